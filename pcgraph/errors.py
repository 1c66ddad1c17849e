# SPDX-License-Identifier: Apache-2.0
"""Exceptions about files; and how foreign text, such as a file's name, is printed safely."""

from __future__ import annotations

import re

MAX_WORD = 160
"""Characters of a word in a message, count: paths are seldom longer, and a message with two of them can still be read.
Chosen by eye; not varied."""


class PcgraphError(Exception):
    """Base of every file error of pcgraph; the message is one sentence fit for a user."""


class CloudReadError(PcgraphError):
    """A file cannot be read as a point cloud: missing, truncated, or its header does not fit its data."""


class CloudWriteError(PcgraphError):
    """A result cannot be written: no such folder, no permission, or an unknown extension."""


def one_line(text: object) -> str:
    """Foreign text for one line of a terminal: control characters, line ends and tabs are spelt out."""
    return visible(str(text)).replace("\n", "\\n").replace("\t", "\\t")


def without_long_words(message: str) -> str:
    """A message on one line, without the middles of very long words: names may have thousands of letters."""
    words = message.split()
    return " ".join(w if len(w) <= MAX_WORD else f"{w[: MAX_WORD // 2]}...{w[3 - MAX_WORD // 2 :]}" for w in words)


def library_reason(error: BaseException) -> str:
    """Class and first line of an error that a library raised about a file; further lines are about its source code."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:MAX_WORD]}" if lines else type(error).__name__


def visible(text: str) -> str:
    """Text with its control characters spelt out, such as `\\u202e`; line ends and tabs stay.

    Control characters would reverse, break or hide the text beside them, or command the terminal. Half a surrogate pair
    cannot be written at all.
    """
    return _CONTROLS.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]")
