# SPDX-License-Identifier: Apache-2.0
"""Recordings of LiDARs made here: packets of Ouster sensors, bit by bit as the manual has them, in pcap files."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

Block = Sequence[tuple[int, int]]
"""Numbers of one ring's block with their bits, from the least significant bit of the first word upwards."""

SERIAL = 122_150_000_150


def metadata(
    rings: int = 4, columns: int = 32, profile: str = "RNG19_RFL8_SIG16_NIR16", **changed: Any
) -> dict[str, Any]:
    """Metadata as firmware 2 writes them: one table; `changed` replaces or adds keys, those of data_format too."""
    layout = {
        "columns_per_frame": columns,
        "columns_per_packet": 8,
        "pixels_per_column": rings,
        "pixel_shift_by_row": [2 * (row % 2) for row in range(rings)],
        "udp_profile_lidar": profile,
        "column_window": [0, columns - 1],
    }
    data = {
        "prod_sn": str(SERIAL),
        "prod_line": "OS-made",
        "lidar_mode": f"{columns}x10",
        "beam_altitude_angles": np.linspace(20, -15, rings).round(2).tolist(),
        "beam_azimuth_angles": [3.1 - 6.2 * (row % 2) for row in range(rings)],
        "lidar_origin_to_beam_origin_mm": 15.806,
        "lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1],
        "data_format": layout,
    }
    for key, value in changed.items():
        (layout if key in layout else data)[key] = value
    return data


def nested(data: dict[str, Any]) -> dict[str, Any]:
    """The same metadata as firmware 3 writes them: a table of tables."""
    groups = {
        "sensor_info": ("prod_sn", "prod_line"),
        "beam_intrinsics": ("beam_altitude_angles", "beam_azimuth_angles", "lidar_origin_to_beam_origin_mm"),
        "lidar_intrinsics": ("lidar_to_sensor_transform",),
        "config_params": ("lidar_mode",),
    }
    tables = {group: {key: data[key] for key in keys if key in data} for group, keys in groups.items()}
    return {**tables, "lidar_data_format": data["data_format"]}


def block(numbers: Block) -> bytes:
    """The bytes of a block: its numbers one above the other, little end first."""
    whole, at = 0, 0
    for value, bits in numbers:
        assert 0 <= value < 1 << bits
        whole |= value << at
        at += bits
    return whole.to_bytes(at // 8, "little")


def single(range_mm: int, reflectivity: int, signal: int, near_ir: int) -> bytes:
    """Block of RNG19_RFL8_SIG16_NIR16."""
    return block([(range_mm, 19), (0, 13), (reflectivity, 8), (0, 8), (signal, 16), (near_ir, 16), (0, 16)])


def dual(ranges_mm: Sequence[int], reflectivities: Sequence[int], signals: Sequence[int], near_ir: int) -> bytes:
    """Block of RNG19_RFL8_SIG16_NIR16_DUAL."""
    (r1, r2), (f1, f2), (s1, s2) = ranges_mm, reflectivities, signals
    words = [(r1, 19), (0, 5), (f1, 8), (r2, 19), (0, 5), (f2, 8), (s1, 16), (s2, 16), (near_ir, 16), (0, 16)]
    return block(words)


def low_rate(range_8mm: int, reflectivity: int, near_ir_16: int) -> bytes:
    """Block of RNG15_RFL8_NIR8."""
    return block([(range_8mm, 15), (1, 1), (reflectivity, 8), (near_ir_16, 8)])


def legacy(range_mm: int, reflectivity: int, signal: int, near_ir: int) -> bytes:
    """Block of LEGACY."""
    return block([(range_mm, 20), (0, 12), (reflectivity, 16), (signal, 16), (near_ir, 16), (0, 16)])


def column(number: int, time_ns: int, blocks: Iterable[bytes], is_valid: bool = True) -> bytes:
    """A column of any profile but LEGACY."""
    return struct.pack("<QHH", time_ns, number, int(is_valid)) + b"".join(blocks)


def legacy_column(number: int, frame: int, time_ns: int, blocks: Iterable[bytes], is_valid: bool = True) -> bytes:
    """A column of LEGACY."""
    status = struct.pack("<I", 0xFFFFFFFF if is_valid else 0)
    return struct.pack("<QHHI", time_ns, number, frame, 88 * number) + b"".join(blocks) + status


def packet(frame: int, columns: Iterable[bytes], serial: int = SERIAL, is_safety: bool = False) -> bytes:
    """A packet of any profile but LEGACY, with the standard header or that of functional safety."""
    if is_safety:
        header = b"\x01" + bytes(3) + struct.pack("<I", frame) + bytes(3) + serial.to_bytes(5, "little")
    else:
        header = struct.pack("<HH", 1, frame) + bytes(3) + serial.to_bytes(5, "little")
    return header.ljust(32, b"\0") + b"".join(columns) + bytes(32)


def ip_packets(
    payload: bytes, port: int = 7502, source: int = 1, number: int = 7, largest: int = 65_515
) -> list[bytes]:
    """A UDP datagram in one IPv4 packet, or in fragments of at most `largest` bytes (a multiple of 8)."""
    content = struct.pack(">HHHH", 7502, port, 8 + len(payload), 0) + payload
    packets = []
    for start in range(0, len(content), largest):
        part = content[start : start + largest]
        flags = (start // 8) | (0x2000 if start + largest < len(content) else 0)
        addresses = bytes([10, 0, 0, source]) + bytes([10, 0, 0, 2])
        packets.append(struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(part), number, flags, 64, 17, 0) + addresses + part)
    return packets


def pcap(packets: Iterable[bytes], order: str = "<", link: int = 1, header: bytes = bytes(12) + b"\x08\x00") -> bytes:
    """A pcap file of IP packets, each behind a header of its link."""
    content = struct.pack(order + "IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link)
    for one in packets:
        record = header + one
        content += struct.pack(order + "IIII", 0, 0, len(record), len(record)) + record
    return content


def recording(payloads: Iterable[bytes]) -> bytes:
    """A pcap file of datagrams."""
    return pcap([one for number, payload in enumerate(payloads) for one in ip_packets(payload, number=number)])


def small_turns(turns: int = 2) -> list[bytes]:
    """Packets of turns of the sensor of `metadata()`: range 1000 + 100 ring + column mm, numbers as in `single`."""
    packets = []
    for turn in range(turns):
        for first in range(0, 32, 8):
            columns = []
            for j in range(first, first + 8):
                blocks = [single(1000 + 100 * ring + j, ring, 2 * j, 3 * j) for ring in range(4)]
                columns.append(column(j, 10**9 + 100_000_000 * turn + 3_125_000 * j, blocks))
            packets.append(packet(500 + turn, columns))
    return packets
