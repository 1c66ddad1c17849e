# SPDX-License-Identifier: Apache-2.0
"""One camera and a stored image of dots: planes of known depth, steps of disparity, shadows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import dots_on_plane
from tiers import to_validate

import rangesim
from rangesim import Intrinsics, Rig, Scene, compare, decode, explain, expose, look_at, transport
from rangesim.causes import Cause
from rangesim.geometry import DenseMatching
from rangesim.instrument.instrument import Instrument
from rangesim.response import Dots, Images
from rangesim.rig import Beam, translation
from rangesim.sensors import ReferencePatternDecoder, ReferencePatternStereo, sensor_from_dict
from rangesim.sensors.reference_pattern import projector_as_camera, reference_image
from rangesim.settings.config import to_dict

SENSOR = ReferencePatternStereo(Dots(640, 400, dot_px=1.2))
"""Its dots have a standard deviation of 0.7 pixels of the camera; finer ones are sampled too coarsely."""


def rig_of(width: int = 240, height: int = 160, T: Any = None) -> Rig:
    place = translation(0.075, 0, 0) if T is None else T
    return Rig(Intrinsics.from_fov(width, height, 40.0), Intrinsics.from_fov(640, 400, 60.0), T_camera_projector=place)


@pytest.mark.parametrize("method", ["census", "zncc", "opencv"])
@pytest.mark.parametrize("distance_m", [*to_validate(0.7, 1.0), 1.37])
def test_a_plane_is_read_to_a_twentieth_of_a_pixel(method: Any, distance_m: float) -> None:
    rig = rig_of()
    capture, _ = dots_on_plane(rig, SENSOR, (0, 0, 1), distance_m)
    found = ReferencePatternDecoder(DenseMatching(method), disparities=64).coordinates(capture)
    assert found.pair is not None
    error = (found.disparity_px - found.pair.parallel.disparity(distance_m))[8:-8, 8:-8]
    known = np.isfinite(error)
    assert known.mean() > 0.95
    assert np.sqrt(np.mean(error[known] ** 2)) < 0.05


@pytest.mark.parametrize("place", [(0.075, 0, 0), (-0.06, 0, 0), (0.07, 0.01, 0.01)])
def test_a_projector_that_is_turned_or_stands_elsewhere_serves_too(place: tuple[float, ...]) -> None:
    rig = rig_of(T=look_at(place, (0, 0, 1.0), up=(0.02, -1, 0)))
    capture, z = dots_on_plane(rig, SENSOR, (0.2, -0.1, 1), 0.9)
    image = decode(capture, ReferencePatternDecoder(disparities=64))
    error = (image.z - z)[10:-10, 10:-10]
    assert np.isfinite(error).mean() > 0.9
    assert np.nanmedian(np.abs(error)) < 0.05 * 0.9**2 / (rig.pinhole.fx * rig.baseline_m)


def test_steps_count_from_the_reference_plane() -> None:
    """On the plane itself, rounding makes no error; a device's formula gives the other depths."""
    rig = rig_of()
    on_plane, _ = dots_on_plane(rig, SENSOR, (0, 0, 1), 1.1)
    decoder = ReferencePatternDecoder(disparities=64, step_px=0.125, reference_m=1.1)
    assert np.nanmedian(decode(on_plane, decoder).z) == pytest.approx(1.1, abs=1e-6)
    tilted, _ = dots_on_plane(rig, SENSOR, (0.3, 0, 1), 0.9)
    image = decode(tilted, decoder)
    pair = decoder.coordinates(tilted).pair
    assert pair is not None
    steps = pair.camera.fx * 0.075 * (1 / image.z[image.valid].astype(np.float64) - 1 / 1.1) / 0.125
    assert np.abs(steps - np.rint(steps)).max() < 0.01


def test_the_reference_image_is_the_pattern_as_the_camera_would_see_it() -> None:
    rig = rig_of()
    seen_by = projector_as_camera(rig)
    assert seen_by.fx == pytest.approx(rig.pinhole.fx, rel=0.01)
    dots = SENSOR.pattern
    assert isinstance(dots, Dots)
    image = reference_image(dots, rig.image_projector, seen_by)
    assert np.nanmean(image) == pytest.approx(1.0, abs=0.03)
    assert np.isnan(image).mean() < 0.02


@pytest.fixture(scope="module")
def plane() -> Scene:
    return rangesim.load_scene(Path(__file__).resolve().parent.parent / "scenes" / "plane.xml")


def test_a_rendered_plane_is_compared_and_explained(plane: Scene) -> None:
    sensor = ReferencePatternStereo(Dots(160, 120, spacing_px=5.0))
    rig = Instrument("kinect", sensor).rig(plane, 96, 72)
    signals = transport(plane, rig, [sensor], spp=32, max_depth=2, caustics=False)
    capture = expose(signals, sensor, sensor.default_detector)
    image = decode(capture)
    row = compare(image, signals).row("all")
    assert row.completeness > 0.9
    assert row.median_abs_m < 0.01
    dark = expose(signals, sensor, sensor.default_detector, exposure_s=2e-8)
    causes = explain(decode(dark), dark, signals).cause
    assert (causes[8:-8, 8:-8] == Cause.LOW_SIGNAL).mean() > 0.9


def test_a_video_projector_may_show_the_dots() -> None:
    """What it shows is the pattern of the sensor up to a factor, for a projector of any size."""
    sensor = ReferencePatternStereo().for_projector(320, 200, ("columns", "rows"))
    assert sensor.default_emitter.size == (320, 200)
    (image,) = sensor.patterns()
    assert image.shape == (200, 320)
    assert image.max() == 1
    shown = replace(sensor, pattern=Images(image[None]))
    rig = Rig(
        Intrinsics.from_fov(120, 90, 50),
        Intrinsics.from_fov(320, 200, 60),
        T_camera_projector=translation(0.075, 0, 0),
    )
    capture, depth = dots_on_plane(rig, sensor, (0.0, 0.0, 1.0), 1.0)
    for decoded_as in (sensor, shown):
        found = decode(replace(capture, sensor=decoded_as)).z
        assert np.isfinite(found).mean() > 0.7
        assert np.nanmedian(np.abs(found - depth)) < 0.01
    with pytest.raises(ValueError, match="expected patterns of shape"):
        shown.for_projector(640, 480)


def test_what_cannot_be_decoded_is_refused() -> None:
    capture, _ = dots_on_plane(rig_of(), SENSOR, (0, 0, 1), 1.0)
    with pytest.raises(ValueError, match="expected a capture with a rig: the reference image depends on"):
        ReferencePatternDecoder().coordinates(replace(capture, rig=None))
    with pytest.raises(ValueError, match="expected pattern to be a Response, got None"):
        ReferencePatternStereo(None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected the pattern as Dots, as Images of one image"):
        ReferencePatternStereo(Images(np.zeros((3, 4, 4), np.float32)))
    assert sensor_from_dict(to_dict(SENSOR), "sensor") == SENSOR
    with pytest.raises(ValueError, match=r"expected a projector \(Intrinsics\)"):
        projector_as_camera(Rig(Intrinsics.from_fov(8, 8, 40.0), Beam((1e-3, 1e-3))))
