# SPDX-License-Identifier: Apache-2.0
"""Patterns of a projector out of focus, in closed form.

A surface point that is out of focus receives light from a disc of the projector's image plane (the circle of
confusion). Here the disc is replaced by a Gaussian with the same standard deviation sigma, a quarter of the disc's
diameter, in projector pixels. The pattern is filtered with this Gaussian before it is read, so nothing has to be
sampled over the lens. The functions are written with `rangesim.response.Math`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from rangesim.response.response import Math

ROOT_HALF = 0.5**0.5
"""1 / sqrt(2), dimensionless: the Gaussian's integral up to x is 0.5 + 0.5 erf(x ROOT_HALF / sigma)."""
MIN_SIGMA = 1e-5
"""Smallest sigma, in periods or pixels: it keeps the formula from dividing 0 by 0 at a point exactly on an edge. It is
so small that the edge still looks like a step."""
MIN_HARMONIC_SIGMA = 0.075
"""Sigma in periods from which on `blurred_stripes` sums harmonics instead of taking the nearest edge. At this value
both forms are within 5e-4 of the exact stripes; above it the form with the edge would be less exact, below it the
harmonics."""


def blurred_stripes(x: Any, period: float, sigma: Any, m: Math) -> Any:
    """Value at x of stripes (a quarter dark, half bright, a quarter dark) blurred by a Gaussian.

    If sigma / P is below `MIN_HARMONIC_SIGMA`, the value is that of the nearest edge, an error function. It neglects
    the next edge, which is less than the Gaussian's tail Q(0.25 / MIN_HARMONIC_SIGMA). Above, the value is the mean and
    the harmonics k = 1, 3, 5 of the square wave, each times exp(-2 (pi k sigma / P)^2). It neglects the seventh
    harmonic, which is less than 2 / (7 pi) exp(-98 (pi MIN_HARMONIC_SIGMA)^2).

    Parameters
    ----------
    x, period, sigma : position, period P of the stripes and standard deviation of the blur, in one unit (pixels).
    """
    phase = x * (1 / period)
    phase = phase - m.floor(phase)
    into = 0.25 - m.abs(phase - 0.5)  # distance in periods to the nearest edge, positive inside the bright stripe
    spread = sigma * (1 / period)
    edge = 0.5 + 0.5 * m.erf(into * (ROOT_HALF / m.select(spread > MIN_SIGMA, spread, MIN_SIGMA)))
    h, c = m.exp(-2 * np.pi**2 * spread * spread), m.cos(2 * np.pi * phase)
    h4, cc = h * h * h * h, c * c
    h9, h16 = h4 * h4 * h, h4 * h4 * h4 * h4
    third, fifth = 4 * cc - 3, (16 * cc - 20) * cc + 5  # cos(3a) / cos(a) and cos(5a) / cos(a), a = 2 pi phase
    harmonics = c * (h - h9 * third * (1 / 3) + h9 * h16 * fifth * (1 / 5))
    return m.select(spread < MIN_HARMONIC_SIGMA, edge, 0.5 - 2 / np.pi * harmonics)


def fringe_contrast(period: float, sigma: Any, m: Math) -> Any:
    """Factor by which blur and pixels lower the contrast of sinusoidal fringes with the period P.

    The blur contributes exp(-2 pi^2 sigma^2 / P^2). The pixels contribute sinc(1 / P), because each shows the value at
    its centre over its whole width (zero-order hold); the function neglects the harmonics of these steps, which have
    about one period per pixel.
    """
    spread = sigma * (1 / period)
    return m.exp(-2 * np.pi**2 * spread * spread) * float(np.sinc(1 / period))


MAX_READ_SIGMA_PX = 0.5
"""Blur, as a sigma in pixels, that the reader adds when it reads the nine nearest pixels; stronger blur is in the
copies. At 0.5, less than 2.3 % (Q(2)) of the Gaussian lies beyond the neighbouring pixels; a larger value would need
more than nine."""
VARIANCE_RATIO = 2.0
"""Ratio of the variances of two successive copies. A smaller ratio makes the interpolation more exact and needs more
copies."""
COPIES = 9
"""Number of copies of a pattern: with the ratio 2 they reach a sigma of 8 pixels, and take 36 bytes per pixel. A
stronger blur reads the last copy, so with fewer copies more patterns would be too sharp; each further copy takes 4
bytes per pixel."""


class BlurredImage:
    """A pattern with Gaussian-blurred copies of it; outside the pattern it is dark.

    A blur of at most `MAX_READ_SIGMA_PX` is computed while reading, exactly except for the Gaussian's tails beyond the
    neighbouring pixels. A stronger blur is split in two: reading adds MAX_READ_SIGMA_PX, and the copies hold the rest,
    so that the variances of both together are MAX_READ_SIGMA_PX^2 times 1, 2, 4 ... 256 (sigma 0.5 to 8 pixels). A
    still stronger blur reads the last copy. Between two copies the value is interpolated linearly in the variance: a
    blur obeys the heat equation, so for small steps the value is linear in the variance.

    Parameters
    ----------
    pattern : (height, width) float32; each pixel is a uniform square. Or (width,), stripes that `along` reads.
    """

    def __init__(self, pattern: np.ndarray) -> None:
        sharp = np.pad(np.asarray(pattern, dtype=np.float32), 1)  # blurred light also falls just outside the pattern
        self.height, self.width = sharp.shape if sharp.ndim == 2 else (1, sharp.size)
        variances = [MAX_READ_SIGMA_PX**2 * (VARIANCE_RATIO**k - 1) for k in range(COPIES)]
        self.copies = np.stack([_smooth(sharp, variance) for variance in variances]).ravel()

    def at(self, u: Any, v: Any, sigma: Any, m: Math) -> Any:
        """Value of the pattern at pixel coordinates (u, v), blurred with the standard deviation `sigma`, pixels."""
        read = m.select(sigma < MAX_READ_SIGMA_PX, sigma, MAX_READ_SIGMA_PX)
        return self._read(_taps(u + 1, self.width, read, m), _taps(v + 1, self.height, read, m), sigma, m)

    def along(self, x: Any, sigma: Any, m: Math) -> Any:
        """Value of stripes at the pixel coordinate x, blurred with the standard deviation `sigma`, pixels."""
        read = m.select(sigma < MAX_READ_SIGMA_PX, sigma, MAX_READ_SIGMA_PX)
        return self._read(_taps(x + 1, self.width, read, m), [(0, 1.0)], sigma, m)

    def _read(self, columns: list[tuple[Any, Any]], rows: list[tuple[Any, Any]], sigma: Any, m: Math) -> Any:
        """Sum of the pixels with their weights, in the copies whose blur is nearest to `sigma`."""
        variance = sigma * sigma * (1 / MAX_READ_SIGMA_PX**2)
        copy, base = 0.0 * variance, 1.0 + 0.0 * variance  # index and relative variance of the copy with less blur
        for k in range(1, COPIES - 1):
            beyond = variance >= VARIANCE_RATIO**k
            copy, base = m.select(beyond, float(k), copy), m.select(beyond, VARIANCE_RATIO**k, base)
        fraction = m.select(variance < VARIANCE_RATIO ** (COPIES - 1), variance / base, VARIANCE_RATIO) - 1
        fraction = m.select(fraction > 0, fraction * (1 / (VARIANCE_RATIO - 1)), 0.0)
        copies, offset = m.array(self.copies), m.unsigned(copy) * (self.height * self.width)
        total = 0.0 * sigma
        for row, row_weight in rows:
            for column, weight in columns:
                index = offset + row * self.width + column
                below, above = m.lookup(copies, index), m.lookup(copies, index + self.height * self.width)
                total = total + row_weight * weight * (below + fraction * (above - below))
        return total


def _taps(x: Any, size: int, sigma: Any, m: Math) -> list[tuple[Any, Any]]:
    """Pairs of index and weight for the three pixels around `x` along one axis of the image.

    A weight is the part of the Gaussian that falls on the pixel; for the two outer pixels, also the part that falls
    beyond them. It is 0 outside the image.
    """
    pixel = m.floor(x)
    scale = ROOT_HALF / m.select(sigma > MIN_SIGMA, sigma, MIN_SIGMA)
    before, after = (0.5 + 0.5 * m.erf((pixel + edge - x) * scale) for edge in (0.0, 1.0))
    taps = []
    for place, weight in ((pixel - 1, before), (pixel, after - before), (pixel + 1, 1 - after)):
        inside = (place >= 0) & (place < size)
        taps.append((m.unsigned(m.select(inside, place, 0.0)), m.select(inside, weight, 0.0)))
    return taps


def _smooth(image: np.ndarray, variance: float) -> np.ndarray:
    """The image blurred by a Gaussian of the given variance, pixels^2.

    The weights of the filter have the Gaussian's frequency response up to half a cycle per pixel. Weights that are
    samples of the Gaussian itself would have neither its variance nor its response if it is narrower than a pixel.
    """
    from scipy.ndimage import correlate1d

    reach = int(np.ceil(5 * np.sqrt(variance))) + 8
    response = np.exp(-2 * np.pi**2 * variance * np.fft.rfftfreq(2 * reach) ** 2)
    kernel = np.fft.fftshift(np.fft.irfft(response))[1:]
    for axis in range(image.ndim):
        image = correlate1d(image, kernel / kernel.sum(), axis=axis, mode="constant")
    return image
