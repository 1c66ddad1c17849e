# SPDX-License-Identifier: Apache-2.0
"""Warnings about clouds that cannot be right, or results that cannot be what was wanted: one sentence each."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.inputs import CleanCloud
from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.spacing import median_spacing
from pcgraph.voxels.visibility import visible_fraction

_STEPS_PER_SPACING = 4.0  # of floating-point numbers: fewer, and points lie on a lattice of rounding
_MIN_SPACING = 1e-7  # of the extent
_MIN_SUPERVOXELS = 500  # of fewer, many objects are no surprise
_OBJECTS_PER_SUPERVOXEL = 0.1
_MIN_VOXELS = 200
_MANY_POINTS = 1000  # of fewer, one voxel may be wanted
_SOLID = 18.0  # voxels around one; on a surface some 6 to 13, on one as thick as voxels 17
_MIN_SEEN = 0.1  # of the voxels, from a viewpoint


class CloudWarning(UserWarning):
    """Something about a cloud, or about what became of it, that cannot be right."""


def warn_of_rounding(given: ArrayLike, cloud: CleanCloud, spacing: float | None) -> None:
    """Warn where float32 cannot tell neighbours apart, so far from the origin are they.

    Parameters
    ----------
    given : array
        Points as they came in.
    cloud : CleanCloud
        What is left of them.
    spacing : float, metres, optional
        If it is known; else it is read where it matters.
    """
    dtype = getattr(given, "dtype", None)
    if dtype is None or dtype.kind != "f" or dtype.itemsize > 4:
        return
    spacing = median_spacing(cloud.points) if spacing is None else spacing
    farthest = float(np.abs(cloud.bounds).max())
    step = float(np.spacing(np.asarray(farthest, dtype)))
    if _STEPS_PER_SPACING * step > spacing:
        _warn(
            f"expected coordinates finer than the spacing of points, but {dtype} comes in steps of {step:.2g} m at "
            f"{farthest:.4g} m, and points lie {spacing:.2g} m apart; subtract an offset before you make them {dtype}"
        )


def warn_of_duplicates(cloud: CleanCloud, spacing: float) -> None:
    """Warn where points lie so close together, for the extent of all, that they are likely to be copies."""
    low, high = cloud.bounds
    extent = float((high - low).max())
    if 0.0 < spacing < _MIN_SPACING * extent:
        _warn(
            f"expected points apart from each other, but most have another within {spacing:.2g} m in a cloud of "
            f"{extent:.3g} m, as copies of a scan do, or parts far off; leave copies out, or give voxel_size"
        )


def warn_of_size(name: str, given: float | None, cloud: CleanCloud) -> None:
    """Warn where a length given in metres is beyond the extent of a cloud of many points, as in another unit."""
    low, high = cloud.bounds
    extent = float((high - low).max())
    if given is not None and float(given) > extent > 0.0 and len(cloud.points) >= _MANY_POINTS:
        _warn(
            f"expected a {name} far below the extent of the cloud, got {float(given):.4g} m for {extent:.3g} m, so "
            "that next to nothing can be told apart; give it in the unit of the points"
        )


def warn_of_oversegmentation(n_objects: int, n_supervoxels: int, voxel_size: float) -> None:
    """Warn where the default cut leaves more objects than a tenth of the supervoxels."""
    if n_supervoxels >= _MIN_SUPERVOXELS and n_objects > _OBJECTS_PER_SUPERVOXEL * n_supervoxels:
        _warn(
            f"expected far fewer objects than supervoxels, got {n_objects} and {n_supervoxels}: voxels of "
            f"{voxel_size:.3g} m may be too small for the cloud; give voxel_size, or cut the tree at another altitude"
        )


def warn_of_volume(grid: VoxelGrid) -> None:
    """Warn where most voxels have others on nearly all sides, as noise that fills a volume has."""
    if grid.n_voxels >= _MIN_VOXELS and float(np.mean(np.diff(grid.indptr) > _SOLID)) > 0.5:
        _warn(
            "expected points on surfaces, but they fill a volume as noise does: at most voxels there are others on "
            f"nearly all sides ({grid.edge_lengths.mean():.3g} m); objects found in it may mean little"
        )


def warn_of_viewpoint(viewpoint: NDArray[np.float64], grid: VoxelGrid) -> None:
    """Warn where a viewpoint, (3,), sees nearly nothing, as from inside or under a surface."""
    if not (grid.centroids != viewpoint).any():
        return
    seen = visible_fraction(grid, viewpoint)
    if seen < _MIN_SEEN:
        _warn(
            f"expected a viewpoint that sees the cloud, but from {np.round(viewpoint, 3).tolist()} m only "
            f"{100.0 * seen:.0f} % of it is visible; it may lie inside or under a surface, or be of another frame"
        )


def _warn(sentence: str) -> None:
    warnings.warn(sentence, CloudWarning, stacklevel=4)  # where `segment` was called
