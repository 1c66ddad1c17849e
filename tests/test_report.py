# SPDX-License-Identifier: Apache-2.0
"""The report: self-contained, true to the numbers, and looked at in a real browser."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from browser import OPTIONS, WITHOUT_WEBGL, browser
from PIL import Image
from scroll_hints import check_scroll_hints
from skimage.color import deltaE_ciede2000, xyz2lab
from skimage.color.colorconv import xyz_from_rgb
from small_result import SCENES, SENSORS, result_of_two_cameras, small_result
from tiers import to_validate
from typer.testing import CliRunner

from pcgraph.viewer.node_colors import node_colors
from rangesim.causes import Cause, CauseMap
from rangesim.cli import app
from rangesim.decoding.status import Status
from rangesim.environment.doctor import find_browser
from rangesim.evaluation.object_segmentation import ObjectOutcome, ObjectSegmentation, Outcome
from rangesim.evaluation.surface_rows import with_mean_over_objects
from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.experiment_run import carry_out
from rangesim.report import palette, render_report, tables, write_report
from rangesim.report.clouds_page import render_clouds_page
from rangesim.report.experiment_page import by_camera
from rangesim.report.line_plots import COLORS
from rangesim.report.objects_section import objects_sentence, objects_table
from rangesim.report.printing import pdf_of
from rangesim.report.verdict import verdict
from rangesim.results.experiment_results import PhotonsRecord, Result, load_result, write_result
from rangesim.rig import Intrinsics
from rangesim.sensors import IdealToF

BROWSER = find_browser()
CANVAS = (16, 21, 29)
"""Background of the point clouds."""
MEDIAN = next(c for c in tables.COLUMNS if c.key == "median_abs_m")
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium found; apt-get install chromium")


@pytest.fixture(scope="module")
def html() -> str:
    return (small_result() / "report.html").read_text(encoding="utf-8")


def test_it_is_one_file_that_needs_no_network(html: str) -> None:
    without_data = re.sub(r'"data:image/png;base64,[^"]*"', '""', html)
    without_data = without_data.replace("http://www.w3.org/1999/xhtml", "")  # a name of XML, which nothing asks for
    assert not re.search(r"https?:|//[a-z]+\.[a-z]|@import|url\(|<link (?!rel=\"icon\" href=\"data:)", without_data)
    assert not re.search(r"<script[^>]+src=|<iframe|<object|fetch\(|XMLHttpRequest", without_data)


def test_every_part_is_there(html: str) -> None:
    for part in ("scene", "numbers", "objects", "maps", "clouds", "captures", "light", "cost", "settings"):
        assert f'id="{part}"' in html
    for title in ("Structured light", "Time of flight (AMCW)", "Time of flight (direct)", "Ideal time of flight"):
        assert f"<h3>{title}" in html
    assert [int(n) for n in re.findall(r'<b class="number">Figure (\d+)', html)] == list(range(1, 7))
    assert [int(n) for n in re.findall(r'<b class="number">Table (\d+)', html)] == list(range(1, 7))
    assert html.count('class="cloud"') == html.count('class="labels"') == len(SENSORS)


def test_the_table_shows_the_statistics(html: str) -> None:
    for m in load_result(small_result()).measurements:
        for row in m.rows:
            assert f">{tables.number(tables.OUTCOMES[1], row['wrong'])}</td>" in html
            if row["kind"] not in ("object", "part"):
                assert f">{tables.number(MEDIAN, row['median_abs_m'])}</span>" in html


def test_text_from_outside_is_escaped(tmp_path: Path) -> None:
    result = load_result(small_result())
    scene = msgspec.structs.replace(result.info.scene, name="<script>alert(1)</script>")
    result = replace(result, info=msgspec.structs.replace(result.info, scene=scene))
    write_report(result, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert" in text


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0.0, "0.000"), (-1e-9, "0.000"), (12.34e-6, "0.012"), (-2.5e-3, "−2.50"), (0.0321, "32.1"), (1.5, "1500")],
)
def test_millimetres_have_three_digits(metres: float, text: str) -> None:
    assert tables.millimetres(metres) == text


@pytest.mark.parametrize(("value", "text"), [(None, "–"), (1.5, "1.5 s"), (0.0123, "12.3 ms"), (1e-5, "10 µs")])
def test_seconds_have_units(value: float | None, text: str) -> None:
    assert tables.seconds(value) == text


def test_the_error_scale_is_odd_and_rises_to_its_limits() -> None:
    errors = np.array([-1, -palette.ERROR_LIMIT_M, -1e-3, 0, 1e-3, palette.ERROR_LIMIT_M, 1])
    fraction = palette.error_fraction(errors)
    np.testing.assert_allclose(fraction, 1 - fraction[::-1])
    np.testing.assert_allclose(fraction[[0, 1, 3, 5, 6]], [0, 0, 0.5, 1, 1])
    assert (np.diff(palette.error_fraction(np.linspace(-0.1, 0.1, 99))) > 0).all()


def test_every_outcome_has_a_name_and_a_colour() -> None:
    assert len(palette.OUTCOME_NAMES) == len(palette.OUTCOME_COLORS) == len(Cause) + 1
    assert len(palette.STATUS_NAMES) == len(palette.STATUS_COLORS) == len(Status)
    for m in load_result(small_result()).measurements:
        found = palette.outcomes(m)
        assert ((found == palette.NOTHING) == np.isnan(m.truth.z)).all()
        assert (found[m.causes.failed] == m.causes.cause[m.causes.failed]).all()


# Machado, Oliveira, Fernandes: "A physiologically-based model for simulation of color vision deficiency" (2009)
SIGHT = {
    "normal": np.eye(3),
    "no red cones": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "no green cones": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}


COMMON = [c for c in Cause if c <= Cause.RESOLUTION and c != Cause.MOTION]
DARK = (21, 27, 36)
"""Colour of the dark page."""


def lab(colors: Any, sight: str) -> np.ndarray:
    """(n, 3) CIELAB of colours 0..255, as they look to this sight."""
    fraction = np.asarray(colors) / 255
    linear = np.where(fraction <= 0.04045, fraction / 12.92, ((fraction + 0.055) / 1.055) ** 2.4)
    return np.asarray(xyz2lab(np.clip(linear @ SIGHT[sight].T, 0, 1) @ xyz_from_rgb.T))


def least_difference(colors: Any, sight: str) -> float:
    """Smallest CIEDE2000 of two of the colours; 1 is just noticeable."""
    seen = lab(colors, sight)
    a, b = np.triu_indices(len(seen), 1)
    return float(deltaE_ciede2000(seen[a], seen[b]).min())


def of_hexadecimal(color: str) -> list[int]:
    return list(bytes.fromhex(color[1:]))


@pytest.mark.parametrize("sight", SIGHT)
def test_colours_are_told_apart_without_red_or_green_cones_and_on_the_dark_page(sight: str) -> None:
    outcomes = palette.OUTCOME_COLORS
    assert least_difference(outcomes[COMMON], sight) > 13
    assert least_difference(outcomes[1:], sight) > 9.6
    assert least_difference(outcomes, sight) > 7  # "right" and "nothing there", a light grey and a darker one
    assert deltaE_ciede2000(lab(outcomes, sight), lab([DARK], sight)).min() > 18
    curves = list(map(of_hexadecimal, COLORS))
    assert least_difference(curves[:6], sight) > 17
    assert least_difference(curves, sight) > 10
    assert least_difference([of_hexadecimal(c) for c in palette.READING_COLORS.values()], sight) > 15


def test_the_failures_of_a_surface_add_up() -> None:
    for m in load_result(small_result()).measurements:
        for row in m.rows:
            assert sum(row["causes"].values()) == pytest.approx(row["wrong"] + row["missing"])
            assert row["right"] + row["wrong"] + row["missing"] == pytest.approx(1)
        assert 1 - m.rows[-1]["right"] == pytest.approx(m.causes.failed[np.isfinite(m.truth.z)].mean())


def test_a_node_has_the_colour_of_its_largest_child() -> None:
    """Leaves of 5, 3 and 4 points: the pair (1, 2) takes the colour of leaf 2, the root that of the pair."""
    colors = node_colors(np.array([4, 3, 3, 4, 4]), np.array([5, 3, 4]))
    assert (colors[3] == colors[2]).all()
    assert (colors[4] == colors[3]).all()
    assert len(np.unique(colors[:3], axis=0)) == 3


def test_the_verdict_says_what_the_rows_say() -> None:
    good = _measured("lines", acquisition_s=0.2, cup=(0.99, 0.01, 1e-3), pot=(0.91, 0.01, 2e-3))
    poor = _measured("amcw", acquisition_s=0.1, cup=(0.12, 0.28, 5e-3), pot=(0.0, 1.0, 5e-3))
    fair = _measured("histogram", acquisition_s=0.3, cup=(0.88, 0.02, 2e-3), pot=(0.3, 0.2, 2e-3))
    both, first, second, _ = (f.text.replace("\xa0", " ") for f in verdict([good, poor, fair]))
    assert "reads 95.0 % of the objects’ pixels right, to 10 mm, and 1.0 % wrong; 4.0 % are missing." in first
    assert (
        "Most pixels are right on 2 of 2 objects; worst: pot (91 % right, 1 % wrong, 8 % missing; multipath)." in first
    )
    assert "Causes of what is wrong or missing: 80 % multipath, 20 % low signal." in first
    assert "Half of its readings on an object lie, on average, within 1.50 mm of the true depth" in first
    assert (
        "Most pixels are right on 0 of 2 objects; worst: pot (0 % right, 100 % wrong, 0 % missing; multipath), "
        "cup (12 % right, 28 % wrong, 60 % missing; multipath)."
    ) in second
    assert "Most of the objects’ pixels right, to 10 mm: Structured light, 95.0 % (next: " in both
    assert "No sensor" not in both
    assert "Smallest median error: Structured light, 1.50 mm" in both
    # the exposure of 0.1 s is no merit of a sensor that reads next to nothing right
    assert "Shortest exposure of all frames: Structured light, 10 frames in 200 ms (against" in both


def _side_by_side(*measurements: Any) -> str:
    return verdict(list(measurements))[0].text.replace("\xa0", " ")


def outcome(name: str, kind: Outcome = Outcome.FOUND, *merged_with: str, **rest: Any) -> ObjectOutcome:
    return ObjectOutcome(name, 100, 0.9, 0.8, kind, merged_with=merged_with, **rest)


@pytest.mark.parametrize(
    ("objects", "invented", "sentence"),
    [
        ([outcome("a"), outcome("b")], 0, "Segmentation finds 2 of 2 objects."),
        ([outcome("a")], 1, "Segmentation finds 1 of 1 object; it invents 1."),
        (
            [outcome("cup"), outcome("bottle", Outcome.MERGED, "table"), outcome("glass", Outcome.MISSED)],
            2,
            "Segmentation finds 1 of 3 objects, merges bottle with table, and misses glass; it invents 2.",
        ),
        (
            [outcome("a", Outcome.MERGED, "b"), outcome("b", Outcome.MERGED, "a"), outcome("c", displaced=True)],
            0,
            "Segmentation finds none of 3 objects, displaces c by over 10\u00a0mm, and merges a and b.",
        ),
        (
            [*(outcome(n, Outcome.MISSED) for n in "abcde"), outcome("f", Outcome.SPLIT)],
            0,
            "Segmentation finds none of 6 objects, splits f, and misses a, b, c and 2 more.",
        ),
        (
            [outcome("a"), outcome("lid", Outcome.MERGED, "a", separable=False)],
            0,
            "Segmentation finds 1 of 2 objects. Even in the true depth it does not find lid.",
        ),
        ([], 0, ""),
    ],
)
def test_a_sentence_says_what_becomes_of_the_objects(
    objects: list[ObjectOutcome], invented: int, sentence: str
) -> None:
    m = load_result(small_result()).measurements[0]
    assert objects_sentence(replace(m, objects=ObjectSegmentation(tuple(objects), invented))) == sentence
    assert objects_sentence(replace(m, objects=None)) == ""


def test_the_table_of_objects_has_a_row_for_each_and_none_where_it_is_not_known(html: str) -> None:
    result = load_result(small_result())
    for m in result.measurements:
        assert (objects_sentence(m) in html) == (not tables.is_reference(m))
    lines = objects_table(result.measurements)
    assert [line.name for line in lines] == list(result.measurements[0].truth.object_names)
    assert all(len(line.cells) == len(SENSORS) for line in lines)
    unknown = tuple(replace(m, objects=None) for m in result.measurements)
    assert 'id="objects"' not in render_report(replace(result, measurements=unknown))
    seen_by_one = [result.measurements[0], replace(result.measurements[1], objects=ObjectSegmentation((), 0))]
    assert {line.cells[1].note for line in objects_table(seen_by_one)} == {"not in view"}


def test_side_by_side_ranks_by_right_readings() -> None:
    """The one that measures everywhere, but wrong, was "most complete" at 97.0 %; it reads half of the pixels right."""
    wrong = _measured("amcw", cup=(0.51, 0.46, 5e-3), pot=(0.51, 0.46, 5e-3))
    right = _measured("lines", cup=(0.9, 0.02, 1e-3), pot=(0.86, 0.02, 1e-3))
    fair = _measured("histogram", cup=(0.9, 0.1, 2e-3), pot=(0.8, 0.1, 2e-3))
    best = "Most of the objects’ pixels right, to 10 mm: Structured light, 88.0 %"
    for two in ([wrong, right], [right, wrong]):
        assert f"{best} (against 51.0 %)." in _side_by_side(*two)
    assert f"{best} (next: Time of flight (direct), 85.0 %)." in _side_by_side(wrong, fair, right)
    assert "97.0" not in _side_by_side(wrong, right)
    assert "pixels right" not in _side_by_side(right, _measured("amcw", cup=(0.88, 0.12, 5e-3)))


def test_a_scene_that_no_sensor_reads_has_no_winner() -> None:
    blind = _measured("amcw", cup=(0.0, 1.0, 5e-2), pot=(0.2, 0.8, 5e-2), jar=(0.1, 0.9, 1e-2))
    poor = _measured("lines", cup=(0.1, 0.1, 1e-3), pot=(0.9, 0.0, 1e-3), jar=(0.2, 0.0, 1e-3))
    said = _side_by_side(blind, poor)
    assert said == (
        "No sensor reads most of the objects’ pixels right, to 10 mm; Structured light reads most, 40.0 %, "
        "and 3.3 % wrong. "
        "No sensor is right on most of these objects: cup (at best 10 %, Structured light), "
        "jar (at best 20 %, Structured light)."
    )
    assert _side_by_side(poor, blind) == said
    nothing = _side_by_side(_measured("amcw", cup=(0.0, 1.0, 5e-2)), _measured("lines", cup=(0.0, 0.0, 1e-3)))
    assert nothing.startswith("No sensor reads any of the pixels of cup right, to 10 mm. ")


def test_without_objects_the_verdict_is_about_materials() -> None:
    scene = _measured("lines", kind="material", gloss=(0.4, 0.6, 1e-2), matte=(0.9, 0.0, 1e-3))
    (finding,) = verdict([scene])
    text = finding.text.replace("\xa0", " ")
    assert "reads 65.0 % of the pixels right, to 10 mm, and 30.0 % wrong; 5.0 % are missing." in text
    assert (
        "Most pixels are right on 1 of 2 materials (matte); worst: gloss (40 % right, 60 % wrong, 0 % missing" in text
    )


def test_no_measurement_is_bold_for_being_there() -> None:
    wrong = _measured("amcw", cup=(0.58, 0.39, 5e-3))
    right = _measured("lines", cup=(0.89, 0.01, 1e-3))
    assert _bold(wrong, right) == {"amcw": [], "lines": ["right", "wrong", "median error", "95\xa0% within"]}


def test_no_bold_where_a_sensor_is_unreliable() -> None:
    good = _measured("lines", cup=(0.98, 0.01, 5e-3))
    fair = _measured("histogram", cup=(0.88, 0.02, 6e-3))
    few = _measured("amcw", cup=(0.1, 0.0, 1e-3))  # the best error, on the tenth that is left
    assert [name for name, columns in _bold(good, fair, few).items() if columns] == ["lines"]
    assert not any(_bold(good, few).values())


def test_automatic_exposures_are_said() -> None:
    cup = (0.98, 0.01, 5e-3)
    chosen = _measured("lines", acquisition_s=0.2, is_automatic=True, cup=cup)
    stated = _measured("amcw", acquisition_s=0.1, cup=cup)
    said = verdict([chosen, stated])[-1]
    assert said.subject == "Exposure"
    assert said.text.startswith("is automatic: Structured light 20 ms per frame.")
    assert "AMCW" not in said.text
    assert "Exposure" not in [finding.subject for finding in verdict([stated])]
    assert [tables.exposure(m.metadata) for m in (chosen, stated)] == ["20 ms automatic", "10 ms"]


def test_the_page_says_which_exposures_are_automatic(html: str) -> None:
    assert ", seed 3, exposure automatic<" in html
    for m in load_result(small_result()).measurements:
        assert m.metadata.exposure_is_automatic == m.capture.reference.exposure_is_automatic
        assert m.metadata.exposure_is_automatic != m.capture.sensor.is_ideal
        assert (f"<td>{tables.seconds(m.metadata.exposure_s)} automatic</td>" in html) != m.capture.sensor.is_ideal


def _bold(*measurements: Any) -> dict[str, list[str]]:
    """Titles of the bold columns of each instrument, in the rows for all surfaces."""
    outcomes, errors = tables.outcome_table(measurements), tables.comparison_table(measurements)
    columns = (*tables.OUTCOMES, *tables.COLUMNS)
    return {
        line.name: [c.title for c, cell in zip(columns, (*line.cells, *cells), strict=True) if cell.best]
        for line, (_, cells) in zip(dict(outcomes)["all"], dict(errors)["all"], strict=True)
    }


def _measured(
    sensor: str, acquisition_s: float = 0.1, kind: str = "object", is_automatic: bool = False, **surfaces: Any
) -> Any:
    """A measurement, from the fractions right and wrong and the median error, metres, of each of its surfaces."""
    surfaces["all"] = np.mean(list(surfaces.values()), axis=0).tolist()
    rows = []
    for name, (right, wrong, median) in surfaces.items():
        row = {"right": right, "wrong": wrong, "missing": 1 - right - wrong, "completeness": right + wrong}
        row |= {"median_abs_m": median, "p95_abs_m": 3 * median}
        row |= {column.key: None for column in tables.COLUMNS if column.key not in row} | {"invented_readings": None}
        causes = {"multipath": 0.8 * (1 - right), "low_signal": 0.2 * (1 - right)}
        rows.append({"kind": "all" if name == "all" else kind, "name": name, **row, "causes": causes})
    return SimpleNamespace(
        name=sensor,
        objects=None,
        capture=SimpleNamespace(sensor=SENSORS[sensor]),
        camera=Intrinsics.from_fov(4, 3, fov_x_deg=40.0),
        rows=with_mean_over_objects(rows),
        metadata=SimpleNamespace(
            acquisition_s=acquisition_s, frames=10, exposure_s=acquisition_s / 10, exposure_is_automatic=is_automatic
        ),
        causes=CauseMap(np.zeros((3, 4), np.uint8), 0.01),
    )


@needs_browser
def test_it_draws_without_errors(tmp_path: Path) -> None:
    """No message on the console, a picture that is not blank, and points in every cloud."""
    picture = tmp_path / "report.png"
    log = _browse(tmp_path, "color=error", f"--screenshot={picture}", "--window-size=1280,12000")
    # software rendering remarks on its own speed when the picture is taken
    said = [line for line in log.splitlines() if "CONSOLE" in line and "GL Driver Message" not in line]
    assert said == []
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB"))
    assert np.mean(pixels.std(axis=2) > 5) > 0.02  # colours
    assert np.mean((pixels > 250).all(axis=2)) > 0.2  # on paper
    background = (np.abs(pixels.astype(int) - CANVAS) <= 2).all(axis=2)
    rows = np.flatnonzero(background.sum(axis=1) > 100)
    assert len(rows) > 100, "no canvas of a point cloud found"
    area = pixels[rows.min() : rows.max()]
    for i in range(3):  # three clouds side by side; the fourth is below
        panel = area[: len(area) // 3, 90 + i * 380 : 90 + i * 380 + 300]
        drawn = (np.abs(panel.astype(int) - CANVAS) > 12).any(axis=2).mean()
        assert 0.1 < drawn < 0.99, f"cloud {i + 1}: {100 * drawn:.0f} % drawn"


@needs_browser
@pytest.mark.parametrize("cut", ["usual", *to_validate("Infinity", "-1")])
def test_the_slider_cuts_the_trees(tmp_path: Path, cut: str) -> None:
    """Numbers of segments in the page: one, those of the default cut, and all supervoxels."""
    page = _browse(tmp_path, "" if cut == "usual" else f"altitude={cut}", "--dump-dom", console=False)
    assert 'data-ready="yes"' in page
    shown = [int(n) for n in re.findall(r'<div class="note">(\d+) segments', page)]
    expected = []
    for m in load_result(small_result()).measurements:
        assert m.segmentation is not None
        counts = {"Infinity": 0, "usual": m.segmentation.labels.max(), "-1": m.segmentation.supervoxels.max()}
        expected.append(int(counts[cut]) + 1)
    assert shown == expected
    if cut == "Infinity":
        assert 'id="altitude">whole scene<' in page


@needs_browser
@pytest.mark.validation
def test_slider_mouse_and_wheel_work(tmp_path: Path) -> None:
    """The slider at its coarse end joins everything; a map reads out; dragging turns, the wheel zooms."""
    with browser(tmp_path) as page:
        page.open(small_result() / "report.html")
        page.click("#level", x=0.01)
        assert page.evaluate("document.querySelector('#altitude').textContent") == "whole scene"
        assert page.evaluate("page.mode") == "segments"
        notes = page.evaluate("[...document.querySelectorAll('canvas.labels + .note')].map((n) => n.textContent)")
        assert [re.match(r"(\d+) segments", note)[1] for note in notes] == ["1"] * len(SENSORS)
        page.mouse("mouseMoved", page.place(".map", 0.5, 0.9))
        said = page.evaluate("document.querySelector('#probe').innerHTML")
        assert re.search(r"<b>\(\d\d, \d\d\)</b> matte: .* error [+−]\d+\.\d\d mm", said)
        page.drag("canvas.cloud", 50)
        assert page.evaluate("page.view.yaw") > -0.45
        page.mouse("mouseWheel", page.place("canvas.cloud"), deltaX=0, deltaY=-300)
        page.wait_for("page.view.zoom > 1")
        assert page.evaluate("page.view.zoom") == pytest.approx(np.exp(0.45))


CLOUD = """(() => { const { canvas: one } = page.clouds[%d], copy = document.createElement("canvas");
    page.clouds.forEach((cloud) => cloud.draw());  // in this very task, as a picture does not stay
    copy.width = one.width; copy.height = one.height;
    const context = copy.getContext("2d"); context.drawImage(one, 0, 0);
    return [one.height, one.width, ...context.getImageData(0, 0, one.width, one.height).data]; })()"""


def _clouds(folder: Path, options: tuple[str, ...], state: str) -> tuple[list[np.ndarray], dict[str, Any]]:
    """(h, w, 3) colours of each cloud, and what the page says."""
    folder.mkdir()
    with browser(folder, options) as page:
        page.open(small_result() / "report.html", state)
        clouds = []
        for i in range(len(SENSORS)):
            height, width, *pixels = page.evaluate(CLOUD % i)
            clouds.append(np.array(pixels, float).reshape(height, width, 4)[..., :3])
        page.drag("canvas.cloud", 50)
        notes = "[...document.querySelectorAll('canvas.%s + .note')].map((n) => n.textContent)"
        return clouds, {
            "errors": page.said,
            "turning": page.evaluate("document.querySelector('#turning').textContent"),
            "yaw": page.evaluate("page.view.yaw"),
            "points": page.evaluate(notes % "cloud"),
            "segments": page.evaluate(notes % "labels"),
        }


@needs_browser
@pytest.mark.parametrize("mode", ["error", *to_validate("intensity", "segments")])
@pytest.mark.validation
def test_without_webgl_the_clouds_are_still_pictures(tmp_path: Path, mode: str) -> None:
    """The same pictures as WebGL draws, with all captions, a sentence and no uncaught error."""
    still, said = _clouds(tmp_path / "without", WITHOUT_WEBGL, f"color={mode}")
    drawn, usual = _clouds(tmp_path / "with", OPTIONS, f"color={mode}")
    assert said["errors"] == usual["errors"] == []
    assert said["turning"].startswith("This browser has no WebGL")
    assert usual["turning"].startswith("Drag to turn")
    assert said["yaw"] == -0.45 < usual["yaw"]
    assert [said["points"], said["segments"]] == [usual["points"], usual["segments"]]
    assert all(re.match(r"[\d,]+ points", note) for note in said["points"])
    for one, other in zip(still, drawn, strict=True):
        assert one.shape == other.shape
        ground = [(np.abs(picture - CANVAS) <= 2).all(axis=2) for picture in (one, other)]
        assert (ground[0] == ground[1]).mean() > 0.97
        np.testing.assert_allclose(one.mean(axis=(0, 1)), other.mean(axis=(0, 1)), atol=3)
        if mode != "error":  # of neighbours whose errors differ, chance says which is in front
            assert (np.abs(one - other).max(axis=2) < 24).mean() > 0.9


def test_photons_per_pulse_have_two_digits() -> None:
    shown = {0.0: "0", 2e-4: "< 0.001", 0.0213: "0.021", 0.213: "0.21", 2.13: "2.1", 21.3: "21", 21300.0: "21 300"}
    for value, text in shown.items():
        said = tables.photons(PhotonsRecord(median=value, largest=3e4))
        assert said == f"{text} photons detected per pulse in the median pixel, 30 000 in the brightest"


def _with_long_names(count: int) -> Result:
    """The small result with so many measurements, of which two have the same sensor and names of 40 characters."""
    result = load_result(small_result())
    lines = result.measurements[0]
    twins = tuple(replace(lines, name=f"left_camera_of_{letter * 25}") for letter in "ab")
    measurements = (*twins, *result.measurements[1:])[:count]
    return replace(result, measurements=measurements, passes=result.passes[: max(m.light_pass for m in measurements)])


@needs_browser
@pytest.mark.parametrize(
    ("count", "paper", "points"),
    [(5, "A4", (595, 842)), *to_validate((1, "letter", (612, 792)), (2, "A4", (595, 842)))],
)
def test_it_prints_on_two_pages(count: int, paper: str, points: tuple[int, int]) -> None:
    assert BROWSER is not None
    pdf = pdf_of(render_report(_with_long_names(count), paper), BROWSER)
    sizes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    assert [(round(float(w)), round(float(h))) for w, h in sizes] == [points, points]


@needs_browser
@pytest.mark.parametrize("width", to_validate(1280, 400))
def test_nothing_is_cut_when_it_prints(tmp_path: Path, width: int) -> None:
    """Also in a narrow window, and in dark mode: what is printed does not depend on the window."""
    write_report(_with_long_names(5), tmp_path / "report.html")
    with browser(tmp_path) as page:
        page.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
        dark = [{"name": "prefers-color-scheme", "value": "dark"}]
        page.call("Emulation.setEmulatedMedia", features=dark)
        page.open(tmp_path / "report.html")
        page.evaluate("dispatchEvent(new Event('beforeprint'))")
        page.call("Emulation.setEmulatedMedia", media="print", features=dark)
        sheets = page.evaluate("""[...document.querySelectorAll(".sheet")].map((sheet) => {
            const { right, height } = sheet.getBoundingClientRect();
            const outside = [...sheet.querySelectorAll("*")].filter((e) => e.getBoundingClientRect().right > right + 1);
            return [height, outside.map((e) => e.outerHTML.slice(0, 99))]; })""")
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    for height, outside in sheets:
        assert height <= 255 / 25.4 * 96  # of Letter, within margins of 12 mm
        assert outside == []


@needs_browser
@pytest.mark.validation
def test_tables_wider_than_the_page_say_that_they_scroll(tmp_path: Path) -> None:
    with browser(tmp_path) as page:
        check_scroll_hints(page, small_result() / "report.html")


def _unpacked(text: str, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype).reshape(shape)


def test_each_instrument_has_the_size_camera_and_truth_of_its_own(tmp_path: Path) -> None:
    result = result_of_two_cameras()
    write_result(result, tmp_path, {})
    html = render_report(load_result(tmp_path))
    assert "96 × 72 and 64 × 36 pixels" in html
    assert [int(n) for n in re.findall(r"<h3>Camera (\d), \d+ × \d+ pixels<", html)] == [1, 2]
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', html)
    data = json.loads(text)
    assert [one["view"] for one in data["instruments"]] == [0, 1]
    for one, m in zip(data["instruments"], result.measurements, strict=True):
        height, width = m.truth.z.shape
        assert (one["width"], one["height"]) == (width, height)
        z, step = _unpacked(one["z"], "<u2", (height, width)), one["stepM"]
        drawn = z > 0
        assert drawn.any()
        np.testing.assert_allclose(one["nearM"] + (z[drawn] - 1.0) * step, m.image.z[drawn], atol=step)
        seen = data["passes"][one["lightPass"]]
        assert seen["materials"] == list(m.truth.material_names)
        assert (_unpacked(seen["material"], "i1", (height, width)) == m.truth.material).all()


def test_instruments_share_a_camera_where_it_stands_in_one_place() -> None:
    measurements = load_result(small_result()).measurements
    assert by_camera(measurements) == [list(measurements)]
    first, *others = measurements
    rig = first.capture.rig
    assert rig is not None
    T = rig.T_world_camera.copy()
    T[:3, 3] += 0.01
    moved = replace(first, capture=replace(first.capture, rig=replace(rig, T_world_camera=T)))
    assert by_camera([*others, moved]) == [others, [moved]]


@needs_browser
@pytest.mark.validation
def test_two_cameras_are_drawn_side_by_side(tmp_path: Path) -> None:
    """Each cloud fills its canvas, and a map marks a pixel in the maps of its own camera alone."""
    write_report(result_of_two_cameras(), tmp_path / "report.html")
    marked = """[...document.querySelectorAll(".map")].filter((m) => m.querySelector("i").style.display === "block")
        .map((m) => +m.dataset.instrument)"""
    with browser(tmp_path) as page:
        page.open(tmp_path / "report.html", "color=material")
        assert page.said == []
        for i in range(2):
            height, width, *pixels = page.evaluate(CLOUD % i)
            cloud_drawn = np.array(pixels, float).reshape(height, width, 4)[..., :3]
            drawn = (np.abs(cloud_drawn - CANVAS) > 12).any(axis=2)
            assert 0.3 < drawn.mean() < 0.99
            assert drawn[:, [0, -1]].mean() < 0.5  # no side is cut off
        for instrument, title in enumerate(("Ideal time of flight", "Time of flight (AMCW)")):
            page.mouse("mouseMoved", page.place(f'.map[data-instrument="{instrument}"]', 0.5, 0.9))
            assert page.evaluate(marked) == [instrument] * 3
            said = page.evaluate("document.querySelector('#probe').innerHTML")
            assert re.search(r"^<b>\(\d\d, \d\d\)</b> matte: <b>", said)
            assert re.findall(r": <b>([^<]*)</b>", said) == [title]


def _browse(folder: Path, state: str, *options: str, console: bool = True, path: Path | None = None) -> str:
    """What headless Chromium prints about the report, on the console or of its document."""
    assert BROWSER is not None
    quiet = ("disable-background-networking", "disable-component-update", "disable-sync", "no-first-run", "no-sandbox")
    command = [
        BROWSER,
        "--headless",
        *(f"--{o}" for o in quiet),
        "--disable-gpu",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--enable-logging=stderr",
        "--hide-scrollbars",
        "--virtual-time-budget=10000",
        f"--user-data-dir={folder / 'profile'}",
        *options,
        f"file://{path or small_result() / 'report.html'}#{state}",
    ]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr[-2000:]
    return run.stderr if console else run.stdout


def test_ideal_sensors_alone_have_a_verdict_without_empty_paragraphs() -> None:
    """They are equal in all that sensors are compared by side by side."""
    instruments = (Instrument("one", IdealToF()), Instrument("two", IdealToF()))
    result = carry_out(Experiment(str(SCENES / "plane.xml"), width=16, height=12, spp=1, instruments=instruments))
    assert [f.text != "" for f in verdict(result.measurements)] == [True, True]
    assert "Ideal time of flight" in render_report(result)


def test_the_clouds_page_holds_every_reading_with_its_cause_and_its_segment() -> None:
    result = load_result(small_result())
    page = render_clouds_page(result)
    for number, m in enumerate(result.measurements):
        block = re.search(rf'id="cloud-{number}">(.*?)</script>', page)
        assert block
        data = json.loads(block[1])
        valid = m.image.valid.ravel()
        assert data["count"] + data["far"] == valid.sum()
        rows = _unpacked(data["index"], "<u4", (-1,))
        columns = {column["name"]: column for column in data["columns"]}
        causes = np.array(columns["cause"]["values"])[_unpacked(columns["cause"]["keys"], "<u2", (-1,)) - 1]
        assert (causes == np.array(palette.OUTCOME_NAMES)[palette.outcomes(m).ravel()[rows]]).all()
        error = columns["error"]
        assert error["unit"] == "mm"
        keys = _unpacked(error["keys"], "<u2", (-1,))
        wanted = 1e3 * (m.image.reading_m - m.true_m).ravel()[rows]
        known = keys > 0
        assert (known == np.isfinite(wanted)).all()
        np.testing.assert_allclose(
            error["low"] + error["step"] * (keys[known] - 1.0), wanted[known], atol=error["step"]
        )
        assert m.segmentation is not None
        leaf = _unpacked(data["tree"]["leaf"], "<u2", (-1,)).astype(int) - 1
        assert (leaf == m.segmentation.supervoxels.ravel()[rows]).all()
        objects = np.append(_unpacked(data["tree"]["objects"], "<i4", (-1,)), -1)[leaf]
        assert (objects == m.segmentation.labels.ravel()[rows]).all()


def test_view_writes_a_page_and_replaces_none(tmp_path: Path) -> None:
    target = tmp_path / "clouds.html"
    arguments = ["view", str(small_result()), "--out", str(target)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    size = target.stat().st_size
    assert size > 600_000
    again = CliRunner().invoke(app, arguments)
    assert again.exit_code == 1
    assert "add --overwrite" in str(again.exception)
    assert target.stat().st_size == size
