# SPDX-License-Identifier: Apache-2.0
"""Text files with a row of numbers for each point: ``.xyz``, ``.txt``, ``.csv``, ``.asc``, ``.pts`` and similar ones.

There is no standard. CloudCompare documents what files in use have in common ("ASCII cloud"). Leica documents ``.pts``:
a count of points, then rows of x y z, intensity, red green blue.

**Rows.** Numbers are separated by blanks, tabs, commas or semicolons. In rows with semicolons, a comma is the decimal
sign. An empty cell between commas or semicolons is NaN, and so are words such as ``NA`` and ``null``. ``True`` and
``FALSE`` are 1 and 0. All rows have as many numbers as the first. Lines that begin with ``#``, ``//`` or ``%`` are
comments, and so is any text after a ``#``.

**Names.** The names of the columns come from the first of these that is there:

1. the argument `columns` of `read_cloud`
2. a line of names above the rows, with or without quotes or a comment sign, such as ``//X Y Z R G B Scalar field``
3. the format (``.xyzn``, ``.xyzrgb``)
4. the number of columns, if it leaves no doubt:

===========  ==================================  =========================================================
columns      names                               condition
===========  ==================================  =========================================================
3            x y z
4            x y z intensity
6            x y z red green blue                all of the last three are whole numbers from 0 to 255
6            x y z nx ny nz                      all of the last three are unit vectors
7            x y z intensity red green blue      the last three are whole numbers from 0 to 255; the fourth to
                                                 sixth are not, or the file is a .pts
7            x y z red green blue, then          the fourth to sixth are whole numbers from 0 to 255, the last
             column_7                            three are not
===========  ==================================  =========================================================

All other columns have their index as name, counted from 0: ``column_3`` is the fourth.

**Types.** A column of numbers that are written as whole ones is int32, or int64 or uint64 if it needs 64 bits. All
other columns are float32 if this loses nothing, else float64. `encode_text` writes all digits of a number, so values
come back exactly, though perhaps in a narrower type.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import (
    COLOR_NAMES,
    LABEL_NAMES,
    NORMAL_NAMES,
    PACKED_NAMES,
    Cloud,
    cloud_from_columns,
    columns_of_cloud,
)
from pcgraph.errors import CloudReadError, CloudWriteError
from pcgraph.io.format import MAX_HEADER_BYTES, CloudFile, Format
from pcgraph.io.text_numbers import INFINITY_OF_WINDOWS, NAN_OF_WINDOWS

MAX_LINE = 1 << 16
"""Largest line, bytes: far more than rows have, so that one endless line does not fill the memory. Chosen by eye; not
varied."""
MAX_COLUMNS = 1024
"""Largest count of columns in a table: far more than tables of points have. Chosen by eye; not varied."""
MAX_OFF_UNIT = 0.01
"""Largest difference between the length of a normal and 1, a fraction: programs write three digits after the point or
more. Chosen by eye; not varied."""
MAX_EXACT = 2.0**53
"""Largest whole number up to which all are exact in float64, because it has 53 bits for the digits."""
MIN_ROW_BYTES = 6
"""Least size of a row, bytes: three digits, two blanks and a line end."""
ROWS_AT_ONCE = 100_000
"""Count of rows that become text at a time, so that the strings of a large cloud are not all in memory at once. Chosen
by eye; not varied."""
COMMENTS = ("#", "//", "%")

UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
"""Byte order marks of a text in UTF-16."""

_WHOLE = re.compile(r"[-+]?[0-9]+")
_COUNT = re.compile(r"[0-9]{1,15}")
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]+(,[0-9]+([eE][-+]?[0-9]+)?)?")
_UNIT = re.compile(r"\s*[\[(][^\])]*[\])]$")
_MISSING = ("NA", "N/A", "n/a", "#N/A", "<NA>", "null", "NULL", "None")
"""Words for a missing number in tables of R, pandas, spreadsheets, databases and Python; they are read as NaN."""
_TRUTHS = {"True": "1", "TRUE": "1", "true": "1", "False": "0", "FALSE": "0", "false": "0"}
"""Truth values in tables of pandas, R, Polars and spreadsheets, and the numbers as which they are read."""
_OF_NUMBERS = b"0123456789.+- \t,;\r\n"
"""Bytes of which most rows consist. A text without them is short, and so is quickly searched for other words."""
_IS_NAN = re.compile(rf"(?<![^\s,;])[-+]?(?:{'|'.join(_MISSING)}|{NAN_OF_WINDOWS})(?![^\s,;])")
_IS_INFINITE = re.compile(INFINITY_OF_WINDOWS)
_IS_TRUTH = re.compile(rf"(?<![^\s,;\"])(?:{'|'.join(_TRUTHS)})(?![^\s,;\"])")
_SHORT_COLORS = (("r", "g", "b"), ("rf", "gf", "bf"))
"""Names of red, green and blue in files of CloudCompare: as bytes, and as floats from 0 to 1."""
_NAMES_BEFORE_A_FIELD = {"x", "y", "z", *COLOR_NAMES, *NORMAL_NAMES[1], "intensity"}
"""Names, in lower case, that CloudCompare writes before the name of a single scalar field, which may have blanks."""
_PTS = (
    ("x", "y", "z"),
    ("x", "y", "z", "intensity"),
    ("x", "y", "z", *COLOR_NAMES),
    ("x", "y", "z", "intensity", *COLOR_NAMES),
)
"""Columns that a .pts file may have."""


# ---- Rows ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Dialect:
    """Separator of the numbers in a row, as in the CSV dialects of Python's csv module.

    Attributes
    ----------
    separator : str
        A comma or a semicolon; a blank means any blanks and tabs.
    has_last : bool
        Whether rows end in a separator.
    has_empty : bool
        Whether cells may be empty.
    """

    separator: str
    has_last: bool = False
    has_empty: bool = True

    @staticmethod
    def of(line: str) -> Dialect | None:
        """The dialect of a line; None if the line is not a row of numbers."""
        separator = next((sign for sign in ";," if sign in line), " ")
        found = Dialect(separator, has_last=separator != " " and line.rstrip().endswith(separator))
        words = found.row(line.partition("#")[0]).split()
        return found if words and all(is_number(word) for word in words) else None

    def row(self, line: str) -> str:
        """The numbers of a row, separated by blanks, with points as decimal signs."""
        if '"' in line:
            line = line.replace('"', "")
        if self.separator == " ":
            return line
        separator = self.separator
        if self.has_last:
            line = line.rstrip().removesuffix(separator)
        if self.has_empty:
            line = separator.join(cell if cell.strip() else "nan" for cell in line.split(separator))
        if separator == ";":
            line = line.replace(",", ".")
        return line.replace(separator, " ")


def is_number(word: str) -> bool:
    """Whether a word is a number as C's strtod reads it."""
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word and word.isascii()  # only Python reads 1_000 and other digits as numbers


class TextLines:
    """Iterator over the lines of a text, without empty lines and without leading blanks.

    Attributes
    ----------
    number : int
        Number of the last line that was read, from 1; 0 before the first.
    size : int
        Bytes of the whole text.
    """

    def __init__(self, content: bytes) -> None:
        self.number, self.size = 0, len(content)
        encoding = encoding_of(content)
        _refuse_long_lines(content)
        rare = content.translate(None, _OF_NUMBERS)
        is_odd = b".#" in content or any(word.encode() in rare for word in (*_MISSING, *_TRUTHS, "an(", "AN("))
        self._has_odd_numbers = is_odd or encoding == "utf-16"
        self._stream = io.TextIOWrapper(io.BytesIO(content), encoding, errors="replace", newline=None)

    def __iter__(self) -> Iterator[str]:
        try:
            for line in self._stream:
                self.number += 1
                if not line.isspace():
                    yield self._usual(line.lstrip()) if self._has_odd_numbers else line.lstrip()
        except UnicodeError:
            raise CloudReadError("expected a text in UTF-16, as its first bytes say, but it is damaged") from None

    @staticmethod
    def _usual(line: str) -> str:
        """The line with NaN and infinity spelled ``nan`` and ``inf``, and with truth values as numbers."""
        line = _IS_TRUTH.sub(lambda found: _TRUTHS[found[0]], line)
        return _IS_INFINITE.sub("inf", _IS_NAN.sub("nan", line))


def _refuse_long_lines(content: bytes) -> None:
    """Raise CloudReadError if a block of `MAX_LINE` bytes has no line end."""
    for start in range(0, len(content) - MAX_LINE, MAX_LINE):
        if all(content.find(end, start, start + MAX_LINE) < 0 for end in (b"\n", b"\r")):
            number = max(content.count(end, 0, start) for end in (b"\n", b"\r")) + 1
            raise CloudReadError(f"expected rows of numbers, but line {number} has {MAX_LINE} bytes or more")


def encoding_of(content: bytes) -> str:
    """Encoding of a text: UTF-16 if it has the byte order mark, else UTF-8 if it is valid, else Latin-1.

    Raises CloudReadError if the content is binary.
    """
    if content.startswith(UTF_16):
        return "utf-16"
    if content.startswith(codecs.BOM_UTF8):
        return "utf-8-sig"
    start = content[:MAX_HEADER_BYTES]
    if b"\0" in start:
        raise CloudReadError("expected a text with a row of numbers for each point, got binary data")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def numbers(rows: Iterable[str], lines: TextLines) -> NDArray[np.float64]:
    """Table (n, m) float64 of the rows, with m numbers in each.

    Parameters
    ----------
    rows : iterable of str
        Rows of numbers between blanks, which come from `lines`.
    lines : TextLines
        It has the number of the line for messages.

    Raises
    ------
    CloudReadError
        There is no row, a row has more or fewer numbers than the first, or a word is not a number.
    """
    rows = iter(rows)
    first = next(rows, None)
    if first is None:
        raise CloudReadError(f"expected a row of numbers after line {lines.number}, but there is none")
    try:
        return np.loadtxt(chain((first,), rows), np.float64, comments="#", ndmin=2)
    except ValueError as error:
        reason = str(error)
        if found := re.search(r"changed from (\d+) to (\d+)", reason):
            wanted, got = found.groups()
            raise CloudReadError(
                f"expected {wanted} numbers in each row, as in the first, but line {lines.number} has {got}"
            ) from None
        word = re.search(r"could not convert string (.*) to ", reason, re.DOTALL)
        got = word[1][:80] if word else reason[:80]
        raise CloudReadError(f"expected numbers only in the rows, but line {lines.number} has {got}") from None


# ---- Names ---------------------------------------------------------------------------------------------------------


def known_names(names: Sequence[str]) -> tuple[str, ...]:
    """The names, with those of coordinates and colours replaced by the ones that `cloud_from_columns` expects."""
    names = [name or f"column_{i}" for i, name in enumerate(names)]
    bare = [_UNIT.sub("", name) for name in names]
    found = [short if short.lower() in ("x", "y", "z") else name for short, name in zip(bare, names, strict=True)]
    lower = [name.lower() for name in names]
    for short in _SHORT_COLORS:
        if all(name in lower for name in short) and not any(name in lower for name in COLOR_NAMES):
            full = dict(zip(short, COLOR_NAMES, strict=True))
            return tuple(full.get(name.lower(), name) for name in found)
    return tuple(found)


def _words(line: str, separator: str | None) -> list[str]:
    """Names in a line; those in quotes may have blanks. Without a separator, blanks and tabs separate them."""
    text = line.rstrip("\r\n")
    for sign in COMMENTS:
        text = text.removeprefix(sign)
    text = text.lstrip()
    if separator is not None:
        names = [
            name.strip().strip("'") for name in next(csv.reader([text], delimiter=separator, skipinitialspace=True))
        ]
        return names[:-1] if names and not names[-1] else names
    return [quoted or word for quoted, word in re.findall(r'"([^"]+)"|(\S+)', text)]


def _header(line: str, count: int | None) -> tuple[str, ...] | None:
    """The `count` names in a line; None if it has more or fewer names, or x, y or z is missing."""
    for separator in (",", ";", "\t", None):
        try:
            names = _words(line, separator)
        except csv.Error:
            continue
        found = known_names(names)
        if count is not None and separator is None and len(found) > count:  # CloudCompare: X Y Z Scalar field
            before = known_names(names[: count - 1])
            if _NAMES_BEFORE_A_FIELD.issuperset(name.lower() for name in before):
                found = (*before, " ".join(names[count - 1 :]))
        if count in (None, len(found)) and {"x", "y", "z"} <= {name.lower() for name in found}:
            return found
    return None


def names_of_numbers(table: NDArray[np.float64], is_pts: bool) -> tuple[str, ...]:
    """Names for the columns of a table without names, by the rules in the module's docstring.

    Raises CloudReadError if there are fewer than three columns, or if the first seems to be the number of the point, as
    total stations write it.
    """
    count = table.shape[1]
    if count < 3:
        raise CloudReadError(f"expected x, y and z in each row, got {count} numbers")
    if not is_pts and count > 3 and len(table) > 2 and _counts(table[:, 0]) and not _are_whole(table[:, 1:4]):
        raise CloudReadError(
            "expected x, y and z first, but the first column seems to count the points: name the columns, "
            "as by columns=['id', 'x', 'y', 'z'] or --columns id,x,y,z"
        )
    xyz, named = ("x", "y", "z"), tuple(f"column_{i}" for i in range(3, count))
    if count == 4:
        named = ("intensity",)
    elif count == 6 and _are_bytes(table[:, 3:6]):
        named = COLOR_NAMES
    elif count == 6 and _are_unit_vectors(table[:, 3:6]):
        named = NORMAL_NAMES[1]
    elif count == 7:
        first, last = _are_bytes(table[:, 3:6]), _are_bytes(table[:, 4:7])
        if last and (not first or is_pts):
            named = ("intensity", *COLOR_NAMES)
        elif first and not last:
            named = (*COLOR_NAMES, "column_6")
    return (*xyz, *named)


def _are_whole(values: NDArray[np.float64]) -> bool:
    return bool((values == np.rint(values)).all())


def _counts(values: NDArray[np.float64]) -> bool:
    return _are_whole(values) and bool((np.diff(values) > 0).all())


def _are_bytes(values: NDArray[np.float64]) -> bool:
    return bool(((values >= 0) & (values <= 255) & (values == np.rint(values))).all())


def _are_unit_vectors(values: NDArray[np.float64]) -> bool:
    return bool((np.abs(np.linalg.norm(values, axis=1) - 1) <= MAX_OFF_UNIT).all())


# ---- Reading -------------------------------------------------------------------------------------------------------


@dataclass
class TextTable:
    """The rows of a text, and the names above them.

    Attributes
    ----------
    lines : TextLines
        The lines from which `rows` comes; it has the number of the last line that was read.
    names : tuple of str, or None
        Names of the columns, if a line above the rows has them.
    first : list of str
        Words of the first row; empty if there is no row.
    rows : iterator of str
        All rows, with blanks between the numbers. It can be used once.
    """

    lines: TextLines
    names: tuple[str, ...] | None
    first: list[str]
    rows: Iterator[str]


def open_table(content: bytes, is_named: bool = False) -> TextTable:
    """The table in a text.

    Parameters
    ----------
    content : bytes
    is_named : bool
        Whether the user named the columns. Then any lines may be above the rows.

    Raises
    ------
    CloudReadError
        The content is not a text, it has no rows, or a line above them is neither a comment nor names nor a count.
    """
    lines = TextLines(content)
    above: list[tuple[int, str]] = []
    promised: int | None = None
    characters = 0
    stream = iter(lines)
    for line in stream:
        dialect = None if line.startswith(COMMENTS) else Dialect.of(line)
        if dialect is None:
            above.append((lines.number, line))
            characters += len(line)
            if characters > MAX_HEADER_BYTES:
                if _names(above, None):
                    _refuse_words(above)
                raise CloudReadError(f"expected rows of numbers, but the first {lines.number} lines have none")
        elif not promised and _COUNT.fullmatch(line.strip()):
            promised = _promise(line, lines)
        else:
            _refuse_decimal_commas(line, lines.number)
            whole = replace(dialect, has_last=False)  # the last cell may be empty, if the names say that there is one
            if dialect.has_last and _names(above, len(whole.row(line).split())):
                dialect = whole
            dialect = replace(dialect, has_empty=_has_empty(content, dialect.separator))
            first = dialect.row(line).partition("#")[0].split()
            names = _names(above, len(first))
            _refuse_strangers(above, len(first), is_named)
            return TextTable(lines, names, first, _rows(chain((line,), stream), dialect, promised, lines))
    names = _names(above, None)
    if promised is None and names is None:
        number, line = above[0] if above else (1, "")
        raise CloudReadError(f"expected rows of numbers, but line {number} and all others have none: {line[:80]!r}")
    _refuse_words(above)
    _refuse_missing(promised)
    return TextTable(lines, names, [], iter(()))


def _has_empty(content: bytes, separator: str) -> bool:
    """Whether there may be empty cells: between two separators, or between a separator and an end of a line."""
    signs = [f"{separator}{sign}" for sign in (separator, f" {separator}", "\n", "\r")]
    return content.startswith(UTF_16) or any(sign.encode() in content for sign in (*signs, f"\n{separator}"))


def _promise(line: str, lines: TextLines) -> int:
    """The count of points in a line; raises CloudReadError if the file is too small for that many."""
    count = int(line)
    if count * MIN_ROW_BYTES > lines.size + 1:  # the last row may have no end
        raise CloudReadError(
            f"line {lines.number} promises {count} points, but the whole file has only {lines.size} bytes"
        )
    return count


def _refuse_decimal_commas(line: str, number: int) -> None:
    words = line.split()
    has_commas = len(words) > 2 and ";" not in line and "," in line
    if has_commas and all(_DECIMAL_COMMA.fullmatch(word) for word in words):
        raise CloudReadError(
            f"line {number} seems to have decimal commas, which are read between semicolons only: "
            "write points, or put semicolons between the columns"
        )


def _names(above: list[tuple[int, str]], count: int | None) -> tuple[str, ...] | None:
    """The names in the last line above the rows with `count` names; None if there is no such line."""
    return next((names for _, line in reversed(above) if (names := _header(line, count))), None)


def _refuse_strangers(above: list[tuple[int, str]], count: int, is_named: bool) -> None:
    """Raise CloudReadError if a line above the rows is neither a comment nor the names of columns."""
    for number, line in above:
        if not is_named and not line.startswith(COMMENTS) and _header(line, count) is None:
            raise CloudReadError(
                f"line {number} is neither a comment (# or //) nor {count} names of columns, x, y and z among them: "
                f"{line.strip()[:80]!r}; name the columns by columns=[...] or --columns"
            )


def _refuse_words(above: list[tuple[int, str]]) -> None:
    """Raise CloudReadError for the first line that is neither a comment nor names, in a text that has no row."""
    for number, line in above:
        if not line.startswith(COMMENTS) and _header(line, None) is None:
            word = next(word for word in re.split(r"[\s,;]+", f"{line} ") if not is_number(word))
            raise CloudReadError(
                f"expected numbers only in the rows, but line {number} has {word[:80]!r}: "
                "leave out columns of words and of dates"
            )


def _refuse_missing(left: int | None) -> None:
    if left:
        raise CloudReadError(f"the count above the points says that there are {left} more than the file has")


def _rows(stream: Iterator[str], dialect: Dialect, promised: int | None, lines: TextLines) -> Iterator[str]:
    """The rows in a stream of lines, of all blocks if the text has blocks with counts of points."""
    left = promised
    for line in stream:
        if line.startswith(COMMENTS):
            continue
        if left == 0:
            if not _COUNT.fullmatch(line.strip()):
                raise CloudReadError(f"line {lines.number} has one point more than the count above the points says")
            left = _promise(line, lines)
            continue
        if left is not None:
            left -= 1
        yield dialect.row(line)
    _refuse_missing(left)


def read_text(file: CloudFile, is_pts: bool = False, usual: tuple[str, ...] | None = None) -> Cloud:
    """Cloud of a text file; the module's docstring describes the rows, names and types.

    Parameters
    ----------
    file : CloudFile
    is_pts : bool
        Whether seven columns are x y z, intensity, red green blue.
    usual : names, optional
        Names of the format's columns, for files that have as many and do not name them.

    Raises
    ------
    CloudReadError
        The content is not a text, or not one of numbers; rows have different numbers of columns; there are fewer rows
        than a count says; the names do not fit the columns, or x, y or z is not among them.

    Examples
    --------
    >>> cloud = read_text(CloudFile(b"//X Y Z R G B Scalar field\\n1.5 2 3 255 0 0 7\\n4 5 6 0 0 255 8\\n"))
    >>> cloud.points.tolist(), cloud.colors.tolist(), cloud.columns
    ([[1.5, 2.0, 3.0], [4.0, 5.0, 6.0]], [[255, 0, 0], [0, 0, 255]], {'Scalar field': array([7, 8], dtype=int32)})
    """
    table = open_table(file.content, file.columns is not None)
    if not table.first:
        names = file.columns or table.names or ("x", "y", "z")
        empty = {name: np.zeros(0, np.int32 if name.lower() in LABEL_NAMES else np.float32) for name in names}
        return cloud_from_columns(empty, (0,))
    if len(table.first) > MAX_COLUMNS:
        raise CloudReadError(f"expected at most {MAX_COLUMNS} numbers in a row, got {len(table.first)}")
    values = numbers(table.rows, table.lines)
    if file.columns is not None:
        names = known_names(file.columns)
        if len(names) != len(table.first):
            raise CloudReadError(f"expected {len(names)} numbers in each row, as columns names, got {len(table.first)}")
    elif table.names is not None:
        names = table.names
    else:
        fits = usual is not None and len(usual) == len(table.first)
        names = usual if fits and usual else names_of_numbers(values, is_pts)
    if len(set(names)) != len(names):
        raise CloudReadError(f"expected distinct names of columns, got {' '.join(names)[:200]}")
    is_whole = [_WHOLE.fullmatch(word) is not None for word in table.first]
    columns = {
        name: _whole(values[:, i], file.content, i) if is_whole[i] else _floats(values[:, i])
        for i, name in enumerate(names)
    }
    return cloud_from_columns(_in_types_of_colors(columns), (len(values),))


def column_of_numbers(values: NDArray[np.float64]) -> NDArray[np.generic]:
    """The column as int32 if all its numbers are whole and fit, else as floats."""
    limits = np.iinfo(np.int32)
    fits = (values == np.rint(values)) & (values >= limits.min) & (values <= limits.max)
    return values.astype(np.int32) if fits.all() else _floats(values)


def _floats(values: NDArray[np.float64]) -> NDArray[np.generic]:
    """The values as float32 if this loses nothing, else as float64."""
    with np.errstate(over="ignore"):
        narrow = values.astype(np.float32)
    return narrow if np.array_equal(narrow, values, equal_nan=True) else values.copy()


def _whole(values: NDArray[np.float64], content: bytes, column: int) -> NDArray[np.generic]:
    """A column of whole numbers as int32, or as int64 or uint64 if needed; as floats if some are not whole."""
    if not (np.isfinite(values).all() and (values == np.rint(values)).all()):
        return _floats(values)
    if np.abs(values).max() < MAX_EXACT:
        fits = np.iinfo(np.int32).min <= values.min() and values.max() <= np.iinfo(np.int32).max
        return values.astype(np.int32 if fits else np.int64)
    for kind in (np.int64, np.uint64):  # float64 has rounded them
        table = open_table(content, is_named=True)
        try:
            return np.asarray(np.loadtxt(table.rows, kind, comments="#", usecols=column, ndmin=1))
        except ValueError:
            continue
    return _floats(values)


def _in_types_of_colors(columns: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    """The columns with colours of whole numbers as uint8, or as uint16 beyond 255, so that the type tells white."""
    lower = {name.lower(): name for name in columns}
    channels = {lower[name]: columns[lower[name]] for name in COLOR_NAMES if name in lower}
    if any(one.dtype.kind == "f" for one in channels.values()):
        columns = columns | {name: one.astype(np.float64) for name, one in channels.items()}
    elif all(one.min() >= 0 and one.max() <= np.iinfo(np.uint16).max for one in channels.values()):
        is_byte = all(one.max() <= np.iinfo(np.uint8).max for one in channels.values())
        columns = columns | {name: one.astype(np.uint8 if is_byte else np.uint16) for name, one in channels.items()}
    for name in columns.keys() & {lower[name] for name in PACKED_NAMES if name in lower}:
        one = columns[name]
        if one.dtype.kind == "f":  # as float32, they would be taken for the bits of packed colours
            columns = columns | {name: one.astype(np.float64)}
        elif one.dtype == np.int64 and one.min() >= 0 and one.max() <= np.iinfo(np.uint32).max:
            columns = columns | {name: one.astype(np.uint32)}
    return columns


# ---- Writing -------------------------------------------------------------------------------------------------------


def encode_text(cloud: Cloud, suffix: str) -> bytes:
    """Bytes of a text file: a line of names, and a row for each point.

    Parameters
    ----------
    cloud : Cloud
        As `pcgraph.cloud.plain_cloud` returns it. Vectors of c numbers become columns ``name_0`` and so on.
    suffix : str
        ".csv": commas separate names and numbers. Other suffixes: blanks separate them, and the line of names begins
        with ``//``, as in files of CloudCompare.

    Raises
    ------
    CloudWriteError
        A column has no numbers, or numbers of more than 64 bits, or a name that would be read as another one.
    """
    columns = _scalars(columns_of_cloud(cloud))
    separator = "," if suffix == ".csv" else " "
    line = separator.join(_quoted(name, separator) for name in columns)
    line = line if separator == "," else f"//{line}"
    if "\n" in line or "\r" in line or _header(line, len(columns)) != tuple(columns):
        raise CloudWriteError(f"expected names of columns that a text keeps, got {line[:200]!r}: rename them")
    return f"{line}\n".encode() + _body(columns, separator)


def encode_pts(cloud: Cloud, suffix: str) -> bytes:
    """Bytes of a .pts file: the count of points, then x y z, intensity, red green blue, the last four if there are any.

    Raises
    ------
    CloudWriteError
        The cloud has other columns.
    """
    columns = _scalars(columns_of_cloud(cloud))
    names = tuple(name for name in _PTS[-1] if name in columns)
    if names not in _PTS or len(names) < len(columns):
        others = ", ".join(name for name in columns if name not in names)
        raise CloudWriteError(
            f"a .pts file holds x y z, intensity and colours, but the cloud has also {others[:200]}: "
            "write a .csv or .txt file"
        )
    return f"{len(columns['x'])}\n".encode() + _body({name: columns[name] for name in names}, " ")


def _scalars(columns: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    """The columns, with a column of vectors split into one column for each of their numbers."""
    parts: dict[str, NDArray[np.generic]] = {}
    for name, column in columns.items():
        own = {name: column} if column.ndim == 1 else {f"{name}_{i}": part for i, part in enumerate(column.T)}
        if not own.keys().isdisjoint(parts):
            raise CloudWriteError(f"expected distinct columns, but {name!r} comes twice as a text has it: rename it")
        parts |= own
    return parts


def _quoted(name: str, separator: str) -> str:
    """The name, in quotes if it has blanks or separators."""
    return f'"{name}"' if separator in name or any(letter.isspace() for letter in name) else name


def _body(columns: dict[str, NDArray[np.generic]], separator: str) -> bytes:
    """Rows of text, one for each point; each number has the fewest digits that are read as the same number."""
    n = len(columns["x"])
    blocks = []
    for start in range(0, n, ROWS_AT_ONCE):
        words = [_number_words(name, column[start : start + ROWS_AT_ONCE]) for name, column in columns.items()]
        blocks.append("".join(f"{row}\n" for row in map(separator.join, zip(*words, strict=True))).encode())
    return b"".join(blocks)


def _number_words(name: str, column: NDArray[np.generic]) -> list[str]:
    kind, size = column.dtype.kind, column.dtype.itemsize
    if kind == "b":
        column = column.astype(np.uint8)
    elif kind not in "iuf" or size > 8:
        raise CloudWriteError(f"expected the column {name!r} as numbers of at most 64 bits, got {column.dtype}")
    return list(map(repr, column.astype(np.float64).tolist() if kind == "f" else column.tolist()))


TEXT = Format("text", (".xyz", ".txt", ".csv", ".asc"), read_text, encode_text, takes_names=True)
PTS = Format("pts", (".pts",), partial(read_text, is_pts=True), encode_pts, holds_columns=False, takes_names=True)
XYZN = Format("xyzn", (".xyzn",), partial(read_text, usual=("x", "y", "z", *NORMAL_NAMES[1])), takes_names=True)
XYZRGB = Format("xyzrgb", (".xyzrgb",), partial(read_text, usual=("x", "y", "z", *COLOR_NAMES)), takes_names=True)
