# SPDX-License-Identifier: Apache-2.0
"""What columns say: whether touching voxels are alike in them, and whether they change where surfaces do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import kernel
from pcgraph.voxels.grid import Neighbourhood, VoxelGrid

_SMOOTH, _CREASED = 0.9, 0.5  # cosines between normals, more than and less than
_TELLING = 1 << 13  # voxels, about
_ROUNDING = 1e-24  # of squares
_DOUBT = 64  # pairs across creases that count as much as what is known without any


def crease_contrast(values: NDArray[np.float64], grid: VoxelGrid, normals: NDArray[np.float64]) -> float:
    """How much more something changes at creases than on smooth surfaces, 0..1.

    0 for noise, for a pattern that does not care for the shape below, and for what is the same everywhere; near 1 where
    each surface has a value of its own.

    Parameters
    ----------
    values : (v, d) float64
        Such as colours, or one column of the features: means over the points of each voxel.
    grid : VoxelGrid of v voxels
    normals : (v, 3) float64
        Unit normals of the voxels.

    Notes
    -----
    1 - S / C, no less than 0, with mean squared distances between the values of touching voxels: S of those whose
    normals are within 26 degrees, C of those whose normals are 60 degrees and more apart. Each counts by m n / (m + n),
    m and n being the voxels' points, so that S and C of noise are alike, its variance. With few creases, as much as 64
    pairs of voxels count whether S is small against any two voxels (1 - S / C with their distances is the spatial
    autocorrelation of Geary 1954). Every so many voxels tell, some 8000.
    """
    step = -(-grid.n_voxels // _TELLING)
    sums, pairs = np.zeros(2), np.zeros(2, np.int64)
    _add_squared_distances(values, grid.counts, normals, grid.neighbourhood, step, sums, pairs)
    some, counts = values[::step], grid.counts[::step]
    mean = np.average(some, axis=0, weights=counts)
    any_two = float((counts @ np.square(some - mean)).sum()) / len(some)
    if not pairs[0] or any_two <= _ROUNDING * float((counts @ np.square(some)).sum()) / len(some):
        return 0.0
    smooth, creased = sums / np.maximum(pairs, 1)
    at_creases, anywhere = (max(1.0 - smooth / other, 0.0) if other > 0.0 else 0.0 for other in (creased, any_two))
    return (pairs[1] * at_creases + _DOUBT * anywhere) / (pairs[1] + _DOUBT)


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
    """Add the weighted squared distances of touching voxels, and their numbers, on smooth surfaces and at creases."""
    indptr, neighbours = around
    for i in range(0, len(values), step):
        for a in range(indptr[i], indptr[i + 1]):
            j, cosine, square = neighbours[a], 0.0, 0.0
            for axis in range(3):
                cosine += normals[i, axis] * normals[j, axis]
            if _CREASED <= cosine <= _SMOOTH:
                continue
            for column in range(values.shape[1]):
                gap = values[i, column] - values[j, column]
                square += gap * gap
            kind = 0 if cosine > _SMOOTH else 1
            sums[kind] += square * counts[i] * counts[j] / (counts[i] + counts[j])
            pairs[kind] += 1


def autocorrelation(values: NDArray[np.float64], grid: VoxelGrid) -> NDArray[np.float64]:
    """How alike touching voxels are in each of d columns, (v, d), (d,) float64: 0 for noise, near 1 for a smooth field.

    Notes
    -----
    1 - C, no less than 0, where C is the mean square difference of touching voxels over twice the variance of all
    (Geary 1954); 0 where all are equal.
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
