# SPDX-License-Identifier: Apache-2.0
"""Is pcgraph's default good on every kind of cloud? One table of clouds against settings and what people use.

    python benchmarks/domains.py [--domains "room1,street sweep A"] [--quick] [--turns N] [--superpoints FOLDER]

Rows of each domain (`domain_clouds.py`):

    default        `pcgraph.segment(points, colors)` and nothing else
    best knobs     the best of a fixed grid: viewpoint told or not, camera or growth of voxels with range, voxel size,
                   linkage, object altitude. Each score takes its own best; the setting named is that of the first score
    chosen         for each cloud or copy the setting, default and baselines among them, that is best on the domain's
                   others: what knobs are worth to somebody who cannot look at the truth. The best of so many settings
                   is above the default by chance, too, as scores of one cloud are draws
    Mumford-Shah   `linkage=MumfordShahLinkage()` and nothing else
    PCL            VCCS and LCCP, best of two voxel sizes
    Felzenszwalb   on the normals of a graph of the 8 nearest points, best of several k, each score its own
    DBSCAN         after a plane by RANSAC, best of several radii, each score its own
    superpoints    those that the file brings along

Columns, means over a domain's clouds; those that count in the domain are named in its heading:

    wov            weighted overlap of the objects with the true segments (segmentation covering)
    oracle, parts  weighted overlap of the best node of the tree for each true segment; the same for true parts
    things         mean over cars, poles and people, or the furniture of a room, with 30 points and more each, of the
                   IoU of the best object
    ground         the same for ground alone
    purity, mIoU   every segment of a cut into a given number (in the heading) takes its most frequent true label:
                   fraction of the points that are right, and mean over the true segments of their IoU. Felzenszwalb's
                   k is the one that gives this number or just fewer; other labels that come without a tree keep
                   their largest segments up to it, and the rest counts as one
    one            1 / number of objects
    change, noise  wov less that of the same cloud without noise; IoU of the points that have no label with the noise
    objects, single, s    objects, those of one point, seconds per cloud

A point without a label belongs to one more segment, that of all such points. A cloud turned about z and shifted is
another draw of voxels, and scores of one cloud change by some hundredths; with --turns all rows of domains that have
only one cloud are means over so many copies of it.

After the domains come settings of the grid as if each were the default everywhere (without what it says of the
viewpoint where none is known), the twelve best of them: the mean over all domains' first scores and over all scores
that count, how many of these are within 0.01 of the best of all rows, and the largest loss. The last line is JSON: for
each domain default, best, chosen, baselines; worst_loss, the least of default - max(best, baselines) over the scores
that count; and worst_loss_of_chosen, the least of default - chosen.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from baselines import felzenszwalb, felzenszwalb_cut, normal_graph, plane_and_clusters
from domain_clouds import NOISE, Domain, MissingDataError, Sample, domains
from numpy.typing import NDArray
from peers import PclSetting, pcl_driver, run_pcl
from scipy.spatial import cKDTree
from scores import Row, completed, largest, mean_overlap, voted

import pcgraph
from pcgraph.metrics import tree_oracle, weighted_overlap
from pcgraph.tree.linkage import Linkage

COLUMNS = ("wov", "oracle", "parts", "things", "ground", "purity", "mIoU", "one", "change", "noise")
COUNTS = ("objects", "single", "s")
ALTITUDES = (0.25, 0.5, 2.0, 4.0)  # times the default
SPACINGS = 3.5  # median distances between nearest points: the voxels that others get, and the unit of the next two
VOXELS = (None, 2.0, 4.0)  # twice as many where clouds are large
SHOWN = 12  # settings
SCALES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
MIN_POINTS = (3, 10)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domains", help="names, comma-separated, or the beginnings of names; default: all")
    parser.add_argument("--quick", action="store_true", help="leave out large clouds and the best knobs")
    parser.add_argument(
        "--turns", type=int, default=1, metavar="N", help="copies of a cloud that is its domain's only one"
    )
    parser.add_argument("--superpoints", type=Path, help="folder of .npz with points, labels, superpoints (and colors)")
    args = parser.parse_args()
    chosen = _chosen(domains(args.superpoints), args.domains, args.quick)
    _warm_up()
    report: dict[str, Any] = {}
    settings: dict[str, dict[str, Row]] = {}
    for domain in chosen:
        try:
            samples = domain.samples()
        except MissingDataError as missing:
            print(f"\n{domain.name}: left out, {missing}")
            continue
        if len(samples) == 1:
            samples = samples[0].turned(args.turns)
        report[domain.name], settings[domain.name] = _measure(domain, samples, with_best=not args.quick)
    if not args.quick:
        _one_for_all(report, settings)
    losses = {name: rows["loss"] for name, rows in report.items() if rows["loss"] is not None}
    worst = min(losses, key=losses.__getitem__, default=None)
    of_chosen = [loss for rows in report.values() for loss in rows.get("losses_of_chosen", {}).values()]
    if of_chosen:
        within = sum(loss >= -0.01 for loss in of_chosen)
        print(f"\ndefault against the chosen: {within} of {len(of_chosen)} scores within 0.01, least {min(of_chosen)}")
    worst_losses = {
        "worst_loss": losses[worst] if worst else None,
        "worst_loss_of_chosen": min(of_chosen, default=None),
    }
    print(json.dumps(report | worst_losses | {"worst_domain": worst}))


def _chosen(every: list[Domain], names: str | None, quick: bool) -> list[Domain]:
    if names is None:
        return [domain for domain in every if not (quick and domain.large)]
    beginnings = [name.strip() for name in names.split(",")]
    for beginning in beginnings:
        if not any(domain.name.startswith(beginning) for domain in every):
            raise SystemExit(f"no domain {beginning!r}; there are: {', '.join(domain.name for domain in every)}")
    return [domain for domain in every if domain.name.startswith(tuple(beginnings))]


def _warm_up() -> None:
    """Compile all that is timed."""
    points = np.random.default_rng(0).random((3000, 3)) * (1.0, 1.0, 0.001)
    for linkage in (None, pcgraph.MumfordShahLinkage(), pcgraph.ConvexityLinkage()):
        found = pcgraph.segment(points, linkage=linkage)
    tree_oracle(found.tree, found.supervoxels, found.labels)
    felzenszwalb(normal_graph(points), 1.0)


def _measure(domain: Domain, samples: list[Sample], *, with_best: bool) -> tuple[dict[str, Any], dict[str, Row]]:
    """What the report says of a domain, and the rows of all settings by their names."""
    sizes = sum(int(np.isfinite(sample.points).all(axis=-1).sum()) for sample in samples) // len(samples)
    number = _segments(domain, samples[0])
    print(f"\n{domain.name}: {len(samples)} x {sizes} points; counts: {', '.join(domain.scores)}; cuts of {number}")
    print(" " * 14 + "".join(f"{name:>8s}" for name in (*COLUMNS, *COUNTS)))
    default = [_segmented(domain, sample)[0] for sample in samples]
    rows: dict[str, Any] = {"default": _mean(default), "best": None, "chosen": None, "baselines": {}}
    _show("default", rows["default"])
    plain = [_segmented(domain, sample, linkage=pcgraph.MumfordShahLinkage())[0] for sample in samples]
    rows["mumford_shah"] = _mean(plain)
    _show("Mumford-Shah", rows["mumford_shah"])
    others: list[list[Row]] = []
    for name, baseline in BASELINES.items():
        found = list(baseline(domain, samples))
        if found:
            others += [of_setting for _, of_setting in found]
            best, setting = _best(domain, found)
            rows["baselines"][name] = best
            _show(name, best, setting)
    settings = {"default": default, "Mumford-Shah": plain} | (dict(_grid(domain, samples)) if with_best else {})
    if with_best:
        best, setting = _best(domain, list(settings.items()))
        rows["best"] = best | {"knobs": setting}
        _show("best knobs", best, setting)
        if len(samples) > 1:
            rows["chosen"] = _chosen_elsewhere([*settings.values(), *others])
            _show("chosen", rows["chosen"])
    rivals = [row for row in (rows["best"], *rows["baselines"].values()) if row is not None]
    losses = {
        score: round(rows["default"][score] - max(rival[score] for rival in rivals if score in rival), 4)
        for score in domain.scores
        if score in rows["default"] and any(score in rival for rival in rivals)
    }
    rows["losses"], rows["loss"] = losses, min(losses.values(), default=None)
    print(" " * 14 + f"default against the best of the others: {losses}", flush=True)
    if rows["chosen"] is not None:
        rows["losses_of_chosen"] = {score: round(rows["default"][score] - rows["chosen"][score], 4) for score in losses}
        print(" " * 14 + f"default against the chosen: {rows['losses_of_chosen']}", flush=True)
    return rows, {name: _mean(of_setting) for name, of_setting in settings.items()}


def _one_for_all(report: dict[str, Any], settings: dict[str, dict[str, Row]]) -> None:
    """Show what each setting would be worth as the default of all domains, the best of them first."""
    table: dict[tuple[float, ...], str] = {}  # settings that say the same once
    for name in {name: None for every in settings.values() for name in every}:
        found = {domain: every.get(name, every.get(name.split("/ ")[-1])) for domain, every in settings.items()}
        rows = {domain: row for domain, row in found.items() if row is not None and report[domain]["losses"]}
        if None in found.values():
            continue
        scores = [[row[score] for score in report[domain]["losses"]] for domain, row in rows.items()]
        losses = [
            loss + row[score] - report[domain]["default"][score]  # against the best of all rows
            for domain, row in rows.items()
            for score, loss in report[domain]["losses"].items()
        ]
        means = float(np.mean([values[0] for values in scores])), float(np.mean(np.concatenate(scores)))
        table.setdefault((*means, sum(loss >= -0.01 for loss in losses), min(losses)), name)
    print(f"\nOne setting for all, of {len(table)}; of {len(losses)} scores\n   first     all  within   worst")
    for numbers, name in sorted(table.items(), reverse=True)[:SHOWN]:
        print("{:8.4f}{:8.4f}{:8d}{:8.3f}  ".format(*numbers) + name)


# --- pcgraph ------------------------------------------------------------------------------------------------------


def _segmented(domain: Domain, sample: Sample, **knobs: Any) -> tuple[Row, pcgraph.Segmentation]:
    """Scores of one call."""
    start = time.perf_counter()
    result = pcgraph.segment(sample.points, sample.colors, **knobs)
    seconds = time.perf_counter() - start
    row = judged(sample, result.labels) | scores_of_tree(domain, sample, result) | {"s": seconds}
    if sample.clean is not None:
        clean = pcgraph.segment(sample.clean.points, sample.clean.colors, **knobs)
        row["change"] = row["wov"] - judged(sample.clean, clean.labels)["wov"]
    return row, result


def scores_of_tree(domain: Domain, sample: Sample, result: pcgraph.Segmentation) -> Row:
    """Scores of the tree and of its cut into the domain's number of segments."""
    number = min(_segments(domain, sample), result.tree.n_leaves)
    row = {"oracle": _oracle(result, sample.truth)} | voted(sample.truth, result.cut(n=number))
    if sample.parts is not None:
        row["parts"] = _oracle(result, sample.parts)
    return row


def _oracle(result: pcgraph.Segmentation, truth: NDArray[np.int32]) -> float:
    """Tree oracle; points outside all supervoxels, should there be any, are lost."""
    judged = truth >= 0
    held = float(np.mean(result.supervoxels[judged] >= 0))
    return held * tree_oracle(result.tree, result.supervoxels, truth)


def _grid(domain: Domain, samples: list[Sample]) -> Iterator[tuple[str, list[Row]]]:
    """Scores of all settings, cloud by cloud."""
    known, first = samples[0].viewpoint is not None, pcgraph.segment(samples[0].points, samples[0].colors)
    views: list[dict[str, Any]] = [{}]
    if known:
        views += [{"viewpoint": True}, {"viewpoint": True, "range_growth": 0.5}]
    if known and samples[0].camera:
        views += [{"viewpoint": True, "camera": True}]
    linkages: list[Linkage] = [first.linkage]
    linkages += [
        other for other in (pcgraph.ConvexityLinkage(), pcgraph.MumfordShahLinkage()) if other != first.linkage
    ]
    for view, linkage, size in itertools.product(views, linkages, VOXELS):
        rows: dict[float, list[Row]] = {altitude: [] for altitude in (1.0, *ALTITUDES)}
        for sample in samples:
            knobs = view | {"linkage": linkage}
            if size is not None:
                knobs["voxel_size"] = size * (2.0 if domain.large else 1.0) * _usual_voxel(sample)
            if "viewpoint" in view:
                knobs["viewpoint"] = _one_viewpoint(sample) if "range_growth" in view else sample.viewpoint
            row, result = _segmented(domain, sample, **knobs)
            rows[1.0].append(row)
            for altitude in ALTITUDES:
                labels = result.cut(altitude=altitude * result.object_altitude)
                rows[altitude].append(row | judged(sample, labels))
        told = " + ".join(f"{name}={value}" if name == "range_growth" else name for name, value in view.items())
        for altitude, found in rows.items():
            sized = [] if size is None else [f"voxels x{size:g} (of large clouds x{2.0 * size:g})"]
            named = ", ".join([type(linkage).__name__, *sized, f"altitude x{altitude:g}"])
            yield f"{told} / {named}" if told else named, found


def _one_viewpoint(sample: Sample) -> NDArray[np.float64]:
    """The viewpoint, or the middle of several."""
    assert sample.viewpoint is not None
    return sample.viewpoint if sample.viewpoint.ndim == 1 else sample.viewpoint.mean(axis=0)


@functools.cache
def _usual_voxel(sample: Sample) -> float:
    points = sample.points[np.isfinite(sample.points).all(axis=-1)].astype(np.float64)
    some = np.random.default_rng(0).choice(points, min(len(points), 20_000), replace=False)
    return SPACINGS * float(np.median(cKDTree(points).query(some, 2)[0][:, 1]))


# --- What people use ----------------------------------------------------------------------------------------------


def _felzenszwalb(domain: Domain, samples: list[Sample]) -> Iterator[tuple[str, list[Row]]]:
    rows: dict[float, list[Row]] = {scale: [] for scale in SCALES}
    for sample in samples:
        finite, start = np.isfinite(sample.points).all(axis=-1), time.perf_counter()
        graph = normal_graph(sample.points[finite])
        seconds = time.perf_counter() - start
        cut = {}
        if "purity" in domain.scores:  # else not worth the time
            cut = voted(sample.truth, _spread(finite, felzenszwalb_cut(graph, _segments(domain, sample))))
        for scale in SCALES:
            start = time.perf_counter()
            labels = _spread(finite, felzenszwalb(graph, scale))
            taken = seconds + time.perf_counter() - start
            rows[scale].append(judged(sample, labels) | cut | {"s": taken})
    for scale, found in rows.items():
        yield f"k {scale:g}", found


def _dbscan(domain: Domain, samples: list[Sample]) -> Iterator[tuple[str, list[Row]]]:
    for radius, least in itertools.product(domain.radii, MIN_POINTS):
        rows = []
        for sample in samples:
            finite, start = np.isfinite(sample.points).all(axis=-1), time.perf_counter()
            labels = _spread(finite, plane_and_clusters(sample.points[finite], domain.ground, radius, least))
            rows.append(_of_labels(domain, sample, labels) | {"s": time.perf_counter() - start})
        yield f"radius {radius:g}, {least} points", rows


def _pcl(domain: Domain, samples: list[Sample]) -> Iterator[tuple[str, list[Row]]]:
    if _missing_pcl():
        return
    for size in (1.0, 2.0):
        rows = []
        for sample in samples:
            voxel = size * _usual_voxel(sample)
            points = sample.points.reshape(1, -1, 3) if sample.points.ndim == 2 else sample.points
            colors = np.zeros(points.shape, np.uint8) if sample.colors is None else sample.colors.reshape(points.shape)
            start = time.perf_counter()
            setting = PclSetting(voxel, 5.0 * voxel, 0.0, 1.0, 4.0, camera=sample.organised)
            segments = run_pcl(points.astype(np.float32), colors, setting, repeats=0).segments
            seconds = time.perf_counter() - start
            labels = np.where(segments > 0, segments, -1).reshape(sample.truth.shape)
            rows.append(_of_labels(domain, sample, labels) | {"s": seconds})
        yield f"voxels x{size:g}", rows


@functools.cache
def _missing_pcl() -> bool:
    try:
        pcl_driver()
    except SystemExit as reason:
        print(f"(rows of PCL are left out: {reason})")
        return True
    return False


def _brought(domain: Domain, samples: list[Sample]) -> Iterator[tuple[str, list[Row]]]:
    if all(sample.superpoints is not None for sample in samples):
        yield "", [voted(sample.truth, sample.superpoints) for sample in samples]


BASELINES = {"Felzenszwalb": _felzenszwalb, "DBSCAN": _dbscan, "PCL": _pcl, "superpoints": _brought}


# --- Scores -------------------------------------------------------------------------------------------------------


def _of_labels(domain: Domain, sample: Sample, labels: NDArray[np.integer]) -> Row:
    """Scores of labels that have no tree."""
    return judged(sample, labels) | voted(sample.truth, largest(labels, _segments(domain, sample)))


def judged(sample: Sample, labels: NDArray[np.integer]) -> Row:
    """Scores of objects."""
    sizes = np.bincount(labels[labels >= 0])
    complete = completed(labels)
    row = {"wov": weighted_overlap(complete, sample.truth)}
    row |= {"objects": float(np.count_nonzero(sizes)), "single": float(np.count_nonzero(sizes == 1))}
    row["one"] = 1.0 / max(row["objects"], 1.0)
    if sample.things is not None:
        row["things"] = mean_overlap(complete, sample.truth, sample.things)
    if sample.clean is not None:
        lost, noise = labels < 0, sample.truth == NOISE
        row["noise"] = float(np.count_nonzero(lost & noise) / np.count_nonzero(lost | noise))
    if sample.ground >= 0:
        row["ground"] = mean_overlap(complete, sample.truth, np.array([sample.ground]))
    return row


def _segments(domain: Domain, sample: Sample) -> int:
    return domain.segments if sample.superpoints is None else len(np.unique(sample.superpoints))


def _spread(finite: NDArray[np.bool_], labels: NDArray[np.integer]) -> NDArray[np.int32]:
    full = np.full(finite.shape, -1, np.int32)
    full[finite] = labels
    return full


def _mean(rows: list[Row]) -> Row:
    return {score: float(np.mean([row[score] for row in rows])) for score in rows[0]}


def _best(domain: Domain, settings: list[tuple[str, list[Row]]]) -> tuple[Row, str]:
    """Each score's best, with the rest and the name of the setting that is best in the domain's first score it has."""
    found = [(name, _mean(rows)) for name, rows in settings]
    first = next((score for score in domain.scores if score in found[0][1]), "wov")
    name, row = max(found, key=lambda one: one[1].get(first, 0.0))
    return row | {score: max(other[score] for _, other in found) for score in COLUMNS if score in row}, name


def _chosen_elsewhere(settings: list[list[Row]]) -> Row:
    """Mean over clouds of each score by the setting, clouds' rows each, that is best in it on all the other clouds."""
    chosen: Row = {}
    for score in COLUMNS:
        having = [rows for rows in settings if score in rows[0]]
        if not having:
            continue
        table = np.array([[row[score] for row in rows] for rows in having])  # (settings, clouds)
        of_others = table.sum(axis=1, keepdims=True) - table
        chosen[score] = float(np.mean(table[of_others.argmax(axis=0), np.arange(table.shape[1])]))
    return chosen


def _show(name: str, row: Row, setting: str = "") -> None:
    values = [f"{row[score]:8.3f}" if score in row else " " * 8 for score in COLUMNS]
    values += [f"{row[count]:8.0f}" if count in row else " " * 8 for count in COUNTS[:2]]
    values.append(f"{row['s']:8.2f}" if "s" in row else " " * 8)
    print(f"{name:14s}{''.join(values)}  {setting}", flush=True)


if __name__ == "__main__":
    main()
