# SPDX-License-Identifier: Apache-2.0
"""A filter that takes noise out of indirect light: neighbouring pixels of a surface share their samples.

Light that has been diffusely reflected twice comes to a matte point from a whole hemisphere. It changes little from one
pixel to the next, but a pixel's few paths sample it badly. The mean over neighbours has the noise of many more paths,
and a bias where the light is not linear within the window. Only radiance over the reflectance of the matte surface is
filtered, so that textures stay. Only pixels of the same instance share light, and only if their normals are similar and
they lie in one plane. The weights reproduce exactly light that varies linearly over the surface. So only the second
derivative causes a bias, also in corners and at contacts (local linear regression: Fan, Ann. Statist. 21, 1993; for
rendered images: Bitterli et al., Computer Graphics Forum 35, 2016). The same weights act on every channel: a filtered
pass is the pass of a slightly blurred light, and sensors, histograms and energy split agree.

The window is built from levels of 3 x 3 pixels that are 1, 3, 9 ... pixels apart, so that 9 taps for each level cover a
square of 3^levels pixels (the "a trous" scheme: Dammertz et al., High Performance Graphics 2010).

What a pixel sees in a mirror or through glass is another surface. There, pixels share light if they see the same
surface by the same way: by the same delta surfaces, off or through each of them
(`rangesim.light_transport.first_scatterer`).
Pixels of a glossy surface share light while their normals differ by less than half the width of its lobe. Light in
narrower lobes is an image of its surroundings, and is left as it is.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.kernel_cache import cached_njit
from pcgraph.parallel import MIN_ROWS, in_blocks

LEVELS = 2
"""Number of levels of the window, which is 3^LEVELS pixels wide. It is chosen small, because one more level would make
the window, and with it the bias, three times as wide."""
REACH_PX = 3**LEVELS // 2
"""Largest distance, in pixels along an axis, over which pixels share light; it follows from the levels."""
MIN_NORMAL_COSINE = 0.9
"""Smallest cosine between the normals of two pixels that share light (26 degrees), so that none is shared around edges.
With a larger cosine, pixels on curved surfaces would share no light."""
MAX_PLANE_SINE = 0.3
"""Largest sine of the angle between a pixel's surface and the line to a neighbour that shares light with it (17
degrees), so that none is shared between surfaces that lie behind each other."""
MIN_JUMP = 0.02
"""Distance of a neighbour from a pixel's tangent plane, as a fraction of the distance from the camera, above which the
pixel counts as mixed: it sees an edge and something behind, and lends no light to others. With a smaller value, pixels
on curved surfaces would share no light; with a larger one, light would spread across edges."""
MAX_STRIDE = 0.1
"""Largest distance between the points that two pixels see in a mirror or through glass if they share light, as a
fraction of the point's distance from the camera. Curved mirrors show a room so small that its light changes within a
few pixels. On `tabletop` at 320 x 240, 0.03 makes the noise of AMCW on mirrors 1.2 times as large; without a limit, the
error of direct time of flight there is 1.2 times as large."""
FIRST_CHAIN = 1 << 30
"""Smallest number that stands for a specular chain and the instance beyond it; smaller ones are indices of shapes."""
RIDGE = 0.05
"""Fraction of the weight times the squared step that is added to the second moments of the regression, because a window
of a single row or column would divide by zero otherwise. A larger fraction makes the result of one-sided windows more
like a plain mean."""
CHANNELS_AT_ONCE = 32
"""Number of channels that are filtered together, so that a few rows of pixels of all of them fit into the caches."""
ROWS_AT_ONCE = 16
"""Number of rows of pixels that are filtered together, so that their weights stay in the cache for all channels."""


class Guides(NamedTuple):
    """Properties of the pixels that decide which of them share light: those of the first surface that scatters.

    instance : (h, w) int32, index of the instance; -1 for pixels that share no light. Numbers from `FIRST_CHAIN` on
        stand for a specular chain and the instance beyond it.
    position : (h, w, 3) float32, metres, from the camera's centre.
    normal : (h, w, 3) float32, unit.
    reflectance : (h, w) float32, of a matte surface; 1 for a glossy one.
    first : (h, w, 3) float32, metres, from the camera's centre, of the first surface.
    cosine : (h, w) float32, smallest cosine between the pixel's normal and that of a neighbour that shares light.
    """

    instance: NDArray[np.int32]
    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    reflectance: NDArray[np.float32]
    first: NDArray[np.float32]
    cosine: NDArray[np.float32]

    def with_reflectance(self, reflectance: NDArray[np.float32]) -> Guides:
        """The same guides with another reflectance (h, w).

        Pixels where it is 0 share no light: at the edge of a surface, the few samples over which a texture is averaged
        may all miss it.
        """
        instance = np.where(reflectance > 0, self.instance, np.int32(-1))
        return self._replace(reflectance=reflectance, instance=instance)


class LightFilter:
    """The filter of indirect light for an image with these guides.

    Examples
    --------
    >>> import numpy as np
    >>> plane = np.zeros((9, 9, 3), np.float32)
    >>> plane[..., :2], plane[..., 2] = np.moveaxis(np.indices((9, 9)), 0, -1), 100
    >>> normal = np.broadcast_to(np.float32([0, 0, -1]), plane.shape)
    >>> ones = np.ones((9, 9), np.float32)
    >>> guides = Guides(np.zeros((9, 9), np.int32), plane, normal, reflectance=ones, first=plane, cosine=0 * ones)
    >>> light = np.zeros((1, 9, 9), np.float32)
    >>> light[0, 4, 4] = 81
    >>> LightFilter(guides).apply(light)
    >>> float(light[0, 4, 4].round(3))
    1.0
    """

    def __init__(self, guides: Guides) -> None:
        self.guides = guides

    @cached_property
    def weights(self) -> list[NDArray[np.float32]]:
        """(h, 9, w) float32 for each level, weights of the neighbours; computed when there is light to be shared."""
        guides, mixed = self.guides, mixed_pixels(self.guides)
        weights = [level_weights(guides, mixed, 3**level) for level in range(LEVELS)]
        reflectance = np.where(guides.instance >= 0, guides.reflectance, np.float32(1)).astype(np.float32)
        _of_radiance(weights[0], weights[-1], reflectance)
        return weights

    @cached_property
    def scratch(self) -> NDArray[np.float32]:
        """(CHANNELS_AT_ONCE, h, w) float32, memory for the result of every other level."""
        return np.empty((CHANNELS_AT_ONCE, *self.guides.instance.shape), np.float32)

    def apply(self, image: NDArray[np.float32]) -> None:
        """Filter an image (c, h, w) float32 in place. Channels without any light are left as they are."""
        for begin in range(0, len(image), CHANNELS_AT_ONCE):
            some = image[begin : begin + CHANNELS_AT_ONCE]
            lit = np.flatnonzero(some.any(axis=(1, 2)))
            if not len(lit):
                continue
            before, after = some, self.scratch[: len(some)]
            for level, weights in enumerate(self.weights):
                in_blocks(_apply, image.shape[1], weights, 3**level, lit, before, after, smallest=MIN_ROWS)
                before, after = after, before
            if before is not some:
                some[lit] = before[lit]


def mixed_pixels(guides: Guides) -> NDArray[np.bool_]:
    """(h, w) bool, whether a pixel sees an edge and something behind it."""
    mixed = np.zeros(guides.instance.shape, np.bool_)
    of_surfaces = guides.instance, guides.position, guides.normal, guides.first
    in_blocks(_find_mixed, len(mixed), *of_surfaces, mixed, smallest=MIN_ROWS)
    return mixed


def level_weights(guides: Guides, mixed: NDArray[np.bool_], step: int) -> NDArray[np.float32]:
    """(h, 9, w) float32 weights of the 3 x 3 pixels `step` apart, row by row; they add up to 1."""
    h, w = guides.instance.shape
    weights = np.zeros((h, 9, w), np.float32)
    of_surfaces = guides.instance, guides.position, guides.normal, guides.cosine
    in_blocks(_weigh, h, step, *of_surfaces, mixed, weights, smallest=MIN_ROWS)
    return weights


@cached_njit(nogil=True)
def _find_mixed(start, stop, instance, position, normal, first, mixed):  # type: ignore[no-untyped-def]
    h, w = instance.shape
    for y in range(start, stop):
        for x in range(w):
            if instance[y, x] < 0:
                continue
            for k in range(9):
                yk, xk = y + k // 3 - 1, x + k % 3 - 1
                if not (0 <= yk < h and 0 <= xk < w):
                    continue
                is_beyond = instance[y, x] >= FIRST_CHAIN
                off = distance = 0.0
                for i in range(3):
                    there = position[yk, xk, i] if is_beyond else first[yk, xk, i]
                    off += (there - position[y, x, i]) * normal[y, x, i]
                    distance += position[y, x, i] * position[y, x, i]
                if is_beyond and instance[yk, xk] != instance[y, x]:
                    mixed[y, x] = True
                if not off * off < MIN_JUMP * MIN_JUMP * distance:
                    mixed[y, x] = True


@cached_njit(nogil=True)
def _weigh(start, stop, step, instance, position, normal, narrowest, mixed, weights):  # type: ignore[no-untyped-def]
    h, w = instance.shape
    for y in range(start, stop):
        for x in range(w):
            if instance[y, x] < 0:
                weights[y, 4, x] = 1.0
                continue
            is_shared = np.zeros(9, np.bool_)
            away = 0.0  # squared distance from the camera
            for i in range(3):
                away += position[y, x, i] * position[y, x, i]
            n = sx = sy = sxx = sxy = syy = 0.0
            for k in range(9):
                dy, dx = k // 3 - 1, k % 3 - 1
                yk, xk = y + dy * step, x + dx * step
                if not (0 <= yk < h and 0 <= xk < w) or instance[yk, xk] != instance[y, x]:
                    continue
                if mixed[yk, xk] and not mixed[y, x]:
                    continue
                if k != 4:
                    cosine = off = distance = 0.0
                    for i in range(3):
                        d = position[yk, xk, i] - position[y, x, i]
                        cosine += normal[yk, xk, i] * normal[y, x, i]
                        off += d * normal[y, x, i]
                        distance += d * d
                    if instance[y, x] >= FIRST_CHAIN and distance > MAX_STRIDE * MAX_STRIDE * away:
                        continue
                    if cosine < MIN_NORMAL_COSINE or cosine < narrowest[y, x]:
                        continue
                    if off * off > MAX_PLANE_SINE * MAX_PLANE_SINE * distance:
                        continue
                is_shared[k] = True
                n += 1
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
            # The weights a + b dx + c dy whose moments are 1, 0, 0 (up to a factor)
            sxx += RIDGE * n
            syy += RIDGE * n
            a, b, c = sxx * syy - sxy * sxy, sxy * sy - sx * syy, sx * sxy - sxx * sy
            total = 0.0
            for k in range(9):
                if is_shared[k]:
                    weights[y, k, x] = max(0.0, a + b * (k % 3 - 1) + c * (k // 3 - 1))  # no negative light
                    total += weights[y, k, x]
            for k in range(9):
                weights[y, k, x] /= total


def _of_radiance(first: NDArray[np.float32], last: NDArray[np.float32], reflectance: NDArray[np.float32]) -> None:
    """Change weights for radiance over reflectance into weights for radiance, in place.

    At the first level the function divides them by the reflectance of the neighbour; at the last level it multiplies
    them by the reflectance of the pixel.
    """
    h, w = reflectance.shape
    for k in range(9):
        dy, dx = k // 3 - 1, k % 3 - 1
        here = np.s_[max(0, -dy) : h - max(0, dy), max(0, -dx) : w - max(0, dx)]
        there = np.s_[max(0, dy) : h - max(0, -dy), max(0, dx) : w - max(0, -dx)]
        first[here[0], k, here[1]] /= reflectance[there]
    last *= reflectance[:, None, :]


@cached_njit(nogil=True)
def _apply(start, stop, weights, step, channels, image, out):  # type: ignore[no-untyped-def]
    h = image.shape[1]
    for first in range(start, stop, ROWS_AT_ONCE):  # the weights of these rows stay in the cache
        for c in channels:
            for y in range(first, min(first + ROWS_AT_ONCE, stop)):
                # Beyond the borders weights are 0, so any pixel will do
                above, below = image[c, max(y - step, 0)], image[c, min(y + step, h - 1)]
                _apply_to_row(weights[y], step, above, image[c, y], below, out[c, y])


@cached_njit(nogil=True)
def _apply_to_row(weights, step, above, row, below, out):  # type: ignore[no-untyped-def]
    w = len(row)
    for border in range(min(step, (w + 1) // 2)):
        for x in (border, w - 1 - border):
            total = np.float32(0)
            for i in range(3):
                neighbour = min(max(x + (i - 1) * step, 0), w - 1)
                total += weights[i, x] * above[neighbour]
                total += weights[3 + i, x] * row[neighbour]
                total += weights[6 + i, x] * below[neighbour]
            out[x] = total
    # Views that all start where the sum begins: else the loop is not vectorised
    w0, w1, w2, w3, w4, w5, w6, w7, w8 = (
        weights[0, step:], weights[1, step:], weights[2, step:], weights[3, step:], weights[4, step:],
        weights[5, step:], weights[6, step:], weights[7, step:], weights[8, step:],
    )  # fmt: skip
    a0, a1, a2, r0, r1, r2 = above, above[step:], above[2 * step :], row, row[step:], row[2 * step :]
    b0, b1, b2, result = below, below[step:], below[2 * step :], out[step:]
    for x in range(w - 2 * step):
        result[x] = (
            (w0[x] * a0[x] + w3[x] * r0[x] + w6[x] * b0[x])
            + (w1[x] * a1[x] + w4[x] * r1[x] + w7[x] * b1[x])
            + (w2[x] * a2[x] + w5[x] * r2[x] + w8[x] * b2[x])
        )
