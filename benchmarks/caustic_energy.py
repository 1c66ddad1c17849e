# SPDX-License-Identifier: Apache-2.0
"""Eleven small scenes with glass or a mirror in a closed matte room, and where the projector's light lands in them.

    make     traces light forwards, writes benchmarks/references/caustic_energy.json, and prints it
    compare  the same fluxes as `transport` traces them, against that file (the default)

The reference shares no code with the pass: rays leave the projector evenly over its image, follow Mitsuba's own
`ray_intersect` and `BSDF.sample` through any number of delta interactions (Fresnel's split is drawn), and end on a
wall. All fluxes are fractions of the projector's power that reach walls by at least one delta interaction; a scene has
one for each wall and one for each number of delta interactions. The last line of `compare` is JSON:

    max_flux_error      largest relative error of the flux on all walls
    max_receiver_error  largest error of the flux on one wall, as a fraction of that on all walls

Usage: python benchmarks/caustic_energy.py [make | compare] [--rays 32000000]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from reference_scenes import GLASS, MATTE, SILVER
from scipy.spatial import ConvexHull

from rangesim import Intrinsics, Rig, Scene, load_scene, look_at
from rangesim.environment.backend import select_variant

REFERENCE = Path(__file__).resolve().parent / "references" / "caustic_energy.json"
ROOM_M = 0.3
"""Half the length of an edge of the room. Glass is in its middle, about 80 mm wide."""
RECEIVERS = ("left", "right", "top", "bottom", "front", "back")
"""Walls at -x, +x, -y, +y, -z and +z."""
OFFSET_M = 1e-6
"""How far off a surface the reference starts a ray, metres: thirty times the error of a hit in single precision. Ten
times as much moves up to 0.03 % of the flux from one wall to another; Mitsuba's own offset, a hundred times as much, up
to 0.3 %, and keeps rays in corners of glass."""
MAX_INTERACTIONS = 130
BATCH = 1 << 20
"""Rays traced at once. Batches are independent, so their spread is the standard error."""
WATER_IOR = 1.333
WATER = {"type": "dielectric", "int_ior": WATER_IOR, "ext_ior": 1.0}
WATER_IN_GLASS = {"type": "dielectric", "int_ior": WATER_IOR, "ext_ior": 1.5}
AIR_IN_GLASS = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5}


@dataclass(frozen=True)
class Flux:
    """Light that reaches walls by at least one delta interaction, in fractions of the projector's power.

    total : on all walls.
    standard_error : of `total`, relative.
    receivers : by wall.
    receiver_error : largest standard error of one wall, as a fraction of `total`.
    interactions : after one, two, ... delta interactions; those beyond the last count with it.
    """

    total: float
    standard_error: float
    receivers: dict[str, float]
    receiver_error: float
    interactions: list[float]


# ---- Scenes -----------------------------------------------------------------------------------------


def scene_of(name: str, folder: Path) -> Scene:
    """The scene of one of `GLASSWARE`; its meshes are written to `folder`."""
    select_variant()  # before Mitsuba's transforms
    return load_scene({"type": "scene", "sensor": _sensor(), **_room(), **GLASSWARE[name](folder)})


def _tilted() -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4f().rotate([1, 0, 0], 15).rotate([0, 1, 0], 20)


def _sphere(radius: float, bsdf: dict[str, Any] = GLASS) -> dict[str, Any]:
    return {"type": "sphere", "center": [0.0, 0.0, 0.0], "radius": radius, "bsdf": bsdf}


def _pane(z: float) -> dict[str, Any]:
    return {"type": "cube", "to_world": _tilted().translate([0, 0, z]).scale([0.045, 0.035, 0.002]), "bsdf": GLASS}


def _ring() -> dict[str, Any]:
    place = _tilted().rotate([1, 0, 0], 35)
    ends = {"p0": [0.0, 0.0, -0.01], "p1": [0.0, 0.0, 0.01]}
    silver = {"type": "twosided", "bsdf": SILVER}
    return {"type": "cylinder", **ends, "radius": 0.035, "to_world": place, "bsdf": silver}


def _box(margin_m: float, bsdf: dict[str, Any]) -> dict[str, Any]:
    half = [0.045 - margin_m, 0.03 - margin_m, 0.03 - margin_m]
    return {"type": "cube", "to_world": _tilted().scale(half), "bsdf": bsdf}


def _mesh(folder: Path, name: str, mesh: Mesh, bsdf: dict[str, Any], is_smooth: bool = True) -> dict[str, Any]:
    shape = written(folder / f"{name}.ply", mesh)
    return {**shape, "face_normals": not is_smooth, "to_world": _tilted(), "bsdf": bsdf}


GLASSWARE: dict[str, Callable[[Path], dict[str, Any]]] = {
    "ball": lambda _: {"ball": _sphere(0.04)},
    "lens": lambda f: {"lens": _mesh(f, "lens", biconvex(0.08, 0.035, 0.001), GLASS)},
    "prism": lambda f: {"prism": _mesh(f, "prism", triangular_prism(0.06, 0.052, 0.07), GLASS, is_smooth=False)},
    "pane": lambda _: {"pane": _pane(0.0)},
    "two panes": lambda _: {"pane": _pane(-0.01), "second": _pane(0.01)},
    "bottle with water": lambda f: {k: _mesh(f, k, mesh, bsdf) for k, (mesh, bsdf) in bottle_with_water().items()},
    "hollow ball": lambda _: {"outside": _sphere(0.04), "inside": _sphere(0.037, AIR_IN_GLASS)},
    "curved mirror": lambda _: {"ring": _ring()},
    "facets": lambda f: {"ball": _mesh(f, "facets", icosphere(0.04), GLASS, is_smooth=False)},
    "facets with normals": lambda f: {"ball": _mesh(f, "smooth", icosphere(0.04), GLASS)},
    "fish tank": lambda _: {"glass": _box(0.0, GLASS), "water": _box(0.003, WATER_IN_GLASS)},
}
"""What stands in the middle of the room: scene name -> shapes, given a folder for meshes."""


def rig_of() -> Rig:
    """Projector and camera side by side at the front wall, of all scenes."""
    T_world_camera, T_world_projector = (look_at(p, (0.0, 0.0, 0.0), (0.0, -1.0, 0.0)) for p in (EYE, LAMP))
    return Rig(
        camera=Intrinsics.from_fov(96, 72, 40),
        projector=Intrinsics.from_fov(320, 200, 24),
        T_world_camera=T_world_camera,
        T_camera_projector=np.linalg.inv(T_world_camera) @ T_world_projector,
    )


LAMP, EYE = (0.02, 0.01, -0.25), (-0.1, -0.05, -0.25)


def receiver_of(points: np.ndarray) -> np.ndarray:
    """(n,) int, index in `RECEIVERS` of the wall on which each of (n, 3) points lies."""
    axis = np.abs(points).argmax(axis=1)
    return np.asarray(2 * axis + (points[np.arange(len(points)), axis] > 0))


def _room() -> dict[str, Any]:
    import mitsuba as mi

    # Turns of the square z = 0, which faces +z, that put it at +z, facing inwards, and then at each wall
    turns = {"left": ([0, 1, 0], -90), "right": ([0, 1, 0], 90), "top": ([1, 0, 0], 90), "bottom": ([1, 0, 0], -90),
             "front": ([0, 1, 0], 180), "back": ([0, 1, 0], 0)}  # fmt: skip
    half = [1.01 * ROOM_M, 1.01 * ROOM_M, -1]  # walls overlap at the edges, which closes the room
    return {
        name: {"type": "rectangle", "bsdf": MATTE,
               "to_world": mi.ScalarTransform4f().rotate(*turn).translate([0, 0, ROOM_M]).scale(half)}
        for name, turn in turns.items()
    }  # fmt: skip


def _sensor() -> dict[str, Any]:
    import mitsuba as mi

    to_world = mi.ScalarTransform4f().look_at(list(EYE), [0, 0, 0], [0, 1, 0])
    return {"type": "perspective", "fov": 40.0, "to_world": to_world}


# ---- Meshes -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Mesh:
    """Vertices (n, 3) in metres, normals (n, 3), triangles (m, 3), counter-clockwise from outside."""

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray


def written(path: Path, mesh: Mesh) -> dict[str, Any]:
    """Write a mesh as a PLY file, and return its shape."""
    import mitsuba as mi

    plain = mi.Mesh(path.stem, len(mesh.vertices), len(mesh.faces), has_vertex_normals=True)
    parameters = mi.traverse(plain)
    parameters["vertex_positions"] = mi.Float(mesh.vertices.ravel())
    parameters["vertex_normals"] = mi.Float(mesh.normals.ravel())
    parameters["faces"] = mi.UInt32(mesh.faces.ravel())
    parameters.update()
    plain.write_ply(str(path))
    return {"type": "ply", "filename": str(path)}


def lathe(*pieces: np.ndarray, segments: int = 192) -> Mesh:
    """A surface of revolution about y, of smooth pieces (m, 2) of radius and height that follow each other.

    The outside is on the right of a piece, seen with the radius to the right and the height upwards.
    """
    turn = 2 * np.pi * np.arange(segments) / segments
    vertices, normals, faces, start = [], [], [], 0
    for piece in pieces:
        slope = np.gradient(piece, axis=0, edge_order=min(2, len(piece) - 1))
        across = np.stack([slope[:, 1], -slope[:, 0]], axis=-1) / np.linalg.norm(slope, axis=1, keepdims=True)
        for profile, into in ((piece, vertices), (across, normals)):
            r, y = profile.T[..., None]
            into.append(np.stack([r * np.cos(turn), np.broadcast_to(y, (len(r), segments)), r * np.sin(turn)], -1))
        i, j = np.meshgrid(np.arange(len(piece) - 1), np.arange(segments), indexing="ij")
        a, b = start + i * segments + j, start + i * segments + (j + 1) % segments
        for corners in ((a, a + segments, b), (b, a + segments, b + segments)):
            faces.append(np.stack(corners, axis=-1).reshape(-1, 3))
        start += len(piece) * segments
    vertices, normals, faces = (np.concatenate([x.reshape(-1, 3) for x in xs]) for xs in (vertices, normals, faces))
    return _without_slivers(vertices, normals, faces)


def biconvex(radius_m: float, half_width_m: float, half_edge_m: float) -> Mesh:
    """A lens of two equal spherical faces with a cylindrical edge; its axis is z."""
    angle = np.linspace(0, np.arcsin(half_width_m / radius_m), 64)
    cap = np.stack([radius_m * np.sin(angle), radius_m * (np.cos(angle) - np.cos(angle[-1])) + half_edge_m], axis=-1)
    below = cap * [1, -1]
    edge = np.array([below[-1], cap[-1]])
    upright = lathe(below, edge, cap[::-1])
    vertices, normals = (x[:, [0, 2, 1]] * [1, 1, -1] for x in (upright.vertices, upright.normals))
    return Mesh(vertices, normals, upright.faces)


def triangular_prism(base_m: float, height_m: float, length_m: float) -> Mesh:
    """A prism along y whose cross-section is an isosceles triangle with its base at +z."""
    triangle = [(-base_m / 2, height_m / 2), (base_m / 2, height_m / 2), (0.0, -height_m / 2)]
    corners = np.array([[x, y, z] for x, z in triangle for y in (-length_m / 2, length_m / 2)])
    return _flat(corners[ConvexHull(corners).simplices])


def icosphere(radius_m: float) -> Mesh:
    """A ball of 320 facets with the normals of the sphere at its corners."""
    golden = (1 + 5**0.5) / 2
    corners = [[0, a, b * golden] for a in (-1, 1) for b in (-1, 1)]
    points = np.array([np.roll(c, k) for c in corners for k in range(3)]) / np.hypot(1, golden)
    for _ in range(2):
        hull = ConvexHull(points)
        edges = np.unique(np.sort(hull.simplices[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0)
        middle = points[edges].sum(axis=1)
        points = np.concatenate([points, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
    faces = ConvexHull(points).simplices
    return _without_slivers(radius_m * points, points, _outwards(points, faces))


def bottle_with_water() -> dict[str, tuple[Mesh, dict[str, Any]]]:
    """Surfaces of a closed glass bottle, filled to a third: name -> mesh and BSDF. Its axis is y."""
    wall, level, shoulder = 0.002, -0.01, np.linspace(0, 1, 48)

    def profile(margin: float, below: float | None = None, above: float | None = None) -> list[np.ndarray]:
        body, neck, base, top = 0.03 - margin, 0.012 - margin, -0.04 + margin, 0.045 - margin
        curve = np.stack([body - (body - neck) * shoulder**2 * (3 - 2 * shoulder), 0.01 + 0.02 * shoulder], axis=-1)
        side = np.concatenate([[[body, base]], curve, [[neck, top]]])
        if below is not None:
            return [np.array([[0, base], [body, base]]), np.array([[body, base], [body, below]])]
        if above is not None:
            side[0, 1] = above
            return [side, np.array([[neck, top], [0, top]])]
        return [np.array([[0, base], [body, base]]), side, np.array([[neck, top], [0, top]])]

    surface = np.array([[0.03 - wall, level], [0, level]])
    return {
        "bottle": (lathe(*profile(0.0)), GLASS),
        "full": (lathe(*profile(wall, below=level)), WATER_IN_GLASS),
        "empty": (lathe(*profile(wall, above=level)), AIR_IN_GLASS),
        "level": (lathe(surface), WATER),
    }


def _flat(triangles: np.ndarray) -> Mesh:
    """A closed convex mesh of triangles (m, 3, 3) around the origin, each with its own normal."""
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    vertices = triangles.reshape(-1, 3)
    faces = _outwards(vertices, faces)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normals = np.empty_like(vertices)
    normals[faces] = (normal / np.linalg.norm(normal, axis=1, keepdims=True))[:, None]
    return Mesh(vertices, normals, faces)


def _outwards(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces of a convex mesh around the origin, turned so that they are counter-clockwise from outside."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    inwards = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    return np.where(inwards[:, None], faces[:, ::-1], faces)


def _without_slivers(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> Mesh:
    """The mesh without triangles of no area, which a lathe makes on its axis."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return Mesh(vertices, normals, faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-15])


# ---- The reference ----------------------------------------------------------------------------------


def forward_flux(scene: Any, rig: Rig, rays: int) -> Flux:
    """Flux by forward tracing in a mitsuba.Scene, from so many rays, rounded up to whole batches."""
    batches = max(2, -(-rays // BATCH))
    counts = np.zeros((batches, len(RECEIVERS), MAX_INTERACTIONS + 1))
    for k in range(batches):
        points, interactions, weight = _landings(scene, rig, k)
        index = receiver_of(points) * (MAX_INTERACTIONS + 1) + interactions
        counts[k] = np.bincount(index, weight / BATCH, counts[k].size).reshape(counts[k].shape)
    counts[..., 0] = 0  # light that came straight
    total, by_wall = counts.sum(axis=(1, 2)), counts.sum(axis=2)
    error, wall_error = (x.std(axis=0, ddof=1) / np.sqrt(batches) / total.mean() for x in (total, by_wall))
    by_number = counts.mean(axis=0).sum(axis=0)[1:]
    shown = 1 + int(np.flatnonzero(by_number > 1e-5)[-1])
    by_number = np.append(by_number[: shown - 1], by_number[shown - 1 :].sum())
    return Flux(
        total=round(float(total.mean()), 7),
        standard_error=float(f"{error:.2g}"),
        receivers={k: round(float(x), 7) for k, x in zip(RECEIVERS, by_wall.mean(axis=0), strict=True)},
        receiver_error=float(f"{wall_error.max():.2g}"),
        interactions=[round(float(x), 7) for x in by_number],
    )


def _landings(scene: Any, rig: Rig, batch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the rays of a batch land: places (n, 3), numbers of delta interactions, weights (n,)."""
    import drjit as dr
    import mitsuba as mi

    # A lattice that fills the square evenly (Roberts 2018), shifted at random for each batch
    shift = np.random.default_rng(batch).random(2)
    square = (np.arange(BATCH)[:, None] * [0.7548776662466927, 0.5698402909980532] + shift) % 1.0
    p = rig.projector
    at = (square * [p.width, p.height] - [p.cx, p.cy]) / [p.fx, p.fy]
    along = np.column_stack([at, np.ones(BATCH)]) @ rig.T_world_projector[:3, :3].T
    ray = mi.Ray3f(mi.Point3f(*map(float, rig.T_world_projector[:3, 3])), dr.normalize(mi.Vector3f(along.T)))
    point, number, weight = _follow(scene, ray, mi.PCG32(BATCH, batch), dr.opaque(mi.UInt32, MAX_INTERACTIONS))
    dr.eval(point, number, weight)
    return np.array(point).T, np.array(number), np.array(weight)


def _follow(scene: Any, ray: Any, rng: Any, most: Any) -> tuple[Any, Any, Any]:
    """Landing place, number of delta interactions and weight of each ray; the weight of a lost one is 0."""
    import drjit as dr
    import mitsuba as mi

    context = mi.BSDFContext(mi.TransportMode.Importance)
    lanes = dr.width(ray.d)

    def step(ray: Any, rng: Any, point: Any, number: Any, weight: Any, active: Any) -> tuple[Any, ...]:
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        weight = dr.select(active & ~si.is_valid(), 0, weight)
        bsdf = si.bsdf(ray)
        delta = active & si.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
        point = dr.select(active & ~delta, si.p, point)
        xi = mi.Point2f(rng.next_float32(), rng.next_float32())
        bs, ratio = bsdf.sample(context, si, rng.next_float32(), xi, delta)
        weight = dr.select(delta, weight * ratio[0], weight)
        weight = dr.select(delta & (number >= most), 0, weight)
        number = dr.select(delta, number + 1, number)
        wo = si.to_world(bs.wo)
        ray = mi.Ray3f(si.p + dr.copysign(OFFSET_M, dr.dot(wo, si.n)) * si.n, wo)
        return ray, rng, point, number, weight, delta & (weight > 0)

    start = (dr.zeros(mi.Point3f, lanes), dr.zeros(mi.UInt32, lanes), dr.ones(mi.Float, lanes))
    state = dr.while_loop((ray, rng, *start, dr.full(mi.Bool, True, lanes)), lambda *state: state[-1], step)
    return state[2:5]


# ---- What transport traces --------------------------------------------------------------------------


def traced_flux(scene: Scene, rig: Rig, seed: int = 1) -> tuple[dict[str, float], float]:
    """Flux by wall as `transport` traces it, in fractions of the projector's power, and the part that its triangles
    carry; photons carry the rest."""
    from rangesim.light_transport.caustic_sheets import trace_sheets
    from rangesim.light_transport.traced_scene import TracedScene

    sheets = trace_sheets(TracedScene.of(scene.mitsuba, rig), rig.projector_power_w, seed)
    assert sheets is not None
    middle = sheets.position[sheets.triangles].mean(axis=1)
    flux = np.bincount(receiver_of(middle), sheets.flux, len(RECEIVERS)) / rig.projector_power_w
    return dict(zip(RECEIVERS, flux.tolist(), strict=True)), sheets.in_triangles


def load() -> dict[str, Flux]:
    """The fluxes that `make` wrote, by scene."""
    return {name: Flux(**entry) for name, entry in json.loads(REFERENCE.read_text())["scenes"].items()}


def make(rays: int, chosen: str | None) -> None:
    """Trace all scenes or one of them, print their fluxes, and write them."""
    rig = rig_of()
    content = json.loads(REFERENCE.read_text()) if chosen else {"command": "", "scenes": {}}
    content["command"] = f"python benchmarks/caustic_energy.py make --rays {rays}"
    with tempfile.TemporaryDirectory() as folder:
        for name in [chosen] if chosen else GLASSWARE:
            flux = forward_flux(scene_of(name, Path(folder)).mitsuba, rig, rays)
            content["scenes"][name] = vars(flux)
            print(f"{name:<20} {flux.total:.6f} +- {flux.standard_error:.1e}; "
                  + ", ".join(f"{k} {x:.5f}" for k, x in flux.receivers.items())
                  + f" +- {flux.receiver_error:.1e}; by number of interactions "
                  + ", ".join(f"{x:.4f}" for x in flux.interactions[:8]), flush=True)  # fmt: skip
    REFERENCE.write_text(json.dumps(content, indent=1) + "\n")


def compare() -> dict[str, float]:
    """Print the table and return the figures of the last line."""
    rig, reference = rig_of(), load()
    totals, walls = [], []
    print(f"{'scene':<20} {'flux':>9} {'error':>8} {'+-':>7}   worst wall {'error':>8} {'+-':>7}")
    with tempfile.TemporaryDirectory() as folder:
        for name, expected in reference.items():
            ours, in_triangles = traced_flux(scene_of(name, Path(folder)), rig)
            totals.append(sum(ours.values()) / expected.total - 1)
            off = {k: (x - expected.receivers[k]) / expected.total for k, x in ours.items()}
            worst = max(off, key=lambda k: abs(off[k]))
            walls.append(off[worst])
            print(f"{name:<20} {sum(ours.values()):>9.6f} {totals[-1]:>+8.3%} {expected.standard_error:>7.3%}   "
                  f"{worst:<10} {walls[-1]:>+8.3%} {expected.receiver_error:>7.3%}   "
                  f"{in_triangles:.2%} in triangles", flush=True)  # fmt: skip
    return {"max_flux_error": round(max(map(abs, totals)), 5), "max_receiver_error": round(max(map(abs, walls)), 5)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=("make", "compare"), default="compare")
    parser.add_argument("--rays", type=int, default=32_000_000, help="of each scene, of `make`")
    parser.add_argument("--scene", choices=GLASSWARE, help="of `make`, alone")
    args = parser.parse_args()
    if args.what == "make":
        make(args.rays, args.scene)
    else:
        print(json.dumps(compare()))


if __name__ == "__main__":
    main()
