# SPDX-License-Identifier: Apache-2.0
"""What does each part of pcgraph's default segmentation gain, on which clouds, and at what price?

    python benchmarks/ablation.py [--parts "gaps,law:"] [--jointly] [--domains "room1,street sweep A"] [--turns N]
                                  [--draws N] [--quick] [--repeats N] [--out FILE] [--table]

Each part (`ablation_parts.py`) is switched off alone, or with --jointly all that are named at once. A score's gain is
that of the default less that without the part, on the same cloud. The clouds (`ablation_clouds.py`) are those of
`domains.py`, with the scores that count there; heaps, images of other cameras; and of each kind of `scan_places.py` the
first cloud, turned, with the fraction of the voxels that face the scanner as a second score. Of a domain with one
cloud, copies of it turned about z are further draws.

Columns, one row per part, the largest gain first:

    gain         mean over all scores of all domains, each the mean over its draws
    +- draws     standard error of it over the draws of each domain: what the luck of the grid makes of these clouds.
                 Domains of one draw take the mean variance of the others
    +- kinds     standard error of it over the domains: what other kinds of clouds may make of it
    rest         gain without the domain that gains most
    for, against domains whose scores gain, or lose, more than 0.003 in the mean
    touched      domains on which the part changes anything at all
    best, worst  the scores that gain and lose most
    image, list  processor time that it takes of a depth image, and of a list of 250 000 points, milliseconds: median of
                 the differences of calls by turns; empty where these never come by it
    lines, constants, kernels
                 what would go with it (`ablation_cost.py`): definitions that nothing else uses, and of those that are
                 but a constant the statements that read it

A part that no call of the default comes by is not run on that cloud; one by which only the way from voxels to objects
comes starts from the default's voxels. --out keeps draws as they come, and goes on from them when it is called again;
--table shows them and runs nothing. For times set NUMBA_NUM_THREADS=1. The last line is JSON: each part's row, and the
code that would go with it.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any

import numpy as np
from ablation_clouds import all_domains
from ablation_cost import Source
from ablation_parts import PARTS, Part, Target, jointly, switched_off
from domain_clouds import Domain, MissingDataError, Sample, mosd_organised
from domains import judged, scores_of_tree
from numpy.typing import NDArray
from room import rooms
from scores import fraction_facing

import pcgraph
import pcgraph.scan as scan_module

NOTICED = 0.003  # mean of a domain's scores from which on a part is for it, or against
LIST_POINTS = 250_000
TURNS, REPEATS = 2, 5

Scores = list[float]
Report = dict[str, Any]
"""What --out keeps: by domain the names of its scores, those of the default, draw by draw, and those without each part
(None: nothing changed; a text: why there are none); and by part the times."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", help="names, comma-separated, or the beginnings of names; default: all")
    parser.add_argument("--jointly", action="store_true", help="switch all of these off at once")
    parser.add_argument("--domains", help="likewise")
    parser.add_argument("--turns", type=int, default=TURNS, metavar="N", help="draws of a domain with one cloud")
    parser.add_argument("--draws", type=int, metavar="N", help="of any domain, at most; default: all")
    parser.add_argument("--quick", action="store_true", help="leave out large clouds, more draws than one, and times")
    parser.add_argument("--repeats", type=int, default=REPEATS, metavar="N", help="of each time")
    parser.add_argument("--out", type=Path, help="keep all draws in this file (JSON), and go on from those in it")
    parser.add_argument("--table", action="store_true", help="only show what is in --out")
    args = parser.parse_args()
    warnings.simplefilter("ignore")  # of switched-off parts
    report = json.loads(args.out.read_text()) if args.out and args.out.exists() else {"domains": {}, "times": {}}
    parts = _named(PARTS, args.parts)
    parts = [jointly(parts)] if args.jointly else parts
    if not args.table:
        for domain in _named(all_domains(args.turns), args.domains):
            if args.quick and domain.large:
                continue
            measure(domain, parts, report, draws=1 if args.quick else args.draws)
            _keep(report, args.out)
        if not args.quick and args.repeats:
            measure_times(parts, report, args.repeats, partial(_keep, report, args.out))
    rows = table(parts, report)
    print(markdown(rows, report))
    print(json.dumps(rows))


def _named(every: Iterable[Any], names: str | None) -> list[Any]:
    """Those of some parts or domains whose names begin as asked."""
    beginnings = None if names is None else tuple(name.strip() for name in names.split(","))
    found = [one for one in every if beginnings is None or one.name.startswith(beginnings)]
    if not found:
        raise SystemExit(f"nothing begins as {names!r}; there are: {', '.join(one.name for one in every)}")
    return found


def _keep(report: Report, path: Path | None) -> None:
    if path is not None:
        beside = path.with_suffix(".part")
        beside.write_text(json.dumps(report), encoding="utf-8")
        beside.replace(path)


# --- Scores with and without each part --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Reference:
    """The default's result of a cloud.

    Attributes
    ----------
    result : pcgraph.Segmentation
    scan : pcgraph.scan.Scan
        What `cluster_scan` was given.
    before, after : set of CodeType
        Python functions that were called before `cluster_scan`, and by it and `merge_supervoxels`.
    """

    result: pcgraph.Segmentation
    scan: scan_module.Scan
    before: set[CodeType]
    after: set[CodeType]

    @classmethod
    def of(cls, sample: Sample) -> Reference:
        """That of a cloud."""
        before: set[CodeType] = set()
        after: set[CodeType] = set()
        given: list[Any] = []
        steps = {step.__name__: step for step in (scan_module.cluster_scan, scan_module.merge_supervoxels)}

        def noting(step: Callable[..., Any]) -> Callable[..., Any]:
            def noted(*arguments: Any) -> Any:
                given.append(arguments[0])
                with _noted(after):
                    return step(*arguments)

            return noted

        vars(scan_module).update({name: noting(step) for name, step in steps.items()})
        try:
            with _noted(before):
                result = pcgraph.segment(sample.points, sample.colors)
        finally:
            vars(scan_module).update(steps)
        return cls(result, given[0], before, after)

    def without(self, part: Part, sample: Sample) -> pcgraph.Segmentation | None:
        """The result without a part; None if it is the same."""
        targets = [Target.of(path) for path in part.off]
        is_early = any(_is_looked_up(target, self.before) for target in targets)
        if not is_early and not any(_is_looked_up(target, self.after) for target in targets):
            return None
        with switched_off(part):
            if is_early:
                found = pcgraph.segment(sample.points, sample.colors)
            else:
                method, linkage = pcgraph.SurfaceGrowth(), pcgraph.RegionLinkage()
                found = scan_module.segment_scan(self.scan, None, scan_module.Settings.of(method, linkage, None))
        return None if _are_same(found, self.result) else found


@contextmanager
def _noted(called: set[CodeType]) -> Iterator[None]:
    """Note which Python functions are called, in this thread and in those that start now."""

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            called.add(frame.f_code)

    earlier = sys.getprofile()
    sys.setprofile(note)
    threading.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(earlier)
        threading.setprofile(earlier)  # type: ignore[arg-type]  # None is none


def _is_looked_up(target: Target, called: set[CodeType]) -> bool:
    """Whether some calls may have come by a name: a Python function was called, or one that reads it."""
    owner, name, value = target
    function = value.fget if isinstance(value, property) else value
    if isinstance(function, FunctionType):
        return function.__code__ in called
    file = None if isinstance(owner, type) else owner.__file__
    return any(name in code.co_names and file in (None, code.co_filename) for code in called)


def _are_same(one: pcgraph.Segmentation, other: pcgraph.Segmentation) -> bool:
    pairs = ((r.labels, r.supervoxels, r.tree.parents, r.tree.altitudes, r.surface.normals) for r in (one, other))
    return all(map(np.array_equal, *pairs))


def _scored(domain: Domain, sample: Sample, result: pcgraph.Segmentation) -> dict[str, float]:
    """The scores that count in a domain, of those that the cloud has."""
    row = judged(sample, result.labels)
    if {"oracle", "purity", "mIoU", "parts"} & set(domain.scores):
        row |= scores_of_tree(domain, sample, result)
    if "facing" in domain.scores and sample.viewpoint is not None and sample.viewpoint.ndim == 1:
        row["facing"] = fraction_facing(result, sample.viewpoint)
    return {name: row[name] for name in domain.scores if name in row}


def measure(domain: Domain, parts: list[Part], report: Report, draws: int | None = None) -> None:
    """Put the scores of a domain, with each part and without, into the report, where they are not there yet."""
    known = report["domains"].get(domain.name, {"without": {}})
    try:
        samples = domain.samples()
    except MissingDataError as missing:
        print(f"{domain.name}: left out, {missing}", flush=True)
        return
    if draws is not None and draws < len(samples):
        samples = [samples[at] for at in np.linspace(0, len(samples) - 1, draws).astype(int)]
    if len(known.get("default", ())) != len(samples):
        known = {"without": {}}
    new = [part for part in parts if part.name not in known["without"]]
    if not new:
        return
    start, default = time.perf_counter(), []
    without: dict[str, list[Scores | str | None]] = {part.name: [] for part in new}
    for sample in samples:
        reference = Reference.of(sample)
        scores = _scored(domain, sample, reference.result)
        default.append(list(scores.values()))
        for part in new:
            without[part.name].append(_scores_without(part, reference, domain, sample))
    without |= known["without"]
    report["domains"][domain.name] = {"scores": list(scores), "default": default, "without": without}
    print(f"{domain.name}: {len(samples)} draws, {time.perf_counter() - start:.0f} s", flush=True)


def _scores_without(part: Part, reference: Reference, domain: Domain, sample: Sample) -> Scores | str | None:
    """The scores without a part; None if nothing changes, and why there are none if it cannot be switched off there."""
    try:
        found = reference.without(part, sample)
    except (ArithmeticError, LookupError, TypeError, ValueError) as failure:
        return f"{type(failure).__name__}: {failure}"
    return None if found is None else list(_scored(domain, sample, found).values())


# --- Times ------------------------------------------------------------------------------------------------------------


def measure_times(parts: list[Part], report: Report, repeats: int, keep: Callable[[], None]) -> None:
    """Put the milliseconds that each part takes of two clouds into the report, where they are not there yet."""
    points, colors = rooms(LIST_POINTS)
    samples = {"list": Sample(points, np.zeros(len(points), np.int32), colors)}
    try:
        samples["image"] = mosd_organised()[0]
    except MissingDataError as missing:
        print(f"times of an image: left out, {missing}")
    for name, sample in samples.items():
        reference = Reference.of(sample)
        for part in parts:
            times = report["times"].setdefault(part.name, {})
            if name in times:
                continue
            targets = [Target.of(path) for path in part.off]
            times[name] = None
            if any(_is_looked_up(target, reference.before | reference.after) for target in targets):
                _seconds(sample, part)  # compiles what it needs
                differences = [_seconds(sample) - _seconds(sample, part) for _ in range(repeats)]
                times[name] = 1e3 * float(np.median(differences))
        report["times"].setdefault("default", {})[name] = 1e3 * float(np.median([_seconds(sample) for _ in range(5)]))
        keep()


def _seconds(sample: Sample, part: Part | None = None) -> float:
    with nullcontext() if part is None else switched_off(part):
        start = time.process_time()
        pcgraph.segment(sample.points, sample.colors)
        return time.process_time() - start


# --- The table --------------------------------------------------------------------------------------------------------


def table(parts: list[Part], report: Report) -> list[dict[str, Any]]:
    """A row for each part of which there are draws, the largest gain first."""
    source, rows = Source(), []
    for part in parts:
        gains = {
            name: found for name, domain in report["domains"].items() if (found := _gains(domain, part)) is not None
        }
        if gains:
            cost, times = source.cost(part.code)._asdict(), report["times"].get(part.name, {})
            code = sorted(":".join(one) for one in source.removed_with(part.code))
            rows.append({"part": part.name, **_summary(gains, report), **times, **cost, "code": code})
    return sorted(rows, key=lambda row: -row["gain"])


def _gains(domain: Report, part: Part) -> NDArray[np.float64] | None:
    """Gains of a domain's scores, (draws, scores); None if the part was not run, or failed on all."""
    pairs = zip(domain["default"], domain["without"].get(part.name, ()), strict=False)
    found = [
        np.subtract(scores, scores if other is None else other) for scores, other in pairs if not isinstance(other, str)
    ]
    return np.array(found, np.float64) if found else None


def _summary(gains: dict[str, NDArray[np.float64]], report: Report) -> dict[str, Any]:
    weights = np.array([gain.shape[1] for gain in gains.values()], np.float64)
    means = np.array([gain.mean() for gain in gains.values()])
    mean = float(weights @ means / weights.sum())
    variances = np.array([gain.mean(axis=1).var(ddof=1) if len(gain) > 1 else math.nan for gain in gains.values()])
    known = np.isfinite(variances)
    variances[~known] = variances[known].mean() if known.any() else math.nan
    variances /= [len(gain) for gain in gains.values()]
    scores = {
        f"{name} {score}": float(column.mean())
        for name, gain in gains.items()
        for score, column in zip(report["domains"][name]["scores"], gain.T, strict=True)
    }
    others = np.arange(len(means)) != np.argmax(weights * means)
    best, worst = max(scores, key=scores.__getitem__), min(scores, key=scores.__getitem__)
    return {
        "gain": mean,
        "draws": float(np.sqrt(weights**2 @ variances) / weights.sum()),
        "kinds": float(np.sqrt(weights**2 @ (means - mean) ** 2) / weights.sum()),
        "rest": float(weights[others] @ means[others] / max(weights[others].sum(), 1.0)),
        "for": int(np.count_nonzero(means > NOTICED)),
        "against": int(np.count_nonzero(means < -NOTICED)),
        "touched": sum(bool(gain.any()) for gain in gains.values()),
        "best": [best, scores[best]] if scores[best] > 0.0 else None,
        "worst": [worst, scores[worst]] if scores[worst] < 0.0 else None,
    }


def markdown(rows: list[dict[str, Any]], report: Report) -> str:
    """The table."""
    n_scores = sum(len(domain["scores"]) for domain in report["domains"].values())
    every = [np.mean(domain["default"], axis=0).sum() for domain in report["domains"].values()]
    default = ", ".join(f"{name} {ms:.0f} ms" for name, ms in report["times"].get("default", {}).items())
    lines = [
        f"{len(report['domains'])} domains, {n_scores} scores, mean of the default {sum(every) / n_scores:.4f}",
        f"time of the default: {default}" if default else "",
        "",
        "| part | gain | +- draws | +- kinds | rest | for | against | touched | best | worst "
        "| image, ms | list, ms | lines | constants | kernels |",
        "|---|" + "---:|" * 7 + "---|---|" + "---:|" * 5,
    ]
    for row in rows:
        ends = " | ".join("" if row[end] is None else f"{row[end][0]} {row[end][1]:+.3f}" for end in ("best", "worst"))
        times = " | ".join("" if row.get(name) is None else f"{row[name]:.1f}" for name in ("image", "list"))
        lines.append(
            f"| {row['part']} | {row['gain']:+.4f} | {row['draws']:.4f} | {row['kinds']:.4f} "
            f"| {row['rest']:+.4f} | {row['for']} "
            f"| {row['against']} | {row['touched']} | {ends} | {times} "
            f"| {row['lines']} | {row['constants']} | {row['kernels']} |"
        )
    failed = sorted(
        f"{part} on {name}: {other}"
        for name, domain in report["domains"].items()
        for part, draws in domain["without"].items()
        for other in {other for other in draws if isinstance(other, str)}
    )
    return "\n".join(lines + (["", "Failed:", *failed] if failed else []) + [""])


if __name__ == "__main__":
    main()
