# SPDX-License-Identifier: Apache-2.0
"""The dense counterpart of a range scan: simulated computed tomography of the same shapes, on the same grid.

Parallel beams through a scene in slices z, at the angle theta,

    p(s, theta) = integral of mu along the line x cos(theta) - y sin(theta) = s                (Radon transform)

with mu the attenuation in 1/m, are measured as counts N exp(-p) (Beer, Lambert), and filtered back-projection with the
ramp filter gives mu again (Kak, Slaney: "Principles of computerized tomographic imaging", 1988, chapter 3), here by
scikit-image's `iradon`. The lines are cast through the true triangles, not through voxels. Every depth along a line
counts, so what is hidden, hollow or transparent to light is measured like everything else.

Left out: beam hardening, scatter, cone beams. Sharp edges ring, and outside what all angles see nothing is right.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rangesim import limits
from rangesim.errors import EnvironmentProblem
from rangesim.fusion.mesh_error import raycasting_scene
from rangesim.fusion.seen_volume import is_closed
from rangesim.fusion.voxel_grid import VoxelGrid
from rangesim.settings.config import ShortRepr, check_keys, shown
from rangesim.triangle_mesh import TriangleMesh

ATTENUATION_PER_M = 50.0
"""Of a shape whose own is not given: about that of glass or of light metal at 100 keV."""
RAYS = 2
"""Lines across each detector pixel, that are averaged."""
SAME_PLACE = 1e-6
"""Fraction of the distance along a line within which two crossings of a kind are one, in single precision."""
TRIES = 8
"""Shifts of a line that runs along an edge, where entries and exits do not match."""


@dataclass(frozen=True, eq=False, repr=False)
class Tomogram(ShortRepr):
    """What a CT measured.

    attenuation_per_m : (nx, ny, nz) float64, 1/m, on the grid. sinograms : (nz, n_detectors, n_angles) float64, p of
    each slice, s ascending by a voxel, 0 at `n_detectors // 2`. angles_rad : (n_angles,). grid : VoxelGrid.
    """

    attenuation_per_m: np.ndarray
    sinograms: np.ndarray
    angles_rad: np.ndarray
    grid: VoxelGrid


def simulate_ct(
    surfaces: Mapping[str, TriangleMesh],
    grid: VoxelGrid,
    attenuation_per_m: float | Mapping[str, float] = ATTENUATION_PER_M,
    *,
    angles: int | None = None,
    photons: float | None = None,
    seed: int = 0,
) -> Tomogram:
    """A CT of shapes: their projections, and what filtered back-projection makes of them.

    Parameters
    ----------
    surfaces : true surface of each shape by name. Those that are not closed have no inside and are left out; where two
        overlap, their attenuations add.
    grid : slices are its layers in z; the axis goes through the centre of voxel (nx // 2, ny // 2). What lies outside
        its square is in the projections only as far as the detector reaches, and leaves artefacts.
    attenuation_per_m : 1/m, of all shapes, or by name (others: 50).
    angles : over half a turn; None: pi / 2 times the voxels across, as many as there is detail at the edge.
    photons : counts of an open beam, for Poisson noise; None: noise-free.

    Raises
    ------
    ValueError
        No closed shape, unknown names, or numbers out of range.
    EnvironmentProblem
        scikit-image is not installed.
    """
    closed = {name: mesh for name, mesh in surfaces.items() if is_closed(mesh)}
    if not closed:
        raise ValueError(f"expected one closed shape or more, got none of {len(surfaces)}.")
    by_name = attenuation_per_m if isinstance(attenuation_per_m, Mapping) else {}
    check_keys(by_name, surfaces, "attenuation_per_m")
    common = ATTENUATION_PER_M if isinstance(attenuation_per_m, Mapping) else attenuation_per_m
    mu = {name: float(by_name.get(name, common)) for name in closed}
    for name, value in mu.items():
        if not 0 <= value < np.inf:
            raise ValueError(f"expected an attenuation of 0 or more per metre for {name!r}, got {value!r}.")
    across = max(grid.shape[:2])
    count = int(np.ceil(np.pi / 2 * across)) if angles is None else angles
    if count < 1:
        raise ValueError(f"expected one angle or more, got {shown(angles)}.")
    if photons is not None and not photons > 0:
        raise ValueError(f"expected a positive number of photons, got {shown(photons)}.")
    directions = np.pi * np.arange(count) / count
    sinograms = sum(mu[name] * path_lengths(mesh, grid, directions) for name, mesh in closed.items())
    assert isinstance(sinograms, np.ndarray)
    if photons is not None:
        counts = np.random.default_rng(seed).poisson(photons * np.exp(-sinograms))
        sinograms = -np.log(np.maximum(counts, 0.5) / photons)  # no photon at all: as of half a one
    return Tomogram(filtered_back_projection(sinograms, directions, grid), sinograms, directions, grid)


def path_lengths(mesh: TriangleMesh, grid: VoxelGrid, angles_rad: ArrayLike) -> np.ndarray:
    """(nz, n_detectors, n_angles) float64, metres that the lines of a CT run inside a closed mesh.

    The sum of where a line leaves less that of where it enters.
    """
    angles = np.asarray(angles_rad, dtype=np.float64)
    nx, ny, nz = grid.shape
    h, detectors = grid.voxel_m, _detectors(grid)
    limits.check("voxels", nz * detectors * len(angles) * RAYS, "lines of a CT")
    axis = np.asarray(grid.corner_m)[:2] + h * (np.array([nx // 2, ny // 2]) + 0.5)
    sub = (np.arange(RAYS) + 0.5) / RAYS - 0.5
    s = h * ((np.arange(detectors) - detectors // 2)[:, None] + sub).ravel()
    z = grid.corner_m[2] + h * (np.arange(nz) + 0.5)
    reach = h * detectors + float(np.linalg.norm(np.abs(mesh.vertices[:, :2] - axis).max(axis=0)))
    result = np.empty((nz, detectors, len(angles)))
    for k, angle in enumerate(angles):
        c, w = np.cos(angle), np.sin(angle)
        across, along = np.array([c, -w, 0]), np.array([w, c, 0])
        places = np.zeros((nz, len(s), 3))
        places[..., :2] = axis
        places[..., 2] = z[:, None]
        places += s[:, None] * across - reach * along
        lengths = _inside(mesh, places.reshape(-1, 3), along, across, 1e-4 * h)
        result[..., k] = lengths.reshape(nz, detectors, RAYS).mean(axis=-1)
    return result


def filtered_back_projection(sinograms: np.ndarray, angles_rad: ArrayLike, grid: VoxelGrid) -> np.ndarray:
    """(nx, ny, nz) float64, 1/m, attenuation whose projections are `sinograms` (nz, n_detectors, n_angles).

    Raises
    ------
    EnvironmentProblem
        scikit-image is not installed.
    """
    try:
        from skimage.transform import iradon
    except ImportError as error:
        raise EnvironmentProblem(
            "simulated CT needs scikit-image, which is not installed; pip install 'rangesim[ct]'."
        ) from error
    (nx, ny, nz), across = grid.shape, max(grid.shape[:2])
    result = np.empty(grid.shape)
    x, y = across // 2 - nx // 2, across // 2 - ny // 2
    for k in range(nz):
        made = iradon(
            sinograms[k], np.degrees(np.asarray(angles_rad)), output_size=across, filter_name="ramp", circle=False
        )
        result[:, :, k] = made.T[x : x + nx, y : y + ny] / grid.voxel_m
    return result


def _detectors(grid: VoxelGrid) -> int:
    """Pixels of the detector: they cover the square's diagonal."""
    return 2 * int(np.ceil(max(grid.shape[:2]) / np.sqrt(2))) + 3


def _inside(
    mesh: TriangleMesh, origins: np.ndarray, along: np.ndarray, across: np.ndarray, shift_m: float
) -> np.ndarray:
    """(n,) metres that lines from `origins` (n, 3) in the direction `along` run inside a closed mesh."""
    import open3d as o3d

    scene, middle = raycasting_scene(mesh)
    leaves = np.sign((mesh.face_normals * along).sum(axis=-1))
    lengths, left = np.zeros(len(origins)), np.arange(len(origins))
    for attempt in range(TRIES):
        # Along an edge two triangles may be met, or none; a line a little beside is as good
        places = origins[left] + shift_m * (attempt + 0.37) * (across * 0.7 + np.array([0, 0, 0.3])) - middle
        rays = np.concatenate([places, np.broadcast_to(along, places.shape)], axis=-1).astype(np.float32)
        met = scene.list_intersections(o3d.core.Tensor(rays))
        ray, t, face = (met[key].numpy() for key in ("ray_ids", "t_hit", "primitive_ids"))
        ray, t, side = _once(ray, t, leaves[face])
        balance = np.bincount(ray, side, len(left))
        matches = np.abs(balance) < 0.5
        lengths[left] = np.maximum(np.bincount(ray, side * t, len(left)), 0)
        left = left[~matches]
        if not left.size:
            return lengths
    lengths[left] = 0.0  # they graze an edge in every one of these places: as good as nothing
    return lengths


def _once(ray: np.ndarray, t: np.ndarray, side: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Crossings (k,) of lines, each once: on an edge, both triangles are met in one place."""
    order = np.lexsort((t, side, ray))
    ray, t, side = ray[order], t[order], side[order]
    again = np.zeros(len(ray), bool)
    again[1:] = (ray[1:] == ray[:-1]) & (side[1:] == side[:-1]) & (np.diff(t) <= SAME_PLACE * np.abs(t[1:]))
    return ray[~again], t[~again], side[~again]
