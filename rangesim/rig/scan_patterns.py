# SPDX-License-Identifier: Apache-2.0
"""Directions and times of the rays of scanning instruments: turning heads, oscillating mirrors, rotating prisms.

Each function returns a table of rays, in the coordinates of the instrument as OpenCV has them: x right, y down, z
forward. Azimuth 0 is z and grows to the right, towards x. Seen from above, a head that turns that way turns clockwise,
as those of Ouster and Velodyne do. Elevation grows upwards, towards -y.

The rows of a table are rings (beams) of a turning head; for the other scanners they are stretches of time.

Examples
--------
A turn of a head with two rings:

>>> rays = spinning(np.radians([10.0, -10.0]), columns=4, period_s=0.1)
>>> rays.directions.shape, rays.times_s[0]
((2, 4, 3), array([0.   , 0.025, 0.05 , 0.075]))
>>> rays.directions[1, 1].round(3) + 0  # the second ring, after a quarter of the turn: right and down
array([0.985, 0.174, 0.   ])
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangesim.settings import limits
from rangesim.settings.bounds import HERTZ, SECONDS, Bounds, check_number, whole
from rangesim.settings.config import shown

Array = NDArray[np.float64]
"""An array of float64."""

ANGLE = Bounds("an angle in radians", -8 * np.pi, 8 * np.pi)
"""Bounds of an angle; four turns either way exclude only degrees that were given for radians."""
AMPLITUDE = Bounds("an angle from 0 to a right angle", 0, np.pi / 2)
"""Bounds of the deflection of a beam, radians: a scanner in front of which the beam turns back is none of these."""
ORIGIN_M = Bounds("an offset in metres", -10, 10)
"""Bounds of the place of a beam in its instrument, metres; they exclude only millimetres that were given for metres."""
RATE_HZ = Bounds("a rate of turning in hertz", -1e6, 1e6)
"""Bounds of the rate at which a prism rotates; its sign is the direction."""
INDEX = Bounds("a refractive index", 1, 5)
"""Bounds of the refractive index of a prism: germanium, the highest in use, has 4.0."""


class ScanRays(NamedTuple):
    """The rays of a scanner: where they begin, where they lead, and when each is sent.

    directions : (h, w, 3) float64, unit vectors, coordinates of the instrument.
    origins : (h, w, 3) float64, metres, coordinates of the instrument; None: all rays begin at the origin.
    times_s : (h, w) float64, seconds after the first ray; None: all rays at once.
    """

    directions: Array
    origins: Array | None
    times_s: Array | None


# ---- A head that turns ----------------------------------------------------------------------------------------------


def spinning(
    elevations_rad: ArrayLike,
    columns: int,
    period_s: float,
    azimuth_offsets_rad: ArrayLike = 0.0,
    origin_offset_m: ArrayLike = (0.0, 0.0, 0.0),
    firing_times_s: ArrayLike = 0.0,
    first_azimuth_rad: float = 0.0,
    arc_rad: float = 2 * np.pi,
) -> ScanRays:
    """The rays of a head that turns at an even rate: ring i and column j are row i and column j of the table.

    At time t the head points to the azimuth a(t) = first_azimuth + arc t / period. Ring i fires for column j at
    t = j period / columns + firing_times[i], to the azimuth a(t) + azimuth_offsets[i], from the place to which
    origin_offset has turned by a(t).

    Parameters
    ----------
    elevations_rad : (h,) float, elevation of each ring, radians, up is positive; in the order of the rows.
    columns : int, measurements of a turn, w.
    period_s : float, duration of the turn, seconds.
    azimuth_offsets_rad : float or (h,) float, by which a ring's beam leads the head, radians, to the right.
    origin_offset_m : (3,) or (h, 3) float, where beams begin when the head points to azimuth 0, metres: (0, 0, n) for a
        beam that begins n in front of the axis, (0, -y, 0) for one that begins y above.
    firing_times_s : float or (h,) float, seconds between the moment of the column and the moment at which a ring fires;
        the head turns on meanwhile.
    first_azimuth_rad : float, where the head points at time 0, radians.
    arc_rad : float, by which the head turns in `period_s`, radians; negative if it turns to the left.

    Returns
    -------
    ScanRays
        `origins` is None if all offsets are 0.

    Raises
    ------
    ValueError
        An argument is not finite, is out of its bounds, or has another shape; or the table has more rays than
        `rangesim.settings.limits` allows pixels.

    Notes
    -----
    The model of Ouster ("Lidar range to XYZ", Software User Manual): elevations are `beam_altitude_angles`, azimuth
    offsets `beam_azimuth_angles`, the offset `lidar_origin_to_beam_origin_mm`. A VLP-16 fires its 16 rings one after
    the other, 2.304 µs apart (VLP-16 User Manual, "Precision azimuth calculation"), and its beams begin at different
    heights.

    Examples
    --------
    The beams begin 15.806 mm in front of the axis:

    >>> rays = spinning([0.0], columns=4, period_s=0.1, origin_offset_m=(0, 0, 0.015806))
    >>> rays.origins[0, 1].round(6) + 0
    array([0.015806, 0.      , 0.      ])
    """
    elevations = _per_ring("elevations_rad", elevations_rad, Bounds("an elevation in radians", -np.pi / 2, np.pi / 2))
    if np.ndim(elevations_rad) != 1 or not elevations.size:
        raise ValueError(f"expected elevations_rad of shape (rings,), got {np.shape(elevations_rad)}.")
    check_number("columns", columns, whole(1))
    check_number("period_s", period_s, SECONDS)
    check_number("first_azimuth_rad", first_azimuth_rad, ANGLE)
    check_number("arc_rad", arc_rad, ANGLE)
    rings = len(elevations)
    limits.check("pixels", rings * columns, f"rays, not {rings} x {columns}")
    leads = _per_ring("azimuth_offsets_rad", azimuth_offsets_rad, ANGLE, rings)
    delays = _per_ring("firing_times_s", firing_times_s, Bounds("0 or positive", 0, period_s), rings)
    times = np.arange(columns) * (period_s / columns) + delays[:, None]
    heads = first_azimuth_rad + arc_rad / period_s * times
    azimuths, up = heads + leads[:, None], elevations[:, None]
    directions = np.stack(
        [np.cos(up) * np.sin(azimuths), np.broadcast_to(-np.sin(up), heads.shape), np.cos(up) * np.cos(azimuths)],
        axis=-1,
    )
    return ScanRays(directions, _turned(origin_offset_m, heads), times)


def _per_ring(name: str, values: ArrayLike, bounds: Bounds, rings: int | None = None) -> Array:
    """(rings,) float64 of a number or of one number per ring, checked."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"expected {name} to be numbers, got {shown(values)}.") from None
    if rings is not None and array.shape not in ((), (rings,)):
        raise ValueError(f"expected {name} to be a number or of shape ({rings},), got {array.shape}.")
    bad = ~(np.isfinite(array) & (array >= bounds.low) & (array <= bounds.high))
    if bad.any():
        raise ValueError(f"expected {name} to be {bounds}, got {array[bad].flat[0]:g}.")
    return array if rings is None else np.broadcast_to(array, (rings,))


def _turned(offset_m: ArrayLike, heads: Array) -> Array | None:
    """(h, w, 3) offsets turned to azimuths (h, w) about the y axis; None if all are 0."""
    offset = _per_ring("origin_offset_m", offset_m, ORIGIN_M)
    if offset.shape not in ((3,), (len(heads), 3)):
        raise ValueError(f"expected origin_offset_m of shape (3,) or ({len(heads)}, 3), got {offset.shape}.")
    if not offset.any():
        return None
    x, y, z = (np.broadcast_to(offset, (len(heads), 3))[:, None, k] for k in range(3))
    cos, sin = np.cos(heads), np.sin(heads)
    return np.stack([x * cos + z * sin, np.broadcast_to(y, heads.shape), z * cos - x * sin], axis=-1)


def column_shifts(directions: ArrayLike) -> NDArray[np.int64]:
    """Columns by which the rows of a turning head's image are shifted to the right, so that columns are directions.

    A ring whose beam leads the head by n columns looks where the head will be n columns later (Ouster calls the shifts
    `pixel_shift_by_row`). The smallest shift is 0.

    directions : (h, w, 3) float, rays as `spinning` has them, of a whole turn or of an arc.

    Examples
    --------
    >>> rays = spinning([0.1, 0.0], columns=360, period_s=0.1, azimuth_offsets_rad=np.radians([3.0, -1.0]))
    >>> column_shifts(rays.directions)
    array([4, 0])
    """
    rays = np.asarray(directions, dtype=np.float64)
    turns = rays[..., 2] + 1j * rays[..., 0]  # the azimuth as the angle of a complex number
    step = np.angle((turns[:, 1:] * turns[:, :-1].conj()).sum()) if turns.shape[1] > 1 else 0.0
    leads = np.angle((turns * turns[0].conj()).sum(axis=1))
    shifts = np.rint(leads / step).astype(np.int64) if step else np.zeros(len(turns), dtype=np.int64)
    return shifts - shifts.min()


# ---- A mirror that oscillates ---------------------------------------------------------------------------------------


def lissajous(
    fast_hz: float,
    slow_hz: float,
    amplitudes_rad: tuple[float, float],
    samples: int | tuple[int, int],
    duration_s: float | None = None,
    phase_rad: float = 0.0,
) -> ScanRays:
    """The rays of a mirror that oscillates about two axes at resonance (MEMS), at even steps of time.

    At time t the beam's azimuth is amplitudes[0] sin(2 pi fast t + phase) and its elevation amplitudes[1] sin(2 pi slow
    t). If fast / slow is a ratio p / q of whole numbers without a common divisor, the figure closes after q / slow.

    Parameters
    ----------
    fast_hz, slow_hz : float, frequencies of the azimuth and of the elevation, hertz.
    amplitudes_rad : largest azimuth and largest elevation of the beam, radians. The beam turns by twice the angle of
        the mirror.
    samples : number of rays n, for a table (1, n); or rows and columns (h, w), in which the rays follow each other row
        by row.
    duration_s : float, seconds in which all rays are sent; None: one period of the elevation.
    phase_rad : float, phase of the azimuth at time 0, radians.

    Raises
    ------
    ValueError
        An argument is not finite or is out of its bounds; or there are more rays than `rangesim.settings.limits` allows
        pixels.

    Examples
    --------
    >>> rays = lissajous(200.0, 100.0, np.radians([30.0, 10.0]), samples=8)
    >>> rays.times_s.shape, float(rays.times_s[0, 1])
    ((1, 8), 0.00125)
    >>> np.degrees(np.arctan2(rays.directions[0, 1, 0], rays.directions[0, 1, 2])).round(6)
    np.float64(30.0)
    """
    for name, hertz in (("fast_hz", fast_hz), ("slow_hz", slow_hz)):
        check_number(name, hertz, HERTZ)
    check_number("phase_rad", phase_rad, ANGLE)
    across, up = _pair("amplitudes_rad", amplitudes_rad, AMPLITUDE)
    times = _times(samples, 1 / slow_hz if duration_s is None else duration_s)
    azimuth = across * np.sin(2 * np.pi * fast_hz * times + phase_rad)
    elevation = up * np.sin(2 * np.pi * slow_hz * times)
    cos = np.cos(elevation)
    directions = np.stack([cos * np.sin(azimuth), -np.sin(elevation), cos * np.cos(azimuth)], axis=-1)
    return ScanRays(directions, None, times)


# ---- Two prisms that rotate -----------------------------------------------------------------------------------------


def risley(
    deflections_rad: tuple[float, float],
    rates_hz: tuple[float, float],
    samples: int | tuple[int, int],
    duration_s: float,
    phases_rad: tuple[float, float] = (0.0, 0.0),
) -> ScanRays:
    """The rays behind two thin wedge prisms that rotate about z (Risley prisms): a rosette, at even steps of time.

    A thin prism turns the beam by a fixed angle towards its thick side, whatever the beam's direction. So the two
    angles add up as vectors: the angle from the axis lies between |d1 - d2| and d1 + d2.

    Parameters
    ----------
    deflections_rad : angles d1 and d2 by which the prisms turn the beam, radians; (n - 1) times the angle of the wedge.
    rates_hz : rates at which the prisms rotate, hertz; positive from x to y, clockwise as the instrument sees it.
    samples : number of rays n, for a table (1, n); or rows and columns (h, w), in which the rays follow each other row
        by row.
    duration_s : float, seconds in which all rays are sent.
    phases_rad : where the thick sides are at time 0, radians from x towards y.

    Raises
    ------
    ValueError
        An argument is not finite or is out of its bounds; or there are more rays than `rangesim.settings.limits` allows
        pixels.

    Notes
    -----
    First-order theory: G. F. Marshall, "Risley prism scan patterns", Proc. SPIE 3787 (1999). `risley_prisms` follows
    the refraction, which differs by degrees where the prisms turn the beam by ten degrees and more.

    Examples
    --------
    >>> rays = risley(np.radians([10.0, 9.0]), rates_hz=(100.0, -60.0), samples=1000, duration_s=0.1)
    >>> off_axis = np.degrees(np.arccos(rays.directions[..., 2]))
    >>> bool(off_axis.min() >= 1), bool(off_axis.max() <= 19.000001)
    (True, True)
    """
    first, second = _pair("deflections_rad", deflections_rad, AMPLITUDE)
    if first + second > np.pi / 2:
        raise ValueError(
            f"expected deflections_rad to add up to at most a right angle, got {first:g} and {second:g} rad."
        )
    times = _times(samples, duration_s)
    angle1, angle2 = _rotations(rates_hz, phases_rad, times)
    x = first * np.cos(angle1) + second * np.cos(angle2)
    y = first * np.sin(angle1) + second * np.sin(angle2)
    off_axis = np.hypot(x, y)
    sine = np.sinc(off_axis / np.pi)  # sin(off_axis) / off_axis
    return ScanRays(np.stack([x * sine, y * sine, np.cos(off_axis)], axis=-1), None, times)


def risley_prisms(
    wedges_rad: tuple[float, float],
    indices: tuple[float, float],
    rates_hz: tuple[float, float],
    samples: int | tuple[int, int],
    duration_s: float,
    phases_rad: tuple[float, float] = (0.0, 0.0),
) -> ScanRays:
    """The rays behind two wedge prisms that rotate about z, refracted at their four faces, at even steps of time.

    The beam arrives along z. Each prism has its first face perpendicular to the axis and its second face tilted by the
    angle of the wedge. Where the beam leaves the last face differs by millimetres between directions; this is left out.

    Parameters
    ----------
    wedges_rad : angles of the two prisms, radians.
    indices : refractive indices of the two prisms in air, dimensionless.
    rates_hz, samples, duration_s, phases_rad : as for `risley`.

    Raises
    ------
    ValueError
        An argument is not finite or is out of its bounds; a prism reflects the beam totally; or there are more rays
        than `rangesim.settings.limits` allows pixels.

    Notes
    -----
    Snell's law in vector form at each face, as in the model of R. G. Brazeal, B. E. Wilkinson and H. H. Hochmair, "A
    rigorous observation model for the Risley prism-based Livox Mid-40 lidar sensor", Sensors 21, 4722 (2021).

    Examples
    --------
    >>> rays = risley_prisms((0.2, 0.2), (1.5, 1.5), rates_hz=(0.0, 0.0), samples=1, duration_s=1.0)
    >>> float(np.arcsin(rays.directions[0, 0, 0]).round(4))  # about 2 (n - 1) wedge = 0.2
    0.209
    """
    wedges = _pair("wedges_rad", wedges_rad, AMPLITUDE)
    glass = _pair("indices", indices, INDEX)
    times = _times(samples, duration_s)
    axis = np.array([0.0, 0.0, 1.0])
    rays = np.broadcast_to(axis, (*times.shape, 3))
    for wedge, index, angle in zip(wedges, glass, _rotations(rates_hz, phases_rad, times), strict=True):
        out = np.stack(
            # the glass is thickest towards `angle`, so its second face looks away from there
            [-np.sin(wedge) * np.cos(angle), -np.sin(wedge) * np.sin(angle), np.full(angle.shape, np.cos(wedge))],
            axis=-1,
        )
        rays = _refracted(_refracted(rays, axis, 1 / index), out, index)
        if np.isnan(rays).any():
            raise ValueError(
                f"expected prisms that let the beam through, got a wedge of {wedge:g} rad and index {index:g} with "
                "total reflection."
            )
    return ScanRays(rays, None, times)


def _refracted(rays: Array, normals: Array, ratio: float) -> Array:
    """Unit rays (..., 3) behind a face of normal n, which points along the rays; NaN where all is reflected.

    ratio : index before the face divided by the index behind it, m. Snell: m d + (c' - m c) n with c = d . n and
        c'^2 = 1 - m^2 (1 - c^2).
    """
    cosine = (rays * normals).sum(axis=-1, keepdims=True)
    squared = 1 - ratio**2 * (1 - cosine**2)
    behind = np.sqrt(np.where((squared >= 0) & (cosine > 0), squared, np.nan))
    bent = ratio * rays + (behind - ratio * cosine) * normals
    return np.asarray(bent / np.linalg.norm(bent, axis=-1, keepdims=True))


def _rotations(rates_hz: tuple[float, float], phases_rad: tuple[float, float], times: Array) -> tuple[Array, Array]:
    """Angles of the two thick sides at times, radians from x towards y."""
    rates, phases = _pair("rates_hz", rates_hz, RATE_HZ), _pair("phases_rad", phases_rad, ANGLE)
    first, second = (2 * np.pi * rate * times + phase for rate, phase in zip(rates, phases, strict=True))
    return first, second


def _pair(name: str, values: ArrayLike, bounds: Bounds) -> tuple[float, float]:
    """Two checked numbers."""
    array = _per_ring(name, values, bounds)
    if array.shape != (2,):
        raise ValueError(f"expected {name} to be two numbers, got {shown(values)}.")
    return float(array[0]), float(array[1])


def _times(samples: int | tuple[int, int], duration_s: float) -> Array:
    """(h, w) moments at even steps from 0, row by row; the step after the last would be at `duration_s`."""
    check_number("duration_s", duration_s, SECONDS)
    shape = samples if isinstance(samples, (tuple, list)) else (1, samples)
    if len(shape) != 2:
        raise ValueError(f"expected samples to be a number, or rows and columns, got {shown(samples)}.")
    for size in shape:
        check_number("samples", size, whole(1))
    total = shape[0] * shape[1]
    limits.check("pixels", total, f"rays, not {shown(total)}")
    return np.linspace(0.0, duration_s, total, endpoint=False).reshape(shape)
