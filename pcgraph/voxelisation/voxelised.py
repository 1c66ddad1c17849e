# SPDX-License-Identifier: Apache-2.0
"""A cloud in voxels: their size by the spacing of points and the surfaces, and no noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.acquisition.depth_image import DepthImage
from pcgraph.acquisition.kinds import Acquisition
from pcgraph.inputs import CleanCloud, positive
from pcgraph.voxelisation.adapted_size import adapted_grading, adapted_voxel_size, voxel_size_for
from pcgraph.voxels.grid import VoxelGrid, grid_without, voxel_grid, with_means
from pcgraph.voxels.outliers import detached_voxels, far_from, fill_the_volume, is_full_of_noise, outlier_voxels
from pcgraph.voxels.spacing import VOXELS_PER_SPACING, median_spacing
from pcgraph.voxels.warp import Warp

_SIZES_PER_OCTAVE = 16
"""Count of default voxel sizes per octave of the cloud's extent, so that a few points more or less change no voxel. Its
effect on the scores is noise (docs/pcgraph_experiments.md)."""
_GRID_OFFSET = 0.382
"""Distance, in voxel edges, from the grid's origin to the lowest corner of the cloud. It is no simple fraction, so that
points on a lattice, and walls a whole number of voxels apart, are not on a border between cells. 0.618 is as good."""
_FEW_OUTLIERS = 0.95
"""Fraction of the points left from which on scale and acquisition are not estimated again: chosen by eye."""
_NOISY = 0.9
"""Fraction of the points left up to which outliers are also sought in voxels half as large. At 10 % of noise that costs
marinas 0.04 of covering, so that it is not done for less."""


class Sizes(NamedTuple):
    """Lengths that the caller gave, checked.

    Attributes
    ----------
    voxel : float, metres, or None
        Edge of a voxel.
    seed : float, metres, or None
        Spacing of supervoxels.
    n_supervoxels : int, or None
        Number of supervoxels, in place of their spacing.
    """

    voxel: float | None
    seed: float | None
    n_supervoxels: int | None

    @classmethod
    def of(cls, voxel: float | None, seed: float | None, n_supervoxels: int | None) -> Sizes:
        """Sizes, checked.

        Raises
        ------
        ValueError
            One is not a positive length, or seeds lie closer together than voxels are large.
        """
        voxel = None if voxel is None else positive("voxel_size", voxel)
        seed = None if seed is None else positive("seed_size", seed)
        if voxel is not None and seed is not None and seed < voxel:
            raise ValueError(f"expected seed_size of at least voxel_size, got {seed:g} m < {voxel:g} m")
        return cls(voxel, seed, n_supervoxels)


@dataclass(frozen=True, eq=False)
class Voxelised:
    """A cloud of n points, and the voxels in which they lie."""

    cloud: CleanCloud
    grid: VoxelGrid

    @classmethod
    def of(cls, cloud: CleanCloud, size: float, warp: Warp) -> Voxelised:
        """A cloud in voxels of a size, metres."""
        return cls(cloud, voxel_grid(cloud.points, size, warp))

    def without(self, voxels: NDArray[np.bool_]) -> Voxelised:
        """The same without some voxels, (v,) bool, and without the points in them."""
        if not voxels.any():
            return self
        return Voxelised(self.cloud.without(voxels[self.grid.voxel_of_point]), grid_without(self.grid, voxels))

    def resized(self, size: float) -> Voxelised:
        """The same in voxels of another size, metres."""
        return Voxelised.of(self.cloud, size, _from_corner(self.grid.warp, self.cloud, size))

    def with_means(self) -> Voxelised:
        """The same with mean colours and features of the voxels."""
        return Voxelised(self.cloud, with_means(self.grid, self.cloud.colors, self.cloud.features))


class Voxelisation(NamedTuple):
    """A cloud in voxels, and the numbers by which they were chosen.

    Attributes
    ----------
    voxelised : Voxelised
        Without noise.
    acquisition : Acquisition
    spacing : float, metres, or None
        Spacing of the points by which voxels were chosen; None if their size was given.
    orienting_size : float, metres
        Edge of the voxels that decide which side is outside, where those of `voxelised` are smaller.
    """

    voxelised: Voxelised
    acquisition: Acquisition
    spacing: float | None
    orienting_size: float


def voxelise(cloud: CleanCloud, assumed: Acquisition, sizes: Sizes) -> Voxelisation:
    """The cloud in voxels as large as its spacing and its surfaces ask for, without noise, and its acquisition.

    Parameters
    ----------
    cloud : CleanCloud of n points
    assumed : Acquisition
        Acquisition that caller and pixels tell, before the spacing is read.
    sizes : Sizes
    """
    found, acquisition, noise = _without_noise(cloud, assumed, sizes)
    spacing, orienting_size = None, found.grid.size
    if sizes.voxel is None:
        spacing = found.grid.size / VOXELS_PER_SPACING
        may_grade = sizes.seed is None and assumed.told.growth is None
        found, orienting_size = _adapted(found, acquisition, noise, sizes, may_grade)
    found = found.without(detached_voxels(found.grid))
    if sizes.n_supervoxels is not None and sizes.voxel is None and found.grid.levels is None:
        size = voxel_size_for(sizes.n_supervoxels, found.cloud.points, found.grid)
        found = found if size == found.grid.size else found.resized(size)
    found = found.with_means()
    return Voxelisation(found, acquisition.confirmed(found.grid).without_image(), spacing, orienting_size)


def voxelise_beside(cloud: CleanCloud, earlier: VoxelGrid) -> Voxelised:
    """A later scan in the voxels of earlier ones, without noise. What lies near earlier voxels is no noise."""
    found = Voxelised.of(cloud, earlier.size, earlier.warp)
    found = found.without(far_from(earlier, found.grid, outlier_voxels(found.grid)))
    if earlier.grading is not None:
        grid = voxel_grid(found.cloud.points, earlier.size, earlier.warp, earlier.grading)
        found = Voxelised(found.cloud, grid)
    return found.without(far_from(earlier, found.grid, detached_voxels(found.grid))).with_means()


def without_flying_pixels(cloud: CleanCloud, image: DepthImage | None) -> CleanCloud:
    """The cloud without pixels whose depth is a mix of two surfaces."""
    if image is None:
        return cloud
    flying = image.flying()
    return cloud.without(flying) if flying.any() else cloud


class _Noise(NamedTuple):
    """The noise that was found.

    Attributes
    ----------
    with_outliers : CleanCloud
        The cloud before its outliers were left out.
    is_much : bool
        Whether it fills the volume, and was sought in voxels half as large from the start.
    """

    with_outliers: CleanCloud
    is_much: bool


def _without_noise(cloud: CleanCloud, assumed: Acquisition, sizes: Sizes) -> tuple[Voxelised, Acquisition, _Noise]:
    """The cloud in voxels of the size that its spacing asks for, without outliers.

    Where many points are outliers, spacing and acquisition were those of noise, and are estimated again without them.
    """
    noisy, left = cloud, 0.0
    for _ in range(2):
        with_outliers = cloud
        size, warp, acquisition = _scale(cloud, assumed, sizes)
        found = _without_outliers(cloud, size, warp)
        may_look_closer = sizes.voxel is None and not acquisition.is_one_scan
        if may_look_closer and is_full_of_noise(found.grid):
            closer = _without_near_outliers(cloud, size, warp)
            found = closer if fill_the_volume(cloud.points, closer.cloud.points) else found
        cloud = found.cloud
        left = len(cloud.points) / len(noisy.points)
        if left >= _FEW_OUTLIERS:
            break
    is_much = may_look_closer and left <= _NOISY and fill_the_volume(noisy.points, cloud.points)
    if is_much:
        found = _without_near_outliers(noisy, size, warp)
    return found, acquisition, _Noise(with_outliers, is_much)


def _adapted(
    found: Voxelised, acquisition: Acquisition, noise: _Noise, sizes: Sizes, may_grade: bool
) -> tuple[Voxelised, float]:
    """The same with larger voxels where surfaces fall apart, everywhere or in some blocks, or smaller ones where they
    stay whole; and the edge of voxels that decide which side is outside, metres."""
    largest = math.inf if sizes.seed is None else sizes.seed
    size, orienting_size = adapted_voxel_size(found.cloud.points, found.grid, acquisition, largest)
    if size != found.grid.size:
        is_larger = size > found.grid.size
        cloud = noise.with_outliers if is_larger else found.cloud  # in larger voxels, what was thin may be no noise
        warp = _from_corner(found.grid.warp, noise.with_outliers, size)
        found = (_without_outliers if is_larger or noise.is_much else Voxelised.of)(cloud, size, warp)
    if may_grade and size == orienting_size:
        grading = adapted_grading(found.grid, acquisition)
        if grading is not None:
            found = Voxelised(found.cloud, voxel_grid(found.cloud.points, size, found.grid.warp, grading))
    return found, orienting_size


def _scale(cloud: CleanCloud, assumed: Acquisition, sizes: Sizes) -> tuple[float, Warp, Acquisition]:
    """Voxel size, metres, and warp that the spacing of the points asks for; and the acquisition that it tells.

    A default size is one of 16 per octave, counted from the extent of the cloud.
    """
    acquisition, spacing = assumed.with_spacing(cloud)
    warp = acquisition.warp(cloud.points)
    size = sizes.voxel
    if size is None:
        if assumed.told.image is not None:
            spacing = assumed.told.image.spacing(cloud.points, warp)
        elif spacing is None:
            spacing = median_spacing(cloud.points, warp)
        size = VOXELS_PER_SPACING * spacing
        extent = float(np.ptp(cloud.bounds, axis=0).max())
        if 0.0 < extent < math.inf and 0.0 < size < math.inf:
            size = extent * 2.0 ** (round(_SIZES_PER_OCTAVE * math.log2(size / extent)) / _SIZES_PER_OCTAVE)
        size = positive("voxel_size", size if sizes.seed is None else min(size, sizes.seed))
    return size, _from_corner(warp, cloud, size), acquisition


def _from_corner(warp: Warp, cloud: CleanCloud, size: float) -> Warp:
    """The warp with its grid aligned with the cloud's lowest corner, so that a moved cloud has the same voxels.

    Where voxels grow about a place, the grid is aligned with that.
    """
    return warp.from_corner(cloud.bounds[0] - _GRID_OFFSET * size)


def _without_outliers(cloud: CleanCloud, size: float, warp: Warp) -> Voxelised:
    """The cloud in voxels of a size, without what these show to be outliers."""
    found = Voxelised.of(cloud, size, warp)
    return found.without(outlier_voxels(found.grid))


def _without_near_outliers(cloud: CleanCloud, size: float, warp: Warp) -> Voxelised:
    """The same, but voxels half as large come first, which tell noise beside surfaces from these.

    Larger voxels keep such noise, and what is left of it would forbid that they become smaller.
    """
    closer = _without_outliers(cloud, size / 2.0, _from_corner(warp, cloud, size / 2.0))
    return _without_outliers(closer.cloud, size, warp)
