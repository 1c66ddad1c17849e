# SPDX-License-Identifier: Apache-2.0
"""The page of a sweep: sentences that are computed, curves, bars and pictures."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from rangesim.causes.cause import TITLES, Cause
from rangesim.evaluation.surface_rows import OBJECTS
from rangesim.report import figures, palette, tables
from rangesim.report.line_plots import (
    COLORS,
    Axis,
    Curve,
    PlotPoint,
    axis_of,
    line_plot,
    number_text,
    point_plot,
    stacked_bars,
    style_of_curves,
)
from rangesim.report.template import render_page, text_of_file
from rangesim.signals import ALL

if TYPE_CHECKING:
    from rangesim.sweep.sweep_result import SweepResult

UNITS = {"m": "m", "deg": "°", "lux": "lux", "w": "W", "s": "s", "e": "e-", "hz": "Hz", "px": "px"}
"""Unit of a setting by the last part of its name."""
MAX_PANELS = 6
"""Combinations of further settings that are shown side by side; rows.csv has all."""
MAX_STRIP = 8
"""Pictures in a row: more would be smaller than a thumbnail on a telephone."""
MAX_NUMBERS = 120
"""Rows of the table of numbers; summary.csv has all."""
ENOUGH = 0.9
"""Fraction of pixels with a reading from which the readings are compared with theory: of fewer, the lucky ones are
left, whose errors are smaller."""
HALF = 0.5
"""Fraction of the pixels from which a sensor counts as reading a scene at all, or a scene as beyond its range."""
RELIED = 0.95
"""Fraction of the readings whose error the verdict asks to be within the tolerance: rows have this percentile."""
MIN_FIT = 3
"""Values of a setting from which the growth of the error is a power of it: a line through two fits always."""


def render_sweep_page(result: SweepResult) -> str:
    """HTML page of the result of a sweep."""
    return render_page("sweep.html.j2", _Page(result).context())


class _Page:
    """The values of the page's template."""

    def __init__(self, result: SweepResult) -> None:
        self.result, self.sweep = result, result.sweep
        kinds = {row["kind"] for row in result.summary}
        self.kind = OBJECTS if OBJECTS in kinds else ALL
        self.rows = [row for row in result.summary if row["kind"] == self.kind]
        self.names = self.sweep.sensor_names
        self.color = {name: i % len(COLORS) for i, name in enumerate(self.names)}

    def context(self) -> dict[str, Any]:
        """All values by name."""
        sweep, result = self.sweep, self.result
        bounds, without = self._kinds_of_theory()
        roc = self._roc()
        cost, cost_without = self._cost()
        error = palette.color_table("RdBu_r")
        return {
            "title": sweep.title,
            "line": f"{_scene_name(sweep.scene)} · {len(sweep.points)} points · {len(self.names)} sensors · "
            f"{sweep.seeds} seeds · {len(result.plan.passes)} light-transport passes",
            "plot_css": Markup(text_of_file("plots.css") + style_of_curves()),
            "verdict": list(self._verdict()),
            "failed": [f"Pass {n + 1} failed: {error}" for n, error in (result.failed or {}).items()],
            "sensors": self._legend(self.names),
            "curves": self._curves(),
            "bounds": ", ".join(bounds),
            "without": ", ".join(without),
            "outlier_sigmas": 6,
            "enough": f"{100 * ENOUGH:.0f} %",
            "level": 95,
            "seeds": sweep.seeds,
            "tolerance": _metres(sweep.tolerance_m),
            "verdicts": self._bars(_outcome_stack),
            "outcomes": [{"name": name, "color": color} for name, color in palette.READING_COLORS.items()],
            "shown": self._shown,
            "whose": "the objects, each with the same weight" if self.kind == OBJECTS else "all surfaces",
            "causes": self._bars(_cause_stack) if self._causes else [],
            "cause_names": [{"name": TITLES[c], "color": _cause_color(c)} for c in self._causes],
            **roc,
            "cost": cost,
            "cost_without": ", ".join(cost_without),
            **self._strips(),
            "error_bar": {"uri": figures.color_bar(error), "ticks": palette.error_ticks()},
            **self._numbers(),
            "settings": [(path, str(value)) for path, value in self._settings()],
            "warnings": result.warnings,
        }

    # ---- Axes of the grid ------------------------------------------------------------------------------------------

    @cached_property
    def axis(self) -> str | None:
        """The path along which curves and bars go: the numeric one with most values, else the first with several."""
        several = [path for path, values in self.sweep.vary.items() if len(values) > 1]
        numeric = [path for path in several if all(_is_number(v) for v in self.sweep.vary[path])]
        if numeric:
            return max(numeric, key=lambda path: len(self.sweep.vary[path]))
        return several[0] if several else None

    @property
    def is_numeric(self) -> bool:
        return self.axis is not None and all(_is_number(v) for v in self.sweep.vary[self.axis])

    @cached_property
    def others(self) -> list[dict[str, Any]]:
        """Combinations of the values of the other paths that are shown."""
        found: dict[str, dict[str, Any]] = {}
        for point in self.sweep.points:
            values = {path: v for path, v in point.values.items() if path != self.axis}
            found.setdefault(str(values), values)
        return list(found.values())[:MAX_PANELS]

    @property
    def _shown(self) -> str:
        combinations = math.prod(len(v) for path, v in self.sweep.vary.items() if path != self.axis)
        left = combinations - len(self.others)
        return f" {left} more combinations stand in summary.csv." if left > 0 else ""

    def _of(self, sensor: str, others: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Rows of a sensor at the values `others` of the other paths, along the axis."""
        return [
            row for row in self.rows if row["sensor"] == sensor and all(row[path] == v for path, v in others.items())
        ]

    @cached_property
    def places(self) -> tuple[Axis, dict[Any, float]]:
        """The horizontal axis, and the place of each value on it."""
        assert self.axis is not None
        values = list(dict.fromkeys(map(_hashable, self.sweep.vary[self.axis])))
        numbers = [float(v) for v in values] if self.is_numeric else []
        positive = [v for v in numbers if v > 0]
        if not numbers or (len(positive) < len(numbers) and max(positive, default=0) > 10 * min(positive, default=1)):
            labels = [number_text(v) if _is_number(v) else str(v) for v in values]
            return Axis(label_of(self.axis), "even", -0.3, len(values) - 0.7, labels), {
                v: i for i, v in enumerate(values)
            }
        return replace(axis_of(numbers, label_of(self.axis)), marks=sorted(numbers)), {v: float(v) for v in values}

    # ---- Sentences -------------------------------------------------------------------------------------------------

    def _verdict(self) -> Iterator[str]:
        others = self.others[0] if self.others else {}
        at = f" (at {_values(others)})" if others else ""
        if self.is_numeric:
            grown = [c for name in self.names if (c := self._growth(name, others))]
            if grown:
                yield f"Error over {label_of(self.axis or '').partition(',')[0]}{at}: {'; '.join(grown)}."
            reached = [c for name in self.names if (c := self._reach(name, others))]
            if reached:
                within = _metres(self.sweep.tolerance_m)
                yield f"Where {100 * RELIED:.0f} % of the readings are within {within}{at}: {'; '.join(reached)}."
        yield from self._ranking()
        yield from self._invented()
        yield from self._objects()
        yield from self._theory()
        yield from self._exposure()
        yield from self._place()
        noisy = [r for r in self.rows if r["sampling_sigma_m"] and r["sampling_sigma_m"] > 0.5 * r["error_m"].mean]
        if noisy:
            names = ", ".join(dict.fromkeys(r["sensor"] for r in noisy))
            yield (
                f"In {len(noisy)} of {len(self.rows)} points the renderer's own noise is more than half of the error "
                f"({names}): take more samples (spp) before you trust these."
            )

    def _reach(self, name: str, others: Mapping[str, Any]) -> str | None:
        """Sentence that says how far along the axis a sensor stays within the tolerance."""
        axis = self.axis
        assert axis is not None
        rows = sorted(self._of(name, others), key=lambda row: row[axis])
        tolerance, unit = self.sweep.tolerance_m, _unit(axis)
        good = [_is_within(row, tolerance) for row in rows]
        if not rows:
            return None
        if not any(good):
            return f"{name} nowhere"
        first = good.index(True)
        last = next((i for i in range(first, len(rows)) if not good[i]), len(rows)) - 1
        start = "" if first == 0 else f" from {_number(rows[first][axis])}{unit}"
        if last + 1 == len(rows):
            return f"{name}{start} up to the last value, {_number(rows[last][axis])}{unit}"
        after = rows[last + 1]
        if not _reads(after):
            lost = f"at {_number(after[axis])}{unit} it reads less than half of the pixels"
            return f"{name}{start} up to {_number(rows[last][axis])}{unit} ({lost})"
        end = _number(float(f"{_crossing(rows[last], after, axis, tolerance):.2g}"))
        return f"{name}{start} up to about {end}{unit}"

    def _growth(self, name: str, others: Mapping[str, Any]) -> str | None:
        """Errors of a sensor at the ends of the axis, where it reads, and the power of the axis that fits between."""
        axis = self.axis
        assert axis is not None
        rows = sorted(self._of(name, others), key=lambda row: row[axis])
        read = [r for r in rows if _reads(r) and r["error_m"].mean > 0]
        within = [r for r in read if not _is_beyond_range(r)]
        known = [(float(r[axis]), float(r["error_m"].mean)) for r in within]
        if len(known) < 2:
            return None
        ends = [f"{_millimetres(error)} mm at {_number(at)}{_unit(axis)}" for at, error in (known[0], known[-1])]
        text = f"{name} {', '.join(ends)}"
        if beyond := [f"{_number(float(r[axis]))}{_unit(axis)}" for r in read if r not in within]:
            text += f" (beyond its range at {', '.join(beyond)})"
        if len(known) < MIN_FIT or known[0][0] <= 0:
            return text
        places, errors = np.log(known).T
        power = float(np.polyfit(places, errors, 1)[0])
        return f"{text}, about as the power {power:.1f}"

    def _ranking(self) -> Iterator[str]:
        """Who is right most often, over all points and at the values of a setting that is no number."""
        means = {name: _mean_right(self._rows_of(name)) for name in self.names}
        known = {name: v for name, v in means.items() if v is not None}
        if len(known) > 1:
            order = sorted(known, key=lambda name: -known[name])
            text = ", ".join(f"{name} {100 * known[name]:.0f} %" for name in order)
            whose = ", of the objects" if self.kind == OBJECTS else ""
            yield f"Right within {_metres(self.sweep.tolerance_m)}{whose}, mean over all points: {text}."
        for path, values in self.sweep.vary.items():
            if len(self.names) < 2 or len(values) < 2 or all(_is_number(v) for v in values):
                continue
            best = []
            for value in values:
                at = {n: _mean_right([r for r in self._rows_of(n) if r[path] == value]) for n in self.names}
                of = {n: v for n, v in at.items() if v is not None}
                if of:
                    name = max(of, key=lambda n: of[n])
                    right = f"{name} ({100 * of[name]:.0f} %)"
                    best.append(f"{value}: {right if of[name] > tables.MOST else f'nobody on most, at best {right}'}")
            yield f"Most often right by {label_of(path)}: {'; '.join(best)}."

    def _invented(self) -> Iterator[str]:
        """Sentence about readings where there is no surface."""
        clauses = []
        for name in self.names:
            rows = [r for r in self.result.summary if (r["sensor"], r["kind"]) == (name, ALL)]
            most = max(rows, key=lambda r: r["invented_readings"], default=None)
            if most is not None and most["invented_readings"]:
                at = _values(self.sweep.points[most["point"]].values)
                clauses.append(f"{name} {_number(most['invented_readings'])}{f' (at {at})' if at else ''}")
        if clauses:
            yield f"Most invented readings in a capture, of pixels that see no surface: {'; '.join(clauses)}."

    def _objects(self) -> Iterator[str]:
        """Sentences about what the failures of each sensor do to the objects."""
        clauses = []
        for name in self.names:
            counted = [c.objects for (_, sensor), c in self.result.cells.items() if sensor == name and c.objects]
            total = {key: sum(one[key] for one in counted) for key in (counted[0] if counted else {})}
            if total:
                lost = ", ".join(f"{total[k]} {k}" for k in ("merged", "split", "missed", "invented") if total[k])
                of = sum(total[k] for k in ("found", "merged", "split", "missed"))
                clauses.append(f"{name} {total['found']} of {of}{f' ({lost})' if lost else ''}")
        if clauses:
            yield f"Objects that the segmentation of the first capture finds, over all points: {'; '.join(clauses)}."

    def _theory(self) -> Iterator[str]:
        """In how many points theory lies in the confidence interval."""
        if self.kind == OBJECTS:  # light that comes by other ways decides there
            return
        bounds, _ = self._kinds_of_theory()
        clauses = []
        for name in self.names:
            rows = [r for r in self._rows_of(name) if _is_comparable(r)]
            if name in bounds or not rows:
                continue
            inside = sum(r["error_m"].low <= r["theory_m"] <= r["error_m"].high for r in rows)
            ratio = statistics.median(r["error_m"].mean / r["theory_m"] for r in rows)
            clauses.append(f"{name} {inside} of {len(rows)} (median ratio {ratio:.2f})")
        if clauses:
            yield (
                f"Points at which the closed form lies in the 95 % interval of the error, of those within the sensor's "
                f"range and with readings in {100 * ENOUGH:.0f} % of the pixels: {', '.join(clauses)}."
            )

    def _exposure(self) -> Iterator[str]:
        """Sentence that says which exposures are fixed, and which are automatic."""
        fixed = self.result.exposures
        if fixed:
            each = []
            for name, one in fixed.items():
                at = _values(self.sweep.points[one.point].values)
                each.append(f"{name} {tables.seconds(one.exposure_s)}{f' (at {at})' if at else ''}")
            saturates = [name for name, one in fixed.items() if one.shortest]
            still = (
                f" Even so, {', '.join(saturates)} may saturate: that is the detector's shortest." if saturates else ""
            )
            yield (
                f"Exposures are fixed at the shortest that automatic exposure would choose at any point, so that none "
                f"saturates: {'; '.join(each)}.{still}"
            )
        own = [
            n for n, i in self.sweep.given.items() if i.exposure_s is not None and "exposure_s" not in self.sweep.vary
        ]
        if own:
            yield f"Exposures that do not change, because the settings state them: {', '.join(self._stated(own))}."
        automatic = {}
        for name in self.names:
            found = [r["exposure_s"] for r in self._rows_of(name) if r["exposure_s"] is not None]
            if name not in fixed and found and self.sweep.given[name].exposure_s is None and min(found) < max(found):
                automatic[name] = (min(found), max(found))
        if self.sweep.exposure == "auto" and automatic:
            each = [f"{n} {tables.seconds(a)} to {tables.seconds(b)}" for n, (a, b) in automatic.items()]
            yield (
                f"Exposure is automatic, so it changes from point to point and hides a part of the noise's change: "
                f"{', '.join(each)}."
            )

    def _stated(self, names: Sequence[str]) -> Iterator[str]:
        """Names of sensors with the exposure that they state."""
        for name in names:
            yield f"{name} {tables.seconds(self.sweep.given[name].exposure_s)}"

    def _place(self) -> Iterator[str]:
        """Sentence about the distance for which sensors without a place of their own are set up."""
        free = [n for n, i in self.sweep.given.items() if i.T_camera_projector is None and i.sensor.triangulates]
        if free:
            yield (
                f"Camera and projector of {', '.join(free)} are set up once, for "
                f"{self.result.plan.working_distance_m:.3g} m, the median of the scenes."
            )

    def _rows_of(self, name: str) -> list[dict[str, Any]]:
        return [row for row in self.rows if row["sensor"] == name]

    def _kinds_of_theory(self) -> tuple[list[str], list[str]]:
        """Names of the sensors whose closed form is a lower bound, and of those without any."""
        bounds, without = [], []
        for name, instrument in self.sweep.given.items():
            decoder = instrument.decoder or instrument.sensor.default_decoder
            has_any = any(row["theory_m"] is not None for row in self._rows_of(name))
            if has_any and decoder.is_lower_bound:
                bounds.append(name)
            elif not has_any:
                without.append(name)
        return bounds, without

    # ---- Figures ---------------------------------------------------------------------------------------------------

    def _legend(self, names: Sequence[str]) -> list[dict[str, str]]:
        return [{"name": name, "color": COLORS[self.color[name]]} for name in names]

    def _curves(self) -> list[dict[str, Any]]:
        """Error along the axis, a plot for each combination of the other values."""
        axis = self.axis
        if axis is None or not self.is_numeric:
            return []
        x, place = self.places
        shown = [r for r in self.rows if math.isfinite(r["error_m"].mean) and r["error_m"].mean > 0]
        if not shown:
            return []
        values = [1e3 * r["error_m"].mean for r in shown]
        values += [1e3 * r["theory_m"] for r in shown if _has_theory(r)]
        y = axis_of([v for v in values if v > 0], "error, mm", is_logarithmic=True)
        plots = []
        for others in self.others:
            curves = []
            for name in self.names:
                rows = sorted(self._of(name, others), key=lambda row: place[row[axis]])
                points = [PlotPoint(place[r[axis]], *(1e3 * v for v in r["error_m"])) for r in rows]
                theory = [PlotPoint(place[r[axis]], 1e3 * r["theory_m"]) for r in rows if _has_theory(r)]
                curves.append(Curve(name, self.color[name], points, theory))
            svg = line_plot(curves, x, y, f"Error of {', '.join(self.names)}", 1e3 * self.sweep.tolerance_m)
            plots.append({"name": _values(others), "svg": svg})
        return plots

    def _bars(self, stack: Any) -> list[dict[str, Any]]:
        """Stacked bars along the axis, a plot for each sensor and combination of the other values."""
        plots = []
        for others in self.others or [{}]:
            for name in self.names:
                rows = self._of(name, others)
                labels = [_label(r[self.axis]) if self.axis else "all" for r in rows]
                at = _values(others)
                svg = stacked_bars(
                    labels, [stack(r) for r in rows], label_of(self.axis) if self.axis else "", f"Outcomes of {name}"
                )
                plots.append({"name": f"{name}{f', {at}' if at else ''}", "svg": svg})
        return plots

    @cached_property
    def _causes(self) -> list[Cause]:
        found = {Cause[c.upper()] for row in self.rows for c, fraction in row["causes"].items() if fraction > 0}
        return sorted(found)

    def _roc(self) -> dict[str, Any]:
        """The ROC of each sensor's confidence, over all points."""
        curves, names, without = [], [], []
        for name in self.names:
            cells = [c.confidence for (_, sensor), c in self.result.cells.items() if sensor == name]
            right, wrong = np.sum(cells, axis=0) if cells else np.zeros((2, 1))
            if not right.sum() or not wrong.sum():
                without.append(name)
                continue
            kept_right, kept_wrong = (np.concatenate([[0], np.cumsum(n[::-1]) / n.sum()]) for n in (right, wrong))
            area = float(np.trapezoid(kept_right, kept_wrong))
            curves.append(
                Curve(
                    name,
                    self.color[name],
                    [PlotPoint(100 * float(a), 100 * float(b)) for a, b in zip(kept_wrong, kept_right, strict=True)],
                )
            )
            names.append({"name": f"{name} ({area:.2f})", "color": COLORS[self.color[name]]})
        if not curves:
            return {"roc": None, "roc_names": [], "roc_without": ""}
        x, y = Axis("wrong readings kept, %", "linear", 0, 100), Axis("right readings kept, %", "linear", 0, 100)
        svg = line_plot(curves, x, y, "ROC of the confidence")
        return {"roc": {"name": "", "svg": svg}, "roc_names": names, "roc_without": ", ".join(without)}

    def _cost(self) -> tuple[dict[str, Any] | None, list[str]]:
        """Acquisition time against error, a point for each sensor; and the names of sensors without either."""
        points, without = [], []
        for name in self.names:
            rows = [r for r in self._rows_of(name) if _reads(r) and r["acquisition_s"]]
            errors = [1e3 * r["median_abs_m"].mean for r in rows if r["median_abs_m"].mean > 0]
            if not errors:
                without.append(name)
                continue
            time_s = statistics.median(r["acquisition_s"] for r in rows)
            points.append((name, self.color[name], 1e3 * time_s, statistics.median(errors)))
        if not points:
            return None, without
        x = axis_of([p[2] for p in points], "acquisition, ms", is_logarithmic=True)
        y = axis_of([p[3] for p in points], "median error, mm", is_logarithmic=True)
        return {"name": "", "svg": point_plot(points, x, y, "Acquisition time against error")}, without

    def _strips(self) -> dict[str, Any]:
        """Rows of small pictures along the axis, at the first values of the other paths."""
        others = self.others[0] if self.others else {}
        points = [p for p in self.sweep.points if all(p.values[path] == v for path, v in others.items())]
        chosen = [points[i] for i in sorted({round(k) for k in np.linspace(0, len(points) - 1, MAX_STRIP)})]
        rows = []
        for name in self.names:
            for kind in ("error", "causes"):
                cells = [self.result.cells.get((p.number, name)) for p in chosen]
                rows.append(
                    {
                        "name": name if kind == "error" else "",
                        "pictures": [
                            {
                                "uri": f"data:image/png;base64,{c.pictures[kind]}" if c else "",
                                "alt": f"{kind} of {name} at {_values(p.values)}",
                            }
                            for p, c in zip(chosen, cells, strict=True)
                        ],
                    }
                )
        labels = [_label(p.values[self.axis]) if self.axis else "" for p in chosen]
        at = f", at {_values(others)}" if others else ""
        path = label_of(self.axis) if self.axis else "sensor"
        return {"strips": rows, "strip_labels": labels, "strip_path": path, "strip_at": at}

    def _numbers(self) -> dict[str, Any]:
        """The table of means."""
        paths = list(self.sweep.vary)
        labels = [*(label_of(p) for p in paths), "sensor", "right, %", "wrong, %", "missing, %", "error, mm"]
        labels += ["theory, mm", "bias, mm", "95 % within, mm", "exposure"]
        columns = [label.partition(", ")[::2] for label in labels]
        rows = []
        for r in self.rows[:MAX_NUMBERS]:
            cells = [*(_label(r[p]) for p in paths), r["sensor"]]
            cells += [f"{100 * r[key].mean:.1f}" for key in ("right", "wrong", "missing")]
            cells += [_millimetres(r["error_m"].mean), _millimetres(r["theory_m"]), _millimetres(r["bias_m"].mean)]
            cells += [_millimetres(r["p95_abs_m"].mean)]
            cells += [tables.seconds(r["exposure_s"]) if r["exposure_s"] is not None else "–"]
            rows.append(cells)
        more = len(self.rows) - len(rows)
        left_out = f" ({more} more rows in summary.csv)" if more else ""
        return {"columns": columns, "numbers": rows, "lefts": len(paths) + 1, "numbers_left_out": left_out}

    def _settings(self) -> Iterator[tuple[str, Any]]:
        sweep = self.sweep
        yield "scene", sweep.scene
        yield "sensors", ", ".join(self.names)
        for path, values in sweep.vary.items():
            yield path, ", ".join(map(_label, values))
        yield from sweep.settings.items()
        yield from (("seeds", sweep.seeds), ("seed", sweep.seed), ("exposure", sweep.exposure))
        yield from (("tolerance_m", sweep.tolerance_m), ("window_px", sweep.window_px or "the whole image"))


def label_of(path: str) -> str:
    """Label of a setting: the last part of its path, with its unit.

    Examples
    --------
    >>> label_of("scene.distance_m"), label_of("ambient.illuminance_lux"), label_of("scene.material")
    ('distance, m', 'illuminance, lux', 'material')
    """
    name = path.rpartition(".")[2]
    stem, _, last = name.rpartition("_")
    return f"{stem.replace('_', ' ')}, {UNITS[last]}" if stem and last in UNITS else name.replace("_", " ")


def _unit(path: str) -> str:
    last = path.rpartition("_")[2]
    return f" {UNITS[last]}" if "_" in path.rpartition(".")[2] and last in UNITS else ""


def _values(values: Mapping[str, Any]) -> str:
    """Text of some settings, such as "distance 0.5 m, material chromium"."""
    return ", ".join(f"{label_of(p).partition(',')[0]} {_label(v)}{_unit(p)}" for p, v in values.items())


def _label(value: Any) -> str:
    return number_text(value) if _is_number(value) else str(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _hashable(value: Any) -> Any:
    return value if isinstance(value, (int, float, str, bool)) else str(value)


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{float(f'{value:.2g}'):,.0f}".replace(",", "\u202f")


def _scene_name(scene: Any) -> str:
    name = scene if isinstance(scene, str) else scene["name"]
    return f"scene {name.rpartition('/')[2]}"


def _metres(value: float) -> str:
    return f"{1e3 * value:g} mm" if value < 1 else f"{value:g} m"


def _millimetres(value: float | None) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{1e3 * value:.3g}"


def _is_within(row: Mapping[str, Any], tolerance_m: float) -> bool:
    """Whether a sensor reads at least half of the pixels, and 95 % of its readings are right."""
    return bool(row["p95_abs_m"].mean <= tolerance_m and _reads(row))


def _reads(row: Mapping[str, Any]) -> bool:
    """Whether a sensor reads at least half of the pixels."""
    return bool(row["right"].mean + row["wrong"].mean >= HALF)


def _is_beyond_range(row: Mapping[str, Any]) -> bool:
    """Whether at least half of the pixels fail because the surface lies outside of the sensor's range."""
    causes = (Cause.RANGE_AMBIGUITY, Cause.OUT_OF_RANGE)
    return bool(sum(row["causes"].get(cause.name.lower(), 0.0) for cause in causes) >= HALF)


def _has_theory(row: Mapping[str, Any]) -> bool:
    """Whether a row has a closed form, and readings in nearly all pixels, for which the closed form holds."""
    return row["theory_m"] is not None and row["right"].mean + row["wrong"].mean >= ENOUGH


def _is_comparable(row: Mapping[str, Any]) -> bool:
    """Whether a row has an error to compare with theory, with a confidence interval."""
    return _has_theory(row) and math.isfinite(row["error_m"].low)


def _crossing(before: Mapping[str, Any], after: Mapping[str, Any], path: str, tolerance_m: float) -> float:
    """Value of a setting at which the 95th percentile passes the tolerance, between two rows, on a straight line."""
    low, high = before["p95_abs_m"].mean, after["p95_abs_m"].mean
    return float(before[path] + (after[path] - before[path]) * (tolerance_m - low) / (high - low))


def _mean_right(rows: Sequence[Mapping[str, Any]]) -> float | None:
    return statistics.fmean(r["right"].mean for r in rows) if rows else None


def _outcome_stack(row: Mapping[str, Any]) -> list[tuple[str, float]]:
    return [(color, row[kind].mean) for kind, color in palette.READING_COLORS.items()]


def _cause_stack(row: Mapping[str, Any]) -> list[tuple[str, float]]:
    return [(_cause_color(Cause[c.upper()]), row["causes"][c]) for c in row["causes"]]


def _cause_color(cause: Cause) -> str:
    return palette.hexadecimal(palette.OUTCOME_COLORS[cause])
