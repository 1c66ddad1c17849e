# SPDX-License-Identifier: Apache-2.0
"""Decoding of any stack of patterns by zero-mean normalised cross-correlation (ZNCC).

A camera pixel has one value per frame, and so has each column of the patterns. The pixel sees the column whose values
are most like its own, apart from a gain (albedo) and an offset (ambient light).
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.bits import CELL_SIGMA
from rangesim.codes.thresholds import GrayThresholds
from rangesim.decoding.pixel_samples import MIN_PIXELS
from rangesim.decoding.status import Status

if TYPE_CHECKING:
    from rangesim.codes.zncc_kernels import Columns, Matches

BLOCK_BYTES = 16 << 20
"""Bytes of the correlations of a block of pixels with all columns. They then stay in the processor's cache, and the
memory that decoding takes does not depend on the size of the image."""

SAME_VALUE = 1e-6
"""Largest difference of two values of patterns, 0 to 1, that are shown alike. It allows for rounding of float32."""

MAX_UNEXPLAINED = 1e-3
"""Largest fraction of the variance, on median or on average over the pixels, that the columns may leave unexplained
before causes are tried. Rounding to 8 bits leaves 1e-5."""

MIN_WRONG = 0.5
"""Least such fraction, beside that of the noise, at which the patterns count as wrong altogether, although no single
fault explains it."""

MAX_MENDED_RATIO = 0.5
"""Largest ratio of the unexplained variance with a fault undone to that without, at which the fault is named. Undoing
a fault that is there leaves the noise alone."""

TINY_GAIN = 1e-20
"""Gain that replaces zero where something is divided by it, in units of the frames: far below any gain, and its square
is still a float64."""

GAMMAS = np.arange(1.2, 3.01, 0.2)
"""Exponents of projectors that are tried. Those of video are about 2.2."""

SAMPLES = 400
"""Number of pixels on which faults are tried. Their fractions then have a standard error of 2.5 % at most."""

SUSPECTS = 12
"""Number of frames, those that fit worst, of which two may have been exchanged. The 66 pairs take about a second."""


class CorrelatedCode(NamedTuple):
    """Places along one axis that correlation found, and how clearly.

    code : AxisCode. distance : (h, w) float32, 0 to 1, correlation with the best place minus that with the best one
        that is no neighbour of it.
    """

    code: AxisCode
    distance: np.ndarray


def decode_by_correlation(seen: AxisFrames, patterns: np.ndarray, thresholds: GrayThresholds) -> CorrelatedCode:
    """Projector coordinates at which the patterns correlate best with the values of each pixel.

    Between two columns the patterns are interpolated linearly. A camera pixel that is as wide as a pixel of the
    projector sees them like this. The place is then a linear least-squares problem of two unknowns. White and black
    count as two more patterns if they were captured.

    A pixel is refused if it lies nearer to the middle between its column and another one than the thresholds allow
    (`LOW_SIGNAL` if noise may have moved it there, `CODE_ERROR` if not). It is also refused (`CODE_ERROR`) if it lies
    farther from its column than half the way to the other one, beside the noise: then it may see several places. The
    thresholds of Gray bits apply: of a pattern and its inverse, |pattern - inverse| is sqrt(2) times the distance from
    the middle between the two values of the bit.

    Parameters
    ----------
    seen : frames (n, h, w). patterns : (n, size) float, the patterns of these frames.

    References
    ----------
    Mirdehghan, Chen, Kutulakos: "Optimal structured light a la carte", CVPR (2018): ZNCC with their columns as
    patterns is the maximum-likelihood decoder for equal noise in all frames.
    """
    frames, shown = _with_white_and_black(seen, patterns)
    columns = columns_of(shown.tobytes(), *shown.shape)
    capture, shape = seen.capture, seen.contrast.values.shape
    found = match(frames.reshape(len(frames), -1), columns)
    explained = found.correlation**2
    sigma = capture.noise(frames.mean(axis=0, dtype=np.float32))
    sigma = None if sigma is None else sigma.ravel()
    with np.errstate(invalid="ignore", divide="ignore"):
        difference = found.length**2 * (explained - found.second**2)
        from_middle = np.where(found.apart > 0, difference / (2 * found.apart), 0.0)
    from_middle = np.where(found.second > 0, from_middle, np.inf)
    least: np.ndarray | float = 0.0
    if sigma is not None:
        least = thresholds.bit_sigmas * sigma
    elif capture.is_digital:
        least = thresholds.bit_of_scale * capture.full_scale / np.sqrt(2)
    noise = least / max(thresholds.bit_sigmas, 1.0)
    left = max(len(frames) - 2, 1)  # gain and offset are fitted
    of_noise = (left + thresholds.bit_sigmas * np.sqrt(2 * left)) * noise**2
    is_ambiguous = ~(from_middle > 0.5 * thresholds.relative_bit * found.apart)
    is_ambiguous |= ~(found.length**2 * (1 - explained) <= 0.25 * found.apart**2 + of_noise)
    status = np.zeros(explained.shape, dtype=np.uint8)
    status[is_ambiguous] = Status.CODE_ERROR
    status[from_middle < least] = Status.LOW_SIGNAL
    status[~seen.contrast.is_enough.ravel()] = Status.LOW_SIGNAL
    is_binary = bool(np.isin(shown, (0, 1)).all())
    clipped = capture.saturated(frames).ravel()
    status[clipped if not is_binary else clipped & (status != Status.OK)] = Status.SATURATED
    width = np.diff(columns.edges)
    cell_px = float(width.max())
    sigma_px = None
    if is_binary:
        sigma_px = np.asarray(CELL_SIGMA * width[found.cell], dtype=np.float32)
    elif sigma is not None:
        sigma_px = (sigma / np.maximum(found.gain * found.turn, 1e-12)).astype(np.float32)
        sigma_px = np.where(width[found.cell] > 1, np.float32(CELL_SIGMA) * width[found.cell], sigma_px)
        sigma_px = sigma_px.astype(np.float32)
    code = AxisCode(
        _coordinates(found, columns).reshape(shape),
        status.reshape(shape),
        cell_px,
        None if sigma_px is None else sigma_px.reshape(shape),
    )
    return CorrelatedCode(code, (found.correlation - found.second).reshape(shape))


def check_columns(patterns: np.ndarray, has_white_and_black: bool) -> None:
    """Raise ValueError if patterns (n, size), with or without white and black, do not tell all places apart."""
    shown = _and_white_and_black(patterns) if has_white_and_black else np.ascontiguousarray(patterns, dtype=np.float32)
    columns_of(shown.tobytes(), *shown.shape)


def match(frames: np.ndarray, columns: Columns) -> Matches:
    """The best matches of m pixels.

    Parameters
    ----------
    frames : (K, m) of any number type. columns : of the K patterns.
    """
    from pcgraph.parallel import in_blocks
    from rangesim.codes.zncc_kernels import Matches, match_best, match_second

    pixels, n = frames.shape[1], len(columns.vectors)
    matches = Matches(np.zeros(pixels, np.int64), *(np.zeros(pixels, np.float32) for _ in range(7)))
    directions = np.ascontiguousarray(columns.directions.T, dtype=np.float32)
    block = max(1, BLOCK_BYTES // (4 * n))

    def run(start: int, stop: int) -> None:
        for first in range(start, stop, block):
            part = slice(first, min(first + block, stop))
            values = np.ascontiguousarray(frames[:, part].T, dtype=np.float32)
            values -= values.mean(axis=1, keepdims=True, dtype=np.float64).astype(np.float32)
            values = np.nan_to_num(values, copy=False, nan=0.0)
            scores = values @ directions
            own = Matches(*(a[part] for a in matches))
            match_best(scores, scores.argmax(axis=1), values, columns, own)
            match_second(scores, scores.argmax(axis=1), columns, own)

    in_blocks(run, pixels, smallest=block)
    return matches


@lru_cache(maxsize=8)  # a decoder is asked for the same patterns again and again
def columns_of(patterns: bytes, n_frames: int, size: int) -> Columns:
    """Columns of the bytes of patterns (n_frames, size) float32.

    Raises
    ------
    ValueError
        Two places look alike, or a place looks the same in all frames.
    """
    from pcgraph.parallel import in_blocks
    from rangesim.codes.zncc_kernels import Columns, find_lobes

    values = np.frombuffer(patterns, dtype=np.float32).reshape(n_frames, size).astype(np.float64).T
    changes = np.flatnonzero(np.abs(np.diff(values, axis=0)).max(axis=1) > SAME_VALUE) + 1
    starts = np.concatenate([[0], changes])
    vectors = values[starts] - values[starts].mean(axis=1, keepdims=True)
    length = np.linalg.norm(vectors, axis=1)
    if (length <= SAME_VALUE).any():
        place = starts[np.argmin(length)]
        raise ValueError(f"expected patterns that change from frame to frame, got the same value at pixel {place}.")
    directions = vectors / length[:, None]
    rounded = np.rint(directions / SAME_VALUE)
    order = np.lexsort(rounded.T)
    alike = (rounded[order[1:]] == rounded[order[:-1]]).all(axis=1) & (np.abs(np.diff(order)) > 1)
    if alike.any():
        first, second = sorted(starts[order[np.argmax(alike) : np.argmax(alike) + 2]])
        raise ValueError(
            f"expected patterns that tell all pixels from each other, got pixels {first} and {second} that look alike "
            "up to gain and offset."
        )
    lobes = np.empty((len(vectors), 2), dtype=np.int64)
    in_blocks(find_lobes, len(vectors), directions, lobes)
    first, second = vectors[:-1], vectors[1:]
    products = np.stack([(first * first).sum(1), (first * second).sum(1), (second * second).sum(1)], axis=1)
    return Columns(vectors, directions, lobes, products, np.concatenate([starts, [size]]).astype(np.float64))


def _with_white_and_black(seen: AxisFrames, patterns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames (k, h, w) and their patterns (k, size) float32, with white and black where they were captured."""
    if not seen.contrast.is_measured:
        return seen.frames, np.ascontiguousarray(patterns, dtype=np.float32)
    more = np.stack([seen.contrast.white, seen.contrast.black])
    return np.concatenate([seen.frames, more]), _and_white_and_black(patterns)


def _worst_frames(values: np.ndarray, patterns: np.ndarray) -> np.ndarray:
    """Indices of the frames that differ most from the best column at the best gain, on average over the pixels.

    Parameters
    ----------
    values : (K, m), pixels. patterns : (K, size) float32.
    """
    columns = columns_of(patterns.tobytes(), *patterns.shape)
    found = match(values, columns)
    fitted = found.gain[:, None] * columns.vectors[found.cell]
    off = values.T - values.mean(axis=0)[:, None] - fitted
    relative = (off / np.maximum(found.gain[:, None], TINY_GAIN)) ** 2
    return np.argsort(np.minimum(relative, 1).mean(axis=0))[-SUSPECTS:]


def _and_white_and_black(patterns: np.ndarray) -> np.ndarray:
    """(n + 2, size) float32, the patterns (n, size), then white and black."""
    constant = np.broadcast_to(np.array([[1.0], [0.0]], dtype=np.float32), (2, patterns.shape[1]))
    return np.concatenate([np.asarray(patterns, dtype=np.float32), constant])


def _coordinates(found: Matches, columns: Columns) -> np.ndarray:
    """(m,) float32, projector pixels.

    Between two cells of one pixel each, the place is a fraction of a pixel. In a wider cell it is the middle, or the
    edge of the cell where the pixel sees a quarter or more of its neighbour.
    """
    edges = columns.edges
    centre, width = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    after = np.minimum(found.cell + 1, len(centre) - 1)
    fine = (width[found.cell] == 1) & (width[after] == 1)
    coarse = np.where(found.fraction < 0.25, centre[found.cell], edges[found.cell + 1])
    coarse = np.where(found.fraction > 0.75, centre[after], coarse)
    return np.where(fine, centre[found.cell] + found.fraction, coarse).astype(np.float32)


def correlation_contradiction(seen: AxisFrames, patterns: np.ndarray) -> str | None:
    """A sentence if no column explains the values of most pixels; None if the columns do, or if the noise hides it.

    The unexplained variance is compared with that after undoing a fault: two frames exchanged, or a gamma. A fault is
    named if undoing it leaves less than half.

    Parameters
    ----------
    seen, patterns : as for `decode_by_correlation`.
    """
    frames, shown = _with_white_and_black(seen, patterns)
    clear = np.flatnonzero(seen.contrast.is_enough & ~seen.capture.saturated(frames))
    if len(clear) < MIN_PIXELS:
        return None
    used = clear[np.linspace(0, len(clear) - 1, SAMPLES).astype(int)]
    values = frames.reshape(len(frames), -1)[:, used].astype(np.float32)

    def unexplained(of: np.ndarray, by: np.ndarray) -> np.ndarray:
        """(2,), median and mean over the pixels: faults show at all pixels, or at those that see two frames."""
        try:
            columns = columns_of(np.ascontiguousarray(by, dtype=np.float32).tobytes(), *by.shape)
        except ValueError:
            return np.ones(2)
        left = 1 - match(of, columns).correlation ** 2
        return np.array([np.median(left), np.mean(left)], dtype=np.float64)

    left = unexplained(values, shown)
    if left.max() <= MAX_UNEXPLAINED:
        return None
    counts = np.maximum(left, MAX_UNEXPLAINED)
    names = [*(seen.shown_name(name) for name in seen.names), "white", "black"][: len(frames)]
    text = (
        f"the frames along {seen.axis} contradict their patterns: no column explains {100 * left[1]:.1g} % of the "
        "variance of a pixel over the frames"
    )
    faults: list[tuple[np.ndarray, str]] = []
    suspects = np.sort(_worst_frames(values, shown))
    for n, i in enumerate(suspects):
        for j in suspects[:n]:
            order = np.arange(len(values))
            order[[i, j]] = j, i
            faults.append((unexplained(values[order], shown), f"frames {names[j]} and {names[i]} seem to be exchanged"))
    for gamma in GAMMAS:
        faults.append(
            (
                unexplained(values, shown ** np.float32(gamma)),
                f"a gamma of about {gamma:.1f} explains it: make projector and camera linear",
            )
        )
    ratio, fault = min((float((remains / counts).min()), fault) for remains, fault in faults)
    if ratio < MAX_MENDED_RATIO:
        return f"{text}; {fault}."
    sigma = seen.capture.noise(values.mean(axis=0))
    variance = values.var(axis=0, dtype=np.float64)
    noise = 0.0 if sigma is None else float(np.median(sigma**2 / np.maximum(variance, 1e-30)))
    if left[0] - noise > MIN_WRONG:
        return f"{text}: check that these are the patterns that were shown, in this order."
    return None
