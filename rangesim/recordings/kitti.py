# SPDX-License-Identifier: Apache-2.0
"""Sweeps of the KITTI data set (.bin): points of a Velodyne HDL-64E without rings, which their order gives back.

The format: float32 x, y, z, reflectance for each point (A. Geiger, P. Lenz, C. Stiller, R. Urtasun, "Vision meets
robotics: the KITTI dataset", IJRR 32, 2013), x to the front, y to the left, z up, metres. The points of one laser
follow each other, from azimuth 0 to the left around the scanner.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.errors import CloudReadError
from pcgraph.io.driving_sweeps import KITTI_COLUMNS, sweep_table
from pcgraph.plumbing.plain_files import read_file
from rangesim.errors import FileFormatError
from rangesim.point_cloud import PointCloud
from rangesim.settings import limits

MAX_OFF_CONE_RAD = np.radians(0.05)
"""Largest angle between a point and the cone of its ring, radians. In a sweep of KITTI, the points of 46 rings keep
within 0.011 degrees. Neighbouring rings are 0.3 degrees apart, so rings that are cut in the wrong places do not."""
MAX_RINGS = 256
"""Largest number of rings that are found. No scanner has more, but points in another order seem to have more."""
MIN_POINTS = 3
"""Least number of points of a ring whose cone is checked, because two points always lie on some cone."""
MAX_UNCHECKED = 0.1
"""Largest fraction of the points that may lie in rings of fewer than `MIN_POINTS` points. If there are few points, in
any order, most of them lie in such rings."""
MIN_SPREAD = 1.02
"""Least ratio of the farthest to the nearest point of a ring, both measured from the axis, at which its cone is given:
points at one distance lie on many cones."""


class Rings(NamedTuple):
    """The rings of a turning scanner, and the cone of each.

    ring : (n,) uint16, ring of each point, from 0.
    elevations_rad : (rings,) float64, radians, elevation of each beam; NaN for a ring of fewer than three points, or
        whose points are all about as far from the axis.
    heights_m : (rings,) float64, metres, height at which each beam meets the axis (z); NaN likewise.
    """

    ring: NDArray[np.uint16]
    elevations_rad: NDArray[np.float64]
    heights_m: NDArray[np.float64]


def read_kitti(path: str | Path) -> PointCloud:
    """The points of a sweep, (n,), in the scanner's coordinates ("world"), with reflectance and, if found, rings.

    The reflectance, 0 to 1, is the intensity. `ring` is None if the points are not in the order of the scanner; see
    `rings_of_order`. Times are not known: the data set has compensated the motion.

    Raises
    ------
    FileFormatError
        The file cannot be read, or is no list of points.
    """
    content = read_file(path, FileFormatError)
    limits.check("points", len(content) // 16, f"points in {path}", FileFormatError)
    try:
        table = sweep_table(content, KITTI_COLUMNS)
    except CloudReadError as error:
        raise FileFormatError(f"{path}: {error}.") from error
    points = table[:, :3].astype(np.float32)
    rings = rings_of_order(points)
    intensity = table[:, 3].astype(np.float32)
    return PointCloud(points, "world", intensity=intensity, ring=None if rings is None else rings.ring)


def rings_of_order(points: np.ndarray) -> Rings | None:
    """The rings of points that are in the order of a turning scanner, ring after ring; None if they are not.

    A ring ends where the azimuth, 0 to 360 degrees, falls back. This is confirmed by the cone of each ring: a beam of
    elevation e that meets the axis at the height h has its points at z = h + sqrt(x^2 + y^2) tan(e).

    Parameters
    ----------
    points : (n, 3) float, metres, finite; the axis is z, azimuth 0 is x, and the scanner turns to the left (towards y)
        in the order of the points.

    Examples
    --------
    Two beams, of -5 and -10 degrees, 0.2 m above the origin, in a room whose wall is 4 to 8 m away:

    >>> azimuth = np.tile(np.linspace(0, 6, 100), 2)
    >>> wall = 6 + 2 * np.cos(azimuth)
    >>> z = wall * np.repeat(np.tan(np.radians([-5, -10])), 100) + 0.2
    >>> rings = rings_of_order(np.stack([wall * np.cos(azimuth), wall * np.sin(azimuth), z], axis=-1))
    >>> rings.ring[[0, 99, 100]], np.degrees(rings.elevations_rad).round(6)
    (array([0, 0, 1], dtype=uint16), array([ -5., -10.]))
    """
    x, y, z = (np.asarray(points, dtype=np.float64)[:, k] for k in range(3))
    if not len(x):
        return None
    azimuth = np.arctan2(y, x) % (2 * np.pi)
    ring = np.concatenate([[0], np.cumsum(np.diff(azimuth) < -np.pi)])
    count = int(ring[-1]) + 1
    if count > MAX_RINGS:
        return None
    across = np.hypot(x, y)
    sizes = np.bincount(ring)
    if not across.all() or sizes[sizes < MIN_POINTS].sum() > MAX_UNCHECKED * len(x):  # the axis has no azimuth
        return None
    elevations, heights = np.full(count, np.nan), np.full(count, np.nan)
    for number in np.flatnonzero(sizes >= MIN_POINTS):
        own = ring == number
        rho, slopes = across[own], z[own] / across[own]
        # The equations of the cone are divided by rho, so that errors are angles.
        terms = np.stack([1 / rho, np.ones_like(rho)], axis=-1)
        (height, slope), *_ = np.linalg.lstsq(terms, slopes, rcond=None)
        if np.abs(slopes - terms @ [height, slope]).max() > MAX_OFF_CONE_RAD:
            return None
        if rho.max() > MIN_SPREAD * rho.min():
            elevations[number], heights[number] = np.arctan(slope), height
    return Rings(ring.astype(np.uint16), elevations, heights)
