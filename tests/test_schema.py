# SPDX-License-Identifier: Apache-2.0
"""A damaged result is one sentence that names file and place, never a traceback and never a wrong report."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_result import small_result

from rangesim.errors import FileFormatError
from rangesim.report import render_report
from rangesim.results.experiment_results import load_result

Edit = Callable[[Any], object]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("schema") / "result"
    shutil.copytree(small_result(), folder)
    return folder


def edit_json(path: Path, edit: Edit) -> None:
    data = json.loads(path.read_text())
    edit(data)
    path.write_text(json.dumps(data))


def edit_arrays(path: Path, edit: Edit) -> None:
    with np.load(path) as file:
        arrays = dict(file)
    edit(arrays)
    np.savez_compressed(path, **arrays)


def put(name: str, value: Any) -> Edit:
    """Set `name`, a dotted path of keys and indices."""

    def edit(data: Any) -> None:
        *way, last = [int(key) if key.isdigit() else key for key in name.split(".")]
        for key in way:
            data = data[key]
        data[last] = value

    return edit


def drop(name: str) -> Edit:
    return lambda data: data.pop(name)


JSON_DAMAGES: list[tuple[str, Edit, str]] = [
    ("experiment.json", put("format_version", 2), r"expected format version 1, got 2"),
    ("experiment.json", drop("format_version"), r"expected format version 1, got None"),
    ("experiment.json", put("format", "other"), r"expected format 'rangesim-result', got 'other'"),
    ("experiment.json", put("passes", "2"), r"expected int, got str, at passes"),
    ("experiment.json", put("passes", -1), r"expected int >= 0, at passes"),
    ("experiment.json", put("passes", 7), r"each of 7 passes to serve an instrument"),
    ("experiment.json", put("scene.working_distance_m", -1.0), r"expected float > 0.*, at scene.working_distance_m"),
    ("experiment.json", put("scene", None), r"expected .*, got null, at scene"),
    ("experiment.json", put("versions.python", 3), r"expected str, got int, at versions"),
    ("experiment.json", put("surplus", 1), r"unknown field surplus"),
    ("experiment.json", put("instruments.0.name", "../../etc"), r"expected the instruments .* as in its experiment"),
    ("experiment.json", put("experiment.instrument.0.name", "../../etc"), r"expected a name of letters"),
    ("experiment.json", put("experiment.spp", 10**30), r"spp"),
    ("experiment.json", put("times_s.transport_1", -1), r"expected float >= 0"),
    ("experiment.json", lambda d: d["times_s"].pop("transport_2"), r"expected the time transport_2"),
    ("lines/comparison.json", put("rows.0.completeness", 1.5), r"expected float <= 1.0, at rows\[0\].completeness"),
    ("lines/comparison.json", put("rows.0.causes.evil", 0.1), r"unknown cause 'evil'"),
    ("lines/comparison.json", put("rows.0.causes", {}), r"to add up to what is wrong or missing"),
    ("lines/comparison.json", put("rows.0.right", 0.0), r"right, wrong and missing of 'objects' to add up to 1"),
    ("lines/comparison.json", put("format_version", 1), r"expected format version 2, got 1; write it anew"),
    ("lines/comparison.json", lambda d: d["rows"].pop(), r"one row per object and material, one 'all'"),
    ("lines/comparison.json", lambda d: d["rows"].append(d["rows"][0]), r"one row per object and material"),
    ("lines/objects.json", put("objects.0.outcome", "lost"), r"Invalid enum value 'lost', at objects"),
    ("lines/objects.json", put("objects.0.covering", 1.5), r"expected float <= 1.0, at objects"),
    ("lines/objects.json", put("invented", -1), r"expected int >= 0, at invented"),
    ("lines/measurement.json", put("pixels", 0), r"expected sensor, frames and pixels of the capture"),
    ("lines/measurement.json", put("exposure_s", 0.0), r"expected float > 0"),
    ("histogram/measurement.json", put("photons_per_pulse", {"median": 1.0, "largest": -1.0}), r"expected float >= 0"),
    ("histogram/measurement.json", put("photons_per_pulse", {"median": 1.0}), r"missing required field"),
    ("lines/capture/capture.json", put("rig.camera.fx", 1e308), r"fx"),
    ("lines/capture/capture.json", put("rig", None), r"expected a rig"),
]

ARRAY_DAMAGES: list[tuple[str, Edit, str]] = [
    ("pass_1.npz", drop("truth_z"), r"expected an array 'truth_z'"),
    ("pass_1.npz", put("more", np.zeros(3)), r"got 'more' as well"),
    ("pass_1.npz", put("truth_z", np.zeros((90, 120), np.float64)), r"'truth_z': expected float32, got float64"),
    ("pass_1.npz", put("truth_z", np.ones((9, 12), np.float32)), r"expected shape 90 x 120, got 9 x 12"),
    ("pass_2.npz", put("energy_direct", np.ones((9, 12), np.float32)), r"expected shape 90 x 120, got 9 x 12"),
    ("pass_1.npz", put("energy_direct", np.full((90, 120), np.nan, np.float32)), r"expected numbers, got NaN"),
    ("pass_1.npz", put("energy_direct", np.full((90, 120), -1, np.float32)), r"expected values from 0 to"),
    ("pass_1.npz", put("truth_instance", np.full((90, 120), 99, np.int32)), r"expected indices into"),
    ("pass_1.npz", put("truth_material_names", np.zeros(2)), r"expected str, got float64"),
    ("lines/range.npz", put("status", np.full((90, 120), 77, np.uint8)), r"expected values from .* to 7"),
    ("lines/range.npz", put("status", np.zeros((90, 120), np.uint8)), r"expected z to be finite where status is 0"),
    ("lines/range.npz", put("z", np.full((90, 120), np.inf, np.float32)), r"expected finite values, got infinity"),
    ("lines/causes.npz", put("cause", np.full((90, 120), 200, np.uint8)), r"expected values from"),
    ("lines/causes.npz", put("tolerance_m", np.array(np.nan)), r"expected numbers, got NaN"),
    ("lines/segmentation.npz", put("parents", np.zeros(5, np.int32)), r"expected shape .*, got|binary tree"),
    ("lines/segmentation.npz", lambda d: d["parents"].__setitem__(0, 0), r"binary tree"),
    ("lines/segmentation.npz", lambda d: d["parents"].__setitem__(0, 2**31 - 1), r"binary tree"),
    ("lines/segmentation.npz", lambda d: d["altitudes"].__setitem__(0, 50), r"binary tree"),
    ("lines/segmentation.npz", lambda d: d["supervoxels"].__setitem__(0, 10**6), r"indices below the number of leaves"),
]


@pytest.mark.parametrize(("name", "edit", "message"), [*JSON_DAMAGES, *ARRAY_DAMAGES])
def test_damaged_results_are_refused(original: Path, name: str, edit: Edit, message: str) -> None:
    path = original / name
    before = path.read_bytes()
    try:
        (edit_arrays if path.suffix == ".npz" else edit_json)(path, edit)
        with pytest.raises(FileFormatError, match=message) as caught:
            render_report(load_result(original))
        assert str(path.parent) in str(caught.value)
        assert len(str(caught.value)) < 700
        assert "\n" not in str(caught.value)
    finally:
        path.write_bytes(before)


def test_results_that_do_not_tell_of_objects_are_read(original: Path) -> None:
    """As older versions wrote them: no `objects.json`, no objects in the pass, none in the settings."""
    paths = [original / name for name in ("lines/objects.json", "pass_1.npz", "experiment.json")]
    before = [path.read_bytes() for path in paths]
    try:
        paths[0].unlink()
        edit_arrays(paths[1], drop("truth_instance_objects"))
        edit_json(paths[2], lambda d: [shape.pop("object") for shape in d["scene"]["shapes"]])
        result = load_result(original)
        assert result.measurements[0].objects is None
        assert result.measurements[0].truth.object_names == ()
        assert "Structured light" in render_report(result)
    finally:
        for path, content in zip(paths, before, strict=True):
            path.write_bytes(content)


@pytest.mark.parametrize("name", ["experiment.json", "pass_1.npz", "lines/range.npz", "lines/comparison.json"])
@pytest.mark.parametrize("content", [b"", b"\0", b"PK\x03\x04", b"[" * 100_000, b"\xff\xfe{}", b"null", None])
def test_files_that_are_something_else_are_refused(original: Path, name: str, content: bytes | None) -> None:
    path = original / name
    before = path.read_bytes()
    try:
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(FileFormatError) as caught:
            load_result(original)
        assert path.name in str(caught.value)
        assert "\n" not in str(caught.value)
    finally:
        path.write_bytes(before)
