# SPDX-License-Identifier: Apache-2.0
"""How well the linkages and cuts of pcgraph find objects on labelled clouds (mOSD); see docs/tree.md.

Weighted overlap (WOv) with true objects, mean over the clouds: at the default altitude of each linkage, at the one
altitude that is best for all clouds (ODS), and at the best altitude per cloud (OIS). The learned linkage is fitted on
all clouds but the one that it is measured on. The last line is JSON.

    python benchmarks/linkages.py [--data FOLDER]
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass

import numpy as np
from mosd import DATA, load_clouds
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

import pcgraph
from pcgraph.features.moments import Moments
from pcgraph.segmentation import Segmentation
from pcgraph.tree.average_linkage import ConvexityLinkage
from pcgraph.tree.energies import plane_energy
from pcgraph.tree.felzenszwalb import FelzenszwalbLinkage
from pcgraph.tree.lccp import LccpLinkage
from pcgraph.tree.learned import LeafTruth, LearnedLinkage, leaf_truth
from pcgraph.tree.least_increase import MumfordShahLinkage, WardLinkage
from pcgraph.tree.linkage import Linkage
from pcgraph.tree.region_linkage import RegionLinkage
from pcgraph.tree.single_linkage import QuasiFlatLinkage
from pcgraph.tree.tree import SegmentationTree, segmentation_tree

LINKAGES: dict[str, Linkage] = {
    "region (default)": RegionLinkage(),
    "convexity": ConvexityLinkage(),
    "LCCP": LccpLinkage(),
    "LCCP, sanity check": LccpLinkage(sanity=True),
    "quasi-flat zones": QuasiFlatLinkage(),
    "Felzenszwalb": FelzenszwalbLinkage(),
    "Ward (normals)": WardLinkage(),
    "Mumford-Shah (planes)": MumfordShahLinkage(),
}
LEVELS = 200  # altitudes tried for ODS and OIS
MIN_SIZE = 300  # points
PLANE_SCALE = 4.0  # square metres x points


@dataclass(frozen=True)
class Case:
    """One segmented cloud with its truth."""

    result: Segmentation
    truth: NDArray[np.int32]
    table: LeafTruth
    leaves: Moments

    def tree(self, linkage: Linkage) -> tuple[SegmentationTree, float]:
        """Tree, and the seconds that it took."""
        start = time.perf_counter()
        merges = linkage.merges(self.result.graph, self.leaves)
        tree = segmentation_tree(merges, self.leaves)
        return tree, time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default=DATA, help="folder of labelled PCD files")
    cases = [_case(cloud) for cloud in load_clouds(parser.parse_args().data)]
    print(f"{len(cases)} clouds, {np.mean([case.table.n_leaves for case in cases]):.0f} supervoxels each")
    rows: dict[str, dict[str, float]] = {}
    for name, linkage in LINKAGES.items():
        rows[name] = _measure(cases, [linkage] * len(cases))
        _show(name, rows[name])
    learned = [_fit_without(cases, left_out) for left_out in range(len(cases))]
    rows["learned (leave one out)"] = _measure(cases, learned)
    _show("learned (leave one out)", rows["learned (leave one out)"])
    cuts = _measure_cuts(cases)
    for name, overlaps in cuts.items():
        print(f"{name:36s} WOv {overlaps['wov']:.4f}, worst {overlaps['worst']:.3f}")
    print(json.dumps({"linkages": rows, "cuts": cuts}))


def _case(cloud) -> Case:  # type: ignore[no-untyped-def]
    result = pcgraph.segment(cloud.points, cloud.colors)
    table = leaf_truth(result.supervoxels, cloud.objects, result.graph.n_nodes)
    return Case(result, cloud.objects, table, result.leaves)


def _fit_without(cases: list[Case], left_out: int) -> LearnedLinkage:
    others = [case for place, case in enumerate(cases) if place != left_out]
    return LearnedLinkage.fit([case.result for case in others], [case.truth for case in others])


def _measure(cases: list[Case], linkages: list[Linkage] | list[LearnedLinkage]) -> dict[str, float]:
    cases[0].tree(linkages[0])  # compiled
    trees, seconds = zip(*(case.tree(linkage) for case, linkage in zip(cases, linkages, strict=True)), strict=True)
    default = [
        case.table.covering(tree.cut(altitude=linkage.default_object_altitude))
        for case, tree, linkage in zip(cases, trees, linkages, strict=True)
    ]
    inner = np.concatenate([tree.altitudes[np.isfinite(tree.altitudes)] for tree in trees])
    levels = np.unique(np.quantile(inner[inner > 0.0], 1.0 - np.geomspace(5e-4, 0.3, LEVELS)))
    curves = np.array(
        [
            [case.table.covering(tree.cut(altitude=level)) for level in levels]
            for case, tree in zip(cases, trees, strict=True)
        ]
    )
    best = int(curves.mean(axis=0).argmax())
    return {
        "wov": float(np.mean(default)),
        "worst": float(np.min(default)),
        "ods": float(curves[:, best].mean()),
        "ods_altitude": float(levels[best]),
        "ois": float(curves.max(axis=1).mean()),
        "ms": 1e3 * float(np.median(seconds)),
    }


def _show(name: str, row: dict[str, float]) -> None:
    quality = f"WOv {row['wov']:.4f}, worst {row['worst']:.3f}; ODS {row['ods']:.4f} at {row['ods_altitude']:.3g}"
    print(f"{name:26s} {quality}; OIS {row['ois']:.4f}; {row['ms']:.1f} ms")


def _measure_cuts(cases: list[Case]) -> dict[str, dict[str, float]]:
    """Other cuts of the default tree."""
    linkage = RegionLinkage()
    altitude, rows = linkage.default_object_altitude, {}
    trees = [case.tree(linkage)[0] for case in cases]
    cuts = {
        f"altitude {altitude:g} rad": lambda tree: tree.cut(altitude=altitude),
        f"the same, min_size {MIN_SIZE}": lambda tree: tree.cut(altitude=altitude, min_size=MIN_SIZE),
        f"optimal, planes, scale {PLANE_SCALE:g}": lambda tree: tree.cut_optimal(plane_energy(tree), PLANE_SCALE),
    }
    for name, cut in cuts.items():
        overlaps = [case.table.covering(cut(tree)) for case, tree in zip(cases, trees, strict=True)]
        rows[name] = {"wov": float(np.mean(overlaps)), "worst": float(np.min(overlaps))}
    for name, connected in (("bound: true object of each supervoxel", False), ("bound: the same, along edges", True)):
        overlaps = [case.table.covering(_best_possible(case, connected)) for case in cases]
        rows[name] = {"wov": float(np.mean(overlaps)), "worst": float(np.min(overlaps))}
    return rows


def _best_possible(case: Case, connected: bool) -> NDArray[np.int32]:
    """Segments by the truth: each supervoxel with most of its points; apart where no edges lead from one to another."""
    truth, (i, j) = case.table.majority(0.0), case.result.graph.edges.T
    if not connected:
        return np.where(truth < 0, truth.max() + 1, truth).astype(np.int32)
    same = truth[i] == truth[j]
    n = case.table.n_leaves
    inside = csr_array((np.ones(same.sum()), (i[same], j[same])), shape=(n, n))
    return connected_components(inside, directed=False)[1].astype(np.int32)


if __name__ == "__main__":
    main()
