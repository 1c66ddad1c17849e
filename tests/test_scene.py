# SPDX-License-Identifier: Apache-2.0
"""Scenes from XML, dictionaries and meshes: cameras, names, material classes, and refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rangesim
from rangesim.errors import FileFormatError
from rangesim.light_transport.backend import select_variant
from rangesim.scene.materials import material_class

SCENES = Path(__file__).resolve().parent.parent / "scenes"
SENSOR = """<sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0,-3,0" target="0,0,0" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="48"/></film></sensor>"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.xml")), ids=lambda p: p.stem)
def test_shipped_scenes_load_and_show_something(path: Path) -> None:
    scene = rangesim.load_scene(path)
    rig = scene.rig(width=64, height=48)
    signals = rangesim.transport(scene, rig, [], spp=4)
    assert np.isfinite(signals.truth.z).mean() > 0.7
    assert signals.energy.direct.mean() > 0
    assert all(instance.name for instance in scene.instances)


def test_shipped_tabletop_holds_every_material_class_of_the_comparison() -> None:
    scene = rangesim.load_scene(SCENES / "tabletop.xml")
    assert {"matte", "glossy", "mirror", "transparent"} == {i.material for i in scene.instances}


def test_the_camera_is_the_scene_s_sensor() -> None:
    scene = rangesim.load_scene(SCENES / "plane.xml")
    assert (scene.camera.width, scene.camera.height) == (640, 480)
    assert scene.camera.fx == pytest.approx(320 / np.tan(np.radians(25)), rel=1e-6)
    expected = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]]  # x right, y down, z along world y
    np.testing.assert_allclose(scene.T_world_camera, expected, atol=1e-6)
    assert scene.working_distance_m == pytest.approx(1.0)


def test_the_rig_s_projector_converges_on_the_working_distance() -> None:
    rig = rangesim.load_scene(SCENES / "plane.xml").rig()
    assert rig.baseline_m == pytest.approx(0.2)
    target = np.linalg.inv(rig.T_camera_projector) @ [0, 0, 1, 1]
    np.testing.assert_allclose(rig.projector.project(target[:3]), [640, 400], atol=1e-9)


def test_mitsuba_s_own_cornell_box_runs_as_it_is() -> None:
    import mitsuba as mi

    select_variant()
    scene = rangesim.load_scene(mi.cornell_box())
    signals = rangesim.transport(scene, scene.rig(width=64, height=64), [rangesim.IdealToF()], spp=4)
    assert signals.energy.ambient.max() > 0
    assert signals.energy.direct.mean() > 0
    assert np.isfinite(signals.truth.z).mean() > 0.8


def test_a_user_s_scene_with_integrator_and_shared_materials(tmp_path: Path) -> None:
    xml = f"""<scene version="3.0.0"><integrator type="path"/>{SENSOR}
        <bsdf type="twosided" id="paint"><bsdf type="diffuse"/></bsdf>
        <bsdf type="dielectric" id="milk"><string name="material_class" value="translucent"/></bsdf>
        <emitter type="constant"/>
        <shape type="sphere" id="ball"><string name="material_class" value="glossy"/><ref id="paint"/></shape>
        <shape type="sphere"><ref id="milk"/></shape>
        <shape type="cube"><ref id="paint"/></shape>
        <shape type="cube"><bsdf type="mask"><float name="opacity" value="0.5"/><bsdf type="conductor"/></bsdf></shape>
        </scene>"""
    scene = rangesim.load_scene(write(tmp_path / "user.xml", xml))
    assert [i.material for i in scene.instances] == ["glossy", "translucent", "matte", "mirror"]
    names = [i.name for i in scene.instances]
    assert names[0] == "ball"
    assert len(set(names)) == 4


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb", ".stl"])
def test_a_bare_mesh_stands_on_a_table(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / "mesh.obj", TETRAHEDRON)
    if suffix != ".obj":
        import trimesh

        mesh = trimesh.load_mesh(path)
        path = tmp_path / f"mesh{suffix}"
        mesh.export(path)
    scene = rangesim.load_scene(path, material="mirror")
    assert {(i.name, i.material) for i in scene.instances} == {("table", "matte"), ("mesh", "mirror")}
    truth = rangesim.transport(scene, scene.rig(width=64, height=48), [], spp=1).truth
    assert (truth.instance == [i.name for i in scene.instances].index("mesh")).mean() > 0.02


BROKEN: dict[str, tuple[str, str]] = {
    "broken.xml": ("<scene version='3.0.0'><shape", "no scene Mitsuba can load"),
    "no_sensor.xml": ('<scene version="3.0.0"><shape type="sphere"/></scene>', "a perspective sensor, got none"),
    "empty.xml": (f'<scene version="3.0.0">{SENSOR}</scene>', "at least one shape"),
    "unknown.xml": (f'<scene version="3.0.0">{SENSOR}<shape type="spheer"/></scene>', "spheer"),
    "class.xml": (
        f'<scene version="3.0.0">{SENSOR}<shape type="sphere">'
        '<string name="material_class" value="glosy"/></shape></scene>',
        "did you mean 'glossy'",
    ),
    "orthographic.xml": (
        '<scene version="3.0.0"><sensor type="orthographic"/><shape type="sphere"/></scene>',
        "to be perspective",
    ),
    "points.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no faces"),
    "notes.txt": ("hello", "expected a scene"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_get_one_clear_sentence(tmp_path: Path, name: str) -> None:
    text, message = BROKEN[name]
    with pytest.raises(FileFormatError, match=message) as caught:
        rangesim.load_scene(write(tmp_path / name, text))
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_an_unknown_material(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="does not exist"):
        rangesim.load_scene(tmp_path / "none.xml")
    with pytest.raises(ValueError, match="names its own materials"):
        rangesim.load_scene(SCENES / "plane.xml", material="mirror")
    with pytest.raises(ValueError, match="did you mean 'mirror'"):
        rangesim.load_scene(write(tmp_path / "mesh.obj", TETRAHEDRON), material="miror")


@pytest.mark.parametrize(
    ("bsdf", "properties", "nested", "expected"),
    [
        ("diffuse", {}, None, "matte"),
        ("roughconductor", {"alpha": 0.01}, None, "mirror"),
        ("roughconductor", {"alpha": 0.3}, None, "glossy"),
        ("roughdielectric", {"alpha": 0.02}, None, "transparent"),
        ("roughdielectric", {}, None, "translucent"),
        ("twosided", {}, "glossy", "glossy"),
        ("hair", {}, None, "other"),
    ],
)
def test_material_classes(bsdf: str, properties: dict[str, Any], nested: str | None, expected: str) -> None:
    assert material_class(bsdf, properties, nested) == expected
