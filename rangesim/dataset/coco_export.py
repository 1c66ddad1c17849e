# SPDX-License-Identifier: Apache-2.0
"""A data set in the format of COCO: images of intensities, and a mask of each object that is seen.

DIR/SENSOR/000000.png        intensity of the sensor, 8 bits, one image of each scene
    annotations_SENSOR.json  images, categories and annotations
    export.json              what was exported

An annotation's `segmentation` is the visible part of the object as run lengths; `amodal_segmentation`, which readers of
COCO leave alone, is its whole silhouette within the image.

[1] Lin et al., Microsoft COCO: Common Objects in Context, ECCV 2014.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rangesim.dataset.export_steps import box_of, grey_of, sensors_of
from rangesim.dataset.sample_files import SampleRecord
from rangesim.dataset.samples import Samples
from rangesim.errors import FileFormatError
from rangesim.files.atomic_directories import DirectoryKind, new_directory
from rangesim.files.image_files import write_grey
from rangesim.files.schema import write_json

KIND = DirectoryKind("rangesim-coco", "export.json", FileFormatError)
"""Directories that hold an export to COCO."""


def export_coco(
    directory: str | Path,
    out: str | Path,
    sensors: Sequence[str] | None = None,
    tell: Callable[[str, float], None] | None = None,
) -> int:
    """Write a data set in the format of COCO; returns the count of images.

    Parameters
    ----------
    directory : folder of the data set.
    out : new folder.
    sensors : names of the sensors to export; None: all.

    Raises
    ------
    FileFormatError
        The data set is not complete or broken, or `out` holds something else.
    ValueError
        There is no such sensor, or no scene.
    """
    samples = Samples(directory)
    names = sensors_of(samples, sensors)
    categories = {name: i for i, name in enumerate(sorted({c for row in samples.rows for c in row.categories}), 1)}
    with new_directory(out, KIND, inputs=[directory]) as folder:
        listed: dict[str, dict[str, list[Any]]] = {name: {"images": [], "annotations": []} for name in names}
        for name in names:
            (folder / name).mkdir()
        for count, sample in enumerate(samples):
            if tell is not None:
                tell(f"Exporting scene {samples.rows[count].scene}", count / len(samples))
            record, _ = samples.record(count)
            for name in names:
                _add(listed[name], record, sample, name, folder, categories)
        for name, parts in listed.items():
            table = [{"id": i, "name": category, "supercategory": ""} for category, i in categories.items()]
            write_json(folder / f"annotations_{name}.json", {**parts, "categories": table})
        write_json(folder / KIND.sidecar, {"format": KIND.format, "sensors": names})
    return len(samples) * len(names)


def _add(
    listed: dict[str, list[Any]],
    record: SampleRecord,
    sample: dict[str, Any],
    sensor: str,
    folder: Path,
    categories: dict[str, int],
) -> None:
    """Write the image of a scene, and list it with its annotations."""
    camera = next(each.camera for each in record.sensors if each.name == sensor)
    truth = sample[f"camera.{camera}"]
    height, width = truth["instance"].shape
    file = f"{sensor}/{record.number:06d}.png"
    write_grey(folder / file, grey_of(sample[f"sensor.{sensor}"]["intensity"]))
    listed["images"].append({"id": record.number, "file_name": file, "width": width, "height": height})
    for number, each in enumerate(record.objects):
        visible = truth["instance"] == each.shape
        box = box_of(visible)
        if box is not None:
            listed["annotations"].append(
                {
                    "id": len(listed["annotations"]) + 1,
                    "image_id": record.number,
                    "category_id": categories[each.category],
                    "segmentation": run_lengths(visible),
                    "amodal_segmentation": run_lengths(truth["amodal"][number]),
                    "area": int(visible.sum()),
                    "bbox": box,
                    "iscrowd": 0,
                }
            )


def run_lengths(mask: np.ndarray) -> dict[str, Any]:
    """A mask (h, w) as COCO's run lengths: column by column, counts of pixels outside and inside in turn.

    Examples
    --------
    >>> run_lengths(np.array([[0, 1], [1, 1]], bool))
    {'size': [2, 2], 'counts': [1, 3]}
    """
    flat = np.concatenate([[False], mask.ravel(order="F"), [False]])
    changes = np.flatnonzero(flat[1:] != flat[:-1])
    ends = np.concatenate([[0], changes, [mask.size] if not changes.size or changes[-1] < mask.size else []])
    return {"size": list(mask.shape), "counts": np.diff(ends).astype(int).tolist()}
