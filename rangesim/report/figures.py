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
from rangesim.results.experiment_results import Measurement
from rangesim.rig.scan_patterns import column_shifts
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
    """PNG, as a data URI, of values 0..1 in the colours of a table, see `_indexed`."""
    return png(*_indexed(fraction, table))


def map_pictures(image: RangeImage) -> dict[str, bytes]:
    """PNG files of the maps of a range image, by name: projector columns and rows if it has them, depth and status."""
    maps = {"columns": image.projector_column, "rows": image.projector_row, "depth": image.z}
    table = palette.color_table("viridis")
    pictures = {
        name: png_bytes(*_indexed(_stretched(values), table))
        for name, values in maps.items()
        if values is not None and np.isfinite(values).any()
    }
    pictures["status"] = png_bytes(image.status, palette.STATUS_COLORS)
    return pictures


def _stretched(values: np.ndarray) -> np.ndarray:
    """Values scaled so that their 1st percentile is 0 and their 99th is 1; some values lie outside 0..1."""
    low, high = np.nanpercentile(values, [1, 99])
    return np.asarray((values - low) / max(high - low, 1e-12))


def _indexed(fraction: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) uint8 indices of values 0..1 into a colour table (256, 3), and that table with light grey for NaN."""
    index = np.rint(np.clip(np.nan_to_num(fraction), 0, 1) * 254).astype(np.uint8)
    index[~np.isfinite(fraction)] = 255
    colors = table[np.rint(np.arange(256) / 254 * 255).clip(0, 255).astype(int)].copy()
    colors[255] = palette.NO_DATA
    return index, colors


def color_bar(table: np.ndarray) -> str:
    """PNG, as a data URI, of one row that shows a colour table from left to right."""
    return png(np.arange(256, dtype=np.uint8)[None], table)


def scene_picture(energy: EnergySplit) -> Picture:
    """Picture of the scene in its own light, or in the emitter's light if it has none."""
    own = bool(energy.ambient.max() > 0)
    image = energy.ambient if own else energy.projector
    light = "in its own light" if own else "lit by the emitter (it has no light of its own)"
    return Picture(grey(image, _bright(image)), f"The scene from the camera, {light}.", "the scene")


def material_picture(truth: GroundTruth) -> tuple[Picture, list[LegendEntry]]:
    """Picture of the material class of each pixel, and its legend."""
    classes = np.where(truth.material >= 0, truth.material, len(truth.material_names)).astype(np.uint8)
    colors = [palette.MATERIAL_COLORS.get(n, palette.NO_DATA) for n in truth.material_names]
    table = np.array([*colors, palette.NO_DATA], dtype=np.uint8)
    names = [*truth.material_names, "nothing"]
    caption = "Material class of the first surface behind each pixel."
    return Picture(png(classes, table), caption, "material classes"), _legend(classes, names, table)


def depth_map(measurement: Measurement, limits: tuple[float, float], table: np.ndarray) -> str:
    """PNG, as a data URI, of the measured depths.

    limits : depths, in metres, at the ends of the colour table.
    """
    low, high = limits
    return color_map((measurement.image.z - low) / (high - low), table)


MAX_STRIP = 3.0
"""Largest ratio of width to height of the picture of a turn; a longer one is cut into strips, one below the other. With
3, a turn of 64 rings over 45 degrees and 1024 columns becomes two strips of 512 pixels, as wide as other maps."""
MAX_ROW_REPEATS = 8
"""Largest number of pixel rows per ring in the picture of a turn: a scanner of few rings still has stripes then."""


def unrolled(ranges: np.ndarray, directions: np.ndarray) -> Picture:
    """Picture of a turn of a scanner, unrolled: a row for each ring, the highest at the top, a column per direction.

    Columns follow each other as the scanner turned. A long picture is cut into strips, one below the other.

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
    'Range over a turn of the scanner, unrolled: 3 rings, 360° from azimuth -180°, 1.0 m (dark) to 1.0 m (bright).'
    """
    shifts = column_shifts(directions)
    rows = np.argsort(-np.arcsin(np.clip(-directions[..., 1], -1, 1)).mean(axis=1), kind="stable")
    source = (np.arange(ranges.shape[1]) - shifts[:, None]) % ranges.shape[1]
    image = np.take_along_axis(ranges, source, axis=1)[rows].astype(np.float64)
    repeats = _rows_per_ring(directions)
    image = np.log(np.where(image > 0, image, np.nan)).repeat(repeats, axis=0)
    strips = 1
    while image.shape[1] / strips > MAX_STRIP * image.shape[0] * strips:
        strips += 1
    padded = np.pad(image, ((0, 0), (0, -image.shape[1] % strips)), constant_values=np.nan)
    gap = np.full((2, padded.shape[1] // strips), np.nan)
    parts = [part for strip in np.split(padded, strips, axis=1) for part in (strip, gap)][:-1]
    folded = np.concatenate(parts)
    measured = np.isfinite(folded).any()
    azimuths = np.unwrap(np.arctan2(directions[shifts.argmin(), :, 0], directions[shifts.argmin(), :, 2]))
    first, arc = np.degrees((azimuths[0], (azimuths[-1] - azimuths[0]) * len(azimuths) / max(len(azimuths) - 1, 1)))
    low, high = np.exp(np.nanpercentile(folded, [1, 99])) if measured else (np.nan, np.nan)
    caption = f"Range over a turn of the scanner, unrolled: {len(ranges)} rings, {arc:.0f}° from azimuth {first:.0f}°"
    caption += f", {low:.1f} m (dark) to {high:.1f} m (bright)." if measured else ", no reading."
    fraction = _stretched(folded) if measured else folded
    return Picture(png(*_indexed(fraction, palette.color_table("viridis"))), caption, "the turn, unrolled")


def _rows_per_ring(directions: np.ndarray) -> int:
    """Pixel rows per ring for which angles are about as large upwards as sideways."""
    if min(directions.shape[:2]) < 2:
        return MAX_ROW_REPEATS
    upwards = np.abs(np.diff(np.sort(np.arcsin(np.clip(directions[:, 0, 1], -1, 1))))).mean()
    sideways = np.linalg.norm(np.diff(directions[:1], axis=1), axis=-1).mean()
    return int(np.clip(np.rint(upwards / max(sideways, 1e-12)), 1, MAX_ROW_REPEATS))


def error_map(measurement: Measurement, table: np.ndarray) -> str:
    """PNG, as a data URI, of the errors of depth."""
    return color_map(palette.error_fraction(measurement.image.z - measurement.truth.z), table)


def cause_map(measurement: Measurement) -> tuple[str, list[LegendEntry]]:
    """PNG, as a data URI, of the causes of failed pixels, and its legend."""
    classes = palette.outcomes(measurement)
    return png(classes, palette.OUTCOME_COLORS), _legend(classes, palette.OUTCOME_NAMES, palette.OUTCOME_COLORS)


def captured_frames(captured: Captured) -> list[Picture]:
    """Pictures of a few representative frames of a capture, all with the same white; of several cameras, of each."""
    pictures = []
    for number, capture in enumerate(captured.captures, 1):
        names = capture.sensor.frame_names()
        chosen = [i for i in capture.sensor.representative_frames(capture.frames) if 0 <= i < len(names)]
        white = max(float(np.percentile(capture.frames[i], 99.5)) for i in chosen)
        camera = f", camera {number}" if len(captured.captures) > 1 else ""
        for i in chosen:
            caption = names[i].replace("_", " ") + camera
            pictures.append(Picture(grey(capture.frames[i], white, capture.black_level), caption, names[i] + camera))
    return pictures


def light_pictures(energy: EnergySplit) -> list[Picture]:
    """Pictures of the radiance by the kind of light path, all with the same white.

    The captions state the fraction of each kind in the emitter's light.
    """
    white = _bright(energy.projector)
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
            grey(image, white),
            f"{name}: {meaning}; {100 * float(image.sum()) / total:.1f} % of the emitter’s light in the image",
            name,
        )
        for name, (meaning, image) in kinds.items()
        if total > 0 and image.max() > 0
    ]
    if energy.ambient.max() > 0:
        ratio = 100 * float(energy.ambient.sum()) / total if total > 0 else float("inf")
        text = f"ambient: all other light, before any filter; {ratio:.0f} % of the emitter’s light"
        pictures.append(Picture(grey(energy.ambient, white), text, "ambient"))
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
