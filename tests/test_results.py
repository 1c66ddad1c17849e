# SPDX-License-Identifier: Apache-2.0
"""Records of directories: what is computed, what is written, and what is read back are one and the same."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_result import small_experiment, small_result
from typer.testing import CliRunner

from rangesim import load_capture
from rangesim.cli import app
from rangesim.decoding import decode
from rangesim.errors import FileFormatError
from rangesim.experiment import ScanSettings, Turntable
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.experiment_run import carry_out
from rangesim.pipeline.scan_run import run_scan
from rangesim.report import render_report
from rangesim.report.figures import map_pictures
from rangesim.report.scan_page import render_scan_page
from rangesim.results.decoded_captures import Decoded, load_decoded, save_decoded
from rangesim.results.experiment_results import Result, load_result
from rangesim.results.scan_results import load_scan
from rangesim.sensors import IdealToF


def assert_equal(one: Any, two: Any, place: str = "it") -> None:
    """Assert that nested dataclasses, tuples and arrays hold the same, byte for byte; 16 may become 16.0."""
    assert type(one) is type(two) or {type(one), type(two)} == {int, float}, place
    if isinstance(one, np.ndarray):
        assert (one.shape, one.dtype) == (two.shape, two.dtype), place
        assert one.tobytes() == two.tobytes(), place
    elif dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            assert_equal(getattr(one, field.name), getattr(two, field.name), f"{place}.{field.name}")
    elif isinstance(one, (tuple, list)):
        assert len(one) == len(two), place
        for k, (a, b) in enumerate(zip(one, two, strict=True)):
            assert_equal(a, b, f"{place}[{k}]")
    elif isinstance(one, dict):
        assert list(one) == list(two), place
        for key in one:
            assert_equal(one[key], two[key], f"{place}[{key!r}]")
    else:
        assert one == two or (one != one and two != two), place


def without_times(result: Result) -> Result:
    measurements = tuple(dataclasses.replace(m, metadata=replace_times(m.metadata)) for m in result.measurements)
    return dataclasses.replace(result, measurements=measurements, info=replace_times(result.info))


def replace_times(record: Any) -> Any:
    values = {name: getattr(record, name) for name in record.__struct_fields__}
    return type(record)(**{**values, "times_s": {}})


@pytest.fixture(scope="module")
def computed() -> Result:
    return carry_out(small_experiment())


def test_what_is_computed_is_what_is_written_and_read_back(computed: Result) -> None:
    assert_equal(without_times(computed), without_times(load_result(small_result())))


def test_nothing_is_written_where_an_experiment_is_carried_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    experiment = dataclasses.replace(
        small_experiment(), instruments=(Instrument("ideal", IdealToF()),), width=16, height=12
    )
    assert len(carry_out(experiment).measurements) == 1
    assert list(tmp_path.iterdir()) == []


def test_the_report_of_a_result_is_that_of_its_files() -> None:
    assert (small_result() / "report.html").read_text() == render_report(load_result(small_result()))


@pytest.fixture(scope="module")
def scan_directory(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    folder = tmp_path_factory.mktemp("scan") / "scan"
    settings = ScanSettings("matte", width=48, height=36, spp=4, path=Turntable(views=3), voxel_m=0.02)
    return run_scan(settings, folder), folder


def test_a_scan_is_read_back_as_it_was(scan_directory: tuple[Any, Path]) -> None:
    """But for the ground truth of each view, which is not kept."""
    result, folder = scan_directory
    found = load_scan(folder)
    plain = dataclasses.replace(result, scan=dataclasses.replace(result.scan, truths=()))
    assert_equal(plain, found)
    assert (folder / "report.html").read_text() == render_scan_page(found)


@pytest.mark.validation
def test_the_page_of_a_scan_is_written_again_from_its_files(scan_directory: tuple[Any, Path], tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(scan_directory[1], folder)
    before = (folder / "report.html").read_bytes()
    (folder / "report.html").unlink()
    assert CliRunner().invoke(app, ["report", str(folder)]).exit_code == 0
    assert (folder / "report.html").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("scan.json", "no rangesim-scan directory"),
        ("mesh.ply", "mesh.ply"),
        ("truth.npz", "truth.npz is missing"),
        ("poses.json", "poses.json"),
        ("view_02/range.npz", "range.npz is missing"),
    ],
)
def test_a_scan_that_lacks_a_file_is_refused(
    scan_directory: tuple[Any, Path], tmp_path: Path, name: str, words: str
) -> None:
    shutil.copytree(scan_directory[1], tmp_path / "copy")
    (tmp_path / "copy" / name).unlink()
    with pytest.raises(FileFormatError, match=words):
        load_scan(tmp_path / "copy")


@pytest.mark.parametrize("cut", [1, 40])
def test_a_mesh_that_ends_early_is_refused(scan_directory: tuple[Any, Path], tmp_path: Path, cut: int) -> None:
    shutil.copytree(scan_directory[1], tmp_path / "copy")
    mesh = tmp_path / "copy" / "mesh.ply"
    mesh.write_bytes(mesh.read_bytes()[:-cut])
    with pytest.raises(FileFormatError, match="expected a mesh that rangesim wrote, complete"):
        load_scan(tmp_path / "copy")


def test_a_scan_with_other_statistics_than_its_files_is_refused(
    scan_directory: tuple[Any, Path], tmp_path: Path
) -> None:
    shutil.copytree(scan_directory[1], tmp_path / "copy")
    sidecar = tmp_path / "copy" / "scan.json"
    record = json.loads(sidecar.read_text())
    record["statistics"]["things"].append("a shape of no scene")
    sidecar.write_text(json.dumps(record))
    with pytest.raises(FileFormatError, match="expected things out of its shapes"):
        load_scan(tmp_path / "copy")


def test_a_decoded_capture_is_read_back_as_it_was(tmp_path: Path) -> None:
    capture = load_capture(small_result() / "lines" / "capture")
    image = decode(capture)
    decoded = Decoded(image, capture.sensor, capture.rig, {"ok": 1.0}, "a cause")
    save_decoded(decoded, tmp_path / "out", map_pictures(image))
    found = load_decoded(tmp_path / "out")
    assert_equal(image, found.image)
    assert (found.sensor, found.status, found.likely_cause) == (capture.sensor, {"ok": 1.0}, "a cause")
    assert found.rig is not None
    assert {path.name for path in (tmp_path / "out").glob("*.png")} == {"columns.png", "depth.png", "status.png"}
