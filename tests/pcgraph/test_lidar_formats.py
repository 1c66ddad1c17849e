# SPDX-License-Identifier: Apache-2.0
"""Files of LiDARs: sweeps of KITTI and nuScenes, recordings of Ouster's packets."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import column, dual, metadata, nested, packet, recording, small_turns

import pcgraph
from pcgraph.cloud import Cloud
from pcgraph.errors import CloudReadError, CloudWriteError
from pcgraph.io import FORMATS
from pcgraph.io.format import CloudFile

BY_NAME = {one.name: one for one in FORMATS}
KITTI = np.array([[1.5, 2, 3, 0.5], [-4, 5, 6, 0.25], [7, 8.25, 9, 1], [0, 1, 2, 0], [3, 4, 5, 0.125]], "<f4")
NUSCENES = np.array([[1.5, 2, 3, 40, 31], [-4, 5, 6, 255, 0], [7, 8.25, 9, 1, 7], [7, 8, 9, 1, 8]], "<f4")


# ---- Sweeps --------------------------------------------------------------------------------------------------------


def write(path: Path, table: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(np.asarray(table, "<f4").tobytes())
    return path


@pytest.mark.parametrize("n", [1, 5])
def test_a_bin_file_is_of_kitti_unless_its_fifth_number_is_a_ring(tmp_path: Path, n: int) -> None:
    cloud = pcgraph.read_cloud(write(tmp_path / "a.bin", KITTI[:n]))
    assert np.array_equal(cloud.points, KITTI[:n, :3])
    assert list(cloud.columns) == ["intensity"]
    assert np.array_equal(cloud.columns["intensity"], KITTI[:n, 3])


@pytest.mark.parametrize("name", ["a.bin", "a.pcd.bin", "A.PCD.BIN"])
def test_sweeps_of_nuscenes_have_rings(tmp_path: Path, name: str) -> None:
    cloud = pcgraph.read_cloud(write(tmp_path / name, NUSCENES))
    assert np.array_equal(cloud.points, NUSCENES[:, :3])
    assert np.array_equal(cloud.columns["intensity"], NUSCENES[:, 3])
    assert cloud.columns["ring"].tolist() == [31, 0, 7, 8]
    assert cloud.columns["ring"].dtype == np.uint8


def test_what_fits_both_has_to_be_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.bin", np.zeros((5, 4)))
    with pytest.raises(CloudReadError, match="file_format='kitti' or file_format='nuscenes'"):
        pcgraph.read_cloud(path)
    assert pcgraph.read_cloud(path, "kitti").points.shape == (5, 3)
    assert pcgraph.read_cloud(path, "nuscenes").points.shape == (4, 3)


def test_labels_of_semantickitti_are_read_beside_the_sweep(tmp_path: Path) -> None:
    path = write(tmp_path / "00" / "velodyne" / "000007.bin", KITTI)
    labels = tmp_path / "00" / "labels" / "000007.label"
    labels.parent.mkdir()
    labels.write_bytes(np.array([10, 40, 252 | 3 << 16, 0, 65535 | 9 << 16], "<u4").tobytes())
    cloud = pcgraph.read_cloud(path)
    assert cloud.labels.tolist() == [10, 40, 252, 0, 65535]
    assert cloud.columns["instance"].tolist() == [0, 0, 3, 0, 9]
    labels.write_bytes(bytes(16))
    with pytest.raises(CloudReadError, match=r"4 bytes for each of 5 points in .*000007\.label, got 16 bytes"):
        pcgraph.read_cloud(path)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.bin", b"", "expected 4 numbers of 4 bytes for each point, x, y, z, intensity, got 0 bytes"),
        ("a.bin", bytes(17), "got 17 bytes"),
        ("a.pcd.bin", bytes(16), "expected 5 numbers"),
        ("a.pcd.bin", np.array([1, 2, 3, 4, 0.5], "<f4").tobytes(), "whole numbers from 0 to 255 as rings"),
        ("a.bin", np.array([1e30, 0, 0, 0], "<f4").tobytes(), "within 10000 m"),
        ("a.bin", np.array([0, 0, 0, np.nan], "<f4").tobytes(), "within 10000 m"),
        ("a.bin", np.tile(np.array([1, 2, 3, -1, -2, -3], "<f4"), 2).tobytes(), "reflectance, got negative ones"),
    ],
)
def test_other_bytes_are_refused(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CloudReadError, match=words):
        pcgraph.read_cloud(tmp_path / name)


def test_sweeps_are_written_as_they_were_read() -> None:
    for name, table in (("kitti", KITTI), ("bin", KITTI), ("nuscenes", NUSCENES)):
        one = BY_NAME[name]
        assert one.encode is not None
        cloud = one.read(CloudFile(table.tobytes()))
        assert one.encode(cloud, ".bin") == table.tobytes()
        with pytest.raises(CloudWriteError, match="and no others, got x, y, z, intensity"):
            one.encode(Cloud(cloud.points, columns={**cloud.columns, "ring2": np.zeros(len(table))}), ".bin")
        with pytest.raises(CloudWriteError, match="expected numbers of float32 in 'x', which the file would round"):
            one.encode(Cloud(cloud.points.astype(float) + 1e-12, columns=cloud.columns), ".bin")


def test_sweeps_that_would_be_read_as_others_are_written_by_name_only(tmp_path: Path) -> None:
    cloud = Cloud(np.zeros((5, 3), np.float32), columns={"intensity": np.zeros(5, np.float32)})
    with pytest.raises(CloudWriteError, match="write and read them with file_format='kitti'"):
        pcgraph.write_cloud(tmp_path / "a.bin", cloud)
    pcgraph.write_cloud(tmp_path / "a.bin", cloud, "kitti")
    assert pcgraph.read_cloud(tmp_path / "a.bin", "kitti").points.shape == (5, 3)
    cloud.columns["intensity"] -= 0.5
    with pytest.raises(CloudWriteError, match="intensities of at least 0"):
        pcgraph.write_cloud(tmp_path / "b.bin", cloud)


# ---- Ouster --------------------------------------------------------------------------------------------------------

REAL = ("OS-0-128-U1_v2.3.0_1024x10", "OS-1-32-G_v2.1.1_1024x10")


def record(folder: Path, payloads: list[bytes], data: dict[str, Any] | None = None) -> Path:
    (folder / "drive.json").write_text(json.dumps(metadata() if data is None else data))
    (folder / "drive.pcap").write_bytes(recording(payloads))
    return folder / "drive.pcap"


@pytest.mark.parametrize("name", REAL)
def test_images_of_a_real_recording_have_the_digests_of_its_maker(real_data: Path, name: str) -> None:
    path = real_data / "lidar" / f"{name}.pcap"
    known = json.loads((real_data / "lidar" / f"{name}_digest.json").read_text())["scans"][0]
    data = json.loads(path.with_suffix(".json").read_text())
    cloud = pcgraph.read_cloud(path)
    shift = np.array(data["data_format"]["pixel_shift_by_row"])[:, None]
    back = (np.arange(1024) + shift) % 1024  # from directions to moments
    images = {name: np.take_along_axis(column, back, axis=1) for name, column in cloud.columns.items()}
    millimetres = images["range"].astype(float) * 1000 + data["lidar_origin_to_beam_origin_mm"]
    images["range"] = np.nan_to_num(np.rint(millimetres), nan=0)
    kinds = {"range": "u4", "reflectivity": "u1", "signal": "u2", "near_ir": "u2"}
    for field in kinds.keys() & images.keys():
        digest = hashlib.md5(np.ascontiguousarray(images[field].astype(kinds[field])).tobytes()).hexdigest()
        assert digest == known[field.upper()], field


def test_a_turn_of_ouster_is_an_image_of_directions(tmp_path: Path) -> None:
    for data in (metadata(), nested(metadata())):
        cloud = pcgraph.read_cloud(record(tmp_path, small_turns(), data))
        assert cloud.points.shape == (4, 32, 3)
        assert cloud.viewpoint.tolist() == [0, 0, pytest.approx(0.03618)]
        rows, columns = np.indices((4, 32))
        moment = (columns - np.array(metadata()["data_format"]["pixel_shift_by_row"])[:, None]) % 32
        assert np.allclose(cloud.columns["range"], (1000 + 100 * rows + moment - 15.806) / 1000)
        assert np.array_equal(cloud.columns["signal"], 2 * moment)
        assert np.array_equal(cloud.columns["near_ir"], 3 * moment)
        assert np.array_equal(cloud.columns["reflectivity"], rows)
        assert np.array_equal(cloud.columns["ring"], rows)
        assert np.allclose(cloud.columns["time"], moment * 3.125e-3)


def test_the_first_whole_turn_is_read_or_the_fullest(tmp_path: Path) -> None:
    turns = small_turns(3)
    whole = pcgraph.read_cloud(record(tmp_path, turns[1:]))
    assert np.isfinite(whole.points).all()
    assert whole.columns["time"].min() == 0
    parts = pcgraph.read_cloud(record(tmp_path, [*turns[:1], *turns[4:7], *turns[8:10]]))
    assert np.isnan(parts.columns["time"]).sum() == 4 * 8
    assert np.array_equal(np.isnan(parts.columns["time"]), np.isnan(parts.points[..., 0]))


def test_the_first_return_is_read(tmp_path: Path) -> None:
    blocks = [dual((2000, 5000), (10, 20), (30, 40), 50)] * 4
    data = metadata(columns=8, profile="RNG19_RFL8_SIG16_NIR16_DUAL")
    cloud = pcgraph.read_cloud(record(tmp_path, [packet(3, [column(j, j, blocks) for j in range(8)])], data))
    assert np.allclose(cloud.columns["range"], 1.984194)
    assert (cloud.columns["signal"] == 30).all()


def test_recordings_without_fitting_metadata_are_refused(tmp_path: Path) -> None:
    path = record(tmp_path, small_turns(), metadata(rings=5))
    with pytest.raises(
        CloudReadError, match=r"drive\.pcap: expected packets of .* as the metadata state, got datagrams"
    ):
        pcgraph.read_cloud(path)
    (tmp_path / "drive.json").write_text("[" * 100_000)
    with pytest.raises(CloudReadError, match=r"drive\.json: expected metadata in JSON"):
        pcgraph.read_cloud(path)
    (tmp_path / "drive.json").write_text("[1]")
    with pytest.raises(CloudReadError, match="expected metadata as a table"):
        pcgraph.read_cloud(path)
    (tmp_path / "drive.json").unlink()
    with pytest.raises(CloudReadError, match=r"metadata in drive\.json beside the recording, found none"):
        pcgraph.read_cloud(path)
    with pytest.raises(CloudReadError, match="give the path of a file"):
        BY_NAME["ouster"].read(CloudFile(path.read_bytes()))
    invalid = [packet(3, [column(j, j, [bytes(12)] * 4, is_valid=False) for j in range(8)])]
    with pytest.raises(CloudReadError, match="the sensor marks all as invalid"):
        pcgraph.read_cloud(record(tmp_path, invalid))
    path.write_bytes(b"no recording")
    with pytest.raises(CloudReadError, match="no pcap file"):
        pcgraph.read_cloud(path)
