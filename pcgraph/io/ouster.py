# SPDX-License-Identifier: Apache-2.0
"""Recordings of Ouster LiDARs: packets in a pcap file, and the sensor's metadata (JSON) beside it.

Source of the geometry: Ouster, "Software User Manual", section "Coordinate frames and XYZ calculation". The module
`ouster_packets` reads the packets.
"""

from __future__ import annotations

from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import Cloud
from pcgraph.errors import CloudReadError
from pcgraph.io.format import CloudFile, Format
from pcgraph.io.ouster_packets import OusterTurn, SensorMetadata, columns_of_directions, ouster_turns, read_metadata
from pcgraph.plumbing.plain_files import read_file


def read_ouster(file: CloudFile) -> Cloud:
    """Cloud of one turn in a recording, in the sensor's own frame (x to the front, y to the left, z up).

    It is the first turn with all its columns. If no turn has all, it is the first one with the most columns.

    Raises
    ------
    CloudReadError
        There is no file of metadata beside the recording, with the same name and the suffix ``.json``, or it is
        damaged. Or the recording is not a pcap file, has no packets of that sensor, or has packets of several sensors.
    """
    if file.path is None:
        raise CloudReadError("expected a recording with the sensor's metadata beside it: give the path of a file")
    beside = file.path.with_suffix(".json")
    if not beside.exists():
        raise CloudReadError(f"expected the sensor's metadata in {beside.name} beside the recording, found none")
    try:
        metadata = read_metadata(read_file(beside, CloudReadError))
    except CloudReadError as error:
        raise CloudReadError(f"{beside.name}: {error}") from None
    best: OusterTurn | None = None
    for turn in ouster_turns(BytesIO(file.content), metadata):
        if best is None or turn.columns_measured > best.columns_measured:
            best = turn
        if best.columns_measured == metadata.columns:
            break
    if best is None:
        raise CloudReadError("expected a turn with valid columns, but the sensor marks all as invalid")
    return cloud_of_turn(best, metadata)


def cloud_of_turn(turn: OusterTurn, metadata: SensorMetadata) -> Cloud:
    """Organised cloud (rings, columns) of the first return of each ray of a turn, in the sensor's own frame.

    All points of a column have one direction, not one time: the rows are shifted (destaggered). Points are NaN where
    there was no return. `viewpoint` is the centre of the rotating head. The `columns` of the cloud are

    - ``range``, float32, metres from the origin of the beam
    - ``reflectivity``, ``signal`` and ``near_ir``, uint16, if the sensor sent them
    - ``time``, float64, seconds after the turn's first column; NaN for a missing column
    - ``ring``, uint16
    """
    h, w = turn.range_m.shape[1:]
    source = columns_of_directions(metadata.pixel_shift, w)
    images: dict[str, NDArray[np.generic]] = {"range": turn.range_m[0]}
    for name in ("reflectivity", "signal"):
        returns = getattr(turn, name)
        if returns is not None:
            images[name] = returns[0]
    if turn.near_ir is not None:
        images["near_ir"] = turn.near_ir
    images["time"] = np.broadcast_to(turn.time_s, (h, w))
    images["ring"] = np.broadcast_to(np.arange(h, dtype=np.uint16)[:, None], (h, w))
    points = _points(turn.range_m[0], metadata)
    return Cloud(
        np.take_along_axis(points, source[..., None], axis=1),
        viewpoint=metadata.T_sensor_lidar[:3, 3].copy(),
        columns={name: np.take_along_axis(image, source, axis=1) for name, image in images.items()},
    )


def _points(ranges: NDArray[np.float32], metadata: SensorMetadata) -> NDArray[np.float32]:
    """Points, (h, w, 3) float32, metres, sensor frame, of ranges (h, w) in firing order, by the manual's formula."""
    head = 2 * np.pi * (1 - np.arange(ranges.shape[1]) / ranges.shape[1])  # the encoder's angle, to the left
    azimuth = head - metadata.azimuths_rad[:, None]
    elevation = metadata.elevations_rad[:, None]
    directions = (np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation))
    x, y, z = metadata.beam_origin_lidar_m
    origins = (x * np.cos(head) - y * np.sin(head), x * np.sin(head) + y * np.cos(head), z)
    lidar = np.stack([origin + ranges * along for origin, along in zip(origins, directions, strict=True)], axis=-1)
    rotation, translation = metadata.T_sensor_lidar[:3, :3], metadata.T_sensor_lidar[:3, 3]
    return (lidar @ rotation.T + translation).astype(np.float32)


OUSTER = Format("ouster", (".pcap",), read_ouster, organised=True)
