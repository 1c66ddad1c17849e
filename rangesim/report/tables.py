# SPDX-License-Identifier: Apache-2.0
"""Tables of the report: statistics of each sensor on each material, as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from rangesim.causes.cause import DEFINITIONS, TITLES, Cause
from rangesim.evaluation.comparison import Comparison, ErrorStatistics
from rangesim.evaluation.range_noise import SMALL, noise_ratio
from rangesim.experiment import Experiment
from rangesim.presets import catalogue
from rangesim.report import palette
from rangesim.report.figures import LegendEntry
from rangesim.report.markdown_table import Table
from rangesim.results.experiment_results import Measurement, PhotonsRecord

Rows = list[dict[str, Any]]
"""Statistics per material class, one dict each, with the keys of `rangesim.results.experiment_results.RowRecord`."""

CAUSE_HEADS = ["right (%)", "others failed because (% of the pixels)"]
"""Heads of the columns that say how many pixels are right, and why the others are not."""
MOST = 0.5
"""Fraction of the pixels of a surface that must be right for a sensor to be reliable on it.

At one half, a pixel is as likely right as not.
"""


@dataclass(frozen=True)
class Column:
    """A column of the table of errors.

    key : name of the value in a row. title, unit, meaning : text of the page. better : which value is best, "high",
    "low" or "near zero"; "" if no value is better than another.
    """

    key: str
    title: str
    unit: str
    meaning: str
    better: str = "low"


COLUMNS = (
    Column("right", "right", "%", "fraction of all pixels with a reading within the tolerance", "high"),
    Column("wrong", "wrong", "%", "fraction with a reading off by more"),
    Column(
        "missing",
        "missing",
        "%",
        "fraction without a reading, in shadow or not",
        "",  # fewer missing readings are not better if those that are there are wrong
    ),
    Column(
        "completeness",
        "complete",
        "%",
        "of the pixels that the emitter lights, the fraction with a measurement; ± is what a render with "
        "very many light paths may change",
        "",  # more readings are not better if they are wrong
    ),
    Column("bias_m", "bias", "mm", "mean of measured minus true z; positive is too far", "near zero"),
    Column("median_abs_m", "median error", "mm", "median of |z − true z|"),
    Column("rmse_m", "RMSE", "mm", "root mean square of z − true z"),
    Column("p95_abs_m", "95\N{NO-BREAK SPACE}% within", "mm", "95th percentile of |z − true z|"),
    Column("flying_rate", "flying", "%", "fraction of the measurements at depth edges that lie on neither side"),
)
"""Columns of the table of errors, from left to right."""


@dataclass(frozen=True)
class Definition:
    """Name of a cause, and its meaning in a sentence."""

    name: str
    meaning: str


@dataclass(frozen=True)
class Cell:
    """A cell of the table of errors.

    text : the value. best : whether it is the best one of the real sensors that are reliable on this material.
    bar : the value as a fraction, 0..1, to be drawn as a bar; None for lengths.
    error : uncertainty of the value by sampling; empty if it rounds to 0, None in columns without uncertainty.
    """

    text: str
    best: bool = False
    bar: float | None = None
    error: str | None = None


def titles(measurements: Sequence[Measurement]) -> dict[str, str]:
    """Title of each instrument, by name. The name is added for devices, and if two instruments have the same title."""
    plain = {m.name: m.capture.sensor.title for m in measurements}
    devices, shown = catalogue.names(), list(plain.values())
    return {n: f"{t}, {n}" if n in devices or shown.count(t) > 1 else t for n, t in plain.items()}


def is_reference(measurement: Measurement) -> bool:
    """Whether the instrument is ideal, so that it is a reference and no competitor."""
    return measurement.capture.sensor.is_ideal


def is_reliable(row: dict[str, Any]) -> bool:
    """Whether most pixels of a row are right."""
    return (row["right"] or 0.0) > MOST


def comparison_table(measurements: Sequence[Measurement]) -> list[tuple[str, list[tuple[str, list[Cell]]]]]:
    """Errors of each instrument per material class, "all" first.

    Each entry is the material and a list with the name and the cells, one per column, of each instrument.
    """
    table = []
    for material in materials(measurements):
        rows = {m.name: row for m in measurements for row in m.rows if row["material"] == material}
        real = [rows[m.name] for m in measurements if m.name in rows and not is_reference(m)]
        rivals = [row for row in real if is_reliable(row)]  # the few readings of the others prove nothing
        best = {c.key: _best(c, rivals) for c in COLUMNS}
        lines = [(n, [_cell(c, row, best[c.key], row in rivals) for c in COLUMNS]) for n, row in rows.items()]
        table.append((material, lines))
    return table


def failure_table(measurements: Sequence[Measurement]) -> list[tuple[str, list[tuple[str, str, list[LegendEntry]]]]]:
    """Right pixels of each instrument and causes of the others per material class, "all" first.

    Each entry is the material and a list with, for each instrument, its name, the right pixels in percent, and the
    legend of the causes of the others.
    """
    table = []
    for material in materials(measurements):
        rows = [(m.name, row) for m in measurements for row in m.rows if row["material"] == material]
        lines = [(name, _percent(row["right"]), parts(row)) for name, row in rows if row["right"] is not None]
        table.append((material, lines))
    return table


def noise_table(measurements: Sequence[Measurement]) -> list[tuple[str, list[tuple[str, list[str], bool]]]]:
    """Noise of each instrument per material class, "all" first; empty if no instrument knows its noise.

    Each entry is the material and a list with, for each instrument, its name, the texts of detector noise, sampling
    noise and their ratio, and whether this ratio is large.
    """
    table = []
    for material in materials(measurements):
        rows = [(m.name, row) for m in measurements for row in m.rows if row["material"] == material]
        lines = [(name, [*_noise(row), _ratio(row)], noise_ratio(row) > SMALL) for name, row in rows]
        table.append((material, lines))
    known = any(row["sampling_sigma_m"] is not None for m in measurements for row in m.rows)
    return table if known else []


def definitions(measurements: Sequence[Measurement]) -> list[Definition]:
    """Definitions of the causes that occur in the measurements, in the order of `Cause`."""
    found = {name for m in measurements for row in m.rows for name in row["causes"]}
    return [Definition(TITLES[c], DEFINITIONS[c]) for c in Cause if c.name.lower() in found]


def parts(row: dict[str, Any]) -> list[LegendEntry]:
    """Legend of the causes of the failed pixels of a row; the largest is first."""
    causes = [(Cause[name.upper()], fraction) for name, fraction in row["causes"].items()]
    return [
        LegendEntry(TITLES[c], palette.hexadecimal(palette.OUTCOME_COLORS[c]), 100 * fraction) for c, fraction in causes
    ]


def materials(measurements: Sequence[Measurement]) -> list[str]:
    """Material classes of all rows, "all" first."""
    names = dict.fromkeys(row["material"] for m in measurements for row in m.rows)
    return sorted(names, key=lambda n: n != "all")


def comparison_tables(tables: Sequence[tuple[str, Rows]]) -> list[Table]:
    """Tables of errors, of causes and of noise, with one row per material and instrument.

    Parameters
    ----------
    tables : name of each instrument with its statistics per material class.
    """
    return [
        _table(tables, [f"{c.title} ({c.unit})" for c in COLUMNS], lambda row: [_text(c, row) for c in COLUMNS]),
        _table(tables, CAUSE_HEADS, _causes),
        _table(tables, ["detector noise (mm)", "sampling noise (mm)"], _noise),
    ]


def comparison_markdown(tables: Sequence[tuple[str, Rows]]) -> str:
    """The tables of `comparison_tables` in Markdown."""
    return "\n".join(table.markdown() for table in comparison_tables(tables))


def errors_markdown(comparison: Comparison) -> str:
    """Markdown table of the errors of one range image, with one row per material class.

    Lengths are in mm, fractions in %.

    Parameters
    ----------
    comparison : Comparison, as `rangesim.compare` returns it.

    Examples
    --------
    `comparison` is `rangesim.compare(image, signals)`, here of a wall at 1 m:

    >>> from rangesim import errors_markdown
    >>> print(errors_markdown(comparison).splitlines()[0])
    | material | pixels | lit | right | wrong | missing | completeness | ... | flying rate |
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
    """Markdown table of the right pixels and the causes of the others, with one row per material class; in %.

    Parameters
    ----------
    rows : as `rangesim.causes.CauseMap.fractions` returns them.

    Examples
    --------
    >>> from rangesim import failures_markdown
    >>> rows = [{"material": "glossy", "right": 0.75, "causes": {"multipath": 0.2, "low_signal": 0.05}}]
    >>> print(failures_markdown(rows), end="")
    | material | right (%) | others failed because (% of the pixels) |
    | --- | --- | --- |
    | glossy | 75.0 | multipath 20.0, low signal 5.0 |
    """
    return Table(["material", *CAUSE_HEADS], [[row["material"], *_causes(row)] for row in rows]).markdown()


def _table(tables: Sequence[tuple[str, Rows]], heads: list[str], texts: Callable[[dict[str, Any]], list[str]]) -> Table:
    """Table with one row per material class and instrument; `texts` makes the cells from the statistics."""
    lines = []
    for material in dict.fromkeys(row["material"] for _, rows in tables for row in rows):
        for name, rows in tables:
            lines += [[material, name, *texts(row)] for row in rows if row["material"] == material]
    return Table(["material", "sensor", *heads], lines)


def _causes(row: dict[str, Any]) -> list[str]:
    """Cells of the right pixels, in percent, and of the causes of the others."""
    return [_percent(row["right"]), ", ".join(f"{p.name} {p.text}" for p in parts(row)) or "–"]


def _noise(row: dict[str, Any]) -> list[str]:
    """Cells of the standard deviations by the detector's noise and by sampling, in millimetres."""
    sigmas = (row["detector_sigma_m"], row["sampling_sigma_m"])
    return ["–" if sigma is None else millimetres(sigma) for sigma in sigmas]


def _ratio(row: dict[str, Any]) -> str:
    """Cell of the ratio of sampling noise to detector noise."""
    ratio = noise_ratio(row)
    return f"{ratio:.2f}" if ratio else "–"


def _percent(fraction: float | None) -> str:
    """Text of a fraction in percent, without the sign; a dash for None."""
    return "–" if fraction is None else f"{100 * fraction:.1f}"


def number(column: Column, value: float | None) -> str:
    """Text of a value in the unit of a column, without the unit; a dash for None."""
    if value is None:
        return "–"
    return f"{100 * value:.1f}" if column.unit == "%" else millimetres(value)


def millimetres(metres: float) -> str:
    """Text of a length in millimetres, with about three significant digits and without the unit."""
    mm = 1e3 * metres
    digits = 3 if abs(mm) < 0.0995 else 2 if abs(mm) < 9.95 else 1 if abs(mm) < 99.5 else 0
    text = f"{mm:.{digits}f}"
    return text.replace("-", "" if float(text) == 0.0 else "−")


def seconds(value: float | None) -> str:
    """Text of a duration with its unit; a dash for None."""
    if value is None:
        return "–"
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("µs", 1e6)):
        if value * factor >= 0.9995:
            return f"{value * factor:.3g} {unit}"
    return f"{value * 1e6:.2g} µs"


def photons(per_pulse: PhotonsRecord) -> str:
    """Sentence part that says how many photons per laser pulse the median and the brightest pixel detect."""
    median, largest = (_amount(value) for value in (per_pulse.median, per_pulse.largest))
    return f"{median} photons detected per pulse in the median pixel, {largest} in the brightest"


def _amount(value: float) -> str:
    """Text of a number that is not negative, with about two significant digits, down to a thousandth."""
    if value < 0.001:
        return "< 0.001" if value else "0"
    digits = 3 if value < 0.0995 else 2 if value < 0.995 else 1 if value < 9.95 else 0
    return f"{value:,.{digits}f}".replace(",", " ") if value < 1e9 else f"{value:.2g}"


def cost_table(measurements: Sequence[Measurement]) -> list[tuple[str, list[str]]]:
    """Costs of each instrument: its name, and texts of frames, exposure, acquisition, computing times and points."""
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
    """Best value of a column among rows; None if there are fewer than two rows, or no value is better than another."""
    values = [row[column.key] for row in rows if row[column.key] is not None]
    if len(rows) < 2 or not values or not column.better:
        return None
    return float(max(values) if column.better == "high" else min(values, key=abs))


def _cell(column: Column, row: dict[str, Any], best: float | None, rival: bool) -> Cell:
    """Cell of a value; `rival` says whether it takes part in the choice of the best."""
    value = row[column.key]
    bar = value if column.unit == "%" else None
    best_here = rival and value is not None and value == best
    return Cell(number(column, value), best=best_here, bar=bar, error=_error(column, row))


def _text(column: Column, row: dict[str, Any]) -> str:
    """Text of a value in the column's unit, with its uncertainty by sampling unless that is unknown or rounds to 0."""
    return f"{number(column, row[column.key])} {_error(column, row) or ''}".rstrip()


def _error(column: Column, row: dict[str, Any]) -> str | None:
    """Text of the uncertainty of a value by sampling, with ±; empty if it is unknown or rounds to 0, None in columns
    without uncertainty."""
    key = f"{column.key}_error"
    if key not in row:
        return None
    text = number(column, row[key]) if row[key] else "0.0"
    return "" if text == "0.0" else f"± {text}"
