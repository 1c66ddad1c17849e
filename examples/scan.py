# SPDX-License-Identifier: Apache-2.0
"""A scan from twelve sides: structured light around some things, fused to one surface, with poses known or found.

Usage: python examples/scan.py [SCENE] [--views 12] [--width 320] [--find-poses] [--out out/scan.ply]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from rangesim import StructuredLight, load_scene, scan
from rangesim.experiment import Turntable
from rangesim.fusion import align, fuse, pose_errors, surface_error
from rangesim.scene.triangles import true_surfaces
from rangesim.triangle_mesh import TriangleMesh

VOXEL_M = 2e-3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scene", nargs="?", default="matte")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--width", type=int, default=320, help="pixels of the camera")
    parser.add_argument("--find-poses", action="store_true", help="from the readings alone")
    parser.add_argument("--out", type=Path, help="where the mesh goes, such as scan.ply")
    arguments = parser.parse_args()

    scene = load_scene(arguments.scene)
    rig = scene.rig(0.1, width=arguments.width)
    path = Turntable(arguments.views, centre_m=(0.0, 0.05, 0.05), distance_m=0.7, elevation_deg=40.0)
    views = scan(scene, rig, StructuredLight(), path, spp=8)  # one transport each, the scene is shared
    print(f"{len(views)} views, {np.mean([i.valid.mean() for i in views.images]):.0%} of their pixels measured")

    if arguments.find_poses:
        nowhere = views.with_poses(np.stack([views.poses[0]] * len(views)))
        views = align(nowhere).scan
        off = pose_errors(views.poses, path.poses())
        print(f"poses found to {off.angle_deg.max():.3f} degrees and {1e3 * off.centre_m.max():.2f} mm")

    truth = TriangleMesh.joined(list(true_surfaces(scene).values()))
    print("views fused   mean error   area of the surface")
    for count in (1, len(views)):
        fused = fuse(views.images[:count], VOXEL_M)
        error = surface_error(fused.mesh, truth, VOXEL_M)
        print(f"{count:11d}   {1e3 * error.accuracy_m:7.3f} mm   {1e4 * fused.mesh.area_m2:8.0f} cm2")
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        fused.mesh.save(arguments.out)
        print(f"{arguments.out}: {len(fused.mesh.faces)} triangles")


if __name__ == "__main__":
    main()
