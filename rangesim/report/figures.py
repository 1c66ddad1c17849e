# SPDX-License-Identifier: Apache-2.0
"""Pictures of the report, each as a PNG in a data URI."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass

import numpy as np

from rangesim.capture import Captured
from rangesim.decoding.range_image import RangeImage
from rangesim.files.image_files import PNG_STRATEGY
from rangesim.report import palette
from rangesim.report.panorama import of_directions, panorama
from rangesim.results.experiment_results import Measurement
from rangesim.rig import Camera
from rangesim.signals import EnergySplit, GroundTruth

GAMMA = 2.2
"""Exponent of the display, dimensionless: grey value = (linear value)^(1/gamma), approximately as in sRGB."""


@dataclass(frozen=True)
class Picture:
    """An image to show. uri : PNG as data URI. caption : plain text below it. alt : text in place of the image."""

    uri: str
    caption: str
    alt: str = ""


@dataclass(frozen=True)
class LegendEntry:
    """An entry of a legend: a class with its colour (#rrggbb) and its fraction of the pixels, in percent."""

    name: str
    color: str
    percent: float

    @property
    def text(self) -> str:
        """Percent with one digit; small values are "< 0.1", not 0."""
        return f"{self.percent:.1f}" if self.percent >= 0.05 else "< 0.1"


def png(image: np.ndarray, table: np.ndarray | None = None) -> str:
    """PNG as a data URI; the parameters are those of `png_bytes`."""
    return "data:image/png;base64," + base64.b64encode(png_bytes(image, table)).decode("ascii")


def png_bytes(image: np.ndarray, table: np.ndarray | None = None) -> bytes:
    """PNG file of an image.

    Parameters
    ----------
    image : (h, w) uint8 grey values, (h, w, 3) uint8 RGB, or (h, w) uint8 indices into `table`.
    table : (n, 3) uint8 colours, RGB; None: the image holds grey values or colours.
    """
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(image))
    if table is not None:
        picture.putpalette(np.ascontiguousarray(table, dtype=np.uint8).tobytes())
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", compress_level=1, compress_type=PNG_STRATEGY)
    return buffer.getvalue()


def grey(image: np.ndarray, white: float, black: float = 0.0) -> str:
    """PNG, as a data URI, of a linear image (h, w) with display gamma.

    white, black : values of the image that are shown as white and as black.
    """
    fraction = (np.nan_to_num(image.astype(np.float64)) - black) / max(white - black, 1e-30)
    return png(np.rint(255 * np.clip(fraction, 0, 1) ** (1 / GAMMA)).astype(np.uint8))


def color_map(fraction: np.ndarray, table: np.ndarray) -> str:
    """PNG, as a data URI, of values 0..1 in the colours of a table, see `indexed`."""
    return png(*indexed(fraction, table))


def map_pictures(image: RangeImage) -> dict[str, bytes]:
    """PNG files of the maps of a range image, by name: projector columns and rows if it has them, depth and status."""
    maps = {"columns": image.projector_column, "rows": image.projector_row, "depth": image.z}
    table = palette.color_table("viridis")
    pictures = {
        name: png_bytes(*indexed(_stretched(values), table))
        for name, values in maps.items()
        if values is not None and np.isfinite(values).any()
    }
    pictures["status"] = png_bytes(image.status, palette.STATUS_COLORS)
    return pictures


def _stretched(values: np.ndarray) -> np.ndarray:
    """Values scaled so that their 1st percentile is 0 and their 99th is 1; some values lie outside 0..1."""
    low, high = np.nanpercentile(values, [1, 99])
    return np.asarray((values - low) / max(high - low, 1e-12))


def indexed(fraction: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) uint8 indices of values 0..1 into a colour table (256, 3), and that table with light grey for NaN."""
    index = np.rint(np.clip(np.nan_to_num(fraction), 0, 1) * 254).astype(np.uint8)
    index[~np.isfinite(fraction)] = 255
    colors = table[np.rint(np.arange(256) / 254 * 255).clip(0, 255).astype(int)].copy()
    colors[255] = palette.NO_DATA
    return index, colors


def color_bar(table: np.ndarray) -> str:
    """PNG, as a data URI, of one row that shows a colour table from left to right."""
    return png(np.arange(256, dtype=np.uint8)[None], table)


def scene_picture(energy: EnergySplit, camera: Camera) -> Picture:
    """Picture of the scene in its own light, or in the emitter's light if it has none."""
    own = bool(energy.ambient.max() > 0)
    image = energy.ambient if own else energy.projector
    light = "in its own light" if own else "lit by the emitter (it has no light of its own)"
    shown = panorama(camera).picture(image, 0.0)
    return Picture(grey(shown, _bright(image)), f"The scene from the camera, {light}.", "the scene")


def material_picture(truth: GroundTruth, camera: Camera) -> tuple[Picture, list[LegendEntry]]:
    """Picture of the material class of each pixel, and its legend."""
    classes = np.where(truth.material >= 0, truth.material, len(truth.material_names)).astype(np.uint8)
    colors = [palette.MATERIAL_COLORS.get(n, palette.NO_DATA) for n in truth.material_names]
    table = np.array([*colors, palette.NO_DATA], dtype=np.uint8)
    names = [*truth.material_names, "nothing"]
    caption = "Material class of the first surface behind each pixel."
    shown = panorama(camera).picture(classes, len(truth.material_names))
    return Picture(png(shown, table), caption, "material classes"), _legend(classes, names, table)


def depth_map(measurement: Measurement, limits: tuple[float, float], table: np.ndarray) -> str:
    """PNG, as a data URI, of the measured depths, or of the ranges of a camera that is no pinhole.

    limits : depths, in metres, at the ends of the colour table.
    """
    low, high = limits
    fraction = (measurement.image.reading_m - low) / (high - low)
    return color_map(panorama(measurement.camera).picture(fraction, np.nan), table)


def unrolled(ranges: np.ndarray, directions: np.ndarray) -> Picture:
    """Picture of the ranges of a scanner as a panorama: azimuth from left to right, elevation upwards.

    Parameters
    ----------
    ranges : (h, w) float, metres; NaN where there is no reading.
    directions : (h, w, 3) float64, unit vectors, coordinates of the scanner (x right, y down, z forward).

    Examples
    --------
    >>> from rangesim.report.figures import unrolled
    >>> from rangesim.rig.scan_patterns import spinning
    >>> rays = spinning(np.radians([10.0, 0.0, -10.0]), columns=360, period_s=0.1, first_azimuth_rad=-np.pi)
    >>> unrolled(np.ones((3, 360)), rays.directions).caption
    'Range over azimuth and elevation, 1.0 m (dark) to 1.0 m (bright).'
    """
    values = np.log(np.where(ranges > 0, ranges, np.nan).astype(np.float64))
    shown = of_directions(np.ascontiguousarray(directions, dtype=np.float64)).picture(values, np.nan)
    caption = "Range over azimuth and elevation, no reading."
    if np.isfinite(shown).any():
        low, high = np.exp(np.nanpercentile(shown, [1, 99]))
        caption = f"Range over azimuth and elevation, {low:.1f} m (dark) to {high:.1f} m (bright)."
        shown = _stretched(shown)
    return Picture(png(*indexed(shown, palette.color_table("viridis"))), caption, "the panorama")


def error_map(measurement: Measurement, table: np.ndarray) -> str:
    """PNG, as a data URI, of the errors of depth."""
    fraction = palette.error_fraction(measurement.image.reading_m - measurement.true_m)
    return color_map(panorama(measurement.camera).picture(fraction, np.nan), table)


def cause_map(measurement: Measurement) -> tuple[str, list[LegendEntry]]:
    """PNG, as a data URI, of the causes of failed pixels, and its legend."""
    classes = palette.outcomes(measurement)
    shown = panorama(measurement.camera).picture(classes, palette.NOTHING)
    return png(shown, palette.OUTCOME_COLORS), _legend(classes, palette.OUTCOME_NAMES, palette.OUTCOME_COLORS)


def captured_frames(captured: Captured) -> list[Picture]:
    """Pictures of a few representative frames of a capture, all with the same white; of several cameras, of each."""
    pictures = []
    for number, capture in enumerate(captured.captures, 1):
        names = capture.sensor.frame_names()
        chosen = [i for i in capture.sensor.representative_frames(capture.frames) if 0 <= i < len(names)]
        white = max(float(np.percentile(capture.frames[i], 99.5)) for i in chosen)
        black, camera = capture.black_level, f", camera {number}" if len(captured.captures) > 1 else ""
        layout = panorama(capture.rig.camera) if capture.rig else None
        for i in chosen:
            shown = layout.picture(capture.frames[i], black) if layout else capture.frames[i]
            pictures.append(Picture(grey(shown, white, black), names[i].replace("_", " ") + camera, names[i] + camera))
    return pictures


def light_pictures(energy: EnergySplit, camera: Camera) -> list[Picture]:
    """Pictures of the radiance by the kind of light path, all with the same white.

    The captions state the fraction of each kind in the emitter's light.
    """
    white, layout = _bright(energy.projector), panorama(camera)
    total = float(energy.projector.sum())
    kinds = {
        "direct": ("emitter, surface, camera", energy.direct),
        "multipath": ("by way of further surfaces", energy.multipath),
        "via mirror or glass": ("the lit surface is seen off a mirror or through glass", energy.specular),
        "caustic": ("the surface is lit off a mirror or through glass", energy.caustic),
        "glint": ("the emitter itself is seen off a mirror or through glass", energy.glint),
    }
    pictures = [
        Picture(
            grey(layout.picture(image, 0.0), white),
            f"{name}: {meaning}; {100 * float(image.sum()) / total:.1f} % of the emitter’s light in the image",
            name,
        )
        for name, (meaning, image) in kinds.items()
        if total > 0 and image.max() > 0
    ]
    if energy.ambient.max() > 0:
        ratio = 100 * float(energy.ambient.sum()) / total if total > 0 else float("inf")
        text = f"ambient: all other light, before any filter; {ratio:.0f} % of the emitter’s light"
        pictures.append(Picture(grey(layout.picture(energy.ambient, 0.0), white), text, "ambient"))
    return pictures


def _bright(image: np.ndarray) -> float:
    """99th percentile of the positive values; 1 if there are none."""
    lit = image[image > 0]
    return float(np.percentile(lit, 99)) if lit.size else 1.0


def _legend(classes: np.ndarray, names: list[str], table: np.ndarray) -> list[LegendEntry]:
    """Entries of the classes (h, w) that occur, with names and colours by the number of the class."""
    counts = np.bincount(classes.ravel(), minlength=len(names))
    return [
        LegendEntry(name, palette.hexadecimal(table[i]), 100 * float(counts[i]) / classes.size)
        for i, name in enumerate(names)
        if counts[i]
    ]
