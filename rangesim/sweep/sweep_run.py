# SPDX-License-Identifier: Apache-2.0
"""Carries out a sweep: the exposures first, then one item of a campaign for each light-transport pass."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rangesim.campaign.engine import run_items
from rangesim.campaign.item_store import ItemStore
from rangesim.campaign.workers import Workers
from rangesim.pipeline.stages import Progress, unwatched
from rangesim.sweep.measure_pass import item_bytes
from rangesim.sweep.passes import Plan, plan
from rangesim.sweep.sweep_result import CellResult, Exposure, SweepResult
from rangesim.sweep.sweep_settings import Sweep

KIND = {"kind": "rangesim-sweep"}
"""What the store of a sweep says of itself. A changed sweep may go on in it: items are named by what they depend on."""


def carry_out(
    sweep: Sweep | Plan,
    out: str | Path | None = None,
    workers: Workers | None = None,
    tell: Progress | None = None,
    retry: bool = False,
) -> SweepResult:
    """The result of a sweep. Tables and page are written by `rangesim.sweep.write_sweep`.

    Parameters
    ----------
    sweep : Sweep, or the Plan of one.
    out : directory in which finished passes are kept, so that the same call goes on after an interruption. None: passes
        are not kept, and this process carries them out one after the other.
    workers : processes that carry out the passes; None: as many as there are cores.
    tell : is called with what is done and with the fraction that is done, 0..1.
    retry : compute the passes again that failed in an earlier run with this `out`.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        As `plan` and `rangesim.campaign.run_items`; without `out` also what a pass raises.
    """
    planned = sweep if isinstance(sweep, Plan) else plan(sweep)
    run = _Run(None if out is None else ItemStore(out, KIND), workers, tell or unwatched, retry)
    run.carry_out(planned.probes())
    exposures = _exposures(planned, run)
    items = planned.items({name: one.exposure_s for name, one in exposures.items()})
    run.carry_out(dict(items))
    failed = {n: run.failed[key] for n, (key, _) in enumerate(items) if key in run.failed}
    results = {n: run.read(key) for n, (key, _) in enumerate(items) if n not in failed}
    warnings = _merged(text for one in results.values() for text in one["warnings"])
    rows, cells = [], {}
    for cell in planned.cells:
        if cell.light_pass in failed:
            continue
        made = results[cell.light_pass]["jobs"][cell.job]
        names = [(row["kind"], row["name"]) for row in made["rows"][0]]
        cells[cell.point, cell.sensor] = CellResult(
            frames=made["frames"],
            acquisition_s=made["acquisition_s"],
            confidence=made["confidence"],
            pictures=made["pictures"],
            objects=made["objects"],
            causes=dict(zip(names, made["causes"], strict=True)),
            sampling_sigma_m=dict(zip(names, made["sampling_sigma_m"], strict=False)),  # none if it is not known
        )
        point = {"point": cell.point, **planned.sweep.points[cell.point].values}
        for seed, of_seed in enumerate(made["rows"]):
            rows += [{**point, "sensor": cell.sensor, "seed": seed, **row} for row in of_seed]
    return SweepResult(planned, rows, cells, exposures, warnings, failed)


def _merged(warnings: Iterable[str]) -> tuple[str, ...]:
    """Warnings, each once; of those that differ in their numbers alone, the first, with the count of the others."""
    alike: dict[str, list[str]] = {}
    for text in dict.fromkeys(warnings):
        alike.setdefault(re.sub(r"(?<![\w.-])[0-9.]+", "#", text), []).append(text)
    return tuple(
        first if not others else f"{first} The same with other numbers: {len(others)} more."
        for first, *others in alike.values()
    )


class _Run:
    """Items that are carried out, by workers with a store, or here without one."""

    def __init__(self, store: ItemStore | None, workers: Workers | None, tell: Progress, retry: bool) -> None:
        self.store, self.workers, self.tell, self.retry = store, workers, tell, retry
        self.kept: dict[str, bytes] = {}
        self.failed: dict[str, str] = {}

    def carry_out(self, items: Mapping[str, Any]) -> None:
        if self.store is not None:
            if items:
                outcome = run_items(item_bytes, items, self.store, self.workers, self.tell, retry=self.retry)
                self.failed |= {one.key: one.error for one in outcome.quarantined}
            return
        for number, (key, item) in enumerate(items.items()):
            self.tell(f"Pass {number + 1} of {len(items)}", number / len(items))
            self.kept[key] = item_bytes(item)

    def read(self, key: str) -> dict[str, Any]:
        content = self.kept[key] if self.store is None else self.store.read(key)
        return json.loads(content)  # type: ignore[no-any-return]


def _exposures(planned: Plan, run: _Run) -> dict[str, Exposure]:
    """Exposures of the sensors that state none: the shortest that automatic exposure would choose in the sweep.

    So no point has more saturated pixels than automatic exposure allows, and all are comparable.
    """
    found: dict[str, Exposure] = {}
    shown = {key: run.read(key)["exposures_s"] for key in planned.probed if key not in run.failed}
    for key, one in planned.probed.items():
        for instrument, exposure_s, point in zip(one.instruments, shown.get(key, ()), one.points, strict=False):
            name = instrument.name
            if exposure_s is None or (name in found and found[name].exposure_s <= exposure_s):
                continue
            assert instrument.detector is not None
            found[name] = Exposure(exposure_s, point, exposure_s <= instrument.detector.min_exposure_s)
    return found
