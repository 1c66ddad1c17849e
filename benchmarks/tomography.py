# SPDX-License-Identifier: Apache-2.0
"""Computed tomography of a head phantom against closed forms and scikit-image's own projections.

    python benchmarks/tomography.py

Seven elliptic cylinders within one another, as in Shepp and Logan's phantom without its overlaps. Their projections are
known in closed form; scikit-image's `radon` projects their voxels, `iradon` brings both back. ct_error is the largest
relative difference of a region's mean attenuation, ours to scikit-image's reference.
"""

from __future__ import annotations

import json
import time

import numpy as np
import trimesh
from scipy.ndimage import binary_erosion
from skimage.transform import iradon, radon

from rangesim.fusion import Solid, VoxelGrid, filtered_back_projection, xray_projections
from rangesim.triangle_mesh import TriangleMesh

N, VOXEL_M, FINE = 160, 1e-3, 6
ELLIPSES = {  # half axes and middle in fractions of the half width, angle in degrees, attenuation in 1/m
    "skull": (0.92, 0.69, 0.0, 0.0, 0, 60.0),
    "brain": (0.874, 0.6624, -0.0184, 0.0, 0, 20.0),
    "ventricle right": (0.31, 0.11, 0.0, 0.22, 18, 12.0),
    "ventricle left": (0.41, 0.16, 0.0, -0.28, -18, 14.0),
    "tumour": (0.21, 0.15, 0.60, 0.0, 0, 26.0),
    "spot": (0.046, 0.046, 0.30, -0.02, 0, 30.0),
    "clot": (0.046, 0.09, -0.605, 0.08, 0, 32.0),
}


def main() -> None:
    print(json.dumps(tomography()))


def tomography() -> dict[str, float]:
    """Prints the table; the keys of the last line."""
    half = N * VOXEL_M / 2
    grid = VoxelGrid((N, N, 1), VOXEL_M, (-half, -half, 0.0))
    solids = [Solid(name, _cylinder(name, half), values[5]) for name, values in ELLIPSES.items()]
    start = time.perf_counter()
    ours = xray_projections(solids, grid)
    projected = time.perf_counter()
    volume = filtered_back_projection(ours)[:, :, 0]
    done = time.perf_counter()

    n = ours.values.shape[1]
    exact = _closed_form(ours.angles, n, half)
    fine = _raster(FINE)
    padded = np.zeros((n, n))
    left = n // 2 - N // 2
    padded[left : left + N, left : left + N] = fine
    theirs = radon(padded, np.degrees(ours.angles), circle=True)
    reference = iradon(theirs, np.degrees(ours.angles), output_size=n, circle=True)[left : left + N, left : left + N]
    truth = _raster(1)
    rows = [
        f"{len(ours.angles)} angles of {n} pixels: {projected - start:.2f} s, back-projection {done - projected:.2f} s"
    ]
    for name, values in (("chords", ours.values[:, :, 0]), ("scikit-image's radon", theirs.T * VOXEL_M)):
        error = np.sqrt(((values - exact) ** 2).mean()) / exact.max()
        rows.append(f"sinogram, {name}: RMS off the closed form {100 * error:.2f} % of the largest integral")
    rows.append(f"{'':18s}{'truth':>8s}{'ours':>9s}{'reference':>11s}   mean attenuation, 1/m")
    errors = []
    for name, (*_, attenuation) in ELLIPSES.items():
        inner = binary_erosion(truth == attenuation, iterations=2)
        mean, wanted = float(volume[inner].mean()), float(reference[inner].mean())
        errors.append(abs(mean / wanted - 1))
        rows.append(f"{name:18s}{attenuation:8.2f}{mean:9.3f}{wanted:11.3f}")
    inside = truth > 0
    for name, image in (("ours", volume), ("reference", reference)):
        rows.append(
            f"RMS off the truth within the skull, {name}: {np.sqrt(((image - fine)[inside] ** 2).mean()):.2f} 1/m"
        )
    print("\n".join(rows))
    return {"ct_error": round(max(errors), 5)}


def _cylinder(name: str, half: float) -> TriangleMesh:
    a, b, x, y, degrees, _ = ELLIPSES[name]
    made = trimesh.creation.cylinder(radius=1.0, height=4 * VOXEL_M, sections=720)
    turn = np.radians(degrees)
    points = made.vertices[:, :2] * [a * half, b * half]
    turned = points @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    vertices = np.column_stack([turned + np.array([x, y]) * half, made.vertices[:, 2]])
    return TriangleMesh(vertices, made.faces)


def _inside(name: str, x: np.ndarray, y: np.ndarray, half: float) -> np.ndarray:
    a, b, x0, y0, degrees, _ = ELLIPSES[name]
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    u, v = (x - x0 * half) * c + (y - y0 * half) * s, -(x - x0 * half) * s + (y - y0 * half) * c
    return np.asarray((u / (a * half)) ** 2 + (v / (b * half)) ** 2 < 1)


def _raster(fine: int) -> np.ndarray:
    """(N, N) attenuation, the mean of fine x fine points per voxel."""
    half = N * VOXEL_M / 2
    axis = (np.arange(N * fine) + 0.5) * VOXEL_M / fine - half
    x, y = np.meshgrid(axis, axis, indexing="ij")
    image = np.zeros(x.shape)
    for name, (*_, attenuation) in ELLIPSES.items():
        image[_inside(name, x, y, half)] = attenuation
    return np.asarray(image.reshape(N, fine, N, fine).mean(axis=(1, 3)))


def _closed_form(angles: np.ndarray, n: int, half: float) -> np.ndarray:
    """(n_angles, n) line integrals: 2 a b sqrt(w^2 - t^2) / w^2, w the half width of an ellipse's shadow (Kak, Slaney
    1988, equation 3.5), times its step of attenuation."""
    axis = np.full(2, (N // 2 + 0.5) * VOXEL_M - half)  # of rotation
    s = (np.arange(n) - n // 2) * VOXEL_M
    total = np.zeros((len(angles), n))
    for name, (a, b, x, y, degrees, attenuation) in ELLIPSES.items():
        step = attenuation - {"skull": 0.0, "brain": ELLIPSES["skull"][5]}.get(name, ELLIPSES["brain"][5])
        across = np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
        turn = np.radians(degrees)
        along_a, along_b = (across @ np.array(e) for e in ((np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))))
        w2 = ((a * half * along_a) ** 2 + (b * half * along_b) ** 2)[:, None]
        t = s - (across @ (np.array([x, y]) * half - axis))[:, None]
        total += step * 2 * a * b * half**2 * np.sqrt(np.maximum(w2 - t**2, 0)) / w2
    return total


if __name__ == "__main__":
    main()
