# SPDX-License-Identifier: Apache-2.0
"""One emitter and several cameras: signals, captures and truth of each, photons traced once; settings of a pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import all_bytes

import rangesim
from rangesim import (
    IdealToF,
    Intrinsics,
    Lens,
    Rig,
    Scene,
    StructuredLight,
    compare,
    decode,
    explain,
    expose,
    look_at,
    transport,
)
from rangesim.errors import TruncationWarning
from rangesim.light_transport import caustics
from rangesim.light_transport.transport_settings import TransportOptions, TransportSettings
from rangesim.rig import translation

SCENES = Path(__file__).resolve().parent.parent / "scenes"


@pytest.fixture(scope="module")
def tabletop() -> Scene:
    return rangesim.load_scene(SCENES / "tabletop.xml")


def pair(scene: Scene, width: int = 48) -> list[Rig]:
    """A rig, and one whose camera stands 12 cm to the right, turned inwards."""
    rig = scene.rig(width=width)
    return [rig, rig.with_camera(look_at((0.12, 0, 0), (0, 0, scene.working_distance_m), up=(0, -1, 0)))]


def test_another_camera_leaves_the_emitter_where_it_is(tabletop: Scene) -> None:
    left, right = pair(tabletop)
    assert right.shares_emitter(left)
    np.testing.assert_allclose(right.T_world_projector, left.T_world_projector, atol=1e-12)
    np.testing.assert_allclose(right.T_world_camera[:3, 3], (left.T_world_camera @ [0.12, 0, 0, 1])[:3])
    wide = left.with_camera(translation(0.1, 0, 0), Intrinsics.from_fov(64, 48, 80), Lens(3e-3, focus_m=0.5))
    assert (wide.camera.width, wide.camera_lens.focus_m) == (64, 0.5)
    moved = replace(left, T_world_camera=translation(0.1, 0, 0) @ left.T_world_camera)
    assert not moved.shares_emitter(left)
    assert not replace(left, projector_power_w=2.0).shares_emitter(left)


def test_each_camera_has_its_own_signals_and_caustics_are_traced_once(
    tabletop: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    rigs, calls = pair(tabletop), []
    trace = caustics.trace_sheets
    monkeypatch.setattr(caustics, "trace_sheets", lambda *args: calls.append(0) or trace(*args))
    sensor = StructuredLight(code="gray")
    options: dict[str, Any] = {"spp": 8, "seed": 3}
    both = transport(tabletop, rigs, [sensor], **options)
    assert len(calls) == 1
    alone = [transport(tabletop, rig, [sensor], **options) for rig in rigs]
    assert [signals.rig for signals in both] == rigs
    assert all_bytes(both[0]) == all_bytes(alone[0])
    for one, other in zip(both, alone, strict=True):
        for part in ("z", "instance", "projector_visible"):
            np.testing.assert_array_equal(getattr(one.truth, part), getattr(other.truth, part))
    # The second camera has random numbers of its own: other noise, the same light. Multipath scatters by 3.6 % from
    # seed to seed, so 0.15 is three standard deviations of a difference
    assert all_bytes(both[1]) != all_bytes(alone[1])
    for part in ("direct", "multipath", "ambient"):
        one, other = (getattr(x[1].energy, part) for x in (both, alone))
        assert one.mean() == pytest.approx(other.mean(), rel=0.15), part
    # Nor is the noise of one camera that of the other
    a, b = (x.sampling.projector for x in both if x.sampling)
    seen = [x.truth.instance >= 0 for x in both]
    assert abs(np.corrcoef(np.sign(a[seen[0] & seen[1]]), np.sign(b[seen[0] & seen[1]]))[0, 1]) < 0.1


@pytest.mark.validation
def test_a_second_camera_sees_the_caustics_that_it_sees_alone(tabletop: Scene) -> None:
    """As means over six seeds, which deviate by 4 to 6 % each."""
    rigs, sensor, means = pair(tabletop), StructuredLight(code="gray"), []
    for seed in range(3, 9):
        options: dict[str, Any] = {"spp": 8, "seed": seed}
        second, alone = (
            transport(tabletop, rigs, [sensor], **options)[1],
            transport(tabletop, rigs[1], [sensor], **options),
        )
        means.append([second.energy.caustic.mean(), alone.energy.caustic.mean()])
    assert np.mean(means, axis=0)[0] == pytest.approx(np.mean(means, axis=0)[1], rel=0.1)


def test_cameras_of_different_size_measure_the_same_surface() -> None:
    """Each camera triangulates with the projector; both clouds lie on the plane, in one world."""
    scene = rangesim.load_scene(SCENES / "plane.xml")
    rig = scene.rig(projector_size=(160, 100), width=64)
    rigs = [rig, rig.with_camera(translation(0.05, 0.02, 0), Intrinsics.from_fov(40, 30, 30))]
    sensor = StructuredLight(160, 100)
    points = []
    for one in transport(scene, rigs, [sensor], spp=16, max_depth=2):
        image = decode(expose(one, sensor, None))
        lit = one.truth.projector_visible
        assert lit.sum() > 300
        assert image.valid[lit].mean() > 0.9
        assert np.nanmax(np.abs(image.z - one.truth.z)) < 1e-3
        cloud = image.to_point_cloud().points.reshape(-1, 3)
        cloud = cloud[np.isfinite(cloud).all(axis=1)]
        points.append(cloud @ one.rig.T_world_camera[:3, :3].T + one.rig.T_world_camera[:3, 3])
    normal = np.linalg.svd(points[0] - points[0].mean(axis=0))[2][2]
    assert np.abs((points[1] - points[0].mean(axis=0)) @ normal).max() < 1e-3


def test_the_adaptive_number_of_samples_is_each_camera_s_own(tabletop: Scene) -> None:
    fractions: list[float] = []
    both = transport(tabletop, pair(tabletop, 24), [IdealToF()], caustics=False, progress=fractions.append)
    assert len(both) == 2
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


@pytest.mark.parametrize(
    ("rigs", "message"),
    [
        (lambda a, b: [], "expected one Rig or more"),
        (lambda a, b: [a, 3], "expected one Rig or more"),
        (lambda a, b: 3, "or a list of them, got int"),
        (lambda a, b: [a, replace(b, projector_power_w=2.0)], "rig 1 has another projector_power_w than rig 0"),
        (lambda a, b: [a, b, replace(b, T_world_camera=np.eye(4))], "rig 2 has another T_world_projector than rig 0"),
    ],
)
def test_what_is_no_rig_with_several_cameras_is_refused(tabletop: Scene, rigs: Any, message: str) -> None:
    given: Sequence[Rig] = rigs(*pair(tabletop))
    with pytest.raises(ValueError, match=message):
        transport(tabletop, given, [])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.full((4, 4), np.nan),), "expected T_camera_other to hold finite numbers"),
        ((np.eye(4)[:3],), r"expected T_camera_other to be a \(4, 4\) matrix, got shape \(3, 4\)"),
        ((2 * np.eye(4),), "expected T_camera_other to be rigid"),
        ((np.eye(4), 0), "expected intrinsics as Camera, got 0"),
        ((np.eye(4), None, 0.02), "expected lens as Lens, got 0.02"),
    ],
)
def test_what_makes_no_camera_is_refused_by_name(tabletop: Scene, arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tabletop.rig(width=16).with_camera(*arguments)


def test_emitters_apart_are_told_apart_far_from_the_origin(tabletop: Scene) -> None:
    rig = tabletop.rig(width=16)
    far = replace(rig, T_world_camera=translation(5e6, 0, 0) @ rig.T_world_camera)
    assert far.with_camera(look_at((0.1, 0, 0), (0, 0, 0.8), (0, -1, 0))).shares_emitter(far)
    assert not replace(far, T_world_camera=translation(1e-3, 0, 0) @ far.T_world_camera).shares_emitter(far)


def test_cameras_mixed_up_are_noticed() -> None:
    scene = rangesim.load_scene(SCENES / "plane.xml")
    rig = scene.rig(projector_size=(160, 100), width=32)
    rigs = [rig, rig.with_camera(translation(0.05, 0, 0))]
    sensor = StructuredLight(160, 100)
    left, right = transport(scene, rigs, [sensor], spp=2, max_depth=2)
    capture = expose(left, sensor)
    image = decode(capture)
    assert compare(image, left).row("all").wrong < 0.1
    with pytest.raises(ValueError, match="signals that the range image comes from, got those of a camera elsewhere"):
        compare(image, right)
    with pytest.raises(ValueError, match="exposed from these signals, got that of a camera elsewhere"):
        explain(image, capture, right)


def test_the_warning_of_light_left_out_says_of_which_camera() -> None:
    scene = rangesim.load_scene(SCENES / "corner.xml")
    rig = scene.rig(width=16)
    with pytest.warns(TruncationWarning) as caught:
        transport(scene, [rig, rig.with_camera(translation(0.01, 0, 0))], [], spp=16, max_depth=3, glint=False)
    assert sorted("of camera 0" in str(w.message) for w in caught) == [False, True]


# ---- Settings of a pass -------------------------------------------------------------------------------


def test_options_are_the_fields_of_the_settings() -> None:
    assert list(TransportOptions.__annotations__) == [f.name for f in fields(TransportSettings)]


def test_settings_and_options_mean_the_same(tabletop: Scene) -> None:
    rig = tabletop.rig(width=16)
    by_name = transport(tabletop, rig, [IdealToF()], spp=2, seed=5, caustics=False)
    settings = TransportSettings(spp=2, seed=5, caustics=False)
    assert all_bytes(transport(tabletop, rig, [IdealToF()], settings)) == all_bytes(by_name)
    assert all_bytes(transport(tabletop, rig, [IdealToF()], settings, seed=6)) != all_bytes(by_name)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sppp": 4}, r"unknown key 'sppp' \(did you mean 'spp'\?\)"),
        ({"spp": "much"}, "expected spp to be a whole number of at least 1, got 'much'"),
        ({"caustics": 500_000}, "expected caustics to be true or false, got 500000"),
        ({"indirect": "smooth"}, "expected indirect to be one of filtered, raw, got 'smooth'"),
        ({"seed": -1}, "seed"),
        ({"glint": 1}, "expected glint to be true or false"),
        ({"memory_bytes": 0}, "expected memory_bytes"),
        ({"spp": np.array([2, 3])}, "expected spp to be a whole number"),
        ({"spp": 2**32}, "expected at most 1000000"),
        ({"max_depth": 10**40}, "expected at most 10000"),
        ({"settings": {"spp": 2}}, "expected settings as TransportSettings, got {'spp': 2}"),
        ({"settings": {}}, "expected settings as TransportSettings, got {}"),
        ({"progress": 3}, "expected progress as a function, got 3"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(tabletop: Scene, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        transport(tabletop, tabletop.rig(width=16), [], **options)
