# SPDX-License-Identifier: Apache-2.0
"""Pixels and rays are inverse, and where a lens model has no inverse, nothing is made up."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from synthetic import plane_signals, stereo_rig

from rangesim.capture.exposure import expose
from rangesim.decoding import decode
from rangesim.decoding.status import Status
from rangesim.rig import Intrinsics
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, Sensor, StructuredLight

FOLDED = Intrinsics(640, 480, 500, 500, 320, 240, (-0.45,))
"""r (1 - 0.45 r^2) turns round at r = 0.861, where the image ends: 0.5738 f = 286.9 px from the centre."""
FOLD_PX = 500 * np.sqrt(1 / (3 * 0.45)) * 2 / 3


@pytest.mark.parametrize("distortion", [(), (0.1,), (-0.3, 0.1, 1e-3, -2e-3, 0.01), (-0.45,)])
def test_rays_project_back_to_their_pixels_or_are_nan(distortion: tuple[float, ...]) -> None:
    lens = dataclasses.replace(FOLDED, distortion=distortion)
    pixels = lens.pixel_centres()
    error = np.linalg.norm(lens.project(lens.directions(pixels)) - pixels, axis=-1)
    assert np.nanmax(error) < 2e-3
    if distortion != FOLDED.distortion:
        assert np.isfinite(error).all()


def test_pixels_beyond_the_fold_of_a_lens_model_have_no_ray() -> None:
    pixels = FOLDED.pixel_centres()
    radius = np.linalg.norm(pixels - [FOLDED.cx, FOLDED.cy], axis=-1)
    nan = np.isnan(FOLDED.normalise(pixels)).all(axis=-1)
    assert nan[radius > FOLD_PX].all()
    assert not nan[radius < FOLD_PX - 2].any()


@pytest.mark.parametrize("sensor", [StructuredLight(), IdealToF(), AmcwToF(), DirectToF()])
def test_camera_pixels_without_a_ray_are_out_of_range(sensor: Sensor) -> None:
    rig = stereo_rig()
    capture = expose(plane_signals(rig, sensor), sensor)
    before = decode(capture)
    camera = dataclasses.replace(rig.camera, distortion=(-1.0,))
    image = decode(dataclasses.replace(capture, rig=dataclasses.replace(rig, camera=camera)))
    lost = np.isnan(camera.directions(camera.pixel_centres())).any(axis=-1)
    assert 0.02 < lost.mean() < 0.5
    expected = np.where(before.status == Status.OK, Status.OUT_OF_RANGE, before.status)
    np.testing.assert_array_equal(image.status[lost], expected[lost])
    assert (np.isfinite(image.to_point_cloud().points).all(axis=-1) == image.valid).all()


@pytest.mark.parametrize("axes", [("columns",), ("columns", "rows")])
def test_projector_pixels_without_a_ray_are_out_of_range(axes: tuple[str, ...]) -> None:
    rig, sensor = stereo_rig(), StructuredLight(axes=axes)  # type: ignore[arg-type]
    capture = expose(plane_signals(rig, sensor), sensor)
    projector = dataclasses.replace(rig.projector, distortion=(-2.0,))
    image = decode(dataclasses.replace(capture, rig=dataclasses.replace(rig, projector=projector)))
    column = image.projector_column
    assert column is not None
    reach = projector.fx * np.sqrt(1 / (3 * 2.0)) * 2 / 3
    lost = np.abs(column - projector.cx) > reach
    assert lost.mean() > 0.02
    assert (image.status[lost] == Status.OUT_OF_RANGE).all()


def test_a_distortion_too_small_to_bend_a_ray_is_none() -> None:
    assert Intrinsics(32, 24, 30.0, 30.0, 16.0, 12.0, (-0.1, 5e-324, 0.0, 0.0, 5e-324)).fold_radius2 == pytest.approx(
        1 / 0.3
    )


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js")
def test_the_viewer_of_reports_has_the_rays_of_a_camera_without_distortion() -> None:
    """`unproject` in sensor_views.js repeats the pinhole of `rangesim.rig.camera_model`, as it runs in a browser."""
    viewer = (Path(__file__).parent.parent / "rangesim" / "report" / "sensor_views.js").read_text(encoding="utf-8")
    start = viewer.index("function unproject(")
    function = viewer[start : viewer.index("\n}\n", start) + 3]
    camera = Intrinsics(6, 4, 5.0, 4.5, 2.8, 2.2)
    settings = {"camera": [camera.fx, camera.fy, camera.cx, camera.cy], "width": 6, "nearM": 0.5, "stepM": 0.01}
    code = f"{function}; const z = Array.from({{length: 24}}, (_, i) => i + 1);"
    code += f"console.log(JSON.stringify(Array.from(unproject({json.dumps(settings)}, z).positions)))"
    said = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True, timeout=60).stdout
    depth = 0.5 + 0.01 * np.arange(24).reshape(4, 6, 1)
    expected = (
        camera.directions(camera.pixel_centres()) * depth * [1, -1, -1]
    )  # there y is up, and z towards the viewer
    np.testing.assert_allclose(np.array(json.loads(said)), expected.ravel(), atol=1e-6)
