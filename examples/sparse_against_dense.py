# SPDX-License-Identifier: Apache-2.0
"""What a range sensor never sees: an opaque, a hollow and a glass thing by structured light from all sides and by CT.

A range sensor measures the first surface on each line of sight. Computed tomography measures every depth along it. Both
on the same voxels, with the truth beside them; writes a picture.

Usage: python examples/sparse_against_dense.py [PICTURE.png] [--views 12] [--width 240] [--voxel 0.0015]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt
import mitsuba as mi
import trimesh
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

from rangesim import Scene, StructuredLight, load_scene
from rangesim.environment.backend import select_variant
from rangesim.fusion import Dome, VoxelGrid, VoxelState, occupancy, scan, simulate_ct
from rangesim.report.mesh_pictures import mesh_picture
from rangesim.scene.triangles import true_surfaces
from rangesim.triangle_mesh import TriangleMesh

MATTE = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.6}}
GLASS = {"type": "dielectric", "int_ior": "bk7"}
ATTENUATION_PER_M = {"core": 120.0}
TINT = np.array([[140, 140, 140], [236, 196, 120]])
"""Of the table, and of what stands on it."""
STATES = ListedColormap(["#5a5a60", "#f0f0ec", "#5e93be"])
"""Never seen, free, surface."""


def sphere(radius: float, x: float, y: float, z: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(4, radius).apply_translation((x, y, z))


def box(size: tuple[float, float, float], z: float) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation((0, 0, z))


def hollow_box() -> trimesh.Trimesh:
    """A wall of 6 mm around nothing."""
    inner = box((0.058, 0.058, 0.038), 0.0255)
    inner.invert()
    return trimesh.util.concatenate([box((0.07, 0.07, 0.05), 0.0255), inner])


THINGS = {
    "opaque": ({"block": box((0.07, 0.05, 0.03), 0.0155), "ball": sphere(0.015, 0.012, 0.0, 0.0456)}, MATTE),
    "hollow": ({"shell": hollow_box(), "core": sphere(0.012, 0.008, 0.0, 0.0190)}, MATTE),
    "glass": ({"ball": sphere(0.03, 0.0, 0.0, 0.0305)}, GLASS),
}
"""Closed meshes by name, which stand on a table, and their BSDF."""


def scene_of(meshes: dict[str, trimesh.Trimesh], bsdf: dict[str, object]) -> Scene:
    select_variant(None)
    T = mi.ScalarTransform4f
    with tempfile.TemporaryDirectory() as folder:
        shapes: dict[str, object] = {}
        for name, mesh in meshes.items():
            file = str(Path(folder) / f"{name}.ply")
            mesh.export(file)
            shapes[name] = {"type": "ply", "filename": file, "face_normals": bsdf is MATTE, "bsdf": bsdf}
        return load_scene(
            {
                "type": "scene",
                "sensor": {
                    "type": "perspective",
                    "fov": 22.0,
                    "to_world": T().look_at([0, -0.42, 0.3], [0, 0, 0.02], [0, 0, 1]),
                    "film": {"type": "hdrfilm", "width": 320, "height": 240},
                },
                "table": {"type": "rectangle", "to_world": T().scale(0.3), "bsdf": MATTE},
                **shapes,
            }
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("picture", nargs="?", type=Path, default=Path("sparse_against_dense.png"))
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--width", type=int, default=240, help="pixels of the camera")
    parser.add_argument("--voxel", type=float, default=1.5e-3, help="metres")
    arguments = parser.parse_args()

    figure, rows = plt.subplots(3, 4, figsize=(10.4, 8.0), layout="constrained")
    print(
        f"{'':8s}{'surface seen':>14s}{'volume seen':>14s}{'never seen':>14s}{'taken for free':>16s}{'CT right':>10s}"
    )
    for axes, (title, (meshes, bsdf)) in zip(rows, THINGS.items(), strict=True):
        scene = scene_of(meshes, bsdf)
        path = Dome(arguments.views, (0.0, 0.0, 0.02), 0.5, 15.0, 75.0)
        views = scan(scene, scene.rig(0.1, width=arguments.width), StructuredLight(), path, spp=8)
        surfaces = {name: mesh for name, mesh in true_surfaces(scene).items() if name != "table"}
        around = np.concatenate([mesh.vertices for mesh in surfaces.values()])
        grid = VoxelGrid.around(around, arguments.voxel, 4 * arguments.voxel)
        sparse = occupancy(views.images, surfaces, grid)
        mu = {name: ATTENUATION_PER_M[name] for name in surfaces if name in ATTENUATION_PER_M}
        dense = simulate_ct(surfaces, grid, mu).attenuation_per_m

        solid = sparse.truth >= 0
        area = sum(s.area_m2 for s in sparse.shapes.values())
        seen = sum(s.surface * s.area_m2 for s in sparse.shapes.values()) / area
        of = {state: float((sparse.states[solid] == state).mean()) for state in VoxelState}
        right = float(((dense > 25.0) == solid).mean())
        print(
            f"{title:8s}{seen:14.1%}{of[VoxelState.SURFACE]:14.1%}{of[VoxelState.NEVER_SEEN]:14.1%}"
            f"{of[VoxelState.FREE]:16.1%}{right:10.1%}"
        )
        middle = grid.indices([0.0, 0.0, 0.02])[0][1]
        whole = TriangleMesh.joined(list(true_surfaces(scene).values()))
        of_table = len(true_surfaces(scene)["table"].faces)  # it comes first
        picture = mesh_picture(
            whole, scene.camera, scene.T_world_camera, lambda _, face, n=of_table: TINT[(face >= n).astype(int)]
        )
        axes[0].imshow(picture)
        grey = {"cmap": "gray", "vmin": 0, "vmax": 130}
        states = {"cmap": STATES, "vmin": 0, "vmax": 2}
        there = attenuation(sparse.truth, sparse.names)
        for ax, values, colors in ((axes[1], there, grey), (axes[2], sparse.states, states), (axes[3], dense, grey)):
            ax.imshow(values[:, middle].T, origin="lower", interpolation="nearest", **colors)
        axes[0].set_ylabel(title, fontsize=12)
        axes[2].set_xlabel(
            f"{seen:.0%} of the surface seen\n{of[VoxelState.NEVER_SEEN]:.0%} of the volume never", fontsize=9
        )
        if of[VoxelState.FREE] > 0.05:
            axes[2].set_xlabel(
                f"{seen:.0%} of the surface seen\n{of[VoxelState.FREE]:.0%} of the volume taken for free", fontsize=9
            )
        axes[3].set_xlabel(f"{right:.1%} of the voxels right", fontsize=9)
    for ax, name in zip(
        rows[0], ("the thing", "a slice of it", "what range views know", "what CT measures"), strict=True
    ):
        ax.set_title(name, fontsize=11)
    for ax in rows.ravel():
        ax.set(xticks=[], yticks=[])
    names = ("never seen", "seen to be free", "a surface was measured")
    patches = [Patch(facecolor=STATES(k), edgecolor="#888", label=name) for k, name in enumerate(names)]
    figure.legend(handles=patches, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.savefig(arguments.picture, dpi=110)
    print(f"{arguments.picture}: written.")


def attenuation(truth: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """The attenuation, 1/m, of the shape that fills each voxel; 0 of none."""
    table = np.array([*(ATTENUATION_PER_M.get(name, 50.0) for name in names), 0.0])
    return np.asarray(table[truth])


if __name__ == "__main__":
    main()
