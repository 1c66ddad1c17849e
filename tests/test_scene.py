# SPDX-License-Identifier: Apache-2.0
"""Scenes from XML, dictionaries and meshes: cameras, names, material classes, and refusals."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rangesim
from rangesim.environment.backend import select_variant
from rangesim.errors import FileFormatError, RangesimWarning
from rangesim.files.bundled_scenes import scene_names
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
    with pytest.warns(RangesimWarning, match=r"colours of 3 materials \(white, green, red\)"):
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


def test_a_mesh_in_millimetres(tmp_path: Path) -> None:
    path = write(tmp_path / "mesh.obj", TETRAHEDRON)
    metres, millimetres = rangesim.load_scene(path), rangesim.load_scene(path, unit_m=0.001)
    assert millimetres.working_distance_m == pytest.approx(0.001 * metres.working_distance_m, rel=1e-3)
    with pytest.raises(ValueError, match="unit_m to be positive and finite metres"):
        rangesim.load_scene(path, unit_m=0.0)
    with pytest.raises(ValueError, match="scale the shapes"):
        rangesim.load_scene(SCENES / "plane.xml", unit_m=0.001)


BROKEN: dict[str, tuple[str, str]] = {
    "broken.xml": ("<scene version='3.0.0'><shape", "no scene that Mitsuba can load"),
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
    "mirrored.xml": (
        f'<scene version="3.0.0">{SENSOR}<shape type="sphere"/></scene>'.replace("<lookat", "<scale x='-1'/><lookat"),
        "negative scale",
    ),
    "instance.xml": (
        f'<scene version="3.0.0">{SENSOR}<shape type="shapegroup" id="g"><shape type="sphere"/></shape>'
        '<shape type="instance"><ref id="g"/></shape></scene>',
        "replace them by copies",
    ),
    "fog.xml": (
        f'<scene version="3.0.0">{SENSOR}<shape type="cube"><bsdf type="dielectric"/>'
        '<medium type="homogeneous" name="interior"/></shape></scene>',
        "boundaries of matched index",
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


def test_a_scene_that_comes_along_is_found_by_name_from_anywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plane").mkdir()  # a result of that name is no scene
    assert scene_names() == ("cornell", "corner", "glassware", "matte", "plane", "street", "tabletop")
    scene = rangesim.load_scene("plane")
    assert scene.name == "plane"
    assert scene.source is not None
    assert scene.source.samefile(SCENES / "plane.xml")
    vessels = rangesim.load_scene("glassware")  # its meshes come along
    assert {"bottle_left", "tumbler"} <= {one.name for one in vessels.instances}


def test_a_file_of_that_name_goes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plane").write_text("mine")
    with pytest.raises(FileFormatError, match=r"got plane\.$"):
        rangesim.load_scene("plane")


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (
            "tabeltop",
            "tabeltop does not exist, and no scene of that name comes with rangesim (did you mean 'tabletop'?); "
            "those are cornell, corner, glassware, matte, plane, street, tabletop.",
        ),
        ("scenes/plane.xml", "; the scene that comes with rangesim is named plane, without folder and suffix."),
        ("part.ply", "expected a scene or mesh file, but part.ply does not exist."),
    ],
)
def test_an_unknown_name_is_told_the_known_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileFormatError, match=re.escape(sentence) + "$"):
        rangesim.load_scene(name)


CLASSES: list[tuple[dict[str, Any], str]] = [
    ({"type": "diffuse"}, "matte"),
    ({"type": "twosided", "b": {"type": "roughplastic"}}, "glossy"),
    ({"type": "plastic"}, "glossy"),
    ({"type": "roughconductor", "alpha": 0.01}, "mirror"),
    ({"type": "roughconductor", "alpha_u": 0.01, "alpha_v": 0.02}, "mirror"),
    ({"type": "roughconductor", "alpha": 0.3}, "glossy"),
    ({"type": "mask", "opacity": 0.5, "b": {"type": "conductor"}}, "mirror"),
    ({"type": "mask", "opacity": {"type": "checkerboard"}, "b": {"type": "conductor"}}, "mirror"),
    ({"type": "mask", "opacity": {"type": "checkerboard"}, "b": {"type": "plastic"}}, "glossy"),
    ({"type": "mask", "opacity": {"type": "checkerboard"}, "b": {"type": "diffuse"}}, "matte"),
    ({"type": "mask", "opacity": {"type": "checkerboard"}, "b": {"type": "dielectric"}}, "transparent"),
    ({"type": "mask", "opacity": 0.5, "b": {"type": "thindielectric"}}, "transparent"),
    ({"type": "dielectric"}, "transparent"),
    ({"type": "thindielectric"}, "transparent"),
    ({"type": "roughdielectric", "alpha": 0.02}, "transparent"),
    ({"type": "roughdielectric"}, "translucent"),
    ({"type": "principled"}, "glossy"),
    ({"type": "principled", "spec_trans": 1.0, "roughness": 0.01}, "transparent"),
    ({"type": "principled", "metallic": 1.0, "roughness": 0.01}, "mirror"),
    ({"type": "null"}, "other"),
]


@pytest.mark.parametrize(("bsdf", "expected"), CLASSES, ids=lambda x: x if isinstance(x, str) else x["type"])
def test_material_classes(bsdf: dict[str, Any], expected: str) -> None:
    import mitsuba as mi

    select_variant()
    assert material_class(mi.load_dict(bsdf)) == expected


# ---- Cameras as Mitsuba means them ------------------------------------------------------------------


def film(extra: str = "") -> str:
    return f'<film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="48"/>{extra}</film>'


OFFSET = '<float name="principal_point_offset_x" value="0.2"/><float name="principal_point_offset_y" value="-0.1"/>'
CROP = "".join(
    f'<integer name="crop_{name}" value="{value}"/>'
    for name, value in {"width": 24, "height": 32, "offset_x": 8, "offset_y": 4}.items()
)
CAMERAS = {
    "plain": f'<sensor type="perspective"><float name="fov" value="40"/>{film()}</sensor>',
    "offset": f'<sensor type="perspective"><float name="fov" value="40"/>{OFFSET}{film()}</sensor>',
    "crop": f'<sensor type="perspective"><float name="fov" value="40"/>{OFFSET}{film(CROP)}</sensor>',
    "fov_axis": '<sensor type="perspective"><float name="fov" value="40"/><string name="fov_axis" value="y"/>'
    f"{film()}</sensor>",
    "thinlens": '<sensor type="thinlens"><float name="fov" value="40"/><float name="aperture_radius" value="1e-6"/>'
    f'<float name="focus_distance" value="2"/>{film()}</sensor>',
}


@pytest.mark.parametrize("name", CAMERAS)
def test_rays_through_pixels_are_those_of_mitsuba_s_sensor(tmp_path: Path, name: str) -> None:
    import mitsuba as mi

    xml = f'<scene version="3.0.0">{CAMERAS[name]}<shape type="sphere"/></scene>'
    scene = rangesim.load_scene(write(tmp_path / "scene.xml", xml))
    for x, y in ((0.1, 0.2), (0.5, 0.5), (0.9, 0.7)):
        theirs = scene.mitsuba.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5, 0.5))[0].d
        pixel = [x * scene.camera.width, y * scene.camera.height]
        ours = scene.T_world_camera[:3, :3] @ scene.camera.directions(pixel)
        np.testing.assert_allclose(ours / np.linalg.norm(ours), np.array(theirs).ravel(), atol=2e-6)


def test_the_projector_covers_an_off_centre_view(tmp_path: Path) -> None:
    to_world = '<transform name="to_world"><scale value="20"/><translate z="2"/></transform>'
    xml = f'<scene version="3.0.0">{CAMERAS["offset"]}<shape type="rectangle">{to_world}</shape></scene>'
    scene = rangesim.load_scene(write(tmp_path / "scene.xml", xml))
    assert rangesim.transport(scene, scene.rig(), [], spp=1).truth.projector_visible.mean() > 0.99


def test_one_side_alone_keeps_the_aspect_ratio() -> None:
    scene = rangesim.load_scene(SCENES / "plane.xml")
    for rig in (scene.rig(width=320), scene.rig(height=240)):
        assert (rig.camera.width, rig.camera.height) == (320, 240)
    with pytest.raises(ValueError, match="width to be a whole number of at least 1"):
        scene.rig(width=0, height=4)


def test_a_second_sensor_can_be_the_camera(tmp_path: Path) -> None:
    xml = f'<scene version="3.0.0">{SENSOR}{CAMERAS["offset"]}<shape type="sphere"/></scene>'
    path = write(tmp_path / "scene.xml", xml)
    with pytest.warns(RangesimWarning, match="2 sensors, and the first becomes the camera"):
        assert rangesim.load_scene(path).camera.cx == pytest.approx(32)
    assert rangesim.load_scene(path, sensor=0).camera.cx == pytest.approx(32)
    assert rangesim.load_scene(path, sensor=1).camera.cx == pytest.approx(32 - 0.2 * 64)
    with pytest.raises(ValueError, match="sensor from 0 to 1"):
        rangesim.load_scene(path, sensor=2)


def test_a_scene_finds_no_files_of_another(tmp_path: Path) -> None:
    import trimesh

    xml = f'<scene version="3.0.0">{SENSOR}<shape type="ply"><string name="filename" value="m.ply"/></shape></scene>'
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write(tmp_path / name / "scene.xml", xml)
    trimesh.creation.box().export(tmp_path / "a" / "m.ply")
    rangesim.load_scene(tmp_path / "a" / "scene.xml")
    with pytest.raises(FileFormatError, match=r"m\.ply"):
        rangesim.load_scene(tmp_path / "b" / "scene.xml")


def test_every_load_of_smooth_meshes_gives_the_same_bytes(tmp_path: Path) -> None:
    """Eight meshes without normals, with a texture: Mitsuba's threads alone make other normals of them in each load."""
    import mitsuba as mi
    import trimesh
    from PIL import Image

    ball = trimesh.creation.icosphere(subdivisions=5)
    ball.vertices *= np.random.default_rng(0).uniform(0.8, 1.2, (len(ball.vertices), 1))
    ball.export(tmp_path / "ball.ply")
    Image.fromarray(np.arange(64, dtype=np.uint8).reshape(8, 8)).save(tmp_path / "paint.png")
    paint = '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="paint.png"/>'
    shapes = "".join(
        f"""<shape type="ply" id="{x}"><string name="filename" value="ball.ply"/><transform name="to_world">
            <scale value="0.1"/><translate x="{x / 4 - 0.9}"/></transform>{paint}</texture></bsdf></shape>"""
        for x in range(8)
    )
    path = write(tmp_path / "scene.xml", f'<scene version="3.0.0">{SENSOR}{shapes}</scene>')

    def normals() -> bytes:
        parameters = mi.traverse(rangesim.load_scene(path).mitsuba)
        return b"".join(np.array(parameters[f"{x}.vertex_normals"]).tobytes() for x in range(8))

    assert len({normals() for _ in range(4)}) == 1


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_normals_of_a_mesh_file_stay(tmp_path: Path, tilt: float) -> None:
    """Those of a ball stand on its surface, as Mitsuba's own do nearly; tilted ones are nobody's but the file's."""
    import mitsuba as mi
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3)
    normals = np.add(ball.vertices, [0.0, 0.0, tilt])
    normals = np.float32(normals / np.linalg.norm(normals, axis=1, keepdims=True))
    trimesh.Trimesh(ball.vertices, ball.faces, vertex_normals=normals, process=False).export(tmp_path / "ball.ply")
    xml = f"""<scene version="3.0.0">{SENSOR}<shape type="ply" id="ball"><string name="filename" value="ball.ply"/>
        </shape></scene>"""
    scene = rangesim.load_scene(write(tmp_path / "scene.xml", xml))
    loaded = np.array(mi.traverse(scene.mitsuba)["ball.vertex_normals"]).reshape(-1, 3)
    np.testing.assert_allclose(loaded, normals, rtol=0, atol=2e-7)


def test_a_face_without_an_area_leaves_the_normals_of_its_corners(tmp_path: Path) -> None:
    import mitsuba as mi

    square = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\nf 2 4 4\nf 3 3 3\n"
    write(tmp_path / "square.obj", square)
    xml = f"""<scene version="3.0.0">{SENSOR}<shape type="obj" id="square">
        <string name="filename" value="square.obj"/></shape></scene>"""
    scene = rangesim.load_scene(write(tmp_path / "scene.xml", xml))
    normals = np.array(mi.traverse(scene.mitsuba)["square.vertex_normals"]).reshape(-1, 3)
    np.testing.assert_allclose(normals, [[0, 0, 1]] * 4, atol=1e-6)


# ---- What a scene of another renderer holds beside ---------------------------------------------------

BALL = '<shape type="sphere"><point name="center" x="0" y="1" z="0"/></shape>'
SAMPLER = '<sampler type="independent"><integer name="sample_count" value="{}"/></sampler>'


def rendered(path: Path, sensor: str, before: str = "") -> Any:
    scene = rangesim.load_scene(write(path, f'<scene version="3.0.0">{before}{sensor}{BALL}</scene>'))
    return scene, rangesim.transport(scene, scene.rig(width=16), [], spp=2, seed=3).energy.direct


def test_an_integrator_and_a_film_that_mitsuba_lacks_are_ignored(tmp_path: Path) -> None:
    """As of mitransient; the size of the film counts."""
    plain, expected = rendered(tmp_path / "plain.xml", SENSOR)
    integrator = '<integrator type="transient_path"><integer name="max_depth" value="4"/></integrator>'
    bins = '<integer name="temporal_bins" value="400"/><float name="start_opl" value="3.5"/><rfilter type="own"/>'
    film = SENSOR.replace('"hdrfilm">', f'"transient_hdr_film">{bins}').replace("<film", SAMPLER.format(4) + "<film")
    foreign, light = rendered(tmp_path / "foreign.xml", film.replace('"independent"', '"own"'), integrator)
    assert foreign.camera == plain.camera
    np.testing.assert_array_equal(light, expected)
    assert light.max() > 0
    for wrong in ("<emitter type='transient_lamp'/>", "<bsdf type='own'/>"):
        with pytest.raises(FileFormatError, match=r"transient_lamp|own"):
            rendered(tmp_path / "wrong.xml", SENSOR, wrong)


def test_a_parameter_without_a_value_matters_only_where_it_counts(tmp_path: Path) -> None:
    _, expected = rendered(tmp_path / "plain.xml", SENSOR)
    sampled = SENSOR.replace("<film", SAMPLER.format("$spp") + "<film")
    integrator = '<integrator type="path"><boolean name="hide_emitters" value="$hide"/></integrator>'
    np.testing.assert_array_equal(rendered(tmp_path / "a.xml", sampled, integrator)[1], expected)
    given = '<default name="spp" value="64"/>'
    np.testing.assert_array_equal(rendered(tmp_path / "b.xml", sampled, given)[1], expected)
    for sensor in (SENSOR.replace('"64"', '"$width"'), sampled.replace("$spp", "$width").replace('"64"', '"$width"')):
        with pytest.raises(FileFormatError, match=r'parameter \$width has no value; put <default name="width" value'):
            rendered(tmp_path / "c.xml", sensor)
    with pytest.raises(FileFormatError, match=r"parameter \$spp has no value; put <default"):  # before it
        rendered(tmp_path / "e.xml", sampled + '<default name="spp" value="64"/>')
    (tmp_path / "part.xml").write_text(f'<scene version="3.0.0">{sampled}</scene>')
    included = rendered(tmp_path / "d.xml", '<include filename="part.xml"/>')[1]
    np.testing.assert_array_equal(included, expected)


@pytest.mark.parametrize(("radius", "focus"), [(0.05, 2.0), (0.002, 0.5), (0.2, 40.0)])
def test_an_aperture_that_is_left_out_is_told(tmp_path: Path, radius: float, focus: float) -> None:
    def lens(radius: float) -> str:
        numbers = f'<float name="aperture_radius" value="{radius}"/><float name="focus_distance" value="{focus}"/>'
        return SENSOR.replace('"perspective">', f'"thinlens">{numbers}')

    sharp, _ = rendered(tmp_path / "a.xml", lens(1e-6))
    with pytest.warns(RangesimWarning, match=rf"aperture of {radius:g} m is ignored.*focus_m={focus:g}\)"):
        wide, _ = rendered(tmp_path / "b.xml", lens(radius))
    assert wide.camera == sharp.camera


@pytest.mark.parametrize(
    ("name", "at_m", "is_told"),
    [
        *(("near_clip", 1.01, True), ("near_clip", 7.0, True), ("near_clip", 0.99, False)),
        *(("far_clip", 0.99, True), ("far_clip", 1.01, False)),
    ],
)
def test_surfaces_that_the_clipping_planes_of_mitsuba_hide_are_told(
    tmp_path: Path, name: str, at_m: float, is_told: bool, recwarn: pytest.WarningsRecorder
) -> None:
    """The wall of `plane` stands 1 m before the camera; here it is seen, wherever the planes are."""
    plane = (Path(__file__).parent.parent / "scenes" / "plane.xml").read_text()
    clip = f'<sensor type="perspective"><float name="{name}" value="{at_m}"/>'
    scene = rangesim.load_scene(write(tmp_path / "plane.xml", plane.replace('<sensor type="perspective">', clip)))
    assert scene.working_distance_m == pytest.approx(1.0)
    told = f"the camera's {name} of {at_m:g} m is ignored, so it sees surfaces that Mitsuba hides, on 100 %"
    assert [told in str(w.message) for w in recwarn] == [True] * is_told


@pytest.mark.parametrize(("name", "advice"), [("part.obj", "needs --unit-m 0.001"), ("part.xml", "scale the scene's")])
def test_a_run_that_measures_nothing_advises_what_the_scene_allows(
    tmp_path: Path, name: str, advice: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from rangesim.cli import main

    write(tmp_path / "part.obj", re.sub(r"^(v.*)1", r"\g<1>5000", TETRAHEDRON, flags=re.MULTILINE))  # too far: dark
    behind = SENSOR.replace('target="0,0,0"', 'target="0,-9,0"')
    write(tmp_path / "part.xml", f'<scene version="3.0.0">{behind}{BALL}</scene>')
    size = ("--width", "8", "--height", "6", "--spp", "1", "--sensor", "gray")
    out = ("--out", str(tmp_path / "out"))
    monkeypatch.setattr("sys.argv", ["rangesim", "run", str(tmp_path / name), *size, *out])
    with pytest.raises(SystemExit) as end:
        main()
    said = capsys.readouterr().err
    assert end.value.code == 0, said
    assert "measured no pixel at all" in said
    assert advice in said
    assert ("--unit-m" in said) == name.endswith(".obj")


@pytest.mark.parametrize(
    ("sensor", "change", "told"),
    [
        ("amcw", "", "ambient-swamped: The emitter's light sufficed"),
        ("gray-phase", "power_w = 1000.0\n", "glint or saturated: The detector saturated"),
        ("direct-tof", "", "ambient-swamped: The emitter's light sufficed"),
    ],
)
def test_a_run_that_measures_nothing_for_another_reason_than_distance_says_which(
    tmp_path: Path,
    sensor: str,
    change: str,
    told: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A wall 1 m away under a bright lamp, exposed for a tenth of a second: more power or other units do not help."""
    from rangesim.cli import main

    lamp = '<emitter type="constant"><spectrum name="radiance" value="500"/></emitter></scene>'
    plane = (Path(__file__).parent.parent / "scenes" / "plane.xml").read_text()
    write(tmp_path / "plane.xml", plane.replace("</scene>", lamp))
    run = f'scene = "plane.xml"\nwidth = 8\nheight = 6\nspp = 1\n[[instrument]]\nsensor = "{sensor}"\n'
    write(tmp_path / "run.toml", f"{run}exposure_s = 0.1\n{change}")
    arguments = ("run", "--config", str(tmp_path / "run.toml"), "--out", str(tmp_path / "out"))
    monkeypatch.setattr("sys.argv", ["rangesim", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    said = capsys.readouterr().err
    assert end.value.code == 0, said
    assert f"measured no pixel at all; the most frequent cause is {told}" in said
    assert "metres" not in said


WRONG_WORDS = {  # what the plugins do not know; each was passed over, and the default taken
    "roughness": '<shape type="cube"><bsdf type="roughconductor"><float name="roughness" value="0.3"/></bsdf></shape>',
    "int_iro": '<shape type="sphere"><bsdf type="dielectric"><float name="int_iro" value="1.33"/></bsdf></shape>',
    "center_": '<shape type="sphere"><point name="center_" x="1" y="0" z="0"/></shape>',
    "to_wordl": '<shape type="cube"><transform name="to_wordl"><scale value="2"/></transform></shape>',
    "raw_": """<shape type="cube"><bsdf type="diffuse"><texture type="checkerboard" name="reflectance">
        <boolean name="raw_" value="true"/></texture></bsdf></shape>""",
    "flip": '<shape type="cube"/><emitter type="constant"><string name="flip" value="a"/></emitter>',
}


@pytest.mark.parametrize("far", [0.0, 5e4])
@pytest.mark.parametrize("name", WRONG_WORDS)
def test_properties_that_a_plugin_does_not_know_are_refused(name: str, far: float, tmp_path: Path) -> None:
    body = f'<scene version="3.0.0">{SENSOR}{WRONG_WORDS[name]}</scene>'.replace("0,-3,0", f"{far},-3,0")
    path = write(tmp_path / "a.xml", body.replace("0,0,0", f"{far},0,0"))
    with pytest.raises(FileFormatError, match=rf"a\.xml is no scene .*1 unreferenced property .*{name}"):
        rangesim.load_scene(path)


def test_a_property_that_is_not_known_in_a_dictionary_is_refused(tmp_path: Path) -> None:
    scene = {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 40.0, "film": {"type": "hdrfilm", "width": 64, "height": 48}},
        "ball": {"type": "sphere", "center": [0.0, 0.0, 3.0], "bsdf": {"type": "roughconductor", "alpha": 0.2}},
    }
    assert rangesim.load_scene(scene).instances[0].name == "ball"
    scene["ball"]["bsdf"]["aplha"] = 0.2
    with pytest.raises(FileFormatError, match=r"1 unreferenced property .*aplha"):
        rangesim.load_scene(scene)


def test_properties_of_what_does_not_matter_may_be_any(tmp_path: Path) -> None:
    film = '<film type="hdrfilm"><float name="gamma_" value="1"/>'
    body = (
        SENSOR.replace('<film type="hdrfilm">', film)
        + '<integrator type="path"><float name="x" value="1"/></integrator>'
    )
    path = write(tmp_path / "a.xml", f'<scene version="3.0.0">{body}<shape type="sphere" id="ball"/></scene>')
    scene = rangesim.load_scene(path)
    assert (scene.camera.width, scene.instances[0].name) == (64, "ball")
