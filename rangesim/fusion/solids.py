# SPDX-License-Identifier: Apache-2.0
"""Solids: closed meshes filled with matter, and their voxels. The truth of what lies inside things."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rangesim.fusion.mesh_error import raycasting_scene
from rangesim.fusion.voxel_grid import VoxelGrid
from rangesim.settings.config import ShortRepr, shown
from rangesim.triangle_mesh import TriangleMesh

TOUCHING = 1e-5
"""Of a solid's extent: what is nearer to its surface lies on it."""
SAMPLES = 2000
"""Points on a surface that are looked at, besides its vertices, to tell whether it crosses another."""
VOTES = 3
"""Rays by which Open3D decides whether a point lies inside."""
AT_ONCE = 1 << 20
"""Points that are looked at in one call."""


@dataclass(frozen=True, eq=False, repr=False)
class Solid(ShortRepr):
    """A closed surface and the matter within it.

    Parameters
    ----------
    name : of the part.
    mesh : closed, its triangles counter-clockwise as seen from outside.
    attenuation_per_m : 1/m, linear attenuation coefficient of the matter for X-rays; 0 is a cavity. Some values at
        60 keV (NIST XCOM): water 20.6, PMMA 22, glass (Pyrex) 57, aluminium 75, iron 950.

    Where solids contain one another, the innermost counts: a hollow ball is a ball, and a smaller one of 0 within it.

    Raises
    ------
    ValueError
        An empty name, a mesh that is not closed or turned inside out, or an attenuation that is negative or not finite.
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
    """(nx, ny, nz) bool, whether the centre of each voxel lies inside a closed mesh: the parity of crossings (Open3D).

    Only voxels within the mesh's bounding box are looked at.
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
    slab = max(1, AT_ONCE // (box.shape[1] * box.shape[2]))
    for first in range(0, box.shape[0], slab):
        centres = box.centres(slice(first, first + slab)).astype(np.float32)
        inside = scene.compute_occupancy(o3d.core.Tensor(centres), nsamples=VOTES).numpy() > 0.5
        start = low[0] + first
        found[start : start + inside.shape[0], low[1] : high[1], low[2] : high[2]] = inside
    return found


def attenuation_volume(solids: Sequence[Solid], grid: VoxelGrid) -> np.ndarray:
    """(nx, ny, nz) float64, 1/m, attenuation at the centre of each voxel: that of the innermost solid; 0 of air."""
    volume = np.zeros(grid.shape)
    for solid in outermost_first(solids):
        volume[inside_voxels(solid.mesh, grid)] = solid.attenuation_per_m
    return volume


def outermost_first(solids: Sequence[Solid]) -> list[Solid]:
    """The solids in an order in which each comes after those that contain it.

    Raises
    ------
    ValueError
        There are none, two share a name, or two of them cross each other.
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
    """1/m, of each solid, in their order: its attenuation less that of what directly surrounds it.

    The line integral of the attenuation is the sum of these steps times the chords through the solids.
    """
    containers = _containers(list(solids))
    steps = []
    for k, solid in enumerate(solids):
        around = max(containers[k], key=lambda j: len(containers[j]), default=None)
        steps.append(solid.attenuation_per_m - (0.0 if around is None else solids[around].attenuation_per_m))
    return steps


def _containers(solids: Sequence[Solid]) -> list[list[int]]:
    """Of each solid those that contain it, by the signed distances of its vertices and of points on its surface,
    which may touch the other."""
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
