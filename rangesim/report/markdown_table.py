# SPDX-License-Identifier: Apache-2.0
"""A table of text, and the same in Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from rangesim.errors import visible

_SPECIAL = re.compile(r"([\\`|\[]|<(?! ))")
"""Characters that Markdown reads as more than text; the "<" of "< 0.1" is text."""
_BREAKS = re.compile(r"[\t\r\n]+")


class Table(NamedTuple):
    """Heads of the columns, and rows with a text for each column."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """The table in Markdown; characters that Markdown or a terminal would interpret are escaped or spelt out."""
        return "\n".join([_line(self.heads), "|" + " --- |" * len(self.heads), *map(_line, self.rows)]) + "\n"


def on_one_line(text: str) -> str:
    """The text without line breaks and control characters."""
    return visible(_BREAKS.sub(" ", text))


def _line(texts: Sequence[str]) -> str:
    return "| " + " | ".join(_SPECIAL.sub(r"\\\1", on_one_line(text)) for text in texts) + " |"
