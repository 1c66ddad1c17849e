# SPDX-License-Identifier: Apache-2.0
"""The verdict: sentences that summarise the measurements of a result, each computed from its numbers alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rangesim.report.tables import (
    Rows,
    is_reference,
    is_reliable,
    millimetres,
    parts,
    seconds,
    titles,
)
from rangesim.results.experiment_results import Measurement

MAIN_CAUSE = 0.1
"""Smallest fraction of the failures at which the verdict names a cause. It is not smaller, so that the sentence stays
short: causes below it are rare and many."""


@dataclass(frozen=True)
class Finding:
    """A short paragraph of the verdict. subject : shown first, in bold. text : the rest."""

    subject: str
    text: str


def verdict(measurements: Sequence[Measurement]) -> list[Finding]:
    """Findings about a result: accuracy and failures of each real sensor, and then a comparison side by side."""
    names = titles(measurements)
    real = [m for m in measurements if not is_reference(m)] or list(measurements)
    findings = [Finding(names[m.name], f"{_accuracy(m)}{_failures(m)}{_reasons(m.rows)}") for m in real]
    if len(real) > 1:
        parts = [_best_error(real, names), _most_right(real, names), _shortest_exposure(real, names)]
        if any(parts):  # ideal sensors alone may be equal in all of these
            findings.append(Finding("Side by side", " ".join(filter(None, parts))))
    return findings


def _accuracy(measurement: Measurement) -> str:
    """Sentences about the pixels that a sensor measured, and about its errors."""
    total = _total(measurement.rows)
    if total["median_abs_m"] is None:
        return "measured nothing."
    lit = f"{_percent(total['completeness'])} of the pixels that its emitter lights"
    measured = lit if total["completeness"] is not None else "only pixels in shadow"
    true = "true depth" if measurement.camera.is_pinhole else "true range"
    return (
        f"measured {measured}. Half of its readings lie within {_mm(total['median_abs_m'])} of the {true}, "
        f"{_glued('95 %')} within {_mm(total['p95_abs_m'])}."
    )


def _failures(measurement: Measurement) -> str:
    """Sentence that lists the materials on which a sensor is unreliable; empty if there are none."""
    parts: list[str] = []
    for row in measurement.rows:
        if row["material"] != "all" and not is_reliable(row):
            limit = "" if parts else f" by over {_limit(measurement)}"
            found = f"{_percent(row['missing'], 0)} missing, {_percent(row['wrong'], 0)} wrong{limit}"
            parts.append(f"{row['material']} ({found})")
    listed = " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)
    return f" Unreliable on these surfaces: {listed}." if parts else ""


def _reasons(rows: Rows) -> str:
    """Sentence about the causes of failures on the materials where the sensor is unreliable. If there is no such
    material, it is about the failures on all surfaces."""
    poor = [row for row in rows if row["material"] != "all" and not is_reliable(row)]
    named = [f"{row['material']}: {_main_causes(row)}" for row in poor if row["causes"]]
    if named:
        return f" Causes of these failures: {'; '.join(named)}."
    total = _total(rows)
    return (
        f" It fails on {_percent(1 - total['right'])} of the pixels: {_main_causes(total)}." if total["causes"] else ""
    )


def _main_causes(row: dict[str, Any]) -> str:
    """The main causes of the failures of a row, each with its fraction of the failures."""
    fractions = [(p.percent / 100 / (1 - row["right"]), p.name) for p in parts(row)]
    main = [f"{_percent(fraction, 0)} {name}" for fraction, name in fractions if fraction >= MAIN_CAUSE]
    return ", ".join(main)


def _best_error(real: Sequence[Measurement], names: dict[str, str]) -> str:
    """Sentence that ranks sensors by their median error.

    Sensors that are unreliable on the whole are left out, because their few readings prove nothing.
    """
    rows = [(_total(m.rows), names[m.name]) for m in real if is_reliable(_total(m.rows))]
    errors = sorted((row["median_abs_m"], name) for row, name in rows if row["median_abs_m"])
    return _ranked("Smallest median error", [(name, _mm(e)) for e, name in errors])


def _most_right(real: Sequence[Measurement], names: dict[str, str]) -> str:
    """Sentence that ranks sensors by their fraction of correct readings; wrong readings do not count."""
    right = [(_total(m.rows)["right"], names[m.name]) for m in real if _total(m.rows)["right"] is not None]
    entries = [(name, f"{_percent(f)} of the pixels") for f, name in sorted(right, key=lambda pair: -pair[0])]
    return _ranked(f"Most right readings, to {_limit(real[0])}", entries)


def _shortest_exposure(real: Sequence[Measurement], names: dict[str, str]) -> str:
    """Sentence that ranks sensors by the exposure time of all their frames."""
    times = [(m.metadata.acquisition_s, m) for m in real if m.metadata.acquisition_s]
    times.sort(key=lambda pair: pair[0])
    return _ranked(
        "Shortest exposure of all frames",
        [(names[m.name], f"{m.metadata.frames} frames in {_glued(seconds(t))}") for t, m in times],
    )


def _ranked(what: str, entries: Sequence[tuple[str, str]]) -> str:
    """Sentence that names the best of the entries (name and value) and the next.

    It is empty for fewer than two entries, and if the two best values are equal in the digits shown.
    """
    if len(entries) < 2 or entries[0][1] == entries[1][1]:
        return ""
    (first, value), *others = entries
    against = f" (against {others[0][1]})" if len(others) == 1 else f" (next: {others[0][0]}, {others[0][1]})"
    return f"{what}: {first}, {value}{against}."


def _limit(measurement: Measurement) -> str:
    """Text of the tolerance of a measurement with its unit."""
    return _glued(f"{1e3 * measurement.causes.tolerance_m:g} mm")


def _total(rows: Rows) -> dict[str, Any]:
    """Statistics of all material classes together."""
    return next(row for row in rows if row["material"] == "all")


def _percent(fraction: float | None, digits: int = 1) -> str:
    """Text of a fraction in percent with its sign; 0 for None."""
    return _glued(f"{100 * (fraction or 0.0):.{digits}f} %")


def _mm(metres: float) -> str:
    """Text of a length in millimetres with its unit."""
    return _glued(f"{millimetres(metres)} mm")


def _glued(quantity: str) -> str:
    """Number and unit with a no-break space between them."""
    return quantity.replace(" ", "\N{NO-BREAK SPACE}")
