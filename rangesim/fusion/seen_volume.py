# SPDX-License-Identifier: Apache-2.0
"""How sparse range data is: what of a scene's surface and volume some views saw, against the voxelised truth.

A range sensor samples the first interface on each line of sight. What is in front of it is known to be free; what is
behind it, the inside of things among it, is never seen. What the sensor looked through, it takes for free.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from rangesim.decoding.range_image import RangeImage
from rangesim.fusion.sdf import placed, signed_distance
from rangesim.fusion.solids import inside_voxels
from rangesim.fusion.voxel_grid import VoxelGrid
from rangesim.settings.config import ShortRepr, shown
from rangesim.triangle_mesh import TriangleMesh

SAMPLES = 20_000
"""Points on the true surface of each shape."""
SLANTED = 4.0
"""Tolerances of depth, at most, that a reading of a slanted face may be off."""
LEAST_COSINE = 0.05
"""Of the angle of incidence, at which a view may see a surface."""
AT_ONCE = 1 << 21
"""Voxels that are looked at in one go."""


class VoxelState(IntEnum):
    """What views know of a voxel. SURFACE : some view measured a surface in it. FREE : some view looked through it.
    NEVER_SEEN : it is behind what all views measured, or none looked there."""

    NEVER_SEEN = 0
    FREE = 1
    SURFACE = 2


@dataclass(frozen=True)
class SeenOfShape:
    """How much of one shape some views saw; fractions, NaN of nothing.

    surface : of its true area, measured to within the tolerance, from outside. volume_surface : of its true volume, in
    voxels with a measured surface. volume_never : never seen. volume_free : taken for free, because the sensor looked
    through it, or read it wrongly. area_m2, volume_m3 : true; 0 m3 of a shape that is not closed.
    """

    surface: float
    volume_surface: float
    volume_never: float
    volume_free: float
    area_m2: float
    volume_m3: float


@dataclass(frozen=True, eq=False, repr=False)
class Occupancy(ShortRepr):
    """What views saw of a grid, and what is there.

    states : (nx, ny, nz) uint8, `VoxelState`. truth : (nx, ny, nz) int32, index into `names` of the shape that fills
    the voxel's centre; -1: none. names : of the shapes. shapes : SeenOfShape by name. grid : VoxelGrid. tolerance_m :
    metres.
    """

    states: np.ndarray
    truth: np.ndarray
    names: tuple[str, ...]
    shapes: dict[str, SeenOfShape]
    grid: VoxelGrid
    tolerance_m: float

    def fraction(self, state: VoxelState) -> float:
        """Fraction of the grid's voxels in a state."""
        return float((self.states == state).mean())


def occupancy(
    images: Sequence[RangeImage],
    surfaces: Mapping[str, TriangleMesh],
    grid: VoxelGrid,
    *,
    tolerance_m: float | None = None,
    seed: int = 0,
) -> Occupancy:
    """How much of shapes some views saw.

    Parameters
    ----------
    images : the views, with their poses.
    surfaces : true surface of each shape by name, as of `rangesim.scene.triangles.true_surfaces`. Where two closed
        shapes overlap, the later one fills the place.
    tolerance_m : metres, within which a reading is of a surface; None: a voxel.

    Raises
    ------
    ValueError
        No views or shapes, a view without camera, or a tolerance that is not positive.
    """
    if not len(images) or not surfaces:
        raise ValueError(f"expected views and shapes to compare, got {len(images)} and {len(surfaces)}.")
    tolerance = grid.voxel_m if tolerance_m is None else tolerance_m
    if not tolerance > 0:
        raise ValueError(f"expected a positive tolerance_m in metres, got {shown(tolerance_m)}.")
    states, truth = voxel_states(images, grid), true_occupancy(surfaces, grid)
    shapes = {}
    for number, (name, mesh) in enumerate(surfaces.items()):
        inside = states[truth == number]
        of = {s: float((inside == s).mean()) if inside.size else float("nan") for s in VoxelState}
        shapes[name] = SeenOfShape(
            surface=seen_surface(images, mesh, tolerance, seed=seed),
            volume_surface=of[VoxelState.SURFACE],
            volume_never=of[VoxelState.NEVER_SEEN],
            volume_free=of[VoxelState.FREE],
            area_m2=mesh.area_m2,
            volume_m3=mesh.volume_m3 if mesh.is_closed else 0.0,
        )
    return Occupancy(states, truth, tuple(surfaces), shapes, grid, float(tolerance))


def voxel_states(images: Sequence[RangeImage], grid: VoxelGrid) -> np.ndarray:
    """(nx, ny, nz) uint8, `VoxelState` of each voxel by its centre.

    With sdf as in `rangesim.fusion.sdf`, and b half a voxel's diagonal: a view calls it surface where |sdf| <= b, and
    free where sdf < -b. SURFACE where as many views call it so as call it free, FREE where more look through it, else
    NEVER_SEEN (Curless, Levoy 1996, section 5, by majority: a ghost of one view is outvoted).
    """
    states = np.empty(grid.shape, np.uint8)
    slab = max(1, AT_ONCE // (grid.shape[1] * grid.shape[2]))
    for first in range(0, grid.shape[0], slab):
        part = slice(first, first + slab)
        centres, half = grid.centres(part), np.sqrt(3) / 2 * grid.voxel_m
        free, surface = np.zeros(centres.shape[:3], np.int32), np.zeros(centres.shape[:3], np.int32)
        for image in images:
            distance = signed_distance(centres, image)
            free += distance < -half  # False with NaN
            surface += np.abs(distance) <= half
        is_surface = (surface > 0) & (surface >= free)
        states[part] = np.where(
            is_surface, VoxelState.SURFACE, np.where(free > 0, VoxelState.FREE, VoxelState.NEVER_SEEN)
        )
    return states


def true_occupancy(surfaces: Mapping[str, TriangleMesh], grid: VoxelGrid) -> np.ndarray:
    """(nx, ny, nz) int32, number of the shape that fills each voxel's centre, the last of several; -1: none.

    Shapes that are not closed have no inside.
    """
    truth = np.full(grid.shape, -1, np.int32)
    for number, mesh in enumerate(surfaces.values()):
        if mesh.is_closed:
            truth[inside_voxels(mesh, grid)] = number
    return truth


def seen_surface(
    images: Sequence[RangeImage], mesh: TriangleMesh, tolerance_m: float, *, samples: int = SAMPLES, seed: int = 0
) -> float:
    """Fraction of a surface's area that some view measured: faces that look at the camera, whose plane a reading is
    within `tolerance_m` of. The inner face of a wall that a view measured from outside is not seen."""
    points, face = mesh.sample(samples, seed)
    normals, seen = mesh.face_normals[face], np.zeros(samples, bool)
    closed = mesh.is_closed
    for image in images:
        _, T = placed(image)
        to_camera = T[:3, 3] - points
        cosine = (to_camera * normals).sum(axis=-1) / np.linalg.norm(to_camera, axis=-1)
        facing = (cosine if closed else np.abs(cosine)) > LEAST_COSINE
        off = np.abs(signed_distance(points, image, lookup="bilinear"))
        seen |= facing & (off * np.abs(cosine) <= tolerance_m) & (off <= SLANTED * tolerance_m)
    return float(seen.mean())
