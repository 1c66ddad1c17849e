# SPDX-License-Identifier: Apache-2.0
"""Coverage: how much of a scene's surface and volume range images saw, against the truth.

A range reading says two things: there is nothing up to it, and a surface at it. What lies behind it says nothing of. So
each voxel is free, surface, or never seen; with the signed distance of `rangesim.fusion.sdf` and a band b about the
surface,

    free      sdf < -b        for more views than call it surface
    surface   |sdf| <= b      for as many views as call it free, at least
    unseen    else: behind what every view saw, or outside them all.

This is Curless and Levoy's classification of space ("A volumetric method for building complex models from range
images", SIGGRAPH 1996, section 5), by majority. A range sensor knows of an opaque solid its outer skin alone; where it
looks through glass, or past a mirror, it calls matter free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from scipy.spatial import cKDTree

from rangesim.decoding.range_image import RangeImage
from rangesim.fusion.sdf import signed_distance
from rangesim.fusion.solids import Solid, matter, outermost_first
from rangesim.fusion.voxel_grid import VoxelGrid
from rangesim.settings.config import ShortRepr

SAMPLES = 50_000
"""Points over the area of each solid."""
BAND = 1.0
"""Voxels on either side of a reading that count as its surface."""
SLAB = 1 << 21
"""Voxels that are looked at in one go."""


class Space(IntEnum):
    """What is known of a voxel."""

    UNSEEN = 0
    FREE = 1
    SURFACE = 2


@dataclass(frozen=True, eq=False, repr=False)
class Coverage(ShortRepr):
    """What a set of range images saw of solids.

    space : (nx, ny, nz) uint8, `Space` of each voxel. grid : of voxels.
    surface_seen : fraction of the area of all surfaces, of cavities and inner solids too, with a reading within
    `tolerance_m`. surface_of : the same of each solid, by name.
    volume_surface, volume_free, volume_unseen : fractions of the matter's volume in voxels that are known as surface,
    that were called free, which is wrong, and that no view told anything of; together 1.
    """

    space: np.ndarray
    grid: VoxelGrid
    surface_seen: float
    surface_of: dict[str, float]
    volume_surface: float
    volume_free: float
    volume_unseen: float
    tolerance_m: float


def known_space(images: Sequence[RangeImage], grid: VoxelGrid, band_m: float | None = None) -> np.ndarray:
    """(nx, ny, nz) uint8, `Space` of each voxel, as the readings of all views have it.

    band_m : metres on either side of a reading that count as surface; None: a voxel.

    Raises
    ------
    ValueError
        No images, images without a camera, or a band that is not positive.
    """
    band = BAND * grid.voxel_m if band_m is None else band_m
    if not len(images):
        raise ValueError("expected range images of at least one view, got none.")
    if not 0 < band < np.inf:
        raise ValueError(f"expected a band_m of more than 0 metres, got {band!r}.")
    space = np.empty(grid.shape, dtype=np.uint8)
    slab = max(1, SLAB // (grid.shape[1] * grid.shape[2]))
    corner, h = np.asarray(grid.corner_m), grid.voxel_m
    axes = [corner[k] + (np.arange(grid.shape[k]) + 0.5) * h for k in range(3)]
    for first in range(0, grid.shape[0], slab):
        part = slice(first, first + slab)
        centres = np.stack(np.meshgrid(axes[0][part], *axes[1:], indexing="ij"), axis=-1)
        free, surface = np.zeros(centres.shape[:3], np.int32), np.zeros(centres.shape[:3], np.int32)
        for image in images:
            distance = signed_distance(centres, image)
            free += distance < -band  # False with NaN
            surface += np.abs(distance) <= band
        space[part] = np.where(
            (surface > 0) & (surface >= free), Space.SURFACE, np.where(free > 0, Space.FREE, Space.UNSEEN)
        )
    return space


def scan_coverage(
    images: Sequence[RangeImage],
    solids: Sequence[Solid],
    grid: VoxelGrid,
    *,
    tolerance_m: float | None = None,
    band_m: float | None = None,
    seed: int = 0,
) -> Coverage:
    """How much of the surface and the volume of solids a set of range images saw.

    Parameters
    ----------
    images : of all views, each with its camera and T_world_camera.
    solids : the truth, in the world's frame.
    grid : voxels on which volume is counted; it should hold all solids.
    tolerance_m : metres within which a reading tells of a surface; None: a voxel. Walls thinner than it count as seen
        from both sides.
    band_m : see `known_space`.
    seed : of the points on the surfaces.

    Raises
    ------
    ValueError
        No images, solids that cross, a grid that holds no matter, or a tolerance that is not positive.
    """
    tolerance = grid.voxel_m if tolerance_m is None else tolerance_m
    if not 0 < tolerance < np.inf:
        raise ValueError(f"expected a tolerance_m of more than 0 metres, got {tolerance!r}.")
    space = known_space(images, grid, band_m)
    is_matter = matter(solids, grid)
    total = np.count_nonzero(is_matter)
    if not total:
        raise ValueError(
            f"expected a grid that holds the solids, but no centre of its voxels of {grid.voxel_m:g} m lies in matter; "
            "make one with VoxelGrid.around."
        )
    readings = _readings(images)
    tree = cKDTree(readings) if len(readings) else None
    surface_of, areas = {}, {}
    for solid in outermost_first(solids):
        points, _ = solid.mesh.sample(SAMPLES, seed)
        near = np.full(len(points), np.inf) if tree is None else tree.query(points, distance_upper_bound=tolerance)[0]
        surface_of[solid.name], areas[solid.name] = float(np.isfinite(near).mean()), solid.mesh.area_m2
    counts = np.bincount(space[is_matter], minlength=len(Space)) / total
    seen = sum(surface_of[name] * areas[name] for name in areas) / sum(areas.values())
    return Coverage(
        space=space,
        grid=grid,
        surface_seen=float(seen),
        surface_of=surface_of,
        volume_surface=float(counts[Space.SURFACE]),
        volume_free=float(counts[Space.FREE]),
        volume_unseen=float(counts[Space.UNSEEN]),
        tolerance_m=float(tolerance),
    )


def _readings(images: Sequence[RangeImage]) -> np.ndarray:
    """(n, 3) float64, metres, world."""
    found = [np.zeros((0, 3))]
    for image in images:
        points = image.to_point_cloud("world").points.reshape(-1, 3).astype(np.float64)
        found.append(points[np.isfinite(points).all(axis=1)])
    return np.concatenate(found)
