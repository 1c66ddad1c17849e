# SPDX-License-Identifier: Apache-2.0
"""Recordings of Ouster LiDARs: packets in a pcap file, and the sensor's metadata (JSON) beside it.

`pcgraph.io.ouster_packets` reads the packets. The geometry: Ouster, "Software User Manual", section "Coordinate frames
and XYZ calculation".

Examples
--------
>>> sweep = read_ouster("drive.pcap")  # doctest: +SKIP
>>> sweep.to_point_cloud().save("drive.pcd")  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcgraph.errors import CloudReadError
from pcgraph.io.ouster_packets import PROFILES as PROFILES
from pcgraph.io.ouster_packets import PacketLayout as PacketLayout
from pcgraph.io.ouster_packets import SensorMetadata, metadata_of, ouster_turns
from pcgraph.plumbing.plain_files import check_file
from rangesim.errors import FileFormatError
from rangesim.files.text_files import read_json
from rangesim.recordings.lidar_sweep import LidarSweep
from rangesim.rig import Acceptance, Spinning
from rangesim.rig.scan_patterns import ScanRays, spinning
from rangesim.rig.scanners import FIELD_RAD
from rangesim.settings import limits
from rangesim.settings.bounds import check_number, whole


@dataclass(frozen=True, eq=False, repr=False)
class OusterMetadata(SensorMetadata):
    """The layout of a sensor's packets and the geometry of its beams, from its metadata.

    The attributes are those of `pcgraph.io.ouster_packets.SensorMetadata`.
    """

    @property
    def beam_origin_m(self) -> NDArray[np.float64]:
        """(3,) float64, metres, where the beams begin while the head points to azimuth 0, coordinates as OpenCV's."""
        x, y, z = self.beam_origin_lidar_m
        return np.array([-y, -z, x])

    @cached_property
    def rays(self) -> ScanRays:
        """The rays of a turn, (rings, columns), as `spinning` has them: coordinates as OpenCV's, z to the front.

        A turn begins at the back, where the sensor's connector is.
        """
        return spinning(
            self.elevations_rad,
            self.columns,
            self.period_s,
            self.azimuths_rad,
            self.beam_origin_m,
            first_azimuth_rad=np.pi,
        )

    def camera(self, field_rad: tuple[float, float] = FIELD_RAD, acceptance: Acceptance = "gaussian") -> Spinning:
        """The sensor as a camera, with which its measurements are simulated; its rays are `rays`.

        field_rad, acceptance : field of a ray, see `Spinning`; the metadata do not state it.
        """
        return Spinning(
            elevations_deg=tuple(np.degrees(self.elevations_rad).tolist()),
            columns=self.columns,
            period_s=self.period_s,
            azimuth_offsets_deg=tuple(np.degrees(self.azimuths_rad).tolist()),
            origin_m=tuple(self.beam_origin_m.tolist()),
            first_azimuth_deg=180.0,
            field_rad=field_rad,
            acceptance=acceptance,
        )

    @property
    def T_world_camera(self) -> NDArray[np.float64]:
        """(4, 4) float64, maps coordinates of `rays` to Ouster's sensor frame (x front, y left, z up), metres."""
        lidar_of_camera = np.zeros((4, 4))
        lidar_of_camera[[0, 1, 2, 3], [2, 0, 1, 3]] = -1, 1, -1, 1  # x = back = -z, y = right = x, z = up = -y
        return self.T_sensor_lidar @ lidar_of_camera


def load_ouster_metadata(path: str | Path) -> OusterMetadata:
    """The metadata of a sensor from its JSON file; older and newer firmware.

    Raises
    ------
    FileFormatError
        The file cannot be read, lacks a key, or states numbers that are out of bounds or contradict each other; or its
        profile is none of `PROFILES`.
    """
    try:
        found = metadata_of(read_json(path))
        limits.check("pixels", found.rings * found.columns, f"points of a turn, not {found.rings} x {found.columns}")
    except (CloudReadError, ValueError) as error:
        raise FileFormatError(f"{path}: {error}.") from error
    return OusterMetadata(**{field.name: getattr(found, field.name) for field in fields(found)})


def ouster_sweeps(
    path: str | Path, metadata: str | Path | OusterMetadata | None = None, port: int | None = None
) -> Iterator[LidarSweep]:
    """Iterator over the turns in a recording, in little memory. The first and the last one may lack columns.

    Packets that arrive after one of the next turn are left out: their columns count as missing, as do those that the
    sensor marks as invalid.

    Parameters
    ----------
    path : the pcap file.
    metadata : the sensor's metadata or their file; None: the file beside the recording, with the suffix .json.
    port : UDP port to which the packets were sent; None: any, if all packets come from one sensor.

    Raises
    ------
    FileFormatError
        A file cannot be read, the recording has no packets of the size that the metadata state, or it has those of
        another sensor or of several; it is raised at the first step of the iteration, or where the packet is met.
    """
    if metadata is None:
        check_file(path, FileFormatError)
        metadata = Path(path).with_suffix(".json")
        if not metadata.exists():
            raise FileFormatError(f"{path}: expected the sensor's metadata in {metadata.name} beside it, found none.")
    if not isinstance(metadata, OusterMetadata):
        metadata = load_ouster_metadata(metadata)
    check_file(path, FileFormatError)
    try:
        with Path(path).open("rb") as file:
            for turn in ouster_turns(file, metadata, port):
                yield LidarSweep(
                    range_m=turn.range_m,
                    rays=metadata.rays,
                    time_s=turn.time_s,
                    start_ns=turn.start_ns,
                    frame=turn.frame,
                    pixel_shift=metadata.pixel_shift,
                    T_world_camera=metadata.T_world_camera,
                    reflectivity=turn.reflectivity,
                    signal=turn.signal,
                    near_ir=turn.near_ir,
                )
    except CloudReadError as error:
        raise FileFormatError(f"{path}: {error}.") from error
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}.") from error


def read_ouster(
    path: str | Path,
    metadata: str | Path | OusterMetadata | None = None,
    sweep: int = 0,
    port: int | None = None,
) -> LidarSweep:
    """One turn of a recording.

    Parameters
    ----------
    sweep : number of the turn in the recording, from 0. path, metadata, port : as for `ouster_sweeps`.

    Raises
    ------
    FileFormatError
        As for `ouster_sweeps`; or the recording has fewer turns.
    ValueError
        `sweep` is no whole number from 0.
    """
    check_number("sweep", sweep, whole(0))
    count = 0
    for found in ouster_sweeps(path, metadata, port):
        if count == sweep:
            return found
        count += 1
    raise FileFormatError(f"{path}: expected more than {sweep} turns with valid columns, got {count}.")
