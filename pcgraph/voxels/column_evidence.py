# SPDX-License-Identifier: Apache-2.0
"""Evidence in columns, such as colours: whether touching voxels are alike, and whether values change at creases."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import kernel
from pcgraph.voxels.directions import CREASE_COSINE, SAME_SURFACE_COSINE
from pcgraph.voxels.grid import Neighbourhood, VoxelGrid

_SAMPLE = 1 << 13
"""Voxels at which the contrast is read, about; chosen by eye, for the time's sake."""
_ROUNDING = 1e-24
"""Ratio of variance to mean square below which values differ by rounding alone; chosen above double precision's."""
_PRIOR_PAIRS = 64
"""Pairs of voxels across creases: with so many, they count half; chosen by eye, not varied."""


def crease_contrast(values: NDArray[np.float64], grid: VoxelGrid, normals: NDArray[np.float64]) -> float:
    """Contrast of values at creases against that on smooth surfaces, 0..1.

    It is 0 for noise, for a pattern that does not depend on the shape below it, and for a constant. It is near 1 if
    each surface has a value of its own.

    Parameters
    ----------
    values : (v, d) float64
        Means over the points of each voxel of, say, colours, or one column of the features.
    grid : VoxelGrid of v voxels
    normals : (v, 3) float64
        Unit normals of the voxels.

    Notes
    -----
    It is 1 - S / C, or 0 if that is negative. S and C are mean squared differences of touching voxels: S of those whose
    normals are within 26 degrees, C of those whose normals are more than 60 degrees apart. A pair counts by
    m n / (m + n), where m and n are the points of its voxels, so that S and C of noise are both its variance. In case
    of few creases, 1 - S / A counts as 64 pairs do, where A is the same as S for any two voxels: that is the spatial
    autocorrelation of Geary 1954. Some 8000 evenly spaced voxels are read.
    """
    step = -(-grid.n_voxels // _SAMPLE)
    sums, pairs = np.zeros(2), np.zeros(2, np.int64)
    _add_squared_distances(values, grid.counts, normals, grid.neighbourhood, step, sums, pairs)
    some, counts = values[::step], grid.counts[::step]
    mean = np.average(some, axis=0, weights=counts)
    any_two = float((counts @ np.square(some - mean)).sum()) / len(some)
    if not pairs[0] or any_two <= _ROUNDING * float((counts @ np.square(some)).sum()) / len(some):
        return 0.0
    smooth, creased = sums / np.maximum(pairs, 1)
    at_creases, anywhere = (max(1.0 - smooth / other, 0.0) if other > 0.0 else 0.0 for other in (creased, any_two))
    return (pairs[1] * at_creases + _PRIOR_PAIRS * anywhere) / (pairs[1] + _PRIOR_PAIRS)


def color_evidence(grid: VoxelGrid, normals: NDArray[np.float64]) -> float:
    """`crease_contrast` of the voxels' colours; 0 if they have none."""
    return 0.0 if grid.colors is None else crease_contrast(grid.colors, grid, normals)


@kernel
def _add_squared_distances(
    values: NDArray[np.float64],
    counts: NDArray[np.int64],
    normals: NDArray[np.float64],
    around: Neighbourhood,
    step: int,
    sums: NDArray[np.float64],
    pairs: NDArray[np.int64],
) -> None:
    """Add weighted squared differences of touching voxels, and numbers of pairs, to (2,) each: smooth, at creases."""
    indptr, neighbours = around
    for i in range(0, len(values), step):
        for a in range(indptr[i], indptr[i + 1]):
            j, cosine, square = neighbours[a], 0.0, 0.0
            for axis in range(3):
                cosine += normals[i, axis] * normals[j, axis]
            if CREASE_COSINE <= cosine <= SAME_SURFACE_COSINE:
                continue
            for column in range(values.shape[1]):
                gap = values[i, column] - values[j, column]
                square += gap * gap
            kind = 0 if cosine > SAME_SURFACE_COSINE else 1
            sums[kind] += square * counts[i] * counts[j] / (counts[i] + counts[j])
            pairs[kind] += 1


def autocorrelation(values: NDArray[np.float64], grid: VoxelGrid) -> NDArray[np.float64]:
    """Spatial autocorrelation of each of d columns, (v, d), (d,) float64: 0 for noise, near 1 for a smooth field.

    Notes
    -----
    It is 1 - C, or 0 if that is negative. C is the mean squared difference of touching voxels over twice the variance
    of all (Geary 1954). It is 0 for a column that is the same everywhere.
    """
    squares = _sums_of_squares(values, values.mean(axis=0), grid.neighbourhood)
    pairs = max(len(grid.neighbours), 1)
    twice = 2.0 * squares[1] / max(grid.n_voxels - 1, 1)
    ratio = np.divide(squares[0] / pairs, twice, out=np.ones_like(twice), where=twice > 0.0)
    return np.maximum(1.0 - ratio, 0.0) if len(grid.neighbours) else np.zeros_like(twice)


@kernel
def _sums_of_squares(
    values: NDArray[np.float64], means: NDArray[np.float64], around: Neighbourhood
) -> NDArray[np.float64]:
    """Sums of squared differences of touching voxels, and of squared distances to the mean, (2, d)."""
    indptr, neighbours = around
    sums = np.zeros((2, values.shape[1]))
    for i in range(len(values)):
        for column in range(values.shape[1]):
            sums[1, column] += (values[i, column] - means[column]) ** 2
            for a in range(indptr[i], indptr[i + 1]):
                sums[0, column] += (values[i, column] - values[neighbours[a], column]) ** 2
    return sums
