# SPDX-License-Identifier: Apache-2.0
"""Solids, which are closed meshes filled with matter, and their voxels: the true inside of objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rangesim.fusion.mesh_error import raycasting_scene
from rangesim.fusion.voxel_grid import VoxelGrid
from rangesim.settings.config import ShortRepr, shown
from rangesim.triangle_mesh import TriangleMesh

TOUCHING = 1e-5
"""A point nearer to a solid's surface than this fraction of the solid's extent lies on the surface. The value is above
the rounding of Open3D (1e-7), because points on the surface must not count as inside or outside."""
SAMPLES = 2000
"""Number of points on a surface, besides its vertices, that are tested to find where it crosses another solid. A
crossing that contains none of them is not found; twice as many points take twice the time."""
VOTES = 3
"""Number of rays for each point. The majority decides whether the point is inside, because a single ray that hits an
edge may be wrong. The count is odd so that there is always a majority."""
POINTS_AT_ONCE = 1 << 20
"""Number of points that are tested in one call, so that they take about 12 MB."""


@dataclass(frozen=True, eq=False, repr=False)
class Solid(ShortRepr):
    """Closed surface and the matter inside it.

    Where one solid contains another, the inner one counts. So you describe a hollow ball as a ball with a smaller ball
    of attenuation 0 inside it.

    Parameters
    ----------
    name : name of the part, not empty.
    mesh : closed mesh, metres, world; triangles counter-clockwise as seen from outside.
    attenuation_per_m : 1/m, linear attenuation coefficient of the matter for X-rays; 0 is a cavity. Some values at
        60 keV (NIST XCOM): water 20.6, PMMA 22, glass (Pyrex) 57, aluminium 75, iron 950.

    Raises
    ------
    ValueError
        An empty name, a mesh that is not closed or is inside out, or an attenuation that is negative or not finite.

    Examples
    --------
    >>> import trimesh
    >>> from rangesim.fusion import Solid
    >>> from rangesim.triangle_mesh import TriangleMesh
    >>> made = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    >>> ball = Solid("ball", TriangleMesh(made.vertices, made.faces), attenuation_per_m=22.0)
    >>> round(1e6 * ball.mesh.volume_m3)  # cm3
    266
    """

    name: str
    mesh: TriangleMesh
    attenuation_per_m: float

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"expected a name for each solid, got {shown(self.name)}.")
        if not 0 <= self.attenuation_per_m < np.inf:
            raise ValueError(
                f"expected an attenuation of 0 1/m or more, got {self.attenuation_per_m!r} of {self.name}."
            )
        if not self.mesh.is_closed:
            raise ValueError(
                f"expected a closed mesh, which encloses a volume, got {self.name} with {len(self.mesh.faces)} "
                "triangles and a hole; close it, as with trimesh's fill_holes."
            )
        if not self.mesh.volume_m3 > 0:
            raise ValueError(
                f"expected triangles counter-clockwise as seen from outside, got {self.name} inside out; turn its "
                "faces: mesh.faces[:, ::-1]."
            )


def inside_voxels(mesh: TriangleMesh, grid: VoxelGrid) -> np.ndarray:
    """Whether the centre of each voxel is inside a closed mesh: (nx, ny, nz) bool.

    Open3D decides it by the parity of the crossings of rays, for voxels within the mesh's bounding box.

    Examples
    --------
    A box of 0.2 x 0.2 x 0.1 m in voxels of 0.05 m:

    >>> import trimesh
    >>> from rangesim.fusion import VoxelGrid, inside_voxels
    >>> from rangesim.triangle_mesh import TriangleMesh
    >>> made = trimesh.creation.box(extents=(0.2, 0.2, 0.1))
    >>> box = TriangleMesh(made.vertices, made.faces)
    >>> int(inside_voxels(box, VoxelGrid.around(box.vertices, 0.05, margin_m=0.1)).sum())
    32
    """
    import open3d as o3d

    found = np.zeros(grid.shape, dtype=bool)
    corner, shape = np.asarray(grid.corner_m), np.asarray(grid.shape)
    low = np.clip(np.floor((mesh.vertices.min(axis=0) - corner) / grid.voxel_m), 0, shape).astype(int)
    high = np.clip(np.ceil((mesh.vertices.max(axis=0) - corner) / grid.voxel_m), 0, shape).astype(int)
    if (high <= low).any():
        return found
    scene, middle = raycasting_scene(mesh)
    box = VoxelGrid(tuple(high - low), grid.voxel_m, tuple(corner + low * grid.voxel_m - middle))
    slab = max(1, POINTS_AT_ONCE // (box.shape[1] * box.shape[2]))
    for first in range(0, box.shape[0], slab):
        centres = box.centres(slice(first, first + slab)).astype(np.float32)
        inside = scene.compute_occupancy(o3d.core.Tensor(centres), nsamples=VOTES).numpy() > 0.5
        start = low[0] + first
        found[start : start + inside.shape[0], low[1] : high[1], low[2] : high[2]] = inside
    return found


def attenuation_volume(solids: Sequence[Solid], grid: VoxelGrid) -> np.ndarray:
    """Attenuation at the centre of each voxel: (nx, ny, nz) float64, 1/m, of the innermost solid there; 0 in air.

    Raises
    ------
    ValueError
        No solids, two with the same name, or two that cross each other.

    Examples
    --------
    >>> import trimesh
    >>> from rangesim.fusion import Solid, VoxelGrid, attenuation_volume
    >>> from rangesim.triangle_mesh import TriangleMesh
    >>> def box(name, edge_m, attenuation_per_m):
    ...     made = trimesh.creation.box(extents=(edge_m, edge_m, edge_m))
    ...     return Solid(name, TriangleMesh(made.vertices, made.faces), attenuation_per_m)
    >>> grid = VoxelGrid.around([[0.0, 0.0, 0.0]], 0.02, margin_m=0.07)
    >>> attenuation_volume([box("wall", 0.1, 75.0), box("cavity", 0.06, 0.0)], grid)[3, 3].tolist()
    [0.0, 75.0, 0.0, 0.0, 0.0, 75.0, 0.0]
    """
    volume = np.zeros(grid.shape)
    for solid in outermost_first(solids):
        volume[inside_voxels(solid.mesh, grid)] = solid.attenuation_per_m
    return volume


def outermost_first(solids: Sequence[Solid]) -> list[Solid]:
    """The solids in an order in which each one comes after those that contain it.

    Raises
    ------
    ValueError
        No solids, two with the same name, or two that cross each other.
    """
    chosen = list(solids)
    if not chosen or not all(isinstance(s, Solid) for s in chosen):
        raise ValueError(f"expected solids, at least one, got {shown(solids)}.")
    names = [s.name for s in chosen]
    if len(set(names)) < len(names):
        raise ValueError(f"expected a name of its own for each solid, got {', '.join(names)}.")
    containers = _containers(chosen)
    return [chosen[k] for k in sorted(range(len(chosen)), key=lambda k: (len(containers[k]), k))]


def steps_of_attenuation(solids: Sequence[Solid]) -> list[float]:
    """Step of attenuation at the surface of each solid, in 1/m: its own attenuation minus that of the solid around it,
    or of air.

    The line integral of the attenuation is the sum over the solids of this step times the chord through the solid.
    """
    containers = _containers(list(solids))
    steps = []
    for k, solid in enumerate(solids):
        around = max(containers[k], key=lambda j: len(containers[j]), default=None)
        steps.append(solid.attenuation_per_m - (0.0 if around is None else solids[around].attenuation_per_m))
    return steps


def _containers(solids: Sequence[Solid]) -> list[list[int]]:
    """Indices of the solids that contain each solid.

    A solid contains another if no vertex of the other, and none of the random points on its surface, is outside. The
    points may touch the surface. ValueError if some are inside and some outside, or all on the surface.
    """
    import open3d as o3d

    found: list[list[int]] = [[] for _ in solids]
    for j, outer in enumerate(solids):
        low, high = outer.mesh.vertices.min(axis=0), outer.mesh.vertices.max(axis=0)
        touching = TOUCHING * float((high - low).max())
        scene, middle = raycasting_scene(outer.mesh)
        for k, inner in enumerate(solids):
            P = np.concatenate([inner.mesh.vertices, inner.mesh.sample(SAMPLES)[0]])
            if j == k or (P.max(axis=0) < low).any() or (P.min(axis=0) > high).any():
                continue
            corners = o3d.core.Tensor((P - middle).astype(np.float32))
            depth = -scene.compute_signed_distance(corners, nsamples=VOTES).numpy()  # Open3D's is negative inside
            within, beyond = (depth > touching).any(), (depth < -touching).any()
            if within and not beyond:
                found[k].append(j)
            elif within == beyond:
                raise ValueError(
                    f"expected solids that lie within one another or apart, but {inner.name} "
                    f"{'crosses' if beyond else 'fills'} {outer.name}; unite them, or leave one out."
                )
    return found
