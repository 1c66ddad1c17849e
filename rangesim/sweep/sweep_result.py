# SPDX-License-Identifier: Apache-2.0
"""The result of a sweep: a row for each point, sensor, seed and surface, their means, and what belongs to the page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from rangesim.settings.config import ShortRepr
from rangesim.signals import ALL
from rangesim.sweep.confidence_intervals import Interval, of_fraction, of_mean
from rangesim.sweep.passes import Plan
from rangesim.sweep.sweep_settings import Sweep

MEANS = ("error_m", "bias_m", "median_abs_m", "rmse_m", "p95_abs_m")
"""Columns of the rows whose means over the seeds stand in the summary, metres."""
FRACTIONS = ("right", "wrong", "missing")
"""Columns that are fractions of all pixels of a row."""


@dataclass(frozen=True)
class Exposure:
    """The exposure that a sweep has fixed for a sensor.

    exposure_s : seconds. point : number of the point that decided it. shortest : whether it is as short as the detector
    can, so that brighter pixels may saturate.
    """

    exposure_s: float
    point: int
    shortest: bool = False


@dataclass(frozen=True)
class CellResult:
    """Findings that the captures of a sensor at a point have in common.

    frames : number of frames. acquisition_s : seconds; None without an exposure. confidence : right and wrong readings
    by classes of confidence, (2, classes). pictures : PNG files, base64, by name. causes : fractions of the pixels that
    failed by each cause in the first capture, by kind and name of the surface. objects : numbers of the true objects
    that the segmentation of the first capture finds, merges, splits, misses and invents; None without objects.
    sampling_sigma_m : noise of the renderer in a reading, metres, by surface; None where it is not known.
    """

    frames: int
    acquisition_s: float | None
    confidence: list[list[int]]
    pictures: Mapping[str, str]
    objects: Mapping[str, int] | None
    causes: Mapping[tuple[str, str], Mapping[str, float]]
    sampling_sigma_m: Mapping[tuple[str, str], float | None]


@dataclass(frozen=True, eq=False, repr=False)
class SweepResult(ShortRepr):
    """The result of a sweep.

    plan : Plan, its passes. rows : one dict for each point, sensor, seed and surface, as `rangesim.compare`.
    cells : CellResult by (number of the point, name of the sensor). exposures : Exposure of the sensors whose exposure
    was chosen for the sweep, by name. warnings : sentences, each once. failed : error of each pass that could not be
    carried out, by the number of the pass; its points have no rows.

    Examples
    --------
    >>> from rangesim.sweep import Sweep, carry_out
    >>> result = carry_out(Sweep("wall", ("amcw",), {"scene.distance_m": (1.0, 2.0)}, seeds=3))  # doctest: +SKIP
    >>> [(row["scene.distance_m"], row["right"].mean) for row in result.summary]  # doctest: +SKIP
    """

    plan: Plan
    rows: list[dict[str, Any]]
    cells: Mapping[tuple[int, str], CellResult]
    exposures: Mapping[str, Exposure]
    warnings: tuple[str, ...] = ()
    failed: Mapping[int, str] | None = None

    @property
    def sweep(self) -> Sweep:
        """The settings."""
        return self.plan.sweep

    @cached_property
    def summary(self) -> list[dict[str, Any]]:
        """One dict for each point, sensor and surface, with means and confidence intervals over the seeds.

        Columns of `MEANS` and `FRACTIONS` hold an `Interval`; `theory_m` and `invented_readings` are numbers or None;
        `causes` holds fractions.
        """
        groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
        for row in self.rows:
            groups.setdefault((row["point"], row["sensor"], row["kind"], row["name"]), []).append(row)
        return [self._summary(rows) for rows in groups.values()]

    def _summary(self, rows: list[dict[str, Any]]) -> dict[str, Any]:
        first, pixels = rows[0], sum(row["pixels"] for row in rows)
        kept = ("point", *self.sweep.vary, "sensor", "kind", "name", "pixels", "lit", "exposure_s")
        found: dict[str, Any] = {key: first[key] for key in kept}
        cell = self.cells[first["point"], first["sensor"]]
        found |= {"seeds": len(rows), "frames": cell.frames, "acquisition_s": cell.acquisition_s}
        found |= {name: of_mean([row[name] for row in rows]) for name in MEANS}
        found["theory_m"] = _mean([row["theory_m"] for row in rows])
        found["sampling_sigma_m"] = cell.sampling_sigma_m.get((first["kind"], first["name"]))
        found |= {name: _fraction([row[name] for row in rows], pixels) for name in FRACTIONS}
        found["invented_readings"] = _mean([row["invented_readings"] for row in rows])
        found["causes"] = cell.causes[first["kind"], first["name"]]
        if first["kind"] == ALL and cell.objects is not None:
            found |= {f"objects_{name}": count for name, count in cell.objects.items()}
        return found


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known else None


def _fraction(values: list[float | None], pixels: int) -> Interval:
    """Interval of a fraction of the pixels of all seeds; the seeds have the same number of pixels."""
    mean = _mean(values)
    return of_fraction(0.0 if mean is None else mean * pixels, pixels)
