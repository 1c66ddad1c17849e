# SPDX-License-Identifier: Apache-2.0
"""Warnings, one sentence each, about clouds that cannot be right, or results that can hardly be wanted."""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass
from types import FrameType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.inputs import CleanCloud
from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.spacing import median_spacing
from pcgraph.voxels.visibility import visible_fraction


@dataclass(frozen=True)
class WarningThresholds:
    """Conditions for warnings. Chosen by eye; none was varied."""

    steps_per_spacing: float = 4.0  # steps of float32 per spacing: with fewer, points lie on a lattice of rounding
    min_spacing: float = 1e-7  # of the extent: a lesser spacing is that of copies
    min_supervoxels: int = 500  # of fewer supervoxels many objects are no surprise
    objects_per_supervoxel: float = 0.1  # objects over supervoxels: with more, voxels are too small for the cloud
    min_voxels: int = 200  # a cloud of fewer voxels is not asked whether it fills a volume
    max_around: float = 18.0  # voxels around one: on a surface some 6 to 13, on one as thick as a voxel 17
    min_points: int = 1000  # of fewer points one voxel may be wanted
    min_seen: float = 0.1  # fraction of the voxels that a viewpoint sees
    max_gone: float = 0.75  # fraction of earlier voxels in sight that are gone: 0 to 0.14 in one frame
    min_in_sight: float = 0.25  # voxels in sight over those of the new scan: or a pose just off counts
    min_voxels_in_sight: int = 1000  # count; the same


_WARN = WarningThresholds()


class CloudWarning(UserWarning):
    """A warning that something about a cloud, or about its segmentation, cannot be right."""


def warn_of_rounding(given: ArrayLike, cloud: CleanCloud, spacing: float | None) -> None:
    """Warn if points lie so far from the origin that float32 cannot tell neighbours apart.

    Parameters
    ----------
    given : array
        Points as the caller gave them.
    cloud : CleanCloud
        The finite ones among them.
    spacing : float, metres, optional
        Spacing of the points. Default: it is read if it matters.
    """
    dtype = getattr(given, "dtype", None)
    if dtype is None or dtype.kind != "f" or dtype.itemsize > 4:
        return
    spacing = median_spacing(cloud.points) if spacing is None else spacing
    farthest = float(np.abs(cloud.bounds).max())
    step = float(np.spacing(np.asarray(farthest, dtype)))
    if _WARN.steps_per_spacing * step > spacing:
        _warn(
            f"expected coordinates finer than the spacing of points, but {dtype} comes in steps of {step:.2g} m at "
            f"{farthest:.4g} m, and points lie {spacing:.2g} m apart; subtract an offset before you make them {dtype}"
        )


def warn_of_duplicates(cloud: CleanCloud, spacing: float) -> None:
    """Warn if points lie so near to each other, against the extent of the cloud, that they are likely to be copies."""
    low, high = cloud.bounds
    extent = float((high - low).max())
    if 0.0 < spacing < _WARN.min_spacing * extent:
        _warn(
            f"expected points apart from each other, but most have another within {spacing:.2g} m in a cloud of "
            f"{extent:.3g} m, as copies of a scan do, or parts far off; leave copies out, or give voxel_size"
        )


def warn_of_size(name: str, given: float | None, cloud: CleanCloud) -> None:
    """Warn if a given length exceeds the extent of a cloud of many points, as a length in another unit does."""
    low, high = cloud.bounds
    extent = float((high - low).max())
    if given is not None and float(given) > extent > 0.0 and len(cloud.points) >= _WARN.min_points:
        _warn(
            f"expected a {name} far below the extent of the cloud, got {float(given):.4g} m for {extent:.3g} m, so "
            "that next to nothing can be told apart; give it in the unit of the points"
        )


def warn_of_oversegmentation(n_objects: int, n_supervoxels: int, voxel_size: float) -> None:
    """Warn if the default cut gives more objects than a tenth of the supervoxels."""
    if n_supervoxels >= _WARN.min_supervoxels and n_objects > _WARN.objects_per_supervoxel * n_supervoxels:
        _warn(
            f"expected far fewer objects than supervoxels, got {n_objects} and {n_supervoxels}: voxels of "
            f"{voxel_size:.3g} m may be too small for the cloud; give voxel_size, or cut the tree at another altitude"
        )


def warn_of_volume(grid: VoxelGrid) -> None:
    """Warn if most voxels have others on nearly all sides, as in noise that fills a volume."""
    if grid.n_voxels >= _WARN.min_voxels and float(np.mean(np.diff(grid.indptr) > _WARN.max_around)) > 0.5:
        _warn(
            "expected points on surfaces, but they fill a volume as noise does: at most voxels there are others on "
            f"nearly all sides ({grid.edge_lengths.mean():.3g} m); objects found in it may mean little"
        )


def warn_of_viewpoint(viewpoint: NDArray[np.float64], grid: VoxelGrid) -> None:
    """Warn if a viewpoint, (3,), sees nearly nothing, as from inside or under a surface."""
    if not (grid.centroids != viewpoint).any():
        return
    seen = visible_fraction(grid, viewpoint)
    if seen < _WARN.min_seen:
        _warn(
            f"expected a viewpoint that sees the cloud, but from {np.round(viewpoint, 3).tolist()} m only "
            f"{100.0 * seen:.0f} % of it is visible; it may lie inside or under a surface, or be of another frame"
        )


def warn_of_frame(n_gone: int, n_there: int, n_new: int) -> None:
    """Warn if most of what a new scan should see of the earlier ones is not there, as in another frame.

    Parameters
    ----------
    n_gone, n_there : int
        Voxels of the earlier scans which the new scan sees through, and in which it has points.
    n_new : int
        Voxels of the new scan.
    """
    in_sight = n_gone + n_there
    is_enough = in_sight >= max(_WARN.min_in_sight * n_new, _WARN.min_voxels_in_sight)
    if is_enough and n_gone > _WARN.max_gone * in_sight:
        _warn(
            f"expected a scan that meets what earlier scans met, but it sees through {100.0 * n_gone / in_sight:.0f} % "
            "of the voxels in its sight; are its points and its viewpoint in the frame of the first scan?"
        )


def _warn(sentence: str) -> None:
    """Warn with a sentence, as of the line outside this package from which the call came."""
    frame: FrameType | None = sys._getframe()
    level = 1
    while frame is not None and frame.f_globals["__name__"].startswith("pcgraph."):
        frame, level = frame.f_back, level + 1
    warnings.warn(sentence, CloudWarning, stacklevel=level)
