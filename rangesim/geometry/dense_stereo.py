# SPDX-License-Identifier: Apache-2.0
"""Dense matching along the rows of a rectified pair: costs, aggregation, checks, and disparities of sub-pixel accuracy.

Disparities are d = x - x', as in `rangesim.geometry.stereo`. The steps are those of the taxonomy of Scharstein and
Szeliski (IJCV 47, 2002):

1. A cost for each pixel and each whole disparity: the Hamming distance of census transforms (Zabih and Woodfill, ECCV
   1994), or 1 - ZNCC of windows.
2. Aggregation: semi-global, along eight paths (Hirschmueller, PAMI 30, 2008), or local, over a window.
3. The disparity of least cost, if no other one fits as well, if it is not at an end of the range, and if the match back
   from the second image agrees.
4. Refinement: the shift, gain and offset that bring the window of the second image nearest to that of the first one
   (Gauss-Newton; Lucas and Kanade, IJCAI 1981). The texture in the window and the noise give its standard deviation.

Step 4 replaces the parabola through three costs, which draws disparities towards whole pixels. OpenCV's semi-global
matcher can take the place of the steps 1 to 3.

Used by: rangesim.decoding and rangesim.sensors.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Literal, NamedTuple

import numpy as np

from pcgraph.parallel import MIN_ROWS, in_blocks, kernel, routine, side_by_side
from rangesim.geometry.stereo import checked_images, contrast_limits, match_rows
from rangesim.settings.bounds import Bounds, check_fields

CENSUS_ROWS = 3
"""Number of rows of the census window above its middle, and as many below. With `CENSUS_COLUMNS` the window has 7 rows
of 9 pixels, because their 62 comparisons fit a word of 64 bits."""
CENSUS_COLUMNS = 4
"""Number of columns of the census window on either side of its middle; see `CENSUS_ROWS`."""
LARGEST_COST = 62
"""Largest cost of a match, dimensionless: all comparisons of the census differ. ZNCC is scaled to the same range, so
that one pair of penalties serves both."""
ROUNDING = 1e-9
"""Fraction of the squared derivatives. A difference of two sums of them that is smaller is an error of rounding, and
not texture; double precision leaves errors far below it."""
PATHS = 8
"""Number of paths of the semi-global aggregation: all directions to neighbours, as the paper recommends. Means over
windows are multiplied by it, so that both aggregations have one scale."""
ZNCC_LEVELS = 4095
"""Number of grey levels to which images are quantised for ZNCC. The sums over windows are then whole numbers, which do
not depend on the order of the additions, so results do not depend on the number of threads."""
REFINEMENT_STEPS = 4
"""Number of Gauss-Newton steps of the refinement. On noise-free dots the third step still changes disparities by 0.01
pixel, the fourth by less than 0.001."""
MAX_SHIFT_PX = 1.0
"""Largest shift, in pixels, of a refined disparity from the whole one of least cost. A larger shift means that the
window fits another place better, or that its texture does not tell."""
MIN_SUPPORT = 0.25
"""Least fraction of a window whose pixels lie on the surface of its middle for the refinement, see `_refine`."""
MAX_STEP_PX = 1
"""Largest difference of whole disparities, in pixels, of the middle of a window and of a pixel that supports it. On a
slanted surface neighbours differ by one; at a depth edge they differ by more."""
DIRECTIONS = 16
"""Number of directions, evenly around a pixel, in each of which `is_enclosed` asks for texture. The segments of a disc
in neighbouring directions overlap by more than half, so no side of a pixel is left out."""
BESIDE_PX = 2.5
"""Least distance of that texture from the pixel along the direction, in pixels: about the half width that a sharp edge
has in the derivatives."""
AROUND = 1.5
"""Radius of the disc in which that texture lies, as a multiple of the side of the window. At the defaults the segment
of the disc in one direction has the area of more than two windows, and holds ten dots."""
SEGMENT_SHARE = 0.1
"""Least texture of a segment, as a fraction of the texture that locates a match to `max_sigma_px`."""
UNMATCHED = 2.0
"""Ratio of two variances: that of the difference of two independent noises of equal strength, and that of one of them.
Where there is no match, the fit has a gain near 0, so its residuals are the noise of one image alone."""
MAX_STEPS = 32_000
"""Largest number of steps between the least and the largest disparity, because OpenCV's filter of speckles takes images
of 16-bit integers, which end at 32 767."""
BIG = 30_000
"""A cost that no path has, in the unit of `LARGEST_COST`. One path costs at most `LARGEST_COST` + the large penalty,
and the sum of all eight stays below this value."""


class MatchOutcome(IntEnum):
    """Outcome of the matching of one pixel.

    Examples
    --------
    >>> MatchOutcome.AMBIGUOUS.name
    'AMBIGUOUS'
    """

    MATCHED = 0
    NO_TEXTURE = 1
    """The texture of the window does not locate a match against the noise."""
    OCCLUDED = 2
    """No pixel of the second image matches back: the second camera does not see the point."""
    AMBIGUOUS = 3
    """Another disparity fits as well, or the match back from the second image disagrees."""
    OUT_OF_RANGE = 4
    """The least cost is at an end of the range of disparities."""
    NO_IMAGE = 5
    """The first image has no value at the pixel."""


@dataclass(frozen=True)
class DenseMatching:
    """Settings of `match_densely`.

    Parameters
    ----------
    method : "census", "zncc", or "opencv", which is OpenCV's StereoSGBM (`rangesim.geometry.match_rows`).
    aggregation : "semi-global" or "local"; "opencv" is always semi-global.
    window_px : odd number of pixels, side of the window of ZNCC, of local aggregation, of OpenCV's blocks and of the
        refinement.
    small_penalty, large_penalty : costs of a change of disparity by one pixel, and by more than one, along a path of
        the "semi-global" aggregation; the cost of a match is 0 to `LARGEST_COST`.
    uniqueness : fraction by which the aggregated cost of any other disparity must be larger than the least one.
    min_advantage : cost by which the mean over the window of any other disparity must be larger. It refuses repeated
        texture, which the paths of semi-global aggregation tell apart by the border of the image alone.
    max_difference_px : largest difference in pixels of the match back from the second image.
    max_sigma_px : largest standard deviation of a disparity in pixels that counts as enough texture.
    min_correlation : least correlation coefficient of both windows after the refinement. Images of noise alone reach
        0.3 to 0.6 where a matcher may choose the place.
    min_slope_correlation : least correlation coefficient of their derivatives along the row. An even slope of the
        brightness gives both windows a high correlation, but locates nothing; their derivatives are noise, and differ.
    min_region_px : number of pixels; smaller regions of connected matches, whose neighbours differ by at most a pixel
        of disparity, are refused as speckles. 0: none are.
    texture_around : whether a match needs texture on all sides of its pixel. Without it, a pixel on an even surface
        beside a lone edge takes the depth of the edge.
    refine : whether disparities are refined, see the module. Without it they come from a parabola through three costs.

    Examples
    --------
    >>> DenseMatching(method="zncc").window_px
    9
    """

    method: Literal["census", "zncc", "opencv"] = "census"
    aggregation: Literal["semi-global", "local"] = "semi-global"
    window_px: Annotated[int, Bounds("an odd number of pixels", 3, 63)] = 9
    small_penalty: Annotated[int, Bounds("a cost", 0, 200)] = 8
    large_penalty: Annotated[int, Bounds("a cost", 0, 2000)] = 30
    uniqueness: Annotated[float, Bounds("a fraction", 0, 1)] = 0.1
    min_advantage: Annotated[float, Bounds("a cost", -LARGEST_COST, LARGEST_COST)] = 1.0
    max_difference_px: Annotated[float, Bounds("pixels", 0, 1e4)] = 1.0
    max_sigma_px: Annotated[float, Bounds("pixels", 1e-6, 1e4)] = 0.15
    min_correlation: Annotated[float, Bounds("a correlation coefficient", -1, 1)] = 0.7
    min_slope_correlation: Annotated[float, Bounds("a correlation coefficient", -1, 1)] = 0.5
    min_region_px: Annotated[int, Bounds("a number of pixels", 0, 10_000_000)] = 60
    texture_around: bool = True
    refine: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
        if self.window_px % 2 == 0:
            raise ValueError(f"expected window_px odd, got {self.window_px}.")
        if self.small_penalty > self.large_penalty:
            raise ValueError(
                f"expected small_penalty to be at most large_penalty, got {self.small_penalty} and "
                f"{self.large_penalty}."
            )

    @property
    def reach(self) -> int:
        """Half of the window without its middle, pixels."""
        return self.window_px // 2


class DenseMatch(NamedTuple):
    """Disparities of the pixels of the first image.

    disparity_px : (h, w) float32, pixels; NaN where `outcome` is not MATCHED.
    sigma_px : (h, w) float32, pixels, standard deviation that the noise of the images causes; NaN where it is not
        known.
    outcome : (h, w) uint8, values of `MatchOutcome`.
    """

    disparity_px: np.ndarray
    sigma_px: np.ndarray
    outcome: np.ndarray


def match_densely(
    first: np.ndarray,
    second: np.ndarray,
    disparities_px: tuple[float, float],
    settings: DenseMatching | None = None,
    noise: tuple[np.ndarray | float, np.ndarray | float] = (0.0, 0.0),
) -> DenseMatch:
    """Disparities of a rectified pair with the outcome of each pixel.

    Parameters
    ----------
    first, second : (h, w) images in any unit, NaN where there is no image.
    disparities_px : least and largest disparity to look for, pixels.
    settings : DenseMatching; None: the defaults.
    noise : standard deviation of the noise of both images, in their unit; each a number or (h, w).

    Raises
    ------
    ValueError
        The images differ in shape, or the range of disparities is empty or wider than the image.

    Examples
    --------
    A texture of waves, shifted by 5.3 pixels:

    >>> import numpy as np
    >>> y, x = np.mgrid[:24, :64] + 0.5
    >>> random = np.random.default_rng(0)
    >>> waves, phases = random.uniform(-1, 1, (40, 2)), random.uniform(0, 6, 40)
    >>> def seen(shift):
    ...     return sum(np.sin(a * (x + shift) + b * y + c) for (a, b), c in zip(waves, phases))
    >>> found = match_densely(seen(0.0), seen(5.3), (0, 10))
    >>> round(float(np.nanmedian(found.disparity_px)), 2)
    5.3
    """
    settings = settings or DenseMatching()
    a, b = checked_images(first, second, disparities_px)
    least, largest = disparities_px
    noises = tuple(np.broadcast_to(np.asarray(n, dtype=np.float32), a.shape).copy() for n in noise)
    images = a.astype(np.float32), b.astype(np.float32)
    if settings.method == "opencv":
        whole, outcome = _by_opencv(images, disparities_px, settings)
    else:
        whole, outcome = _by_costs(images, noises, disparities_px, settings)
    known = np.isfinite(a)
    outcome[~known] = MatchOutcome.NO_IMAGE
    fit = refine_disparities(images, noises, whole, settings)
    # Where the texture does not suffice, neither a match nor its failure means anything
    is_flat = locating_sigma(images[0], noises, settings.reach) > settings.max_sigma_px
    outcome[known & is_flat] = MatchOutcome.NO_TEXTURE
    if settings.texture_around:
        matched = outcome == MatchOutcome.MATCHED
        outcome[matched & ~is_enclosed(images[0], fit.variance, matched, settings)] = MatchOutcome.NO_TEXTURE
    is_alike = fit.slope_correlation >= settings.min_slope_correlation
    is_sure = is_alike & (fit.correlation >= settings.min_correlation) & (fit.sigma_px <= settings.max_sigma_px)
    refused = ~(np.isfinite(fit.disparity_px) & is_sure)
    outcome[(outcome == MatchOutcome.MATCHED) & refused] = MatchOutcome.AMBIGUOUS
    found = fit.disparity_px if settings.refine else whole
    outside = ~((found >= least) & (found <= largest)) & (outcome == MatchOutcome.MATCHED)
    outcome[outside] = MatchOutcome.OUT_OF_RANGE
    disparity = found.astype(np.float32)
    outcome[_is_speckle(disparity, outcome, settings.min_region_px)] = MatchOutcome.AMBIGUOUS
    wrong = outcome != MatchOutcome.MATCHED
    disparity[wrong] = np.nan
    return DenseMatch(disparity, np.where(wrong, np.nan, fit.sigma_px).astype(np.float32), outcome)


def locating_sigma(image: np.ndarray, noises: tuple[np.ndarray, ...], reach: int) -> np.ndarray:
    """(h, w) float64, pixels, standard deviation with which the texture in a window of the first image locates a match.

    It is the square root of V / S, where V is the variance of the noise of both images, and S the sum of the squared
    derivatives in the window, less what an even slope and the noise itself contribute; infinite where nothing is left.

    Parameters
    ----------
    image : (h, w) float, NaN where there is none. noises : standard deviations (h, w) of the noise of both images.
    """
    from scipy.ndimage import uniform_filter

    slopes = _slopes(image)
    derivative, usable = np.nan_to_num(slopes), np.isfinite(slopes).astype(np.float64)
    own = noises[0].astype(np.float64) ** 2
    side = 2 * reach + 1
    mean, squares, weight = (uniform_filter(v, side, mode="constant") for v in (derivative, derivative**2, usable))
    with np.errstate(divide="ignore", invalid="ignore"):
        texture = squares - mean**2 / weight - weight * own / 2  # a central difference has half of the noise's variance
        variance = own + float(np.mean(noises[1].astype(np.float64) ** 2))
        tiny = ROUNDING * np.nan_to_num(squares)
        return np.where(texture > tiny, np.sqrt(variance / (texture * side**2)), np.inf)


def _slopes(image: np.ndarray) -> np.ndarray:
    """(h, w) float64, central differences along the rows, per pixel; NaN where a neighbour has no finite value."""
    values = np.where(np.isfinite(image), image, np.nan).astype(np.float64)
    slopes = np.full(image.shape, np.nan)
    slopes[:, 1:-1] = (values[:, 2:] - values[:, :-2]) / 2
    return slopes


def is_enclosed(image: np.ndarray, variance: np.ndarray, matched: np.ndarray, settings: DenseMatching) -> np.ndarray:
    """(h, w) bool, whether texture encloses a pixel of the first image.

    A window that holds nothing but one edge finds the place of the edge, not that of its middle: beside the outline of
    a thing before an even wall, the wall would get the depth of the thing. Such a pixel has a direction in which there
    is no texture. Texture is counted in units of the noise: that of the match at the pixel, or that around it,
    whichever is less. A segment of which at least half lies outside the image counts as textured.

    Parameters
    ----------
    image : (h, w) float, NaN where there is none.
    variance : (h, w) float64, variance of the difference of both images at a match; NaN where there is none.
    """
    squares = _slopes(image) ** 2
    outer = AROUND * settings.window_px
    reach = int(outer)
    dy, dx = (v.ravel() for v in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    along = np.outer(np.cos(angles), dx) + np.outer(np.sin(angles), dy)
    beyond = (along > BESIDE_PX) & (np.hypot(dx, dy) <= outer)
    used = beyond.any(axis=0)
    segments = [np.flatnonzero(s) for s in beyond[:, used]]
    starts = np.cumsum([0, *map(len, segments)])
    tiny = ROUNDING * np.nanmean(squares) if np.isfinite(squares).any() else 0.0
    floor = np.maximum(variance, max(float(np.nan_to_num(tiny)), 1e-300))
    needed = SEGMENT_SHARE / settings.max_sigma_px**2
    result = np.zeros(image.shape, dtype=np.bool_)
    in_blocks(
        _enclosed, len(image), squares, floor, matched, needed, dy[used], dx[used],
        np.concatenate(segments), starts, result,
        smallest=MIN_ROWS,
    )  # fmt: skip
    return result


@kernel
def _enclosed(start, stop, squares, variance, matched, needed, dy, dx, members, starts, result):  # type: ignore[no-untyped-def]
    """Kernel over rows: whether each segment has more than `needed` texture, in units of the variance."""
    height, width = squares.shape
    values = np.empty(len(dy))
    for y in range(start, stop):
        for x in range(width):
            here = variance[y, x]
            if not (matched[y, x] and here < np.inf):
                continue
            for k in range(len(dy)):
                row, column = y + dy[k], x + dx[k]
                if 0 <= row < height and 0 <= column < width:
                    others = UNMATCHED * variance[row, column]  # not a number where it is not known
                    v = others if others < here else here
                    values[k] = squares[row, column] / v - 0.5
                else:
                    values[k] = np.nan
            result[y, x] = True
            for i in range(len(starts) - 1):
                total, n, size = 0.0, 0, starts[i + 1] - starts[i]
                for k in range(starts[i], starts[i + 1]):
                    value = values[members[k]]
                    if np.isfinite(value):
                        total += value
                        n += 1
                if n > size / 2 and total <= needed * n / size:
                    result[y, x] = False
                    break


def _is_speckle(disparity_px: np.ndarray, outcome: np.ndarray, size: int) -> np.ndarray:
    """(h, w) bool, whether a match belongs to a region of at most `size` pixels, see `DenseMatching.min_region_px`."""
    import cv2

    matched = outcome == MatchOutcome.MATCHED
    if not size or not matched.any():
        return np.zeros(outcome.shape, dtype=bool)
    least = float(disparity_px[matched].min())
    steps = min(16.0, MAX_STEPS / max(float(disparity_px[matched].max()) - least, 1.0))  # steps per pixel
    levels = np.full(outcome.shape, -1, dtype=np.int16)
    levels[matched] = np.rint((disparity_px[matched] - least) * steps)
    kept = levels.copy()
    cv2.filterSpeckles(kept, -1, size, int(MAX_STEP_PX * steps))
    return np.asarray(matched & (kept < 0))


def _by_opencv(
    images: tuple[np.ndarray, np.ndarray], disparities_px: tuple[float, float], settings: DenseMatching
) -> tuple[np.ndarray, np.ndarray]:
    """Disparities (h, w) float64 of OpenCV's matcher, and outcomes. OpenCV does not say why a pixel has no match, so
    all of these count as ambiguous."""
    low, high = contrast_limits(images[0].astype(np.float64))
    if not high > low:
        nothing = np.full(images[0].shape, np.nan)
        return nothing, np.full(images[0].shape, MatchOutcome.AMBIGUOUS, dtype=np.uint8)
    found = match_rows(*images, disparities_px, settings.window_px).astype(np.float64)
    outcome = np.where(np.isfinite(found), MatchOutcome.MATCHED, MatchOutcome.AMBIGUOUS).astype(np.uint8)
    return found, outcome


def _by_costs(
    images: tuple[np.ndarray, np.ndarray],
    noises: tuple[np.ndarray, ...],
    disparities_px: tuple[float, float],
    settings: DenseMatching,
) -> tuple[np.ndarray, np.ndarray]:
    """Disparities (h, w) float64 of least cost, with the parabola's fraction, and outcomes (h, w) uint8."""
    least, largest = disparities_px
    start = int(np.floor(least)) - 1  # one more at either end: a least cost there is out of range
    count = int(np.ceil(largest)) + 1 - start + 1
    height, width = images[0].shape
    cost = np.empty((height, width, count), dtype=np.uint8)
    if settings.method == "census":
        codes = tuple(_census_codes(image, noise) for image, noise in zip(images, noises, strict=True))
        in_blocks(_hamming_cost, height, *codes, start, cost, smallest=MIN_ROWS)
    else:
        grey = tuple(_grey_levels(image, images[0]) for image in images)
        sums = tuple(_window_moments(g, settings.reach) for g in grey)
        in_blocks(_zncc_cost, height, *grey, *sums, settings.reach, start, cost, smallest=MIN_ROWS)
    total = _aggregated(cost, settings)
    back = np.empty((height, width), dtype=np.int32)
    in_blocks(_best_of_second, height, total, start, back, smallest=MIN_ROWS)
    disparity, outcome = np.empty((height, width)), np.empty((height, width), dtype=np.uint8)
    local = total if settings.aggregation == "local" else _window_costs(cost, settings)
    limits = _Limits(settings.uniqueness, settings.max_difference_px, PATHS * settings.min_advantage)
    in_blocks(_best_of_first, height, total, local, back, start, limits, disparity, outcome, smallest=MIN_ROWS)
    return disparity, outcome


def _census_codes(image: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(h, w) uint64 census transform of an image; a neighbour counts as darker if it is so by more than the noise."""
    codes = np.empty(image.shape, dtype=np.uint64)
    in_blocks(_census, len(image), image, noise, codes, smallest=MIN_ROWS)
    return codes


def _grey_levels(image: np.ndarray, of: np.ndarray) -> np.ndarray:
    """(h, w) int64, the image in `ZNCC_LEVELS` levels between the quantiles of 0.1 and 99.9 % of the image `of`."""
    known = of[np.isfinite(of)]
    low, high = np.quantile(known, [0.001, 0.999]) if known.size else (0.0, 1.0)
    scale = ZNCC_LEVELS / max(float(high - low), 1e-30)
    return np.nan_to_num(np.rint(np.clip((image - low) * scale, 0, ZNCC_LEVELS))).astype(np.int64)


def _window_moments(grey: np.ndarray, reach: int) -> np.ndarray:
    """(2, h, w) int64, sums of the grey levels and of their squares over the window around each pixel; the window is
    cut off at the border of the image."""
    return np.stack([_box(grey, reach), _box(grey * grey, reach)])


def _box(values: np.ndarray, reach: int) -> np.ndarray:
    """(h, w) int64, sums over windows that are cut off at the border."""
    for axis in (0, 1):
        n = values.shape[axis]
        running = np.cumsum(values, axis=axis, dtype=np.int64)
        running = np.concatenate([np.zeros_like(np.take(running, [0], axis)), running], axis=axis)
        above, below = np.minimum(np.arange(n) + reach + 1, n), np.maximum(np.arange(n) - reach, 0)
        values = np.take(running, above, axis) - np.take(running, below, axis)
    return values


def _aggregated(cost: np.ndarray, settings: DenseMatching) -> np.ndarray:
    """(h, w, n) uint16, costs (h, w, n) aggregated along eight paths, or over a window."""
    if settings.aggregation == "local":
        return _window_costs(cost, settings)
    penalties = settings.small_penalty, settings.large_penalty
    down, up = np.zeros(cost.shape, dtype=np.uint16), np.zeros(cost.shape, dtype=np.uint16)
    side_by_side(lambda: _sweep(cost, *penalties, True, down), lambda: _sweep(cost, *penalties, False, up))
    down += up
    return down


def _window_costs(cost: np.ndarray, settings: DenseMatching) -> np.ndarray:
    """(h, w, n) uint16, mean of the costs (h, w, n) over the window around each pixel, times `PATHS`."""
    total = np.empty(cost.shape, dtype=np.uint16)
    in_blocks(_window_sum, len(cost), cost, settings.reach, total, smallest=MIN_ROWS)
    return total


class _Limits(NamedTuple):
    """Limits of the checks of a least cost, as kernels take them; see `DenseMatching`."""

    uniqueness: float
    max_difference_px: float
    min_advantage: float


# ---- Costs ---------------------------------------------------------------------------------------------------------


@kernel
def _census(start, stop, image, noise, codes):  # type: ignore[no-untyped-def]
    """Kernel over rows: codes[y, x] has a bit for each neighbour that is darker than the pixel."""
    height, width = image.shape
    for y in range(start, stop):
        for x in range(width):
            code = np.uint64(0)
            level = image[y, x] - noise[y, x]
            for v in range(-CENSUS_ROWS, CENSUS_ROWS + 1):
                row = min(max(y + v, 0), height - 1)
                for u in range(-CENSUS_COLUMNS, CENSUS_COLUMNS + 1):
                    if u != 0 or v != 0:
                        code <<= np.uint64(1)
                        if image[row, min(max(x + u, 0), width - 1)] < level:
                            code |= np.uint64(1)
            codes[y, x] = code


@routine
def _bits(word):  # type: ignore[no-untyped-def]
    """Number of bits that are set in a word of 64 bits (Knuth, The Art of Computer Programming 4A, 7.1.3)."""
    word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@kernel
def _hamming_cost(start, stop, first, second, least, cost):  # type: ignore[no-untyped-def]
    """Kernel over rows: cost[y, x, i] of the disparity `least` + i; the largest one where the match is no pixel."""
    _, width, count = cost.shape
    for y in range(start, stop):
        for x in range(width):
            for i in range(count):
                other = x - least - i
                inside = 0 <= other < width
                cost[y, x, i] = _bits(first[y, x] ^ second[y, other]) if inside else LARGEST_COST


@kernel
def _zncc_cost(start, stop, first, second, moments, other_moments, reach, least, cost):  # type: ignore[no-untyped-def]
    """Kernel over rows: cost[y, x, i] = (1 - ZNCC) `LARGEST_COST` / 2 of the disparity `least` + i.

    first, second : (h, w) int64 grey levels. moments, other_moments : (2, h, w) int64, sums of the levels and of their
    squares over windows.
    """
    height, width, count = cost.shape
    columns = np.empty(width, dtype=np.int64)
    for y in range(start, stop):
        top, bottom = max(y - reach, 0), min(y + reach, height - 1) + 1
        for i in range(count):
            shift = least + i
            for x in range(width):
                other = x - shift
                total = np.int64(0)
                if 0 <= other < width:
                    for row in range(top, bottom):
                        total += first[row, x] * second[row, other]
                columns[x] = total
            product = np.int64(0)
            for x in range(min(reach, width)):
                product += columns[x]
            for x in range(width):
                if x + reach < width:
                    product += columns[x + reach]
                if x - reach - 1 >= 0:
                    product -= columns[x - reach - 1]
                other = x - shift
                if not 0 <= other < width:
                    cost[y, x, i] = LARGEST_COST
                    continue
                n = (bottom - top) * (min(x + reach, width - 1) + 1 - max(x - reach, 0))
                covariance = n * product - moments[0, y, x] * other_moments[0, y, other]
                own = n * moments[1, y, x] - moments[0, y, x] ** 2
                others = n * other_moments[1, y, other] - other_moments[0, y, other] ** 2
                zncc = 0.0
                if own > 0 and others > 0:
                    zncc = covariance / (np.sqrt(float(own)) * np.sqrt(float(others)))
                cost[y, x, i] = round(0.5 * LARGEST_COST * (1.0 - min(max(zncc, -1.0), 1.0)))


# ---- Aggregation ---------------------------------------------------------------------------------------------------


@kernel
def _window_sum(start, stop, cost, reach, total):  # type: ignore[no-untyped-def]
    """Kernel over rows: total[y, x, i] is the mean cost over the window times `PATHS`."""
    height, width, count = cost.shape
    columns = np.zeros((width, count), dtype=np.int64)
    for y in range(start, stop):
        top, bottom = max(y - reach, 0), min(y + reach, height - 1) + 1
        columns[:] = 0
        for row in range(top, bottom):
            for x in range(width):
                for i in range(count):
                    columns[x, i] += cost[row, x, i]
        sums = np.zeros(count, dtype=np.int64)
        for x in range(min(reach, width)):
            for i in range(count):
                sums[i] += columns[x, i]
        for x in range(width):
            n = (bottom - top) * (min(x + reach, width - 1) + 1 - max(x - reach, 0))
            for i in range(count):
                if x + reach < width:
                    sums[i] += columns[x + reach, i]
                if x - reach - 1 >= 0:
                    sums[i] -= columns[x - reach - 1, i]
                total[y, x, i] = PATHS * sums[i] // n


@routine
def _extend(cost, before, least_before, small, large, after, total):  # type: ignore[no-untyped-def]
    """Extend one path by a pixel, add its costs to `total` (n,), and return the least of them.

    before, after : (n + 2,) int32, costs of the path at the pixel before and at this pixel, with `BIG` at either end.
    """
    least = np.int32(BIG)
    jump = least_before + large
    for i in range(len(cost)):
        best = min(min(before[i + 1], jump), min(before[i], before[i + 2]) + small)
        value = np.int32(cost[i] + best - least_before)
        after[i + 1] = value
        total[i] += np.uint16(value)
        least = min(least, value)
    return least


@kernel
def _sweep(cost, small, large, is_down, total):  # type: ignore[no-untyped-def]
    """Add to total (h, w, n) the costs of four paths: along the row, and from the three neighbours in the row before.

    Down the image, the paths lead to the right and down; up the image, they lead to the left and up.
    """
    height, width, count = cost.shape
    small, large = np.int32(small), np.int32(large)
    along = np.empty((2, count + 2), dtype=np.int32)
    rows = np.full((2, 3, width + 2, count + 2), BIG, dtype=np.int32)
    least = np.zeros((2, 3, width + 2), dtype=np.int32)
    rows[:, :, :, 1 : count + 1] = 0
    step = 1 if is_down else -1
    for j in range(height):
        y = j if is_down else height - 1 - j
        now, then = j % 2, 1 - j % 2
        along[:] = BIG
        along[:, 1 : count + 1] = 0
        least_along = np.int32(0)
        for i in range(width):
            x = i if is_down else width - 1 - i
            here, sums = cost[y, x], total[y, x]
            least_along = _extend(here, along[(i + 1) % 2], least_along, small, large, along[i % 2], sums)
            for k in range(3):
                source = x + 1 + (k - 1) * step
                least[now, k, x + 1] = _extend(
                    here, rows[then, k, source], least[then, k, source], small, large, rows[now, k, x + 1], sums
                )


# ---- The least cost ------------------------------------------------------------------------------------------------


@kernel
def _best_of_second(start, stop, total, least, back):  # type: ignore[no-untyped-def]
    """Kernel over rows: back[y, x] is the disparity of least cost of pixel x of the second image."""
    _, width, count = total.shape
    for y in range(start, stop):
        for other in range(width):
            best, lowest = 0, 1 << 30
            for i in range(count):
                x = other + least + i
                if 0 <= x < width and total[y, x, i] < lowest:
                    best, lowest = i, total[y, x, i]
            back[y, other] = best + least


@kernel
def _best_of_first(start, stop, total, local, back, least, limits, disparity, outcome):  # type: ignore[no-untyped-def]
    """Kernel over rows: the disparity of least cost of each pixel of the first image, and whether it passes the checks.

    A pixel whose match back disagrees is occluded if no pixel of the second image in its range matches back to it, and
    ambiguous otherwise (Hirschmueller, section II.E).
    """
    _, width, count = total.shape
    for y in range(start, stop):
        for x in range(width):
            best, lowest = 0, int(total[y, x, 0])
            for i in range(1, count):
                if total[y, x, i] < lowest:
                    best, lowest = i, int(total[y, x, i])
            second, elsewhere = 1 << 30, 1 << 30
            for i in range(count):
                if abs(i - best) > 1:
                    second = min(second, int(total[y, x, i]))
                    elsewhere = min(elsewhere, int(local[y, x, i]))
            fraction = 0.0
            if 0 < best < count - 1:
                before, after = float(total[y, x, best - 1]), float(total[y, x, best + 1])
                curvature = before + after - 2.0 * lowest
                if curvature > 0:
                    fraction = 0.5 * (before - after) / curvature
            disparity[y, x] = least + best + fraction
            other = x - least - best
            found = MatchOutcome.MATCHED.value
            if not 0 <= other < width or abs(back[y, other] - least - best) > limits.max_difference_px:
                found = MatchOutcome.OCCLUDED.value
                for i in range(count):
                    there = x - least - i
                    if 0 <= there < width and abs(back[y, there] - least - i) <= limits.max_difference_px:
                        found = MatchOutcome.AMBIGUOUS.value
            elif best == 0 or best == count - 1:
                found = MatchOutcome.OUT_OF_RANGE.value
            elif second * (1.0 - limits.uniqueness) <= lowest or elsewhere - local[y, x, best] < limits.min_advantage:
                found = MatchOutcome.AMBIGUOUS.value
            outcome[y, x] = found


# ---- Refinement ----------------------------------------------------------------------------------------------------


class Refinement(NamedTuple):
    """Refined disparities: all (h, w) float64; NaN where the window has too little support.

    disparity_px, sigma_px : pixels, the disparity and its standard deviation.
    correlation : correlation coefficient of both windows.
    slope_correlation : correlation coefficient of their derivatives along the row, which alone locate a match.
    variance : V of `refine_disparities`, in the square of the first image's unit.
    """

    disparity_px: np.ndarray
    sigma_px: np.ndarray
    correlation: np.ndarray
    slope_correlation: np.ndarray
    variance: np.ndarray


def refine_disparities(
    images: tuple[np.ndarray, np.ndarray],
    noises: tuple[np.ndarray, ...],
    disparity_px: np.ndarray,
    settings: DenseMatching,
) -> Refinement:
    """Disparities refined by least squares: the first window is b + a times the second one, shifted by a fraction.

    The second image is interpolated by cubic B-splines along its rows. The standard deviation is that of the linear
    model: sigma^2 = V / (a^2 S), where S is the sum of the squared derivatives in the window that gain and offset do
    not explain. V is the variance of a pixel: by the stated noise, sigma_1^2 + a^2 sigma_2^2, or by the residuals of
    the fit if these are larger. So it contains what the model leaves out, such as texture that is too fine for the
    pixels. It counts neighbouring pixels as independent.

    Parameters
    ----------
    images, noises : (h, w) float32 each. disparity_px : (h, w) float64 disparities to start from; NaN for none.
    """
    from scipy.ndimage import spline_filter1d

    known = tuple(np.isfinite(image) for image in images)
    middle = float(np.nanmean(images[1])) if known[1].any() else 0.0
    filled = np.where(known[1], images[1], middle).astype(np.float64)
    splines = spline_filter1d(filled, order=3, axis=1, mode="mirror")
    slopes = np.zeros(filled.shape)
    own = spline_filter1d(np.nan_to_num(images[0].astype(np.float64)), order=3, axis=1, mode="mirror")
    slopes[:, 1:-1] = (own[:, 2:] - own[:, :-2]) / 2
    size = images[0].shape
    result = Refinement(*(np.full(size, np.nan) for _ in Refinement._fields))
    in_blocks(
        _refine, size[0], images[0].astype(np.float64), slopes, known[0], splines, known[1],
        *(n.astype(np.float64) for n in noises), disparity_px, settings.reach, result, smallest=MIN_ROWS,
    )  # fmt: skip
    return result


@kernel
def _refine(start, stop, first, slopes, known, splines, other_known, noise, other_noise, start_px, reach, result):  # type: ignore[no-untyped-def]
    """Kernel over rows: refined disparities. Pixels of the window support it whose own disparity is about the same."""
    height, width = first.shape
    side = 2 * reach + 1
    values, derivatives, references = np.empty(side * side), np.empty(side * side), np.empty(side * side)
    own = np.empty(side * side)
    for y in range(start, stop):
        for x in range(width):
            base = start_px[y, x]
            if not np.isfinite(base):
                continue
            shift = base
            for iteration in range(REFINEMENT_STEPS + 1):
                cell = np.floor(-shift)
                t = -shift - cell
                w0, w1, w2, w3 = (
                    (1 - t) ** 3 / 6,
                    2 / 3 - t * t * (1 - t / 2),
                    2 / 3 - (1 - t) ** 2 * (1 + t) / 2,
                    t**3 / 6,
                )
                v0, v1, v2, v3 = -((1 - t) ** 2) / 2, t * (1.5 * t - 2), 0.5 + t - 1.5 * t * t, t * t / 2
                n = 0
                mean_own = 0.0
                mean_first, mean_value, mean_derivative, variance, other_variance = 0.0, 0.0, 0.0, 0.0, 0.0
                for row in range(max(y - reach, 0), min(y + reach, height - 1) + 1):
                    for column in range(max(x - reach, 0), min(x + reach, width - 1) + 1):
                        at = column + int(cell)
                        if at < 1 or at + 2 >= width or not abs(start_px[row, column] - base) <= MAX_STEP_PX + 0.5:
                            continue
                        if not (known[row, column] and other_known[row, at] and other_known[row, at + 1]):
                            continue
                        s0, s1, s2, s3 = (
                            splines[row, at - 1],
                            splines[row, at],
                            splines[row, at + 1],
                            splines[row, at + 2],
                        )
                        value = w0 * s0 + w1 * s1 + w2 * s2 + w3 * s3
                        derivative = v0 * s0 + v1 * s1 + v2 * s2 + v3 * s3
                        values[n], derivatives[n], references[n] = value, derivative, first[row, column]
                        own[n] = slopes[row, column]
                        mean_own += slopes[row, column]
                        mean_first += first[row, column]
                        mean_value += value
                        mean_derivative += derivative
                        variance += noise[row, column] ** 2
                        other_variance += other_noise[row, at] ** 2
                        n += 1
                if n < MIN_SUPPORT * side * side:
                    break
                mean_first, mean_value, mean_derivative = mean_first / n, mean_value / n, mean_derivative / n
                vv, dd, ff, vd, vf, df = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for k in range(n):
                    v, d, f = values[k] - mean_value, derivatives[k] - mean_derivative, references[k] - mean_first
                    vv += v * v
                    dd += d * d
                    ff += f * f
                    vd += v * d
                    vf += v * f
                    df += d * f
                texture = dd - vd * vd / vv if vv > 0 else 0.0  # derivatives that a gain does not explain
                if not (texture > 0 and ff > 0):
                    break
                change = (df - vd * vf / vv) / texture  # gain times the shift to the right
                gain = (vf - change * vd) / vv
                if iteration == REFINEMENT_STEPS:
                    gain = max(vf / vv, 1e-30)
                    variance = variance / n + gain * gain * other_variance / n
                    residual = max(ff - gain * vf, 0.0) / max(n - 3, 1)
                    result.disparity_px[y, x] = shift
                    result.variance[y, x] = max(variance, residual)
                    result.sigma_px[y, x] = np.sqrt(max(variance, residual) / texture) / gain
                    mean_own /= n
                    oo, od = 0.0, 0.0
                    for k in range(n):
                        o = own[k] - mean_own
                        oo += o * o
                        od += o * (derivatives[k] - mean_derivative)
                    result.correlation[y, x] = vf / np.sqrt(vv * ff)
                    result.slope_correlation[y, x] = od / np.sqrt(oo * dd) if oo > 0 else 0.0
                    break
                if not gain > 0:
                    break
                shift -= min(max(change / gain, -0.5), 0.5)
                if abs(shift - base) > MAX_SHIFT_PX:
                    break
