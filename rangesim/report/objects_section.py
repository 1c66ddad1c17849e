# SPDX-License-Identifier: Apache-2.0
"""The section of the report on objects: what the segmentation of each sensor's cloud makes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rangesim.evaluation.object_segmentation import ObjectOutcome, ObjectSegmentation, Outcome
from rangesim.results.experiment_results import Measurement

MAX_NAMED = 3
"""Largest number of objects that a part of a sentence names; the others are counted. The table names all of them."""


@dataclass(frozen=True)
class OutcomeCell:
    """A cell of the table of objects. word : the outcome. note : more of it, in small letters. good : as it should."""

    word: str
    note: str = ""
    good: bool = True


@dataclass(frozen=True)
class ObjectLine:
    """A row of the table. name : of the object. note : what is special about it. cells : one per instrument."""

    name: str
    note: str
    cells: list[OutcomeCell]


def objects_table(measurements: Sequence[Measurement]) -> list[ObjectLine]:
    """Outcomes of each object, one cell per instrument; empty if no object is in view, or it is not known."""
    known = [{o.name: o for o in m.objects.objects} if m.objects is not None else {} for m in measurements]
    lines = []
    for name in dict.fromkeys(name for of_one in known for name in of_one):
        found = [of_one.get(name) for of_one in known]
        hard = not any(o is not None and o.separable for o in found)
        note = "not told apart even in the true depth" if hard else ""
        lines.append(ObjectLine(name, note, [_cell(o) for o in found]))
    return lines


def totals(measurements: Sequence[Measurement]) -> list[ObjectLine]:
    """The last rows of the table: the numbers of objects found and invented, and the panoptic quality."""
    columns = [_totals(m.objects) for m in measurements]
    names = ("found in place", "invented", "panoptic quality")
    return [ObjectLine(name, "", list(cells)) for name, cells in zip(names, zip(*columns, strict=True), strict=True)]


def _totals(objects: ObjectSegmentation | None) -> tuple[OutcomeCell, OutcomeCell, OutcomeCell]:
    """Cells of one instrument: objects found, segments invented, panoptic quality."""
    if objects is None or not objects.objects:
        return (OutcomeCell("–"),) * 3
    found = f"{len(objects.names(Outcome.FOUND)) - len(_displaced(objects))} of {len(objects.objects)}"
    quality = OutcomeCell(f"{objects.panoptic_quality:.2f}")
    return OutcomeCell(found), OutcomeCell(str(objects.invented), good=not objects.invented), quality


def objects_sentence(measurement: Measurement) -> str:
    """Sentences on what becomes of the objects; empty if none is in view, or if it is not known.

    Examples
    --------
    `measurement` is one of `rangesim.results.experiment_results.Result.measurements`:

    >>> objects_sentence(measurement)  # doctest: +SKIP
    'Segmentation finds 6 of 9 objects, merges bottle with table, and misses glass; it invents 2.'
    """
    objects = measurement.objects
    if objects is None or not objects.objects:
        return ""
    failures = []
    if displaced := _displaced(objects):
        failures.append(f"displaces {_listed(displaced)} by over {1e3 * measurement.causes.tolerance_m:g}\u00a0mm")
    blamed = [o for o in objects.objects if o.separable]
    failures += _merges([o for o in blamed if o.outcome == Outcome.MERGED])
    for verb, outcome in (("splits", Outcome.SPLIT), ("misses", Outcome.MISSED)):
        if names := [o.name for o in blamed if o.outcome == outcome]:
            failures.append(f"{verb} {_listed(names)}")
    count, found = len(objects.objects), len(objects.names(Outcome.FOUND)) - len(_displaced(objects))
    hard = [o.name for o in objects.objects if not o.separable and o.outcome != Outcome.FOUND]
    whole = f"Segmentation finds {found or 'none'} of {count} object{'s' * (count != 1)}"
    sentence = ", ".join([whole, *failures[:-1]])
    if failures:
        sentence += f", and {failures[-1]}"
    sentence += f"; it invents {objects.invented}." if objects.invented else "."
    alone = f" Even in the true depth it does not find {_listed(hard)}." if hard else ""
    return sentence + alone


def _displaced(objects: ObjectSegmentation) -> list[str]:
    return [o.name for o in objects.objects if o.displaced]


def _merges(merged: Sequence[ObjectOutcome]) -> list[str]:
    """Parts of a sentence that say which objects are merged with what; those of one segment share a part."""
    groups: dict[frozenset[str], list[ObjectOutcome]] = {}
    for o in merged:
        groups.setdefault(frozenset((o.name, *o.merged_with)), []).append(o)
    by_partners: dict[tuple[str, ...], list[list[str]]] = {}
    for group in groups.values():
        names = [o.name for o in group]
        partners = tuple(name for name in group[0].merged_with if name not in names)
        by_partners.setdefault(partners, []).append(names)
    texts = []
    for partners, together in by_partners.items():
        names = [name for group in together for name in group]
        texts.append(f"merges {_listed(names)}{f' with {_listed(partners)}' if partners else ''}")
    return texts


def _listed(names: Sequence[str]) -> str:
    """Names as words, at most `MAX_NAMED` of them."""
    shown = list(names[:MAX_NAMED])
    if (more := len(names) - MAX_NAMED) > 0:
        shown.append(f"{more} more")
    return _joined(shown)


def _joined(words: Sequence[str]) -> str:
    """Words with commas, and "and" before the last."""
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]


def _cell(o: ObjectOutcome | None) -> OutcomeCell:
    """Cell of one object and one instrument."""
    if o is None:
        return OutcomeCell("–", "not in view")
    covering = f"{100 * o.covering:.0f} %"
    if o.displaced:
        return OutcomeCell("displaced", covering, good=False)
    if o.outcome == Outcome.MERGED:
        return OutcomeCell("merged", f"with {_listed(o.merged_with)}", good=False)
    return OutcomeCell(o.outcome.value, covering, good=o.outcome == Outcome.FOUND)
