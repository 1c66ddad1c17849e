# SPDX-License-Identifier: Apache-2.0
"""The trees of pcgraph against Higra's: the same merges, and the time of both; see docs/tree.md.

Graphs are Delaunay triangulations of random points in the plane with 1 k, 10 k and 100 k nodes (as many edges per node
as supervoxels have). Times are medians of repeated calls, compiled, with the building of Higra's graph object apart.
The last line is JSON.

    python benchmarks/tree_vs_higra.py [--nodes 1000 10000 100000]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import higra
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from pcgraph.features.moments import Moments
from pcgraph.hierarchy import lowest_common_ancestors
from pcgraph.tree.average_linkage import average_linkage
from pcgraph.tree.least_increase import Regions, least_increase_linkage
from pcgraph.tree.linkage import Merges
from pcgraph.tree.optimal_cut import Energy
from pcgraph.tree.single_linkage import single_linkage
from pcgraph.tree.tree import SegmentationTree


@dataclass(frozen=True)
class Problem:
    """A graph with costs, weights and values, in either library's form."""

    n: int
    edges: NDArray[np.int32]
    costs: NDArray[np.float64]
    weights: NDArray[np.float64]
    values: NDArray[np.float64]
    graph: higra.UndirectedGraph


def problem(n: int) -> tuple[Problem, float]:
    """Problem of n nodes, and the seconds that Higra's graph object took to build."""
    rng = np.random.default_rng(n)
    corners = Delaunay(rng.random((n, 2))).simplices
    pairs = np.sort(np.concatenate((corners[:, :2], corners[:, 1:], corners[:, ::2])), axis=1)
    edges = np.unique(pairs, axis=0).astype(np.int32)
    start = time.perf_counter()
    graph = higra.UndirectedGraph(n)
    graph.add_edges(edges[:, 0], edges[:, 1])
    built = time.perf_counter() - start
    weights = rng.integers(1, 20, len(edges)).astype(np.float64)
    return Problem(n, edges, rng.random(len(edges)), weights, rng.normal(size=(n, 3)), graph), built


def ours(kind: str, p: Problem) -> Merges:
    if kind == "single":
        return single_linkage(p.n, p.edges, p.costs)
    if kind == "average":
        return average_linkage(p.n, p.edges, p.costs, p.weights)
    regions = Regions(np.ones(p.n), p.values, np.zeros((p.n, 3)), np.zeros((p.n, 3, 3)), 0.0)
    return least_increase_linkage(regions, p.edges, None)


def theirs(kind: str, p: Problem) -> tuple[higra.Tree, NDArray[np.float64]]:
    if kind == "single":
        return higra.bpt_canonical(p.graph, p.costs)
    if kind == "average":
        return higra.binary_partition_tree_average_linkage(p.graph, p.costs, p.weights)
    return higra.binary_partition_tree_ward_linkage(p.graph, p.values)


def parents_of(pairs: NDArray[np.int32], n: int) -> NDArray[np.int32]:
    parents = np.arange(2 * n - 1, dtype=np.int32)
    parents[pairs] = np.arange(n, 2 * n - 1, dtype=np.int32)[:, None]
    return parents


def same_hierarchy(p: Problem, pairs: NDArray[np.int32], altitudes: NDArray[np.float64], tree, levels) -> bool:  # type: ignore[no-untyped-def]
    """Whether the ends of every edge meet at the same altitude in both trees (to 1e-9)."""
    meeting = lowest_common_ancestors(parents_of(pairs, p.n), *p.edges.T)
    mine = np.concatenate((np.zeros(p.n), altitudes))[meeting]
    return bool(np.allclose(mine, higra.saliency(tree, levels), rtol=1e-9))


def cut_times(p: Problem, pairs: NDArray[np.int32], altitudes: NDArray[np.float64], repeats: int) -> dict[str, float]:
    """Milliseconds of cuts and saliency on the same tree, ours and Higra's."""
    parents = parents_of(pairs, p.n)
    levels = np.concatenate((np.zeros(p.n), altitudes))
    k, rng = len(parents), np.random.default_rng(0)
    nothing = Moments(np.ones(k, np.int64), np.zeros((k, 3)), np.zeros((k, 3, 3)), None)
    tree = SegmentationTree(parents, levels, nothing)
    other = higra.Tree(parents.astype(np.int64))
    higra.CptHierarchy.link(other, p.graph)
    sizes = higra.attribute_area(other)
    energy = Energy(rng.random(k) * sizes, np.ones(k))
    level = float(np.quantile(altitudes, 0.99))
    return {
        "cut_ms": median_ms(lambda: tree.cut(altitude=level), repeats),
        "higra_cut_ms": median_ms(
            lambda: higra.labelisation_horizontal_cut_from_threshold(other, levels, level), repeats
        ),
        "saliency_ms": median_ms(lambda: tree.edge_saliency(p.edges), repeats),
        "higra_saliency_ms": median_ms(lambda: fresh_saliency(other, levels, p.graph), repeats),
        "optimal_hierarchy_ms": median_ms(lambda: tree.by_energy(energy), repeats),
        "higra_optimal_hierarchy_ms": median_ms(
            lambda: higra.hierarchy_to_optimal_energy_cut_hierarchy(other, energy.data, energy.complexity), repeats
        ),
    }


def fresh_saliency(tree, levels, graph) -> NDArray[np.float64]:  # type: ignore[no-untyped-def]
    """Higra's saliency with the common ancestors found anew: it keeps what it found for a tree otherwise."""
    higra.clear_all_attributes()
    higra.CptHierarchy.link(tree, graph)
    return higra.saliency(tree, levels)


def median_ms(call: Callable[[], object], repeats: int) -> float:
    call()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return 1e3 * float(np.median(seconds))


def import_ms(statement: str) -> float:
    """Milliseconds of an import in a fresh process where NumPy, SciPy and numba are loaded already."""
    before = "import numpy, scipy.spatial, numba, time; t = time.perf_counter()"
    code = f"{before}; {statement}; print(time.perf_counter() - t)"
    runs = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True) for _ in range(3)]
    return 1e3 * float(np.median([float(run.stdout) for run in runs]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, nargs="+", default=[1000, 10_000, 100_000])
    results: dict[str, object] = {
        "import_higra_ms": import_ms("import higra"),
        "import_pcgraph_tree_ms": import_ms("import pcgraph.tree.tree, pcgraph.tree.average_linkage"),
    }
    print(f"import: Higra {results['import_higra_ms']:.0f} ms, pcgraph.tree {results['import_pcgraph_tree_ms']:.0f} ms")
    for n in parser.parse_args().nodes:
        p, built = problem(n)
        repeats = max(3, 30_000 // n)
        row: dict[str, object] = {"edges": len(p.edges), "higra_graph_ms": 1e3 * built}
        for kind in ("single", "average", "ward"):
            merges = ours(kind, p)
            tree, levels = theirs(kind, p)
            row[kind] = {
                "same": same_hierarchy(p, merges.pairs, merges.altitudes, tree, levels),
                "ms": median_ms(lambda kind=kind, p=p: ours(kind, p), repeats),  # type: ignore[misc]
                "higra_ms": median_ms(lambda kind=kind, p=p: theirs(kind, p), repeats),  # type: ignore[misc]
            }
            print(f"{n:7d} nodes, {len(p.edges)} edges, {kind:8s}", row[kind])
        merges = ours("average", p)
        row["cuts"] = cut_times(p, merges.pairs, merges.altitudes, repeats)
        print(f"{n:7d} nodes", {name: round(ms, 3) for name, ms in row["cuts"].items()})
        results[str(n)] = row
    print(json.dumps(results))


if __name__ == "__main__":
    main()
