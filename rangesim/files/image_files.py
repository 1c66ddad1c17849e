# SPDX-License-Identifier: Apache-2.0
"""One grey image per file: PNG, TIFF or JPEG for digital numbers, OpenEXR for radiance."""

from __future__ import annotations

import errno
import math
import os
import struct
import sys
import warnings
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from pcgraph.plumbing.plain_files import DISK, check_file
from rangesim.errors import FileFormatError
from rangesim.files.utf8_names import utf8_name
from rangesim.settings import limits
from rangesim.settings.config import brief

SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".pgm", ".exr")
"""Files that `read_grey` takes for images."""
_BROKEN = (
    *(OSError, ValueError, SyntaxError, RuntimeError, LookupError, TypeError, EOFError, ArithmeticError, MemoryError),
    *(struct.error, zlib.error),
)
"""What Pillow and OpenEXR raise on a file that is no image, or broken."""


PNG_STRATEGY = zlib.Z_RLE
"""Of deflate. Noise does not repeat itself: to search for it takes longer and makes files 5 % larger."""
GREY_LEVELS = 5
"""Of 255, difference at most between the channels of a pixel that counts as grey."""


_EXR = b"\x76\x2f\x31\x01"
_TARGA = b"TRUEVISION-XFILE.\0"
_MAX_HEADER = 1 << 16
"""Bytes of a text header that are searched for the size of the image."""


class _OtherFormatError(OSError):
    """A file begins like none of the formats that are read here."""


def write_grey(path: Path, image: np.ndarray) -> None:
    """Write (h, w) uint8 or uint16 as PNG, or float32 as OpenEXR with one channel Y, by the suffix of `path`.

    Raises
    ------
    OSError
        The disk takes no more.
    """
    if path.suffix == ".exr":
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        try:
            with utf8_name(path) as name:
                OpenEXR.File(header, {"Y": np.ascontiguousarray(image, dtype=np.float32)}).write(name)
        except RuntimeError as error:  # OpenEXR's for whatever the system says
            said = next((number for number in DISK if os.strerror(number) in str(error)), errno.EIO)
            raise OSError(said, os.strerror(said), str(path)) from error
        return
    from PIL import Image

    Image.fromarray(np.ascontiguousarray(image)).save(path, compress_level=1, compress_type=PNG_STRATEGY)


def read_grey(path: Path) -> np.ndarray:
    """(h, w) uint8, uint16 or float32 image of a file; colour becomes grey by luma (ITU-R BT.601).

    Raises
    ------
    FileFormatError
        The file cannot be read, or its pixels are none of these types.
    """
    check_file(path, FileFormatError)
    try:
        with _quiet():
            return _read_exr(path) if path.suffix.lower() == ".exr" else _read_raster(path)
    except FileFormatError:
        raise
    except _BROKEN as error:
        raise FileFormatError(f"{path} cannot be read as an image: {brief(error)}.") from error


def is_coloured(path: Path) -> bool:
    """Whether an image has colours, as far as a few of its pixels tell; False for what cannot be read here."""
    try:
        with _quiet(), _open_raster(path) as image:
            small = np.asarray(image.convert("RGB").resize((32, 32), 0), dtype=np.int16)
    except _BROKEN:  # Mitsuba says so, or reads what Pillow does not
        return False
    return bool((small.max(axis=-1) - small.min(axis=-1)).max() > GREY_LEVELS)


def check_pixels(path: Path) -> None:
    """Raise FileFormatError if an image file states more pixels, or bytes, than the limits allow, or is damaged.

    For files that others will decode: Mitsuba's libpng crashed on some. Of Radiance files, float maps and Targa only
    the stated size is checked; a file of yet another format than those of `read_grey` passes.
    """
    check_file(path, FileFormatError)
    try:
        with _quiet():
            if path.suffix.lower() == ".exr" or _start_of(path).startswith(_EXR):  # Mitsuba goes by the contents
                _open_exr(path)
                return
            try:
                with _open_raster(path) as image:
                    image.load()
            except _OtherFormatError:
                _check_stated_size(path)
    except FileFormatError:
        raise
    except _BROKEN as error:
        raise FileFormatError(f"{path} cannot be read as an image: {brief(error)}.") from error


def read_stack(paths: list[Path], size: tuple[int, int] | None = None) -> np.ndarray:
    """(k, h, w) uint8, uint16 or float32 images of files.

    size : (w, h) that they must have, if it is known; then it is asked before memory is allocated for all of them.

    Raises
    ------
    FileFormatError
        A file is missing or unreadable, or the images differ in size or type; the message names the file.
    """
    first: np.ndarray | None = None
    for i, path in enumerate(paths):
        if not os.path.lexists(path):  # unlike Path.exists, also of names that cannot be
            raise FileFormatError(f"frame {path} is missing.")
        image = read_grey(path)
        if first is None:
            first = image
            if size is not None and image.shape != size[::-1]:
                raise FileFormatError(
                    f"{path}: expected {size[0]} x {size[1]} pixels, got {image.shape[1]} x {image.shape[0]}."
                )
            try:
                frames = np.empty((len(paths), *image.shape), dtype=image.dtype)
            except MemoryError as error:
                gigabytes = len(paths) * image.nbytes / 1e9
                raise FileFormatError(
                    f"{path}: {len(paths)} images of that size take {gigabytes:.1f} GB, more than is free."
                ) from error
        if image.shape != first.shape or image.dtype != first.dtype:
            raise FileFormatError(
                f"{path}: expected {first.shape[1]} x {first.shape[0]} {first.dtype} as {paths[0].name}, "
                f"got {image.shape[1]} x {image.shape[0]} {image.dtype}."
            )
        frames[i] = image
    return frames


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep libraries from printing: OpenEXR and libtiff print what they also raise, Pillow warns of metadata."""
    sys.stdout.flush()
    sys.stderr.flush()
    with warnings.catch_warnings(), ExitStack() as kept:
        warnings.simplefilter("ignore")
        nowhere = os.open(os.devnull, os.O_WRONLY)
        kept.callback(os.close, nowhere)
        for stream in (1, 2):
            with suppress(OSError):  # it is closed
                before = os.dup(stream)
                kept.callback(os.close, before)
                kept.callback(os.dup2, before, stream)
                os.dup2(nowhere, stream)
        yield


def _start_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(16)


def _check_stated_size(path: Path) -> None:
    """Check the size that a Radiance file (RGBE), float map (PFM) or Targa states; none of them is decoded here.

    Mitsuba reads them, and makes room for as much as they state.
    """
    content = path.read_bytes()
    words: list[bytes] = []
    if content.startswith(b"#?"):
        for line in content.split(b"\n"):
            words = line.replace(b",", b" ").split()
            if len(words) == 4 and words[0] == b"-Y" and words[2] == b"+X":
                words = words[1::2]
                break
    elif content.startswith((b"PF", b"Pf")):
        words = content[2:_MAX_HEADER].split(None, 2)[:2]
    elif content.endswith(_TARGA) and len(content) >= 18:
        words = [b"%d" % size for size in struct.unpack_from("<HH", content, 12)]
    else:
        return
    if len(words) != 2 or not all(word.isdigit() and len(word) < 20 for word in words):
        raise ValueError("its header states no size")
    pixels = math.prod(map(int, words))
    if pixels == 0:  # Mitsuba ends Python over a Radiance file of no rows
        raise ValueError(f"its header states {int(words[0])} by {int(words[1])} pixels")
    limits.check("pixels", pixels, f"pixels in {path}", FileFormatError)


def _open_exr(path: Path) -> None:
    """Check the sizes in the headers of an OpenEXR file, before the library allocates them."""
    import OpenEXR

    pixels = size = 0
    with utf8_name(path) as name:
        parts = OpenEXR.File(name, header_only=True).parts
    for part in parts:
        low, high = part.header["dataWindow"]
        area = math.prod(max(0, int(b) - int(a) + 1) for a, b in zip(low, high, strict=True))
        pixels, size = max(pixels, area), size + 4 * area * len(part.header["channels"])
    limits.check("pixels", pixels, f"pixels in {path}", FileFormatError)
    limits.check("bytes", size, f"bytes in {path}, decompressed", FileFormatError)


def _read_exr(path: Path) -> np.ndarray:
    import OpenEXR

    _open_exr(path)
    with utf8_name(path) as name:
        file = OpenEXR.File(name, separate_channels=True)
    if not file.parts:
        raise FileFormatError(f"{path} cannot be read as an image: its pixels are damaged or missing.")
    channels = {name: c.pixels for name, c in file.channels().items()}
    if "Y" in channels:
        return np.asarray(channels["Y"], dtype=np.float32)
    r, g, b = (np.asarray(channels[c], dtype=np.float32) for c in "RGB")
    return np.asarray(0.299 * r + 0.587 * g + 0.114 * b, dtype=np.float32)


@contextmanager
def _open_raster(path: Path) -> Iterator[Any]:
    """The Pillow image of a file, not yet decoded, whose size is within the limits.

    `Image.open` would try every format, and apply a limit of its own, which is one for the whole process.
    """
    from PIL import (
        BmpImagePlugin,
        Image,
        JpegImagePlugin,
        PngImagePlugin,
        PpmImagePlugin,
        TiffImagePlugin,
    )

    plugins = (PngImagePlugin.PngImageFile, JpegImagePlugin.JpegImageFile, BmpImagePlugin.BmpImageFile,
               PpmImagePlugin.PpmImageFile, TiffImagePlugin.TiffImageFile)  # fmt: skip
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of damaged tags, which the pixels do not need
        start = file.read(16)
        for plugin in plugins:
            factory, accepts = Image.OPEN[plugin.format]
            if accepts is None or accepts(start) is not True:
                continue
            file.seek(0)
            with factory(file, str(path)) as image:
                limits.check("pixels", image.width * image.height, f"pixels in {path}", FileFormatError)
                yield image
            return
    raise _OtherFormatError(f"it is none of {', '.join(p.format for p in plugins)} or OpenEXR")


def _read_raster(path: Path) -> np.ndarray:
    with _open_raster(path) as image:
        if image.format == "TIFF" and (pages := _pages_of_one_size(image)) > 1:
            raise FileFormatError(
                f"{path} holds {pages} images of one size, expected one; save each in a file of its own."
            )
        if image.format == "PNG" and _is_deep_colour_png(path):
            raise FileFormatError(f"{path} is a colour PNG of 16 bits, which is not supported; convert it to grey.")
        if image.mode in ("I;16", "I;16L", "I;16B", "I;16N", "I"):
            values = np.asarray(image)
            if values.size and (values.min() < 0 or values.max() > 65535):
                raise FileFormatError(f"{path} holds values beyond 16 bits, from {values.min()} to {values.max()}.")
            return values.astype(np.uint16)
        if image.mode == "F":
            return np.asarray(image, dtype=np.float32)
        return np.asarray(image.convert("L"), dtype=np.uint8)


def _pages_of_one_size(image: Any) -> int:
    """Pages of a TIFF as large as the first, it included; a smaller one may be a preview. The first stays chosen."""
    sizes = []
    for page in range(image.n_frames):
        image.seek(page)
        sizes.append(image.size)
    image.seek(0)
    return sizes.count(sizes[0])


def _is_deep_colour_png(path: Path) -> bool:
    """Whether the header says 16 bits and colour; Pillow would cut those to 8 bits without a word."""
    with path.open("rb") as file:
        header = file.read(26)
    return header[24] == 16 and header[25] in (2, 6)
