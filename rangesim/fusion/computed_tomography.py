# SPDX-License-Identifier: Apache-2.0
"""Computed tomography: parallel-beam projections of solids, and their filtered back-projection.

It measures volumes inside and out, while range data end at the first opaque surface. By the law of Beer and
Lambert, a ray in the direction (cos a, sin a, 0) at the distance s from the axis of rotation measures

    I = I0 exp(-p),    p(a, s, z) = integral of mu along the ray

(Kak, Slaney: "Principles of Computerized Tomographic Imaging", 1988, chapter 3). mu is the attenuation in 1/m; p has no
unit. The axis is parallel to z and passes through the centre of the voxels [nx // 2, ny // 2]. s is measured along
(-sin a, cos a). This is the convention of scikit-image, whose `iradon` filters and back-projects each slice.

The module does not simulate scatter, nor the spectrum of an X-ray tube and its beam hardening. In a real machine they
cause cupping and streaks. X-rays go straight through glass and mirrors, which count by their attenuation alone.
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
"""Names of the filters of scikit-image's `iradon`. The ramp is exact; the others have less noise and resolution."""
RAYS_AT_ONCE = 1 << 19
"""Number of rays that are cast in one call, so that a call needs about a hundred megabytes. With fewer rays, more calls
are needed."""
MAX_SHIFTS = 8
"""A ray that meets an edge of the mesh is shifted; this is the largest number of shifts. A shifted ray rarely meets
another edge. The number has a limit, because a ray through a hole in the mesh would be shifted forever."""
SHIFT_VOXELS = 1e-3
"""Length of such a shift in voxels, chosen far above the rounding of single precision and far below the resolution."""
MIN_COUNT = 0.5
"""Number of photons that replaces a count of 0, because the logarithm of 0 is infinite: half-way between 0 and 1."""


@dataclass(frozen=True, eq=False, repr=False)
class Sinogram(ShortRepr):
    """Line integrals of attenuation, for each angle and each pixel of a detector.

    values : (n_angles, n, nz) float64, no unit. Pixel k of a row of n pixels is at s = (k - n // 2) voxel_m from the
        axis. A row covers the diagonal of the grid's slices, and there is one row for each layer of voxels.
    angles : (n_angles,) float64, radians.
    grid : the voxels that the projections are made for.
    """

    values: np.ndarray
    angles: np.ndarray
    grid: VoxelGrid


def sampling_angles(grid: VoxelGrid) -> np.ndarray:
    """Angles that sample half a turn evenly: (n_angles,) float64, radians.

    Their number is pi / 2 times the pixels of a row. Then, at the edge of a slice, the resolution along the edge
    is the same as across it (Kak, Slaney 1988, section 5.1).

    Examples
    --------
    >>> from rangesim.fusion import VoxelGrid, sampling_angles
    >>> angles = sampling_angles(VoxelGrid((64, 64, 1), 0.001))
    >>> len(angles), angles[:2].round(4).tolist()
    (147, [0.0, 0.0214])
    """
    count = math.ceil(math.pi / 2 * _row(grid))
    return np.pi * np.arange(count) / count


def xray_projections(solids: Sequence[Solid], grid: VoxelGrid, angles: ArrayLike | None = None) -> Sinogram:
    """Line integrals of attenuation through solids, along one ray to the centre of each pixel.

    They are exact for the triangles of the solids: sums of chords times attenuation, and no sums over voxels.

    Parameters
    ----------
    solids : solids inside one another or apart, see `Solid`. Parts beyond the detector's rows are not measured.
    grid : voxels that the detector fits to.
    angles : (n,), radians; None: `sampling_angles`.

    Raises
    ------
    ValueError
        Solids that cross, angles that are not finite, or a mesh that rays do not leave as often as they enter.

    Examples
    --------
    Along its axis, a ray through a cube of 0.1 m with 20 1/m measures 0.1 * 20 = 2:

    >>> import trimesh
    >>> from rangesim.fusion import Solid, VoxelGrid, xray_projections
    >>> from rangesim.triangle_mesh import TriangleMesh
    >>> made = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
    >>> cube = Solid("cube", TriangleMesh(made.vertices, made.faces), attenuation_per_m=20.0)
    >>> sinogram = xray_projections([cube], VoxelGrid.around(cube.mesh.vertices, 0.02), angles=[0.0])
    >>> sinogram.values[0, sinogram.values.shape[1] // 2].round(4).tolist()
    [2.0, 2.0, 2.0, 2.0, 2.0]
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
    """The same sinogram with shot noise.

    The noisy values are ln(I0 / counts) with counts drawn from Poisson(I0 exp(-p)). Their standard deviation is about
    exp(p / 2) / sqrt(I0) where counts are large. A count of 0, behind too much matter, is replaced by half a photon.

    Parameters
    ----------
    photons : I0, number of photons that a pixel counts at each angle without solids, 1 to 1e15.
    seed : the same seed gives the same noise.

    Raises
    ------
    ValueError
        A number of photons or a seed that is out of its range.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.fusion import Sinogram, VoxelGrid, with_photon_noise
    >>> empty = Sinogram(np.zeros((100, 93, 1)), np.linspace(0, np.pi, 100), VoxelGrid((64, 64, 1), 0.001))
    >>> round(float(with_photon_noise(empty, photons=10_000).values.std()), 3)  # 1 / sqrt(10_000)
    0.01
    """
    if not 1 <= photons <= 1e15:
        raise ValueError(f"expected 1 to 1e15 photons per pixel, got {photons!r}.")
    check_seed(seed)
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-sinogram.values))
    return replace(sinogram, values=np.log(photons / np.maximum(counts, MIN_COUNT)))


def filtered_back_projection(sinogram: Sinogram, filter_name: str = "ramp") -> np.ndarray:
    """Attenuation that has these projections, on the sinogram's grid: (nx, ny, nz) float64, 1/m.

    Each slice is computed by scikit-image's `iradon` with linear interpolation between pixels. Values in air scatter
    about 0 and may be negative. Edges are blurred by about a voxel, and show ringing.

    Parameters
    ----------
    filter_name : one of `FILTERS`.

    Raises
    ------
    ValueError
        Another filter, or fewer than two angles.
    EnvironmentProblem
        scikit-image is not installed.

    Examples
    --------
    A cylinder of 20 1/m along z, from closed-form projections:

    >>> import numpy as np
    >>> from rangesim.fusion import Sinogram, VoxelGrid, filtered_back_projection, sampling_angles
    >>> grid, radius_m = VoxelGrid((32, 32, 1), 0.001), 0.01
    >>> s = 0.001 * (np.arange(49) - 24)
    >>> chord = 2 * np.sqrt(np.maximum(radius_m**2 - s**2, 0))
    >>> angles = sampling_angles(grid)
    >>> values = np.tile(20.0 * chord[:, None], (len(angles), 1, 1))
    >>> volume = filtered_back_projection(Sinogram(values, angles, grid))
    >>> round(float(volume[12:20, 12:20].mean()))
    20
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
        raise ValueError(f"expected at least two angles, got {len(sinogram.angles)}.")
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
    """Number of pixels in a row of the detector, which covers the diagonal of a slice on both sides of the axis."""
    nx, ny, _ = grid.shape
    return 2 * math.ceil(math.hypot(nx // 2 + 0.5, ny // 2 + 0.5)) + 1


def _chords(solid: Solid, grid: VoxelGrid, angles: np.ndarray) -> np.ndarray:
    """Length of each ray inside a solid: (n_angles, n, nz) float64, metres."""
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
    caster = _Caster(solid, SHIFT_VOXELS * h)
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
    """Caster of rays that measures their lengths inside one closed mesh.

    shift_m : metres, shift of a ray that meets an edge of the mesh.
    """

    def __init__(self, solid: Solid, shift_m: float) -> None:
        self.name, self.shift_m = solid.name, shift_m
        self.scene, self.middle = raycasting_scene(solid.mesh)
        self.normals = _outward(solid.mesh)

    def lengths(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Length of each ray inside the mesh: (m,) float64, metres.

        It is the sum of the ranges at which the ray leaves the mesh, less those at which it enters. For a ray through
        an edge or a vertex, Open3D may report a triangle twice or not at all. Its crossings then do not alternate
        between in and out, and it is cast again, shifted sideways.

        origins, directions : (m, 3), metres, world, and unit vectors.
        """
        found, closed = self._cast(origins, directions)
        for k in range(1, MAX_SHIFTS + 1):
            if closed.all():
                return found
            again = np.flatnonzero(~closed)
            sideways = np.cross(directions[again], [0.0, 0.0, 1.0])
            moved = origins[again] + self.shift_m * k * (sideways + np.array([0.0, 0.0, 0.7]))
            found[again], closed[again] = self._cast(moved, directions[again])
        if not closed.all():
            raise ValueError(
                f"expected a closed mesh that rays leave as often as they enter, but {np.count_nonzero(~closed)} of "
                f"{len(closed)} rays through {self.name} do not; close its holes, and turn faces that point inward."
            )
        return found

    def _cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lengths of rays inside the mesh (m,), metres, and whether their crossings alternate between in and out."""
        import open3d as o3d

        rays = np.concatenate([origins - self.middle, directions], axis=1).astype(np.float32)
        hits = self.scene.list_intersections(o3d.core.Tensor(rays))
        ray = hits["ray_ids"].numpy().astype(np.int64)
        range_m, face = hits["t_hit"].numpy().astype(np.float64), hits["primitive_ids"].numpy()
        leaves = (self.normals[face] * directions[ray]).sum(axis=1) > 0
        order = np.lexsort((range_m, ray))
        ray, range_m, sign = ray[order], range_m[order], np.where(leaves[order], 1, -1)
        m = len(origins)
        depth = np.cumsum(sign) - np.repeat(*_before(sign, ray, m))  # -1 inside, 0 outside
        closed = np.bincount(ray, sign, m) == 0
        closed &= np.bincount(ray, (depth != 0) & (depth != -1), m) == 0
        return np.bincount(ray, sign * range_m, m), closed


def _before(sign: np.ndarray, ray: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Sum of all signs before the first crossing of each ray, and the ray's number of crossings."""
    counts = np.bincount(ray, minlength=m)
    totals = np.concatenate([[0], np.cumsum(sign)])
    return totals[np.cumsum(counts) - counts], counts


def _outward(mesh: TriangleMesh) -> np.ndarray:
    """Outward normals of the faces: (k, 3) float64, not of unit length."""
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    return np.cross(b - a, c - a)
