# SPDX-License-Identifier: Apache-2.0
"""Recordings of LiDARs: real ones by their digests, made ones bit by bit, and what is wrong in one sentence."""

from __future__ import annotations

import hashlib
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import (
    SERIAL,
    column,
    dual,
    ip_packets,
    legacy,
    legacy_column,
    low_rate,
    metadata,
    nested,
    packet,
    pcap,
    recording,
    single,
    small_turns,
)

import pcgraph
from rangesim.errors import FileFormatError
from rangesim.recordings import (
    datagrams,
    load_ouster_metadata,
    ouster_sweeps,
    read_kitti,
    read_ouster,
    rings_of_order,
)
from rangesim.recordings.ouster import PROFILES, PacketLayout
from rangesim.rig.scan_patterns import column_shifts, spinning

REAL = ("OS-0-128-U1_v2.3.0_1024x10", "OS-1-32-G_v2.1.1_1024x10")
"""Recordings with digests: one of a low data rate, one of the legacy format."""


def write(folder: Path, content: bytes, data: dict[str, Any] | None = None) -> Path:
    (folder / "drive.json").write_text(json.dumps(metadata() if data is None else data))
    (folder / "drive.pcap").write_bytes(content)
    return folder / "drive.pcap"


# ---- Real recordings ------------------------------------------------------------------------------------------------


def md5(*arrays: np.ndarray) -> str:
    return hashlib.md5(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


@pytest.mark.parametrize("name", REAL)
def test_every_number_of_a_real_recording_has_the_digest_of_its_maker(real_data: Path, name: str) -> None:
    folder = real_data / "lidar"
    known = json.loads((folder / f"{name}_digest.json").read_text())
    layout = PacketLayout(load_ouster_metadata(folder / f"{name}.json"))
    payloads = [d.payload for d in datagrams(folder / f"{name}.pcap") if layout.is_lidar(d.payload)]
    packets = [layout.columns(payload) for payload in payloads]
    kinds = {"range": "u4", "flags": "u1", "reflectivity": "u1", "signal": "u2", "near_ir": "u2"}
    for field, bits in PROFILES[layout.metadata.profile].fields.items():
        values = [bits.read(one["words"]).T.astype(kinds[field]) for one in packets]
        assert md5(*values) == known["packet_hash"][field.upper()], field
        image = np.zeros((layout.metadata.rings, layout.metadata.columns), kinds[field])
        image[:, np.concatenate([one["column"] for one in packets])] = np.concatenate(values, axis=1)
        assert field == "flags" or md5(image) == known["scans"][0][field.upper()], field
    assert md5(*(one["time"] for one in packets)) == known["packet_hash"]["TIMESTAMP"]
    assert md5(*(one["column"] for one in packets)) == known["packet_hash"]["MEASUREMENT_ID"]
    assert md5(*(one["status"].astype("u4") for one in packets)) == known["packet_hash"]["STATUS"]
    assert {str(layout.frames(p, c)[0]) for p, c in zip(payloads, packets, strict=True)} == {
        known["scans"][0]["FRAME_ID"]
    }


def xyz_of_the_manual(data: dict[str, Any], range_mm: np.ndarray) -> np.ndarray:
    """(h, w, 3) metres, sensor frame, by the formula of Ouster's manual (range to XYZ), for all columns."""
    w, n = range_mm.shape[1], data["lidar_origin_to_beam_origin_mm"]
    encoder = 2 * np.pi * (1 - np.arange(w) / w)
    azimuth = -np.radians(data["beam_azimuth_angles"])[:, None]
    altitude = np.radians(data["beam_altitude_angles"])[:, None]
    x = (range_mm - n) * np.cos(encoder + azimuth) * np.cos(altitude) + n * np.cos(encoder)
    y = (range_mm - n) * np.sin(encoder + azimuth) * np.cos(altitude) + n * np.sin(encoder)
    z = (range_mm - n) * np.sin(altitude)
    lidar = np.stack([x, y, z, np.ones_like(x)], axis=-1)
    return np.asarray(lidar @ np.reshape(data["lidar_to_sensor_transform"], (4, 4)).T)[..., :3] / 1000


@pytest.mark.parametrize("name", REAL)
def test_points_are_those_of_the_makers_formula(real_data: Path, name: str) -> None:
    """Rays of `spinning` times the range from their own origin, to 0.1 mm beyond single precision."""
    path = real_data / "lidar" / f"{name}.pcap"
    data = json.loads(path.with_suffix(".json").read_text())
    sweep = read_ouster(path)
    assert sweep.is_complete
    assert sweep.returns == 1
    range_mm = sweep.range_m[0].astype(np.float64) * 1000 + data["lidar_origin_to_beam_origin_mm"]
    expected = xyz_of_the_manual(data, range_mm)
    world = sweep.to_point_cloud(coordinates="world")
    assert world.valid.mean() > 0.7
    assert np.nanmax(np.abs(world.points - expected)) < 1e-4
    camera = sweep.to_point_cloud().points.astype(np.float64)
    moved = camera @ sweep.T_world_camera[:3, :3].T + sweep.T_world_camera[:3, 3]
    assert np.nanmax(np.abs(moved - expected)) < 1e-4


@pytest.mark.parametrize("name", REAL)
def test_a_real_sweep_takes_a_tenth_of_a_second_and_destaggers_to_directions(real_data: Path, name: str) -> None:
    sweep = read_ouster(real_data / "lidar" / f"{name}.pcap")
    steps = np.diff(sweep.time_s)
    assert np.median(steps) == pytest.approx(0.1 / 1024, rel=0.02)
    assert 0.098 < sweep.time_s[-1] < 0.101
    directions = sweep.destaggered(sweep.rays.directions)
    azimuth = np.unwrap(np.arctan2(directions[..., 0], directions[..., 2]), axis=0)
    assert np.degrees(np.ptp(azimuth, axis=0)).max() < 1.5 * 360 / 1024  # shifts are whole columns
    shifts = column_shifts(sweep.rays.directions)
    assert np.ptp(shifts - sweep.pixel_shift) <= 1  # those of the rays are those of the maker, but for rounding
    ranges = sweep.destaggered(sweep.range_m)
    assert ranges.shape == sweep.range_m.shape
    across = np.nanmedian(np.abs(np.diff(ranges[0], axis=0)))
    assert across < np.nanmedian(np.abs(np.diff(sweep.range_m[0], axis=0)))  # neighbours see neighbouring things


@pytest.mark.parametrize("name", REAL)
def test_pcgraph_has_the_same_points(real_data: Path, name: str) -> None:
    """By the formula of the manual, to a step of single precision."""
    path = real_data / "lidar" / f"{name}.pcap"
    cloud = pcgraph.read_cloud(path)
    sweep = read_ouster(path).to_point_cloud(coordinates="world", destaggered=True)
    np.testing.assert_array_equal(np.isnan(cloud.points), np.isnan(sweep.points))
    step = np.spacing(np.float32(np.nanmax(np.abs(sweep.points))))
    assert np.nanmax(np.abs(cloud.points - sweep.points)) <= step
    for mine, theirs in (("time", sweep.time_s), ("ring", sweep.ring), ("reflectivity", sweep.intensity)):
        np.testing.assert_array_equal(cloud.columns[mine], theirs)


def test_a_sweep_of_kitti_gets_its_rings_back(real_data: Path) -> None:
    """46 beams of the HDL-64E, in two blocks of lenses: the upper 32 begin 7 cm above the others."""
    cloud = read_kitti(real_data / "lidar" / "kitti_000008.bin")
    rings = rings_of_order(cloud.points)
    assert rings is not None
    assert cloud.ring is not None
    np.testing.assert_array_equal(cloud.ring, rings.ring)
    assert len(rings.elevations_rad) == 46
    assert (np.diff(rings.elevations_rad) < 0).all()
    heights = rings.heights_m
    assert heights[:32].min() - heights[32:].max() > 0.07
    assert np.ptp(heights[:32]) < 0.015
    assert np.ptp(heights[32:]) < 0.006
    assert cloud.intensity is not None
    assert 0 <= cloud.intensity.min() <= cloud.intensity.max() < 1


# ---- Packets made bit by bit ----------------------------------------------------------------------------------------


def test_turns_come_back_as_they_were_made(tmp_path: Path) -> None:
    sweeps = list(ouster_sweeps(write(tmp_path, recording(small_turns()))))
    assert [sweep.frame for sweep in sweeps] == [500, 501]
    rows, columns = np.indices((4, 32))
    for sweep in sweeps:
        np.testing.assert_allclose(sweep.range_m[0], (1000 + 100 * rows + columns - 15.806) / 1000, rtol=1e-6)
        for found, made in ((sweep.reflectivity, rows), (sweep.signal, 2 * columns), (sweep.near_ir, 3 * columns)):
            np.testing.assert_array_equal(np.squeeze(found), made)
        np.testing.assert_allclose(sweep.time_s, columns[0] * 3.125e-3, atol=1e-12)
    assert sweeps[1].start_ns == 10**9 + 100_000_000
    assert read_ouster(tmp_path / "drive.pcap", sweep=1).frame == 501


def test_both_returns_of_a_dual_profile_are_told_apart(tmp_path: Path) -> None:
    blocks = [dual((2000 + ring, 5000 if ring else 0), (10, 20), (30, 40), 50) for ring in range(4)]
    payload = packet(3, [column(j, 10**6 * j, blocks) for j in range(8)])
    data = metadata(columns=8, profile="RNG19_RFL8_SIG16_NIR16_DUAL")
    sweep = read_ouster(write(tmp_path, recording([payload]), data))
    assert sweep.returns == 2
    assert sweep.reflectivity is not None
    assert sweep.signal is not None
    np.testing.assert_array_equal(sweep.reflectivity[:, 1, 2], [10, 20])
    np.testing.assert_array_equal(sweep.signal[:, 1, 2], [30, 40])
    np.testing.assert_allclose(sweep.range_m[:, 1, 0], [1.985194, 4.984194], rtol=1e-6)
    assert np.isnan(sweep.range_m[1, 0]).all()
    second = sweep.to_point_cloud(return_number=2)
    assert second.points.shape == (4, 8, 3)
    assert second.valid.sum() == 24
    every = sweep.to_point_cloud(return_number=None, intensity="signal")
    assert every.points.shape == (56, 3)
    assert every.return_number is not None
    assert every.intensity is not None
    np.testing.assert_array_equal(every.intensity[every.return_number == 2], 40)
    with pytest.raises(ValueError, match="from 1 to 2, got 3"):
        sweep.to_point_cloud(return_number=3)


def test_low_rates_have_steps_of_8_mm(tmp_path: Path) -> None:
    payload = packet(3, [column(j, j, [low_rate(250, 7, 3)] * 4) for j in range(8)])
    sweep = read_ouster(write(tmp_path, recording([payload]), metadata(columns=8, profile="RNG15_RFL8_NIR8")))
    np.testing.assert_allclose(sweep.range_m, 2 - 0.015806, rtol=1e-6)
    assert sweep.signal is None
    assert sweep.near_ir is not None
    assert np.unique(sweep.near_ir) == [48]
    assert sweep.to_point_cloud(intensity="signal").intensity is None


def test_legacy_packets_may_hold_two_turns(tmp_path: Path) -> None:
    blocks = [legacy(3000, 5, 6, 7)] * 4
    first = [legacy_column(j, 9, j, blocks) for j in range(8, 16)]
    mixed = [legacy_column(j, 9 if j >= 16 else 10, j, blocks) for j in (*range(28, 32), *range(4))]
    data = metadata(profile="LEGACY")
    sweeps = list(ouster_sweeps(write(tmp_path, recording([b"".join(first), b"".join(mixed)]), data)))
    assert [sweep.frame for sweep in sweeps] == [9, 10]
    assert [np.isfinite(sweep.time_s).sum() for sweep in sweeps] == [12, 4]


def test_a_safety_header_is_known_by_the_serial_number(tmp_path: Path) -> None:
    columns = [column(j, j, [single(2000, 1, 1, 1)] * 4) for j in range(8)]
    payload = packet(70_000, columns, is_safety=True)
    assert read_ouster(write(tmp_path, recording([payload]))).frame == 70_000


def test_missing_invalid_and_late_columns_have_no_points(tmp_path: Path) -> None:
    turns = small_turns()
    late = [*turns[:3], turns[4], turns[3], *turns[5:]]  # the last packet of the first turn comes too late
    blocks = [single(9000, 0, 0, 0)] * 4
    invalid = packet(501, [column(j, 1, blocks, is_valid=False) for j in range(8)])
    sweeps = list(ouster_sweeps(write(tmp_path, recording([*late, invalid]))))
    assert len(sweeps) == 2
    assert not sweeps[0].is_complete
    np.testing.assert_array_equal(np.isnan(sweeps[0].time_s), np.arange(32) >= 24)
    assert not sweeps[0].to_point_cloud().valid[:, 24:].any()
    assert sweeps[1].is_complete
    assert np.nanmax(sweeps[1].range_m) < 2


def test_metadata_of_newer_firmware_say_the_same(tmp_path: Path) -> None:
    old, new = metadata(), nested(metadata())
    first, second = (
        read_ouster(write(tmp_path, recording(small_turns()), data)).to_point_cloud() for data in (old, new)
    )
    np.testing.assert_array_equal(first.points, second.points)


def test_beam_origins_may_be_given_as_a_transform(tmp_path: Path) -> None:
    by_distance = read_ouster(write(tmp_path, recording(small_turns())))
    transform = [1, 0, 0, 15.806, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    data = metadata(beam_to_lidar_transform=transform, lidar_origin_to_beam_origin_mm=0)
    by_transform = read_ouster(write(tmp_path, recording(small_turns()), data))
    np.testing.assert_array_equal(by_distance.to_point_cloud().points, by_transform.to_point_cloud().points)


def test_metadata_make_the_sensor_a_camera(tmp_path: Path) -> None:
    (tmp_path / "drive.json").write_text(json.dumps(metadata()))
    found = load_ouster_metadata(tmp_path / "drive.json")
    camera = found.camera(field_rad=(1e-3, 3e-3))
    rays = camera.pixel_rays()
    np.testing.assert_allclose(rays.directions, found.rays.directions, atol=1e-14)
    assert found.rays.origins is not None
    np.testing.assert_allclose(rays.origins, found.rays.origins, atol=1e-14)
    np.testing.assert_array_equal(camera.times_s, found.rays.times_s)


def test_destaggered_clouds_keep_what_belongs_to_a_point(tmp_path: Path) -> None:
    sweep = read_ouster(write(tmp_path, recording(small_turns())))
    raw, shifted = sweep.to_point_cloud(), sweep.to_point_cloud(destaggered=True)
    for name in ("points", "time_s", "intensity", "ring"):
        before, after = getattr(raw, name), getattr(shifted, name)
        np.testing.assert_array_equal(after[0], before[0])
        np.testing.assert_array_equal(after[1], np.roll(before[1], 2, axis=0))
    with pytest.raises(ValueError, match="shape"):
        sweep.destaggered(np.zeros((4, 31)))


# ---- pcap files -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("link", "header"),
    [
        (1, bytes(12) + b"\x08\x00"),
        (1, bytes(12) + b"\x81\x00\x00\x05\x08\x00"),  # in a virtual network
        (101, b""),
        (113, bytes(14) + b"\x08\x00"),
    ],
)
def test_datagrams_are_found_behind_each_link(tmp_path: Path, order: str, link: int, header: bytes) -> None:
    path = tmp_path / "a.pcap"
    path.write_bytes(pcap(ip_packets(b"hello", port=7502), order, link, header))
    assert list(datagrams(path)) == [("10.0.0.1", 7502, b"hello")]


def test_fragments_in_any_order_make_the_datagram(tmp_path: Path) -> None:
    payload = np.random.default_rng(0).bytes(8448)
    parts = ip_packets(payload, largest=1480)
    assert len(parts) == 6
    other = ip_packets(b"x" * 3000, number=8, largest=1480)
    path = tmp_path / "a.pcap"
    path.write_bytes(pcap([parts[5], other[0], *parts[4:0:-1], other[1], parts[0], other[2]]))
    assert [d.payload for d in datagrams(path)] == [payload, b"x" * 3000]
    path.write_bytes(pcap([*parts[:3], *parts[4:]]))
    assert list(datagrams(path)) == []


def test_records_that_were_cut_short_are_left_out(tmp_path: Path) -> None:
    content = pcap([*ip_packets(b"first"), *ip_packets(b"second")])
    path = tmp_path / "a.pcap"
    path.write_bytes(content[:-1])
    assert [d.payload for d in datagrams(path)] == [b"first"]
    cut = bytearray(content)
    cut[36:40] = struct.pack("<I", 2000)  # the first record had more bytes than it holds
    path.write_bytes(cut)
    assert [d.payload for d in datagrams(path)] == [b"second"]


# ---- What is wrong --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"beam_altitude_angles": [1, 2, 3]}, "expected 4 numbers in beam_altitude_angles, one for each ring, got 3"),
        ({"beam_altitude_angles": [1, 2, 3, 91]}, "from -90 to 90"),
        ({"beam_azimuth_angles": [1, 2, 3, "x"]}, r"expected float, got str in beam_azimuth_angles"),
        ({"pixel_shift_by_row": [0]}, "pixel_shift_by_row"),
        ({"lidar_mode": "512x10"}, "such as 32x10, got '512x10'"),
        ({"lidar_mode": "32x0"}, "turns per second"),
        ({"udp_profile_lidar": "RNG99"}, "to be one of LEGACY, .* got 'RNG99'"),
        ({"columns_per_frame": 100_000}, "data_format.columns_per_frame"),
        ({"columns_per_packet": 4096}, "packets of at most 65507 bytes"),
        ({"lidar_to_sensor_transform": [1, 0]}, "expected 16 numbers in lidar_to_sensor_transform, got 2"),
        ({"lidar_to_sensor_transform": [2] * 16}, "lidar_to_sensor_transform"),
        ({"data_format": None}, "with a data_format, found none"),
    ],
)
def test_contradictory_metadata_are_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    path = write(tmp_path, recording(small_turns()), metadata(**change))
    with pytest.raises(FileFormatError, match=words):
        read_ouster(path)


def test_recordings_that_do_not_fit_their_metadata_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, recording(small_turns()), metadata(rings=5))
    with pytest.raises(FileFormatError, match=r"expected packets of .* bytes, as the metadata state, got datagrams"):
        read_ouster(path)
    path = write(tmp_path, recording(small_turns()), metadata(prod_sn="5"))
    with pytest.raises(FileFormatError, match=f"recorded from sensor {SERIAL}, but the metadata are those of 5"):
        read_ouster(path)
    path = write(tmp_path, recording(small_turns()), metadata(columns=16))
    with pytest.raises(FileFormatError, match="a column of number 23, but the metadata state 16"):
        read_ouster(path)
    path = write(tmp_path, recording(small_turns()))
    with pytest.raises(FileFormatError, match="expected more than 2 turns"):
        read_ouster(path, sweep=2)
    with pytest.raises(FileFormatError, match=r"to port 1, .* got no UDP datagrams"):
        read_ouster(path, port=1)
    with pytest.raises(ValueError, match="sweep"):
        read_ouster(path, sweep=-1)
    (tmp_path / "drive.json").unlink()
    with pytest.raises(FileFormatError, match=r"drive\.json"):
        read_ouster(path)


def test_two_sensors_in_a_recording_need_a_port(tmp_path: Path) -> None:
    turns = small_turns()
    packets = [one for p in turns for one in ip_packets(p, 7502) + ip_packets(p, 7512, source=9)]
    path = write(tmp_path, pcap(packets))
    with pytest.raises(FileFormatError, match=r"several sensors, from 10\.0\.0\.1 to port 7502 .* name the port"):
        read_ouster(path)
    assert read_ouster(path, port=7512).is_complete


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "no pcap file"),
        (b"\x0a\x0d\x0d\x0a" + bytes(40), "pcapng"),
        (pcap([], link=147), "got link 147"),
        (pcap([]) + struct.pack("<IIII", 0, 0, 1 << 30, 1 << 30), "a record states 1073741824 bytes"),
        (pcap([]) + bytes(1000), "a record states 0 bytes"),
    ],
)
def test_broken_recordings_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    with pytest.raises(FileFormatError, match=words):
        read_ouster(write(tmp_path, content))


# ---- KITTI ----------------------------------------------------------------------------------------------------------


def made_sweep(field_deg: float = 180.0) -> tuple[np.ndarray, np.ndarray]:
    """Points of a scanner of 24 beams within a field to both sides of the front, in its order, and their rings."""
    elevations = np.radians(np.linspace(2, -24, 24))
    offsets = np.zeros((24, 3))
    offsets[:, 1] = -np.where(np.arange(24) < 12, 0.21, 0.13)
    rays = spinning(elevations, 720, 0.1, origin_offset_m=offsets, arc_rad=-2 * np.pi, first_azimuth_rad=-1e-4)
    assert rays.origins is not None
    azimuth = np.arctan2(rays.directions[..., 0], rays.directions[..., 2])
    ranges = 12 + 5 * np.sin(3 * azimuth) + np.random.default_rng(0).normal(0, 0.02, azimuth.shape)
    points = rays.origins + ranges[..., None] * rays.directions
    kept = np.abs(azimuth) <= np.radians(field_deg)
    ring = np.broadcast_to(np.arange(24)[:, None], kept.shape)[kept]
    forward, left, up = points[kept][:, 2], -points[kept][:, 0], -points[kept][:, 1]
    return np.stack([forward, left, up], axis=-1).astype(np.float32), ring


@pytest.mark.parametrize("field_deg", [180.0, 40.0])
def test_rings_follow_from_the_order_of_points(field_deg: float) -> None:
    points, ring = made_sweep(field_deg)
    found = rings_of_order(points)
    assert found is not None
    np.testing.assert_array_equal(found.ring, ring)
    np.testing.assert_allclose(np.degrees(found.elevations_rad), np.linspace(2, -24, 24), atol=1e-3)
    np.testing.assert_allclose(found.heights_m, np.where(np.arange(24) < 12, 0.21, 0.13), atol=1e-3)


def test_points_in_another_order_have_no_rings(tmp_path: Path) -> None:
    points, _ = made_sweep()
    rng = np.random.default_rng(1)
    assert rings_of_order(points[rng.permutation(len(points))]) is None
    assert rings_of_order(points[::-1]) is None
    assert rings_of_order(points[rng.permutation(len(points))[:50]]) is None
    swapped = points.copy()
    swapped[300:700] = points[1000:1400]
    assert rings_of_order(swapped) is None
    table = np.column_stack([points[::-1], np.full(len(points), 0.5)]).astype("<f4")
    table.tofile(tmp_path / "a.bin")
    cloud = read_kitti(tmp_path / "a.bin")
    assert cloud.ring is None
    np.testing.assert_array_equal(cloud.points, points[::-1])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "got 0 bytes"),
        (bytes(17), "got 17 bytes"),
        (np.array([np.nan, 0, 0, 0], "<f4").tobytes(), "within 10000 m"),
        (np.array([1e30, 0, 0, 0], "<f4").tobytes(), "within 10000 m"),
        (np.array([1, 0, 0, np.inf], "<f4").tobytes(), "within 10000 m"),
    ],
)
def test_files_that_are_no_sweeps_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "a.bin").write_bytes(content)
    with pytest.raises(FileFormatError, match=words):
        read_kitti(tmp_path / "a.bin")
