# SPDX-License-Identifier: Apache-2.0
"""Tables of the report: statistics of each sensor on each surface, as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from rangesim.causes.cause import DEFINITIONS, TITLES, Cause
from rangesim.evaluation.comparison import Comparison, ErrorStatistics
from rangesim.evaluation.range_noise import SMALL, noise_ratio
from rangesim.evaluation.surface_rows import KINDS, OBJECT, OBJECTS, PART
from rangesim.experiment import Experiment
from rangesim.presets import catalogue
from rangesim.report import palette
from rangesim.report.figures import LegendEntry
from rangesim.report.markdown_table import Table
from rangesim.results.experiment_results import Measurement, MeasurementRecord, PhotonsRecord
from rangesim.signals import ALL

Rows = list[dict[str, Any]]
"""Statistics per surface, one dict each, with the keys of `rangesim.results.experiment_results.RowRecord`."""

BECAUSE = "because (% of the pixels)"
"""Head of the column with the causes of wrong and missing readings."""
SUMMARIES = tuple(kind for kind in KINDS if kind not in (OBJECT, PART))
"""Kinds of rows of the tables of errors and of noise, which would be long with a row for every object."""
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


OUTCOMES = (
    Column("right", "right", "%", "the reading is off by at most the tolerance", "high"),
    Column("wrong", "wrong", "%", "the reading is off by more"),
    # fewer missing readings are not better if those that are there are wrong
    Column("missing", "missing", "%", "there is no reading, in shadow or not", ""),
)
"""Columns of the table of right readings, fractions of all pixels of a surface that add up to 1, from left to right."""
COLUMNS = (
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
class OutcomeLine:
    """A line of the table of right readings.

    name : of the instrument. cells : one for each of `OUTCOMES`. parts : legend of the causes of wrong and missing
    readings; the largest is first.
    """

    name: str
    cells: list[Cell]
    parts: list[LegendEntry]


@dataclass(frozen=True)
class Cell:
    """A cell of the table of errors.

    text : the value. best : whether it is the best one of the real sensors that are reliable on this surface.
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


def outcome_table(measurements: Sequence[Measurement]) -> list[tuple[str, list[OutcomeLine]]]:
    """Right, wrong and missing readings of each instrument per surface, objects first, with the causes."""
    table = []
    for surface, rows in _by_surface(measurements, KINDS):
        lines = zip(_lines(measurements, rows, OUTCOMES), rows, strict=True)
        table.append((surface, [OutcomeLine(name, cells, parts(row)) for (name, cells), (_, row) in lines]))
    return table


def comparison_table(measurements: Sequence[Measurement]) -> list[tuple[str, list[tuple[str, list[Cell]]]]]:
    """Errors of each instrument per surface, except single objects and parts.

    Each entry is the surface and a list with the name and the cells, one per column, of each instrument.
    """
    return [(surface, _lines(measurements, rows, COLUMNS)) for surface, rows in _by_surface(measurements, SUMMARIES)]


def noise_table(measurements: Sequence[Measurement]) -> list[tuple[str, list[tuple[str, list[str], bool]]]]:
    """Noise of each instrument per surface, except single objects; empty if no instrument knows its noise.

    Each entry is the surface and a list with, for each instrument, its name, the texts of detector noise, sampling
    noise and their ratio, and whether this ratio is large.
    """
    table = []
    for surface, rows in _by_surface(measurements, SUMMARIES):
        lines = [(name, [*_noise(row), _ratio(row)], noise_ratio(row) > SMALL) for name, row in rows]
        table.append((surface, lines))
    known = any(row["sampling_sigma_m"] is not None for m in measurements for row in m.rows)
    return table if known else []


def _by_surface(
    measurements: Sequence[Measurement], kinds: Sequence[str]
) -> list[tuple[str, list[tuple[str, dict[str, Any]]]]]:
    """Rows of these kinds, each with the name of its instrument, by the label of their surface."""
    found: dict[tuple[str, str], list[tuple[str, dict[str, Any]]]] = {}
    for m in measurements:
        for row in m.rows:
            if row["kind"] in kinds:
                found.setdefault((row["kind"], row["name"]), []).append((m.name, row))
    return [(surface_label(key), found[key]) for key in sorted(found, key=lambda key: kinds.index(key[0]))]


def surface_label(key: tuple[str, str]) -> str:
    """Text that names the surface of a row by its kind and name, such as "object bottle"; "objects" and "all" alone."""
    kind, name = key
    return kind if kind == name and kind in (OBJECTS, ALL) else f"{kind} {name}"


def _lines(
    measurements: Sequence[Measurement], rows: Sequence[tuple[str, dict[str, Any]]], columns: Sequence[Column]
) -> list[tuple[str, list[Cell]]]:
    """Name of each instrument with its cells, one per column, from the rows of one surface."""
    references = {m.name for m in measurements if is_reference(m)}
    # the few readings of the others prove nothing
    rivals = [row for name, row in rows if name not in references and is_reliable(row)]
    best = {c.key: _best(c, rivals) for c in columns}
    return [(name, [_cell(c, row, best[c.key], row in rivals) for c in columns]) for name, row in rows]


def definitions(measurements: Sequence[Measurement]) -> list[Definition]:
    """Definitions of the causes that occur in the measurements, in the order of `Cause`."""
    found = {name for m in measurements for row in m.rows for name in row["causes"]}
    return [Definition(TITLES[c], DEFINITIONS[c]) for c in Cause if c.name.lower() in found]


def parts(row: dict[str, Any]) -> list[LegendEntry]:
    """Legend of the causes of the wrong and missing readings of a row; the largest is first."""
    causes = [(Cause[name.upper()], fraction) for name, fraction in row["causes"].items()]
    return [
        LegendEntry(TITLES[c], palette.hexadecimal(palette.OUTCOME_COLORS[c]), 100 * fraction) for c, fraction in causes
    ]


def comparison_tables(tables: Sequence[tuple[str, Rows]], taken: Sequence[MeasurementRecord]) -> list[Table]:
    """Tables of right readings and causes, of errors and of noise, with one row per surface and instrument, and of the
    exposures.

    Parameters
    ----------
    tables : name of each instrument with its statistics per surface. If causes are not known, they are None in every
        row, and the table has no column for them.
    taken : record of each of these measurements.
    """
    knows_causes = any(row["causes"] is not None for _, rows in tables for row in rows)
    return [
        _table(
            tables,
            [*(f"{c.title} ({c.unit})" for c in OUTCOMES), *[BECAUSE] * knows_causes],
            lambda row: [*(number(c, row[c.key]) for c in OUTCOMES), *([_causes(row)] if knows_causes else [])],
            KINDS,
        ),
        _table(
            tables,
            [f"{c.title} ({c.unit})" for c in COLUMNS],
            lambda row: [_text(c, row) for c in COLUMNS],
            SUMMARIES,
        ),
        _table(tables, ["detector noise (mm)", "sampling noise (mm)"], _noise, SUMMARIES),
        _exposure_table([name for name, _ in tables], taken),
    ]


def tolerance_line(tolerance_m: float) -> str:
    """Sentence that says up to which error a reading counts as right, as every table of right readings needs it."""
    return f"Right readings are off by at most {1e3 * tolerance_m:g} mm."


def comparison_markdown(
    tables: Sequence[tuple[str, Rows]], taken: Sequence[MeasurementRecord], tolerance_m: float
) -> str:
    """The tables of `comparison_tables` in Markdown, below the tolerance."""
    of_each = [table.markdown() for table in comparison_tables(tables, taken)]
    return "\n".join([f"{tolerance_line(tolerance_m)}\n", *of_each])


def errors_markdown(comparison: Comparison) -> str:
    """Markdown table of the errors of one range image, with one row per surface.

    Lengths are in mm, fractions in %.

    Parameters
    ----------
    comparison : Comparison, as `rangesim.compare` returns it.

    Examples
    --------
    `comparison` is `rangesim.compare(image, signals)`, here of a wall at 1 m:

    >>> from rangesim import errors_markdown
    >>> print(errors_markdown(comparison).splitlines()[0])
    | surface | pixels | lit | right | wrong | missing | completeness | ... | invented readings |
    """
    names = [f.name for f in fields(ErrorStatistics) if f.name not in ("kind", "name")]
    heads = [name.removesuffix("_m") + " mm" if name.endswith("_m") else name for name in names]
    rows = [
        [surface_label((row.kind, row.name)), *(_plain(name, getattr(row, name)) for name in names)]
        for row in comparison.table
    ]
    return Table(["surface", *(head.replace("_", " ") for head in heads)], rows).markdown()


def _plain(name: str, value: Any) -> str:
    """A value of `ErrorStatistics` as text."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if name.endswith("_m"):
        return f"{1000 * value:.2f}"
    if isinstance(value, float):
        return f"{100 * value:.1f} %"
    return str(value)


def failures_markdown(rows: Rows) -> str:
    """Markdown table of the right pixels and the causes of the others, with one row per surface; fractions in %.

    Parameters
    ----------
    rows : as `rangesim.causes.CauseMap.fractions` returns them.

    Examples
    --------
    >>> from rangesim import failures_markdown
    >>> causes = {"multipath": 0.2, "low_signal": 0.05}
    >>> rows = [{"kind": "object", "name": "cup", "right": 0.75, "causes": causes}]
    >>> print(failures_markdown(rows), end="")
    | surface | right (%) | because (% of the pixels) |
    | --- | --- | --- |
    | object cup | 75.0 | multipath 20.0, low signal 5.0 |
    """
    right = OUTCOMES[0]
    lines = [[surface_label((row["kind"], row["name"])), number(right, row["right"]), _causes(row)] for row in rows]
    return Table(["surface", f"{right.title} ({right.unit})", BECAUSE], lines).markdown()


def _table(
    tables: Sequence[tuple[str, Rows]],
    heads: list[str],
    texts: Callable[[dict[str, Any]], list[str]],
    kinds: Sequence[str],
) -> Table:
    """Table with one row per surface of these kinds and instrument; `texts` makes the cells from the statistics."""
    keys = dict.fromkeys((row["kind"], row["name"]) for _, rows in tables for row in rows if row["kind"] in kinds)
    lines = []
    for key in sorted(keys, key=lambda key: kinds.index(key[0])):
        for name, rows in tables:
            lines += [[surface_label(key), name, *texts(row)] for row in rows if (row["kind"], row["name"]) == key]
    return Table(["surface", "sensor", *heads], lines)


def _causes(row: dict[str, Any]) -> str:
    """Text of the causes of wrong and missing readings."""
    return ", ".join(f"{p.name} {p.text}" for p in parts(row)) or "–"


def _noise(row: dict[str, Any]) -> list[str]:
    """Cells of the standard deviations by the detector's noise and by sampling, in millimetres."""
    sigmas = (row["detector_sigma_m"], row["sampling_sigma_m"])
    return ["–" if sigma is None else millimetres(sigma) for sigma in sigmas]


def _ratio(row: dict[str, Any]) -> str:
    """Cell of the ratio of sampling noise to detector noise."""
    ratio = noise_ratio(row)
    return f"{ratio:.2f}" if ratio else "–"


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
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("µs", 1e6), ("ns", 1e9)):
        if value * factor >= 0.9995:
            return f"{value * factor:.3g} {unit}"
    return f"{value * 1e9:.2g} ns"


def exposure(taken: MeasurementRecord) -> str:
    """Text of the exposure of each frame, which says whether it is automatic; a dash for a noise-free capture."""
    return f"{seconds(taken.exposure_s)}{' automatic' * taken.exposure_is_automatic}"


def automatic_exposures(taken: Mapping[str, MeasurementRecord]) -> str:
    """Sentences, after the word "exposure", on exposures that were chosen automatically; empty if none was.

    Parameters
    ----------
    taken : record of each measurement, by the name that the sentence gives it.
    """
    chosen = [f"{name} {seconds(one.exposure_s)}" for name, one in taken.items() if one.exposure_is_automatic]
    if not chosen:
        return ""
    return (
        f"is automatic: {', '.join(chosen)} per frame. Another distance, material or light gets another exposure, and "
        "so another noise: state exposure_s to compare them."
    )


def invented_readings(rows: Mapping[str, Rows]) -> str:
    """Sentences, after the words "invented readings", on readings where there is no surface; empty if there are none.

    Parameters
    ----------
    rows : statistics of each measurement, by the name that the sentence gives it.
    """
    counts = {name: of_one[-1]["invented_readings"] for name, of_one in rows.items()}
    found = [f"{count} of {name}" for name, count in counts.items() if count]
    if not found:
        return ""
    return (
        f"are those of pixels that see no surface: {', '.join(found)}. Right, wrong and missing do not count them, "
        "because they are fractions of the pixels that see one."
    )


def _exposure_table(names: Sequence[str], taken: Sequence[MeasurementRecord]) -> Table:
    """Table of the exposure of each instrument, and of whether it was chosen automatically."""
    lines = [
        [name, _choice(one), str(one.frames), seconds(one.exposure_s), seconds(one.acquisition_s)]
        for name, one in zip(names, taken, strict=True)
    ]
    return Table(["sensor", "exposure", "frames", "per frame", "acquisition"], lines)


def _choice(taken: MeasurementRecord) -> str:
    """Text that says who chose the exposure."""
    return "–" if taken.exposure_s is None else "automatic" if taken.exposure_is_automatic else "as stated"


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
        cells = [str(f.frames), exposure(f), seconds(f.acquisition_s)]
        cells += [seconds(times.get(stage)) for stage in ("exposure", "decode", "points", "segmentation")]
        table.append((m.name, [*cells, f"{f.points:,}".replace(",", " "), f"{f.points / f.pixels:.2f}"]))
    return table


def size_text(shape: tuple[int, ...]) -> str:
    """Width and height of an image of a shape (h, w)."""
    return f"{shape[1]} × {shape[0]}"


def settings_line(experiment: Experiment, measurements: Sequence[Measurement]) -> str:
    """The settings of the light transport, and the kind of exposure, in one line."""
    sizes = " and ".join(dict.fromkeys(size_text(m.truth.z.shape) for m in measurements))
    paths = f"up to {experiment.max_spp}" if experiment.spp is None else experiment.spp
    exposed = [m.metadata for m in measurements if m.metadata.exposure_s is not None]
    automatic = [one.exposure_is_automatic for one in exposed]
    some = f"{sum(automatic)} of {len(exposed)} automatic" if any(automatic) else "fixed"
    kind = "automatic" if all(automatic) else some
    return (
        f"{sizes} pixels, {paths} light paths per pixel of up to {experiment.max_depth} segments, "
        f"seed {experiment.seed}" + (f", exposure {kind}" if exposed else "")
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
