# SPDX-License-Identifier: Apache-2.0
"""The report of a scanner: ranges instead of depths, the turn unrolled, and its cloud where the points are."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import BROWSER, browser

from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.experiment_run import run
from rangesim.report import point_viewer
from rangesim.report.experiment_page import context
from rangesim.results.experiment_results import Result
from rangesim.rig import Beam, Spinning
from rangesim.sensors import IdealToF

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "corner.xml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scanner") / "result"


@pytest.fixture(scope="module")
def result(folder: Path) -> Result:
    """A scanner beside a pinhole camera of the same sensor."""
    head = Spinning(tuple(np.linspace(30, -30, 12)), 96, 0.1, (3.0, -3.0) * 6, (0.0, 0.0, 0.02), arc_deg=120.0)
    scanner = Instrument("scanner", IdealToF(), camera=head, projector=Beam())
    camera = Instrument("camera", IdealToF())
    return run(Experiment(str(SCENE), width=32, height=24, spp=1, instruments=(scanner, camera)), folder)


def numbers(text: str) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype="<f4").astype(np.float64).reshape(-1, 3)


def test_maps_of_a_scanner_are_of_ranges_and_its_turn_is_unrolled(result: Result, folder: Path) -> None:
    scanner, camera = context(result)["maps"]
    assert (scanner["quantity"], camera["quantity"]) == ("range", "depth z")
    assert scanner["turn"].caption.startswith("Range over a turn of the scanner, unrolled: 12 rings, 120°")
    assert camera["turn"] is None
    page = (folder / "report.html").read_text()
    assert page.count("the turn, unrolled") == 1
    assert "cameras that are no pinholes: range along the ray" in page


def test_points_in_the_viewer_are_those_of_the_cloud(result: Result) -> None:
    scanner, camera = result.measurements
    rays = point_viewer.packed_rays([scanner])
    assert rays is not None
    assert point_viewer.packed_rays([camera]) is None
    shown = numbers(rays["origins"]) + scanner.image.range_m.reshape(-1, 1) * numbers(rays["directions"])
    assert scanner.image.camera is not None
    points = scanner.image.camera.points(scanner.image).reshape(-1, 3)
    valid = scanner.image.valid.ravel()
    between = [np.linalg.norm(p[valid][1:] - p[valid][:-1], axis=1) for p in (shown, points)]
    np.testing.assert_allclose(between[0], between[1], atol=1e-5)  # one is the other turned and moved
    upwards = np.array([0, np.cos(point_viewer.VIEW_PITCH_RAD), np.sin(point_viewer.VIEW_PITCH_RAD)])
    np.testing.assert_allclose(shown[valid] @ upwards + points[valid][:, 1], -rays["middleM"] * upwards[2], atol=1e-5)


@pytest.mark.skipif(BROWSER is None, reason="no browser")
def test_the_page_opens_and_draws_the_scanner_s_points(result: Result, folder: Path) -> None:
    with browser(folder) as page:
        page.open(folder / "report.html")
        page.wait_for("document.documentElement.dataset.ready === 'yes'")
        assert page.said == []
        said: Any = page.evaluate("window.page.clouds.map((c) => c.pixels.length)")
        assert said == [int(m.image.valid.sum()) for m in result.measurements]
