# SPDX-License-Identifier: Apache-2.0
"""Statistics of errors that were put in by hand."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from synthetic import plane_signals, stereo_rig

from rangesim import IdealToF, decode, expose
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.evaluation.comparison import compare
from rangesim.report import errors_markdown, tables
from rangesim.signals import GroundTruth


def truth_of(z: np.ndarray, material: np.ndarray, visible: np.ndarray | None = None) -> GroundTruth:
    shape = z.shape
    return GroundTruth(
        z=z.astype(np.float32),
        range_m=z.astype(np.float32),
        normal=np.zeros((*shape, 3), np.float32),
        instance=material,
        material=material,
        projector_uv=np.zeros((*shape, 2), np.float32),
        projector_visible=np.isfinite(z) if visible is None else visible,
        instance_names=("left", "right", "unused"),
        material_names=("matte", "glass", "unused"),
    )


def image_of(z: np.ndarray) -> RangeImage:
    status = np.where(np.isfinite(z), Status.OK, Status.LOW_SIGNAL).astype(np.uint8)
    return RangeImage(z, z, np.ones_like(z), status, np.ones_like(z))


def test_signals_stand_for_their_ground_truth() -> None:
    signals = plane_signals(stereo_rig(), IdealToF())
    image = decode(expose(signals, IdealToF()))
    assert compare(image, signals).rows() == compare(image, signals.truth).rows()


@pytest.fixture
def scene() -> tuple[np.ndarray, GroundTruth]:
    """Left half matte, right half glass at 1 m; the last row sees nothing."""
    z = np.ones((11, 20))
    z[10] = np.nan
    material = np.tile(np.where(np.arange(20) < 10, 0, 1), (11, 1)).astype(np.int32)
    material[10] = -1
    return z, truth_of(z, material)


def test_a_perfect_image_has_no_errors(scene: tuple[np.ndarray, GroundTruth]) -> None:
    z, truth = scene
    result = compare(image_of(z), truth)
    assert [row.name for row in result.table] == ["matte", "glass", "all"]
    for row in result.table:
        assert row.pixels == row.lit == (200 if row.kind == "all" else 100)
        assert (row.right, row.wrong, row.missing, row.completeness) == (1, 0, 0, 1)
        assert row.bias_m == row.median_abs_m == row.rmse_m == row.p95_abs_m == 0
        assert row.edge_pixels == 0 or row.flying_rate == 0


def test_errors_come_out_per_class(scene: tuple[np.ndarray, GroundTruth]) -> None:
    z, truth = scene
    measured = z.copy()
    measured[:, :10] += 0.002
    measured[:5, 10:] = np.nan
    measured[5:, 10:] -= 0.050
    result = compare(image_of(measured), truth)
    matte, glass = result.row("matte"), result.row("glass")
    np.testing.assert_allclose([matte.bias_m, matte.median_abs_m, matte.rmse_m, matte.p95_abs_m], 0.002, atol=1e-6)
    assert (matte.right, matte.wrong, matte.missing) == (1, 0, 0)
    assert (glass.right, glass.wrong, glass.missing) == (0, 0.5, 0.5)
    assert glass.completeness == 0.5
    assert abs(glass.bias_m + 0.05) < 1e-6
    assert (result.row("all").right, result.row("all").wrong, result.row("all").missing) == (0.5, 0.25, 0.25)
    assert np.isnan(result.error_m[:5, 10:]).all()
    assert np.isnan(result.error_m[10]).all()
    np.testing.assert_allclose(result.error_m[:10, :10], 0.002, atol=1e-6)
    assert compare(image_of(measured), truth, tolerance_m=0.001).row("matte").wrong == 1


def test_shadow_is_no_incompleteness(scene: tuple[np.ndarray, GroundTruth]) -> None:
    z, truth = scene
    visible = np.isfinite(z)
    visible[:, :5] = False
    measured = np.where(visible, z, np.nan)
    row = compare(image_of(measured), dataclasses.replace(truth, projector_visible=visible)).row("matte")
    assert (row.pixels, row.lit, row.completeness) == (100, 50, 1.0)
    assert (row.right, row.wrong, row.missing) == (0.5, 0.0, 0.5)


def test_right_wrong_and_missing_add_up_and_follow_the_tolerance(scene: tuple[np.ndarray, GroundTruth]) -> None:
    z, truth = scene
    errors = np.random.default_rng(0).normal(0, 0.01, z.shape)
    measured = np.where(np.random.default_rng(1).random(z.shape) < 0.3, np.nan, z + errors)
    measured[0] = z[0]  # a perfect reading is right, whatever the tolerance
    before = np.zeros(3)
    for tolerance_m in (1e-12, 1e-3, 1e-2, 1e-1):
        rows = compare(image_of(measured), truth, tolerance_m).table
        for row in rows:
            assert row.right + row.wrong + row.missing == pytest.approx(1, abs=1e-12)
        right = np.array([row.right for row in rows])
        assert (right >= before).all()
        assert (right >= 0.1).all()
        before = right
    missing = np.isnan(measured[:10]).mean()
    assert (rows[-1].right, rows[-1].missing) == pytest.approx((1 - missing, missing))


def test_readings_of_pixels_that_see_no_surface_are_counted_apart() -> None:
    z = np.full((4, 5), 2.0)
    z[1:3] = np.nan
    measured = np.full(z.shape, 2.0)
    measured[1, :2] = np.nan
    instance = np.zeros(z.shape, np.int32)
    result = compare(image_of(measured), truth_of(z, instance))
    row = result.row("all")
    assert (row.pixels, row.right, row.wrong, row.missing, row.invented_readings) == (10, 1, 0, 0, 8)
    assert {other.invented_readings for other in result.table if other is not row} == {None}
    said = tables.invented_readings({"a": result.rows(), "b": compare(image_of(z), truth_of(z, instance)).rows()})
    assert "8 of a. " in said


def test_flying_pixels_lie_on_neither_side_of_an_edge() -> None:
    z = np.where(np.arange(20)[None, :] < 10, 1.0, 2.0) * np.ones((10, 1))
    truth = truth_of(z, np.zeros(z.shape, np.int32))
    measured = z.copy()
    measured[:, 9] = 1.5  # between both sides: flies
    measured[:, 10] = 1.0  # on the wrong side of the edge: wrong, but no flying pixel
    measured[:, 3] = 1.5  # far from the edge: wrong only
    result = compare(image_of(measured), truth)
    row = result.row("all")
    assert row.edge_pixels == 60
    assert result.flying.sum() == 10
    assert result.flying[:, 9].all()
    assert abs(row.flying_rate - 10 / 60) < 1e-9
    assert (row.right, row.wrong, row.missing) == (170 / 200, 30 / 200, 0)


def of_objects(sizes: dict[str, int], material: str = "matte") -> GroundTruth:
    """A row of pixels at 1 m, of objects of these sizes in pixels."""
    instance = np.repeat(np.arange(len(sizes)), list(sizes.values()))[None]
    truth = truth_of(np.ones(instance.shape), np.zeros_like(instance))
    names = tuple(sizes)
    return dataclasses.replace(
        truth, instance=instance, instance_names=names, instance_objects=names, material_names=(material,)
    )


def test_an_object_of_several_shapes_is_one_object_with_parts() -> None:
    """A cup of a body and a handle before a wall; background is no object, and a part weighs nothing of its own."""
    truth = of_objects({"body": 90, "handle": 10, "ball": 20, "wall": 80})
    truth = dataclasses.replace(truth, instance_objects=("cup", "cup", "ball", ""))
    measured = np.ones(truth.z.shape)
    measured[0, 90:100] = np.nan
    result = compare(image_of(measured), truth)
    names = ["objects", "cup", "ball", "body", "handle", "matte", "all"]
    assert [row.name for row in result.table] == names
    assert (result.row("cup").right, result.row("handle").right, result.row("body").right) == (0.9, 0.0, 1.0)
    assert result.row("handle").kind == "part"
    assert result.row("objects").right == pytest.approx(0.95)
    assert result.row("all").right == 0.95


@pytest.mark.parametrize("pixels", [8, 80, 8000])
def test_an_object_weighs_the_same_at_any_size(pixels: int) -> None:
    """The big one is right, the small one wrong by half and missing by half."""
    truth = of_objects({"big": pixels, "small": 8})
    measured = np.ones(truth.z.shape)
    measured[0, pixels : pixels + 4] = 1.1
    measured[0, pixels + 4 :] = np.nan
    result = compare(image_of(measured), truth)
    big, small, mean = result.row("big"), result.row("small"), result.row("objects")
    assert (big.right, big.wrong, big.missing) == (1, 0, 0)
    assert (small.right, small.wrong, small.missing) == (0, 0.5, 0.5)
    assert (mean.right, mean.wrong, mean.missing) == (0.5, 0.25, 0.25)
    assert mean.completeness == 0.75
    assert mean.median_abs_m == pytest.approx(0.05)
    assert mean.pixels == truth.z.size
    assert [row.kind for row in result.table] == ["objects", "object", "object", "material", "all"]


def test_an_object_without_readings_leaves_the_mean_error_to_the_others() -> None:
    truth = of_objects({"seen": 8, "blind": 8})
    measured = np.where(np.arange(16)[None] < 8, 1.002, np.nan)
    result = compare(image_of(measured), truth)
    assert math.isnan(result.row("blind").median_abs_m)
    assert result.row("objects").median_abs_m == pytest.approx(0.002, abs=1e-6)
    assert (result.row("objects").right, result.row("objects").missing) == (0.5, 0.5)
    unread = compare(image_of(np.full_like(measured, np.nan)), truth)
    assert unread.rows()[0]["median_abs_m"] is None


def test_an_object_and_a_material_of_one_name_are_told_apart_by_kind() -> None:
    truth = of_objects({"mirror": 8, "cup": 8}, material="mirror")
    result = compare(image_of(np.ones(truth.z.shape)), truth)
    assert result.row("mirror", "object").pixels == 8
    assert result.row("mirror", kind="material").pixels == 16
    with pytest.raises(ValueError, match="expected the kind of row 'mirror', 'object' or 'material', got none"):
        result.row("mirror")
    with pytest.raises(ValueError, match=r"of the kind 'object' out of mirror, cup, got 'cap' \(did you mean 'cup'"):
        result.row("cap", kind="object")


def test_tables_are_json_and_markdown(scene: tuple[np.ndarray, GroundTruth]) -> None:
    z, truth = scene
    result = compare(image_of(np.full_like(z, np.nan)), truth)
    rows = json.loads(json.dumps(result.rows(), allow_nan=False))
    assert rows[0]["bias_m"] is None
    assert rows[0]["completeness"] == 0
    assert math.isnan(result.table[0].bias_m)
    lines = errors_markdown(result).splitlines()
    assert len(lines) == 2 + len(result.table)
    assert len({line.count("|") for line in lines}) == 1
    nothing = truth_of(np.full_like(z, np.nan), np.full(z.shape, -1, np.int32))
    assert [row.name for row in compare(image_of(z), nothing).table] == ["all"]


def test_impossible_comparisons_are_refused(scene: tuple[np.ndarray, GroundTruth]) -> None:
    z, truth = scene
    with pytest.raises(ValueError, match="shape"):
        compare(image_of(z[:5]), truth)
    with pytest.raises(ValueError, match="tolerance_m"):
        compare(image_of(z), truth, tolerance_m=0)
    with pytest.raises(ValueError, match="matte, glass, all"):
        compare(image_of(z), truth).row("wood")


def test_functions_of_the_package_are_not_hidden_by_its_modules() -> None:
    import rangesim

    for _ in range(2):
        assert callable(rangesim.compare)
        assert callable(rangesim.decode)
