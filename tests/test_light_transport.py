# SPDX-License-Identifier: Apache-2.0
"""The path loop against closed forms, Mitsuba's own integrator, and its own promises."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from delta_scenes import GLASS, MIRROR, matte, rig_of, scene_of, wall
from synthetic import all_bytes
from tiers import to_validate

import rangesim
from rangesim import AmcwToF, DirectToF, IdealToF, Intrinsics, Rig, StructuredLight, look_at, transport
from rangesim.environment.backend import select_variant
from rangesim.response import FirstReturn, Images, TransientHistogram

SCENES = Path(__file__).resolve().parent.parent / "scenes"
SIZE = {"width": 64, "height": 48}


@pytest.fixture(scope="module")
def corner() -> rangesim.Scene:
    return rangesim.load_scene(SCENES / "corner.xml")


@pytest.fixture(scope="module")
def tabletop() -> rangesim.Scene:
    return rangesim.load_scene(SCENES / "tabletop.xml")


def all_sensors() -> list[rangesim.Sensor]:
    return [
        StructuredLight(axes=("columns", "rows")),
        AmcwToF(waveform="square"),
        DirectToF(bins=64, bin_s=400e-12),
        IdealToF(),
    ]


# ---- Closed forms -----------------------------------------------------------------------------------


def test_a_fronto_parallel_plane_has_the_radiance_of_lambert_s_law() -> None:
    """Uniform irradiance E on the plane z = 1 gives E rho / pi cos^... = E rho / pi, the same everywhere."""
    scene = rangesim.load_scene(SCENES / "plane.xml")
    camera = scene.camera.resized(64, 48)
    rig = Rig(camera, Intrinsics.from_fov(1280, 800, 70), scene.T_world_camera, projector_power_w=3.0)
    signals = transport(scene, rig, [], spp=4)
    expected = 0.5 / np.pi * rig.projector_irradiance
    np.testing.assert_allclose(signals.energy.direct, expected, rtol=2e-4)
    assert not signals.energy.multipath.any()
    assert not signals.energy.specular.any()


def test_the_projector_s_power_is_what_reaches_a_plane() -> None:
    intrinsics = Intrinsics.from_fov(1280, 800, 70)
    rig = Rig(intrinsics, intrinsics, projector_power_w=3.0)
    area_at_1_m = (1280 / intrinsics.fx) * (800 / intrinsics.fy)
    assert rig.projector_irradiance * area_at_1_m == pytest.approx(3.0)


def test_the_path_length_of_a_plane_is_exact() -> None:
    scene = rangesim.load_scene(SCENES / "plane.xml")
    rig = scene.rig(**SIZE)
    radiance, moment = transport(scene, rig, [FirstReturn()], spp=256).channels[FirstReturn()]
    offsets = (np.arange(8) + 0.5) / 8 - 0.5  # a pixel sees the mean over its area
    pixels = rig.camera.pixel_centres()[..., None, None, :] + np.stack(np.meshgrid(offsets, offsets), axis=-1)
    points = rig.camera.directions(pixels)  # on the plane z = 1 m, in the camera's frame
    lengths = np.linalg.norm(points, axis=-1) + np.linalg.norm(points - rig.T_camera_projector[:3, 3], axis=-1)
    error = moment / radiance - lengths.mean(axis=(2, 3))
    assert np.abs(error).max() < 3e-4
    assert abs(error.mean()) < 5e-6


def test_off_a_mirror_the_path_length_is_that_of_the_mirror_image() -> None:
    """A camera looks down a flat mirror at 45 degrees: the wall appears straight behind the mirror."""
    import mitsuba as mi

    select_variant()
    T = mi.ScalarTransform4f
    scene = rangesim.load_scene(
        {
            "type": "scene",
            "sensor": perspective(T().look_at([0, 0, 0], [0, 1, 0], [0, 0, 1])),
            "mirror": {
                "type": "rectangle",
                "to_world": T().translate([0, 1, 0]).rotate([0, 0, 1], 45).rotate([1, 0, 0], 90).scale(0.4),
                "bsdf": {"type": "conductor"},
            },
            "wall": {
                "type": "rectangle",
                "to_world": T().translate([2, 1, 0]).rotate([0, 1, 0], -90).scale(5),
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}},
            },
            "wall_left": {
                "type": "rectangle",
                "to_world": T().translate([-2, 1, 0]).rotate([0, 1, 0], 90).scale(5),
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}},
            },
        }
    )
    # The lamp sees the walls beside the mirror, not through it
    lamp = Intrinsics.from_fov(100, 100, 175)
    rig = Rig(scene.camera, lamp, scene.T_world_camera, look_at((0, 0, 0.6), (0, 0, 1.6), (0, -1, 0)))
    signals = transport(scene, rig, [FirstReturn()], spp=64)
    radiance, moment = signals.channels[FirstReturn()]
    centre = (slice(23, 25), slice(31, 33))
    assert signals.truth.material_names[signals.truth.material[24, 32]] == "mirror"
    assert signals.energy.direct[centre].max() == 0
    assert signals.energy.specular[centre].min() > 0
    # 1 m to the mirror, 2 m on to one of the walls at x = -2, 2 (alike), and back to the lamp at (0, 0.6, 0)
    expected = 1.0 + 2.0 + np.hypot(2.0, 0.4)
    np.testing.assert_allclose((moment[centre] / radiance[centre]).mean(), expected, atol=2e-3)


def perspective(to_world: Any) -> dict[str, Any]:
    return {
        "type": "perspective",
        "fov": 30.0,
        "to_world": to_world,
        "film": {"type": "hdrfilm", "width": 64, "height": 48},
    }


# ---- Against Mitsuba's own path integrator ----------------------------------------------------------


@pytest.mark.filterwarnings("ignore::rangesim.errors.TruncationWarning")  # cornell has more to give
@pytest.mark.parametrize(("name", "max_depth"), [("corner", 6), *to_validate(("tabletop", 40), ("cornell", 6))])
def test_white_and_ambient_agree_with_mitsuba_s_path_integrator(name: str, max_depth: int) -> None:
    """To the same depth; with glass and mirrors, which Mitsuba counts, to one where nothing is left."""
    import mitsuba as mi
    from plain_mitsuba import plain_scene, render, z_score

    scene = rangesim.load_scene(SCENES / f"{name}.xml")
    rig = scene.rig(width=96, height=72)
    plain = plain_scene(scene, rig, {"type": "hdrfilm", "pixel_format": "luminance"})
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 3})
    reference = render(plain, integrator, spp=256, seed=1)
    options = {"spp": 256, "max_depth": max_depth, "rr_depth": 3, "caustics": False, "glint": False}
    energy = transport(scene, rig, [], seed=2, **options).energy
    assert abs(z_score(energy.projector + energy.ambient, reference)) < 5
    assert (energy.ambient.max() > 0) == scene.has_ambient


@pytest.mark.validation
def test_patterns_agree_with_a_projector_that_shows_them() -> None:
    import mitsuba as mi
    from plain_mitsuba import plain_scene, render, show, z_score

    scene = rangesim.load_scene(SCENES / "matte.xml")
    rig = scene.rig(width=96, height=72, projector_size=(64, 40))
    light = StructuredLight(64, 40, code="gray", axes=("columns", "rows"))
    rng = np.random.default_rng(0)
    images = Images(rng.random((2, 40, 64), dtype=np.float32))
    signals = transport(scene, rig, [light, images], spp=64)
    plain = plain_scene(scene, rig, {"type": "hdrfilm", "pixel_format": "luminance"})
    integrator = mi.load_dict({"type": "path", "max_depth": 5})
    patterns = np.concatenate([light.patterns()[:-1], images.patterns])
    frames = np.concatenate([signals.frames(light)[:-1], signals.channels[images]])
    for k, (pattern, frame) in enumerate(zip(patterns, frames, strict=True)):
        show(plain, pattern)
        reference = render(plain, integrator, spp=64, seed=k)
        assert np.isfinite(reference).all(), f"pattern {k}"
        assert np.isfinite(frame).all(), f"pattern {k}"
        assert abs(z_score(frame, reference)) < 5, f"pattern {k}"
        lit = reference > np.quantile(reference, 0.2)
        assert np.corrcoef(frame[lit], reference[lit])[0, 1] > 0.99, f"pattern {k}"


# ---- One pass, one truth ----------------------------------------------------------------------------


def test_bins_add_up_to_the_steady_image(corner: rangesim.Scene) -> None:
    bins = TransientHistogram(0.0, 0.1, 200)
    signals = transport(corner, corner.rig(**SIZE), [bins], spp=32)
    np.testing.assert_allclose(signals.channels[bins].sum(axis=0), signals.energy.projector, rtol=1e-5)


def test_a_pattern_and_its_inverse_add_up_to_white(tabletop: rangesim.Scene) -> None:
    light = StructuredLight(axes=("columns",), code="gray")
    signals = transport(tabletop, tabletop.rig(**SIZE), [light], spp=8)
    frames = signals.frames(light, ambient_transmission=0.0)
    white, black = frames[-2], frames[-1]
    np.testing.assert_allclose(frames[0:-2:2] + frames[1:-2:2], np.broadcast_to(white, (11, 48, 64)), rtol=1e-5)
    assert not black.any()


def test_sensors_of_one_pass_do_not_disturb_each_other(corner: rangesim.Scene) -> None:
    rig, light = corner.rig(**SIZE), StructuredLight()
    alone = transport(corner, rig, [light], spp=8).frames(light)
    together = transport(corner, rig, all_sensors(), spp=8)
    with pytest.raises(ValueError, match="run transport with this sensor"):
        together.frames(AmcwToF((1e6,)))
    both = transport(corner, rig, [light, *all_sensors()], spp=8).frames(light)
    np.testing.assert_allclose(both, alone, rtol=1e-6)


def test_corner_multipath_biases_amcw_long_and_vanishes_with_direct_light(corner: rangesim.Scene) -> None:
    rig, sensor = corner.rig(baseline_m=0.03, **SIZE), AmcwToF((20e6,))
    bias = {}
    for depth in (2, 6):
        signals = transport(corner, rig, [sensor], spp=256, max_depth=depth)
        image = rangesim.decode(rangesim.expose(signals, sensor))
        bias[depth] = np.nanmedian((image.range_m - signals.truth.range_m)[:, 24:40])
    assert abs(bias[2]) < 0.0005
    assert bias[6] > 0.02


# ---- Same seed, same bytes --------------------------------------------------------------------------


def test_threads_and_memory_budget_do_not_change_a_byte(tabletop: rangesim.Scene) -> None:
    import drjit as dr

    rig = tabletop.rig(width=96, height=72)
    before = dr.thread_count()
    results = []
    for threads, memory in ((1, 2 << 30), (2, 2 << 30), (2, 2 << 20)):
        dr.set_thread_count(threads)
        results.append(all_bytes(transport(tabletop, rig, all_sensors(), spp=4, seed=7, memory_bytes=memory)))
    dr.set_thread_count(before)
    assert results[0] == results[1] == results[2]
    assert results[0] != all_bytes(transport(tabletop, rig, all_sensors(), spp=4, seed=8))


def test_a_second_pass_compiles_nothing_wherever_its_arrays_lie(tabletop: rangesim.Scene) -> None:
    import drjit as dr

    rig, compiled = tabletop.rig(width=33, height=21), []
    held = []  # memory of odd sizes, lest the same places come again
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for seed in range(6):
            held += [np.empty(n, np.uint8) for n in range(16, 4000, 48 + 16 * seed)]
            transport(tabletop, rig, [StructuredLight()], spp=4, seed=seed)
            compiled.append({kernel["hash"] for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT})
    assert all(kernels <= compiled[0] for kernels in compiled[1:])


def test_progress_ends_at_one_and_changes_nothing(corner: rangesim.Scene) -> None:
    shares: list[float] = []
    rig = corner.rig(**SIZE)
    quiet = transport(corner, rig, all_sensors(), spp=4)
    assert all_bytes(transport(corner, rig, all_sensors(), spp=4, progress=shares.append)) == all_bytes(quiet)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


@pytest.mark.validation
def test_independent_seeds_are_unbiased(corner: rangesim.Scene) -> None:
    """Means of 12 seeds at 4 spp agree with one long pass: no bias from sharing paths between patterns."""
    rig, light = corner.rig(**SIZE), StructuredLight(code="gray")
    short = np.stack(
        [transport(corner, rig, [light], spp=4, seed=s).frames(light).mean(axis=(1, 2)) for s in range(12)]
    )
    long = transport(corner, rig, [light], spp=512, seed=99).frames(light).mean(axis=(1, 2))
    error = short.std(axis=0, ddof=1) / np.sqrt(len(short))
    lit = error > 0
    assert (np.abs(short.mean(axis=0) - long)[lit] < 5 * error[lit]).all()


def test_a_mirror_beside_the_view_is_multipath_not_a_specular_chain() -> None:
    """The camera sees matte surfaces only; some of their light has come over the mirror."""
    import mitsuba as mi

    select_variant()
    T = mi.ScalarTransform4f
    matte = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    side = T().translate([1.2, 0, 1.5]).rotate([0, 1, 0], -90).scale(2)
    scene = rangesim.load_scene(
        {
            "type": "scene",
            "sensor": perspective(T().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])),
            "wall": {"type": "rectangle", "to_world": T().translate([0, 0, 2]).scale(3), "bsdf": matte},
            "floor": {
                "type": "rectangle",
                "to_world": T().translate([0, -0.8, 1]).rotate([1, 0, 0], -90).scale(2),
                "bsdf": matte,
            },
            "mirror": {"type": "rectangle", "to_world": side, "bsdf": {"type": "conductor"}},
        }
    )
    energy = transport(scene, scene.rig(), [], spp=64).energy
    assert energy.multipath.mean() > 0
    assert not energy.specular.any()


def test_a_cut_out_hole_is_seen_through() -> None:
    import mitsuba as mi

    select_variant()
    T = mi.ScalarTransform4f
    hole = {"type": "mask", "opacity": 0.0, "bsdf": {"type": "diffuse"}}
    sensor = IdealToF()
    scene = rangesim.load_scene(
        {
            "type": "scene",
            "sensor": perspective(T().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])),
            "wall": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 2]).scale([3, 3, -1]),
                "bsdf": {"type": "diffuse"},
            },
            "hole": {"type": "rectangle", "to_world": T().translate([-0.05, 0, 0.3]).scale(0.04), "bsdf": hole},
        }
    )
    signals = transport(scene, scene.rig(baseline_m=0.3), [sensor], spp=16)
    np.testing.assert_allclose(signals.truth.z, 2.0, atol=1e-3)
    image = rangesim.decode(rangesim.expose(signals, sensor))
    lit = signals.energy.direct > 0
    assert lit.mean() > 0.8
    np.testing.assert_allclose(image.z[lit], 2.0, atol=2e-3)
    assert not signals.energy.specular.any()


NESTED: dict[str, tuple[dict[str, Any], str]] = {
    "diffuse": ({"type": "diffuse"}, "matte"),
    "plastic": ({"type": "plastic"}, "glossy"),
    "conductor": (MIRROR, "mirror"),
    "dielectric": (GLASS, "transparent"),
    "thindielectric": ({**GLASS, "type": "thindielectric"}, "transparent"),
}


@pytest.mark.validation
@pytest.mark.parametrize("nested", NESTED)
def test_the_holes_of_a_mask_are_as_if_nothing_were_there_whatever_it_is_cut_from(nested: str) -> None:
    """Two quadrants of a sheet before the camera are cut out. There, what is lit straight is that of a free wall."""
    bsdf, material = NESTED[nested]
    checks = {
        "type": "checkerboard",
        **{f"color{i}": {"type": "spectrum", "value": float(i)} for i in (0, 1)},
    }
    sheet = wall(0.1, {"type": "mask", "opacity": checks, "bsdf": bsdf}, 0.1 * np.tan(np.radians(20)))
    rig = rig_of(Intrinsics.from_fov(8, 8, 40), Intrinsics.from_fov(64, 64, 60), (0.5, 0.0, 0.0), (0.0, 0.0, 2.0))
    response = FirstReturn()
    free, through = (
        transport(scene_of(**parts, wall=wall(2.0, matte())), rig, [response], spp=16, max_depth=3, caustics=False)
        for parts in ({}, {"sheet": sheet})
    )
    holes = np.kron([[False, True], [True, False]], np.ones((4, 4), dtype=bool))
    truth = through.truth
    classes = np.array(truth.material_names)[truth.material]
    np.testing.assert_allclose(truth.z, np.where(holes, 2.0, 0.1), rtol=1e-5)
    np.testing.assert_array_equal(classes, np.where(holes, "matte", material))
    np.testing.assert_array_equal(truth.projector_visible[holes], free.truth.projector_visible[holes])
    assert free.energy.direct[holes].all()
    assert not through.energy.specular[holes].any()
    np.testing.assert_allclose(through.energy.direct[holes], free.energy.direct[holes], rtol=1e-5)
    np.testing.assert_allclose(through.channels[response][:, holes], free.channels[response][:, holes], rtol=1e-5)


def test_the_back_of_a_masked_sheet_is_not_lit() -> None:
    """Holes let light pass between what is left of the sheet, not through it."""
    sheet = {"type": "mask", "opacity": 0.9, "bsdf": matte()}
    camera = projector = Intrinsics.from_fov(8, 8, 40)
    rigs = [rig_of(camera, projector, (0.1, 0.0, z), (0.0, 0.0, 1.0)) for z in (0.0, 2.0)]
    before, behind = (transport(scene_of(sheet=wall(1.0, sheet)), rig, [], spp=1).truth for rig in rigs)
    assert before.projector_visible.any()
    assert not behind.projector_visible.any()


def test_the_back_of_a_thin_sheet_is_not_lit() -> None:
    import mitsuba as mi

    select_variant()
    T = mi.ScalarTransform4f
    sheet = T().translate([0.1, 0, 1]).rotate([0, 1, 0], 90).scale(0.3)  # between the camera and the projector
    scene = rangesim.load_scene(
        {
            "type": "scene",
            "sensor": perspective(T().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])),
            "sheet": {"type": "rectangle", "to_world": sheet, "bsdf": {"type": "twosided", "b": {"type": "diffuse"}}},
        }
    )
    poses = [look_at((x, 0, 0), (x, 0, 1), (0, -1, 0)) for x in (-0.3, 0.3)]
    rigs = [Rig(scene.camera, Intrinsics.from_fov(100, 100, 80), scene.T_world_camera, pose) for pose in poses]
    visible = [transport(scene, rig, [], spp=1).truth.projector_visible.mean() for rig in rigs]
    assert sorted(v > 0 for v in visible) == [False, True]


def test_bins_of_a_periodic_laser_are_those_of_a_single_shot_folded(corner: rangesim.Scene) -> None:
    once, again = TransientHistogram(0.0, 0.1, 400), TransientHistogram(0.0, 0.1, 16, 1.6)
    signals = transport(corner, corner.rig(**SIZE), [once, again], spp=16)
    folded = signals.channels[once].reshape(25, 16, 48, 64).sum(axis=0)
    assert signals.channels[once][16:].any()
    np.testing.assert_allclose(signals.channels[again], folded, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(signals.channels[again].sum(axis=0), signals.energy.projector, rtol=1e-4, atol=1e-6)


def test_shared_bins_keep_the_mean_length_of_light() -> None:
    scene = rangesim.load_scene(SCENES / "plane.xml")
    bins, first = TransientHistogram(0.0, 0.2, 20, is_shared=True), FirstReturn()
    signals = transport(scene, scene.rig(**SIZE), [bins, first], spp=16, max_depth=2)
    radiance, moment = signals.channels[first]
    centres = (np.arange(20) + 0.5) * 0.2
    np.testing.assert_allclose(signals.channels[bins].sum(axis=0), radiance, rtol=1e-5)
    np.testing.assert_allclose(
        np.tensordot(centres, signals.channels[bins], 1) / radiance, moment / radiance, atol=1e-5
    )


# ---- Ground truth -----------------------------------------------------------------------------------


def test_ground_truth_of_the_plane() -> None:
    scene = rangesim.load_scene(SCENES / "plane.xml")
    rig = scene.rig(**SIZE)
    truth = transport(scene, rig, [], spp=1).truth
    np.testing.assert_allclose(truth.z, 1.0, atol=1e-5)
    directions = rig.camera.directions(rig.camera.pixel_centres())
    np.testing.assert_allclose(truth.range_m, np.linalg.norm(directions, axis=-1), atol=1e-5)
    np.testing.assert_allclose(truth.normal, np.broadcast_to([0, -1, 0], truth.normal.shape), atol=1e-5)
    points = np.linalg.inv(rig.T_camera_projector) @ np.concatenate([directions, np.ones((48, 64, 1))], -1)[..., None]
    np.testing.assert_allclose(truth.projector_uv, rig.projector.project(points[..., :3, 0]), atol=0.02)
    assert truth.projector_visible.all()
    assert set(truth.instance.ravel()) == {0}


def test_ground_truth_knows_the_objects(tabletop: rangesim.Scene) -> None:
    truth = transport(tabletop, tabletop.rig(**SIZE), [], spp=1).truth
    classes = {
        truth.instance_names[i]: truth.material_names[m]
        for i, m in zip(truth.instance.ravel(), truth.material.ravel(), strict=True)
    }
    expected = {"clay_ball": "matte", "mug": "glossy", "silver_ball": "mirror", "glass_ball": "transparent"}
    assert expected.items() <= classes.items()
    assert not truth.projector_visible.all()
    assert truth.projector_visible.mean() > 0.8


@pytest.mark.parametrize(("option", "value"), [("spp", 0), ("spp", -4), ("max_depth", 0), ("spp", 1.5)])
def test_bad_numbers_get_one_clear_sentence(corner: rangesim.Scene, option: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"expected {option} to be a whole number of at least 1, got {value}"):
        transport(corner, corner.rig(**SIZE), [], **{option: value})


def test_patterns_fit_the_projector(corner: rangesim.Scene) -> None:
    rig = corner.rig(**SIZE)
    with pytest.raises(ValueError, match="projector of 1280 x 800"):
        transport(corner, rig, [Images(np.ones((2, 10, 10), np.float32))], spp=1)
    with pytest.raises(
        ValueError, match="a rig whose projector has the 640 x 400 pixels that the sensor codes, got 1280 x 800"
    ):
        transport(corner, rig, [StructuredLight(640, 400)], spp=1)


def test_equal_pattern_stacks_share_their_channels(corner: rangesim.Scene) -> None:
    pixels = np.random.default_rng(0).random((2, 40, 64), dtype=np.float32)
    images = Images(pixels)
    copy, unpickled, other = Images(pixels.copy()), pickle.loads(pickle.dumps(images)), Images(pixels[:1])
    assert images == copy == unpickled != other
    assert hash(images) == hash(copy) == hash(unpickled)
    signals = transport(corner, corner.rig(**SIZE, projector_size=(64, 40)), [images, copy, unpickled, other], spp=1)
    assert list(signals.channels) == [images, other]
    assert signals.channels[unpickled] is signals.channels[images]
    pixels[:] = 0
    assert images == copy  # it holds a copy


def test_unlit_pixels_never_reach_a_response(tabletop: rangesim.Scene) -> None:
    """Where the projector does not reach, u and v may be anything; patterns must not be looked up there."""
    images = Images(np.ones((1, 800, 1280), np.float32))
    rig = tabletop.rig(**SIZE)
    away = Rig(rig.camera, rig.projector, rig.T_world_camera, look_at((0, 0, 0.5), (1, 0, 0.5), (0, -1, 0)))
    for seed in range(4):
        signals = transport(tabletop, away, [images, *all_sensors()], spp=16, seed=seed)
        for values in signals.channels.values():
            assert np.isfinite(values).all()
        np.testing.assert_allclose(signals.channels[images][0], signals.energy.projector, rtol=1e-5)


def test_wrong_kinds_of_arguments_get_one_clear_sentence(corner: rangesim.Scene) -> None:
    rig, sensor = corner.rig(**SIZE), AmcwToF(20e6)  # type: ignore[arg-type]
    assert sensor.modulation_hz == (20e6,)
    signals = transport(corner, rig, [sensor], spp=1)
    wrong = {
        "a Scene": lambda: transport("corner.xml", rig, []),  # type: ignore[arg-type]
        "a Rig": lambda: transport(corner, None, []),  # type: ignore[arg-type]
        "a list of sensors": lambda: transport(corner, rig, sensor),  # type: ignore[arg-type]
        "list of sensors": lambda: transport(corner, rig, ["amcw"]),  # type: ignore[list-item]
        "a Detector": lambda: rangesim.expose(signals, sensor, "x"),
        "a Capture": lambda: rangesim.decode(None),
        "a path or a scene": lambda: rangesim.load_scene(3),
        "a whole number": lambda: corner.rig(width=1.5),  # type: ignore[arg-type]
        "a positive baseline": lambda: corner.rig(baseline_m="a"),  # type: ignore[arg-type]
    }
    for message, call in wrong.items():
        with pytest.raises(ValueError, match=message):
            call()
    assert repr(corner) == "Scene('corner', 2 shapes, camera 640 x 480)"
