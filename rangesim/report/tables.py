# SPDX-License-Identifier: Apache-2.0
"""Numbers of the report as text: what was measured, per sensor and material."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from rangesim.causes.cause import DEFINITIONS, TITLES, Cause
from rangesim.evaluation.comparison import OUTLIER_M, Comparison, ErrorStatistics
from rangesim.evaluation.range_noise import SMALL, noise_ratio
from rangesim.experiment import Experiment
from rangesim.report import palette
from rangesim.report.figures import LegendEntry
from rangesim.report.markdown_table import Table
from rangesim.results.run_files import Measurement, PhotonsRecord

Rows = list[dict[str, Any]]

FAILURE_HEADS = ["failed (%)", "because (% of the pixels)"]
UNRELIABLE = 0.5
"""Fraction of outliers or of missing pixels from which a sensor is called unreliable on a material."""


@dataclass(frozen=True)
class Column:
    """A column of the comparison. better : "low", "near zero" or "" if no value is better than another."""

    key: str
    title: str
    unit: str
    meaning: str
    better: str = "low"


COLUMNS = (
    Column(
        "completeness",
        "complete",
        "%",
        "fraction of the pixels that the emitter lights which have a measurement, ± what a render with "
        "very many light paths may change",
        "",  # a wrong reading completes nothing
    ),
    Column("bias_m", "bias", "mm", "mean of measured minus true z; positive is too far", "near zero"),
    Column("median_abs_m", "median error", "mm", "median of |z − true z|"),
    Column("rmse_m", "RMSE", "mm", "root mean square of z − true z"),
    Column("p95_abs_m", "95\N{NO-BREAK SPACE}% within", "mm", "95th percentile of |z − true z|"),
    Column("outlier_rate", "outliers", "%", f"fraction of the measurements off by more than {1e3 * OUTLIER_M:g} mm"),
    Column("flying_rate", "flying", "%", "fraction of the measurements at depth edges that lie on neither side"),
)


@dataclass(frozen=True)
class Definition:
    """A cause and what it means, in a sentence."""

    name: str
    meaning: str


@dataclass(frozen=True)
class Cell:
    """text; best : of the real sensors that are reliable on this material; bar : 0..1 for fractions, else None; error :
    the uncertainty, empty if none shows, None in columns without."""

    text: str
    best: bool = False
    bar: float | None = None
    error: str | None = None


def titles(measurements: Sequence[Measurement]) -> dict[str, str]:
    """Title of each instrument by name; with the name added where two would share a title."""
    plain = {m.name: m.capture.sensor.title for m in measurements}
    return {n: t if list(plain.values()).count(t) == 1 else f"{t}, {n}" for n, t in plain.items()}


def is_reference(measurement: Measurement) -> bool:
    """Whether the instrument is an ideal that nobody can buy."""
    return measurement.capture.sensor.is_ideal


def missing_fraction(row: dict[str, Any]) -> float:
    """Fraction of the lit pixels without a measurement; 0 where none is lit."""
    return 1.0 - row["completeness"] if row["completeness"] is not None else 0.0


def is_unreliable(row: dict[str, Any]) -> bool:
    """Whether half of the lit pixels or more have no measurement, or half of the measurements or more are outliers."""
    return max(missing_fraction(row), row["outlier_rate"] or 0.0) >= UNRELIABLE


def comparison_table(measurements: Sequence[Measurement]) -> list[tuple[str, list[tuple[str, list[Cell]]]]]:
    """Per material class, "all" first: name and cells of each instrument."""
    table = []
    for material in materials(measurements):
        rows = {m.name: row for m in measurements for row in m.rows if row["material"] == material}
        real = [rows[m.name] for m in measurements if m.name in rows and not is_reference(m)]
        rivals = [row for row in real if not is_unreliable(row)]  # the few pixels left of the others prove nothing
        best = {c.key: _best(c, rivals) for c in COLUMNS}
        lines = [(n, [_cell(c, row, best[c.key], row in rivals) for c in COLUMNS]) for n, row in rows.items()]
        table.append((material, lines))
    return table


def failure_table(measurements: Sequence[Measurement]) -> list[tuple[str, list[tuple[str, str, list[LegendEntry]]]]]:
    """Per material class, "all" first: name, failed pixels in percent, and their causes, of each instrument."""
    table = []
    for material in materials(measurements):
        rows = [(m.name, row) for m in measurements for row in m.rows if row["material"] == material]
        lines = [(name, _percent(row["failed"]), parts(row)) for name, row in rows if row["failed"] is not None]
        table.append((material, lines))
    return table


def noise_table(measurements: Sequence[Measurement]) -> list[tuple[str, list[tuple[str, list[str], bool]]]]:
    """Per material class, "all" first: name, noise of the detector, that of sampling and their ratio, and whether this
    is large, of each instrument; nothing where none is known."""
    table = []
    for material in materials(measurements):
        rows = [(m.name, row) for m in measurements for row in m.rows if row["material"] == material]
        lines = [(name, [*_noise(row), _ratio(row)], noise_ratio(row) > SMALL) for name, row in rows]
        table.append((material, lines))
    known = any(row["sampling_sigma_m"] is not None for m in measurements for row in m.rows)
    return table if known else []


def definitions(measurements: Sequence[Measurement]) -> list[Definition]:
    """What the causes that occur mean, in the order of their families."""
    found = {name for m in measurements for row in m.rows for name in row["causes"]}
    return [Definition(TITLES[c], DEFINITIONS[c]) for c in Cause if c.name.lower() in found]


def parts(row: dict[str, Any]) -> list[LegendEntry]:
    """Causes of the failed pixels of a row, largest first."""
    causes = [(Cause[name.upper()], fraction) for name, fraction in row["causes"].items()]
    return [
        LegendEntry(TITLES[c], palette.hexadecimal(palette.OUTCOME_COLORS[c]), 100 * fraction) for c, fraction in causes
    ]


def materials(measurements: Sequence[Measurement]) -> list[str]:
    """Material classes of all rows, "all" first."""
    names = dict.fromkeys(row["material"] for m in measurements for row in m.rows)
    return sorted(names, key=lambda n: n != "all")


def comparison_tables(tables: Sequence[tuple[str, Rows]]) -> list[Table]:
    """Tables of errors, of failures and of noise, one row per material and instrument.

    Parameters
    ----------
    tables : name of each instrument, and its rows: statistics per material class.
    """
    return [
        _table(tables, [f"{c.title} ({c.unit})" for c in COLUMNS], lambda row: [_text(c, row) for c in COLUMNS]),
        _table(tables, FAILURE_HEADS, _failures),
        _table(tables, ["detector noise (mm)", "sampling noise (mm)"], _noise),
    ]


def comparison_markdown(tables: Sequence[tuple[str, Rows]]) -> str:
    """The tables of `comparison_tables` in Markdown."""
    return "\n".join(table.markdown() for table in comparison_tables(tables))


def errors_markdown(comparison: Comparison) -> str:
    """Table in Markdown of the errors of one range image, one row per material class; lengths in mm, fractions in %.

    Parameters
    ----------
    comparison : Comparison, as `rangesim.compare` returns.
    """
    heads = [f.name.replace("_m", "_mm") if f.name.endswith("_m") else f.name for f in fields(ErrorStatistics)]
    rows = [[_plain(name, value) for name, value in asdict(row).items()] for row in comparison.table]
    return Table([head.replace("_", " ") for head in heads], rows).markdown()


def _plain(name: str, value: Any) -> str:
    """A value of `ErrorStatistics` as text."""
    if isinstance(value, float) and math.isnan(value):
        return "-"
    if name.endswith("_m"):
        return f"{1000 * value:.2f}"
    if isinstance(value, float):
        return f"{100 * value:.1f} %"
    return str(value)


def failures_markdown(rows: Rows) -> str:
    """Table in Markdown of the failed pixels and their causes, one row per material class; fractions in %.

    Parameters
    ----------
    rows : as `rangesim.causes.CauseMap.fractions` returns.
    """
    return Table(["material", *FAILURE_HEADS], [[row["material"], *_failures(row)] for row in rows]).markdown()


def _table(tables: Sequence[tuple[str, Rows]], heads: list[str], texts: Callable[[dict[str, Any]], list[str]]) -> Table:
    """One row per material class and instrument, with the cells that `texts` makes of the statistics."""
    lines = []
    for material in dict.fromkeys(row["material"] for _, rows in tables for row in rows):
        for name, rows in tables:
            lines += [[material, name, *texts(row)] for row in rows if row["material"] == material]
    return Table(["material", "sensor", *heads], lines)


def _failures(row: dict[str, Any]) -> list[str]:
    """Failed pixels in percent, and their causes."""
    return [_percent(row["failed"]), ", ".join(f"{p.name} {p.text}" for p in parts(row)) or "–"]


def _noise(row: dict[str, Any]) -> list[str]:
    """Standard deviations by the detector's noise and by sampling, millimetres."""
    sigmas = (row["detector_sigma_m"], row["sampling_sigma_m"])
    return ["–" if sigma is None else millimetres(sigma) for sigma in sigmas]


def _ratio(row: dict[str, Any]) -> str:
    ratio = noise_ratio(row)
    return f"{ratio:.2f}" if ratio else "–"


def _percent(fraction: float | None) -> str:
    return "–" if fraction is None else f"{100 * fraction:.1f}"


def number(column: Column, value: float | None) -> str:
    """A value in the column's unit, without it; a dash where it is not defined."""
    if value is None:
        return "–"
    return f"{100 * value:.1f}" if column.unit == "%" else millimetres(value)


def millimetres(metres: float) -> str:
    """Millimetres with about three significant digits."""
    mm = 1e3 * metres
    digits = 3 if abs(mm) < 0.0995 else 2 if abs(mm) < 9.95 else 1 if abs(mm) < 99.5 else 0
    text = f"{mm:.{digits}f}"
    return text.replace("-", "" if float(text) == 0.0 else "−")


def seconds(value: float | None) -> str:
    """A duration with its unit; a dash if there is none."""
    if value is None:
        return "–"
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("µs", 1e6)):
        if value * factor >= 0.9995:
            return f"{value * factor:.3g} {unit}"
    return f"{value * 1e6:.2g} µs"


def photons(per_pulse: PhotonsRecord) -> str:
    """Photons that a laser pulse brings, in words: in the median pixel and in the brightest."""
    median, largest = (_amount(value) for value in (per_pulse.median, per_pulse.largest))
    return f"{median} photons detected per pulse in the median pixel, {largest} in the brightest"


def _amount(value: float) -> str:
    """A number that is not negative, with about two significant digits, down to a thousandth."""
    if value < 0.001:
        return "< 0.001" if value else "0"
    digits = 3 if value < 0.0995 else 2 if value < 0.995 else 1 if value < 9.95 else 0
    return f"{value:,.{digits}f}".replace(",", " ") if value < 1e9 else f"{value:.2g}"


def cost_table(measurements: Sequence[Measurement]) -> list[tuple[str, list[str]]]:
    """Per instrument: frames, exposure, acquisition, decoding, segmentation, points per pixel."""
    table = []
    for m in measurements:
        f, times = m.metadata, m.metadata.times_s
        cells = [str(f.frames), seconds(f.exposure_s), seconds(f.acquisition_s)]
        cells += [seconds(times.get(stage)) for stage in ("exposure", "decode", "points", "segmentation")]
        table.append((m.name, [*cells, f"{f.points:,}".replace(",", " "), f"{f.points / f.pixels:.2f}"]))
    return table


def size_text(shape: tuple[int, ...]) -> str:
    """Width and height of an image of a shape (h, w)."""
    return f"{shape[1]} × {shape[0]}"


def settings_line(experiment: Experiment, shapes: Sequence[tuple[int, ...]]) -> str:
    """The settings of the light transport in one line.

    Parameters
    ----------
    shapes : height and width of the images of each instrument, pixels.
    """
    sizes = " and ".join(dict.fromkeys(map(size_text, shapes)))
    paths = f"up to {experiment.max_spp}" if experiment.spp is None else experiment.spp
    return (
        f"{sizes} pixels, {paths} light paths per pixel of up to {experiment.max_depth} segments, "
        f"seed {experiment.seed}"
    )


def _best(column: Column, rows: Sequence[dict[str, Any]]) -> float | None:
    values = [row[column.key] for row in rows if row[column.key] is not None]
    if len(rows) < 2 or not values or not column.better:
        return None
    return float(min(values, key=abs))


def _cell(column: Column, row: dict[str, Any], best: float | None, rival: bool) -> Cell:
    value = row[column.key]
    bar = value if column.unit == "%" else None
    best_here = rival and value is not None and value == best
    return Cell(number(column, value), best=best_here, bar=bar, error=_error(column, row))


def _text(column: Column, row: dict[str, Any]) -> str:
    """A value of a row in the column's unit, with its uncertainty by sampling where that is known and shows."""
    return f"{number(column, row[column.key])} {_error(column, row) or ''}".rstrip()


def _error(column: Column, row: dict[str, Any]) -> str | None:
    """The uncertainty of a value by sampling; empty if it is not known or does not show, None in columns without."""
    key = f"{column.key}_error"
    if key not in row:
        return None
    text = number(column, row[key]) if row[key] else "0.0"
    return "" if text == "0.0" else f"± {text}"
