# SPDX-License-Identifier: Apache-2.0
"""The verdict: sentences that summarise the measurements of a result, each computed from its numbers alone.

It judges a sensor by its right readings of the objects, in which every object weighs the same. In a scene without
objects it judges by all surfaces, and names materials in place of objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rangesim.evaluation.surface_rows import MATERIAL, OBJECT, OBJECTS
from rangesim.report.objects_section import objects_sentence
from rangesim.report.tables import (
    Rows,
    automatic_exposures,
    invented_readings,
    is_reference,
    is_reliable,
    millimetres,
    parts,
    seconds,
    titles,
)
from rangesim.results.experiment_results import Measurement
from rangesim.signals import ALL

MAIN_CAUSE = 0.1
"""Smallest fraction of the failures at which the verdict names a cause. It is not smaller, so that the sentence stays
short: causes below it are rare and many."""
MAX_NAMED = 3
"""Largest number of objects that a sentence names; the others are counted. The table names all of them."""


@dataclass(frozen=True)
class Finding:
    """A short paragraph of the verdict. subject : shown first, in bold. text : the rest."""

    subject: str
    text: str


def verdict(measurements: Sequence[Measurement]) -> list[Finding]:
    """Findings about a result: real sensors side by side, right readings and failures of each, automatic exposures."""
    names = titles(measurements)
    real = [m for m in measurements if not is_reference(m)] or list(measurements)
    findings = [Finding(names[m.name], _of_one(m)) for m in real]
    if len(real) > 1:
        parts = [
            _most_right(real, names),
            _nobody_right(real, names),
            _best_error(real, names),
            _shortest_exposure(real, names),
        ]
        if any(parts):  # ideal sensors alone may be equal in all of these
            findings.insert(0, Finding("Side by side", " ".join(filter(None, parts))))
    if text := invented_readings({names[m.name]: m.rows for m in real}):
        findings.append(Finding("Invented readings", text))
    if text := automatic_exposures({names[m.name]: m.metadata for m in real}):
        findings.append(Finding("Exposure", text))
    return findings


# ---- One sensor ----------------------------------------------------------------------------------------------------


def _of_one(m: Measurement) -> str:
    """Sentences about one sensor."""
    about = [_right(m) + _worst(m.rows) + _reasons(m.rows) + _accuracy(m), objects_sentence(m)]
    return " ".join(filter(None, about))


def _right(measurement: Measurement) -> str:
    """Sentence about right, wrong and missing readings."""
    judged = _judged(measurement.rows)
    if judged["right"] is None:
        return "saw no surface."
    if _row(measurement.rows, ALL)["missing"] == 1:
        return "measured nothing."
    return (
        f"reads {_percent(judged['right'])} of {_whose_pixels(measurement.rows)} right, to {_limit(measurement)}, and "
        f"{_percent(judged['wrong'])} wrong; {_percent(judged['missing'])} are missing."
    )


def _worst(rows: Rows) -> str:
    """Sentences about the objects that a sensor is not right on most of, the worst first, or about the worst one."""
    surfaces, noun = _surfaces(rows)
    if len(surfaces) < 2 or _row(rows, ALL)["missing"] == 1:
        return ""
    surfaces.sort(key=lambda row: row["right"])
    poor = [row for row in surfaces if not is_reliable(row)]
    named = [_described(row) for row in (poor or surfaces)[: MAX_NAMED if poor else 1]]
    more = f" and {len(poor) - MAX_NAMED} more" if len(poor) > MAX_NAMED else ""
    good = [row["name"] for row in surfaces if row not in poor]
    count = f"{len(good)} of {len(surfaces)} {noun}"
    if poor and 0 < len(good) <= MAX_NAMED:
        count += f" ({', '.join(reversed(good))})"
    return f" Most pixels are right on {count}; worst: {', '.join(named)}{more}."


def _described(row: dict[str, Any]) -> str:
    """Name of a surface, with what is right, wrong and missing on it, and the main cause."""
    found = ", ".join(f"{_percent(row[outcome], 0)} {outcome}" for outcome in ("right", "wrong", "missing"))
    causes = parts(row)
    return f"{row['name']} ({found}{f'; {causes[0].name}' if causes else ''})"


def _reasons(rows: Rows) -> str:
    """Sentence about the main causes of wrong and missing readings, each with its fraction of them."""
    judged = _judged(rows)
    failed = sum(judged["causes"].values())
    main = [(p.name, p.percent / 100 / failed) for p in parts(judged)]
    named = [f"{_percent(fraction, 0)} {name}" for name, fraction in main if fraction >= MAIN_CAUSE]
    return f" Causes of what is wrong or missing: {', '.join(named)}." if named else ""


def _accuracy(measurement: Measurement) -> str:
    """Sentence about the errors of the readings, right and wrong ones; empty if most pixels are not right."""
    judged = _judged(measurement.rows)
    if not is_reliable(judged):
        return ""
    true = "true depth" if measurement.camera.is_pinhole else "true range"
    lie = "lie" if judged["kind"] == ALL else "on an object lie, on average,"
    return (
        f" Half of its readings {lie} within {_mm(judged['median_abs_m'])} of the {true}, {_glued('95 %')} within "
        f"{_mm(judged['p95_abs_m'])}."
    )


# ---- Side by side --------------------------------------------------------------------------------------------------


def _most_right(real: Sequence[Measurement], names: dict[str, str]) -> str:
    """Sentence that ranks sensors by their right readings, or says that none of them is right on most."""
    right = [(_judged(m.rows)["right"], m) for m in real if _judged(m.rows)["right"] is not None]
    right.sort(key=lambda pair: -pair[0])
    entries = [(names[m.name], _percent(f)) for f, m in right]
    whose = _whose_pixels(real[0].rows)
    if right and not any(is_reliable(_judged(m.rows)) for _, m in right):
        name, most = entries[0]
        wrong = _percent(_judged(right[0][1].rows)["wrong"])
        most_of = f"{whose} right, to {_limit(real[0])}"
        if most == _percent(0.0):
            return f"No sensor reads any of {most_of}."
        return f"No sensor reads most of {most_of}; {name} reads most, {most}, and {wrong} wrong."
    return _ranked(f"Most of {whose} right, to {_limit(real[0])}", entries)


def _nobody_right(real: Sequence[Measurement], names: dict[str, str]) -> str:
    """Sentence that names the objects of which no sensor reads most right, each with the best sensor; else empty."""
    best: dict[str, tuple[float, str]] = {}
    noun = ""
    for m in real:
        surfaces, noun = _surfaces(m.rows)
        for row in surfaces:
            best[row["name"]] = max(best.get(row["name"], (-1.0, "")), (row["right"], names[m.name]))
    poor = sorted((right, name, sensor) for name, (right, sensor) in best.items() if not is_reliable({"right": right}))
    if not poor:
        return ""
    named = [f"{name} (at best {_percent(right, 0)}, {sensor})" for right, name, sensor in poor[:MAX_NAMED]]
    more = f" and {len(poor) - MAX_NAMED} more" if len(poor) > MAX_NAMED else ""
    which = "any of the" if len(poor) == len(best) else "these"
    return f"No sensor is right on most of {which} {noun}: {', '.join(named)}{more}."


def _best_error(real: Sequence[Measurement], names: dict[str, str]) -> str:
    """Sentence that ranks sensors by their median error; those that are not right on most prove nothing by it."""
    rows = [(_judged(m.rows), names[m.name]) for m in real if is_reliable(_judged(m.rows))]
    errors = sorted((row["median_abs_m"], name) for row, name in rows if row["median_abs_m"])
    return _ranked("Smallest median error", [(name, _mm(e)) for e, name in errors])


def _shortest_exposure(real: Sequence[Measurement], names: dict[str, str]) -> str:
    """Sentence that ranks sensors that are right on most by the exposure time of all their frames."""
    reliable = [m for m in real if is_reliable(_judged(m.rows))]
    times = [(m.metadata.acquisition_s, m) for m in reliable if m.metadata.acquisition_s]
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


# ---- Rows and texts ------------------------------------------------------------------------------------------------


def _row(rows: Rows, kind: str) -> dict[str, Any]:
    """The first row of a kind."""
    return next(row for row in rows if row["kind"] == kind)


def _judged(rows: Rows) -> dict[str, Any]:
    """The row by which a sensor is judged: the mean over the objects, or all surfaces if there are no objects."""
    return _row(rows, OBJECTS if any(row["kind"] == OBJECTS for row in rows) else ALL)


def _surfaces(rows: Rows) -> tuple[Rows, str]:
    """Rows of the objects, or of the materials if there are no objects; and what they are called."""
    objects = [row for row in rows if row["kind"] == OBJECT]
    return (objects, "objects") if objects else ([row for row in rows if row["kind"] == MATERIAL], "materials")


def _whose_pixels(rows: Rows) -> str:
    """Words for the pixels that a sensor is judged by."""
    objects = [row["name"] for row in rows if row["kind"] == OBJECT]
    return f"the pixels of {objects[0]}" if len(objects) == 1 else "the objects’ pixels" if objects else "the pixels"


def _limit(measurement: Measurement) -> str:
    """Text of the tolerance of a measurement with its unit."""
    return _glued(f"{1e3 * measurement.causes.tolerance_m:g} mm")


def _percent(fraction: float | None, digits: int = 1) -> str:
    """Text of a fraction in percent with its sign; 0 for None."""
    return _glued(f"{100 * (fraction or 0.0):.{digits}f} %")


def _mm(metres: float) -> str:
    """Text of a length in millimetres with its unit."""
    return _glued(f"{millimetres(metres)} mm")


def _glued(quantity: str) -> str:
    """Number and unit with a no-break space between them."""
    return quantity.replace(" ", "\N{NO-BREAK SPACE}")
