# SPDX-License-Identifier: Apache-2.0
"""Patterns of a projector out of focus, in closed form.

A surface point out of focus sees the pattern through a disc of the projector's image plane. The disc is approximated by
a Gaussian of its standard deviation sigma (a quarter of its diameter), in projector pixels; the pattern is then
filtered before it is read, instead of sampled over the lens. The functions work over `rangesim.response.Math`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from rangesim.response.base import Math

ROOT_HALF = 0.5**0.5
SHARPEST = 1e-5
"""Smallest sigma, in periods or pixels: keeps an edge that is read at its place from 0 / 0."""
SWITCH = 0.075
"""Sigma in periods from which on harmonics stand for the stripes; both forms are then within 5e-4."""


def blurred_stripes(x: Any, period: float, sigma: Any, m: Math) -> Any:
    """Stripes 0 1 1 0 of the given period, dark first, blurred by a Gaussian of standard deviation `sigma`.

    Little blur: the nearest edge, an error function; the next one is left out, less than Q(0.25 / SWITCH), the
    Gaussian's tail. Much blur: mean and harmonics k = 1, 3, 5 of the square wave, each times
    exp(-2 (pi k sigma / P)^2); the seventh is below 2 / (7 pi) exp(-98 (pi SWITCH)^2).
    """
    phase = x * (1 / period)
    phase = phase - m.floor(phase)
    into = 0.25 - m.abs(phase - 0.5)  # periods from the nearest edge, > 0 inside the bright stripe
    spread = sigma * (1 / period)
    edge = 0.5 + 0.5 * m.erf(into * (ROOT_HALF / m.select(spread > SHARPEST, spread, SHARPEST)))
    h, c = m.exp(-2 * np.pi**2 * spread * spread), m.cos(2 * np.pi * phase)
    h4, cc = h * h * h * h, c * c
    h9, h16 = h4 * h4 * h, h4 * h4 * h4 * h4
    third, fifth = 4 * cc - 3, (16 * cc - 20) * cc + 5  # cos 3x and cos 5x, over cos x
    harmonics = c * (h - h9 * third * (1 / 3) + h9 * h16 * fifth * (1 / 5))
    return m.select(spread < SWITCH, edge, 0.5 - 2 / np.pi * harmonics)


def fringe_contrast(period: float, sigma: Any, m: Math) -> Any:
    """Factor on the modulation of a sinusoid: exp(-2 pi^2 sigma^2 / P^2) of the blur, sinc(1 / P) of the pixels.

    Pixels hold the value at their centre over their width (zero-order hold). The steps' own harmonics, near one per
    pixel, are neglected.
    """
    spread = sigma * (1 / period)
    return m.exp(-2 * np.pi**2 * spread * spread) * float(np.sinc(1 / period))


FINEST = 0.5
"""Sigma in pixels up to which the nine nearest pixels are read, each with the Gaussian's weight."""
STEP = 2.0
"""Ratio of variances between blurred copies."""
COPIES = 9


class BlurredImage:
    """A pattern and Gaussian-blurred copies of it, dark outside.

    A blur of up to `FINEST` is read exactly, but for the Gaussian's tails beyond the neighbouring pixels. A stronger
    one is split: the reading blurs by `FINEST`, and the copies hold the rest, so that their variances are FINEST^2
    times 1, 2, 4 ... 256 (sigma 0.5 ... 8 pixels; a stronger blur reads the last copy). Between copies the value is
    linear in the variance, as the heat equation has it for small steps. 36 bytes per pixel.

    Parameters
    ----------
    pattern : (height, width) float32; each pixel a uniform square.
    """

    def __init__(self, pattern: np.ndarray) -> None:
        sharp = np.pad(np.asarray(pattern, dtype=np.float32), 1)  # what is blurred reaches beyond the pattern's edge
        self.height, self.width = sharp.shape
        self.copies = np.stack([_smooth(sharp, FINEST**2 * (STEP**k - 1)) for k in range(COPIES)]).ravel()

    def at(self, u: Any, v: Any, sigma: Any, m: Math) -> Any:
        """Value at pixel coordinates (u, v) with a blur of standard deviation `sigma` pixels."""
        variance = sigma * sigma * (1 / FINEST**2)
        copy, base = 0.0 * variance, 1.0 + 0.0 * variance  # the copy below, and its variance
        for k in range(1, COPIES - 1):
            beyond = variance >= STEP**k
            copy, base = m.select(beyond, float(k), copy), m.select(beyond, STEP**k, base)
        fraction = m.select(variance < STEP ** (COPIES - 1), variance / base, STEP) - 1
        fraction = m.select(fraction > 0, fraction * (1 / (STEP - 1)), 0.0)
        sigma = m.select(sigma < FINEST, sigma, FINEST)
        columns, rows = _taps(u + 1, self.width, sigma, m), _taps(v + 1, self.height, sigma, m)
        copies, offset = m.array(self.copies), m.unsigned(copy) * (self.height * self.width)
        total = 0.0 * u
        for row, row_weight in rows:
            for column, weight in columns:
                index = offset + row * self.width + column
                below, above = m.lookup(copies, index), m.lookup(copies, index + self.height * self.width)
                total = total + row_weight * weight * (below + fraction * (above - below))
        return total


def _taps(x: Any, size: int, sigma: Any, m: Math) -> list[tuple[Any, Any]]:
    """Indices and weights of the three pixels about `x`: the fractions of a Gaussian on each, 0 outside the image."""
    pixel = m.floor(x)
    scale = ROOT_HALF / m.select(sigma > SHARPEST, sigma, SHARPEST)
    before, after = (0.5 + 0.5 * m.erf((pixel + edge - x) * scale) for edge in (0.0, 1.0))
    taps = []
    for place, weight in ((pixel - 1, before), (pixel, after - before), (pixel + 1, 1 - after)):
        inside = (place >= 0) & (place < size)
        taps.append((m.unsigned(m.select(inside, place, 0.0)), m.select(inside, weight, 0.0)))
    return taps


def _smooth(image: np.ndarray, variance: float) -> np.ndarray:
    """`image` convolved with the taps whose frequency response is the Gaussian's up to half a cycle per pixel.

    Sampled Gaussians narrower than a pixel have neither its variance nor its response.
    """
    from scipy.ndimage import correlate1d

    reach = int(np.ceil(5 * np.sqrt(variance))) + 8
    response = np.exp(-2 * np.pi**2 * variance * np.fft.rfftfreq(2 * reach) ** 2)
    kernel = np.fft.fftshift(np.fft.irfft(response))[1:]
    for axis in (0, 1):
        image = correlate1d(image, kernel / kernel.sum(), axis=axis, mode="constant")
    return image
