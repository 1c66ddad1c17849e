# SPDX-License-Identifier: Apache-2.0
"""Fractions of a scene's surface and volume that some views saw, by comparison with the voxelised truth.

A range sensor measures the first surface on each line of sight. The space in front of it is known to be free. The space
behind it, and with it the inside of objects, is never seen. A sensor that looks through glass counts the glass as free
space.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from rangesim.decoding.range_image import RangeImage
from rangesim.fusion.sdf import camera_and_pose, signed_distance
from rangesim.fusion.solids import inside_voxels
from rangesim.fusion.virtual_cameras import pinhole_views
from rangesim.fusion.voxel_grid import VoxelGrid
from rangesim.settings.config import ShortRepr, shown
from rangesim.triangle_mesh import TriangleMesh

SAMPLES = 20_000
"""Number of points on the true surface of each shape; the seen fraction then has a standard error of 0.4 % at most."""
MAX_SLANT_TOLERANCES = 4.0
"""Largest difference of depth, in multiples of `tolerance_m`, at which a reading still belongs to a slanted face. At 75
degrees of incidence, this is a distance of one tolerance from the face's plane. A larger value would count readings of
other surfaces, a smaller one fewer slanted faces."""
MIN_VIEW_COSINE = 0.05
"""Smallest cosine of the angle of incidence, no unit, at which a view may see a surface: up to 87 degrees. At a larger
angle, a pixel covers so much of a face that its reading says nothing about a single place."""
VOXELS_AT_ONCE = 1 << 21
"""Number of voxels that are compared with the views in one step, so that a step needs some hundred megabytes. With
fewer voxels, more steps are needed."""


class VoxelState(IntEnum):
    """Knowledge that views have of a voxel.

    SURFACE : views measured a surface in it. FREE : views looked through it. NEVER_SEEN : it is behind the surface that
    each view measured, or no view looked there. The exact rule is that of `voxel_states`.
    """

    NEVER_SEEN = 0
    FREE = 1
    SURFACE = 2


@dataclass(frozen=True)
class SeenOfShape:
    """Fractions of one shape that some views saw.

    The fractions of the volume are NaN if the shape fills no voxel, for example because it is not closed.

    surface : fraction of its true area that was measured from outside, to within the tolerance.
    volume_surface : fraction of its true volume in voxels with a measured surface.
    volume_never : fraction of its true volume that was never seen.
    volume_free : fraction of its true volume that counted as free space, because the sensor looked through it or its
        readings are wrong.
    area_m2, volume_m3 : true area and volume; 0 m3 for a shape that is not closed.
    """

    surface: float
    volume_surface: float
    volume_never: float
    volume_free: float
    area_m2: float
    volume_m3: float


@dataclass(frozen=True, eq=False, repr=False)
class Occupancy(ShortRepr):
    """Voxels as views saw them and as they are, and the fractions of each shape that were seen.

    states : (nx, ny, nz) uint8, `VoxelState` of each voxel.
    truth : (nx, ny, nz) int32, index into `names` of the shape at the voxel's centre; -1: none.
    names : names of the shapes.
    shapes : SeenOfShape of each shape, by name.
    grid : VoxelGrid.
    tolerance_m : metres, distance within which a reading belongs to a surface.
    """

    states: np.ndarray
    truth: np.ndarray
    names: tuple[str, ...]
    shapes: dict[str, SeenOfShape]
    grid: VoxelGrid
    tolerance_m: float

    def fraction(self, state: VoxelState) -> float:
        """Fraction of the grid's voxels that are in a state."""
        return float((self.states == state).mean())


def occupancy(
    images: Sequence[RangeImage],
    surfaces: Mapping[str, TriangleMesh],
    grid: VoxelGrid,
    *,
    tolerance_m: float | None = None,
    seed: int = 0,
) -> Occupancy:
    """Fractions of shapes that some views saw, and the state of each voxel.

    Parameters
    ----------
    images : the views, with their poses.
    surfaces : true surface of each shape by name, such as `rangesim.scene.triangles.true_surfaces` returns. Where two
        closed shapes overlap, the later one counts.
    grid : voxels on which views and shapes are compared.
    tolerance_m : metres, distance within which a reading belongs to a surface; None: a voxel.
    seed : seed of the random points on surfaces; the same seed gives the same points.

    Raises
    ------
    ValueError
        No views or shapes, a view without camera, or a tolerance that is not positive.

    Examples
    --------
    A camera looks along z at the near face of a cube of 0.2 m, which is a sixth of its area:

    >>> import numpy as np
    >>> import trimesh
    >>> from rangesim import Intrinsics, RangeImage
    >>> from rangesim.fusion import VoxelGrid, occupancy
    >>> from rangesim.triangle_mesh import TriangleMesh
    >>> made = trimesh.creation.box(extents=(0.2, 0.2, 0.2))
    >>> cube = TriangleMesh(made.vertices + [0, 0, 1.1], made.faces)
    >>> camera, z = Intrinsics.from_fov(32, 24, 40.0), np.ones((24, 32), np.float32)
    >>> range_m = z * np.linalg.norm(camera.directions(camera.pixel_centres()), axis=-1)
    >>> view = RangeImage(z, range_m, 0.5 * z, np.zeros(z.shape, np.uint8), z, camera, np.eye(4))
    >>> seen = occupancy([view], {"cube": cube}, VoxelGrid.around(cube.vertices, voxel_m=0.02))
    >>> round(seen.shapes["cube"].surface, 2), round(seen.shapes["cube"].volume_never, 2)
    (0.17, 0.9)
    """
    if not len(images) or not surfaces:
        raise ValueError(f"expected views and shapes to compare, got {len(images)} and {len(surfaces)}.")
    images = [view for image in images for view in pinhole_views(image)]
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
    """State of each voxel, by its centre: (nx, ny, nz) uint8, values of `VoxelState`.

    Let sdf be the signed distance of `rangesim.fusion.sdf`, and b half a voxel's diagonal. A view votes for surface if
    |sdf| <= b, and for free if sdf < -b. A voxel is SURFACE if it has votes for surface, and at least as many as for
    free. Otherwise it is FREE if it has votes for free, and NEVER_SEEN if it has none. The rule is that of Curless and
    Levoy (1996, section 5), with a majority, so that a ghost of one view is outvoted.

    Examples
    --------
    Voxels along the axis of a camera that sees a wall 1 m away: 0 is never seen, 1 is free, 2 is surface.

    >>> import numpy as np
    >>> from rangesim import Intrinsics, RangeImage
    >>> from rangesim.fusion import VoxelGrid, voxel_states
    >>> camera, z = Intrinsics.from_fov(32, 24, 40.0), np.ones((24, 32), np.float32)
    >>> range_m = z * np.linalg.norm(camera.directions(camera.pixel_centres()), axis=-1)
    >>> wall = RangeImage(z, range_m, 0.5 * z, np.zeros(z.shape, np.uint8), z, camera, np.eye(4))
    >>> voxel_states([wall], VoxelGrid((1, 1, 5), 0.1, (-0.05, -0.05, 0.75)))[0, 0].tolist()
    [1, 1, 2, 0, 0]
    """
    states = np.empty(grid.shape, np.uint8)
    images = [view for image in images for view in pinhole_views(image)]
    slab = max(1, VOXELS_AT_ONCE // (grid.shape[1] * grid.shape[2]))
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
    """Index of the shape at each voxel's centre: (nx, ny, nz) int32; -1: none, and of several shapes the last.

    Shapes that are not closed have no inside, so they fill no voxel.

    Examples
    --------
    >>> import trimesh
    >>> from rangesim.fusion import VoxelGrid, true_occupancy
    >>> from rangesim.triangle_mesh import TriangleMesh
    >>> made = trimesh.creation.box(extents=(0.2, 0.2, 0.2))
    >>> cube = TriangleMesh(made.vertices, made.faces)
    >>> true_occupancy({"cube": cube}, VoxelGrid((4, 1, 1), 0.1, (-0.2, -0.05, -0.05)))[:, 0, 0].tolist()
    [-1, 0, 0, -1]
    """
    truth = np.full(grid.shape, -1, np.int32)
    for number, mesh in enumerate(surfaces.values()):
        if mesh.is_closed:
            truth[inside_voxels(mesh, grid)] = number
    return truth


def seen_surface(
    images: Sequence[RangeImage], mesh: TriangleMesh, tolerance_m: float, *, samples: int = SAMPLES, seed: int = 0
) -> float:
    """Fraction of a surface's area that some view measured.

    A view sees a point of the surface that faces it, if its reading there is within `tolerance_m` of the face's plane.
    The inner face of a wall is not seen by a view from outside, however thin the wall is.

    samples : number of random points on the surface.
    """
    points, face = mesh.sample(samples, seed)
    return float(is_measured(images, points, mesh.face_normals[face], tolerance_m, one_sided=mesh.is_closed).mean())


def is_measured(
    images: Sequence[RangeImage], points: np.ndarray, normals: np.ndarray, tolerance_m: float, *, one_sided: bool
) -> np.ndarray:
    """Whether some view measured each point of a surface: (n,) bool. The rule is that of `seen_surface`.

    points, normals : (n, 3), metres and unit vectors, world.
    one_sided : whether only views on the side to which the normal points see the surface.
    """
    seen = np.zeros(len(points), bool)
    for view in (view for image in images for view in pinhole_views(image)):
        _, T = camera_and_pose(view)
        to_camera = T[:3, 3] - points
        cosine = (to_camera * normals).sum(axis=-1) / np.linalg.norm(to_camera, axis=-1)
        facing = (cosine if one_sided else np.abs(cosine)) > MIN_VIEW_COSINE
        off = np.abs(signed_distance(points, view, lookup="bilinear"))
        seen |= facing & (off * np.abs(cosine) <= tolerance_m) & (off <= MAX_SLANT_TOLERANCES * tolerance_m)
    return seen
