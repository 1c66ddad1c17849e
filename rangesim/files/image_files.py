# SPDX-License-Identifier: Apache-2.0
"""Files of one grey image each: PNG, TIFF and others for digital numbers, OpenEXR for radiance."""

from __future__ import annotations

import errno
import math
import os
import struct
import sys
import warnings
import zlib
from collections.abc import Callable, Iterator
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
"""Suffixes of the files that `read_grey` reads."""
CHANNELS = {"grey": "", "red": "R", "green": "G", "blue": "B"}
"""Channels that can be read of a colour image, each with its name in files; "grey" is their luma (ITU-R BT.601)."""
LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in grey, by ITU-R BT.601."""
GREY_MODES = ("1", "L", "LA", "La", "I", "F", "I;16", "I;16L", "I;16B", "I;16N")
"""Modes of Pillow's images without colours."""
_BROKEN = (
    *(OSError, ValueError, SyntaxError, RuntimeError, LookupError, TypeError, EOFError, ArithmeticError, MemoryError),
    *(struct.error, zlib.error),
)
"""Errors that Pillow and OpenEXR raise on a file that is broken or no image."""
PNG_STRATEGY = zlib.Z_RLE
"""Strategy of deflate for PNG. Noise does not repeat, so a search for repetitions only takes longer; in a test, it made
the files of frames 5 % larger."""
GREY_LEVELS = 5
"""Largest difference between the channels (0 to 255) of a pixel that counts as grey. JPEG compression changes the
channels of a grey image by a few levels; at 0, such images would count as coloured."""
_EXR = b"\x76\x2f\x31\x01"
"""First four bytes of an OpenEXR file."""
_TARGA = b"TRUEVISION-XFILE.\0"
"""Last bytes of a Targa file."""
_MAX_HEADER = 1 << 16
"""Number of bytes, from the start of a float map, in which the reader looks for the size of the image. The header is a
few words; because of this limit, the reader does not read the pixels."""


class _OtherFormatError(OSError):
    """The format of a file is none of those that Pillow reads here."""


ONLY_COLOUR = 0.8
"""Least fraction of the change between two images that one channel has if the light has one colour. It is 1 if the
filters of the camera part the colours, and a third in white light."""


def write_grey(path: Path, image: np.ndarray) -> None:
    """Write an image (h, w): float32 as OpenEXR with one channel Y if `path` ends in .exr, else uint8 or uint16 as PNG.

    Raises
    ------
    OSError
        The file cannot be written, for example because the disk is full.
    """
    if path.suffix == ".exr":
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        try:
            with utf8_name(path) as name:
                OpenEXR.File(header, {"Y": np.ascontiguousarray(image, dtype=np.float32)}).write(name)
        except RuntimeError as error:  # OpenEXR raises it for every error of the system
            said = next((number for number in DISK if os.strerror(number) in str(error)), errno.EIO)
            raise OSError(said, os.strerror(said), str(path)) from error
        return
    from PIL import Image

    Image.fromarray(np.ascontiguousarray(image)).save(path, compress_level=1, compress_type=PNG_STRATEGY)


def read_grey(path: Path, channel: str = "grey") -> np.ndarray:
    """The image in a file as (h, w) uint8, uint16 or float32.

    channel : of a colour image, one of `CHANNELS`. Luma holds three tenths of red, so a red laser is nearly black in
        it.

    Raises
    ------
    FileFormatError
        The file cannot be read, its pixels are of another type, or it has no colours where one is asked for.
    """
    check_file(path, FileFormatError)
    try:
        with _quiet():
            return _read_exr(path, channel) if path.suffix.lower() == ".exr" else _read_raster(path, channel)
    except FileFormatError:
        raise
    except _BROKEN as error:
        raise FileFormatError(f"{path} cannot be read as an image: {brief(error)}.") from error


def is_coloured(path: Path) -> bool:
    """Whether an image has colours, judged by 32 x 32 of its pixels; False for a file that cannot be read here."""
    try:
        with _quiet(), _open_raster(path) as image:
            small = np.asarray(image.convert("RGB").resize((32, 32), 0), dtype=np.int16)
    except _BROKEN:  # Mitsuba reports it, or reads a format that Pillow does not
        return False
    return bool((small.max(axis=-1) - small.min(axis=-1)).max() > GREY_LEVELS)


def check_pixels(path: Path) -> None:
    """Raise FileFormatError if an image file is damaged, or states more pixels or bytes than the limits allow.

    Mitsuba will decode the file afterwards, and its libpng crashed on some damaged files. Of Radiance files, float maps
    and Targa files, only the stated size is checked. Files of other formats that `read_grey` does not read are
    accepted.
    """
    check_file(path, FileFormatError)
    try:
        with _quiet():
            if path.suffix.lower() == ".exr" or _start_of(path).startswith(_EXR):  # Mitsuba too looks at the contents
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


def read_stack(
    paths: list[Path], size: tuple[int, int] | None = None, read: Callable[[Path], np.ndarray] = read_grey
) -> np.ndarray:
    """The images in several files as one array (k, h, w), uint8, uint16 or float32.

    size : (w, h) that the images must have, pixels; None: that of the first. It is checked before memory is allocated
        for all images.
    read : function that reads one file.

    Raises
    ------
    FileFormatError
        A file is missing or unreadable, or the images differ in size or type; the message names the file.
    """
    first: np.ndarray | None = None
    for i, path in enumerate(paths):
        if not os.path.lexists(path):  # unlike Path.exists, accepts impossible names
            raise FileFormatError(f"frame {path} is missing.")
        image = read(path)
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
    """Silence libraries while the block runs: OpenEXR and libtiff print errors that they also raise; Pillow warns."""
    sys.stdout.flush()
    sys.stderr.flush()
    with warnings.catch_warnings(), ExitStack() as kept:
        warnings.simplefilter("ignore")
        nowhere = os.open(os.devnull, os.O_WRONLY)
        kept.callback(os.close, nowhere)
        for stream in (1, 2):
            with suppress(OSError):  # the stream is closed
                before = os.dup(stream)
                kept.callback(os.close, before)
                kept.callback(os.dup2, before, stream)
                os.dup2(nowhere, stream)
        yield


def _start_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(16)


def _check_stated_size(path: Path) -> None:
    """Check the size that a Radiance file (RGBE), a float map (PFM) or a Targa file states, without decoding it.

    Mitsuba allocates as much memory as the file states.
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
    if pixels == 0:  # Mitsuba ends the process on a Radiance file without rows
        raise ValueError(f"its header states {int(words[0])} by {int(words[1])} pixels")
    limits.check("pixels", pixels, f"pixels in {path}", FileFormatError)


def _open_exr(path: Path) -> None:
    """Check the sizes stated in the headers of an OpenEXR file, before the library allocates memory for them."""
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


def _no_colours(path: Path, channel: str) -> FileFormatError:
    return FileFormatError(f"{path} is grey and has no channel {channel}: leave out --channel.")


def _read_exr(path: Path, channel: str) -> np.ndarray:
    import OpenEXR

    _open_exr(path)
    with utf8_name(path) as name:
        file = OpenEXR.File(name, separate_channels=True)
    if not file.parts:
        raise FileFormatError(f"{path} cannot be read as an image: its pixels are damaged or missing.")
    channels = {name: c.pixels for name, c in file.channels().items()}
    if channel != "grey":
        if CHANNELS[channel] not in channels:
            raise _no_colours(path, channel)
        return np.asarray(channels[CHANNELS[channel]], dtype=np.float32)
    if "Y" in channels:
        return np.asarray(channels["Y"], dtype=np.float32)
    r, g, b = (np.asarray(channels[c], dtype=np.float32) for c in "RGB")
    return np.asarray(LUMA[0] * r + LUMA[1] * g + LUMA[2] * b, dtype=np.float32)


def only_colour(bright: Path, dark: Path) -> str | None:
    """The channel in which alone two images of a scene differ; None if several do, or if the images have no colours.

    Parameters
    ----------
    bright, dark : files of images of equal size, such as one with light and one without.
    """
    check_file(bright, FileFormatError)
    check_file(dark, FileFormatError)
    colours = []
    with _quiet():
        for path in (bright, dark):
            if path.suffix.lower() == ".exr":
                return None
            with _open_raster(path) as image:
                if image.mode not in ("RGB", "RGBA"):
                    return None
                colours.append(np.asarray(image.convert("RGB"), dtype=np.int16))
    change = np.abs(colours[0] - colours[1]).mean(axis=(0, 1))
    strongest = int(np.argmax(change))
    is_alone = change[strongest] > 0 and change[strongest] >= ONLY_COLOUR * change.sum()
    return list(CHANNELS)[1 + strongest] if is_alone else None


@contextmanager
def _open_raster(path: Path) -> Iterator[Any]:
    """The Pillow image of a file, not yet decoded, after a check of its size.

    `Image.open` is not used, because it would try every format and apply a limit that holds for the whole process.
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
        warnings.simplefilter("ignore", UserWarning)  # Pillow warns of damaged tags, which the pixels do not need
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


def _read_raster(path: Path, channel: str) -> np.ndarray:
    with _open_raster(path) as image:
        if image.format == "TIFF" and (pages := _pages_of_one_size(image)) > 1:
            raise FileFormatError(
                f"{path} holds {pages} images of one size, expected one; save each in a file of its own."
            )
        if image.format == "PNG" and _is_deep_colour_png(path):
            raise FileFormatError(f"{path} is a colour PNG of 16 bits, which is not supported; convert it to grey.")
        if channel != "grey":
            if image.mode in GREY_MODES:
                raise _no_colours(path, channel)
            return np.asarray(image.convert("RGB").getchannel(CHANNELS[channel]), dtype=np.uint8)
        if image.mode in ("I;16", "I;16L", "I;16B", "I;16N", "I"):
            values = np.asarray(image)
            if values.size and (values.min() < 0 or values.max() > 65535):
                raise FileFormatError(f"{path} holds values beyond 16 bits, from {values.min()} to {values.max()}.")
            return values.astype(np.uint16)
        if image.mode == "F":
            return np.asarray(image, dtype=np.float32)
        return np.asarray(image.convert("L"), dtype=np.uint8)


def _pages_of_one_size(image: Any) -> int:
    """Number of pages of a TIFF file that have the size of the first; a smaller page may be a preview.

    Afterwards the first page is selected again.
    """
    sizes = []
    for page in range(image.n_frames):
        image.seek(page)
        sizes.append(image.size)
    image.seek(0)
    return sizes.count(sizes[0])


def _is_deep_colour_png(path: Path) -> bool:
    """Whether a PNG file has colours of 16 bits, which Pillow would silently reduce to 8 bits."""
    with path.open("rb") as file:
        header = file.read(26)
    return header[24] == 16 and header[25] in (2, 6)
