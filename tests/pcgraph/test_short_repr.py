# SPDX-License-Identifier: Apache-2.0
"""What a result prints: one to five lines, whatever its size."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, make_dataclass

import numpy as np
import pytest

import pcgraph
from pcgraph import detection, learning, metrics
from pcgraph.plumbing.short_repr import ShortRepr


def of_arrays(kind: object) -> bool:
    """Whether this is a dataclass with an array."""
    return is_dataclass(kind) and any("NDArray" in str(field.type) for field in fields(kind))


def public_kinds() -> dict[str, type]:
    rooms = (pcgraph, detection, learning, metrics)
    return {name: getattr(room, name) for room in rooms for name in dir(room) if of_arrays(getattr(room, name))}


def assert_short(thing: object) -> None:
    lines = repr(thing).splitlines()
    assert 1 <= len(lines) <= 5
    assert max(map(len, lines)) <= 160
    assert lines[0].startswith(type(thing).__name__)


def test_every_public_class_of_arrays_has_a_short_repr():
    kinds = public_kinds()
    assert {"AdjacencyGraph", "Cloud", "NodeFeatures", "OrientedBox", "Planes", "SegmentationTree"} <= set(kinds)
    for name, kind in kinds.items():
        assert issubclass(kind, ShortRepr) or "__repr__" in vars(kind), name


def test_results_print_in_five_lines(boxes):
    points, truth, result = boxes
    planes = detection.find_planes(result)
    graph = metrics.NeighbourGraph.of(points)
    curve = metrics.level_curve(result.tree, result.supervoxels, truth)
    things = [
        *(pcgraph.Cloud(points), pcgraph.Cloud(points, columns={"x" * 99 + str(i): points for i in range(40)})),
        *(result, result.graph, result.graph.edge_features, result.graph.node_features),
        *(result.tree, result.tree.moments, result.tree.features(), result.surface, result.surface.grid),
        *(result.primitives(), result.occlusions(), pcgraph.plane_energy(result.tree, result.graph), planes),
        *(*detection.objects_on(result, planes), graph, curve, metrics.best_scales([curve])),
        metrics.panoptic_quality(result.labels, truth),
    ]
    assert len(things) >= 18
    for thing in things:
        assert_short(thing)
    m, k = len(result.graph.edges), result.tree.n_leaves
    assert f"({k} nodes, {m} edges, edges=int32[{m}, 2], " in repr(result.graph).replace("\n    ", "")
    said = f"({k} leaves, {2 * k - 1} nodes, parents=int32[{2 * k - 1}], "
    assert said in repr(result.tree).replace("\n    ", "")
    assert f"({len(planes)} planes (3 horizontal, " in repr(planes).replace("\n    ", "")
    assert f", normals=float64[{len(planes)}, 3]," in repr(planes).replace("\n    ", "")
    apart = pcgraph.segment([[0.0, 0.0, 1.0], [5.0, 0.0, 1.0]], voxel_size=0.1)
    assert "2 leaves, 3 nodes, 2 parts that do not touch" in repr(apart.tree)
    assert "(0 planes, normals" in repr(detection.find_planes(apart)).replace("\n    ", "")
    assert "node_features=NodeFeatures(...)" in repr(result.graph)


def test_an_occlusion_of_a_scene(boxes):
    assert_short(boxes[2].occlusions().continuations)


@dataclass(frozen=True, eq=False)
class Thing(ShortRepr):
    up: np.ndarray
    table: np.ndarray
    name: str = "a"


@dataclass
class OwnRepr(ShortRepr):
    x: int = 0

    def __repr__(self) -> str:
        return "own"


@dataclass(frozen=True)
class Below(Thing):
    more: tuple = (1, 2, 3, 4)


def test_small_arrays_show_their_numbers_and_large_ones_their_shape():
    thing = Thing(np.array([0.0, 0.0, 1.0]), np.zeros((4, 2), np.float32))
    assert repr(thing) == "Thing(up=[0., 0., 1.], table=float32[4, 2], name='a')"
    assert repr(Thing(np.zeros(0), np.zeros(()))).startswith("Thing(up=array([]")
    assert repr(Below(thing.up, thing.table)).endswith("more=4 of int)")
    assert repr(OwnRepr()) == "own"


@pytest.mark.parametrize("n", [1, 8, 20, 200])
def test_many_fields_take_five_lines_and_are_counted(n):
    kind = make_dataclass("Many", [f"column_{i:03}" for i in range(n)], bases=(ShortRepr,))
    text = repr(kind(*[np.zeros((100, 3))] * n))
    assert_short(kind(*[np.zeros((100, 3))] * n))
    shown = text.count("float64[100, 3]")
    assert shown == n or f"and {n - shown} more" in text
