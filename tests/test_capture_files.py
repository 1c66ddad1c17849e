# SPDX-License-Identifier: Apache-2.0
"""Captures load back the same; broken ones are refused in one sentence, and nothing is written half-way."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from synthetic import plane_signals, stereo_rig

from rangesim import save_capture
from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.codes import GrayPhase
from rangesim.electronics.detector import Detector, PhotoDetector
from rangesim.electronics.spad import SpadDetector
from rangesim.errors import FileFormatError
from rangesim.files.image_files import read_grey, write_grey
from rangesim.results.captures import SIDECAR, import_capture, load_capture
from rangesim.rig import Intrinsics
from rangesim.rig.calibration_files import load_calibration, save_calibration
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, Sensor, StructuredLight

SMALL = StructuredLight(8, 4, "gray")


def small_capture(detector: PhotoDetector | None = None, sensor: Sensor = SMALL) -> Capture:
    rig = dataclasses.replace(stereo_rig(32, 24), projector=Intrinsics.from_fov(8, 4, 60))
    return expose(plane_signals(rig, sensor, ambient=0.1), sensor, detector)


@pytest.mark.parametrize(
    ("sensor", "detector"),
    [
        (SMALL, None),
        (SMALL, Detector()),
        (SMALL, Detector(bits=8)),
        (StructuredLight(8, 4, GrayPhase(4.0), ("columns", "rows")), Detector(bits=16)),
        (AmcwToF(waveform="square"), Detector.time_of_flight()),
        (DirectToF(bins=20, bin_s=1e-9), SpadDetector(pile_up=True)),
        (IdealToF(), None),
    ],
)
def test_captures_load_back_the_same(tmp_path: Path, sensor: Sensor, detector: PhotoDetector | None) -> None:
    capture = small_capture(detector, sensor)
    save_capture(capture, tmp_path / "out" / "capture")
    loaded = load_capture(tmp_path / "out" / "capture")
    assert loaded.frames.dtype == capture.frames.dtype
    assert loaded.frames.tobytes() == capture.frames.tobytes()
    assert (loaded.sensor, loaded.rig, loaded.detector) == (capture.sensor, capture.rig, capture.detector)
    np.testing.assert_equal(loaded.exposure_s, capture.exposure_s)
    assert loaded.exposure_is_automatic == capture.exposure_is_automatic == (detector is not None)
    suffix = ".exr" if detector is None else ".png"
    names = sorted(p.name for p in (tmp_path / "out" / "capture").glob("0*"))
    assert names == [f"{i:03d}_{name}{suffix}" for i, name in enumerate(sensor.frame_names())]
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["capture"]


def test_an_uncalibrated_capture_and_wide_counts_load_back(tmp_path: Path) -> None:
    sensor = DirectToF(bins=2, pulse_fwhm_s=0.0)
    capture = Capture(np.full((2, 3, 4), 60_000, dtype=np.uint32), sensor)
    save_capture(capture, tmp_path / "c")
    loaded = load_capture(tmp_path / "c")
    assert loaded.frames.dtype == np.uint32
    assert loaded.rig is None
    assert loaded.detector is None
    too_many = Capture(np.full((2, 3, 4), 70_000, dtype=np.uint32), sensor)
    with pytest.raises(FileFormatError, match="70000"):
        save_capture(too_many, tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_a_capture_from_before_a_setting_was_there_loads(tmp_path: Path) -> None:
    """Its laser is the usual one."""
    sensor = DirectToF(bins=20, bin_s=1e-9)
    save_capture(small_capture(SpadDetector(pile_up=False), sensor), tmp_path / "c")
    _edit(lambda s: s["sensor"].pop("laser"))(tmp_path / "c")
    loaded = load_capture(tmp_path / "c")
    assert loaded.sensor == sensor
    assert loaded.detector == SpadDetector(pile_up=False)


def test_a_capture_is_replaced_and_nothing_else_is(tmp_path: Path) -> None:
    save_capture(small_capture(Detector()), tmp_path / "c")
    save_capture(small_capture(None), tmp_path / "c")
    assert load_capture(tmp_path / "c").frames.dtype == np.float32
    assert not list((tmp_path / "c").glob("*.png"))
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.txt").write_text("all my work")
    with pytest.raises(FileFormatError, match="nothing was written"):
        save_capture(small_capture(), precious)
    with pytest.raises(FileFormatError, match="no directory"):
        save_capture(small_capture(), precious / "thesis.txt")
    assert (precious / "thesis.txt").read_text() == "all my work"


def _edit(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        settings = json.loads((folder / SIDECAR).read_text())
        change(settings)
        (folder / SIDECAR).write_text(json.dumps(settings))

    return apply


def _overwrite(name: str, image: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: Image.fromarray(image).save(folder / name)


FIRST = "000_columns_bit2.png"


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: (d / SIDECAR).unlink(), "is no rangesim-capture directory: it has no capture.json"),
        (lambda d: (d / SIDECAR).write_text("{"), "is no valid JSON"),
        (lambda d: (d / SIDECAR).write_text("[]"), "is no rangesim-capture file"),
        (lambda d: (d / FIRST).unlink(), f"{FIRST} is missing"),
        (lambda d: (d / FIRST).write_bytes(b"not a picture"), "cannot be read as an image"),
        (lambda d: (d / FIRST).write_bytes((d / FIRST).read_bytes()[:200]), "cannot be read as an image"),
        (_overwrite("001_columns_bit2_inverse.png", np.zeros((5, 6), np.uint16)), "got 6 x 5 uint16"),
        (_overwrite("001_columns_bit2_inverse.png", np.zeros((24, 32), np.uint8)), "got 32 x 24 uint8"),
        (_edit(lambda s: s.update(exposure=1)), "unknown key 'exposure' .did you mean 'exposure_s'"),
        (_edit(lambda s: s["sensor"].update(code="grey")), "sensor.code: .*'grey'"),
        (_edit(lambda s: s["sensor"].update(type="structured-ligth")), "did you mean 'structured-light'"),
        (_edit(lambda s: s["sensor"].pop("type")), "expected 'type'"),
        (_edit(lambda s: s.pop("sensor")), "expected a table"),
        (_edit(lambda s: s["rig"]["camera"].update(width=33)), "expected 33 x 24 pixels"),
        (_edit(lambda s: s["detector"].update(bits=40)), "number of bits, 1 to 16"),
        (_edit(lambda s: s.update(format_version=99)), "format version 1, got 99"),
        (_edit(lambda s: s.update(exposure_s="long")), "long"),
        (_edit(lambda s: s.update(frames=s["frames"][1:])), "list of 8 frames"),
        (_edit(lambda s: s["frames"].__setitem__(0, "../../etc/passwd")), "plain file names"),
        (_edit(lambda s: s.update(dtype="float32")), "expected frames of type float32"),
    ],
)
def test_damaged_captures_are_refused(tmp_path: Path, damage: Callable[[Path], object], message: str) -> None:
    save_capture(small_capture(Detector()), tmp_path / "c")
    damage(tmp_path / "c")
    with pytest.raises(FileFormatError, match=message) as caught:
        load_capture(tmp_path / "c")
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_failure_while_writing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError("No space left on device")

    save_capture(small_capture(), tmp_path / "old")
    monkeypatch.setattr("rangesim.results.captures.write_json", full)
    for name in ("c", "not/yet/there", "old"):
        with pytest.raises(OSError, match="No space"):
            save_capture(small_capture(Detector()), tmp_path / name)
    assert [p.name for p in tmp_path.iterdir()] == ["old"]
    assert load_capture(tmp_path / "old").frames.dtype == np.float32


def test_real_images_come_in_by_number(tmp_path: Path) -> None:
    for i in range(SMALL.n_frames):
        image = np.full((4, 5, 3), 20 * i, dtype=np.uint8)
        Image.fromarray(image if i % 2 else image[..., 0]).save(tmp_path / f"shot{i + 1}.png")
    for i, value in enumerate([9, 10, 11]):
        (tmp_path / f"notes{i}.txt").write_text(str(value))
    capture = import_capture(tmp_path, SMALL)
    np.testing.assert_array_equal(capture.frames[:, 0, 0], 20 * np.arange(8))
    with pytest.raises(FileFormatError, match="expected 10 images"):
        import_capture(tmp_path, StructuredLight(16, 4, "gray"))
    with pytest.raises(FileFormatError, match="expected frames of 160 x 120"):
        import_capture(tmp_path, SMALL, stereo_rig())
    Image.fromarray(np.zeros((4, 6), np.uint8)).save(tmp_path / "shot5.png")
    with pytest.raises(FileFormatError, match=r"shot5\.png: expected 5 x 4 uint8"):
        import_capture(tmp_path, SMALL)
    with pytest.raises(FileFormatError, match="expected a folder of images, got a path"):
        import_capture(tmp_path / "nowhere", SMALL)


def test_impossible_captures_are_refused() -> None:
    with pytest.raises(ValueError, match="expected 8 frames"):
        Capture(np.zeros((7, 4, 4), np.uint8), SMALL)
    with pytest.raises(ValueError, match="float64"):
        Capture(np.zeros((8, 4, 4)), SMALL)
    with pytest.raises(ValueError, match="160 x 120"):
        Capture(np.zeros((8, 4, 4), np.uint8), SMALL, stereo_rig())


def test_rigs_load_back_the_same(tmp_path: Path) -> None:
    rig = dataclasses.replace(stereo_rig(), camera=Intrinsics(160, 120, 100.5, 101, 80, 60.25, (0.1, -0.2)))
    save_calibration(rig, tmp_path / "rig.json")
    assert load_calibration(tmp_path / "rig.json") == rig
    assert [p.name for p in tmp_path.iterdir()] == ["rig.json"]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", "{", "no valid JSON"),
        ("a.json", '{"camera": {}}', "missing 'projector'"),
        ("a.json", '{"camara": {}}', "did you mean 'camera'"),
        ("a.xml", "<opencv_storage>", "no valid XML"),
        ("a.xml", "<opencv_storage/>", "the camera's matrix under a usual name"),
        ("a.xml", "<o><K1><data>1 2 3</data></K1></o>", "expected 'K1' to hold 3 x 3 numbers, got 3"),
        ("a.xml", "<o><K1><data>1 two</data></K1></o>", "does not hold numbers"),
        ("a.yml", "%YAML:1.0\n---\nK1: [1, 2", "a list in brackets without its end"),
        ("a.yml", "K1: &a [1]", "a reference or a block of text"),
        ("a.toml", "", "expected a file that ends in .xml"),
    ],
)
def test_broken_calibrations_are_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(FileFormatError, match=message):
        load_calibration(tmp_path / name, (8, 8))
    with pytest.raises(FileFormatError, match="does not exist"):
        load_calibration(tmp_path / "nowhere.xml")


def test_deep_and_coloured_images_come_in_unharmed_or_are_refused(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    sensor = IdealToF()
    deep = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
    for suffix in (".tif", ".png"):
        folder = tmp_path / suffix
        folder.mkdir()
        for i in range(2):
            cv2.imwrite(str(folder / f"{i}{suffix}"), deep + i)
        np.testing.assert_array_equal(import_capture(folder, sensor).frames, [deep, deep + 1])
    cv2.imwrite(str(tmp_path / ".png" / "1.png"), np.repeat(deep[..., None], 3, axis=2))
    with pytest.raises(FileFormatError, match="colour PNG of 16 bits"):
        import_capture(tmp_path / ".png", sensor)
    for i in range(2):
        (tmp_path / ".tif" / f"{i}.tif").unlink()
        write_grey(tmp_path / ".tif" / f"{i}.exr", deep.astype(np.float32))
    np.testing.assert_array_equal(import_capture(tmp_path / ".tif", sensor).frames, [deep, deep])
    (tmp_path / ".tif" / "1.exr").write_bytes(b"no picture")
    with pytest.raises(FileFormatError, match="cannot be read as an image"):
        import_capture(tmp_path / ".tif", sensor)


def test_calibration_settings_must_be_positive(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text("<o/>")
    for wrong in ({"code_step": 0}, {"unit_m": 0.0}):
        with pytest.raises(ValueError, match=r"code_step|unit_m"):
            load_calibration(tmp_path / "a.xml", (8, 8), **wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "dtype"), [("frame.exr", "float32"), ("frame.png", "uint16")])
def test_images_on_a_disk_that_takes_no_more_are_an_error_of_the_system(tmp_path: Path, name: str, dtype: str) -> None:
    """OpenEXR has an error of its own for it, which nobody would take for a full disk."""
    pytest.importorskip("resource")
    code = (
        "import errno, resource, signal, sys; from pathlib import Path; import numpy as np\n"
        "from rangesim.files.image_files import write_grey\n"
        "image = (1e4 * np.random.default_rng(1).random((200, 300))).astype(sys.argv[2])\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "try: write_grey(Path(sys.argv[1]), image)\n"
        "except OSError as error: sys.exit(0 if error.errno == errno.EFBIG else repr(error))\n"
        "sys.exit('no error')\n"
    )
    line = [sys.executable, "-c", code, str(tmp_path / name), dtype]
    done = subprocess.run(line, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("mode", ["L", "I;16", "F", "RGB"])
def test_a_tiff_of_several_images_is_refused_and_a_preview_is_none(tmp_path: Path, mode: str) -> None:
    """All but the first were left out without a word."""
    first, second = (Image.new("RGB", (6, 4), (k, k, k)).convert("L").convert(mode) for k in (9, 90))
    first.save(tmp_path / "three.tif", save_all=True, append_images=[second, second])
    first.save(tmp_path / "preview.tif", save_all=True, append_images=[second.resize((3, 2), Image.Resampling.NEAREST)])
    with pytest.raises(FileFormatError, match=r"three\.tif holds 3 images of one size, expected one"):
        read_grey(tmp_path / "three.tif")
    np.testing.assert_array_equal(read_grey(tmp_path / "preview.tif"), np.full((4, 6), 9))
