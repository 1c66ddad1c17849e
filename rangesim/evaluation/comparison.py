# SPDX-License-Identifier: Apache-2.0
"""Comparison of a range image with the ground truth, by object and by material class."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from rangesim.decoding.range_image import RangeImage
from rangesim.evaluation.depth_edges import depth_edges
from rangesim.evaluation.neighbourhood import Neighbourhood, neighbourhood
from rangesim.evaluation.surface_rows import index_of_row, with_mean_over_objects
from rangesim.rig import is_same_pose
from rangesim.settings.config import ShortRepr
from rangesim.signals import GroundTruth, Signals, Surface

TOLERANCE_M = 0.010
"""Largest error of a right reading, in metres, unless the task states another one.

The value is a choice, not a measurement. It decides what fraction of the pixels is called wrong, so every table states
the tolerance.
"""
EDGE_RADIUS = 2
"""Distance from a depth edge, in pixels, within which a pixel can be a flying pixel.

A larger radius counts more correct readings beside the edge, and so lowers the rate of flying pixels. Other
values were not measured.
"""


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of the errors on one surface. A value is NaN where there are no pixels to compute it from.

    Parameters
    ----------
    kind, name : str, what the row is about: "object" or "part" and its name; "material" and the class of the first
        surface behind the pixel; "all", all surfaces; or "objects", the mean over objects, each of the same weight
        (`rangesim.evaluation.surface_rows.with_mean_over_objects`).
    pixels : int, number of pixels with a true depth.
    lit : int, number of those pixels that the emitter lights; the others lie in its shadow or outside its field.
    right, wrong, missing : fractions of all pixels, lit or not, which add up to 1: with a reading whose error is at
        most `tolerance_m`, with a reading and a larger error, without a reading. A reading is z of a pinhole camera,
        and the range along the ray of a scanner and of zones (`rangesim.RangeImage.reading_m`).
    completeness : fraction of the lit pixels that have a reading, right or wrong.
    bias_m : mean error of the readings, metres, over all pixels with a reading, lit or not.
    median_abs_m, rmse_m, p95_abs_m : median, root mean square and 95th percentile of the absolute errors, metres.
    edge_pixels : int, number of pixels with a reading within `EDGE_RADIUS` pixels of a depth edge.
    flying_rate : fraction of the edge pixels that are flying pixels: their z differs by more than `tolerance_m` from
        every true depth in the window of 5 x 5 pixels, so that they lie on neither side of the edge.
    invented_readings : int, number of pixels with a reading that see no surface of the scene, in the row "all"; None in
        the others. `pixels` and the fractions are of pixels that see a surface, so they do not count these.
    """

    kind: str
    name: str
    pixels: int
    lit: int
    right: float
    wrong: float
    missing: float
    completeness: float
    bias_m: float
    median_abs_m: float
    rmse_m: float
    p95_abs_m: float
    edge_pixels: int
    flying_rate: float
    invented_readings: int | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(ShortRepr):
    """Statistics of the errors of a range image per object and per material class, and its error map.

    table : tuple of ErrorStatistics: the mean over objects, objects, parts, material classes, "all".
    error_m : (h, w) float32, metres, reading - true reading; NaN where there is no reading or no true surface.
    flying : (h, w) bool, flying pixels.
    tolerance_m : float, metres, largest error of a right reading.
    """

    table: tuple[ErrorStatistics, ...]
    error_m: np.ndarray
    flying: np.ndarray
    tolerance_m: float

    def rows(self) -> list[dict[str, Any]]:
        """One dict per row of the table, as JSON can hold it: None in place of NaN."""
        return [
            {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in vars(row).items()}
            for row in self.table
        ]

    def row(self, name: str, kind: str | None = None) -> ErrorStatistics:
        """Statistics of the object, part or material class of this name, or of "objects" or "all".

        Parameters
        ----------
        kind : "object", "part" or "material", if several have this name; None: the one that there is.

        Raises
        ------
        ValueError
            The comparison has no row of this name, or several.
        """
        return self.table[index_of_row([(row.kind, row.name) for row in self.table], name, kind)]


def compare(image: RangeImage, truth: GroundTruth | Signals, tolerance_m: float = TOLERANCE_M) -> Comparison:
    """Errors of a range image against the ground truth, per object, per material class and over all pixels.

    Parameters
    ----------
    image : RangeImage.
    truth : GroundTruth, or the Signals that contain it.
    tolerance_m : float, metres, largest error of a right reading; what the task of the sensor can bear.

    Raises
    ------
    ValueError
        Image and truth differ in size, the signals are those of a camera at another place, or `tolerance_m` is not
        positive.

    Examples
    --------
    `image` is what `rangesim.decode` makes of a capture of these signals:

    >>> from rangesim import compare
    >>> comparison = compare(image, signals)
    >>> [row.name for row in comparison.table if row.kind == "material"]
    ['matte']
    >>> matte = comparison.row("matte")
    >>> matte.right > 0.999, matte.missing
    (True, 0.0)
    >>> compare(image, signals, tolerance_m=1e-9).row("matte").right < 0.5
    True

    References
    ----------
    Flying pixels: Sabov, Krüger: "Identification and correction of flying pixels in range camera data", SCCG
    (2008). They detect flying pixels from the image alone; here the true depths are known.
    """
    if isinstance(truth, Signals):
        there = truth.rig.T_world_camera
        truth = truth.truth
        if image.T_world_camera is not None and not is_same_pose(image.T_world_camera, there):
            raise ValueError("expected the signals that the range image comes from, got those of a camera elsewhere.")
    true_m = truth.z if image.camera is None else image.camera.reading(truth)
    if image.z.shape != truth.z.shape:
        raise ValueError(f"expected ground truth of shape {image.z.shape} as the image, got {truth.z.shape}.")
    if not tolerance_m > 0:
        raise ValueError(f"expected a positive tolerance_m in metres, got {tolerance_m}.")
    error = np.where(image.valid, image.reading_m.astype(np.float64) - true_m, np.nan)
    edge, flying = _flying(image.reading_m, true_m, tolerance_m, neighbourhood(image.camera))
    rows = [
        dict(vars(_statistics(surface, error, truth.projector_visible, edge, flying, tolerance_m)))
        for surface in truth.surfaces()
    ]
    rows[-1]["invented_readings"] = int((image.valid & ~np.isfinite(true_m)).sum())  # the last row is "all"
    table = tuple(ErrorStatistics(**row) for row in with_mean_over_objects(rows))
    return Comparison(table, error.astype(np.float32), flying, tolerance_m)


def _statistics(
    surface: Surface,
    error: np.ndarray,
    visible: np.ndarray,
    edge: np.ndarray,
    flying: np.ndarray,
    tolerance_m: float,
) -> ErrorStatistics:
    """Statistics of the pixels of a surface."""
    error, lit, edge, flying = (image[surface.mask] for image in (error, visible, edge, flying))
    measured = np.isfinite(error)
    at_edge, e = measured & edge, error[measured]
    absolute = np.abs(e)
    median, p95 = np.percentile(absolute, [50, 95]) if e.size else (np.nan, np.nan)
    return ErrorStatistics(
        kind=surface.kind,
        name=surface.name,
        pixels=error.size,
        lit=_count(lit),
        right=_fraction(_count(absolute <= tolerance_m), error.size),
        wrong=_fraction(_count(absolute > tolerance_m), error.size),
        missing=_fraction(error.size - e.size, error.size),
        completeness=_fraction(_count(measured & lit), _count(lit)),
        bias_m=float(e.mean()) if e.size else math.nan,
        median_abs_m=float(median),
        rmse_m=float(np.sqrt(np.mean(e**2))) if e.size else math.nan,
        p95_abs_m=float(p95),
        edge_pixels=_count(at_edge),
        flying_rate=_fraction(_count(at_edge & flying), _count(at_edge)),
    )


def _count(mask: np.ndarray) -> int:
    """Number of pixels of a mask."""
    return int(np.count_nonzero(mask))


def _fraction(part: int, whole: int) -> float:
    """One number of pixels over another; NaN if the second is 0."""
    return part / whole if whole else math.nan


def _flying(
    z: np.ndarray, true_z: np.ndarray, tolerance_m: float, pixels: Neighbourhood
) -> tuple[np.ndarray, np.ndarray]:
    """Two masks, (h, w) bool each: pixels near a depth edge, and flying pixels."""
    far = np.where(np.isfinite(true_z), true_z, np.inf)
    nearest = np.full(z.shape, np.inf)
    measured = np.where(np.isfinite(z), z, np.nan)
    for shifted in pixels.shifted(far, EDGE_RADIUS):
        np.fmin(nearest, np.abs(measured - shifted), out=nearest)
    edges = depth_edges(true_z, tolerance_m, pixels)
    edge = np.any(pixels.shifted(edges, EDGE_RADIUS), axis=0) & np.isfinite(true_z)
    return edge, edge & np.isfinite(measured) & (nearest > tolerance_m)
