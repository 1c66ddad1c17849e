# SPDX-License-Identifier: Apache-2.0
"""Which shapes of a scene are objects, and which bear, back or surround them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import rangesim
from rangesim import Scene, load_scene, load_signals, save_signals
from rangesim.environment.backend import select_variant
from rangesim.errors import FileFormatError
from rangesim.experiment import Experiment
from rangesim.pipeline.experiment_run import carry_out

select_variant()
T = mi.ScalarTransform4f
GREY = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
GLASS = {"type": "dielectric", "int_ior": 1.5}
THIN = 0.004
"""Metres, thickness of the walls of bins."""


def box(x: float, y: float, z: float, centre: list[float], turn: float = 0.0) -> dict[str, Any]:
    to_world = T().translate(centre).rotate([0, 0, 1], turn).scale([x / 2, y / 2, z / 2])
    return {"type": "cube", "to_world": to_world, "bsdf": GREY}


def sheet(x: float, y: float, centre: list[float], tilt: float = 0.0, bsdf: Any = GREY) -> dict[str, Any]:
    """A rectangle, horizontal, or tilted about the x axis by some degrees."""
    return {
        "type": "rectangle",
        "to_world": T().translate(centre).rotate([1, 0, 0], tilt).scale([x / 2, y / 2, 1]),
        "bsdf": bsdf,
    }


def ball(radius: float, centre: list[float], bsdf: Any = GREY) -> dict[str, Any]:
    return {"type": "sphere", "center": centre, "radius": radius, "bsdf": bsdf}


def post(radius: float, foot: list[float], height: float, bsdf: Any = GREY) -> dict[str, Any]:
    return {"type": "cylinder", "radius": radius, "p0": foot, "p1": [*foot[:2], foot[2] + height], "bsdf": bsdf}


def boards(x: float, y: float, z: float) -> dict[str, dict[str, Any]]:
    """The bottom and the four walls of a bin."""
    sides = {
        f"side{i}": box(*(size), [i % 2 * (i - 2) * x / 2, (1 - i % 2) * (i - 1) * y / 2, z / 2])
        for i, size in enumerate([(x, THIN, z), (THIN, y, z)] * 2)
    }
    return {"bottom": box(x, y, THIN, [0, 0, THIN / 2]), **sides}


def scene(
    shapes: dict[str, Any], origin: tuple[float, ...] = (0.1, -0.6, 0.9), target: tuple[float, ...] = (0, 0, 0)
) -> Scene:
    camera = {
        "type": "perspective",
        "fov": 50,
        "to_world": T().look_at(list(origin), list(target), [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 40, "height": 30},
    }
    return load_scene({"type": "scene", "sensor": camera, **shapes})


def joined(parts: dict[str, dict[str, Any]], path: Path) -> dict[str, Any]:
    """One mesh of several shapes."""
    import trimesh

    meshes = []
    for part in parts.values():
        matrix = np.array(part["to_world"].matrix)
        meshes.append(trimesh.creation.box((2, 2, 2)).apply_transform(matrix))
    trimesh.util.concatenate(meshes).export(path)
    return {"type": "ply", "filename": str(path), "bsdf": GREY}


def objects(of: Scene) -> set[str]:
    return {i.name for i in of.instances if i.is_object}


PARTS = {"bar": box(0.1, 0.05, 0.04, [0.1, 0.05, 0.03], 30), "nut": ball(0.03, [-0.15, -0.05, 0.034])}
TABLE = {"table": box(1.2, 0.8, 0.04, [0, 0, -0.02])}
WALL = {"wall": sheet(4, 3, [0, 0.6, 0.5], 90)}
FLOOR = {"floor": sheet(4, 4, [0, 0, -0.001])}
BELT = {"belt": box(2, 0.4, 0.05, [0, 0, 0.35])}
PANE = {"pane": sheet(1.2, 0.8, [0, -0.2, 0.4], 90, {"type": "thindielectric"})}
LAMP = {"lamp": ball(0.05, [0, 0, 0.5]) | {"emitter": {"type": "area", "radiance": 1.0}}}
LEGS = {f"leg{i}": box(0.05, 0.05, 0.7, [0.5 * (-1) ** i, 0.3 * (-1) ** (i // 2), -0.39]) for i in range(4)}


@pytest.mark.parametrize(
    ("shapes", "expected"),
    [
        ({**FLOOR, **boards(0.6, 0.4, 0.15), **PARTS}, "bar nut"),
        ({**FLOOR, **boards(0.6, 0.4, 0.15), "bar": PARTS["bar"]}, "bar"),
        ({**FLOOR, "a": box(0.5, 0.4, 0.3, [0, 0, 0.15]), "b": box(0.4, 0.35, 0.25, [0, 0, 0.425], 9)}, "a b"),
        ({**TABLE, "plate": box(0.24, 0.24, 0.02, [0, 0, 0.01], 10)}, "plate"),
        ({**TABLE, "plate": box(0.24, 0.24, 0.02, [0, 0, 0.01], 10), "apple": ball(0.04, [0, 0, 0.06])}, "plate apple"),
        ({**TABLE, **WALL, "box": box(0.2, 0.2, 0.2, [0, 0, 0.1]), "ball": ball(0.05, [0, 0, 0.25])}, "box ball"),
        ({**FLOOR, **BELT, "parcel": box(0.2, 0.15, 0.1, [0, 0, 0.425], 20)}, "parcel"),
        ({**TABLE, "glass": ball(0.1, [0, 0, 0.1], GLASS), "water": ball(0.06, [0, 0, 0.08])}, "glass water"),
        ({**TABLE, **WALL, **PANE, **PARTS}, "pane bar nut"),
        ({**WALL, "board": sheet(0.4, 0.4, [0, 0.1, 0.3], 80)}, "board"),
        ({**LAMP, **TABLE, **PARTS}, "bar nut"),
        ({"nut": PARTS["nut"]}, "nut"),
        (WALL, ""),
        ({**WALL, **FLOOR}, ""),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_what_bears_backs_or_surrounds_is_no_object(shapes: dict[str, Any], expected: str) -> None:
    assert objects(scene(shapes)) == set(expected.split())


@pytest.mark.parametrize("floor", [FLOOR, {}])
def test_a_bin_or_a_room_of_one_mesh_is_no_object(floor: dict[str, Any], tmp_path: Path) -> None:
    mesh = joined(boards(0.6, 0.4, 0.15), tmp_path / "bin.ply")
    assert objects(scene({**floor, "bin": mesh, **PARTS})) == {"bar", "nut"}
    assert objects(scene({**floor, "bin": mesh, "bar": PARTS["bar"]})) == {"bar"}


def test_a_table_with_legs_is_as_flat_as_its_top_and_a_hollow_vessel_is_not_flat(tmp_path: Path) -> None:
    import trimesh

    table = joined({**TABLE, **LEGS}, tmp_path / "table.ply")
    assert objects(scene({"table": table, "cup": post(0.04, [0, 0, 0], 0.1)})) == {"cup"}
    profile = np.array([[0, 0], [0.05, 0], [0.05, 0.2], [0.048, 0.2], [0.048, 0.002], [0, 0.002]])
    trimesh.creation.revolve(profile).export(tmp_path / "vase.ply")
    vase = {"type": "ply", "filename": str(tmp_path / "vase.ply"), "bsdf": GREY}
    before = scene({**TABLE, "vase": vase, "ball": ball(0.03, [0, -0.12, 0.03])}, (0, -0.7, 0.2), (0, 0, 0.1))
    assert objects(before) == {"vase", "ball"}


def test_a_ring_around_a_ball_is_no_container(tmp_path: Path) -> None:
    import trimesh

    trimesh.creation.torus(0.1, 0.03).apply_translation([0, 0, 0.03]).export(tmp_path / "ring.ply")
    ring = {"type": "ply", "filename": str(tmp_path / "ring.ply"), "bsdf": GREY}
    assert objects(scene({**TABLE, "ring": ring, "ball": ball(0.03, [0, 0, 0.03])})) == {"ring", "ball"}


@pytest.mark.parametrize(
    ("name", "background", "count"),
    [
        ("tabletop", {"table", "wall"}, 9),
        ("glassware", {"table", "wall"}, 5),
        ("matte", {"table", "wall"}, 5),
        ("cornell", {"lamp", "floor", "ceiling", "back_wall", "left_wall", "right_wall"}, 2),
        ("corner", {"left_wall", "right_wall"}, 0),
        ("plane", {"wall"}, 0),
    ],
)
def test_objects_of_the_scenes_of_the_package(name: str, background: set[str], count: int) -> None:
    loaded = load_scene(name)
    assert {i.name for i in loaded.instances if not i.object_name} == background
    assert len({i.object_name for i in loaded.instances if i.object_name}) == count


def test_parts_of_one_thing_are_one_object_and_files_survive(tmp_path: Path) -> None:
    parts = {"mug": post(0.05, [0, 0, 0], 0.12), "lid": ball(0.05, [0, 0, 0.12]) | {"part_of": "mug"}, **PARTS}
    loaded = scene({**TABLE, **parts})
    signals = rangesim.transport(loaded, loaded.rig(), [rangesim.IdealToF()], spp=1, caustics=False, glint=False)
    truth = signals.truth
    assert truth.object_names == ("mug", "bar", "nut")
    mug = truth.objects()["mug"]
    assert mug.sum() == sum((truth.instance == truth.instance_names.index(name)).sum() for name in ("mug", "lid")) > 0
    assert set(np.unique(truth.object_index)) == {-1, 0, 1, 2}
    save_signals(signals, tmp_path / "signals.npz")
    assert load_signals(tmp_path / "signals.npz").truth.instance_objects == truth.instance_objects
    older = replace(signals, truth=replace(truth, instance_objects=()))  # as files that do not tell
    save_signals(older, tmp_path / "older.npz")
    again = load_signals(tmp_path / "older.npz").truth
    assert (again.object_names, again.objects()) == ((), {})
    assert (again.object_index == -1).all()


def test_a_scene_states_its_objects() -> None:
    shapes = {**TABLE, **PARTS}
    shapes["table"] = shapes["table"] | {"is_object": True}
    shapes["nut"] = shapes["nut"] | {"is_object": False}
    assert objects(scene(shapes)) == {"table", "bar"}
    for key, value, words in (("is_object", "no", "true or false"), ("part_of", "", "the name of a thing")):
        with pytest.raises(FileFormatError, match=f"expected {key} to be {words}"):
            scene({**TABLE, "nut": PARTS["nut"] | {key: value}})
    two = {"a": PARTS["bar"] | {"is_object": True}, "b": PARTS["nut"] | {"is_object": False, "part_of": "a"}}
    with pytest.raises(FileFormatError, match="one is_object for all parts of 'a'"):
        scene(two)


def test_a_user_states_the_objects() -> None:
    loaded = load_scene("tabletop")
    chosen = loaded.with_objects(["mug_lid", "table"])
    assert {i.name for i in chosen.instances if i.is_object} == {"mug", "mug_lid", "table"}
    with pytest.raises(ValueError, match=r"objects of the scene 'tabletop', got 'tabel' \(did you mean 'table'\?\)"):
        loaded.with_objects(["tabel"])
    with pytest.raises(ValueError, match="did you mean 'carton'"):
        carry_out(Experiment("tabletop", width=40, height=30, objects=("cartoon",)))
