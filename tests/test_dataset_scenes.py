# SPDX-License-Identifier: Apache-2.0
"""Random scenes: what decides them, where things lie, and whether the renderer sees them there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rangesim
from rangesim.dataset import DatasetSpec, RandomScene, load_spec, piles, random_scene, spec_from_dict, spec_to_dict
from rangesim.dataset import model_files as files
from rangesim.dataset.convex_pieces import convex_pieces
from rangesim.dataset.model_files import model_files, read_model
from rangesim.dataset.piles import GAP_M
from rangesim.dataset.random_primitives import PRIMITIVES, primitive
from rangesim.errors import FileFormatError
from rangesim.light_transport.transport_settings import TransportSettings
from rangesim.scene.catalogue_materials import material_names, surface
from rangesim.settings.draws import ANY_NUMBER, Draw, Of, draw_table
from rangesim.triangle_mesh import TriangleMesh

ROOT = Path(__file__).resolve().parent.parent
MAX_PENETRATION_M = 0.5e-3


def spec_of(**changes: Any) -> DatasetSpec:
    data: dict[str, Any] = {
        "objects": [{"model": list(PRIMITIVES), "count": 10, "size_m": {"uniform": [0.04, 0.08]}}],
        "instrument": [{"sensor": "ideal-tof"}],
        "support": {"type": "bin"},
        "width": 80,
        "height": 60,
        "seed": 3,
    }
    return spec_from_dict({**data, **changes})


def test_the_tolerance_of_the_task_is_that_of_each_experiment() -> None:
    assert random_scene(spec_of(tolerance_m="2mm"), 0).experiment.tolerance_m == 0.002


# ---- Draws ---------------------------------------------------------------------------------------------------------


def test_draws_have_their_distributions() -> None:
    random = np.random.default_rng(0)

    def values(plain: Any, of: Of = ANY_NUMBER) -> np.ndarray:
        return np.array([Draw.of(plain).value(random, of) for _ in range(4000)])

    assert np.mean(values({"uniform": [1, 3]})) == pytest.approx(2, abs=0.04)
    assert len(np.unique(values({"uniform": [1, 3]}))) > 1000  # whole ends do not make whole numbers
    assert set(values({"uniform": [1, 3]}, Of(int))) == {1, 2, 3}
    assert np.mean(np.log(values({"log_uniform": [0.01, 1.0]}))) == pytest.approx(np.log(0.1), abs=0.1)
    assert np.std(values({"normal": [5.0, 2.0]})) == pytest.approx(2, abs=0.1)
    assert np.mean(values([0.0, {"uniform": [1.0, 1.0]}])) == pytest.approx(0.5, abs=0.04)


def test_draws_of_tables_leave_lists_alone() -> None:
    table = {"a": {"choice": ["x"]}, "b": [1, 2], "c": {"d": {"uniform": [2.0, 2.0]}}}
    assert draw_table(table, np.random.default_rng(0)) == {"a": "x", "b": [1, 2], "c": {"d": 2.0}}


# ---- Specifications ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenez": 3}, "did you mean 'scenes'"),
        ({"objects": [{"model": "box", "counts": 3}]}, "did you mean 'count'"),
        ({"objects": [{"model": "boxx"}]}, "did you mean 'box'"),
        ({"objects": [{"model": "box", "material": "stel"}]}, r"objects\[0\]\.material.*did you mean 'steel'"),
        ({"objects": [{"model": "box", "size_m": {"unifrom": [1, 2]}}]}, "did you mean 'uniform'"),
        ({"objects": [{"model": "box", "count": {"uniform": [3, -1]}}]}, "lower to the higher"),
        ({"objects": [{"model": "box", "count": {"normal": [3, 1]}}]}, "whole number"),
        ({"support": {"type": "bin", "width": 1}}, "did you mean 'width_m'"),
        ({"instrument": [{"sensor": "amcw", "power": 1}]}, "did you mean 'power_w'"),
        ({"instrument": [{"sensor": "amcw", "power_w": {"uniform": [-2, -1]}}]}, "power_w"),
        ({"materials": {"steel": {"alpha": 0.1}}}, "parameter of steel"),
        ({"light": {"illuminant": "moon"}}, "sun, tungsten or led"),
        ({"objects": [{"model": ""}]}, "expected a model out of"),
        ({"objects": [{"model": "box", "category": ""}]}, "category as a name of 1 to 200 characters"),
        ({"instrument": [{"sensor": "amcw", "name": "a" * 80}]}, "at most 79 characters"),
    ],
)
def test_what_is_wrong_in_a_specification_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        spec_of(**changes)


def test_the_example_is_read_and_written_again() -> None:
    spec = load_spec(ROOT / "examples" / "dataset_bin.toml")
    assert spec_from_dict(json.loads(json.dumps(spec_to_dict(spec)))) == spec
    powers = {random_scene(spec, i).experiment.instruments[0].power_w for i in range(3)}
    assert len(powers) == 3


def test_every_material_of_the_catalogue_is_read() -> None:
    for name in material_names():
        assert surface(name)["bsdf"]["type"]


# ---- Models --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PRIMITIVES)
def test_the_pieces_of_a_primitive_are_its_mesh(name: str) -> None:
    from scipy.spatial import ConvexHull

    solid = primitive(name, 0.07, np.random.default_rng(1))
    assert solid.mesh.is_closed
    assert solid.size_m == pytest.approx(0.07)
    assert solid.pieces is not None
    assert sum(ConvexHull(piece).volume for piece in solid.pieces) == pytest.approx(solid.mesh.volume_m3, rel=1e-6)


def test_pieces_of_a_cup_cover_it_closely() -> None:
    """Points of the wall and the bottom lie in a piece; the hollow is left free."""
    from scipy.spatial import ConvexHull

    cup = primitive("cup", 0.06, np.random.default_rng(1))
    found = convex_pieces(cup.mesh)
    volume = sum(ConvexHull(points).volume for points in found.points)
    assert 0.999 < volume / cup.mesh.volume_m3 < 1.05
    assert found.standoff_m < 0.01 * cup.size_m


def test_models_of_a_folder_have_their_units_and_categories(tmp_path: Path) -> None:
    import trimesh

    for category, extents in (("pins", (10, 10, 60)), ("plates", (50, 50, 5))):
        (tmp_path / "parts" / category).mkdir(parents=True)
        for suffix in ("stl", "glb", "obj", "ply"):
            trimesh.creation.box(extents).export(tmp_path / "parts" / category / f"{category}.1.{suffix}")
    group = {"model": "parts", "count": 6, "unit_m": 0.001, "scale": {"uniform": [0.5, 1.0]}}
    spec = spec_from_dict({"objects": [group], "instrument": [{"sensor": "ideal-tof"}]}, tmp_path)
    scene = random_scene(spec, 0)
    assert {one.category for one in scene.objects} == {"pins", "plates"}
    for one in scene.objects:
        longest_m = np.ptp(one.mesh.vertices, axis=0).max()
        assert longest_m == pytest.approx({"pins": 0.06, "plates": 0.05}[one.category])
        assert 0.5 <= one.scale <= 1
        assert len(one.source_sha256) == 64
        assert "." not in one.name
    for extents, name in (((10, 10, 60), "pin"), ((50, 50, 5), "plate")):
        trimesh.creation.box(extents).export(tmp_path / f"{name}.stl")
    flat = {**group, "model": ["pin.stl", "plate.stl", "box"]}
    spec = spec_from_dict({"objects": [flat], "instrument": [{"sensor": "ideal-tof"}]}, tmp_path)
    for one in random_scene(spec, 0).objects:
        assert one.category == one.model


def test_a_file_in_millimetres_that_is_read_as_metres_is_refused(tmp_path: Path) -> None:
    import trimesh

    trimesh.creation.box((50, 50, 20)).export(tmp_path / "part.stl")
    data = {"objects": [{"model": "part.stl"}], "instrument": [{"sensor": "ideal-tof"}]}
    for unit_m in (1.0, 1e-6):
        data["objects"][0]["unit_m"] = unit_m
        with pytest.raises(ValueError, match=r"0\.85 m, got part of .*: state unit_m"):
            random_scene(spec_from_dict(data, tmp_path), 0)
    data["objects"][0]["size_m"] = 0.05
    assert len(random_scene(spec_from_dict(data, tmp_path), 0).objects) == 1


def test_a_urdf_file_has_its_links_where_the_joints_put_them(tmp_path: Path) -> None:
    import trimesh

    (tmp_path / "arm" / "meshes").mkdir(parents=True)
    trimesh.creation.box((20, 20, 20)).export(tmp_path / "arm" / "meshes" / "cube.stl")
    (tmp_path / "arm" / "arm.urdf").write_text(
        """<robot name="arm">
        <link name="base"><visual><geometry><box size="0.1 0.1 0.02"/></geometry></visual></link>
        <link name="tip"><visual><origin xyz="0 0 0.05"/><geometry>
          <mesh filename="package://arm/meshes/cube.stl" scale="0.001 0.001 0.001"/></geometry></visual></link>
        <joint name="j" type="revolute"><parent link="base"/><child link="tip"/>
          <origin xyz="0.04 0 0.1" rpy="0 1.5707963267948966 0"/></joint></robot>"""
    )
    solid = read_model(tmp_path / "arm" / "arm.urdf", 1.0)
    np.testing.assert_allclose(solid.mesh.vertices.min(axis=0), [-0.05, -0.05, -0.01], atol=1e-9)
    np.testing.assert_allclose(
        solid.mesh.vertices.max(axis=0), [0.1, 0.05, 0.11], atol=1e-9
    )  # the turned z points to x
    assert solid.mesh.volume_m3 == pytest.approx(0.1 * 0.1 * 0.02 + 0.02**3)


def test_an_open_mesh_is_refused_by_name_and_one_inside_out_is_turned(tmp_path: Path) -> None:
    import trimesh

    box = trimesh.creation.box((1, 1, 1))
    trimesh.Trimesh(box.vertices, box.faces[1:]).export(tmp_path / "open.ply")
    with pytest.raises(FileFormatError, match=r"closed mesh in .*open\.ply"):
        read_model(tmp_path / "open.ply", 1.0)
    trimesh.Trimesh(box.vertices, box.faces[:, ::-1], process=False).export(tmp_path / "turned.ply")
    assert read_model(tmp_path / "turned.ply", 1.0).mesh.volume_m3 == pytest.approx(1)


# ---- Scenes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arrangement", ["scattered", "pile"])
def test_specification_and_number_decide_everything(arrangement: str) -> None:
    groups = [{"model": list(PRIMITIVES), "count": 6, "material": ["steel", "bk7"]}]
    first, second, other = (random_scene(spec_of(objects=groups, arrangement=arrangement), i) for i in (2, 2, 4))
    assert first.to_dict() == second.to_dict()
    assert first.experiment == second.experiment
    for a, b in zip(first.objects, second.objects, strict=True):
        assert a.world_mesh.vertices.tobytes() == b.world_mesh.vertices.tobytes()
    assert other.to_dict() != first.to_dict()
    assert other.experiment.seed != first.experiment.seed
    json.dumps(first.to_dict(), allow_nan=False)


def test_another_light_leaves_the_objects_where_they_are() -> None:
    one, two = (random_scene(spec_of(light={"illuminance_lux": lux}), 0) for lux in (0, 5000))
    assert one.to_dict()["objects"] == two.to_dict()["objects"]
    assert one.experiment.ambient is None
    assert "sky" not in one.scene


def test_objects_that_find_no_place_are_counted() -> None:
    scene = random_scene(spec_of(objects=[{"model": "sphere", "count": 30, "size_m": 0.09}]), 0)
    assert 0 < len(scene.objects) < 30
    assert scene.left_out == {"no free place": 30 - len(scene.objects)}


def test_views_that_see_nothing_are_drawn_again_and_counted() -> None:
    """A third of the cameras look past the ball, and a third of the others are inside of it or at its surface."""
    view = {"type": "shell", "distance_m": [0.005, 0.04, 0.6], "elevation_deg": 80, "offset_m": [-0.2, 0.0, 0.0]}
    spec = spec_of(objects=[{"model": "sphere", "size_m": 0.1}], view=view)
    redrawn = [random_scene(spec, i).redrawn_views for i in range(10)]
    reasons = {reason for counts in redrawn for reason in counts}
    assert reasons == {"no object in view", "camera inside a thing", "camera at a surface"}
    with pytest.raises(ValueError, match="no object in view 100 times"):
        random_scene(spec_of(view={"type": "shell", "distance_m": 0.5, "offset_m": 90.0}), 0)


def test_a_robot_path_gives_the_poses() -> None:
    poses = [rangesim.look_at((0.1, -0.3, 0.6), (0, 0, 0)), rangesim.look_at((0, 0.3, 0.6), (0, 0, 0))]
    matrices = [pose.tolist() for pose in poses]
    spec = spec_of(view={"type": "path", "path": {"type": "poses", "matrices": matrices}})
    for i in range(3):
        scene = random_scene(spec, i)
        assert any(np.array_equal(scene.T_world_camera, pose) for pose in poses)


# ---- Piles ---------------------------------------------------------------------------------------------------------


def meshes_of(scene: RandomScene) -> dict[str, TriangleMesh]:
    """Meshes of objects and support as the renderer has them, by the name of the shape."""
    shapes = {name: shape["mesh"] for name, shape in scene.scene.items() if isinstance(shape, dict) and "mesh" in shape}
    return {name: TriangleMesh(mesh.vertices.astype(np.float32), mesh.faces) for name, mesh in shapes.items()}


def penetration_m(meshes: dict[str, TriangleMesh]) -> float:
    """Largest depth of any point on a surface or an edge of a mesh inside of another one, by Open3D."""
    import open3d as o3d

    points = []
    for mesh in meshes.values():
        a, b = mesh.corners, mesh.corners[:, [1, 2, 0]]
        edges = [(1 - t) * a + t * b for t in np.linspace(0, 1, 9)]
        points.append(np.concatenate([mesh.sample(2000)[0], np.concatenate(edges).reshape(-1, 3)]))
    deepest = 0.0
    for number, mesh in enumerate(meshes.values()):
        world = o3d.t.geometry.RaycastingScene()
        world.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
        others = np.concatenate([p for i, p in enumerate(points) if i != number])
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        near = others[((others > low) & (others < high)).all(axis=1)].astype(np.float32)
        if len(near):
            deepest = max(deepest, -float(world.compute_signed_distance(near, nsamples=11).numpy().min()))
    return deepest


def check_pile(scene: RandomScene) -> None:
    meshes = meshes_of(scene)
    del meshes["table"]  # the bin stands on it
    assert penetration_m(meshes) < MAX_PENETRATION_M
    assert scene.values["arrangement"]["max_speed_m_s"] <= 1e-3
    rim = meshes["bin"].vertices[:, 2].max()
    for one in scene.objects:
        assert np.abs(one.world_mesh.vertices.mean(axis=0)[:2]).max() < 0.2
        assert one.world_mesh.vertices[:, 2].min() < rim + 0.1


def test_a_pile_lies_in_its_bin_and_nothing_intersects() -> None:
    scene = random_scene(spec_of(arrangement="pile"), 4)
    check_pile(scene)
    lowest = min(one.world_mesh.vertices[:, 2].min() for one in scene.objects)
    assert 0 < lowest - scene.values["support"]["wall_m"] < 3 * GAP_M  # on the bottom, as far as one sees


def test_penetration_is_measured() -> None:
    ball = primitive("sphere", 0.05, np.random.default_rng(0)).mesh
    for overlap_m in (1e-3, 2e-4):
        other = TriangleMesh(ball.vertices + np.array([0.05 - overlap_m, 0, 0]), ball.faces)
        assert penetration_m({"a": ball, "b": other}) == pytest.approx(overlap_m, abs=1e-4)


@pytest.mark.validation
def test_objects_that_fall_off_are_counted() -> None:
    small = {"type": "table", "width_m": 0.12, "depth_m": 0.12}
    scene = random_scene(spec_of(support=small, arrangement="pile"), 0)
    assert scene.left_out["fell off the support"] > 0
    assert len(scene.objects) + sum(scene.left_out.values()) == 10


@pytest.mark.validation
def test_piles_rest_and_masks_are_first_hits() -> None:
    """Twenty piles of ten."""
    spec = spec_of(arrangement="pile", width=160, height=120)
    for index in range(20):
        scene = random_scene(spec, index)
        check_pile(scene)
        assert len(scene.objects) >= 8
        assert different_pixels(scene) == 0


@pytest.mark.validation
def test_objects_that_are_wedged_when_the_time_is_over_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixteen objects, some as large as half of the bin: four of them lie 0.9 mm deep in others after 2.4 s."""
    monkeypatch.setattr(piles, "MAX_CHUNKS", 24)
    objects = [{"model": list(PRIMITIVES), "count": 16, "size_m": {"uniform": [0.02, 0.12]}}]
    scene = random_scene(spec_of(objects=objects, arrangement="pile", seed=9001), 8)
    assert scene.left_out["wedged in another object"] > 0
    check_pile(scene)


# ---- Masks ---------------------------------------------------------------------------------------------------------


def different_pixels(scene: RandomScene) -> int:
    """Number of pixels whose instance in the ground truth is not what Open3D's rays hit first."""
    import open3d as o3d

    loaded = rangesim.load_scene(scene.scene)
    one = scene.experiment.instruments[0]
    rig = one.rig(loaded, scene.experiment.width, scene.experiment.height)
    settings = TransportSettings(1, 2, caustics=False, glint=False)
    truth = rangesim.transport(loaded, rig, [one.sensor], settings=settings).truth
    world, names = o3d.t.geometry.RaycastingScene(), []
    for name, mesh in meshes_of(scene).items():
        names.append(truth.instance_names.index(name))
        world.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    directions = rig.camera.directions(rig.camera.pixel_centres()).reshape(-1, 3) @ rig.T_world_camera[:3, :3].T
    places = np.broadcast_to(rig.T_world_camera[:3, 3], directions.shape)
    hits = world.cast_rays(np.concatenate([places, directions], axis=1).astype(np.float32))["geometry_ids"].numpy()
    expected = np.where(hits < len(names), np.array([*names, -1])[np.minimum(hits, len(names))], -1)
    return int((expected.reshape(truth.instance.shape) != truth.instance).sum())


def test_masks_are_first_hits() -> None:
    scene = random_scene(spec_of(), 1)
    assert different_pixels(scene) == 0


def test_a_folder_of_models_that_is_a_whole_disk_is_refused_soon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A specification with the model "/" listed all files of the machine; found by fuzzing."""
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "a.stl").touch()
    monkeypatch.setattr(files, "MAX_ENTRIES", 2)
    assert model_files(tmp_path) == (tmp_path / "deep" / "a.stl",)
    (tmp_path / "deep" / "b.txt").touch()
    with pytest.raises(FileFormatError, match="at most 2 files and subfolders"):
        model_files(tmp_path)
