# SPDX-License-Identifier: Apache-2.0
"""Scanners as cameras: heads that turn, mirrors that oscillate, prisms that rotate; each ray has a time of its own.

`rangesim.rig.scan_patterns` says where the rays lead. A scanner usually has a `rangesim.rig.Beam` as its emitter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from rangesim.rig.cameras import Acceptance, Camera, PixelRays, finite_array
from rangesim.rig.poses import Array, check_rigid
from rangesim.rig.ray_cameras import FieldAngle, RayTable, ScanningCamera
from rangesim.rig.scan_patterns import ScanRays, column_shifts, lissajous, risley, spinning
from rangesim.settings.bounds import Bounds, Seconds, check_fields, whole

Angles = tuple[Annotated[float, Bounds("an angle in degrees", -3600, 3600)], ...]
"""Angles in degrees; ten turns either way exclude only nonsense."""
Offset = Annotated[float, Bounds("metres", -10, 10)]
"""Offset of a ray's origin from the axis of a head, metres; the bounds only exclude millimetres given for metres."""
Rate = Annotated[float, Bounds("a rate in hertz", -1e6, 1e6)]
"""Rate of an oscillation or rotation, hertz; the sign of a rotation is its direction."""
FIELD_RAD = (3e-3, 3e-3)
"""Default field of a ray, radians: that of an Ouster OS1 (data sheet: 0.18 degrees). Others have 1 to 3 mrad."""


@dataclass(frozen=True)
class Spinning(ScanningCamera):
    """A head that turns, such as those of Ouster and Velodyne: a row for each ring, a column for each moment.

    Angles are in degrees, as in data sheets. Columns follow each other in time, from azimuth `first_azimuth_deg` to the
    right (clockwise from above).

    Parameters
    ----------
    elevations_deg : elevation of each ring, degrees, up is positive, in the order of the rows.
    columns : int, measurements of a turn.
    period_s : float, duration of the turn, seconds.
    azimuth_offsets_deg : by which each ring's beam leads the head, degrees; empty: all 0.
    origin_m : (x, y, z) float, metres, where the beams start when the head points along z.
    firing_times_s : seconds between the moment of the column and the moment at which each ring fires; empty: all 0.
    first_azimuth_deg, arc_deg : float, degrees, where the head points first, and how far it turns.
    field_rad : (along x, along y) float, radians, full widths of the field of a ray.
    acceptance : "box" or "gaussian".

    Raises
    ------
    ValueError
        A value out of its bounds, or too many rays.

    Examples
    --------
    >>> head = Spinning(elevations_deg=(2.0, 0.0, -2.0), columns=360, period_s=0.1)
    >>> head.height, head.width, float(head.times_s[0, 90])
    (3, 360, 0.025)
    >>> head.pixel_rays().directions[1, 90].round(6) + 0  # to the right
    array([1., 0., 0.])
    """

    elevations_deg: Angles
    columns: Annotated[int, whole(1, "pixels")]
    period_s: Seconds = 0.1
    azimuth_offsets_deg: Angles = ()
    origin_m: tuple[Offset, Offset, Offset] = (0.0, 0.0, 0.0)
    firing_times_s: tuple[Annotated[float, Bounds("0 or positive", 0, 1e6)], ...] = ()
    first_azimuth_deg: Annotated[float, Bounds("an angle in degrees", -360, 360)] = 0.0
    arc_deg: Annotated[float, Bounds("an angle in degrees", -360, 360)] = 360.0
    field_rad: tuple[FieldAngle, FieldAngle] = FIELD_RAD
    acceptance: Acceptance = "box"

    type_name: ClassVar[str] = "spinning"

    def __post_init__(self) -> None:
        check_fields(self)
        if self.elevations_deg and max(map(abs, self.elevations_deg)) > 90:
            steepest = max(self.elevations_deg, key=abs)
            raise ValueError(f"expected elevations_deg of -90 to 90 degrees, got {steepest:g}.")
        for name in ("azimuth_offsets_deg", "firing_times_s"):
            if (given := len(getattr(self, name))) not in (0, self.height):
                raise ValueError(
                    f"expected {name} for each of the {self.height} elevations_deg, or none, got {given} numbers."
                )
        self.scan_rays()  # checks the rest

    @property
    def width(self) -> int:  # type: ignore[override]
        return self.columns

    @property
    def height(self) -> int:  # type: ignore[override]
        return len(self.elevations_deg)

    @property
    def rings(self) -> NDArray[np.uint16]:
        return np.broadcast_to(np.arange(self.height, dtype=np.uint16)[:, None], (self.height, self.width))

    @property
    def lattice(self) -> NDArray[np.int64]:
        rows = np.argsort(-np.asarray(self.elevations_deg), kind="stable")
        shifts = column_shifts(self.rays.directions)
        columns = (np.arange(self.width) - shifts[rows, None]) % self.width
        return rows[:, None] * self.width + columns

    def scan_rays(self) -> ScanRays:
        return spinning(
            np.radians(self.elevations_deg),
            self.columns,
            self.period_s,
            np.radians(self.azimuth_offsets_deg) if self.azimuth_offsets_deg else 0.0,
            self.origin_m,
            self.firing_times_s or 0.0,
            np.radians(self.first_azimuth_deg),
            np.radians(self.arc_deg),
        )


class SampledScanner(ScanningCamera):
    """A scanner whose samples follow each other in time, row by row of the table; the rows mean nothing else.

    Subclasses have the fields `rows` and `columns`.
    """

    rows: int
    columns: int

    has_neighbours: ClassVar[bool] = False

    @property
    def width(self) -> int:  # type: ignore[override]
        return self.columns

    @property
    def height(self) -> int:  # type: ignore[override]
        return self.rows


@dataclass(frozen=True)
class Lissajous(SampledScanner):
    """A mirror that oscillates about two axes at resonance (MEMS).

    Parameters
    ----------
    rows, columns : int, shape of the table; the samples follow each other in time, row by row.
    fast_hz, slow_hz : float, hertz, rates of the horizontal and the vertical oscillation.
    amplitudes_deg : (horizontal, vertical) float, degrees, largest deflections of the beam.
    duration_s : float, seconds, of the whole table.
    field_rad, acceptance : field of a ray, see `Spinning`.

    Examples
    --------
    >>> mirror = Lissajous(10, 100, fast_hz=1e4, slow_hz=500.0, amplitudes_deg=(35.0, 27.0), duration_s=1e-3)
    >>> mirror.times_s.shape
    (10, 100)
    """

    rows: Annotated[int, whole(1, "pixels")]
    columns: Annotated[int, whole(1, "pixels")]
    fast_hz: Rate
    slow_hz: Rate
    amplitudes_deg: tuple[
        Annotated[float, Bounds("0 to 90 degrees", 0, 90)], Annotated[float, Bounds("0 to 90 degrees", 0, 90)]
    ]
    duration_s: Seconds
    field_rad: tuple[FieldAngle, FieldAngle] = FIELD_RAD
    acceptance: Acceptance = "box"

    type_name: ClassVar[str] = "lissajous"

    def scan_rays(self) -> ScanRays:
        horizontal, vertical = np.radians(self.amplitudes_deg)
        size = self.rows, self.columns
        return lissajous(self.fast_hz, self.slow_hz, (float(horizontal), float(vertical)), size, self.duration_s)


@dataclass(frozen=True)
class Risley(SampledScanner):
    """Two thin wedge prisms that rotate (Risley prisms): a rosette about the axis, as Livox scanners have it.

    Parameters
    ----------
    rows, columns : int, shape of the table; the samples follow each other in time, row by row.
    deflections_deg : float, degrees, by which each prism turns the beam.
    rates_hz : float, hertz, at which the prisms rotate; opposite signs for opposite directions.
    duration_s : float, seconds, of the whole table.
    field_rad, acceptance : field of a ray, see `Spinning`.

    Examples
    --------
    >>> rosette = Risley(10, 100, deflections_deg=(9.0, 9.0), rates_hz=(121.6, -77.8), duration_s=0.1)
    >>> z = rosette.pixel_rays().directions[..., 2]
    >>> np.degrees(np.arccos(z.min())).round(1)
    np.float64(18.0)
    """

    rows: Annotated[int, whole(1, "pixels")]
    columns: Annotated[int, whole(1, "pixels")]
    deflections_deg: tuple[
        Annotated[float, Bounds("0 to 90 degrees", 0, 90)], Annotated[float, Bounds("0 to 90 degrees", 0, 90)]
    ]
    rates_hz: tuple[Rate, Rate]
    duration_s: Seconds
    field_rad: tuple[FieldAngle, FieldAngle] = FIELD_RAD
    acceptance: Acceptance = "box"

    type_name: ClassVar[str] = "risley"

    def scan_rays(self) -> ScanRays:
        first, second = np.radians(self.deflections_deg)
        return risley((float(first), float(second)), self.rates_hz, (self.rows, self.columns), self.duration_s)


@dataclass(frozen=True, eq=False)
class MovingCamera(Camera):
    """A scanner that moves while it scans: its rays in its own coordinates at the start.

    A table of rays that start at their own places needs one light-transport pass, however the scanner moves.

    Parameters
    ----------
    camera : Camera with times, such as `Spinning`.
    poses : (n, 4, 4) float64, rigid, T_start_camera: maps coordinates of the camera at each of its n different times,
        in order, to its coordinates at the start; metres.

    Raises
    ------
    ValueError
        The camera has no times or consists of zones, there is not one pose for each different time, or a pose is not
        rigid.

    Examples
    --------
    A head that moves forward by 15 m/s:

    >>> head = Spinning(elevations_deg=(0.0,), columns=4, period_s=0.1)
    >>> poses = np.tile(np.eye(4), (4, 1, 1))
    >>> poses[:, 2, 3] = 15.0 * np.unique(head.times_s)
    >>> MovingCamera(head, poses).pixel_rays().origins[0, :, 2]
    array([0.   , 0.375, 0.75 , 1.125])
    """

    camera: Camera
    poses: np.ndarray

    type_name: ClassVar[str] = "moving"

    def __post_init__(self) -> None:
        if not isinstance(self.camera, Camera) or self.camera.times_s is None:
            raise ValueError(f"expected a camera whose rays have times, got {type(self.camera).__name__}.")
        if self.camera.traced is not self.camera:
            raise ValueError("expected a camera without zones; make zones of the moving camera instead.")
        times = len(np.unique(self.camera.times_s))
        poses = finite_array(self.poses, "poses", (None, 4, 4))
        if len(poses) != times:
            raise ValueError(f"expected a pose for each of the camera's {times} times, got {len(poses)}.")
        check_rigid(poses, "poses")
        object.__setattr__(self, "poses", poses)

    @property
    def width(self) -> int:  # type: ignore[override]
        return self.camera.width

    @property
    def height(self) -> int:  # type: ignore[override]
        return self.camera.height

    @property
    def acceptance(self) -> Acceptance:  # type: ignore[override]
        return self.camera.acceptance

    @property
    def has_neighbours(self) -> bool:  # type: ignore[override]
        return self.camera.has_neighbours

    @property
    def times_s(self) -> Array | None:
        return self.camera.times_s

    @property
    def rings(self) -> NDArray[np.uint16] | None:
        return self.camera.rings

    @property
    def lattice(self) -> NDArray[np.int64] | None:
        return self.camera.lattice

    def cropped(self, top: int, bottom: int, left: int, right: int) -> RayTable:
        return RayTable.of(self).cropped(top, bottom, left, right)

    def pixel_rays(self) -> PixelRays:
        """The rays of the camera, each moved to where it is measured."""
        rays, times = self.camera.rays, self.camera.times_s
        assert times is not None
        T = self.poses[np.unique(times, return_inverse=True)[1].reshape(times.shape)]
        rotation, place = T[..., :3, :3], T[..., :3, 3]
        turn = "hwij,hwj->hwi"
        steps = np.einsum("hwij,hwkj->hwki", rotation, rays.steps)
        shift = None if rays.origin_steps is None else np.einsum("hwij,hwkj->hwki", rotation, rays.origin_steps)
        origins = np.einsum(turn, rotation, rays.origins) + place
        return PixelRays(origins, np.einsum(turn, rotation, rays.directions), steps, shift)
