# SPDX-License-Identifier: Apache-2.0
"""One grey image per file: PNG, TIFF or JPEG for digital numbers, OpenEXR for radiance."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangesim.errors import FileFormatError

SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".pgm", ".exr")
"""Files that `read_grey` takes for images."""


def write_grey(path: Path, image: np.ndarray) -> None:
    """Write (h, w) uint8 or uint16 as PNG, or float32 as OpenEXR with one channel Y, by the suffix of `path`."""
    if path.suffix == ".exr":
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Y": np.ascontiguousarray(image, dtype=np.float32)}).write(str(path))
        return
    from PIL import Image

    Image.fromarray(np.ascontiguousarray(image)).save(path, compress_level=1)


def read_grey(path: Path) -> np.ndarray:
    """(h, w) uint8, uint16 or float32 image of a file; colour becomes grey by luma (ITU-R BT.601).

    Raises
    ------
    FileFormatError
        The file cannot be read, or its pixels are none of these types.
    """
    try:
        return _read_exr(path) if path.suffix.lower() == ".exr" else _read_raster(path)
    except FileFormatError:
        raise
    except (OSError, ValueError, SyntaxError, RuntimeError, KeyError) as error:
        raise FileFormatError(f"{path} cannot be read as an image: {error}.") from error


def read_stack(paths: list[Path]) -> np.ndarray:
    """(k, h, w) uint8, uint16 or float32 images of files.

    Raises
    ------
    FileFormatError
        A file is missing or unreadable, or the images differ in size or type; the message names the file.
    """
    first: np.ndarray | None = None
    for i, path in enumerate(paths):
        if not path.is_file():
            raise FileFormatError(f"frame {path} is missing.")
        image = read_grey(path)
        if first is None:
            first = image
            frames = np.empty((len(paths), *image.shape), dtype=image.dtype)
        if image.shape != first.shape or image.dtype != first.dtype:
            raise FileFormatError(
                f"{path}: expected {first.shape[1]} x {first.shape[0]} {first.dtype} as {paths[0].name}, "
                f"got {image.shape[1]} x {image.shape[0]} {image.dtype}."
            )
        frames[i] = image
    return frames


def _read_exr(path: Path) -> np.ndarray:
    import OpenEXR

    channels = {name: c.pixels for name, c in OpenEXR.File(str(path), separate_channels=True).channels().items()}
    if "Y" in channels:
        return np.asarray(channels["Y"], dtype=np.float32)
    r, g, b = (np.asarray(channels[c], dtype=np.float32) for c in "RGB")
    return np.asarray(0.299 * r + 0.587 * g + 0.114 * b, dtype=np.float32)


def _read_raster(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
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


def _is_deep_colour_png(path: Path) -> bool:
    """Whether the header says 16 bits and colour; Pillow would cut those to 8 bits without a word."""
    with path.open("rb") as file:
        header = file.read(26)
    return header[24] == 16 and header[25] in (2, 6)
