# SPDX-License-Identifier: Apache-2.0
"""Scans fused to a surface: how fast, how much better than one view, poses without a guess, glass and mirrors.

The last line is JSON:

    fusion_s         seconds to fuse 24 views of 640 x 480 pixels, a table with things, in voxels of 2 mm
    fusion_gain      mean distance of one view's readings from the true surface, over that of the fused mesh, on the
                     things of that scan (gray-phase structured light with the detector's noise); above 2
    registration_mm  largest error of a camera centre, of 12 turntable views whose poses were found from the readings

Usage: python benchmarks/fused_scans.py [--small]
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh

from rangesim import StructuredLight, load_scene, scan
from rangesim.environment.backend import select_variant
from rangesim.experiment import Dome, Turntable
from rangesim.fusion import align, fuse, pose_errors, surface_error
from rangesim.fusion.mesh_error import distances_to
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.views import Scan
from rangesim.scene.triangles import true_surfaces
from rangesim.triangle_mesh import TriangleMesh

VOXEL_M = 2e-3
BACKGROUND = ("table", "wall")
EXPOSURE_S = 3e-4
"""A sixteenth of the automatic one: 26 frames in 8 ms, with the noise of little light."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help="a quarter of the pixels and views")
    small = parser.parse_args().small
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n")
    result = {**fusion(small), **weights(small), **registration(small)}
    print(json.dumps({key: result[key] for key in ("fusion_s", "fusion_gain", "registration_mm")}))


def fusion(small: bool = False) -> dict[str, float]:
    """24 noisy views of `matte` by structured light, fused; best of three."""
    scene = load_scene("matte")
    views, width = (6, 160) if small else (24, 640)
    rig = scene.rig(0.05, width=width)  # a baseline as of a hand-held scanner
    path = Dome(views, (0.0, 0.05, 0.05), 0.7, 25.0, 80.0)
    start = time.perf_counter()
    found = scan(scene, rig, Instrument("noisy", StructuredLight(), exposure_s=EXPOSURE_S), path, spp=8)
    rendered_s = time.perf_counter() - start
    fuse(found.images[:1], VOXEL_M)  # compiles
    times = []
    for _ in range(3):
        start = time.perf_counter()
        fused = fuse(found.images, VOXEL_M)
        times.append(time.perf_counter() - start)
    surfaces = true_surfaces(scene)
    things = TriangleMesh.joined([m for n, m in surfaces.items() if n not in BACKGROUND])
    everything = TriangleMesh.joined(list(surfaces.values()))
    single = np.mean([distances_to(p, everything).mean() for p in (_readings(found, k, things) for k in range(views))])
    mesh = _near(fused.mesh, things)
    error = surface_error(mesh, everything, VOXEL_M)
    one = surface_error(_near(fuse(found.images[:1], VOXEL_M).mesh, things), everything, VOXEL_M)
    print(f"{views} views of {width} x {rig.camera.height}, gray-phase, rendered and decoded in {rendered_s:.0f} s")
    print(
        f"fused at {1e3 * VOXEL_M:g} mm, {fused.voxels / 1e6:.0f} M voxels, {len(mesh.faces)} triangles on the things"
    )
    print(f"{'fused in':32s}{min(times):8.2f} s   (best of {[round(t, 2) for t in times]})")
    print(f"{'one view, its readings':32s}{1e3 * single:8.3f} mm  mean distance to the true surface")
    print(f"{'one view, fused alone':32s}{1e3 * one.accuracy_m:8.3f} mm")
    print(f"{'all views, fused':32s}{1e3 * error.accuracy_m:8.3f} mm  gain {single / error.accuracy_m:.2f}\n")
    return {"fusion_s": round(min(times), 2), "fusion_gain": round(single / error.accuracy_m, 2)}


def weights(small: bool = False) -> dict[str, float]:
    """What is left of mirrors and glass, with weights by confidence and without: `tabletop`, 24 views."""
    scene = load_scene("tabletop")
    rig = scene.rig(width=96 if small else 240)
    found = scan(scene, rig, StructuredLight(), Dome(6 if small else 24, (0.0, 0.05, 0.05), 0.7, 25.0, 80.0), spp=8)
    surfaces = true_surfaces(scene)
    everything = TriangleMesh.joined(list(surfaces.values()))
    groups = {
        "matte, glossy": ("clay_ball", "carton", "mug", "mug_lid", "billiard_ball", "steel_block"),
        "mirror": ("silver_ball", "hand_mirror"),
        "glass": ("glass_ball", "glass_block"),
    }
    voxel = 6e-3 if small else 3e-3
    print(
        f"tabletop, {len(found)} views, voxels of {1e3 * voxel:g} mm: fraction of each true surface that the mesh has"
    )
    print("within a voxel, and area of the mesh that is farther than three voxels from any true surface (ghosts)")
    head = f"{'':38s}" + "".join(f"{g:>15s}" for g in groups) + f"{'ghosts, cm2':>14s}"
    print(head)
    for name, options in (
        ("uniform, every surface kept", {"weights": "uniform", "min_weight": 0.0}),
        ("uniform, least weight 1", {"weights": "uniform", "min_weight": 1.0}),
        ("uniform, least weight 2", {"weights": "uniform", "min_weight": 2.0}),
        ("confidence, every surface kept", {"weights": "confidence", "min_weight": 0.0}),
        ("confidence, least weight 1 (default)", {"min_weight": 1.0}),
        ("confidence, least weight 2", {"min_weight": 2.0}),
    ):
        mesh = fuse(found.images, voxel, **options).mesh  # type: ignore[arg-type]
        recall = [
            (distances_to(TriangleMesh.joined([surfaces[n] for n in names]).sample(5000)[0], mesh) <= voxel).mean()
            for names in groups.values()
        ]
        far = distances_to(mesh.corners.mean(axis=1), everything) > 3 * voxel
        ghosts = mesh.face_areas_m2[far].sum()
        print(f"{name:38s}" + "".join(f"{r:15.3f}" for r in recall) + f"{1e4 * ghosts:14.1f}")
    print()
    return {}


def registration(small: bool = False) -> dict[str, float]:
    """12 turntable views of a part, structured light with noise, poses from the readings alone."""
    found = turntable_scan(4 if small else 12, 160 if small else 320, sweep_deg=90.0 if small else 360.0)
    unknown = found.with_poses(np.stack([np.eye(4)] * len(found)))
    start = time.perf_counter()
    aligned = align(unknown)
    took = time.perf_counter() - start
    off = pose_errors(aligned.poses, found.true_poses)  # type: ignore[arg-type]
    print(
        f"{len(found)} views of {found.images[0].z.shape[1]} pixels aligned in {took:.0f} s, {len(aligned.pairs)} pairs"
    )
    print(f"largest error {off.angle_deg.max():.4f} degrees, camera centre {1e3 * off.centre_m.max():.3f} mm\n")
    return {
        "registration_mm": round(1e3 * float(off.centre_m.max()), 3),
        "registration_deg": round(float(off.angle_deg.max()), 4),
    }


def turntable_scan(views: int, width: int, sweep_deg: float = 360.0) -> Scan:
    """A part of 10 cm with nothing around it, by structured light."""
    import mitsuba as mi

    select_variant(None)
    with tempfile.TemporaryDirectory() as folder:
        name = str(Path(folder) / "part.ply")
        part().export(name)
        scene = load_scene(
            {
                "type": "scene",
                "sensor": {
                    "type": "perspective",
                    "fov": 22.0,
                    "to_world": mi.ScalarTransform4f().look_at([0, -0.43, 0.27], [0, 0, 0.02], [0, 0, 1]),
                    "film": {"type": "hdrfilm", "width": width, "height": 3 * width // 4},
                },
                "part": {
                    "type": "ply",
                    "filename": name,
                    "face_normals": True,
                    "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}},
                },
            }
        )
    path = Turntable(views, (0.0, 0.0, 0.02), 0.5, 30.0, sweep_deg=sweep_deg)
    return scan(scene, scene.rig(0.1), StructuredLight(), path, spp=16)


def part() -> trimesh.Trimesh:
    """A block with two bosses and a ball, that looks different from all sides."""
    box, move = trimesh.creation.box, trimesh.transformations.translation_matrix
    return trimesh.util.concatenate(
        [
            box((0.10, 0.07, 0.04)),
            box((0.03, 0.02, 0.06), move((0.03, 0.02, 0.04))),
            box((0.02, 0.04, 0.03), move((-0.03, -0.01, 0.03))),
            trimesh.creation.icosphere(4, 0.018).apply_transform(move((0.0, -0.035, 0.025))),
        ]
    )


def _readings(found: Scan, k: int, things: TriangleMesh) -> np.ndarray:
    """(n, 3) world points of view k on the things, by ground truth of place."""
    points = found.images[k].to_point_cloud("world").points.reshape(-1, 3).astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    return points[distances_to(points, things) < 3 * VOXEL_M]


def _near(mesh: TriangleMesh, things: TriangleMesh) -> TriangleMesh:
    """The triangles within three voxels of the things."""
    return TriangleMesh(mesh.vertices, mesh.faces[distances_to(mesh.corners.mean(axis=1), things) < 3 * VOXEL_M])


if __name__ == "__main__":
    main()
