# SPDX-License-Identifier: Apache-2.0
"""Numbers in text after a header that has their count: ascii PLY and PCD files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from io import BytesIO
from itertools import chain

import numpy as np
from numpy.typing import DTypeLike, NDArray

from pcgraph.cloud import PACKED_NAMES
from pcgraph.errors import CloudReadError

TextField = tuple[str, DTypeLike, int]
"""A field of a text file: its name, its type, and the count of its numbers for each point."""
NAN_OF_WINDOWS = r"(?i:1\.#(?:QNAN|SNAN|IND)0*|nan\(\w+\))"
"""Pattern of NaN as the C libraries of Windows write it, without a sign."""
INFINITY_OF_WINDOWS = r"(?i:1\.#INF0*)"
"""Pattern of infinity as the C libraries of Windows write it, without a sign."""
_NO_NUMBER = re.compile(rf"[-+]?{NAN_OF_WINDOWS}".encode())
_INFINITE = re.compile(rf"([-+]?){INFINITY_OF_WINDOWS}".encode())


def columns_of_rows(
    body: bytes, n_rows: int, fields: Sequence[TextField], first_line: int
) -> dict[str, NDArray[np.generic]]:
    """One array per field from the rows of a text; whole numbers of 64 bits are exact.

    Parameters and errors are as for `numbers_from_text` and `columns_from_text`.
    """
    width = sum(count for _, _, count in fields)
    columns = columns_from_text(numbers_from_text(body, n_rows, width, first_line), fields)
    first = 0
    for name, dtype, count in fields:
        kind = np.dtype(dtype)
        if kind.itemsize == 8 and kind.kind in "iu":
            columns[name] = _exact(columns[name], body, (first, first + count, width))
        first += count
    return columns


def columns_from_text(table: NDArray[np.float64], fields: Iterable[TextField]) -> dict[str, NDArray[np.generic]]:
    """One array per field of a text file, in the types that the header names.

    A packed colour of nan means no colour, because a text does not keep the bits of a nan. It becomes 0, black. If all
    are nan, the field is left out. Packed colours that are whole numbers of 32 bits may have a sign or not, whatever
    type the header names.

    Parameters
    ----------
    table : (n, m) float64
        Numbers of the text, row by row.
    fields : iterable of (name, dtype, count)
        The counts add up to m.

    Returns
    -------
    dict of field name to array
        (n,), or (n, c) if the count c is above 1.

    Raises
    ------
    CloudReadError
        A field of integers has a number that is not whole, or is out of the range of its type.
    """
    columns: dict[str, NDArray[np.generic]] = {}
    end = 0
    for name, dtype, count in fields:
        first, end = end, end + count
        numbers = table[:, first] if count == 1 else table[:, first:end]
        kind = np.dtype(dtype)
        is_packed = name.lower() in PACKED_NAMES and kind.itemsize == 4
        if is_packed and (none := np.isnan(numbers)).any():
            if none.all():
                continue
            numbers = np.where(none, 0.0, numbers)
        if kind.kind in "iu":
            limits = np.iinfo(kind)
            least, most = (-(1 << 31), (1 << 32) - 1) if is_packed else (int(limits.min), int(limits.max))
            _check_whole(name, numbers, least, most)
        if is_packed and kind.kind in "iu":
            numbers = numbers.astype(np.int64)
        with np.errstate(over="ignore", invalid="ignore"):
            columns[name] = numbers.astype(kind)
    return columns


def _check_whole(name: str, numbers: NDArray[np.float64], least: int, most: int) -> None:
    """Raise CloudReadError if a field of integers cannot hold one of the numbers, (n,) or (n, c)."""
    wrong = ~((numbers >= float(least)) & (numbers <= float(most)) & (numbers == np.rint(numbers)))
    if wrong.any():
        row = int(np.flatnonzero(wrong.reshape(len(wrong), -1).any(axis=1))[0])
        got = f"{numbers[wrong][0]:.12g}"
        raise CloudReadError(
            f"the header says that {name!r} holds whole numbers from {least} to {most}, "
            f"but row {row + 1} of numbers has {got}: correct the type in the header, or the number"
        )


def _exact(values: NDArray[np.generic], body: bytes, place: tuple[int, int, int]) -> NDArray[np.generic]:
    """Exact whole numbers of 64 bits from a text, in place of those that doubles have rounded.

    Parameters
    ----------
    values : (n,) or (n, c) int64 or uint64
        Rounded numbers.
    body : bytes
        The text.
    place : (first column, column after the last, number of columns in the text)
    """
    first, end, width = place
    words = body.split(None, len(values) * width)[: len(values) * width]
    rows = [words[row + first : row + end] for row in range(0, len(words), width)]
    try:
        return np.array([[_whole(word) for word in row] for row in rows], values.dtype).reshape(values.shape)
    except OverflowError:  # a number beyond the limits by less than a double resolves
        limits = np.iinfo(values.dtype.name)
        raise CloudReadError(f"expected whole numbers from {limits.min} to {limits.max}, as the header says") from None


def _whole(word: bytes) -> int:
    try:
        return int(word)
    except ValueError:
        return int(float(word))  # with a decimal point or an exponent


def numbers_from_text(body: bytes, n_rows: int, n_columns: int, first_line: int) -> NDArray[np.float64]:
    """The first `n_rows` rows of numbers in a text; empty lines are skipped.

    A row is one line. If the first row takes several lines, all others must take as many.

    Parameters
    ----------
    body : bytes
        Lines that end in a line feed. Text after the last row is not read.
    n_rows, n_columns : int
    first_line : int
        Number of the body's first line in the file, from 1, for messages.

    Returns
    -------
    (n_rows, n_columns) float64
        ``nan`` and ``inf``, in upper or lower case, are numbers too.

    Raises
    ------
    CloudReadError
        There are too few rows, a row has more or fewer words than columns, or a word is not a number.
    """
    needed = n_rows * n_columns
    if needed > len(body):  # a number takes at least a byte: no memory for numbers that only the header has
        raise CloudReadError(f"the header promises {needed} numbers, but only {len(body)} bytes follow")
    rows = _rows_of_text(body, n_rows, n_columns, first_line)
    # Not through an array of the words: each would take as many bytes as the longest.
    return np.fromiter(chain.from_iterable(rows), np.float64, needed).reshape(n_rows, n_columns)


def _rows_of_text(body: bytes, n_rows: int, n_columns: int, first_line: int) -> Iterator[list[float]]:
    """Numbers of each line, which must be as many as in the same line of the first row."""
    lengths = _line_lengths(body, n_columns)
    n_lines, read = n_rows * len(lengths), 0
    lines = enumerate(BytesIO(body), first_line)
    while read < n_lines:
        number, line = next(lines, (0, b""))
        if not number:
            rows = read // len(lengths)
            raise CloudReadError(f"the header promises {n_rows} points, but {rows} rows of numbers follow")
        words = line.split(None, n_columns)
        if not words:
            continue
        expected = lengths[read % len(lengths)]
        if len(words) != expected:
            got = f"more than {n_columns}" if len(words) > n_columns else f"{len(words)}"
            raise CloudReadError(
                f"expected {expected} numbers in each line, one for each field of the header, "
                f"but line {number} has {got}: correct the line or the header{_about_commas(line)}"
            )
        yield numbers_of_words(words, line, number)
        read += 1


def _line_lengths(body: bytes, n_columns: int) -> tuple[int, ...]:
    """Count of the words in each line of the first row.

    Most files have one line per row. The viewer of RealSense cameras writes coordinates and colours in two lines.
    """
    lengths: list[int] = []
    for line in BytesIO(body):
        if words := len(line.split(None, n_columns)):
            lengths.append(words)
        if sum(lengths) >= n_columns:
            break
    return tuple(lengths) if sum(lengths) == n_columns else (n_columns,)


def numbers_of_words(words: Sequence[bytes], line: bytes, number: int) -> list[float]:
    """Numbers of the words of a line; the C library of Windows writes NaN as ``1.#QNAN`` or ``-nan(ind)``.

    Raises
    ------
    CloudReadError
        A word is not a number. The message has the number of the line.
    """
    if b"_" in line:  # only Python reads 1_000 as a number
        word = next((word for word in words if b"_" in word), line).decode("latin-1")
        raise CloudReadError(f"expected numbers only in the ascii data, got in line {number}: {word[:80]!r}")
    try:
        return [float(word) for word in words]
    except ValueError:
        pass
    try:
        return [float(_INFINITE.sub(rb"\1inf", _NO_NUMBER.sub(b"nan", word))) for word in words]
    except ValueError as error:
        reason = f"{str(error)[:120]}{_about_commas(line)}"
        raise CloudReadError(f"expected numbers only in the ascii data, got in line {number}: {reason}") from None


def _about_commas(line: bytes) -> str:
    return "; it has commas: write decimal points, and blanks between numbers" if b"," in line else ""
