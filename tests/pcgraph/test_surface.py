# SPDX-License-Identifier: Apache-2.0
"""The public surface and the import rules."""

from __future__ import annotations

import ast
import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

import pcgraph

PACKAGE = Path(pcgraph.__file__).parent


def test_public_names():
    assert pcgraph.__all__ == [
        "Acquisition",
        "AdjacencyGraph",
        "BoundaryCost",
        "BoundaryStrength",
        "Bridges",
        "Cloud",
        "CloudReadError",
        "CloudWarning",
        "CloudWriteError",
        "Continuations",
        "ConvexityLinkage",
        "EdgeFeatures",
        "EdgeModel",
        "Energy",
        "FelzenszwalbLinkage",
        "Gaps",
        "LccpLinkage",
        "LearnedLinkage",
        "Linkage",
        "LocalPlanes",
        "Merges",
        "Moments",
        "MumfordShahLinkage",
        "NodeFeatures",
        "Occlusions",
        "PcgraphError",
        "Primitive",
        "Primitives",
        "QuasiFlatLinkage",
        "RegionLinkage",
        "RobustScaling",
        "Segmentation",
        "SegmentationTree",
        "SupervoxelMethod",
        "Supervoxels",
        "Surface",
        "SurfaceGrowth",
        "Vccs",
        "VoxelGrid",
        "WardLinkage",
        "as_cloud",
        "detection",
        "labelled_cloud",
        "learning",
        "load_segmentation",
        "metrics",
        "plane_energy",
        "read_cloud",
        "sample_surface",
        "segment",
        "supervoxel_clustering",
        "tree_of_graph",
        "update",
        "variance_energy",
        "viewer",
        "write_cloud",
        "write_segmentation",
    ]
    for name in pcgraph.__all__:
        assert getattr(pcgraph, name) is not None
    assert set(pcgraph.__all__) <= set(dir(pcgraph))


def test_the_public_names_of_rooms_are_these():
    assert dir(pcgraph.detection) == [
        "DetectedObject",
        "OrientedBox",
        "Planes",
        "Shape",
        "boxes_of_labels",
        "find_planes",
        "fit_shape",
        "object_labels",
        "objects_on",
        "standing_box",
        "tight_box",
    ]
    assert dir(pcgraph.learning) == [
        "NodeClassifier",
        "accumulate",
        "accumulate_points",
        "leaf_descriptors",
        "majority",
        "propagate_labels",
        "pure_ancestors",
        "supervoxels_at",
        "unpool",
        "votes",
    ]


@pytest.mark.parametrize("room", [pcgraph, pcgraph.detection, pcgraph.learning, pcgraph.viewer])
def test_type_checkers_see_what_loads(room):
    """The imports under TYPE_CHECKING, which editors read, name the objects that are loaded."""
    tree = ast.parse(Path(room.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            assert alias.asname == alias.name  # else type checkers take it for private
            seen[alias.name] = node.module
    assert sorted(seen) == sorted(room.__all__) == dir(room)
    for name, module in seen.items():
        assert getattr(importlib.import_module(module), name) is getattr(room, name)


def test_unknown_names_are_refused():
    assert not hasattr(pcgraph, "supervoxelise")


def imported_modules(path: Path) -> set[str]:
    modules = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            modules.add(node.module or "")
    return {module.split(".")[0] for module in modules}


def test_pcgraph_never_imports_rangesim():
    files = list(PACKAGE.rglob("*.py"))
    assert len(files) > 20
    for path in files:
        assert not imported_modules(path) & {"rangesim", "mitsuba", "drjit"}, path


def test_tests_of_pcgraph_and_their_scenes_import_no_benchmark():
    """A benchmark may change as its figures need; what tests stand on may not. `tests/benchmarks` tests benchmarks."""
    tests = Path(__file__).parents[1]
    benchmarks = {path.stem for path in (tests.parent / "benchmarks").glob("*.py")}
    files = [*tests.glob("pcgraph/*.py"), *tests.glob("scenes/*.py")]
    assert len(benchmarks) > 30
    assert [(file.name, found) for file in files if (found := imported_modules(file) & benchmarks)] == []


LOADED = """
import sys

def loaded(*names):
    print(sorted({*names} & set(sys.modules)))

import pcgraph
loaded("numba", "scipy", "numpy", "open3d", "networkx", "sklearn")
from pcgraph import learning
learning.accumulate, learning.leaf_descriptors
loaded("sklearn")
sys.modules["sklearn"] = sys.modules["sklearn.base"] = None
try:
    learning.NodeClassifier
except ImportError as error:
    print(error)
pcgraph.segment([[1.0, 1.0, 1.0]], viewpoint=(0, 0, 0)).graph.to_pyg()
loaded("torch", "torch_geometric", "open3d", "networkx")
from pcgraph.parallel import in_blocks
in_blocks(lambda *block: sys.stdout.write("block "), 10**6)
print()
import numpy as np
y, x = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9))
points = np.stack((x, y, 1 + 0.2 * (x > 0.5)), axis=-1)
for kind in (pcgraph.ConvexityLinkage(), pcgraph.WardLinkage()):
    print(pcgraph.segment(points, linkage=kind, voxel_size=0.15).graph.n_nodes > 1)
"""


def test_libraries_are_loaded_where_they_are_needed_threads_are_as_many_as_told_and_all_runs_uncompiled():
    """One process, for starting one takes most of the time: importing loads none of them; scikit-learn comes with the
    classifier, and all else works without it; PyG's arrays need no torch. Uncompiled as in a debugger."""
    environment = {**os.environ, "NUMBA_NUM_THREADS": "3", "NUMBA_DISABLE_JIT": "1"}
    line = [sys.executable, "-c", LOADED]
    done = subprocess.run(line, capture_output=True, text=True, check=True, env=environment)
    missing = "NodeClassifier needs scikit-learn; pip install 'rangesim[learn]'"
    assert done.stdout.splitlines() == ["[]", "[]", missing, "[]", "block block block ", "True", "True"]
