# SPDX-License-Identifier: Apache-2.0
"""Signals and range images come back from their files as they were; what is no such file is refused in a sentence."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from synthetic import plane_signals, stereo_rig

import rangesim
from rangesim import (
    AmcwToF,
    Beam,
    DirectToF,
    IdealToF,
    Rig,
    Sensor,
    Signals,
    Spinning,
    StructuredLight,
    decode,
    explain,
    expose,
    load_range_image,
    load_signals,
    save_range_image,
    save_signals,
)
from rangesim.decoding.phase_shift import PhaseThresholds
from rangesim.errors import FileFormatError
from rangesim.response import DenseResponse, Images, LightPath, Math
from rangesim.results.saved_signals import LightPass, read_pass, write_pass
from rangesim.sensors import AmcwDecoder

ROOT = Path(__file__).resolve().parent.parent
SENSORS: list[Sensor] = [
    StructuredLight(256, 160, axes=("columns", "rows")),
    AmcwToF(waveform="square"),
    DirectToF(bins=32, bin_s=400e-12),
    IdealToF(),
]


@pytest.fixture(scope="module")
def traced() -> Signals:
    scene = rangesim.load_scene(ROOT / "scenes" / "matte.xml")
    return rangesim.transport(scene, scene.rig(None, (256, 160), width=48, height=36), SENSORS, spp=4)


def test_signals_are_exposed_again_as_those_traced(traced: Signals, tmp_path: Path) -> None:
    save_signals(traced, tmp_path / "signals.npz")
    loaded = load_signals(tmp_path / "signals.npz")
    assert loaded.rig == traced.rig
    assert loaded.truncation == traced.truncation
    for sensor in SENSORS:
        for noise in (sensor.default_detector, None):
            first, again = (expose(signals, sensor, noise, seed=5) for signals in (traced, loaded))
            assert first.frames.tobytes() == again.frames.tobytes()
            causes = (explain(decode(c), c, s) for c, s in ((first, traced), (again, loaded)))
            np.testing.assert_array_equal(*(c.cause for c in causes))
        np.testing.assert_array_equal(*(s.frames(sensor, sampling_errors=1.0) for s in (traced, loaded)))


def test_signals_without_a_sampling_error_have_none_afterwards(tmp_path: Path) -> None:
    signals = plane_signals(stereo_rig(40, 30), AmcwToF())
    save_signals(signals, tmp_path / "plane.npz")
    loaded = load_signals(tmp_path / "plane.npz")
    assert loaded.sampling is None
    assert loaded.truncation is None
    np.testing.assert_array_equal(loaded.frames(AmcwToF()), signals.frames(AmcwToF()))


@dataclass(frozen=True)
class Nearby(DenseResponse):
    """Light that travelled at most so far: a response from outside the package."""

    farthest_m: float
    channels: ClassVar[int] = 1  # type: ignore[misc]
    type_name: ClassVar[str] = "nearby"

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        return [m.select(path.path_length_m < self.farthest_m, 1.0, 0.0)]


@dataclass(frozen=True)
class Nameless(DenseResponse):
    channels: ClassVar[int] = 1  # type: ignore[misc]

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        return [1.0]


def test_a_response_of_your_own_comes_back(tmp_path: Path) -> None:
    signals = plane_signals(stereo_rig(40, 30), AmcwToF())
    channels = {Nearby(3.0): np.ones((1, 30, 40), np.float32), **signals.channels}
    save_signals(replace(signals, channels=channels), tmp_path / "own.npz")
    assert list(load_signals(tmp_path / "own.npz").channels) == list(channels)


def test_what_cannot_be_read_back_is_not_written(tmp_path: Path) -> None:
    signals = plane_signals(stereo_rig(40, 30), AmcwToF())
    images = Images(np.ones((2, 800, 1280), np.float32))
    with pytest.raises(ValueError, match="expected responses of numbers, got Images"):
        save_signals(replace(signals, channels={images: np.ones((2, 30, 40), np.float32)}), tmp_path / "images.npz")
    with pytest.raises(ValueError, match=r"expected responses with a type_name, .* got Nameless without one"):
        save_signals(replace(signals, channels={Nameless(): np.ones((1, 30, 40), np.float32)}), tmp_path / "n.npz")
    assert not list(tmp_path.iterdir())


def changed(path: Path, settings: dict[str, Any] | None = None, **arrays: Any) -> None:
    """Rewrite a file with other settings and arrays; None leaves an array out."""
    with np.load(path) as file:
        data = {**{name: file[name] for name in file.files}, **arrays}
    if settings is not None:
        kept = json.loads(data["settings"].tobytes())
        data["settings"] = np.frombuffer(json.dumps({**kept, **settings}).encode(), np.uint8)
    np.savez(path, **{name: values for name, values in data.items() if values is not None})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"settings": {"format": "other"}}, "is no rangesim-signals file"),
        ({"settings": {"format_version": 2}}, "expected format version 1, got 2"),
        ({"settings": {"more": 1}}, "unknown key 'more'"),
        ({"settings": {"rig": {}}}, "rig"),
        ({"settings": {"rig": None}}, "expected a table"),
        ({"settings": {"responses": 3}}, "not iterable"),
        ({"settings": {"responses": [{"type": "Nothing"}]}}, "expected 'type' to be one of .*, got 'Nothing'"),
        ({"settings": {"responses": [{"type": "Phasor", "modulation_hz": -1}]}}, "modulation_hz"),
        ({"settings": {"responses": [{"type": "FirstReturn"}] * 3}}, "got one twice"),
        ({"channels_0": None}, "expected an array 'channels_0'"),
        ({"channels_0": np.ones((2, 3, 4), np.float32)}, "channels_0'?: expected shape 2 x 30 x 40"),
        ({"channels_0": np.full((2, 30, 40), np.nan, np.float32)}, "expected numbers, got NaN"),
        ({"error_projector": np.zeros((30, 40), np.float32)}, "sampling error of all channels, or of none"),
        ({"energy_direct": np.zeros((30, 41), np.float32)}, "expected shape"),
        ({"truth_instance": np.full((30, 40), 7, np.int32)}, "expected indices into truth_instance_names"),
        ({"more": np.zeros(3)}, "'more' as well"),
    ],
)
def test_damaged_signals_are_refused(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = tmp_path / "signals.npz"
    save_signals(plane_signals(stereo_rig(40, 30), AmcwToF()), path)
    changed(path, **change)
    with pytest.raises(FileFormatError, match=message) as error:
        load_signals(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [None, b"", b"PK\x03\x04", b"{}"])
def test_what_is_no_file_of_arrays_is_refused(content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "x.npz").write_bytes(content)
    for load in (load_signals, load_range_image):
        with pytest.raises(FileFormatError, match=r"x\.npz"):
            load(tmp_path / "x.npz")


@pytest.mark.parametrize("is_calibrated", [True, False])
def test_range_images_come_back_with_camera_and_decoder(is_calibrated: bool, tmp_path: Path) -> None:
    sensor, decoder = AmcwToF(), AmcwDecoder(phase=PhaseThresholds(max_sigma_rad=0.1))
    capture = expose(plane_signals(stereo_rig(40, 30, baseline_m=0.03), sensor), sensor, sensor.default_detector)
    image = decode(capture if is_calibrated else replace(capture, rig=None), decoder)
    save_range_image(image, tmp_path / "range.npz")
    loaded = load_range_image(tmp_path / "range.npz")
    assert loaded.decoder == decoder
    assert loaded.camera == image.camera
    for f in fields(image):
        if isinstance(getattr(image, f.name), np.ndarray):
            np.testing.assert_array_equal(getattr(loaded, f.name), getattr(image, f.name))


def test_a_range_image_is_read_where_no_sensor_is_loaded_yet(tmp_path: Path) -> None:
    sensor = AmcwToF()
    save_range_image(
        decode(expose(plane_signals(stereo_rig(40, 30, baseline_m=0.03), sensor), sensor)), tmp_path / "range.npz"
    )
    code = f"import rangesim; print(rangesim.load_range_image({str(tmp_path / 'range.npz')!r}).decoder)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.startswith("AmcwDecoder(")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"settings": {"decoder": {"type": "other"}}}, "expected 'type' to be one of"),
        ({"settings": {"camera": {"width": 1}}}, "camera"),
        ({"settings": {"more": 1}}, "unknown key 'more'"),
        ({"status": np.ones((30, 40), np.uint8)}, "expected z to be finite where status is 0"),
        ({"status": np.full((30, 40), 99, np.uint8)}, "expected values from"),
        ({"z": np.ones((2, 2), np.float32)}, "expected shape"),
    ],
)
def test_damaged_range_images_are_refused(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    sensor = AmcwToF()
    path = tmp_path / "range.npz"
    save_range_image(decode(expose(plane_signals(stereo_rig(40, 30, baseline_m=0.03), sensor), sensor)), path)
    changed(path, **change)
    with pytest.raises(FileFormatError, match=message) as error:
        load_range_image(path)
    assert "\n" not in str(error.value)


def test_signals_of_a_scanner_come_back_with_depths_behind_it(tmp_path: Path) -> None:
    scene = rangesim.load_scene("street")
    head = Spinning(elevations_deg=(1.0, -3.0), columns=8)
    rig = Rig(head, Beam((3e-3, 3e-3)), scene.T_world_camera)
    sensor = DirectToF(bins=512, bin_s=1e-9, pulse_fwhm_s=4e-9, laser="single-shot")
    signals = rangesim.transport(scene, rig, [sensor], spp=1, max_depth=2, caustics=False)
    assert (signals.truth.z < 0.0).any()
    save_signals(signals, tmp_path / "signals.npz")
    loaded = load_signals(tmp_path / "signals.npz")
    assert loaded.rig == rig
    np.testing.assert_array_equal(loaded.truth.z, signals.truth.z)
    np.testing.assert_array_equal(expose(loaded, sensor).frames, expose(signals, sensor).frames)
    write_pass(LightPass.of(signals), tmp_path / "pass_1.npz")  # as `rangesim report` reads it
    again = read_pass(tmp_path / "pass_1.npz", {"h": 2, "w": 8})
    np.testing.assert_array_equal(again.truth.z, signals.truth.z)
