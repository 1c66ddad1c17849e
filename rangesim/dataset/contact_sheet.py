# SPDX-License-Identifier: Apache-2.0
"""The contact sheet of a data set: pictures of some of its scenes, and figures of all, as one HTML page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rangesim.dataset.sample_files import SampleRecord
from rangesim.dataset.samples import Samples
from rangesim.dataset.store import IndexRow
from rangesim.report.dataset_page import ContactSheet, SceneTile, SensorTile, render_dataset_page
from rangesim.report.palette import NOTHING

SCENES = 24
"""Number of scenes that are shown by default, spread evenly over the data set: some ten screens, and a page of a few
megabytes at 160 x 120 pixels with three sensors."""


def contact_sheet(directory: str | Path, scenes: int = SCENES) -> str:
    """HTML page of a data set.

    Parameters
    ----------
    directory : its folder.
    scenes : largest number of scenes to show.

    Raises
    ------
    FileFormatError
        The data set is not complete, or is broken.
    """
    samples = Samples(directory)
    rows, shown = samples.store.rows, min(scenes, len(samples))
    places = [round(i * (len(samples) - 1) / max(shown - 1, 1)) for i in range(shown)]
    sheet = ContactSheet(
        title=Path(directory).resolve().name,
        tolerance_m=samples.store.record.tolerance_m,
        line=_line(samples, rows),
        sentences=_sentences(samples.rows),
        sensors=_means(samples.rows),
        categories=sorted(Counter(category for row in samples.rows for category in row.categories).items()),
        failed=[(row.scene, str(row.error)) for row in rows if row.error is not None],
        tiles=[_tile(samples.record(i)[0], samples[i], samples.rows[i]) for i in places],
    )
    return render_dataset_page(sheet)


def _line(samples: Samples, rows: Sequence[IndexRow]) -> str:
    """Line with the numbers of scenes, objects and shards."""
    shards = {row.shard for row in samples.rows}
    size = sum(row.size or 0 for row in samples.rows)
    objects = sum(row.objects or 0 for row in samples.rows)
    version = samples.store.record.versions.get("rangesim")
    failed = len(rows) - len(samples)
    in_shards = f"{len(shards)} shard{'s' * (len(shards) != 1)}, {size / 1e6:.1f} MB"
    text = f"{len(samples)} scenes with {objects} objects · {in_shards}"
    return f"{text} · {failed} scenes failed · rangesim {version}"


def _means(rows: Sequence[IndexRow]) -> list[tuple[str, float, float, float]]:
    """Name of each sensor, and means over all scenes of its fractions right, wrong and missing; NaN if not known."""
    parts: dict[str, list[tuple[float | None, ...]]] = {}
    for row in rows:
        for name, *fractions in zip(row.sensors, row.right, row.wrong, row.missing, strict=True):
            parts.setdefault(name, []).append(tuple(fractions))
    means = {}
    for name, values in parts.items():
        known = np.array([v for v in values if None not in v], dtype=np.float64).reshape(-1, 3)
        means[name] = known.mean(axis=0) if len(known) else np.full(3, np.nan)
    return [(name, *map(float, mean)) for name, mean in means.items()]  # type: ignore[misc]


def _sentences(rows: Sequence[IndexRow]) -> list[str]:
    """Findings for the head of the page."""
    means = [entry for entry in _means(rows) if not np.isnan(entry[1])]
    if not means:
        return ["No scene has a reading to compare."]
    best, worst = max(means, key=lambda entry: entry[1]), max(means, key=lambda entry: entry[2])
    said = [f"Most right: {best[0]}, {100 * best[1]:.1f} % of the pixels of objects."]
    if len(means) > 1:
        said.append(f"Most wrong, without a warning from the sensor: {worst[0]}, {100 * worst[2]:.1f} %.")
    return said


def _tile(record: SampleRecord, sample: dict[str, Any], row: IndexRow) -> SceneTile:
    """A scene as its first camera sees it, and what each sensor made of it."""
    truth = sample["camera.1"]
    instance = np.full(truth["instance"].shape, -1, np.int32)
    for number, each in enumerate(record.objects):
        instance[truth["instance"] == each.shape] = number
    sensors = []
    for sensor, right, wrong, missing in zip(record.sensors, row.right, row.wrong, row.missing, strict=True):
        arrays = sample[f"sensor.{sensor.name}"]
        nothing = ~np.isfinite(sample[f"camera.{sensor.camera}"]["true_m"])
        outcome = np.where(nothing, NOTHING, arrays["cause"]).astype(np.uint8)
        sensors.append(SensorTile(sensor.name, arrays["intensity"], outcome, right, wrong, missing))
    counts = Counter(each.category for each in record.objects)
    return SceneTile(
        number=record.number,
        categories=sorted(counts),
        models=[each.model for each in record.objects],
        depth_m=truth["true_m"],
        instance=instance,
        amodal=truth["amodal"],
        sensors=sensors,
        warnings=record.warnings,
    )
