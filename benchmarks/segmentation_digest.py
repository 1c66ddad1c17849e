# SPDX-License-Identifier: Apache-2.0
"""Digests of all that pcgraph makes of real clouds, for changes that must not change results: every linkage, cuts,
metrics, detection, primitives, descriptors.

    python benchmarks/segmentation_digest.py --out before.json
    (a change of the code)
    python benchmarks/segmentation_digest.py --against before.json

Data: mOSD (../shared/data/mosd), and of ../shared/data/clouds an office fused from many places and an airborne scan.
The second line of calls lists the digests that differ, and ends with status 1 if any do. The last line is JSON:
`digests`, `differ`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from digest import compared
from mosd import DATA, LabelledCloud, load_clouds

import pcgraph
from pcgraph import Segmentation, detection, learning, metrics, segment

CLOUDS = DATA.parent / "clouds"
OF_LABELS = (
    "weighted_overlap",
    "achievable_accuracy",
    "oversegmentation_rate",
    "undersegmentation_rate",
    "adjusted_rand_index",
    "variation_of_information",
    "panoptic_quality",
    "undersegmentation_error",
)
OF_TREES = ("tree_oracle", "dendrogram_purity", "fragmentation_curve")


def parts(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The arrays and numbers that a result is made of, by the names of its fields."""
    if isinstance(value, np.generic):
        value = value.item()
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from parts(f"{name}/{field.name}", getattr(value, field.name))
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from parts(f"{name}/{key}", item)
    elif isinstance(value, (tuple, list)):
        for number, item in enumerate(value):
            yield from parts(f"{name}/{number}", item)
    elif isinstance(value, (np.ndarray, str, int, float, type(None))):
        yield name, value


def of_graph(name: str, result: Segmentation) -> Iterator[tuple[str, Any]]:
    """Supervoxels, graph and features, which no linkage changes."""
    yield f"{name}/supervoxels", result.supervoxels
    yield f"{name}/edges", result.graph.edges
    yield from parts(f"{name}/edge", result.graph.edge_features.columns())
    yield from parts(f"{name}/node", result.graph.node_features.columns())
    yield f"{name}/boundary strength", result.graph.edge_features.boundary_strength
    yield from parts(f"{name}/moments", result.tree.moments.columns())


def of_tree(name: str, result: Segmentation) -> Iterator[tuple[str, Any]]:
    """Labels, tree and its cuts."""
    tree = result.tree
    yield f"{name}/labels", result.labels
    yield f"{name}/parents", tree.parents
    yield f"{name}/altitudes", tree.altitudes
    yield f"{name}/cut into 20", tree.cut(n=20)
    yield f"{name}/cut into 20 of 100", tree.cut(n=20, min_size=100)
    yield f"{name}/part cut", tree.cut(altitude=result.linkage.default_part_altitude)
    yield f"{name}/persistence", tree.persistence


def of_more(name: str, result: Segmentation) -> Iterator[tuple[str, Any]]:
    """What else a tree is asked for."""
    tree = result.tree
    energy = pcgraph.plane_energy(tree, result.graph)
    yield from parts(f"{name}/energy", energy)
    yield f"{name}/optimal cut", tree.cut_optimal(energy, 1e-3)
    yield f"{name}/by energy", tree.by_energy(energy).altitudes
    yield f"{name}/saliency", result.saliency()
    yield f"{name}/edge saliency", tree.edge_saliency(result.graph.edges)
    yield from parts(f"{name}/primitives", result.primitives().columns())
    yield from parts(f"{name}/descriptors", learning.leaf_descriptors(result))
    if result.viewpoint.ndim == 1:
        yield from parts(f"{name}/occlusions", result.occlusions())


def of_detection(name: str, result: Segmentation) -> Iterator[tuple[str, Any]]:
    """Planes and the objects on them."""
    planes = detection.find_planes(result)
    yield from parts(f"{name}/planes", planes)
    objects = detection.objects_on(result, planes)
    yield f"{name}/object labels", detection.object_labels(result, objects)
    for number, found in enumerate(objects):
        yield from parts(f"{name}/object {number}", found)


def of_metrics(name: str, result: Segmentation, cloud: LabelledCloud) -> Iterator[tuple[str, Any]]:
    """Every metric, of objects and supervoxels, trees and levels."""
    inside = cloud.finite
    points, truth = cloud.points[inside], cloud.objects[inside]
    labels, leaves, tree = result.labels[inside], result.supervoxels[inside], result.tree
    for metric in OF_LABELS:
        for of, found in (("objects", labels), ("supervoxels", leaves)):
            yield from parts(f"{name}/{metric}/{of}", getattr(metrics, metric)(found, truth))
    for metric in OF_TREES:
        yield from parts(f"{name}/{metric}", getattr(metrics, metric)(tree, leaves, truth))
    curve = metrics.level_curve(tree, leaves, truth)
    fields_of_curve = {"altitudes": curve.altitudes, "regions": curve.regions, "values": curve.values}
    yield from parts(f"{name}/level curve", {"score": "weighted_overlap", **fields_of_curve})
    yield from parts(f"{name}/best scales", metrics.best_scales([curve]))
    graph = metrics.NeighbourGraph.of(points)
    yield from parts(f"{name}/boundary recall", graph.recall(leaves, truth))
    yield from parts(f"{name}/boundary precision", graph.precision(leaves, truth))
    yield from parts(f"{name}/boundary curve", metrics.boundary_curve(graph, tree, leaves, truth))
    yield from parts(f"{name}/compactness", metrics.compactness(graph, leaves))
    yield from parts(
        f"{name}/explained variation", metrics.explained_variation(cloud.colors[inside].astype(float), leaves)
    )


def linkages() -> dict[str, pcgraph.Linkage]:
    """Every linkage that needs no training."""
    kinds = ("Felzenszwalb", "Lccp", "MumfordShah", "QuasiFlat", "Ward")
    return {kind: getattr(pcgraph, f"{kind}Linkage")() for kind in kinds}


def all_values() -> Iterator[tuple[str, Any]]:
    clouds = load_clouds()
    for number, cloud in enumerate(clouds):
        result = segment(cloud.points, cloud.colors)
        yield from of_graph(cloud.name, result)
        yield from of_tree(f"{cloud.name}/convexity", result)
        for kind, linkage in linkages().items():
            other = segment(cloud.points, cloud.colors, linkage=linkage)
            yield from of_tree(f"{cloud.name}/{kind}", other)
        if number % 3 == 0:
            yield from of_more(cloud.name, result)
            yield from of_detection(cloud.name, result)
            yield from of_metrics(cloud.name, result, cloud)
    first, second = clouds[0], clouds[5]
    vccs = segment(first.points, first.colors, method=pcgraph.Vccs())
    yield from of_graph("vccs", vccs)
    yield from of_tree("vccs", vccs)
    plain = segment(first.points[np.isfinite(first.points).all(axis=-1)], range_growth=0.5)
    yield from of_graph("range growth", plain)
    both = pcgraph.update(segment(first.points, first.colors, camera=False), second.points, second.colors)
    yield from of_graph("update", both)
    yield from of_tree("update", both)
    trained = pcgraph.LearnedLinkage.fit([segment(first.points, first.colors)], [first.objects])
    yield from of_tree("learned", segment(second.points, second.colors, linkage=trained))
    room = pcgraph.read_cloud(CLOUDS / "room1_fine.pcd")
    air = np.load(CLOUDS / "isprs_samp11.npz")
    for name, points, colors in (("room", room.points, room.colors), ("air", air["points"], None)):
        result = segment(points, colors)
        yield from of_graph(name, result)
        yield from of_tree(name, result)
        yield from of_more(name, result)
        yield from of_detection(name, result)


if __name__ == "__main__":
    compared(__doc__ or "", all_values())
