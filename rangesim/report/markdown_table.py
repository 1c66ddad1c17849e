# SPDX-License-Identifier: Apache-2.0
"""Tables of text, and their form in Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from rangesim.errors import visible

_SPECIAL = re.compile(r"([\\`|\[]|<(?! ))")
"""Characters that Markdown interprets. "<" is missing, because Markdown does not interpret the "<" of "< 0.1"."""
_BREAKS = re.compile(r"[\t\r\n]+")
"""Tabulators and line breaks, which would end a cell of a table."""


class Table(NamedTuple):
    """A table of text.

    heads : text above each column. rows : text of each cell, row by row.

    Examples
    --------
    >>> from rangesim.report.markdown_table import Table
    >>> print(Table(["surface", "bias (mm)"], [["matte", "0.3"]]).markdown(), end="")
    | surface | bias (mm) |
    | --- | --- |
    | matte | 0.3 |
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """The table in Markdown; characters that Markdown or a terminal interprets are escaped or spelt out."""
        return "\n".join([_line(self.heads), "|" + " --- |" * len(self.heads), *map(_line, self.rows)]) + "\n"


def on_one_line(text: str) -> str:
    """The text on one line: line breaks become spaces, control characters are spelt out."""
    return visible(_BREAKS.sub(" ", text))


def _line(texts: Sequence[str]) -> str:
    """Row of a Markdown table."""
    return "| " + " | ".join(_SPECIAL.sub(r"\\\1", on_one_line(text)) for text in texts) + " |"
