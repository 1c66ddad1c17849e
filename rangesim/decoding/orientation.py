# SPDX-License-Identifier: Apache-2.0
"""Orientation of the map from camera pixels to projector pixels: it tells mirrored, turned and exchanged images."""

from __future__ import annotations

import numpy as np

from rangesim.decoding.pixel_samples import MIN_PIXELS
from rangesim.rig import Rig

STEPS_PER_IMAGE = 40
"""Number of steps along the shorter side of the image over which slopes are measured. A step of several pixels spans
several cells of a Gray code, whose coordinates are whole numbers. With fewer steps, fewer would stay on one surface."""

MAX_SLOPES = 200
"""Largest number of slopes along each side of the image, so that the time is bounded. Forty thousand slopes tell a
fraction to 0.3 %."""

MIN_AREA_PX2 = 4.0
"""Least area, in square projector pixels, of the image of a step by a step that counts. Whole coordinates are off by
half a pixel each, so the sign of a smaller area may be wrong."""

MIN_MIRRORED_FRACTION = 0.8
"""Least fraction of the areas that are turned over, at which the map counts as mirrored. Of a real camera, only depth
edges and noise turn areas over; a mirrored image turns over all but those."""

MIN_JUMP = 0.8
"""Least change over a step, as a fraction of the projector's size, that counts as a jump from one end to the other."""

MIN_JUMP_FRACTION = 0.005
"""Least fraction of the steps that jump, at which the ends of the projector count as meeting within the image. A line
across the image makes 0.02 (one step of 40 along the shorter side); noise at the true ends makes none, because there
is no light beyond them."""

MAX_TURN_DEG = 60.0
"""Largest angle in degrees between the direction in which a coordinate grows and the one that the calibration predicts.
A wrong image is turned by 90 or 180 degrees or mirrored. A surface that is tilted by 45 degrees changes the angle by 30
degrees at most where the baseline is half the distance."""


def orientation_contradiction(column: np.ndarray | None, row: np.ndarray | None, rig: Rig | None) -> str | None:
    """A sentence if the map from camera to projector pixels cannot be that of a camera as described; None if it can.

    Two devices that see a surface from the same side see it in the same orientation. So the determinant of the map's
    derivative is positive; in a mirrored image it is negative. If the rig is known, it predicts in which direction of
    the camera's image a coordinate grows.

    Parameters
    ----------
    column, row : (h, w) float32, projector pixels, NaN where not decoded; None for an axis that is not coded.
    rig : Rig that took the capture; None: not calibrated.
    """
    slopes = {name: _slopes(c) for name, c in (("columns", column), ("rows", row)) if c is not None}
    if len(slopes) == 2 and _is_turned_over(slopes["columns"], slopes["rows"]):
        if _along(slopes["columns"]) == "height" and _along(slopes["rows"]) == "width":
            return (
                "columns change along the image's height and rows along its width: rows may have been shown first, or "
                "the images are turned and mirrored."
            )
        return (
            "the camera's images seem to be mirrored: where the projector shows an L, the camera sees its mirror "
            "image. Check that no image is mirrored, and that the frames of columns and rows are not exchanged."
        )
    if rig is None:
        return None
    for axis, seen in slopes.items():
        turn = _turn_deg(seen, _predicted(rig, axis, next(c for c in (column, row) if c is not None).shape))
        if turn is None or turn <= MAX_TURN_DEG:
            continue
        other = "rows" if axis == "columns" else "columns"
        cause = (
            "that no image is mirrored or turned by 180 degrees"
            if turn > 180 - MAX_TURN_DEG
            else f"that no image is turned by 90 degrees, and that {axis} were shown, not {other}"
        )
        return (
            f"{axis} grow in another direction of the image than the calibration predicts, at an angle of {turn:.0f} "
            f"degrees to it: check {cause}."
        )
    return None


def fringe_doubt(column: np.ndarray | None, row: np.ndarray | None, size: tuple[int, int]) -> str | None:
    """A clause if coordinates that fringes alone tell seem to be mirrored or to start elsewhere; None if not.

    An upright camera sees columns grow to the right and rows downwards. On a surface in view, neighbours do not see
    opposite ends of the projector.

    Parameters
    ----------
    column, row : (h, w) float32, projector pixels, NaN where not decoded; None for an axis that is not coded.
    size : (width, height) of the projector in pixels.
    """
    axes = [
        (name, _slopes(c), n)
        for name, c, n in zip(("columns", "rows"), (column, row), size, strict=True)
        if c is not None
    ]
    for name, slopes, n in axes:
        known = np.abs(slopes[:, np.isfinite(slopes).all(axis=0)])
        if known.size and (known > MIN_JUMP * n).any(axis=0).mean() > MIN_JUMP_FRACTION:
            return (
                f"{name} jump from one end of the projector to the other within the image: the fringes start "
                "elsewhere, give another --set start, or they are shorter than the projector"
            )
    if not all(_grows_backwards(slopes, 0 if name == "columns" else 1) for name, slopes, _ in axes):
        return None
    ways = " and ".join("columns grow to the left" if name == "columns" else "rows grow upwards" for name, _, _ in axes)
    return (
        f"{ways}: the fringes move the other way, give --set direction=backward or forward, unless the camera stood "
        "upside down; fringes alone do not tell"
    )


def _grows_backwards(slopes: np.ndarray, side: int) -> bool:
    """Whether a coordinate with these slopes (2, n, m) decreases across (side 0) or down (side 1) the image."""
    return _along(slopes) == ("width", "height")[side] and float(np.nanmedian(slopes[side])) < 0


def is_mirrored(column: np.ndarray, row: np.ndarray) -> bool:
    """Whether the map from camera pixels to projector pixels turns nearly all areas over.

    Parameters
    ----------
    column, row : (h, w) float32, projector pixels, NaN where not decoded.
    """
    return _is_turned_over(_slopes(column), _slopes(row))


def changes_along(coordinate: np.ndarray) -> str | None:
    """Side of the image along which a coordinate changes twice as much as along the other; None if there is none.

    Parameters
    ----------
    coordinate : (h, w) float32, projector pixels, NaN where not decoded.
    """
    return _along(_slopes(coordinate))


def _slopes(coordinate: np.ndarray) -> np.ndarray:
    """(2, n, m) changes of a coordinate over a step across and a step down the image, at the same n x m places."""
    high, wide = coordinate.shape
    step = max(1, min(high, wide) // STEPS_PER_IMAGE)
    if min(high, wide) <= step:
        return np.zeros((2, 0, 0))
    here = coordinate[:-step, :-step]
    across, down = coordinate[:-step, step:] - here, coordinate[step:, :-step] - here
    strides = tuple(slice(None, None, 1 + size // MAX_SLOPES) for size in here.shape)
    return np.stack([across[strides], down[strides]])


def _is_turned_over(column: np.ndarray, row: np.ndarray) -> bool:
    """Whether nearly all areas are turned over, by the slopes (2, n, m) of both axes."""
    area = column[0] * row[1] - column[1] * row[0]
    clear = np.abs(area) >= MIN_AREA_PX2  # False for NaN
    n = np.count_nonzero(clear)
    return bool(n >= MIN_PIXELS and np.count_nonzero(clear & (area < 0)) > MIN_MIRRORED_FRACTION * n)


def _along(slopes: np.ndarray) -> str | None:
    """Side of the image along which slopes (2, n, m) are twice as steep, "width" or "height"; None if neither is."""
    known = np.abs(slopes[:, np.isfinite(slopes).all(axis=0)])
    if known.shape[1] < MIN_PIXELS:
        return None
    across, down = np.median(known, axis=1)
    return "height" if down > 2 * across else "width" if across > 2 * down else None


def _predicted(rig: Rig, axis: str, shape: tuple[int, ...]) -> np.ndarray:
    """(2, n, m) slopes of a coordinate as the rig predicts them for what is far away, at the places of `_slopes`."""
    y, x = (np.linspace(0.5, size - 0.5, 40) for size in shape)
    directions = rig.pinhole.directions(np.stack(np.meshgrid(x, y), axis=-1)) @ rig.T_camera_projector[:3, :3]
    with np.errstate(invalid="ignore", divide="ignore"):
        place = rig.image_projector.project(directions)[..., 0 if axis == "columns" else 1]
    place = np.where(directions[..., 2] > 0, place, np.nan)
    return np.stack([np.diff(place, axis=1)[:-1] / (x[1] - x[0]), np.diff(place, axis=0)[:, :-1] / (y[1] - y[0])])


def _turn_deg(seen: np.ndarray, predicted: np.ndarray) -> float | None:
    """Angle in degrees between the median slopes (2, n, m) and (2, k, l); None if too few are known."""
    vectors = []
    for slopes in (seen, predicted):
        known = slopes[:, np.isfinite(slopes).all(axis=0)]
        if known.shape[1] < MIN_PIXELS:
            return None
        vectors.append(np.median(known, axis=1))
    (x, y), (p, q) = vectors
    if not (np.hypot(x, y) > 0 and np.hypot(p, q) > 0):
        return None
    return float(np.rad2deg(np.abs(np.arctan2(x * q - y * p, x * p + y * q))))
