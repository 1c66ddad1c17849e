# SPDX-License-Identifier: Apache-2.0
"""Do columns given as `features=` help where they say something, and do no harm where they do not?

    python benchmarks/given_features.py [--domains "room1,street sweep A"] [--weights 0,0.1,0.2]

Columns of each domain (`domain_clouds.py`): noise; a reflectance, that of each true segment times log-normal noise of
30 % per point; and where there are colours, their brightness and their three channels, with and without colours beside
them. Scores per `feature_weight`: weighted overlap of the objects, best node of the tree, undersegmentation error of
the supervoxels; means over up to six clouds, or six draws of the column on one. The last line is JSON: domain ->
column -> weight -> scores.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator

import numpy as np
from domain_clouds import Sample, domains
from numpy.typing import NDArray

import pcgraph
from pcgraph.metrics import tree_oracle, undersegmentation_error, weighted_overlap

DOMAINS = "mosd organised,room1,simulated room A,street sweep A,street sweep B,airborne tile"
DRAWS = 6
NOISE = 0.3

Table = NDArray[np.float64]
Colors = NDArray[np.uint8] | None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domains", default=DOMAINS, help="names, comma-separated")
    parser.add_argument("--weights", default="0,0.1,0.2", help="values of feature_weight, comma-separated")
    args = parser.parse_args()
    weights = [float(weight) for weight in args.weights.split(",")]
    wanted = args.domains.split(",")
    report = {d.name: _measured(d.name, d.samples()[:DRAWS], weights) for d in domains() if d.name in wanted}
    print(json.dumps(report))


def _measured(domain: str, samples: list[Sample], weights: list[float]) -> dict[str, dict[str, list[float]]]:
    rng = np.random.default_rng(0)
    scores: dict[str, dict[float, list[tuple[float, float, float]]]] = {}
    for sample in samples * (DRAWS if len(samples) == 1 else 1):
        for name, column, colors in _columns(sample, rng):
            for weight in weights:
                scores.setdefault(name, {}).setdefault(weight, []).append(_scores(sample, column, colors, weight))
    means = {
        name: {f"{weight:g}": np.mean(rows, axis=0).tolist() for weight, rows in of_weights.items()}
        for name, of_weights in scores.items()
    }
    print(f"\n{domain}: overlap, best nodes, undersegmentation error")
    print(" " * 26 + "".join(f"weight {weight:<16g}" for weight in weights))
    for name, of_weights in means.items():
        print(f"{name:26s}" + "".join("{:.4f} {:.4f} {:.4f}   ".format(*row) for row in of_weights.values()))
    return means


def _columns(sample: Sample, rng: np.random.Generator) -> Iterator[tuple[str, Table, Colors]]:
    """Columns of a cloud: name, numbers, and the colours beside them."""
    shape = sample.truth.shape
    yield "noise", rng.standard_normal(shape), sample.colors
    levels = rng.random(int(sample.truth.max()) + 1)
    reflectance = np.where(sample.truth >= 0, levels[sample.truth], 0.5)
    yield "reflectance", reflectance * np.exp(NOISE * rng.standard_normal(shape)), sample.colors
    if sample.colors is not None:
        channels = sample.colors.astype(np.float64)
        yield "brightness, no colours", channels @ (0.3, 0.6, 0.1), None
        yield "brightness and colours", channels @ (0.3, 0.6, 0.1), sample.colors
        yield "channels, no colours", channels, None


def _scores(sample: Sample, column: Table, colors: Colors, weight: float) -> tuple[float, float, float]:
    method = pcgraph.SurfaceGrowth(feature_weight=weight)
    result = pcgraph.segment(sample.points, colors, features=column, method=method)
    judged = (sample.truth >= 0) & (result.supervoxels >= 0)
    truth, leaf = sample.truth[judged], result.supervoxels[judged]
    overlap = weighted_overlap(result.labels[judged], truth)
    return overlap, tree_oracle(result.tree, leaf, truth), undersegmentation_error(leaf, truth)


if __name__ == "__main__":
    main()
