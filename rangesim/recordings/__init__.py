# SPDX-License-Identifier: Apache-2.0
"""Readers of what real LiDARs recorded: packets of Ouster sensors, sweeps of KITTI."""

from pcgraph.io.pcap import Datagram
from rangesim.recordings.kitti import Rings, read_kitti, rings_of_order
from rangesim.recordings.lidar_sweep import LidarSweep
from rangesim.recordings.ouster import OusterMetadata, load_ouster_metadata, ouster_sweeps, read_ouster
from rangesim.recordings.pcap import datagrams

__all__ = [
    "Datagram",
    "LidarSweep",
    "OusterMetadata",
    "Rings",
    "datagrams",
    "load_ouster_metadata",
    "ouster_sweeps",
    "read_kitti",
    "read_ouster",
    "rings_of_order",
]
