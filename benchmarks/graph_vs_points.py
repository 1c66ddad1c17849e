# SPDX-License-Identifier: Apache-2.0
"""Classes of points: learned from raw points, from supervoxels, and from what graph and tree add to these.

    python benchmarks/graph_vs_points.py [--trees 50]

The same random forest learns from each, in three folds over whole clouds. Points are described as in Weinmann et al.
2015: colour, covariance of the 20 and 80 nearest points, and, where pose is told, height and slope. Tasks: table or
object, and table, box or round object (real, mOSD), and six exact classes of simulated rooms. Accuracy counts points;
mIoU is the mean over classes. Seconds are for learning from the clouds of two folds, features included, and for
labelling all points of one cloud; those of nodes include `pcgraph.segment`. The last line is JSON.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass

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
LEARN = 4000  # points per cloud from which the points' classifier learns: more hardly change its accuracy
JUDGE = 10000  # points per cloud on which it is judged; nodes are judged on all points
NEAR = (20, 80)
VARIANTS = {
    "supervoxels": {"neighbours": 0, "ancestors": 0},
    "+ graph": {"neighbours": 2, "ancestors": 0},
    "+ tree": {"neighbours": 0, "ancestors": 3},
    "+ graph + tree": {"neighbours": 2, "ancestors": 3},
}


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


def point_features(cloud: Example, chosen: NDArray[np.int64], pose: bool) -> NDArray[np.float64]:
    """Features of some points of a cloud, (q, f)."""
    _, near = cKDTree(cloud.points).query(cloud.points[chosen], k=max(NEAR))
    columns = [cloud.colors[chosen]]
    for k in NEAR:
        around = cloud.points[near[:, :k]]
        local = around - around.mean(axis=1, keepdims=True)
        values, vectors = np.linalg.eigh(local.transpose(0, 2, 1) @ local / k)
        s = np.sqrt(np.maximum(values, 0.0))
        top = np.maximum(s[:, 2], 1e-12)
        columns += [s, np.stack(((s[:, 2] - s[:, 1]) / top, (s[:, 1] - s[:, 0]) / top, s[:, 0] / top), axis=1)]
        columns.append(cloud.colors[near[:, :k]].std(axis=1))
        if pose:
            normal = vectors[:, :, 0]
            normal = normal * np.sign(-np.einsum("qa,qa->q", normal, cloud.points[chosen]))[:, None]  # to the camera
            rise = normal @ cloud.up
            columns += [np.stack((rise, np.abs(rise), np.ptp(around @ cloud.up, axis=1)), axis=1)]
    if pose:
        columns.append((cloud.points[chosen] @ cloud.up - cloud.ground)[:, None])
    return np.concatenate(columns, axis=1)


def forest(trees: int) -> RandomForestClassifier:
    return RandomForestClassifier(trees, min_samples_leaf=2, random_state=0, n_jobs=2)


def judge(confusion: NDArray[np.int64]) -> dict[str, float]:
    right = np.diag(confusion)
    with np.errstate(invalid="ignore"):
        ious = right / (confusion.sum(axis=0) + confusion.sum(axis=1) - right)
    return {"accuracy": float(right.sum() / confusion.sum()), "miou": float(np.nanmean(ious))}


def points_alone(clouds: list[Example], n: int, pose: bool, trees: int) -> dict[str, float]:
    rng = np.random.default_rng(0)
    picks = [rng.permutation(np.flatnonzero(cloud.truth >= 0)) for cloud in clouds]
    confusion, learning = np.zeros((n, n), np.int64), 0.0
    judged = [point_features(cloud, pick[-JUDGE:], pose) for cloud, pick in zip(clouds, picks, strict=True)]
    for fold in range(FOLDS):
        start = time.perf_counter()
        taught = [i for i, cloud in enumerate(clouds) if cloud.fold != fold]
        rows = np.concatenate([point_features(clouds[i], picks[i][:LEARN], pose) for i in taught])
        model = forest(trees).fit(rows, np.concatenate([clouds[i].truth[picks[i][:LEARN]] for i in taught]))
        learning += time.perf_counter() - start
        for i, cloud in enumerate(clouds):
            if cloud.fold == fold:
                np.add.at(confusion, (cloud.truth[picks[i][-JUDGE:]], model.predict(judged[i])), 1)
    start = time.perf_counter()
    model.predict(point_features(clouds[0], np.arange(len(clouds[0].points)), pose))
    labelling = time.perf_counter() - start
    return {**judge(confusion), "learn_s": learning / FOLDS, "label_s": labelling}


def nodes(clouds: list[Example], n: int, pose: bool, trees: int, options: dict[str, int]) -> dict[str, float]:
    confusion, learning, labelling = np.zeros((n, n), np.int64), 0.0, 0.0
    model = NodeClassifier(forest(trees), pose=pose, **options)
    truths = []
    for cloud in clouds:
        truth = np.full(cloud.result.supervoxels.shape, -1, np.int32)
        truth[cloud.result.supervoxels >= 0] = cloud.truth
        truths.append(truth)
    ups = [cloud.up for cloud in clouds]
    for fold in range(FOLDS):
        taught = [i for i, cloud in enumerate(clouds) if cloud.fold != fold]
        start = time.perf_counter()
        model.fit([clouds[i].result for i in taught], [truths[i] for i in taught], [ups[i] for i in taught])
        learning += time.perf_counter() - start + sum(clouds[i].seconds for i in taught)
        for i, cloud in enumerate(clouds):
            if cloud.fold == fold:
                start = time.perf_counter()
                predicted = model.predict(cloud.result, cloud.up)
                labelling += time.perf_counter() - start + cloud.seconds
                known = truths[i] >= 0
                np.add.at(confusion, (truths[i][known], predicted[known]), 1)
    return {**judge(confusion), "learn_s": learning / FOLDS, "label_s": labelling / len(clouds)}


def tasks() -> dict[str, tuple[list[Example], int]]:
    """Clouds and number of classes by task."""
    real = load_clouds()
    round_ones = [33 <= int("".join(filter(str.isdigit, cloud.name))) <= 44 for cloud in real]
    rank = [sum(r == kind for r in round_ones[:i]) for i, kind in enumerate(round_ones)]
    plain, kinds = [], []
    for cloud, is_round, place in zip(real, round_ones, rank, strict=True):
        plain.append(example(cloud.points, cloud.colors, np.minimum(cloud.objects, 1), place % FOLDS))
        kind = np.where(plain[-1].truth > 0, 1 + int(is_round), plain[-1].truth)
        kinds.append(Example(**{**plain[-1].__dict__, "truth": kind}))
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
            for name in ("points", *VARIANTS):
                if name == "points":
                    row = points_alone(clouds, n, pose, trees)
                else:
                    row = nodes(clouds, n, pose, trees, VARIANTS[name])
                report.append({"task": task, "pose": pose, "features": name, **row})
                print(
                    f"  {name:15s} accuracy {row['accuracy']:.4f}  mIoU {row['miou']:.4f}  "
                    f"learn {row['learn_s']:5.1f} s  label {row['label_s']:5.2f} s",
                    flush=True,
                )
    print(json.dumps(report))


if __name__ == "__main__":
    main()
