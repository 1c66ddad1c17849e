# SPDX-License-Identifier: Apache-2.0
"""Zones are sums of the pixels of a finer camera: traced fine, read coarse."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from delta_scenes import matte, rig_of, scene_of, wall
from synthetic import all_bytes

from rangesim import (
    AmcwToF,
    Detector,
    DirectToF,
    IdealToF,
    Intrinsics,
    Lens,
    Rig,
    Scene,
    SpadDetector,
    compare,
    decode,
    expose,
    load_range_image,
    load_scene,
    load_signals,
    save_range_image,
    save_signals,
    transport,
)
from rangesim.causes import explain
from rangesim.causes.cause import Cause
from rangesim.instrument.instrument import Instrument
from rangesim.rig import Beam, Fisheye, Zones
from rangesim.sensors import DirectToFDecoder
from rangesim.settings.config import from_dict, to_dict
from rangesim.signals import EnergySplit

FINE = Intrinsics.from_fov(16, 12, 40.0)
SCENES = Path(__file__).resolve().parent.parent / "scenes"
SENSORS = [DirectToF(bins=64, bin_s=200e-12), AmcwToF((50e6,)), IdealToF()]


@pytest.fixture(scope="module")
def corner() -> Scene:
    return load_scene(SCENES / "corner.xml")


def rig_in(scene: Scene, camera: Any, **changes: Any) -> Rig:
    return replace(scene.rig(0.03, camera=FINE), camera=camera, **changes)


# ---- The matrix ------------------------------------------------------------------------------------------------------


def test_rectangles_tile_the_image() -> None:
    for columns, rows in ((4, 3), (16, 12), (5, 7), (1, 1)):
        matrix = Zones(FINE, columns, rows).matrix
        np.testing.assert_allclose(matrix.sum(axis=0), 1)  # each pixel's light goes to zones, once
        np.testing.assert_allclose(matrix.sum(axis=1), 16 * 12 / (columns * rows))
    blocks = Zones(FINE, 8, 6).matrix.toarray().reshape(6, 8, 12, 16)
    assert (blocks[2, 3, 4:6, 6:8] == 1).all()
    assert blocks[2, 3].sum() == 4


def test_overlap_widens_and_blur_spreads_zones() -> None:
    plain, wide, blurred = (Zones(FINE, 4, 3, **s) for s in ({}, {"overlap": 0.5}, {"blur_px": 0.8}))  # type: ignore[arg-type]
    middle = 5  # of 4 x 3: row 1, column 1
    assert wide.matrix.sum(axis=1)[middle] == pytest.approx(1.5**2 * plain.matrix.sum(axis=1)[middle])
    assert blurred.matrix.sum(axis=1)[middle] == pytest.approx(plain.matrix.sum(axis=1)[middle], rel=1e-3)
    across = blurred.matrix.toarray()[middle].reshape(12, 16).sum(axis=0)
    x = np.arange(16)
    variance = (across * x**2).sum() / across.sum() - ((across * x).sum() / across.sum()) ** 2
    assert variance == pytest.approx(0.8**2 + (4**2 - 1) / 12, rel=0.02)


def test_the_rays_and_solid_angles_of_binned_pixels_are_those_of_a_coarser_camera() -> None:
    zones, coarse = Zones(FINE, 8, 6), FINE.resized(8, 6)
    rays, expected = zones.pixel_rays(), coarse.pixel_rays()
    np.testing.assert_allclose(rays.directions, expected.directions, atol=2e-3)
    np.testing.assert_allclose(rays.steps, expected.steps, rtol=0.02, atol=1e-3)
    np.testing.assert_allclose(zones.solid_angle_sr(), coarse.solid_angle_sr(), rtol=1e-12)
    assert zones.etendue_m2sr(1e-3) == pytest.approx(coarse.etendue_m2sr(1e-3))
    np.testing.assert_allclose(zones.project([0.1, 0.05, 1.0]), coarse.project([0.1, 0.05, 1.0]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Zones(FINE, 17, 1), "expected at most 16 x 12 zones"),
        (lambda: Zones(FINE, 0, 1), "columns"),
        (lambda: Zones(Zones(FINE, 2, 2), 1, 1), "a Camera without zones"),
        (lambda: Zones(FINE, 1, 1, weights=np.ones((1, 5))), r"weights of shape \(1, 192\)"),
        (lambda: Zones(FINE, 1, 1, weights=-np.ones((1, 192))), "0 or more"),
        (lambda: Zones(FINE, 2, 1, weights=np.eye(2, 192) * [[1], [0]]), "above 0 for each zone"),
        (lambda: Zones(FINE, 1, 1, weights=np.ones((1, 192)), blur_px=1.0), "got both"),
        (lambda: Rig(Zones(FINE, 2, 2), Beam()), "expected a projector for a camera of zones"),
    ],
)
def test_what_makes_no_zones_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("zones", [Zones(FINE, 4, 3, 0.2, 0.5), Zones(FINE, 1, 1, weights=np.ones((1, 192)))])
def test_zones_are_kept_in_files(zones: Zones) -> None:
    assert from_dict(Zones, to_dict(zones)) == zones
    assert Rig.from_dict(to_dict(Rig(zones, FINE))).camera == zones
    assert Zones(FINE, 4, 3) != zones
    assert hash(Zones(FINE, 4, 3)) == hash(Zones(FINE, 4, 3))


# ---- Signals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", [Lens(0.75e-3), Lens(0.75e-3, vignetting=4.0)])
def test_zones_of_one_pixel_each_change_no_byte(corner: Scene, lens: Lens) -> None:
    without, of_one = (
        transport(corner, rig_in(corner, camera, camera_lens=lens), SENSORS, spp=8)
        for camera in (FINE, Zones(FINE, 16, 12))
    )
    of_one = replace(of_one, truth=replace(of_one.truth, nearest_m=None, farthest_m=None))
    assert all_bytes(without) == all_bytes(of_one)
    assert without.sampling is not None
    assert of_one.sampling is not None
    assert without.sampling.projector.tobytes() == of_one.sampling.projector.tobytes()
    for sensor, detector in zip(SENSORS, (SpadDetector(), Detector(), None), strict=True):
        frames = [expose(s, sensor, detector, seed=3).frames for s in (without, of_one)]
        np.testing.assert_array_equal(*frames)


@pytest.mark.parametrize("vignetting", [0.0, 4.0])
def test_zones_of_four_pixels_are_their_mean_and_count_their_sum(corner: Scene, vignetting: float) -> None:
    lens = Lens(0.75e-3, vignetting=vignetting)
    rigs = [rig_in(corner, camera, camera_lens=lens) for camera in (FINE, Zones(FINE, 8, 6))]
    fine, binned = (transport(corner, rig, SENSORS, spp=8) for rig in rigs)

    def four(image: np.ndarray) -> np.ndarray:
        """(..., 6, 8) sums over 2 x 2 pixels."""
        return image.astype(np.float64).reshape(*image.shape[:-2], 6, 2, 8, 2).sum(axis=(-1, -3))

    illumination = rigs[0].camera_illumination
    for f in fields(EnergySplit):
        expected = four(getattr(fine.energy, f.name) * illumination) / four(illumination)
        np.testing.assert_allclose(getattr(binned.energy, f.name), expected, rtol=1e-6, atol=1e-9)
    for sensor, detector in zip(SENSORS[:2], (SpadDetector(), Detector()), strict=True):
        electrons = []
        for signals in (fine, binned):
            radiance = signals.frames(sensor) * signals.rig.camera_illumination
            electrons.append(detector.mean_electrons(radiance, sensor.gate, signals.rig, 1e-3))
        dark = detector.mean_electrons(np.zeros(1), sensor.gate, rigs[0], 1e-3)[0]
        np.testing.assert_allclose(electrons[1] - dark, four(electrons[0] - dark), rtol=1e-5)


def test_any_matrix_gives_the_counts_of_its_weighted_pixels(corner: Scene) -> None:
    weights = np.random.default_rng(0).random((3, 192)) ** 4
    rigs = [rig_in(corner, camera) for camera in (FINE, Zones(FINE, 3, 1, weights=weights))]
    fine, mixed = (transport(corner, rig, SENSORS, spp=4) for rig in rigs)
    sensor, detector = SENSORS[0], SpadDetector(dark_counts_hz=0.0)
    electrons = [
        detector.mean_electrons(s.frames(sensor) * s.rig.camera_illumination, sensor.gate, s.rig, 1e-3)
        for s in (fine, mixed)
    ]
    expected = np.einsum("zp,kp->kz", weights, electrons[0].reshape(sensor.n_frames, -1))
    np.testing.assert_allclose(electrons[1][:, 0], expected, rtol=1e-5)
    assert expose(mixed, sensor, detector, exposure_s=1e-3).frames.shape == (64, 1, 3)


def test_the_truth_of_a_zone_is_its_largest_surface_and_the_range_of_its_depths() -> None:
    """A card at 1 m covers 3/4 of the left zone and nothing of the right; a wall stands at 2 m."""
    camera = Intrinsics.from_fov(16, 8, 10.0)
    edge = (6.0 - camera.cx) / camera.fx
    scene = scene_of(wall=wall(2.0, matte()), card=wall(1.0, matte(), half_size=0.5, x=edge - 0.5))
    rig = rig_of(Zones(camera, 2, 1), Intrinsics.from_fov(100, 100, 30.0))  # type: ignore[arg-type]
    truth = transport(scene, rig, [], spp=4, max_depth=2).truth
    assert [truth.instance_names[i] for i in truth.instance[0]] == ["card", "wall"]
    np.testing.assert_allclose(truth.z[0], [1.0, 2.0], rtol=1e-5)
    assert truth.nearest_m is not None
    assert truth.farthest_m is not None
    np.testing.assert_allclose(truth.nearest_m[0], [1.0, 2.0], rtol=5e-3)
    np.testing.assert_allclose(truth.farthest_m[0], [2.0, 2.0], rtol=2e-2)
    assert (truth.farthest_m >= truth.nearest_m).all()
    np.testing.assert_allclose(np.linalg.norm(truth.normal, axis=-1), 1, rtol=1e-6)
    assert truth.projector_visible.all()


def test_a_zone_over_an_edge_has_two_returns_by_their_parts_of_it() -> None:
    camera, sensor = Intrinsics.from_fov(16, 8, 6.0), DirectToF(pulse_fwhm_s=500e-12)
    edge = (6.0 - camera.cx) / camera.fx
    scene = scene_of(wall=wall(1.6, matte()), card=wall(1.0, matte(), half_size=0.5, x=edge - 0.5))
    rig = rig_of(Zones(camera, 2, 1), Intrinsics.from_fov(100, 100, 20.0))  # type: ignore[arg-type]
    signals = transport(scene, rig, [sensor], spp=64, max_depth=2)
    returns = decode(expose(signals, sensor), DirectToFDecoder(max_returns=2)).returns
    assert returns is not None
    np.testing.assert_array_equal(returns.number, [[2, 1]])
    radiance = 0.5 / np.pi * rig.projector_irradiance
    np.testing.assert_allclose(returns.strength[:, 0, 0], [0.75 * radiance, 0.25 * radiance / 1.6**2], rtol=0.02)
    np.testing.assert_allclose(returns.range_m[:, 0, 0], [1.0, 1.6], rtol=3e-3)


def test_a_zone_that_reads_the_smaller_surface_fails_by_its_edge() -> None:
    camera, sensor = Intrinsics.from_fov(16, 8, 6.0), DirectToF(pulse_fwhm_s=500e-12)
    edge = (6.0 - camera.cx) / camera.fx
    scene = scene_of(wall=wall(1.6, matte()), card=wall(1.0, matte(), half_size=0.5, x=edge - 0.5))
    rig = rig_of(Zones(camera, 1, 1), Intrinsics.from_fov(100, 100, 20.0))  # type: ignore[arg-type]
    signals = transport(scene, rig, [sensor], spp=32, max_depth=2)
    assert signals.truth.z[0, 0] == pytest.approx(1.6, rel=1e-3)  # of 16 columns, ten see the wall
    capture = expose(signals, sensor)
    for reading, cause in (("first", Cause.DEPTH_EDGE), ("last", Cause.NONE)):
        image = decode(capture, DirectToFDecoder(reading=reading, max_returns=2))  # type: ignore[arg-type]
        assert explain(image, capture, signals).cause[0, 0] == cause


# ---- The rest of the package -----------------------------------------------------------------------------------------


def test_readings_comparison_causes_and_clouds_work_on_zones(corner: Scene, tmp_path: Path) -> None:
    sensor = DirectToF(bins=128, bin_s=100e-12, pulse_fwhm_s=300e-12)
    rig = rig_in(corner, Zones(Intrinsics.from_fov(32, 32, 30.0), 8, 8), projector_power_w=0.02)
    signals = transport(corner, rig, [sensor])
    capture = expose(signals, sensor, SpadDetector(), seed=1)
    image = decode(capture)
    assert image.z.shape == (8, 8)
    assert image.valid.mean() > 0.9
    error = (image.range_m - signals.truth.range_m)[image.valid]
    assert np.median(np.abs(error)) < 0.02
    assert image.to_point_cloud("world").points.shape == (8, 8, 3)
    assert compare(image, signals.truth).rows
    assert explain(image, capture, signals).cause.shape == (8, 8)
    save_range_image(image, tmp_path / "range.npz")
    assert load_range_image(tmp_path / "range.npz").camera == rig.camera
    save_signals(signals, tmp_path / "signals.npz")
    loaded = load_signals(tmp_path / "signals.npz")
    assert all_bytes(loaded) == all_bytes(signals)
    assert loaded.truth.nearest_m is not None


def test_an_instrument_may_have_zones(corner: Scene) -> None:
    zones = Zones(Intrinsics.from_fov(16, 16, 45.0), 4, 4)
    instrument = Instrument("zones", SENSORS[0], camera=zones)  # type: ignore[arg-type]
    assert instrument.rig(corner).camera == zones


def test_zones_beyond_the_field_of_a_fisheye_see_nothing() -> None:
    """Zones in the corners have pixels without rays alone: they are dark, and the others are those of a matrix."""
    scene = scene_of(wall=wall(2.0, matte(), half_size=50.0))
    lens = Fisheye(24, 24, fx=9.0, fy=9.0, cx=12, cy=12, max_angle_rad=np.radians(75))
    rig = rig_of(FINE, Intrinsics.from_fov(32, 32, 90.0))
    zones = replace(rig, camera=Zones(lens, columns=8, rows=8))
    signals = transport(scene, zones, [IdealToF()], spp=4)
    fine = transport(scene, replace(rig, camera=lens), [IdealToF()], spp=4).truth.range_m
    in_zones = np.swapaxes(fine.reshape(8, 3, 8, 3), 1, 2).reshape(8, 8, 9)
    dark = ~np.isfinite(in_zones).any(axis=-1)
    assert dark[[0, 0, -1, -1], [0, -1, 0, -1]].all()
    assert not dark[3:5].any()
    np.testing.assert_array_equal(np.isnan(signals.truth.range_m), dark)
    np.testing.assert_array_equal(np.isnan(signals.truth.nearest_m), dark)
    seen = ~dark
    np.testing.assert_allclose(signals.truth.nearest_m[seen], np.nanmin(in_zones[seen], axis=-1))
    np.testing.assert_allclose(signals.truth.farthest_m[seen], np.nanmax(in_zones[seen], axis=-1))
    image = decode(expose(signals, IdealToF(), None))
    assert not image.valid[dark].any()
