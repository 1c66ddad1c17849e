# SPDX-License-Identifier: Apache-2.0
"""The exceptions of pcgraph that are not a plain ``ValueError``: those about files; and how text of others is shown."""

from __future__ import annotations

import re

MAX_WORD = 160
"""Characters of a word in a message: paths are seldom longer, and two of them still make a message that can be read."""


class PcgraphError(Exception):
    """Base of every file error of pcgraph; the message is one sentence fit for a user."""


class CloudReadError(PcgraphError):
    """A file cannot be read as a point cloud: missing, truncated, or its header does not fit its data."""


class CloudWriteError(PcgraphError):
    """A result cannot be written: no such folder, no permission, or an unknown extension."""


def one_line(text: object) -> str:
    """Text of others, such as a file's name, for one line of a terminal: as `visible`, line ends and tabs too."""
    return visible(str(text)).replace("\n", "\\n").replace("\t", "\\t")


def without_long_words(message: str) -> str:
    """A message on one line, the middles of its longest words left out: names may have thousands of letters."""
    words = message.split()
    return " ".join(w if len(w) <= MAX_WORD else f"{w[: MAX_WORD // 2]}...{w[3 - MAX_WORD // 2 :]}" for w in words)


def visible(text: str) -> str:
    """Text whose control characters, but line ends and tabs, are spelt out, as `\\u202e`.

    They would turn round, break or hide the text beside them, or give orders to a terminal; and half a surrogate pair
    cannot be written at all.
    """
    return _CONTROLS.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]")
