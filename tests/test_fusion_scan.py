# SPDX-License-Identifier: Apache-2.0
"""Many views in one call: paths, scans of rendered scenes, and poses that are found from the readings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fusion_scenes import ball, block, mesh_depth, part, range_image

import rangesim
from rangesim import IdealToF, StructuredLight, load_scene, scan
from rangesim.errors import AlignmentWarning, sentence
from rangesim.experiment import Dome, HandHeld, PoseList, Turntable, Viewpoint
from rangesim.experiment.scan_settings import ScanSettings
from rangesim.fusion import PairFit, Scan, align, fuse, multiway_registration, pose_errors, surface_error
from rangesim.fusion.multiway_registration import _unchecked, _without_planes, check_first_pair
from rangesim.geometry import Registration
from rangesim.pipeline.scan_run import run_scan
from rangesim.rig import Intrinsics, look_at, translation
from rangesim.scene.triangles import true_surfaces
from rangesim.triangle_mesh import TriangleMesh

CENTRE = (0.1, -0.2, 0.05)
VIEWPOINT = Viewpoint(look_at((0, -0.6, 0.45), (0, 0, 0)), 0.75)


# ---- Paths -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", [Turntable(7, CENTRE, 0.5, 20.0), Dome(15, CENTRE, 0.5, 5.0, 70.0)])
def test_views_stand_at_their_distance_and_look_at_the_centre(path: Turntable | Dome) -> None:
    poses = path.poses()
    local = (np.asarray(CENTRE) - poses[:, :3, 3])[:, None, :] @ poses[:, :3, :3]
    assert local[:, 0] == pytest.approx(np.broadcast_to([0, 0, 0.5], (path.views, 3)), abs=1e-12)
    assert (poses[:, 2, 1] < 0).all()  # y is down


def test_a_turntable_turns_in_equal_steps_at_one_height() -> None:
    poses = Turntable(8, CENTRE, 0.5, 30.0).poses()
    assert poses[:, 2, 3] == pytest.approx(0.05 + 0.25)
    azimuth = np.unwrap(np.arctan2(poses[:, 1, 3] + 0.2, poses[:, 0, 3] - 0.1))
    assert np.diff(azimuth) == pytest.approx(np.pi / 4)
    half = Turntable(5, CENTRE, 0.5, 30.0, start_deg=0.0, sweep_deg=180.0).poses()
    assert half[0, 0, 3] - 0.1 == pytest.approx(0.1 - half[-1, 0, 3])  # ends are both taken


def test_a_dome_covers_its_zone_evenly() -> None:
    """A band of any height between the limits holds its share of the views, as of the area (Archimedes)."""
    z = (Dome(200, CENTRE, 0.5, 0.0, 80.0).poses()[:, 2, 3] - 0.05) / 0.5
    assert np.histogram(z, 10, (0, np.sin(np.radians(80))))[0] == pytest.approx(20, abs=1)


def test_a_hand_shakes_about_the_walk_and_the_same_way_again() -> None:
    calm = HandHeld(200, CENTRE, 0.5, 30.0, shake_m=0.0, shake_deg=0.0).poses()
    first, again = HandHeld(200, CENTRE, 0.5, 30.0).poses(), HandHeld(200, CENTRE, 0.5, 30.0).poses()
    assert np.array_equal(first, again)
    assert np.abs(HandHeld(200, CENTRE, 0.5, 30.0, seed=1).poses() - first).max() > 1e-3
    off = np.linalg.norm((first - calm)[:, :3, 3], axis=1)
    assert 0.005 < np.sqrt((off**2).mean() / 3) < 0.02
    assert np.linalg.norm(np.diff(first[:, :3, 3], axis=0), axis=1).max() < 0.03  # no jumps


def test_what_a_path_is_not_told_it_takes_from_the_camera() -> None:
    poses = Turntable(4).poses(VIEWPOINT)
    assert poses[0] == pytest.approx(VIEWPOINT.T_world_camera, abs=1e-12)


def test_refuses_paths_that_lead_nowhere() -> None:
    with pytest.raises(ValueError, match="centre_m and distance_m"):
        Turntable().poses()
    with pytest.raises(ValueError, match="elevation_deg"):
        Turntable(3, CENTRE, 0.5).poses()
    with pytest.raises(ValueError, match="lowest_deg below"):
        Dome(3, CENTRE, 0.5, 50.0, 50.0)
    with pytest.raises(ValueError, match="views"):
        Turntable(0)
    with pytest.raises(ValueError, match="rigid"):
        PoseList(2 * np.eye(4)[None])
    with pytest.raises(ValueError, match="one pose or more"):
        PoseList(np.zeros((0, 4, 4)))


# ---- Scans -------------------------------------------------------------------------------------------------------


def scene_of(mesh: TriangleMesh, tmp_path, **bsdf: object) -> rangesim.Scene:  # type: ignore[no-untyped-def]
    import mitsuba as mi

    from rangesim.environment.backend import select_variant

    select_variant(None)
    name = str(tmp_path / "thing.ply")
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(name)
    return load_scene(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 25.0,
                "to_world": mi.ScalarTransform4f().look_at([0, -0.4, 0.25], [0, 0, 0.02], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 160, "height": 120},
            },
            "thing": {
                "type": "ply",
                "filename": name,
                "face_normals": True,
                "bsdf": bsdf or {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.6}},
            },
        }
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):  # type: ignore[no-untyped-def]
    return scene_of(part(), tmp_path_factory.mktemp("part"))


def test_the_views_of_a_scan_are_those_of_transport_at_their_poses(scene) -> None:  # type: ignore[no-untyped-def]
    rig, done = scene.rig(0.05, width=80), []
    found = scan(scene, rig, IdealToF(), Turntable(3), spp=4, progress=done.append)
    assert done == [1, 2, 3]
    assert len(found) == 3
    for image, truth, T in zip(found.images, found.truths, found.true_poses, strict=True):
        assert np.array_equal(image.T_world_camera, T)
        alone = rangesim.transport(scene, replace(rig, T_world_camera=T), [], spp=1).truth
        assert np.array_equal(alone.z, truth.z, equal_nan=True)
        both = image.valid & np.isfinite(truth.z)
        assert np.median(np.abs(image.z - truth.z)[both]) < 1e-4


def test_the_noise_of_views_is_their_own_and_the_same_again(scene) -> None:  # type: ignore[no-untyped-def]
    rig, sensor = scene.rig(0.05, width=64), StructuredLight()
    pose = np.stack([scene.T_world_camera] * 2)
    first, again = (scan(scene, rig, sensor, pose, spp=4, seed=3) for _ in range(2))
    assert np.array_equal(first.images[1].z, again.images[1].z, equal_nan=True)
    assert not np.array_equal(first.images[0].z, first.images[1].z, equal_nan=True)


def test_fused_views_of_structured_light_are_better_than_one(scene) -> None:  # type: ignore[no-untyped-def]
    found = scan(scene, scene.rig(0.05, width=160), StructuredLight(), Turntable(8), spp=8)
    truth = TriangleMesh.joined(list(true_surfaces(scene).values()))
    error = surface_error(fuse(found.images, 1.5e-3).mesh, truth, 1e-3)
    assert error.accuracy_m < 3e-4
    assert error.precision > 0.97
    assert error.recall > 0.65  # neither the underside nor what the part's blocks hide of each other


@pytest.mark.validation
def test_true_surfaces_are_where_rays_meet_them() -> None:
    scene = load_scene("tabletop")
    surfaces = true_surfaces(scene)
    rig = scene.rig(width=96)
    truth = rangesim.transport(scene, rig, [], spp=1).truth
    joined = TriangleMesh.joined([surfaces[i.name] for i in scene.instances])
    z = mesh_depth(joined, rig.camera, rig.T_world_camera)
    both = np.isfinite(z) & np.isfinite(truth.z)
    assert both.mean() > 0.99
    assert np.percentile(np.abs(z - truth.z)[both], 98) < 2e-5
    assert surfaces["clay_ball"].volume_m3 == pytest.approx(4 / 3 * np.pi * 0.07**3, rel=1e-3)


def test_refuses_scans_that_cannot_be(scene) -> None:  # type: ignore[no-untyped-def]
    rig = scene.rig(0.05, width=32)
    with pytest.raises(ValueError, match="sensor or an instrument"):
        scan(scene, rig, "gray", Turntable(2))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="rigid"):
        scan(scene, rig, IdealToF(), np.zeros((1, 4, 4)))
    with pytest.raises(ValueError, match="sp"):
        scan(scene, rig, IdealToF(), Turntable(2), ssp=3)


# ---- Poses from readings -----------------------------------------------------------------------------------------


COARSE_M = 4e-3
"""A spacing at which poses are as good as at the default one, 1.4 mm here, and found in a third of the time."""


def made(mesh: TriangleMesh, n: int, sweep_deg: float, noise_m: float = 1.5e-4) -> Scan:
    """Views of a mesh whose images do not know their poses."""
    camera, random = Intrinsics.from_fov(160, 120, 25), np.random.default_rng(0)
    poses = Turntable(n, (0, 0, 0.02), 0.4, 30.0, sweep_deg=sweep_deg).poses()
    depths = [mesh_depth(mesh, camera, T) for T in poses]
    images = [range_image(z + random.normal(0, noise_m, z.shape), np.eye(4), camera) for z in depths]
    return Scan(tuple(images), true_poses=poses)


def test_poses_are_found_from_the_readings() -> None:
    views = made(part(), 3, 60.0)
    found = align(views, spacing_m=COARSE_M)
    off = pose_errors(found.poses, views.true_poses)  # type: ignore[arg-type]
    assert off.angle_deg.max() < 0.05
    assert off.centre_m.max() < 3e-4
    assert np.array_equal(found.poses[0], np.eye(4))  # the first view's pose is the world
    assert found.unchecked == ()
    assert any(pair.is_loop for pair in found.pairs)


def test_a_table_is_set_aside_and_the_faces_of_a_part_are_not() -> None:
    random = np.random.default_rng(0)
    thing = part().sample(3000)[0] + [0, 0, 0.5]
    table = np.column_stack([random.uniform(-0.3, 0.3, (20_000, 2)), random.normal(0.479, 1e-4, 20_000)])
    left = _without_planes(np.concatenate([thing, table]), 4e-3, 0)
    assert 1500 < len(left) < 3500  # but for the thing's underside, and little of the table
    assert (left[:, 2] > 0.482).mean() > 0.95
    assert len(_without_planes(thing, 4e-3, 0)) == 3000
    assert len(_without_planes(table, 4e-3, 0)) == 20_000  # nothing would be left: registration says why


def test_pose_errors_do_not_depend_on_the_world() -> None:
    poses = Turntable(5, CENTRE, 0.5, 30.0).poses()
    world = look_at((1, 2, 3), (0, 0, 0))
    assert pose_errors(world @ poses, poses).centre_m == pytest.approx(0, abs=1e-12)
    assert pose_errors(world @ poses, poses).angle_deg == pytest.approx(0, abs=1e-5)
    moved = poses.copy()
    moved[2] = moved[2] @ translation(0.01, 0, 0)
    assert pose_errors(moved, poses).centre_m == pytest.approx([0.002, 0.002, 0.008, 0.002, 0.002], abs=1e-9)


@pytest.mark.parametrize(
    ("mesh", "n", "sweep"),
    [(ball(0.04), 3, 60.0), (block((0.08, 0.08, 0.05)), 2, 90.0)],
    ids=["what slides on itself", "what is symmetric"],
)
def test_failure_is_said(mesh: TriangleMesh, n: int, sweep: float) -> None:
    with pytest.raises(ValueError, match=r"view 1 cannot be aligned; on view 0: expected .*|looks through"):
        align(made(mesh, n, sweep))


def test_views_that_hang_on_one_pair_are_found() -> None:
    """A triangle of views, and a chain of two more on its last one."""
    edges = [(1, 0), (2, 1), (2, 0), (3, 2), (4, 3)]
    pairs = tuple(PairFit(a, b, np.eye(4), 1.0, 0.0, False) for a, b in edges)
    assert _unchecked(pairs, 5) == (3, 4)
    assert _unchecked(pairs[:3], 3) == ()


def test_two_views_are_warned_of_as_nothing_confirms_their_pair() -> None:
    views = made(part(), 2, 20.0)
    with pytest.warns(AlignmentWarning, match="no loop confirms the pose of view 1"):
        found = align(views, spacing_m=COARSE_M)
    assert found.unchecked == (1,)
    assert pose_errors(found.poses, views.true_poses).angle_deg.max() < 0.1  # type: ignore[arg-type]


@pytest.mark.validation
def test_views_without_overlap_are_told_what_order_is_expected() -> None:
    """The second of them looks from the other side."""
    views = made(part(), 4, 180.0)
    shuffled = Scan(tuple(views.images[k] for k in (0, 3, 1, 2)))
    with pytest.raises(
        ValueError, match=r"view 1 cannot be aligned; on view 0: expected (.|\n)*in the order of a walk"
    ):
        align(shuffled)


REASONS = [
    "expected 30% of the source on the target, got 0.0% within 3 spacings; scan with more overlap, or a first guess.",
    "expected surfaces that hold each other, got ones that slide (constraint 1.0e-03): a plane, a sphere, a cylinder; "
    "add points of another shape to the clouds, such as what they stand on.",
    "expected clouds that fit in one way, got two poses 180 degrees and 0.00123 m apart that both fit (agreement 0.912 "
    "and 0.898): what both clouds show is symmetric, or too little; scan with more overlap.",
    "expected surfaces that lie on each other, got partners 0.00123 m apart along the normals, an agreement of -0.12, "
    "below 0.45: a wrong pose, another shape or scale, or noise far above the spacing; start nearer.",
]


@pytest.mark.parametrize("reason", REASONS)
@pytest.mark.parametrize(("n", "told"), [(1, ""), (2, ", nor on 0"), (3, ", nor on 1, nor on 0")])
def test_a_view_that_fits_on_none_before_is_told_in_a_sentence_that_is_never_cut(
    reason: str, n: int, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    clouds = [np.full((1, 3), float(k)) for k in range(n + 1)]

    def fails_on_the_last(source: np.ndarray, target: np.ndarray, **_: object) -> Registration:
        if source[0, 0] == n:
            raise ValueError(reason)
        return Registration(np.eye(4), 1.0, 1.0, 0.0, 1.0, 1.0)

    monkeypatch.setattr(multiway_registration, "register", fails_on_the_last)
    with pytest.raises(ValueError, match=f"view {n} cannot be aligned; on view {n - 1}: expected ") as refused:
        multiway_registration._chain(clouds, 0)
    message = str(refused.value)
    assert len(message) <= 350
    assert sentence(message) == message
    assert reason.partition("; ")[0] + f"{told}. Views are expected in the order of a walk" in message


@pytest.mark.parametrize(("failures", "is_refused"), [(0, False), (1, False), (2, False), (3, True)])
def test_the_first_two_views_are_refused_early_only_if_they_fit_at_no_spacing(
    failures: int, is_refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second has to fit on the first, as there is no other before it; but the spacing may turn out another."""
    sizes: list[int] = []

    def fails_at_first(source: np.ndarray, target: np.ndarray, **_: object) -> Registration:
        sizes.append(len(source))
        if len(sizes) <= failures:
            raise ValueError("expected more, got less; do it.")
        return Registration(np.eye(4), 1.0, 1.0, 0.0, 1.0, 1.0)

    monkeypatch.setattr(multiway_registration, "register", fails_at_first)
    views = made(part(), 2, 20.0)
    if is_refused:
        with pytest.raises(ValueError, match="view 1 cannot be aligned; on view 0: expected more, got less\\. Views"):
            check_first_pair(views)
        assert sizes[2] < sizes[0] < sizes[1]  # points of 1.25 times, once and 0.8 times the spacing
    else:
        check_first_pair(views)
    assert len(sizes) == min(failures + 1, 3)


@pytest.mark.parametrize(("views", "rendered"), [(7, 2), (2, 2)])
def test_poses_that_cannot_be_found_are_refused_before_all_views_are_rendered(
    views: int, rendered: int, tmp_path: Path
) -> None:
    stages: list[str] = []
    settings = ScanSettings("plane", width=48, spp=2, path=Turntable(views), registration="unknown")
    with pytest.raises(ValueError, match="view 1 cannot be aligned"):
        run_scan(settings, tmp_path / "out", lambda stage, _: stages.append(stage))
    assert [s for s in stages if s.startswith("View")] == [f"View {k + 1} of {views}" for k in range(rendered)]
    assert not list(tmp_path.iterdir())


def test_refuses_what_cannot_be_aligned() -> None:
    views = made(part(), 2, 30.0)
    with pytest.raises(ValueError, match="two views or more"):
        align(Scan(views.images[:1]))
    with pytest.raises(ValueError, match="0 in view 1"):
        align(Scan((views.images[0], range_image(np.full((120, 160), np.nan), None, views.images[0].camera))))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="spacing_m"):
        align(views, -1.0)
    with pytest.raises(ValueError, match="200 points or more"):
        align(views, 0.05)
    with pytest.raises(ValueError, match="as many poses"):
        pose_errors(np.zeros((2, 4, 4)), np.zeros((3, 4, 4)))
