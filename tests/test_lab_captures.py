# SPDX-License-Identifier: Apache-2.0
"""Captures as labs have them: any folder of images, files of arrays, turned cameras, few bits; and pattern sets."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from synthetic import plane_depth, signals_of_depth, stereo_rig
from typer.testing import CliRunner

from rangesim import AmcwToF, Capture, DirectToF, SpadDetector, StructuredLight, decode, expose, import_capture
from rangesim.cli import app
from rangesim.conventions import Convention
from rangesim.errors import FileFormatError, RangesimWarning
from rangesim.files.frame_files import (
    CameraView,
    NumberFormat,
    as_counts,
    as_digital,
    find_frames,
    read_frames_file,
)
from rangesim.files.image_files import read_grey, write_grey
from rangesim.results.pattern_sets import PatternSet, load_patterns, save_patterns
from rangesim.sensors import ReferencePatternStereo

SIZE = ("--projector", "64x48")
BOTH = StructuredLight(64, 48, "gray", ("columns", "rows"))
FLAT = (255 * BOTH.patterns()).astype(np.uint8)
"""Frames of a camera that sees each projector pixel with one of its own."""


def run(*arguments: object) -> str:
    """What a command says; a refusal must be one sentence."""
    answer = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert answer.exit_code == 0, answer.output or answer.exception
    return " ".join(answer.output.split())


def refused(*arguments: object) -> str:
    """The sentence with which a command refuses; it must leave nothing."""
    answer = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert answer.exit_code == 1
    assert isinstance(answer.exception, (ValueError, FileFormatError)), answer.exception
    return str(answer.exception)


def write_images(folder: Path, frames: np.ndarray, names: list[str] | None = None, suffix: str = ".png") -> Path:
    folder.mkdir(exist_ok=True)
    for i, frame in enumerate(frames):
        path = folder / f"{names[i] if names else f'shot{i}'}{suffix}"
        np.save(path, frame) if suffix == ".npy" else Image.fromarray(frame).save(path)
    return folder


def decoded(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The maps and the record of a decoded capture."""
    with np.load(folder / "range.npz") as maps:
        return dict(maps), json.loads((folder / "decoded.json").read_text())


def check_flat(folder: Path, turned: Any = lambda image: image) -> None:
    """Each camera pixel sees the projector pixel in its own place, or where `turned` puts it."""
    maps, record = decoded(folder)
    rows, columns = np.mgrid[:48, :64] + 0.5
    np.testing.assert_allclose(maps["projector_column"], turned(columns), atol=0.1)
    np.testing.assert_allclose(maps["projector_row"], turned(rows), atol=0.1)
    assert record["status"]["measured"] == 1.0


# ---- Folders of images ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".npy"])
def test_images_are_taken_in_the_order_of_their_numbers(tmp_path: Path, suffix: str) -> None:
    write_images(tmp_path / "scan", FLAT, suffix=suffix)
    assert "100.0 % of the pixels decoded" in run("decode", tmp_path / "scan", *SIZE, "--out", tmp_path / "out")
    check_flat(tmp_path / "out")


def test_images_that_are_no_frames_are_left_out(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "scan", FLAT)
    write_images(folder, FLAT[:1, ::2, ::2], ["a_photograph"])
    options = ("decode", folder, *SIZE, "--out", tmp_path / "out")
    assert "expected 64 x 48" not in refused(*options)
    run(*options, "--images", "shot*.png")
    check_flat(tmp_path / "out")
    assert "expected images that match 'pat*', got a folder with a_photograph.png" in refused(
        *options, "--images", "pat*"
    )


def test_a_list_says_which_images_and_what_they_show(tmp_path: Path) -> None:
    mixed = np.random.default_rng(1).permutation(len(FLAT))
    folder = write_images(tmp_path / "scan", FLAT[mixed])
    names = BOTH.frame_names()
    lines = [f"shot{i}.png  {names[k]}" for i, k in enumerate(mixed)]
    (tmp_path / "order.txt").write_text("# file, frame\n" + "\n".join(lines))
    options = ("decode", folder, *SIZE, "--out", tmp_path / "out", "--images", tmp_path / "order.txt")
    run(*options)
    check_flat(tmp_path / "out")
    assert "leave out --order" in refused(*options, "--order", "*")
    (tmp_path / "order.txt").write_text("\n".join(f"shot{i}.png" for i in np.argsort(mixed)))
    run(*options)
    check_flat(tmp_path / "out")
    for text, sentence in (
        ("shot0.png white\nshot1.png", "after each image or after none"),
        ("shot0.png white\nshot1.png white", "got 'white' twice"),
        ("shot99.png", "expected the names of files in"),
        ("# nothing", "got no line with one"),
        ("\n".join(lines).replace("white", "wite"), "did you mean 'white'"),
    ):
        (tmp_path / "order.txt").write_text(text)
        assert sentence in refused(*options)


def test_an_order_of_frames_is_stated(tmp_path: Path) -> None:
    names = BOTH.frame_names()
    order = ["white", "black", *(name for name in names if name.startswith("columns"))]
    folder = write_images(tmp_path / "scan", FLAT[[names.index(name) for name in order]])
    run("decode", folder, *SIZE, "--order", "white, black,columns_*", "--out", tmp_path / "out")
    maps, record = decoded(tmp_path / "out")
    assert record["sensor"]["axes"] == ["columns"]
    np.testing.assert_allclose(maps["projector_column"][7], np.arange(64) + 0.5)
    said = refused("decode", folder, *SIZE, "--order", "wite", "--out", tmp_path / "out")
    assert "did you mean 'white'" in said
    assert "only for structured light" in refused("decode", folder, "--sensor", "amcw", "--order", "a", "--out", "x")


@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
@pytest.mark.parametrize("mirror", [False, True])
def test_a_turned_camera_is_turned_back(tmp_path: Path, rotate: int, mirror: bool) -> None:
    upright = FLAT[:, :, ::-1] if mirror else FLAT
    taken = np.rot90(upright, rotate // 90, axes=(1, 2))  # anticlockwise, so that clockwise brings it back
    folder = write_images(tmp_path / "scan", np.ascontiguousarray(taken))
    options = ("--rotate", rotate, *(["--mirror"] if mirror else []))
    run("decode", folder, *SIZE, *options, "--out", tmp_path / "out")
    check_flat(tmp_path / "out")


def test_a_channel_of_colours_is_taken(tmp_path: Path) -> None:
    red = np.zeros((*FLAT.shape, 3), dtype=np.uint8)
    red[..., 0] = FLAT // 2  # a red laser: luma is below the threshold of 40
    folder = write_images(tmp_path / "scan", red)
    options = ("decode", folder, *SIZE, "--out", tmp_path / "out")
    assert "0.0 % of the pixels decoded" in run(*options)
    run(*options, "--channel", "red")
    check_flat(tmp_path / "out")
    assert "did you mean 'green'" in refused(*options, "--channel", "gren")
    write_images(folder, FLAT)
    assert "is grey and has no channel red" in refused(*options, "--channel", "red")
    write_grey(tmp_path / "a.exr", FLAT[0].astype(np.float32))
    with pytest.raises(FileFormatError, match="no channel blue"):
        read_grey(tmp_path / "a.exr", "blue")


def test_findings_of_the_frames_are_printed_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def found(frames: np.ndarray, sensor: StructuredLight) -> Convention:
        return Convention(replace(sensor, order=("white", "black", "*")), ("white and black come first.",))

    monkeypatch.setattr("rangesim.conventions.detect_convention", found)
    folder = write_images(tmp_path / "scan", FLAT[[-2, -1, *range(len(FLAT) - 2)]])
    assert "white and black come first" in run("decode", folder, *SIZE, "--out", tmp_path / "out")
    check_flat(tmp_path / "out")
    assert decoded(tmp_path / "out")[1]["findings"] == [f"{folder}: white and black come first."]


def test_settings_of_the_decoder_are_set(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "scan", FLAT // 10)
    options = ("decode", folder, *SIZE, "--out", tmp_path / "out")
    assert "0.0 % of the pixels decoded" in run(*options)
    run(*options, "--set", "contrast_of_scale=0.05", "--set", "decoder.gray.bit_of_scale=0.01")
    check_flat(tmp_path / "out")
    assert "did you mean 'gray.contrast_of_scale'" in refused(*options, "--set", "gray.contrast_of_scal=1")
    assert "contrast_of_scale" in refused(*options, "--set", "contrast_of_scale=-1")


# ---- Pattern sets ---------------------------------------------------------------------------------------------------


def test_patterns_say_all_that_decoding_needs(tmp_path: Path) -> None:
    said = run("patterns", "gray-phase", *SIZE, "--axes", "rows,columns", "--set", "period_px=8",
               "--set", "convention.start=sin", "--order", "white,*", "--out", tmp_path / "patterns")  # fmt: skip
    assert "26 images for Structured light" in said
    assert "as they were written" in run("verify", tmp_path / "patterns")
    assert "100.0 % of the pixels decoded" in run("decode", tmp_path / "patterns", "--out", tmp_path / "out")
    check_flat(tmp_path / "out")
    patterns = load_patterns(tmp_path / "patterns")
    assert decoded(tmp_path / "out")[1]["sensor"]["order"] == ["white", "*"]
    images = import_capture(tmp_path / "patterns", patterns.sensor).frames
    write_images(tmp_path / "scan", images)
    sidecar = ("--patterns", tmp_path / "patterns" / "patterns.json")
    run("decode", tmp_path / "scan", *sidecar, "--out", tmp_path / "again")
    check_flat(tmp_path / "again")
    for option in (("--code", "gray"), SIZE, ("--axes", "rows"), ("--order", "*")):
        assert f"leave out {option[0]}" in refused("decode", tmp_path / "scan", *sidecar, *option, "--out", "x")


@pytest.mark.parametrize(
    ("colour", "channel"), [((1.0, 0.1, 0.05), "red"), ((0.0, 0.1, 1.0), "blue"), ((1, 1, 1), None)]
)
def test_light_of_one_colour_names_its_channel(colour: tuple[float, ...], channel: str | None, tmp_path: Path) -> None:
    images = 40 + 0.8 * FLAT[..., None] * np.array(colour)  # in a lit room
    write_images(tmp_path / "scan", np.rint(images).astype(np.uint8))
    said = run("decode", tmp_path / "scan", "--projector", "64x48", "--code", "gray", "--out", tmp_path / "out")
    assert f"give --channel {channel}" in said if channel else "--channel" not in said


def test_photographs_in_another_order_than_patterns_json_states(tmp_path: Path) -> None:
    run("patterns", "gray", *SIZE, "--axes", "columns", "--out", tmp_path / "patterns")
    shown = import_capture(tmp_path / "patterns", load_patterns(tmp_path / "patterns").sensor).frames
    sidecar = ("--patterns", tmp_path / "patterns" / "patterns.json")
    for name, order, words in (
        ("first", [-2, -1, *range(len(shown) - 2)], "not as the patterns were written: white and black come first."),
        ("inverses", [*(i ^ 1 for i in range(len(shown) - 2)), -2, -1], "each inverse stands before its pattern."),
    ):
        write_images(tmp_path / name, shown[order])
        assert words in run("decode", tmp_path / name, *sidecar, "--out", tmp_path / f"out_{name}")
        with np.load(tmp_path / f"out_{name}" / "range.npz") as maps:
            column = maps["projector_column"]
        np.testing.assert_array_equal(column, np.broadcast_to(np.arange(column.shape[1]) + 0.5, column.shape))


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (5, np.uint8), (10, np.uint16)])
def test_a_projector_with_that_gamma_shows_the_patterns(bits: int, dtype: type) -> None:
    sensor = StructuredLight(64, 48)
    images = PatternSet(sensor, gamma=2.2, bits=bits).images()
    assert images.dtype == dtype
    values = images.astype(float) / np.iinfo(images.dtype).max
    assert len(np.unique(values)) <= 2**bits
    error = np.abs(values - sensor.patterns() ** (1 / 2.2))
    assert error.max() <= 0.5 / (2**bits - 1) + 0.5 / 255
    assert {0.0, 1.0} <= set(np.unique(values))


def test_a_pattern_set_replaces_its_own_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    assert "holds something else" in refused("patterns", "gray", *SIZE, "--out", tmp_path)
    for _ in range(2):
        run("patterns", "gray", *SIZE, "--out", tmp_path / "p")
    for options, sentence in (
        (("grey",), "did you mean 'gray'"),
        (("amcw",), "expected a sensor that knows the images of its projector"),
        (("gray", "--gamma", "0"), "gamma"),
        (("gray", "--bits", "17"), "bits"),
        (("gray", "--set", "phase.max_sigma_rad=1"), "no decoder"),
    ):
        assert sentence in refused("patterns", *options, "--out", tmp_path / "new")
        assert not (tmp_path / "new").exists()


def test_dots_are_patterns_too(tmp_path: Path) -> None:
    size = ("--set", "pattern.width=64", "--set", "pattern.height=48")
    run("patterns", "reference-pattern", *size, "--out", tmp_path / "dots")
    image = read_grey(tmp_path / "dots" / "000_infrared.png")
    assert image.shape == (48, 64)
    assert image.max() == 255
    assert isinstance(load_patterns(tmp_path / "dots").sensor, ReferencePatternStereo)


def test_a_broken_sidecar_is_one_sentence(tmp_path: Path) -> None:
    save_patterns(PatternSet(BOTH), tmp_path / "p")
    sidecar = tmp_path / "p" / "patterns.json"
    whole = json.loads(sidecar.read_text())
    for change, sentence in (
        ({"sensor": {"type": "structured-light", "code": "grey"}}, "'grey'"),
        ({"gamma": 0}, "gamma"),
        ({"format_version": 2}, "format version 1, got 2"),
    ):
        sidecar.write_text(json.dumps(whole | change))
        assert sentence in refused("decode", tmp_path / "p", "--out", tmp_path / "out")
    sidecar.write_text("{")
    assert "no valid JSON" in refused("decode", tmp_path / "p", "--out", tmp_path / "out")


def test_a_code_of_ones_own_is_projected_and_read(tmp_path: Path) -> None:
    """The file may import its neighbours, and takes settings."""
    (tmp_path / "neighbour.py").write_text("CELL = 2\n")
    (tmp_path / "own_gray.py").write_text(
        "from dataclasses import dataclass\nfrom neighbour import CELL\nfrom rangesim.codes import GrayCode\n"
        "@dataclass(frozen=True)\nclass Wide(GrayCode):\n    cell_px: int = CELL\n    type_name = 'wide-gray'\n"
    )
    own = f"{tmp_path / 'own_gray.py'}:Wide"
    run("patterns", own, *SIZE, "--set", "cell_px=4", "--out", tmp_path / "p")
    assert load_patterns(tmp_path / "p").sensor.code.cell_px == 4  # type: ignore[attr-defined]
    run("decode", tmp_path / "p", "--sensor", own, "--out", tmp_path / "out")
    maps, _ = decoded(tmp_path / "out")
    np.testing.assert_allclose(maps["projector_column"][3, :8], [2, 2, 2, 2, 6, 6, 6, 6])


# ---- Numbers of cameras ---------------------------------------------------------------------------------------------


def test_numbers_of_few_bits_are_stretched() -> None:
    twelve = np.array([[[0, 1, 2048, 4095]]], dtype=np.uint16)
    np.testing.assert_array_equal(as_digital(twelve, NumberFormat(12)).frames, np.rint(twelve * (65535 / 4095)))
    assert as_digital(twelve, NumberFormat()).frames is twelve
    np.testing.assert_array_equal(as_digital(twelve.astype(np.int64), NumberFormat(12)).frames,
                                  as_digital(twelve, NumberFormat(12)).frames)  # fmt: skip
    for values, number, sentence in (
        (twelve, NumberFormat(11), "from 0 to 2047 for --bits 11, got 4095"),
        (twelve.astype(np.uint8), NumberFormat(12), "--bits of 1 to 8 for uint8"),
        (twelve + np.float64(np.nan), NumberFormat(), "expected pixels that are finite"),
        (twelve, NumberFormat(11, True), "expected two's complement of 11 bits"),
    ):
        with pytest.raises(ValueError, match=sentence):
            as_digital(values, number)
    for text in ("12", "s12", None):
        NumberFormat.parse(text)
    for text in ("0", "s33", "twelve", "-1", "9" * 5000):
        with pytest.raises(ValueError, match="--bits"):
            NumberFormat.parse(text)


@pytest.mark.parametrize("container", ["int16", "sign-extended", "twelve bits", "float64"])
def test_signed_numbers_keep_their_differences(container: str) -> None:
    """Whatever the file holds them in."""
    signed = np.array([[[-2048, -1, 0, 5, 2047]]], dtype=np.int16)
    values = {
        "int16": signed,
        "sign-extended": signed.view(np.uint16),
        "twelve bits": signed.view(np.uint16) & 0xFFF,
        "float64": signed.astype(np.float64),
    }[container]
    frames, findings = as_digital(values, NumberFormat(12, is_signed=True))
    np.testing.assert_array_equal(frames, np.rint((signed.astype(int) + 2048) * (65535 / 4095)))
    assert findings == ()
    if container in ("int16", "float64"):
        frames, findings = as_digital(values, NumberFormat())
        assert "taken as 12 bits in two's complement" in findings[0]


def test_floating_point_numbers_are_digital_numbers() -> None:
    values = np.array([[[0.5, 900.25]], [[3.5, np.nan]]])
    frames, findings = as_digital(values, NumberFormat(3))
    assert frames.dtype == np.uint16
    np.testing.assert_array_equal(frames[:, 0, 0], np.rint(np.array([0.5, 3.5]) * (65535 / 7)))
    np.testing.assert_array_equal(frames[:, 0, 1], 0)  # masked in both
    assert "1 of 2" in findings[0]
    assert "fractions of full scale" in as_digital(np.array([[[0.25, 1.0]]]), NumberFormat()).findings[0]


def test_histograms_stay_counts() -> None:
    counts = np.array([[[3.0, 70_000.0]]])
    frames, _ = as_counts(counts)
    assert frames.dtype == np.uint32
    np.testing.assert_array_equal(frames, counts)
    for wrong, sentence in ((counts / 2, "whole counts"), (-counts, "counts from 0")):
        with pytest.raises(ValueError, match=sentence):
            as_counts(wrong)


# ---- Files with all frames ------------------------------------------------------------------------------------------


def test_stacks_are_read_in_any_layout(tmp_path: Path) -> None:
    np.save(tmp_path / "first.npy", FLAT)
    np.save(tmp_path / "last.npy", np.moveaxis(FLAT, 0, -1))
    np.save(tmp_path / "colour.npy", np.repeat(FLAT[..., None], 3, axis=-1))
    np.savez(tmp_path / "two.npz", frames=FLAT, mask=FLAT[0])
    (tmp_path / "stack").mkdir()
    np.save(tmp_path / "stack" / "all.npy", FLAT.astype(np.float64))
    for name, *options in (
        ("first.npy",),
        ("last.npy",),
        ("colour.npy",),
        ("two.npz", "--images", "frames"),
        ("stack",),
    ):
        run("decode", tmp_path / name, *SIZE, *options, "--out", tmp_path / "out")
        check_flat(tmp_path / "out")
    for name, options, sentence in (
        ("two.npz", (), "expected one array, got frames, mask: say which with --images"),
        ("two.npz", ("--images", "frame"), "expected an array 'frame'"),
        ("first.npy", ("--images", "a"), "holds one array"),
        ("first.npy", ("--projector", "128x48"), "expected 28 images"),
    ):
        assert sentence in refused("decode", tmp_path / name, *SIZE, *options, "--out", tmp_path / "x")
    np.save(tmp_path / "text.npy", np.array([["a"]]))
    (tmp_path / "cut.npy").write_bytes((tmp_path / "first.npy").read_bytes()[:-1])
    for name, sentence in (
        ("text.npy", "array of numbers"),
        ("cut.npy", "another number"),
        ("none.npy", "cannot read"),
    ):
        with pytest.raises(FileFormatError, match=sentence):
            read_frames_file(tmp_path / name, 3)
    (tmp_path / "a.bin").write_bytes(b"")
    assert "or a file with all frames" in refused("decode", tmp_path / "a.bin", *SIZE, "--out", tmp_path / "x")


@pytest.mark.parametrize("kind", ["int16 differences", "float64", "12 bits in 16"])
def test_raw_taps_are_decoded(tmp_path: Path, kind: str) -> None:
    """As those of a capture with a known detector, to a millimetre."""
    rig = stereo_rig(64, 48, baseline_m=0.0)
    sensor = AmcwToF((60e6,))
    z = plane_depth(rig)
    frames = expose(signals_of_depth(rig, z, [sensor]), sensor).frames
    counts = np.rint(frames * (3000 / frames.max()))
    taps = {
        "int16 differences": (counts - counts[[2, 3, 0, 1]]).astype(np.int16),  # as of two opposite taps
        "float64": counts + 0.25,
        "12 bits in 16": counts.astype(np.uint16),
    }[kind]
    np.save(tmp_path / "taps.npy", taps)
    options = ("--sensor", "amcw", "--set", "modulation_hz=[60e6]", *(("--bits", 12) if "12" in kind else ()))
    K = {"K": [[rig.pinhole.fx, 0, 31.5], [0, rig.pinhole.fy, 23.5], [0, 0, 1]], "dist": [0] * 5}
    (tmp_path / "camera.json").write_text(json.dumps(K))
    said = run("decode", tmp_path / "taps.npy", *options, "--calibration", tmp_path / "camera.json", "--out",
               tmp_path / "out")  # fmt: skip
    assert ("taken as" in said) == ("12" not in kind)
    maps, _ = decoded(tmp_path / "out")
    assert np.isfinite(maps["z"]).all()
    assert np.abs(maps["z"] - z).max() < 2e-3


def test_histograms_are_decoded(tmp_path: Path) -> None:
    rig = stereo_rig(16, 12, baseline_m=0.0)
    sensor = DirectToF(bins=64, bin_s=200e-12)
    capture = expose(signals_of_depth(rig, plane_depth(rig), [sensor]), sensor, SpadDetector(pile_up=False))
    counts = capture.frames
    expected = decode(Capture(counts.astype(np.uint32), sensor)).range_m
    np.save(tmp_path / "first.npy", counts)
    np.save(tmp_path / "last.npy", np.moveaxis(counts, 0, -1).astype(np.int64))
    (tmp_path / "table.json").write_text(json.dumps([{"id": 1, "hists": counts.reshape(64, -1).T.tolist()}]))
    options = ("--sensor", "direct-tof", "--set", "bins=64", "--set", "bin_s=200e-12", "--out", tmp_path / "out")
    for name in ("first.npy", "last.npy"):
        run("decode", tmp_path / name, *options)
        np.testing.assert_array_equal(decoded(tmp_path / "out")[0]["range_m"], expected)
    run("decode", tmp_path / "table.json", *options, "--images", "0.hists")
    np.testing.assert_array_equal(decoded(tmp_path / "out")[0]["range_m"], expected.reshape(1, -1))
    assert "no --bits for histograms" in refused("decode", tmp_path / "first.npy", *options, "--bits", 12)
    assert "leads nowhere in a list of 1" in refused("decode", tmp_path / "table.json", *options, "--images", "1.hists")
    assert "say where with --images" in refused("decode", tmp_path / "table.json", *options)


def test_a_devices_histograms_are_decoded(tmp_path: Path, real_data: Path) -> None:
    """Of the robot's 20 cm, the device's own start of the histogram is right to some centimetres."""
    file = real_data / "tof" / "tmf8820_distance.json"
    records = json.loads(file.read_text())
    at = next(i for i, record in enumerate(records) if record["dist_to_plane"] > 0.2)
    run("decode", file, "--sensor", "tmf8820", "--images", f"{at}.hists", "--out", tmp_path / "out")
    maps, record = decoded(tmp_path / "out")
    assert record["status"]["measured"] == 1.0
    assert np.abs(maps["range_m"] - records[at]["dist_to_plane"]).max() < 0.05


def test_the_functions_take_what_the_command_takes(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "scan", FLAT[:, :, ::-1].astype(np.float64), suffix=".npy")
    with pytest.warns(RangesimWarning, match="taken as 8 bits"):
        capture = import_capture(folder, BOTH, view=CameraView(mirror=True), images="shot*")
    np.testing.assert_array_equal(capture.frames // 257, FLAT)
    write_images(folder, FLAT[:1])
    with pytest.raises(FileFormatError, match="expected images or arrays"):
        find_frames(folder)
    for wrong in ({"rotate": 45}, {"channel": "alpha"}):
        with pytest.raises(ValueError, match="expected"):
            CameraView(**wrong)  # type: ignore[arg-type]


def test_a_capture_that_says_all_refuses_words_about_images(tmp_path: Path) -> None:
    from rangesim import save_capture

    save_capture(Capture(FLAT, BOTH), tmp_path / "c")
    for option in (("--images", "*"), ("--order", "*"), ("--rotate", 90), ("--mirror",), ("--channel", "red")):
        assert f"leave out {option[0]}" in refused("decode", tmp_path / "c", *option, "--out", tmp_path / "x")
    assert "which" in refused("decode", tmp_path / "c", "--set", "projector_width=3", "--out", tmp_path / "x")
    run("decode", tmp_path / "c", "--set", "gray.contrast_of_scale=0.9", "--out", tmp_path / "out")
