# SPDX-License-Identifier: Apache-2.0
"""What a range scan never sees, and a CT does: an opaque, a hollow and a glass thing, side by side.

Each stands on a table, is scanned by structured light from a dome of views, and is put through a simulated CT. Prints
how much of surface and volume the scan saw, and writes a page with a section through each: the truth, what the views
know of space, and the CT on the same voxels.

Usage: python examples/sparse_against_dense.py [OUT.html] [--views 8] [--width 240] [--voxel-mm 1.5]
       [--things opaque hollow glass]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from rangesim import StructuredLight, load_scene, scan
from rangesim.experiment import Dome
from rangesim.fusion import (
    Occupancy,
    Scan,
    Solid,
    VoxelGrid,
    VoxelState,
    attenuation_volume,
    filtered_back_projection,
    occupancy,
    with_photon_noise,
    xray_projections,
)
from rangesim.scene.triangles import true_surfaces

PLASTIC, GLASS, ALUMINIUM, AIR = 22.0, 57.0, 75.0, 0.0
"""1/m at 60 keV: PMMA, Pyrex, aluminium (NIST XCOM)."""
MATTE, CLEAR = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}, {"type": "dielectric", "int_ior": 1.5}
THINGS = {
    "opaque": {"ball": (MATTE, PLASTIC)},
    "hollow": {"ball": (MATTE, PLASTIC), "cavity": (MATTE, AIR), "core": (MATTE, ALUMINIUM)},
    "glass": {"ball": (CLEAR, GLASS), "core": (MATTE, ALUMINIUM)},
}
"""Parts of each thing: what light sees of it, and X-rays."""
STATES = VoxelState.SURFACE, VoxelState.FREE, VoxelState.NEVER_SEEN
MIDDLE, PHOTONS = (0.0, 0.0, 0.045), 1e5


def shape(part: str) -> dict[str, Any]:
    """A ball of 80 mm, a cavity of 60 mm in it, and a slab of 30 x 10 x 16 mm askew within."""
    if part == "core":
        import mitsuba as mi

        to_world = mi.ScalarTransform4f().translate(MIDDLE).rotate([0, 0, 1], 30).scale([0.015, 0.005, 0.008])
        return {"type": "cube", "to_world": to_world}
    return {"type": "sphere", "center": list(MIDDLE), "radius": {"ball": 0.04, "cavity": 0.03}[part]}


def scanned(parts: dict[str, tuple[dict[str, Any], float]], views: int, width: int) -> tuple[Scan, list[Solid]]:
    """A scan of a thing on a table, and the thing itself."""
    import mitsuba as mi

    camera = mi.ScalarTransform4f().look_at([0, -0.4, 0.25], MIDDLE, [0, 0, 1])
    film = {"type": "hdrfilm", "width": width, "height": width * 3 // 4}
    table = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(0.5), "bsdf": MATTE}
    shapes = {name: shape(name) | {"bsdf": bsdf} for name, (bsdf, _) in parts.items()}
    view = {"type": "perspective", "fov": 22, "to_world": camera, "film": film}
    scene = load_scene({"type": "scene", "sensor": view, "table": table} | shapes)
    sensor = StructuredLight(projector_width=640, projector_height=400)
    path = Dome(views=views, centre_m=MIDDLE, distance_m=0.45)
    found = scan(scene, scene.rig(projector_size=(640, 400)), sensor, path, spp=8)
    surfaces = true_surfaces(scene)
    return found, [Solid(name, surfaces[name], attenuation) for name, (_, attenuation) in parts.items()]


def seen_surface(seen: Occupancy) -> float:
    """Of the area of all surfaces, also inner ones."""
    shapes = seen.shapes.values()
    return sum(s.surface * s.area_m2 for s in shapes) / sum(s.area_m2 for s in shapes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("out/sparse_against_dense.html"))
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--width", type=int, default=240, help="of the camera's images")
    parser.add_argument("--voxel-mm", type=float, default=1.5)
    parser.add_argument("--things", nargs="+", choices=THINGS, default=list(THINGS))
    args = parser.parse_args()
    load_scene("plane")  # chooses the renderer's variant, which transforms are made in

    rows, columns = [], []
    print(f"{'':8s}{'surface seen':>14s}{'volume known':>14s}{'called free':>13s}{'unseen':>9s}{'CT error, 1/m':>15s}")
    for name in args.things:
        parts = THINGS[name]
        found, solids = scanned(parts, args.views, args.width)
        grid = VoxelGrid.around(solids[0].mesh.vertices, args.voxel_mm * 1e-3, 0.01)
        seen = occupancy(found.images, {solid.name: solid.mesh for solid in solids}, grid)
        truth = attenuation_volume(solids, grid)
        of_matter = [float((seen.states[truth > 0] == state).mean()) for state in STATES]
        tomogram = filtered_back_projection(with_photon_noise(xray_projections(solids, grid), PHOTONS), "hann")
        error = float(np.abs(tomogram - truth)[truth > 0].mean())
        cells = [f"{100 * s:.0f} %" for s in (seen_surface(seen), *of_matter)]
        print(f"{name:8s}{cells[0]:>14s}{cells[1]:>14s}{cells[2]:>13s}{cells[3]:>9s}{error:15.1f}")
        print(f"{'':8s}of {', '.join(f'{part} {100 * s.surface:.0f} %' for part, s in seen.shapes.items())}")
        rows.append((name, *cells, f"{error:.1f}"))
        columns.append((name, found, seen, truth, tomogram))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    draw(args.out.with_suffix(".png"), columns)
    args.out.write_text(page(rows, args.out.with_suffix(".png").name, args))
    print(args.out)


def draw(out: Path, things: list[tuple[str, Scan, Occupancy, np.ndarray, np.ndarray]]) -> None:
    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    figure, axes = plt.subplots(len(things), 4, figsize=(11.5, 2.9 * len(things)), layout="constrained", squeeze=False)
    space = ListedColormap(["#30343b", "#d9e6f2", "#e07b39"])
    for row, (name, found, seen, truth, tomogram) in zip(axes, things, strict=True):
        h = 1e3 * seen.grid.voxel_m
        nx, _, nz = truth.shape
        box = {"origin": "lower", "extent": (0, nx * h, 0, nz * h)}
        section = [volume[:, truth.shape[1] // 2].T for volume in (truth, seen.states, tomogram)]
        picture = found.images[0].intensity
        row[0].imshow(picture, cmap="gray", vmin=0, vmax=np.nanquantile(picture, 0.995))
        row[0].set_axis_off()
        scale = {"cmap": "gray", "vmin": 0, "vmax": ALUMINIUM}
        row[1].imshow(section[0], **box, **scale)
        row[2].imshow(section[1], **box, cmap=space, vmin=-0.5, vmax=2.5, interpolation="nearest")
        shown = row[3].imshow(section[2], **box, **scale)
        row[0].set_title(f"{name}: a view")
        row[1].set_title("truth")
        row[2].set_title(f"{len(found)} range images: {100 * seen_surface(seen):.0f} % of the surface")
        row[3].set_title("CT")
        for axis in row[1:]:
            axis.set(xlabel="mm", xticks=[0, 50], yticks=[0, 50])
        figure.colorbar(shown, ax=row[3], label="attenuation, 1/m")
    names = [("unseen", "#30343b"), ("free", "#d9e6f2"), ("surface", "#e07b39")]
    figure.legend(
        handles=[Patch(facecolor=c, edgecolor="0.4", label=n) for n, c in names],
        loc="outside lower center",
        ncols=3,
        title="what the range images know",
        frameon=False,
    )
    figure.savefig(out, dpi=100)


def page(rows: list[tuple[str, ...]], picture: str, args: argparse.Namespace) -> str:
    heads = ("", "surface seen", "volume known", "volume called free", "volume never seen", "CT error, 1/m")
    cells = "\n".join("<tr>" + "".join(f"<td>{c}</td>" for c in row) + "</tr>" for row in rows)
    return f"""<!doctype html><html lang="en"><meta charset="utf-8"><title>Sparse against dense</title>
<style>body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem }}
img {{ max-width: 100% }} td, th {{ padding: .2rem 1.2rem .2rem 0; text-align: left }}</style>
<h1>Sparse against dense</h1>
<p>A range sensor reads the first surface that sends its light back. {args.views} views of structured light from a dome
know the skin of an opaque thing, and nothing of what is within. Glass they look through: its matter is called free,
and what is seen in it stands where refraction puts it. X-rays pass, and a CT has all of it.</p>
<table><tr>{"".join(f"<th>{h}</th>" for h in heads)}</tr>
{cells}</table>
<p>Voxels of {args.voxel_mm:g} mm. Surface counts cavities and inner parts too. The CT: parallel beams,
{PHOTONS:g} photons per pixel, filtered back-projection; its error is the mean over the matter.</p>
<img src="{picture}" alt="Sections through the three things">
</html>
"""


if __name__ == "__main__":
    main()
