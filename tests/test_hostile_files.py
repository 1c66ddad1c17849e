# SPDX-License-Identifier: Apache-2.0
"""Files that would take all memory, or the stack: one sentence, before they are decoded."""

from __future__ import annotations

import io
import json
import os
import struct
import tempfile
import time
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from rangesim.errors import FileFormatError
from rangesim.experiment import load_experiment
from rangesim.files.array_files import read_arrays
from rangesim.files.image_files import check_pixels, read_grey
from rangesim.files.text_files import is_nested_deeper, read_json
from rangesim.rig.calibration_files import load_calibration
from rangesim.settings import limits


@pytest.fixture(autouse=True)
def _at_once() -> Iterator[None]:
    start = time.process_time()
    yield
    assert time.process_time() - start < 3


def png_of(width: int, height: int) -> bytes:
    """A PNG that states this size and holds no pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def exr_of(width: int, height: int) -> bytes:
    """An OpenEXR file whose data window has this size."""
    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.exr"
        OpenEXR.File(attributes, {"Y": np.zeros((3, 5), np.float32)}).write(str(path))
        data = path.read_bytes()
    window = struct.pack("<4i", 0, 0, 4, 2)
    assert window in data
    return data.replace(window, struct.pack("<4i", 0, 0, width - 1, height - 1))


@pytest.mark.parametrize("suffix", ["png", "pgm", "bmp", "tif", "exr"])
def test_image_bombs_are_refused_by_their_header(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"bomb.{suffix}"
    if suffix == "png":
        path.write_bytes(png_of(100_000, 100_000))
    elif suffix == "pgm":
        path.write_bytes(b"P5 100000 100000 255\n" + bytes(100))
    elif suffix == "exr":
        path.write_bytes(exr_of(100_000, 100_000))
    else:
        Image.new("L", (4, 3)).save(path)
        data = bytearray(path.read_bytes())
        if suffix == "bmp":
            data[18:26] = struct.pack("<ii", 100_000, 100_000)
        else:
            for tag, value in ((256, 100_000), (257, 100_000)):
                place = data.index(struct.pack("<H", tag))
                data[place : place + 12] = struct.pack("<HHII", tag, 4, 1, value)
        path.write_bytes(data)
    for read in (read_grey, check_pixels):
        with pytest.raises(FileFormatError, match=r"at most 100000000 pixels in .*bomb"):
            read(path)


def radiance(width: int, height: int) -> bytes:
    return b"#?RADIANCE\n# made by hand\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width)


def targa(width: int, height: int) -> bytes:
    head = bytes([0, 0, 2]) + bytes(9) + struct.pack("<HHBB", width, height, 32, 0)
    return head + bytes(4 * 30) + bytes(8) + b"TRUEVISION-XFILE.\0"


OTHER_IMAGES = {
    "hdr": radiance,
    "pfm": lambda width, height: b"PF\n%d %d\n-1.0\n" % (width, height),
    "grey.pfm": lambda width, height: b"Pf\n%d %d\n-1.0\n" % (width, height),
    "tga": targa,
    "exr": exr_of,
}


@pytest.mark.parametrize("name", ["a.png", "a.dat", "a.hdr"])
@pytest.mark.parametrize("kind", OTHER_IMAGES)
def test_images_that_mitsuba_reads_by_their_contents_have_a_size(tmp_path: Path, kind: str, name: str) -> None:
    """Mitsuba makes room for what the header states, whatever the name of the file says."""
    path = tmp_path / name
    for width, height in ((10_001, 10_000), (65_535, 65_535)):
        path.write_bytes(OTHER_IMAGES[kind](width, height))
        with pytest.raises(FileFormatError, match=rf"at most 100000000 pixels in .*{name}, got {width * height}"):
            check_pixels(path)
    path.write_bytes(OTHER_IMAGES[kind](6, 5) + bytes(6 * 5 * 12) * (kind in ("hdr", "pfm", "grey.pfm")))
    check_pixels(path)


@pytest.mark.parametrize("kind", ["hdr", "pfm", "tga"])
@pytest.mark.parametrize(("width", "height"), [(4, 0), (0, 4), (0, 0)])
def test_headers_that_state_no_pixels_are_refused(tmp_path: Path, kind: str, width: int, height: int) -> None:
    """Mitsuba ended Python over a Radiance file of no rows."""
    path = tmp_path / f"a.{kind}"
    path.write_bytes(OTHER_IMAGES[kind](width, height) + bytes(64) * (kind != "tga"))
    with pytest.raises(FileFormatError, match=rf"a\.{kind} cannot be read as an image: its header states \d by \d"):
        check_pixels(path)


@pytest.mark.parametrize(
    "start", [b"#?RADIANCE\n", b"#?\n-Y 9x +X 9\n", b"PF\n", b"PF\n-1 5\n1.0\n", b"PF 9" + b"9" * 30]
)
def test_headers_without_a_size_are_refused(tmp_path: Path, start: bytes) -> None:
    (tmp_path / "a.hdr").write_bytes(start)
    with pytest.raises(FileFormatError, match="its header states no size"):
        check_pixels(tmp_path / "a.hdr")


def test_images_larger_than_pillows_own_limit_are_read_if_ours_is_raised(tmp_path: Path) -> None:
    path = tmp_path / "large.png"
    path.write_bytes(png_of(20_000, 20_000))
    with limits.raised(pixels=10**9), pytest.raises(FileFormatError, match="cannot be read as an image"):
        read_grey(path)  # it holds no pixels


def test_no_image_runs_postscript(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n")
    with pytest.raises(FileFormatError, match="as an image: it is none of PNG"):
        read_grey(path)


def test_an_image_cut_short_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    whole = exr_of(5, 3)
    path.write_bytes(whole[:-5])
    with pytest.raises(FileFormatError, match="its pixels are damaged or missing"):
        read_grey(path)


def npz(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def test_arrays_read_back_equal(tmp_path: Path) -> None:
    arrays = {
        "a": np.zeros((0, 3)),
        "b": np.arange(5, dtype=np.uint16),
        "names": np.array(["x", "yy"]),
        "scalar": np.float32(3),
        "turned": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "empty": np.array([], dtype="U3"),
    }
    for write in (np.savez, np.savez_compressed):
        write(tmp_path / "a.npz", **arrays)
        back = read_arrays(tmp_path / "a.npz")
        assert list(back) == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(back[name], array)
            assert back[name].dtype == np.asarray(array).dtype
    assert list(read_arrays(tmp_path / "a.npz", ["b"])) == ["b"]
    with pytest.raises(FileFormatError, match="expected an array 'c'"):
        read_arrays(tmp_path / "a.npz", ["c"])


def header_of(shape: str, descr: str = "'<f8'") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


@pytest.mark.parametrize(
    ("member", "message"),
    [
        (header_of("(1000000000000,)"), "expected 8000000000000 bytes"),
        (header_of("(-1,)"), "shape"),
        (header_of("(2,)") + bytes(17), "expected 16 bytes"),
        (header_of("(2,)") + bytes(15), "expected 16 bytes"),
        (header_of("(1,)", "'|O'") + bytes(8), "expected numbers or text"),
        (header_of("(1,)", "[('a', '<f8')]") + bytes(8), "expected numbers or text"),
        (header_of("(" * 150 + ",)" * 150), "header is broken"),
        (npy(np.array([{}], dtype=object)), "expected numbers or text"),
        (b"\x93NUMPY\x09\x00", "header is broken"),
        (b"", "header is broken"),
    ],
)
def test_damaged_arrays_are_one_sentence(tmp_path: Path, member: bytes, message: str) -> None:
    with pytest.raises(FileFormatError, match=rf"a\.npz: array 'x'.*{message}"):
        read_arrays(npz(tmp_path / "a.npz", x=member))


def test_npz_bombs_are_refused_by_their_directory(tmp_path: Path) -> None:
    path = npz(tmp_path / "bomb.npz", **{f"x{i}": header_of("(12500000,)") + bytes(10**8) for i in range(3)})
    assert path.stat().st_size < 10**6
    with limits.raised(bytes=2 * 10**8), pytest.raises(FileFormatError, match="at most 200000000 bytes"):
        read_arrays(path)


def test_an_npz_that_lies_about_its_size_is_refused(tmp_path: Path) -> None:
    path = npz(tmp_path / "a.npz", x=header_of("(1000000,)") + bytes(8 * 10**6))
    size = struct.pack("<I", len(header_of("(1000000,)")) + 8 * 10**6)
    path.write_bytes(path.read_bytes().replace(size, struct.pack("<I", 200)))
    with pytest.raises(FileFormatError, match=r"a\.npz"):
        read_arrays(path)


def test_mutated_arrays_are_read_or_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    np.savez_compressed(tmp_path / "a.npz", x=np.arange(100), names=np.array(["a", "b"]))
    original = (tmp_path / "a.npz").read_bytes()
    refused = 0
    for _ in range(400):
        data = bytearray(original)
        for place in rng.integers(0, len(data), rng.integers(1, 5)):
            data[place] = rng.integers(256)
        (tmp_path / "b.npz").write_bytes(data[: rng.integers(1, len(data))] if rng.random() < 0.2 else data)
        try:
            read_arrays(tmp_path / "b.npz")
        except FileFormatError:
            refused += 1
    assert 100 < refused <= 400


@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, of damaged tags
@pytest.mark.parametrize("suffix", ["png", "tif", "jpg", "bmp", "pgm", "exr"])
def test_mutated_images_are_read_or_refused(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(1)
    path = tmp_path / f"a.{suffix}"
    if suffix == "exr":
        path.write_bytes(exr_of(5, 3))
    else:
        Image.fromarray(rng.integers(0, 255, (6, 8), dtype=np.uint8)).save(path)
    original = path.read_bytes()
    for _ in range(200):
        data = bytearray(original)
        for place in rng.integers(0, min(len(data), 400), rng.integers(1, 5)):
            data[place] = rng.integers(256)
        path.write_bytes(data[: rng.integers(1, len(data))] if rng.random() < 0.2 else data)
        try:
            image = read_grey(path)
        except FileFormatError:
            continue
        assert image.ndim == 2


DEEP = 20_000


@pytest.mark.parametrize(
    "text", ["[" * DEEP, "[" * DEEP + "]" * DEEP, '{"a":' * DEEP + "1" + "}" * DEEP, "[" * 200 + "]" * 200]
)
def test_deep_json_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    for read in (read_json, load_calibration):
        with pytest.raises(FileFormatError, match="expected at most 100 levels in"):
            read(path)


@pytest.mark.parametrize("text", ["1e400", "[1, 2", '{"camera": ' + "1" * 5000 + "}", '{"camera": NaN}', "\ud800"])
def test_odd_json_is_one_short_sentence(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(FileFormatError) as caught:
        load_calibration(path)
    assert len(str(caught.value)) < 500


def test_json_nested_within_the_limit_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("[" * 100 + "]" * 100)
    assert read_json(path)
    with limits.raised(nesting=99), pytest.raises(FileFormatError, match="at most 99 levels"):
        read_json(path)


def test_things_that_hold_themselves_are_too_deep() -> None:
    loop: list[object] = []
    loop.append(loop)
    assert is_nested_deeper(loop, 100)
    shared: list[object] = []
    for _ in range(50):
        shared = [shared, shared]  # 2^50 leaves
    assert not is_nested_deeper(shared, 100)


@pytest.mark.parametrize(
    "text",
    [
        *("a = " + "[" * DEEP, "a = " + "{b = " * DEEP, "a = " + "[" * 150 + "]" * 150),
        *("a." * 100_000 + "a = 1", "[" + "a." * 200 + "a]"),
    ],
)
def test_deep_toml_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match="expected at most 100 levels in"):
        load_experiment(path)


@pytest.mark.parametrize(
    "text",
    [
        'scene = "a"\nspp = ' + "1" * 5000,
        'scene = "a"\nspp = 1' + "0" * 400,
        'scene = "a"\nspp = 9223372036854775808',
        'scene = "a"\nunit_m = 1e400',
        'scene = "a"\nunit_m = 1' + "0" * 400,
        'scene = "a"\nspp = "' + "x" * 10**6 + '"',
        "x" * 10**6 + " = 1",
        'scene = "a"\n[[instrument]]\nname = "a"\nsensor = {type = []}',
        'scene = "a"\n[[instrument]]\nsensor = "amcw"\ndetector = {type = {}}',
        'scene = "a"\nwidth = true',
        'scene = "a"\n[[instrument]]\nsensor = "' + "x" * 10**6 + '"',
        'scene = "a"\n[[instrument]]\nsensor = "amcw"\nbaseline_m = nan',
        'scene = "a"\n[[instrument]]\nname = "a"\nsensor = {type = "amcw-tof", modulation_hz = [9223372036854775808]}',
        'scene = "a"\n[motion.objects.a]\ntype = "poses"\ntimes_s = ["' + "x" * 10**6 + '"]\nposes = []',
        'scene = "a"\n[motion.objects.a]\ntype = "poses"\ntimes_s = [0]\nposes = [[1' + "0" * 400 + "]]",
    ],
)
def test_odd_toml_is_one_short_sentence(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        load_experiment(path)
    assert len(str(caught.value)) < 500
    assert "\n" not in str(caught.value)


CALIBRATION = {
    "img_shape": "480. 640.", "cam_int": "600. 0. 320. 0. 600. 240. 0. 0. 1.", "cam_dist": "0. 0. 0. 0. 0.",
    "proj_int": "600. 0. 320. 0. 600. 240. 0. 0. 1.", "proj_dist": "0. 0. 0. 0. 0.",
    "roration": "1. 0. 0. 0. 1. 0. 0. 0. 1.", "translation": "100. 0. 0.",
}  # fmt: skip


def calibration(path: Path, **changed: str) -> Path:
    matrices = "".join(f"<{k}><data>{v}</data></{k}>" for k, v in (CALIBRATION | changed).items())
    path.write_text(f"<?xml version='1.0'?><opencv_storage>{matrices}</opencv_storage>")
    return path


def test_a_calibration_is_read(tmp_path: Path) -> None:
    assert load_calibration(calibration(tmp_path / "a.xml"), (640, 480)).baseline_m == pytest.approx(0.1)


@pytest.mark.parametrize("name", CALIBRATION)
@pytest.mark.parametrize("number", ["inf", "nan", "-inf", "1e308", "1e400", "-1e20"])
def test_a_calibration_with_a_number_that_is_none_is_refused(tmp_path: Path, name: str, number: str) -> None:
    path = calibration(tmp_path / "a.xml", **{name: CALIBRATION[name].replace(CALIBRATION[name].split()[0], number, 1)})
    with pytest.raises(FileFormatError, match=rf"expected numbers below .* in '{name}'"):
        load_calibration(path, (640, 480))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"img_shape": "1e6 1e6"}, "at most 100000000 pixels"),
        ({"img_shape": "0 640"}, "whole numbers of at least 1"),
        ({"img_shape": "480.5 640"}, "whole numbers"),
        ({"roration": "0 0 0 0 0 0 0 0 0"}, "expected"),
        ({"cam_int": "0 0 0 0 0 0 0 0 1"}, "fx to be positive"),
    ],
)
def test_a_calibration_that_is_none_is_one_sentence(tmp_path: Path, changed: dict[str, str], message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        load_calibration(calibration(tmp_path / "a.xml", **changed), (640, 480))


@pytest.mark.parametrize("size", [(0, 1), (True, 2), (1.5, 2), (10**30, 2), (1,), 3, "ab"])
def test_a_projector_size_that_is_none_is_refused(tmp_path: Path, size: object) -> None:
    with pytest.raises(ValueError, match="projector"):
        load_calibration(calibration(tmp_path / "a.xml"), size)  # type: ignore[arg-type]


def test_deep_xml_and_entities_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text("<a>" * DEEP + "</a>" * DEEP)
    with pytest.raises(FileFormatError, match="at most 100 levels"):
        load_calibration(path, (640, 480))
    path.write_text('<!DOCTYPE a [<!ENTITY b "bbbb"><!ENTITY c "&b;&b;">]><a>&c;</a>')
    with pytest.raises(FileFormatError, match="expected no entities"):
        load_calibration(path, (640, 480))


def test_devices_and_pipes_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    for path in (tmp_path / "pipe.json", Path("/dev/zero")):
        for read in (read_json, read_arrays, read_grey):
            with pytest.raises(FileFormatError, match="no plain file"):
                read(path)


def test_text_files_have_a_limit(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(["x" * 1000]))
    with limits.raised(text=999), pytest.raises(FileFormatError, match="at most 999 bytes"):
        read_json(path)
