# SPDX-License-Identifier: Apache-2.0
"""Cuts of the default tree against the superpoints of Superpoint Transformer, at as many segments.

    python -m venv spt && spt/bin/pip install "numpy<2" scipy pgeof pycut-pursuit
    python benchmarks/superpoints.py --python spt/bin/python [--domains "room1,simulated room A"] [--turns 4]

Superpoints as its authors make them for S3DIS and ScanNet (Robert et al. 2023; Landrieu and Simonovsky 2018): points
thinned to the means of 3 or 2 cm cubes; linearity, planarity, scattering and verticality of the 45 nearest (`pgeof`,
MIT), elevation and colours; and on a graph of the 10 nearest the piecewise constant approximation of these and of
positions, by parallel cut pursuit at regularisations of 0.01, 0.1 and 0.5, each on the regions of the one before, none
of fewer than 10 cubes. `pycut-pursuit` (GPL) wants an older NumPy than we do, hence an environment of its own. Rooms of
`domain_clouds.py`, seen by both as they are.

Every segment takes its most frequent true label: purity, and mean IoU of the true things; of superpoints, of the cut
into as many segments, and of that into as many of which none has fewer points than the smallest superpoint
(`min_size`). Seconds are those of features and partition, and of the whole of `pcgraph.segment`. Figures are means over
so many turns of each cloud, the first as it comes: one turn more or less decides as much as a tenth. The last line is
JSON: cloud -> cube -> one row per level.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from domain_clouds import Sample

ROOMS = (
    *("room1", "simulated room A", "simulated room B", "room1 thinned", "room A thinned", "room B thinned"),
    *("room A as mesh", "room B as mesh"),
)
CUBES = (0.03, 0.02)  # metres
REGULARISATIONS = (0.01, 0.1, 0.5)
NEIGHBOURS = 45  # of the features,
ADJACENT = 10  # and of the graph
POSITION_WEIGHT = 0.1
LEAST = 10  # points of a superpoint, or superpoints of the level below
ITERATIONS = 15
VERTICALITY, ELEVATION = 2.0, 0.25  # what they count, per metre the second
WHICH = ("superpoints", "cut", "cut, none smaller")
LOW = 1.5  # metres above the lowest point, among which the ground is sought


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", type=Path, help="interpreter of the environment that has pycut-pursuit and pgeof")
    parser.add_argument("--domains", default=",".join(ROOMS), help="names, comma-separated")
    parser.add_argument("--turns", type=int, default=4, help="of each cloud, both alike; default %(default)s")
    parser.add_argument("--partition", type=Path, metavar="FOLDER", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.partition:
        for path in sorted(arguments.partition.glob("*.cloud.npz")):
            partition(path)
    elif arguments.python:
        compare(arguments.python, arguments.domains.split(","), arguments.turns)
    else:
        parser.error("expected --python, the interpreter of an environment that has pycut-pursuit and pgeof")


# --- in our environment -----------------------------------------------------------------------------------------------


Rows = list[dict[str, Any]]


def compare(python: Path, names: list[str], turns: int) -> None:
    """Print superpoints and cuts of the default tree side by side."""
    from domain_clouds import domains

    every = {domain.name: domain for domain in domains()}
    if unknown := [name for name in names if name not in every]:
        raise SystemExit(f"no domain {unknown[0]!r}; there are: {', '.join(every)}")
    samples = {name: every[name].samples()[0].turned(turns) for name in names}
    report: dict[str, dict[str, Rows]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, turned in samples.items():
            for turn, sample in enumerate(turned):
                colors = np.empty((0, 3), np.uint8) if sample.colors is None else sample.colors
                path = Path(folder, f"{name}.{turn}.cloud.npz")
                np.savez(path, points=sample.points.astype(np.float64), colors=colors)
        subprocess.run([str(python), __file__, "--partition", folder], check=True)
        print(f"{'cloud':18s} cube segments least" + "".join(f"{which:>22s}" for which in WHICH))
        print(" " * 37 + "   purity   mIoU     s" * 3)
        for name, turned in samples.items():
            of_turns = [_of_turn(sample, Path(folder, f"{name}.{turn}")) for turn, sample in enumerate(turned)]
            report[name] = {
                cube: [_mean(levels) for levels in zip(*(rows[cube] for rows in of_turns), strict=True)]
                for cube in of_turns[0]
            }
            for cube, rows in report[name].items():
                for row in rows:
                    shown = "".join("{purity:9.3f}{mIoU:7.3f}{s:6.1f}".format(**row[which]) for which in WHICH)
                    print(f"{name:18s}{cube:>5s}{row['segments']:9.0f}{row['least']:6.0f}{shown}", flush=True)
    print(_summary([row for of_cloud in report.values() for rows in of_cloud.values() for row in rows]))
    print(json.dumps(report))


def _of_turn(sample: Sample, stem: Path) -> dict[str, Rows]:
    """By size of cubes, a row per level of the superpoints that lie beside a stem."""
    from scores import voted

    import pcgraph

    seconds = []
    for _ in range(2):  # the first compiles
        start = time.perf_counter()
        result = pcgraph.segment(sample.points, sample.colors)
        seconds.append(time.perf_counter() - start)
    rows: dict[str, Rows] = {}
    for cube in CUBES:
        with np.load(f"{stem}.{cube:g}.npz") as found:
            levels, taken = found["levels"], float(found["seconds"])
        for level in levels:
            sizes = np.bincount(level)
            n, least = len(sizes), int(sizes.min())
            most = int(result.cut(altitude=-1.0, min_size=least).max()) + 1
            ours = result.cut(n=min(n, result.tree.n_leaves)), result.cut(n=min(n, most), min_size=least)
            scores = [voted(sample.truth, level) | {"s": taken}]
            scores += [voted(sample.truth, cut) | {"s": seconds[1]} for cut in ours]
            row = {"segments": n, "least": least} | dict(zip(WHICH, scores, strict=True))
            rows.setdefault(f"{cube:g}", []).append(row)
    return rows


def _mean(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means of the numbers in rows of one shape."""
    means: dict[str, Any] = {}
    for key, first in rows[0].items():
        values = [row[key] for row in rows]
        means[key] = _mean(values) if isinstance(first, dict) else float(np.mean(values))
    return means


def _summary(rows: Rows) -> str:
    """How many of the figures of the cuts reach those of the superpoints, in a line per kind of cut."""
    lines = []
    for which in WHICH[1:]:
        short = {key: np.array([row[WHICH[0]][key] - row[which][key] for row in rows]) for key in ("purity", "mIoU")}
        every = np.concatenate(list(short.values()))
        lines.append(
            f"{which}: as good in {np.count_nonzero(every <= 0.0)} of {every.size} figures (purity in "
            f"{np.count_nonzero(short['purity'] <= 0.0)} of {len(rows)}), within 0.01 in "
            f"{np.count_nonzero(every <= 0.01)}; at most {every.max():.4f} less"
        )
    return "\n".join(lines)


# --- in the other one -------------------------------------------------------------------------------------------------


def partition(path: Path) -> None:
    """Write the superpoints of a cloud beside it, a row per level, for each size of cubes."""
    with np.load(path) as columns:
        points, colors = columns["points"], columns["colors"] / 255.0
    for cube in CUBES:
        start = time.perf_counter()
        cells = np.unique(np.floor(points / cube).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
        size = np.bincount(cells).astype(np.float64)
        columns = np.hstack((points, colors)) if len(colors) else points
        means = np.stack([np.bincount(cells, column) for column in columns.T], axis=1) / size[:, None]
        levels = np.stack(superpoints(means[:, :3], means[:, 3:]))[:, cells]
        seconds = time.perf_counter() - start
        np.savez(path.with_name(path.name.replace(".cloud.npz", f".{cube:g}.npz")), levels=levels, seconds=seconds)


def superpoints(position: NDArray[np.float64], colors: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Superpoints (n,) of each level, the finest first."""
    import pgeof
    from scipy.spatial import cKDTree

    n = len(position)
    distances, near = cKDTree(position).query(position, NEIGHBOURS + 1, workers=2)
    starts = (np.arange(n + 1) * (NEIGHBOURS + 1)).astype(np.uint32)
    shape = pgeof.compute_features(position.astype(np.float32), near.ravel().astype(np.uint32), starts)[:, :4]
    shape[:, 3] *= VERTICALITY
    heights = position[:, 2] - position[:, 2].min()
    often, edges = np.histogram(heights[heights < LOW], bins=75)
    elevation = ELEVATION * (heights - edges[often.argmax() : often.argmax() + 2].mean())
    features = np.hstack((colors, shape, elevation[:, None]))
    distances, near = distances[:, 1 : ADJACENT + 1], near[:, 1 : ADJACENT + 1]
    sources = np.repeat(np.arange(n), ADJACENT)
    weights = (1.0 / (1.0 + distances / distances.mean())).ravel()
    levels, size, label = [], np.ones(n), np.arange(n)
    graph = sources, near.ravel(), weights
    for regularisation in REGULARISATIONS:
        region, means, graph = _cut_pursuit(position, features, size, graph, regularisation)
        position, features = means[:, :3] + position.mean(axis=0), means[:, 3:]
        size = np.bincount(region, size, len(means))
        label = region[label]
        levels.append(label)
    return levels


Graph = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]


def _cut_pursuit(
    position: NDArray[np.float64],
    features: NDArray[np.float64],
    size: NDArray[np.float64],
    graph: Graph,
    regularisation: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64], Graph]:
    """Region of each node, (n,); means of the regions, positions about their mean; and the graph of the regions."""
    from pycut_pursuit.cp_d0_dist import cp_d0_dist

    sources, targets, weights = _with_isolated(position, *graph)
    order = np.argsort(sources, kind="stable")
    first = np.searchsorted(sources[order], np.arange(len(position) + 1)).astype(np.uint32)
    values = np.hstack((position - position.mean(axis=0), features))
    count = np.ones(values.shape[1], np.float32)
    count[:3] = POSITION_WEIGHT
    region, means, reduced = cp_d0_dist(
        values.shape[1],
        np.asfortranarray(values.T.astype(np.float32)),
        first,
        targets[order].astype(np.uint32),
        edge_weights=(regularisation * weights[order]).astype(np.float32),
        vert_weights=size.astype(np.float32),
        coor_weights=count,
        cp_dif_tol=1e-2,
        cp_it_max=ITERATIONS,
        split_damp_ratio=0.7,
        min_comp_weight=LEAST,
        verbose=False,
        max_num_threads=2,
        compute_Graph=True,
    )
    starts, targets, weights = (np.asarray(column) for column in reduced)
    sources = np.repeat(np.arange(len(starts) - 1), np.diff(starts.astype(np.int64)))
    return region.astype(np.int64), means.T, (sources, targets.astype(np.int64), weights / regularisation)


def _with_isolated(
    position: NDArray[np.float64], sources: NDArray[np.int64], targets: NDArray[np.int64], weights: NDArray[np.float64]
) -> Graph:
    """The graph, and edges from nodes that have none to those nearest to them."""
    from scipy.spatial import cKDTree

    alone = np.setdiff1d(np.arange(len(position)), np.concatenate((sources, targets)))
    k = min(ADJACENT, len(position) - 1)
    if not len(alone) or not k:
        return sources, targets, weights
    distances, near = cKDTree(position).query(position[alone], k + 1)
    more = np.repeat(alone, k), near[:, 1:].ravel(), (1.0 / (1.0 + distances / distances.mean()))[:, 1:].ravel()
    return (
        np.concatenate((sources, more[0])),
        np.concatenate((targets, more[1])),
        np.concatenate((weights, more[2])),
    )


if __name__ == "__main__":
    main()
