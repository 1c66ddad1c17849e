# SPDX-License-Identifier: Apache-2.0
"""Any stack of patterns, from a file: decoded by correlation."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.code import Code, CodeThresholds
from rangesim.codes.zncc_matching import check_columns, correlation_contradiction, decode_by_correlation
from rangesim.errors import FileFormatError
from rangesim.settings import limits
from rangesim.settings.bounds import check_fields
from rangesim.settings.config import brief, shown

MAX_UNEVEN = 2 / 255
"""Largest difference along the stripes of a pattern, as a fraction of white: JPEG and scaling change a value by 1."""

DIGEST_LENGTH = 16
"""Number of hexadecimal digits of a digest: 64 bits, so that two stacks never share one by chance."""

SMOOTH_PATTERNS = 12
"""Number of patterns of the stack without a file. With it, the periods and the seed below, no two places that are no
neighbours correlate by more than 0.95."""

MAX_SMOOTH_PERIODS = 16
"""Number of periods over the projector of the finest of these patterns; see `SMOOTH_PATTERNS`."""

SMOOTH_SEED = 7
"""Seed of the phases of these patterns; see `SMOOTH_PATTERNS`."""


@dataclass(frozen=True)
class ImageStack(Code):
    """A stack of patterns from a file, such as patterns that were optimised for a scene.

    Parameters
    ----------
    path : file .npy with an array (n, size) of values from 0 to 1; or folder of images, in the order of their names,
        each of which varies along one axis only. Empty: 12 smooth patterns of random fringes, for trials.
    digest : first 16 digits of the SHA-256 of the patterns; it is filled in when the file is read. A capture keeps it,
        so that a file with other patterns is refused.

    Raises
    ------
    ValueError
        The file is missing or holds no such patterns, or others than the digest says.

    References
    ----------
    Mirdehghan, Chen, Kutulakos: "Optimal structured light a la carte", CVPR (2018).

    Examples
    --------
    >>> ImageStack().patterns(1280).shape
    (12, 1280)
    """

    path: str = ""
    digest: str = ""

    type_name: ClassVar[str] = "image-stack"
    title: ClassVar[str] = "Structured light (stack of patterns)"

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.path:
            if self.digest:
                raise ValueError(
                    f"expected no digest without a path, got {shown(self.digest)}: give the path, or leave it out."
                )
            return
        patterns = _patterns_in(self.path)
        found = _digest(patterns)
        if self.digest and self.digest != found:
            raise ValueError(
                f"expected the patterns with the digest {shown(self.digest)} in {shown(self.path)}, got others, with "
                f"{found}."
            )
        object.__setattr__(self, "digest", found)

    def _stack(self, size: int) -> np.ndarray:
        return _patterns_in(self.path) if self.path else _smooth_patterns(size)

    def names(self, size: int) -> list[str]:
        return [f"pattern{i}" for i in range(len(self._stack(size)))]

    def patterns(self, size: int) -> np.ndarray:
        return self._stack(size)

    def check(self, size: int) -> None:
        patterns = self._stack(size)
        if patterns.shape[1] != size:
            raise ValueError(
                f"expected patterns of {size} pixels, got {patterns.shape[1]} in "
                f"{shown(self.path)}: make them for this size, or choose the projector that they are for."
            )
        check_columns(patterns, has_white_and_black=True)

    def check_shown(self, size: int, shown: Sequence[str]) -> None:
        coded = [name for name in self.names(size) if name in shown]
        check_columns(self._of(size, coded), has_white_and_black={"white", "black"} <= set(shown))

    def _of(self, size: int, names: Sequence[str]) -> np.ndarray:
        """Patterns (n, size) of these names."""
        every = self.names(size)
        return np.asarray(self._stack(size)[[every.index(name) for name in names]])

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        return decode_by_correlation(seen, self._of(seen.size, seen.names), thresholds.gray).code

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        return correlation_contradiction(seen, self._of(seen.size, seen.names))

    @property
    def details(self) -> str:
        return f"patterns of {Path(self.path).name}" if self.path else f"{SMOOTH_PATTERNS} smooth patterns"


@lru_cache(maxsize=8)
def _smooth_patterns(size: int) -> np.ndarray:
    """(n, size) float32, fringes of 1 to `MAX_SMOOTH_PERIODS` periods with random phases; read-only."""
    rng = np.random.default_rng(SMOOTH_SEED)
    x = (np.arange(size) + 0.5) / size
    periods = np.linspace(1, MAX_SMOOTH_PERIODS, SMOOTH_PATTERNS)
    phases = rng.random(SMOOTH_PATTERNS)
    patterns = (0.5 + 0.5 * np.cos(2 * np.pi * (periods[:, None] * x + phases[:, None]))).astype(np.float32)
    patterns.setflags(write=False)
    return patterns


def _digest(patterns: np.ndarray) -> str:
    digest = hashlib.sha256(repr(patterns.shape).encode())
    digest.update(np.ascontiguousarray(patterns).data)
    return digest.hexdigest()[:DIGEST_LENGTH]


def _patterns_in(path: str) -> np.ndarray:
    """(n, size) float32 in 0..1, the patterns in a file or a folder; ValueError if there are none."""
    place = Path(path)
    try:
        if place.is_dir():
            files = tuple(sorted(place.iterdir(), key=_in_natural_order))
            return _read(place, tuple((file, file.stat().st_mtime_ns) for file in files))
        return _read(place, ((place, place.stat().st_mtime_ns),))
    except FileFormatError as error:
        raise ValueError(f"expected patterns in {shown(path)}: {error}") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or brief(error)
        raise ValueError(f"expected patterns in {shown(path)}: {reason}.") from error


@lru_cache(maxsize=8)  # a sensor asks for its patterns again and again
def _read(place: Path, files: tuple[tuple[Path, int], ...]) -> np.ndarray:
    """The patterns of files, each with the time of its last change; read-only."""
    from rangesim.files.image_files import SUFFIXES, read_grey

    if len(files) == 1 and files[0][0] == place:
        patterns = np.load(place, mmap_mode="r", allow_pickle=False)
        if not isinstance(patterns, np.ndarray) or patterns.ndim != 2 or patterns.dtype.kind not in "fiub":
            raise ValueError(f"expected an array (n, size) of numbers, got {shown(patterns)}")
    else:
        images = [file for file, _ in files if file.suffix.lower() in SUFFIXES]
        if not images:
            raise ValueError(f"expected images ({', '.join(SUFFIXES)}) in the folder, got {len(files)} other files")
        lines = [_along_axis(read_grey(file), file) for file in images]
        lengths = sorted({len(line) for line in lines})
        if len(lengths) > 1:
            raise ValueError(
                "expected images of one size that all vary along the same axis, got patterns of "
                f"{lengths[0]} and of {lengths[-1]} pixels"
            )
        patterns = np.stack(lines)
    limits.check("frames", len(patterns), "patterns")
    limits.check("projector", patterns.shape[1], "pixels of a pattern")
    kept = np.array(patterns, dtype=np.float32, order="C")
    if not kept.size:
        raise ValueError(f"expected one pattern or more, got {shown(kept)}")
    low, high = float(kept.min()), float(kept.max())
    if not (low >= 0 and high <= 1):  # neither is a NaN
        raise ValueError(f"expected values from 0 to 1, got {low:g} to {high:g}: divide them by their full scale")
    kept.setflags(write=False)
    return kept


def _along_axis(image: np.ndarray, file: Path) -> np.ndarray:
    """(size,) float32 in 0..1, the values of a pattern along the axis on which it varies; constant: along the width."""
    values = image.astype(np.float32)
    if image.dtype.kind == "u":
        values /= np.iinfo(image.dtype).max
    down, across = np.ptp(values, axis=0).max(), np.ptp(values, axis=1).max()
    if min(down, across) > MAX_UNEVEN:
        raise ValueError(f"expected images that vary along one axis, got {file.name}, which varies along both")
    return np.asarray(values.mean(axis=0) if down <= MAX_UNEVEN else values.mean(axis=1))


def _in_natural_order(file: Path) -> list[tuple[int, int | str]]:
    """Key that sorts names so that image2 comes before image10."""
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", file.name.lower())]
