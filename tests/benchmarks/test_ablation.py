# SPDX-License-Identifier: Apache-2.0
"""The ablation: every part can be switched off and counted, and is measured on the cloud that it is about."""

from __future__ import annotations

import numpy as np
import pytest
from ablation import Reference, markdown, measure, table
from ablation_cost import Code, Source
from ablation_parts import PARTS, Part, Target, jointly, switched_off
from domain_clouds import Domain, Sample
from scenes.tables import two_boxes_on_a_plane

import pcgraph
import pcgraph.scan as scan_module

CONSTANTS = "tree.region_linkage._CONSTANTS"
"""The constants of `RegionLinkage`, of which several parts set one each."""


@pytest.fixture(scope="module")
def source() -> Source:
    return Source()


@pytest.fixture(scope="module")
def sample() -> Sample:
    points, truth = two_boxes_on_a_plane()[:2]
    return Sample(points, truth)


def named(*names: str) -> list[Part]:
    return [part for part in PARTS if part.name in names]


def code_of(path: str) -> Code:
    owner, name, _ = Target.of(path)
    module, outer = (owner.__module__, f"{owner.__qualname__}.") if isinstance(owner, type) else (owner.__name__, "")
    return Code(module.removeprefix("pcgraph.").replace(".", "/") + ".py", outer + name)


def test_names_of_parts_differ():
    assert len({part.name for part in PARTS}) == len(PARTS)


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_a_part_is_code_that_is_there_and_no_kernel_holds_what_switches_it_off(part, source):
    assert source.cost(part.code).lines > 0
    for path in part.off:
        code = code_of(path)
        if code.name.isupper() and isinstance(Target.of(path).value, (int, float)):
            assert source.kernels_reading(code) == []


def test_a_part_is_back_after_it_was_switched_off():
    for part in PARTS:
        before = [Target.of(path) for path in part.off]
        with switched_off(part):
            assert all(Target.of(path).value is not target.value for path, target in zip(part.off, before, strict=True))
        assert [Target.of(path) for path in part.off] == before


def test_parts_that_patch_one_name_are_off_together():
    constants = Target.of(CONSTANTS).value
    both = jointly(part for part in PARTS if part.name.endswith(("(c1)", "(k1)", "(m0)")))
    with switched_off(both):
        found = Target.of(CONSTANTS).value
    assert found == constants._replace(c1=0.0, k1=0.0, m0=0.0)


def test_what_starts_from_the_default_s_voxels_is_what_all_of_it_gives(sample):
    reference, (part,) = Reference.of(sample), named("refinement")
    found = reference.without(part, sample)
    with switched_off(part):
        whole = pcgraph.segment(sample.points, sample.colors)
    np.testing.assert_array_equal(found.supervoxels, whole.supervoxels)
    np.testing.assert_array_equal(found.tree.altitudes, whole.tree.altitudes)
    assert scan_module.cluster_scan.__name__ == "cluster_scan"
    assert scan_module.merge_supervoxels.__name__ == "merge_supervoxels"


def test_a_part_by_which_the_default_does_not_come_changes_nothing(sample):
    reference, (part,) = Reference.of(sample), named("flying pixels")
    assert reference.without(part, sample) is None
    with switched_off(part):
        np.testing.assert_array_equal(pcgraph.segment(sample.points).labels, reference.result.labels)


@pytest.mark.validation
def test_a_table_has_gains_and_prices(sample):
    report = {"domains": {}, "times": {}}
    domain = Domain("boxes", ("wov", "oracle"), lambda: [sample, *sample.turned(2)[1:]], 10, (0.02,), 0.01)
    parts = named("distance of normals", "flying pixels")
    measure(domain, parts, report)
    found = report["domains"]["boxes"]
    assert found["scores"] == ["wov", "oracle"]
    assert found["without"]["flying pixels"] == [None, None]
    assert len(found["default"]) == len(found["without"]["distance of normals"]) == 2
    rows = table(parts, report)
    assert {row["part"] for row in rows} == {part.name for part in parts}
    of_normals, of_pixels = sorted(rows, key=lambda row: row["part"])
    gains = np.subtract(found["default"], found["without"]["distance of normals"])
    assert of_normals["gain"] == pytest.approx(gains.mean())
    assert of_pixels["gain"] == of_pixels["touched"] == 0
    assert "| flying pixels | +0.0000 |" in markdown(rows, report)


def test_what_nothing_else_uses_goes_with_a_part(source):
    gone = {code.name for code in source.removed_with(["voxels/outliers.py:_surfaces_among"])}
    assert gone == {"_surfaces_among", "_find_flat", "_FLAT", "_NEAREST"}
    assert source.cost(["voxels/outliers.py:_surfaces_among"]).kernels == 1
