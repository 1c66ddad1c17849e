# SPDX-License-Identifier: Apache-2.0
"""A scene that is moved, however far, gives the same readings: the renderer works near the camera."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from delta_scenes import GLASS, MIRROR, matte, rig_of, scene_of
from delta_scenes import wall as wall_at
from tiers import to_validate

from pcgraph import read_cloud
from rangesim import (
    AmcwToF,
    DirectToF,
    Intrinsics,
    Scene,
    Signals,
    StructuredLight,
    decode,
    expose,
    load_scene,
    transport,
)
from rangesim.environment.backend import select_variant
from rangesim.errors import FileFormatError, RangesimWarning
from rangesim.motion import ConstantTwist, Motion, Timing, transport_moving
from rangesim.response import FirstReturn
from rangesim.scene.origin import NEAR_M

ROOM = (50.3, -30.6, 20.2)
UTM = (400_000.3, 5_200_000.6, 300.7)
"""Metres by which scenes are moved whose camera is at the origin."""
EXACT_M = 1e-5
SENSORS = (StructuredLight(axes=("columns", "rows")), AmcwToF((60e6,)), DirectToF(bins=64, bin_s=400e-12))


def mesh_file(folder: Path) -> str:
    """A PLY file with a ball of 320 facets around the origin."""
    import trimesh

    path = folder / "ball.ply"
    trimesh.creation.icosphere(subdivisions=2, radius=0.2).export(path)
    return str(path)


def scene_at(by: tuple[float, ...], **parts: Any) -> dict[str, Any]:
    """The dictionary of a scene seen along y from a camera that stands at `by`."""
    select_variant()
    import mitsuba as mi

    place = mi.ScalarTransform4d().translate(by)
    sensor = {
        "type": "perspective",
        "fov": 50.0,
        "to_world": place @ mi.ScalarTransform4d().look_at([0, 0, 0], [0.05, 1, -0.1], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 64, "height": 48},
    }
    return {"type": "scene", "sensor": sensor, **parts}


def room(by: tuple[float, ...], folder: Path) -> dict[str, Any]:
    """One shape and one lamp of each kind, in a corner with a wall whose reflectance is a function of place."""
    select_variant()
    import mitsuba as mi

    place, T = mi.ScalarTransform4d().translate(by), mi.ScalarTransform4d
    point = lambda x, y, z: np.add(by, (x, y, z)).tolist()  # noqa: E731
    grey = matte(0.5)
    ramp = np.broadcast_to(np.linspace(0.1, 0.9, 8, dtype=np.float32)[:, None], (2, 2, 8, 1)).copy()
    in_space = {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(ramp),
        "raw": True,
        "to_world": place @ T().translate([-1, 0, -1]).scale([2, 3, 2]),
    }
    ramped = {"type": "diffuse", "reflectance": {"type": "volume", "volume": in_space}}
    return scene_at(
        by,
        back={"type": "rectangle", "to_world": place @ T().translate([0, 2, 0]).rotate([1, 0, 0], 90).scale(3),
              "bsdf": {"type": "twosided", "bsdf": ramped}},
        side={"type": "rectangle", "to_world": place @ T().translate([0.8, 0, 0]).rotate([0, 1, 0], -90).scale(3),
              "bsdf": grey},
        floor={"type": "rectangle", "to_world": place @ T().translate([0, 0, -0.6]).scale(3), "bsdf": grey},
        ball={"type": "sphere", "center": point(-0.3, 1.5, 0.3), "radius": 0.2, "bsdf": grey},
        globe={"type": "sphere", "to_world": place @ T().translate([0.1, 1.5, 0.45]).scale(0.15), "bsdf": grey},
        pole={"type": "cylinder", "p0": point(0.5, 1.75, -0.625), "p1": point(0.5, 1.5, 0.875), "radius": 0.1,
              "bsdf": grey},
        disk={"type": "disk", "to_world": place @ T().translate([0.4, 1.2, 0]).rotate([1, 0, 0], 60).scale(0.2),
              "bsdf": grey},
        box={"type": "cube", "to_world": place @ T().translate([-0.2, 1.3, -0.4]).rotate([0, 0, 1], 30).scale(0.2),
             "bsdf": grey},
        mesh={"type": "ply", "filename": mesh_file(folder), "to_world": place @ T().translate([0.3, 1.4, -0.4]),
              "bsdf": grey},
        bulb={"type": "point", "position": point(0, 0.5, 1), "intensity": 0.1},
        lamp={"type": "point", "to_world": place @ T().translate([0.5, 0.5, 1]), "intensity": 0.1},
        spot={"type": "spot", "to_world": place @ T().look_at([0, 0, 1], [0, 2, 0], [0, 0, 1]), "intensity": 0.3},
        panel={"type": "rectangle", "to_world": place @ T().translate([0, 1, 2]).rotate([1, 0, 0], 180).scale(0.3),
               "emitter": {"type": "area", "radiance": 0.2}},
        sun={"type": "directional", "direction": [0.3, 0.5, -1], "irradiance": 0.1},
        sky={"type": "constant", "radiance": 0.02},
    )  # fmt: skip


def glass(by: tuple[float, ...]) -> dict[str, Any]:
    """A glass ball and a pane before a wall."""
    select_variant()
    import mitsuba as mi

    place, T = mi.ScalarTransform4d().translate(by), mi.ScalarTransform4d
    centre = np.add(by, (0.05, 0.9, 0.2)).tolist()
    return scene_at(
        by,
        back={"type": "rectangle", "to_world": place @ T().translate([0, 1.3, 0]).rotate([1, 0, 0], 90).scale(3),
              "bsdf": matte(0.5)},
        ball={"type": "sphere", "center": centre, "radius": 0.15, "bsdf": GLASS},
        pane={"type": "cube", "to_world": place @ T().translate([0.6, 1, 0.2]).scale([0.2, 0.004, 0.2]), "bsdf": GLASS},
    )  # fmt: skip


def measured(scene: Scene, **options: Any) -> Signals:
    return transport(scene, scene.rig(width=64, height=48), SENSORS, **{"spp": 16, **options})


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Absolute differences; where only one of the two is NaN, infinite."""
    off = np.abs(np.where(np.isnan(a) & np.isnan(b), 0, np.subtract(a, b)))
    return np.where(np.isnan(off), np.inf, off)


# ---- The same readings, wherever the scene stands ----------------------------------------------------


@pytest.mark.parametrize("by", [UTM, *to_validate((ROOM,))])
def test_a_room_that_is_moved_reads_the_same(by: tuple[float, ...], tmp_path: Path) -> None:
    here, there = (measured(load_scene(room(at, tmp_path))) for at in ((0.0, 0.0, 0.0), by))
    assert np.array_equal(there.truth.instance, here.truth.instance)
    assert len(np.unique(here.truth.instance)) >= 9
    for name in ("z", "range_m", "normal"):
        assert difference(getattr(there.truth, name), getattr(here.truth, name)).max() < EXACT_M
    assert difference(there.truth.projector_uv, here.truth.projector_uv).max() < 1e-3  # pixels
    for sensor in SENSORS:
        image, expected = (decode(expose(signals, sensor)).z for signals in (there, here))
        assert difference(image, expected).max() < EXACT_M
    for name in ("direct", "multipath", "ambient"):
        expected = getattr(here.energy, name)
        np.testing.assert_allclose(getattr(there.energy, name), expected, atol=1e-4 * expected.mean(), rtol=1e-4)


@pytest.mark.validation
@pytest.mark.parametrize("by", [ROOM, UTM])
def test_caustics_glint_and_what_is_seen_through_glass_are_the_same(by: tuple[float, ...], tmp_path: Path) -> None:
    scenes = [load_scene(glass(at)) for at in ((0.0, 0.0, 0.0), by)]
    here, there = (measured(scene, caustics=False) for scene in scenes)
    for name in ("specular", "glint", "multipath"):
        expected = getattr(here.energy, name)
        assert expected.any()
        np.testing.assert_allclose(getattr(there.energy, name), expected, atol=1e-4 * expected.mean(), rtol=1e-4)
    for sensor in SENSORS:
        image, expected = (decode(expose(signals, sensor)).z for signals in (there, here))
        assert difference(image, expected).max() < EXACT_M
    # Rounding takes rays along silhouettes another way, which changes the draws of all photons
    a, b = (measured(scene).energy.caustic for scene in scenes)
    assert b.sum() == pytest.approx(a.sum(), rel=5e-3)
    bright = a > a.mean()
    assert np.median(np.abs(b[bright] / a[bright] - 1)) < 1e-3


def test_a_scene_file_is_read_in_double_precision(tmp_path: Path) -> None:
    def xml(x: float, y: float) -> Path:
        path = tmp_path / f"{x}.xml"
        path.write_text(f"""<scene version="3.0.0">
            <sensor type="perspective"><transform name="to_world">
                <lookat origin="{x}, {y}, 0" target="{x}, {y + 1}, 0" up="0, 0, 1"/></transform></sensor>
            <shape type="sphere"><point name="center" x="{x}" y="{y + 1.125}" z="0"/><float name="radius" value="0.5"/>
            </shape></scene>""")
        return path

    here, there = (
        transport(s, s.rig(width=16, height=12), [], spp=1) for s in map(load_scene, map(xml, [0, UTM[0]], [0, UTM[1]]))
    )
    assert difference(here.truth.z, there.truth.z).max() < 1e-6


# ---- What a user sees is in the user's world -----------------------------------------------------------


def test_poses_and_points_are_in_the_world_of_the_file(tmp_path: Path) -> None:
    scenes = [load_scene(room(by, tmp_path)) for by in ((0.0, 0.0, 0.0), UTM)]
    here, there = (scene.T_world_camera for scene in scenes)
    np.testing.assert_allclose(there[:3, 3], here[:3, 3] + UTM, atol=1e-8, rtol=0)
    np.testing.assert_allclose(there[:3, :3], here[:3, :3], atol=1e-7)
    clouds = []
    for scene in scenes:
        signals = measured(scene, spp=1)
        np.testing.assert_array_equal(signals.rig.T_world_camera, scene.rig().T_world_camera)
        clouds.append(decode(expose(signals, SENSORS[0])).to_point_cloud("world"))
    assert difference(clouds[1].points - UTM, clouds[0].points).max() < EXACT_M
    for suffix in (".ply", ".pcd"):
        path = tmp_path / f"far{suffix}"
        clouds[1].save(path)
        read = read_cloud(path).points.reshape(-1, 3)
        np.testing.assert_array_equal(read[np.isfinite(read).all(axis=1)], clouds[1].finite().points)


def test_the_renderer_s_origin_is_the_chosen_camera_and_that_of_the_file_nearby(tmp_path: Path) -> None:
    parts = room(UTM, tmp_path)
    far_off = scene_at((NEAR_M + 0.1, 0.0, 0.0))["sensor"]
    parts |= {"second": scene_at((NEAR_M - 0.1, 0.0, 0.0))["sensor"], "third": far_off}
    first, second, third = (load_scene(parts, sensor=i) for i in range(3))
    np.testing.assert_allclose(first.origin_m, UTM, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(second.origin_m, 0)
    np.testing.assert_allclose(third.origin_m, (NEAR_M + 0.1, 0, 0))
    assert first.rig().T_world_camera[:3, 3].tolist() == pytest.approx(UTM, abs=1e-8)


def test_what_is_near_the_origin_stays_there_however_far_the_camera() -> None:
    """So what it sees is rounded least."""
    away = scene_at((0.0, -30.0, 0.0), wall={"type": "rectangle", "bsdf": matte(0.5)} | {"to_world": facing_y()})
    np.testing.assert_array_equal(load_scene(away).origin_m, 0)


def facing_y() -> Any:
    select_variant()
    import mitsuba as mi

    return mi.ScalarTransform4d().rotate([1, 0, 0], 90).scale(20)


@pytest.mark.filterwarnings("ignore:the 4 taps of a frequency lie on no cosine")  # each sees another place
@pytest.mark.validation
def test_what_moves_moves_in_the_world(tmp_path: Path) -> None:
    """A ball on an arc about a place in the world, a mesh on a straight line, seen from a rig that turns."""
    sensor = AmcwToF((60e6,))
    seen = []
    for by in ((0.0, 0.0, 0.0), UTM):
        scene = load_scene(room(by, tmp_path))
        centre = tuple(np.add(by, (0.0, 2.0, 0.0)))
        motion = Motion(
            {
                "ball": ConstantTwist((0.5, 0.0, 0.0), (0.0, 0.0, 1.0), centre),
                "mesh": ConstantTwist((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), centre),
            },
            ConstantTwist((0.0, 0.2, 0.0), (0.0, 0.1, 0.0), by),
        )
        rig = scene.rig(width=64, height=48)
        signals = transport_moving(scene, rig, {sensor: Timing(0.1, single_tap=True)}, motion, spp=4)[sensor]
        place = signals.rig.T_world_camera[:3, 3] - by
        seen.append((decode(expose(signals, sensor)).z, signals.truth.z, signals.motion_m, place))
    for here, there in zip(*seen, strict=True):
        assert difference(there, here).max() < EXACT_M


# ---- What single precision leaves, near the camera ------------------------------------------------------


@pytest.mark.parametrize("distance_m", [1.0, 30.0, 1000.0])
@pytest.mark.parametrize("through_mirror", [False, True])
def test_half_a_path_length_errs_by_a_millionth_of_the_distance_at_most(
    distance_m: float, through_mirror: bool
) -> None:
    """A wall ahead, or one to the right that is seen in a mirror at 45 degrees; lit by a projector at the wall."""
    select_variant()
    import mitsuba as mi

    d, T = distance_m, mi.ScalarTransform4d
    ahead, right = np.array([0.0, 0.0, d]), np.array([d, 0.0, d])
    if through_mirror:
        mirror = {
            "type": "rectangle",
            "to_world": T().look_at(ahead, [d, 0, 0], [0, 1, 0]).scale(d / 2),
            "bsdf": MIRROR,
        }
        wall = {"type": "rectangle", "to_world": T().look_at(right, ahead, [0, 1, 0]).scale(3 * d), "bsdf": matte(0.5)}
        scene, at, looks_at = scene_of(mirror=mirror, wall=wall), (0.45 * d, 0.0, d), right
    else:
        scene, at, looks_at = scene_of(wall=wall_at(d, matte(0.5), 3 * d)), (0.1 * d, 0.0, 0.0), ahead
    camera = Intrinsics.from_fov(64, 48, 30)
    rig = rig_of(camera, Intrinsics.from_fov(1280, 800, 150), at, tuple(looks_at))
    signals = transport(scene, rig, [FirstReturn()], spp=1, max_depth=2, caustics=False, glint=False, indirect="raw")
    radiance, moment = signals.channels[FirstReturn()].astype(np.float64)
    rays = camera.directions(camera.pixel_centres())
    points, unfolded = rays * d, rays * d  # of the wall ahead
    if through_mirror:  # the wall stands behind the mirror at z = 2 d, x and z change places
        unfolded = rays * 2 * d
        points = np.stack([unfolded[..., 2] - d, unfolded[..., 1], unfolded[..., 0] + d], axis=-1)
    expected = np.linalg.norm(unfolded, axis=-1) + np.linalg.norm(points - at, axis=-1)
    lit = radiance > 0
    assert lit.mean() > 0.5
    assert np.abs(moment / np.where(lit, radiance, 1) - expected)[lit].max() < 2e-6 * d


# ---- What cannot be saved -------------------------------------------------------------------------------


def far_mesh(folder: Path, offset: tuple[float, ...], suffix: str = ".ply") -> str:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2, radius=50.0)
    ball.apply_translation(offset)
    path = folder / f"scan{suffix}"
    ball.export(path)
    return str(path)


def test_a_mesh_file_far_from_its_origin_is_warned_of_once(tmp_path: Path) -> None:
    near = (UTM[0], UTM[1] + 60, UTM[2])
    scan = {"type": "ply", "filename": far_mesh(tmp_path, near), "bsdf": matte(0.5)}
    with pytest.warns(RangesimWarning, match=r"'scan' .* rounds them by up to 3.1e.02 mm; subtract an offset") as said:
        load_scene(scene_at(UTM, scan=scan))
    assert len(said) == 1


def test_a_mesh_that_a_transform_brings_there_is_exact_and_not_warned_of(tmp_path: Path) -> None:
    import mitsuba as mi

    path = far_mesh(tmp_path, (0.0, 0.0, 0.0))
    z = []
    for by in ((0.0, 0.0, 0.0), UTM):
        place = mi.ScalarTransform4d().translate(np.add(by, (0, 60, 0)).tolist())
        scene = load_scene(scene_at(by, scan={"type": "ply", "filename": path, "to_world": place, "bsdf": matte(0.5)}))
        z.append(transport(scene, scene.rig(width=16, height=12), [], spp=1).truth.z)
    assert difference(*z).max() < EXACT_M


def test_a_bare_mesh_in_single_precision_is_warned_of_and_one_in_double_precision_is_not(tmp_path: Path) -> None:
    offset = tuple(np.add(UTM, 0.01))
    with pytest.warns(RangesimWarning, match="the vertices of mesh 'scan'"):
        load_scene(far_mesh(tmp_path, offset, ".stl"))
    load_scene(far_mesh(tmp_path, offset, ".obj"))


@pytest.mark.parametrize("coordinates", ["single", "double"])
def test_a_transform_made_in_single_precision_is_warned_of(coordinates: str) -> None:
    select_variant()
    import mitsuba as mi

    T = mi.ScalarTransform4f if coordinates == "single" else mi.ScalarTransform4d
    wall = {"type": "rectangle", "to_world": T().translate(UTM).scale(0.3), "bsdf": matte(0.5)}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        load_scene(scene_at(UTM, wall=wall))
    if coordinates == "double":
        assert not said
    else:
        (one,) = said
        assert "to_world of 'wall' was made in single precision" in str(one.message)
        assert "up to 3.1e+02 mm; make it with mitsuba.ScalarTransform4d" in str(one.message)


def test_lamps_far_away_have_to_be_dictionaries() -> None:
    import mitsuba as mi

    select_variant()
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4d().translate(UTM), "bsdf": matte(0.5)}
    lamps = {"spot": mi.load_dict({"type": "spot"}), "sky": mi.load_dict({"type": "constant"})}
    load_scene(scene_at(UTM, wall=wall, sky=lamps["sky"]))
    with pytest.raises(FileFormatError, match=r"emitters, sensors and grids .* as dictionaries"):
        load_scene(scene_at(UTM, wall=wall, **lamps))


def test_what_is_loaded_already_and_cannot_be_moved_is_said() -> None:
    select_variant()
    import mitsuba as mi

    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((2, 2, 2, 1), np.float32))}
    loaded = mi.load_dict({"type": "diffuse", "reflectance": {"type": "volume", "volume": grid}})
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4d().translate(UTM), "bsdf": loaded}
    with pytest.raises(FileFormatError, match=r"grids .* as dictionaries"):
        load_scene(scene_at(UTM, wall=wall))
    parts = scene_at(UTM, wall=wall | {"bsdf": matte(0.5)})
    parts["sensor"] = mi.load_dict(parts["sensor"])
    with pytest.warns(RangesimWarning, match="the camera is a loaded object 5.2e.06 m from the origin"):
        load_scene(parts)
