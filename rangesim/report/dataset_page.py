# SPDX-License-Identifier: Apache-2.0
"""The HTML page of a data set: its figures, and a contact sheet of scenes that can be filtered by category."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rangesim.report import figures, palette
from rangesim.report.template import render_page

WIDTH_PX = 240
"""Largest width of a picture in pixels. Larger images are thinned, so that a page of many scenes stays small."""
OBJECT_COLORS = "tab20"
"""matplotlib's colours of objects, of which neighbours in the list differ most."""
BACKGROUND = (226, 228, 231)
"""Colour of what is no object, RGB 0..255."""


@dataclass(frozen=True, eq=False)
class SensorTile:
    """Pictures and figures of one sensor for a scene.

    intensity : (h, w) float32. outcome : (h, w) uint8, index into `palette.OUTCOME_NAMES`.
    right, wrong, missing : fractions of the pixels of objects; None if not known.
    """

    name: str
    intensity: np.ndarray
    outcome: np.ndarray
    right: float | None
    wrong: float | None
    missing: float | None


@dataclass(frozen=True, eq=False)
class SceneTile:
    """A scene of the contact sheet.

    depth_m : (h, w) float32, true readings, NaN where there is no surface. instance : (h, w) int32, number of the
    object at each pixel, -1 for none. amodal : (objects, h, w) bool. models : name of the model of each object.
    warnings : sentences.
    """

    number: int
    categories: Sequence[str]
    models: Sequence[str]
    depth_m: np.ndarray
    instance: np.ndarray
    amodal: np.ndarray
    sensors: Sequence[SensorTile]
    warnings: Sequence[str]


@dataclass(frozen=True, eq=False)
class ContactSheet:
    """A data set to show.

    title : its name. tolerance_m : largest error of a right reading, metres. line : what it is, in one line.
    sentences : what stands out.
    sensors : name, and mean of the fractions right, wrong and missing over all scenes. categories : count of scenes of
    each. failed : number and error of each scene that failed. tiles : the scenes that are shown.
    """

    title: str
    tolerance_m: float
    line: str
    sentences: Sequence[str]
    sensors: Sequence[tuple[str, float, float, float]]
    categories: Sequence[tuple[str, int]]
    failed: Sequence[tuple[int, str]]
    tiles: Sequence[SceneTile]


def render_dataset_page(sheet: ContactSheet) -> str:
    """HTML page of a data set."""
    seen = sorted({int(i) for tile in sheet.tiles for sensor in tile.sensors for i in np.unique(sensor.outcome)})
    color = [palette.hexadecimal(c) for c in palette.OUTCOME_COLORS]
    values = {
        "sheet": sheet,
        "rows": [(name, [_percent(value) for value in parts]) for name, *parts in sheet.sensors],
        "scenes": [_scene(tile) for tile in sheet.tiles],
        "tolerance": f"{1e3 * sheet.tolerance_m:g} mm",
        "legend": [(palette.OUTCOME_NAMES[i], color[i]) for i in seen],
    }
    return render_page("dataset.html.j2", values, scripts=("scroll.js", "dataset.js"))


def _scene(tile: SceneTile) -> dict[str, object]:
    """Values of the template for a scene."""
    finite = tile.depth_m[np.isfinite(tile.depth_m)]
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
    depth = (_thinned(tile.depth_m) - low) / max(high - low, 1e-12)
    pictures = [
        (figures.color_map(depth, palette.color_table("viridis")), f"depth, {low:.2f} to {high:.2f} m"),
        (figures.png(_thinned(_objects(tile))), f"{len(tile.models)} objects; outlines: also what is hidden"),
    ]
    for sensor in tile.sensors:
        white = float(np.nanpercentile(sensor.intensity, 99.5)) if np.isfinite(sensor.intensity).any() else 1.0
        pictures.append((figures.grey(_thinned(sensor.intensity), white), sensor.name))
        shares = zip(("right", "wrong", "missing"), (sensor.right, sensor.wrong, sensor.missing), strict=True)
        text = ", ".join(f"{name} {_percent(share)}" for name, share in shares)
        pictures.append((figures.png(_thinned(sensor.outcome), palette.OUTCOME_COLORS), text))
    return {
        "number": tile.number,
        "categories": sorted(set(tile.categories)),
        "models": [f"{count} × {model}" if count > 1 else model for model, count in Counter(tile.models).items()],
        "pictures": pictures,
        "warnings": tile.warnings,
    }


def _thinned(image: np.ndarray) -> np.ndarray:
    """Every k-th pixel, so that at most `WIDTH_PX` columns are left."""
    step = -(-image.shape[1] // WIDTH_PX)
    return np.ascontiguousarray(image[::step, ::step])


def _objects(tile: SceneTile) -> np.ndarray:
    """(h, w, 3) uint8, the visible part of each object in a colour, and the outline of its whole silhouette."""
    from matplotlib import colormaps
    from scipy.ndimage import binary_erosion

    colors = np.rint(255 * np.array([colormaps[OBJECT_COLORS](i % 20)[:3] for i in range(len(tile.models))]))
    picture = np.full((*tile.instance.shape, 3), BACKGROUND, np.uint8)
    for number, color in enumerate(colors):
        picture[tile.instance == number] = color
    for mask, color in zip(tile.amodal, colors, strict=True):
        picture[mask & ~binary_erosion(mask)] = 0.6 * color
    return picture


def _percent(fraction: float | None) -> str:
    return "-" if fraction is None or np.isnan(fraction) else f"{100 * fraction:.1f}\u00a0%"
