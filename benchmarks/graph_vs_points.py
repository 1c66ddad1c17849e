# SPDX-License-Identifier: Apache-2.0
"""Classes of points: learned from raw points, from supervoxels, and from what graph and tree add to these.

    python benchmarks/graph_vs_points.py [--trees 50]

The same random forest learns from each, in three folds over whole clouds. Points are described as in Weinmann et al.
2015: colour (or none), covariance of the 20 and 80 nearest points, and, where pose is told, height and slope. Tasks:
table or object, and table, box or round object (real, mOSD), and six exact classes of simulated rooms. Accuracy is the
share of points, in the mean, median and worst cloud; mIoU the mean over classes. Seconds are for learning from the
clouds of two folds, features included, and for labelling all points of one cloud (raw points: extrapolated from
20 000); those of nodes include `pcgraph.segment`. The last line is JSON.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from mosd import load_clouds
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from simulated_rooms import room
from sklearn.ensemble import RandomForestClassifier

import pcgraph
from pcgraph.detection import find_planes
from pcgraph.learning import NodeClassifier

FOLDS = 3
LEARN = 3000  # points per cloud from which the points' classifier learns
JUDGE = 6000  # points per cloud on which it is judged; nodes are judged on all points
TIMED = 20000  # points that are labelled against the clock
NEAR = (20, 80)
POSE = 1 + 3 * len(NEAR)
COLOR = [0, 1, 2, *(3 + 9 * i + 6 + c for i in range(len(NEAR)) for c in range(3))]
VARIANTS = {
    "supervoxels": {"neighbours": 0, "ancestors": 0},
    "+ graph": {"neighbours": 2, "ancestors": 0},
    "+ tree": {"neighbours": 0, "ancestors": 3},
    "+ graph + tree": {"neighbours": 2, "ancestors": 3},
}


@dataclass(frozen=True)
class Sample:
    """Points drawn from a cloud to learn from and to judge by, their features, and the seconds the former took."""

    learned: NDArray[np.int64]
    judged: NDArray[np.int64]
    learn: NDArray[np.float64]
    judge: NDArray[np.float64]
    seconds: float


@dataclass(frozen=True)
class Example:
    """One labelled cloud with its segmentation and the seconds that took."""

    points: NDArray[np.float64]
    colors: NDArray[np.float64]
    truth: NDArray[np.int32]
    fold: int
    result: pcgraph.Segmentation
    up: NDArray[np.float64]
    ground: float
    seconds: float

    @cached_property
    def image(self) -> NDArray[np.int32]:
        """The truth in the shape of the points, -1 where there is none."""
        truth = np.full(self.result.supervoxels.shape, -1, np.int32)
        truth[self.result.supervoxels >= 0] = self.truth
        return truth

    @cached_property
    def sample(self) -> Sample:
        pick = np.random.default_rng(0).permutation(np.flatnonzero(self.truth >= 0))
        learned, judged = pick[:LEARN], pick[-JUDGE:]
        start = time.perf_counter()
        learn = point_features(self, learned)
        seconds = time.perf_counter() - start
        return Sample(learned, judged, learn, point_features(self, judged), seconds)


def example(points, colors, truth, fold, up=None):  # type: ignore[no-untyped-def]
    start = time.perf_counter()
    result = pcgraph.segment(points, colors)
    seconds = time.perf_counter() - start
    planes = find_planes(result, up=up)
    finite = result.supervoxels >= 0
    ground = planes.offsets[0] if up is None else float((points[finite] @ up).min())
    shades = colors / 255.0 if colors.dtype == np.uint8 else colors
    return Example(
        points[finite].astype(float), shades[finite], truth[finite], fold, result, planes.up, ground, seconds
    )


def point_features(cloud: Example, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
    """Features of some points of a cloud, (q, f); the last `POSE` columns tell height and slope."""
    _, near = cKDTree(cloud.points).query(cloud.points[chosen], k=max(NEAR))
    columns, posed = [cloud.colors[chosen]], [(cloud.points[chosen] @ cloud.up - cloud.ground)[:, None]]
    for k in NEAR:
        around = cloud.points[near[:, :k]]
        local = around - around.mean(axis=1, keepdims=True)
        values, vectors = np.linalg.eigh(local.transpose(0, 2, 1) @ local / k)
        s = np.sqrt(np.maximum(values, 0.0))
        top = np.maximum(s[:, 2], 1e-12)
        columns += [s, np.stack(((s[:, 2] - s[:, 1]) / top, (s[:, 1] - s[:, 0]) / top, s[:, 0] / top), axis=1)]
        columns.append(cloud.colors[near[:, :k]].std(axis=1))
        normal = vectors[:, :, 0]
        normal = normal * np.sign(-np.einsum("qa,qa->q", normal, cloud.points[chosen]))[:, None]  # to the camera
        rise = normal @ cloud.up
        posed.append(np.stack((rise, np.abs(rise), np.ptp(around @ cloud.up, axis=1)), axis=1))
    return np.concatenate(columns + posed, axis=1)


def forest(trees: int) -> RandomForestClassifier:
    return RandomForestClassifier(trees, min_samples_leaf=2, random_state=0)


def judge(tables: list[NDArray[np.int64]]) -> dict[str, float]:
    """Measures from one confusion table per cloud, each of the same weight."""
    shares = np.array([table / table.sum() for table in tables])
    confusion, right = shares.sum(axis=0), np.diag(shares.sum(axis=0))
    with np.errstate(invalid="ignore"):
        ious = right / (confusion.sum(axis=0) + confusion.sum(axis=1) - right)
    single = np.trace(shares, axis1=1, axis2=2)
    return {
        "accuracy": float(single.mean()),
        "median": float(np.median(single)),
        "worst": float(single.min()),
        "miou": float(np.nanmean(ious)),
    }


def points_alone(clouds: list[Example], n: int, pose: bool, trees: int, color: bool) -> dict[str, float]:
    kept = np.r_[: 3 + 9 * len(NEAR) + (POSE if pose else 0)]
    if not color:
        kept = kept[~np.isin(kept, COLOR)]
    tables, learning = [], 0.0
    for fold in range(FOLDS):
        taught = [cloud for cloud in clouds if cloud.fold != fold]
        rows = np.concatenate([cloud.sample.learn[:, kept] for cloud in taught])
        truth = np.concatenate([cloud.truth[cloud.sample.learned] for cloud in taught])
        start = time.perf_counter()
        model = forest(trees).fit(rows, truth)
        learning += time.perf_counter() - start + sum(cloud.sample.seconds for cloud in taught)
        for cloud in clouds:
            if cloud.fold == fold:
                table = np.zeros((n, n), np.int64)
                np.add.at(table, (cloud.truth[cloud.sample.judged], model.predict(cloud.sample.judge[:, kept])), 1)
                tables.append(table)
    n_points = len(clouds[0].points)
    some = np.arange(0, n_points, max(n_points // TIMED, 1))
    start = time.perf_counter()
    model.predict(point_features(clouds[0], some)[:, kept])
    labelling = (time.perf_counter() - start) * n_points / len(some)
    return {**judge(tables), "learn_s": learning / FOLDS, "label_s": labelling}


def nodes(clouds: list[Example], n: int, pose: bool, trees: int, options: dict[str, int]) -> dict[str, float]:
    tables, learning, labelling = [], 0.0, 0.0
    model = NodeClassifier(forest(trees), pose=pose, **options)
    for fold in range(FOLDS):
        taught = [cloud for cloud in clouds if cloud.fold != fold]
        start = time.perf_counter()
        model.fit([c.result for c in taught], [c.image for c in taught], [c.up for c in taught])
        learning += time.perf_counter() - start + sum(cloud.seconds for cloud in taught)
        for cloud in clouds:
            if cloud.fold == fold:
                start = time.perf_counter()
                predicted = model.predict(cloud.result, cloud.up)
                labelling += time.perf_counter() - start + cloud.seconds
                known, table = cloud.image >= 0, np.zeros((n, n), np.int64)
                np.add.at(table, (cloud.image[known], predicted[known]), 1)
                tables.append(table)
    return {**judge(tables), "learn_s": learning / FOLDS, "label_s": labelling / len(clouds)}


def tasks() -> dict[str, tuple[list[Example], int]]:
    """Clouds and number of classes by task."""
    real = load_clouds()
    round_ones = [33 <= int("".join(filter(str.isdigit, cloud.name))) <= 44 for cloud in real]
    rank = [sum(r == kind for r in round_ones[:i]) for i, kind in enumerate(round_ones)]
    plain, kinds = [], []
    for cloud, is_round, place in zip(real, round_ones, rank, strict=True):
        plain.append(example(cloud.points, cloud.colors, np.minimum(cloud.objects, 1), place % FOLDS))
        kind = np.where(plain[-1].truth > 0, 1 + int(is_round), plain[-1].truth)
        kinds.append(replace(plain[-1], truth=kind))
    views = [room(seed) for seed in range(18)]
    rooms = [example(v.points, v.colors, v.classes, i % FOLDS, v.up) for i, v in enumerate(views)]
    return {"table or object": (plain, 2), "table, box or round": (kinds, 3), "rooms": (rooms, 6)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trees", type=int, default=50)
    trees = parser.parse_args().trees
    report = []
    first = room(0, shape=(60, 80))
    example(first.points, first.colors, first.classes, 0, first.up)  # compiles
    for task, (clouds, n) in tasks().items():
        for pose in (True, False):
            print(f"\n{task}, {'with' if pose else 'without'} height and slope")
            for name in ("points", "no colour", *VARIANTS):
                if name in ("points", "no colour"):
                    row = points_alone(clouds, n, pose, trees, color=name == "points")
                else:
                    row = nodes(clouds, n, pose, trees, VARIANTS[name])
                report.append({"task": task, "pose": pose, "features": name, **row})
                print(f"  {name:15s}" + "  ".join(f"{key} {value:.3f}" for key, value in row.items()), flush=True)
    print(json.dumps(report))


if __name__ == "__main__":
    main()
