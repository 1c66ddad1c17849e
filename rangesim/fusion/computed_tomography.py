# SPDX-License-Identifier: Apache-2.0
"""Computed tomography: parallel-beam projections of solids, and their filtered back-projection. The dense counterpart
of range data, which end at the first opaque surface.

A pencil of X-rays in the direction (cos a, sin a, 0) that passes the axis of rotation at the distance s measures, by
Beer and Lambert,

    I = I0 exp(-p),    p(a, s, z) = integral of mu along the ray

(Kak, Slaney: "Principles of Computerized Tomographic Imaging", 1988, chapter 3). mu is the attenuation in 1/m, p has no
unit. The axis is parallel to z, through the middle of the voxel [nx // 2, ny // 2], and s counts along
(-sin a, cos a): scikit-image's convention, whose `iradon` filters and back-projects each slice.

Not simulated: scatter, and the spectrum of a tube with its beam hardening; in a real machine they add cups and streaks.
Glass is to X-rays what it is by its attenuation: neither it nor a mirror deflects them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from rangesim.errors import EnvironmentProblem
from rangesim.fusion.mesh_error import raycasting_scene
from rangesim.fusion.solids import Solid, outermost_first, steps_of_attenuation
from rangesim.fusion.voxel_grid import VoxelGrid
from rangesim.settings import limits
from rangesim.settings.config import ShortRepr, nearest, shown
from rangesim.settings.seeds import check_seed
from rangesim.triangle_mesh import TriangleMesh

FILTERS = ("ramp", "shepp-logan", "cosine", "hamming", "hann")
"""Of scikit-image's `iradon`: the ramp is exact, the others trade resolution for less noise."""
RAYS_AT_ONCE = 1 << 19
SHIFTS = 8
"""Times that a ray which meets an edge of the mesh is moved by a little."""
SHIFT = 1e-3
"""Of a voxel."""
LEAST_COUNT = 0.5
"""Photons that a pixel is taken to have counted which counted none."""


@dataclass(frozen=True, eq=False, repr=False)
class Sinogram(ShortRepr):
    """Line integrals of attenuation.

    values : (n_angles, n, nz) float64, no unit. Pixel k of a row of n measures at s = (k - n // 2) voxel_m from the
    axis; n covers the diagonal of the grid's slices. angles : (n_angles,) float64, radians. grid : the voxels that it
    is made for, one row of the detector for each layer.
    """

    values: np.ndarray
    angles: np.ndarray
    grid: VoxelGrid


def sampling_angles(grid: VoxelGrid) -> np.ndarray:
    """(n_angles,) float64, radians, evenly over half a turn: pi / 2 for each pixel of a row, which resolves as finely
    along the rim as across (Kak, Slaney 1988, section 5.1)."""
    count = math.ceil(math.pi / 2 * _row(grid))
    return np.pi * np.arange(count) / count


def xray_projections(solids: Sequence[Solid], grid: VoxelGrid, angles: ArrayLike | None = None) -> Sinogram:
    """Line integrals through solids, exact for their triangles: the chords of rays, one to the middle of each pixel.

    Parameters
    ----------
    solids : closed meshes, within one another or apart; see `Solid`. What lies outside the grid's inscribed cylinder
        of rays is not measured.
    angles : (n,) radians; None: `sampling_angles`.

    Raises
    ------
    ValueError
        Solids that cross, angles that are not finite, or a mesh whose chords do not close.
    """
    ordered = outermost_first(solids)
    chosen = sampling_angles(grid) if angles is None else np.asarray(angles, dtype=np.float64)
    if chosen.ndim != 1 or not chosen.size or not np.isfinite(chosen).all():
        raise ValueError(f"expected finite angles of shape (n,), in radians, got {shown(chosen)}.")
    n, nz = _row(grid), grid.shape[2]
    limits.check("voxels", len(chosen) * n * nz, f"line integrals, not {len(chosen)} x {n} x {nz}")
    values = np.zeros((len(chosen), n, nz))
    for solid, step in zip(ordered, steps_of_attenuation(ordered), strict=True):
        if step != 0:
            values += step * _chords(solid, grid, chosen)
    return Sinogram(np.maximum(values, 0.0), chosen, grid)


def with_photon_noise(sinogram: Sinogram, photons: float, seed: int = 0) -> Sinogram:
    """The same with shot noise: p = ln(I0 / counts), counts ~ Poisson(I0 exp(-p)), I0 photons per pixel and angle.

    The standard deviation is about exp(p / 2) / sqrt(I0) where counts are many. A pixel without a photon, behind too
    much matter, is taken for half a photon.
    """
    if not 1 <= photons <= 1e15:
        raise ValueError(f"expected 1 to 1e15 photons per pixel, got {photons!r}.")
    check_seed(seed)
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-sinogram.values))
    return replace(sinogram, values=np.log(photons / np.maximum(counts, LEAST_COUNT)))


def filtered_back_projection(sinogram: Sinogram, filter_name: str = "ramp") -> np.ndarray:
    """(nx, ny, nz) float64, 1/m, the attenuation whose projections these are, on the sinogram's grid.

    scikit-image's `iradon`, slice by slice, with linear interpolation between pixels. Values of air scatter about 0,
    below it too; edges are spread over about a voxel, and ring.

    Raises
    ------
    ValueError
        Another filter, or fewer than two angles.
    EnvironmentProblem
        scikit-image is not there.
    """
    try:
        from skimage.transform import iradon
    except ModuleNotFoundError as missing:
        raise EnvironmentProblem(
            "filtered back-projection needs scikit-image, which is not installed; pip install 'rangesim[ct]'."
        ) from missing
    if filter_name not in FILTERS:
        raise ValueError(
            f"expected a filter out of {', '.join(FILTERS)}, got {filter_name!r}{nearest(filter_name, FILTERS)}."
        )
    if len(sinogram.angles) < 2:
        raise ValueError(f"expected at least two angles to see depth by, got {len(sinogram.angles)}.")
    grid, degrees = sinogram.grid, np.degrees(sinogram.angles)
    n, (nx, ny, nz) = sinogram.values.shape[1], grid.shape
    left, top = n // 2 - nx // 2, n // 2 - ny // 2
    volume = np.zeros(grid.shape)
    for layer in range(nz):
        row = sinogram.values[:, :, layer].T
        if row.any():
            slice_ = iradon(row, theta=degrees, output_size=n, filter_name=filter_name, circle=True)
            volume[:, :, layer] = slice_[left : left + nx, top : top + ny]
    return volume / grid.voxel_m


def _row(grid: VoxelGrid) -> int:
    """Pixels of a row of the detector: the diagonal of a slice, about the axis."""
    nx, ny, _ = grid.shape
    return 2 * math.ceil(math.hypot(nx // 2 + 0.5, ny // 2 + 0.5)) + 1


def _chords(solid: Solid, grid: VoxelGrid, angles: np.ndarray) -> np.ndarray:
    """(n_angles, n, nz) metres that each ray runs within a solid."""
    n, (nx, ny, nz) = _row(grid), grid.shape
    h, corner = grid.voxel_m, np.asarray(grid.corner_m)
    axis = corner[:2] + (np.array([nx // 2, ny // 2]) + 0.5) * h
    P = solid.mesh.vertices
    reach = float(np.linalg.norm(P[:, :2] - axis, axis=1).max()) + h
    low, high = np.searchsorted(corner[2] + (np.arange(nz) + 0.5) * h, [P[:, 2].min(), P[:, 2].max()])
    heights = corner[2] + (np.arange(low, high) + 0.5) * h
    near = np.flatnonzero(np.abs(np.arange(n) - n // 2) * h <= reach)
    lengths = np.zeros((len(angles), n, nz))
    if not (near.size and heights.size):
        return lengths
    s = (near - n // 2) * h
    at_once = max(1, RAYS_AT_ONCE // (len(s) * len(heights)))
    caster = _Caster(solid, SHIFT * h)
    for first in range(0, len(angles), at_once):
        a = angles[first : first + at_once]
        along = np.stack([np.cos(a), np.sin(a), 0 * a], axis=-1)
        across = np.stack([-np.sin(a), np.cos(a), 0 * a], axis=-1)
        start = across[:, None, None] * s[:, None, None] - reach * along[:, None, None]
        origins = np.empty((len(a), len(s), len(heights), 3))
        origins[..., :2] = axis + start[..., :2]
        origins[..., 2] = heights
        directions = np.broadcast_to(along[:, None, None], origins.shape)
        found = caster.lengths(origins.reshape(-1, 3), directions.reshape(-1, 3))
        lengths[first : first + at_once, near[0] : near[-1] + 1, low:high] = found.reshape(origins.shape[:3])
    return lengths


class _Caster:
    """Lengths of rays within one closed mesh."""

    def __init__(self, solid: Solid, shift_m: float) -> None:
        self.name, self.shift_m = solid.name, shift_m
        self.scene, self.middle = raycasting_scene(solid.mesh)
        self.normals = _outward(solid.mesh)

    def lengths(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(m,) metres: sum of the ranges at which a ray leaves, less those at which it enters.

        A ray through an edge or a vertex may be told of one triangle twice or not at all; then its crossings do not
        alternate, and it is shifted by a thousandth of a voxel.
        """
        found, closed = self._cast(origins, directions)
        for k in range(1, SHIFTS + 1):
            if closed.all():
                return found
            again = np.flatnonzero(~closed)
            sideways = np.cross(directions[again], [0.0, 0.0, 1.0])
            moved = origins[again] + self.shift_m * k * (sideways + np.array([0.0, 0.0, 0.7]))
            found[again], closed[again] = self._cast(moved, directions[again])
        if not closed.all():
            raise ValueError(
                f"expected a closed mesh that rays leave as often as they enter, but {np.count_nonzero(~closed)} of "
                f"{len(closed)} do not through {self.name}; mend its holes and turned faces."
            )
        return found

    def _cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        import open3d as o3d

        rays = np.concatenate([origins - self.middle, directions], axis=1).astype(np.float32)
        hits = self.scene.list_intersections(o3d.core.Tensor(rays))
        ray = hits["ray_ids"].numpy().astype(np.int64)
        range_m, face = hits["t_hit"].numpy().astype(np.float64), hits["primitive_ids"].numpy()
        leaves = (self.normals[face] * directions[ray]).sum(axis=1) > 0
        order = np.lexsort((range_m, ray))
        ray, range_m, sign = ray[order], range_m[order], np.where(leaves[order], 1, -1)
        m = len(origins)
        depth = np.cumsum(sign) - np.repeat(*_before(sign, ray, m))  # -1 within, 0 outside
        closed = np.bincount(ray, sign, m) == 0
        closed &= np.bincount(ray, (depth != 0) & (depth != -1), m) == 0
        return np.bincount(ray, sign * range_m, m), closed


def _before(sign: np.ndarray, ray: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Sum of the signs before each ray's first crossing, and its number of crossings."""
    counts = np.bincount(ray, minlength=m)
    totals = np.concatenate([[0], np.cumsum(sign)])
    return totals[np.cumsum(counts) - counts], counts


def _outward(mesh: TriangleMesh) -> np.ndarray:
    """(k, 3) normals of the faces, not of unit length."""
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    return np.cross(b - a, c - a)
