# SPDX-License-Identifier: Apache-2.0
"""Tables in Markdown, written and read."""

from __future__ import annotations

import re
from collections.abc import Sequence

from rangesim.errors import visible

_SPECIAL = re.compile(r"([\\`|\[]|<(?! ))")
"""What Markdown reads as more than text; "< 0.1" is none of it."""
_ESCAPED = re.compile(r"\\([\\`|\[<])")
_BORDER = re.compile(r"(?<!\\)\|")
_BREAKS = re.compile(r"[\t\r\n]+")


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; what Markdown or a terminal would take for more than text is escaped or spelt out."""
    return "\n".join([_line(heads), "|" + " --- |" * len(heads), *map(_line, rows)]) + "\n"


def cells(line: str) -> list[str]:
    """Cells of a line of such a table, as they were before they became Markdown."""
    return [_ESCAPED.sub(r"\1", cell.strip()) for cell in _BORDER.split(line)[1:-1]]


def _line(texts: Sequence[str]) -> str:
    return "| " + " | ".join(_SPECIAL.sub(r"\\\1", visible(_BREAKS.sub(" ", text))) for text in texts) + " |"
