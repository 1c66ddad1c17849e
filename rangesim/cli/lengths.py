# SPDX-License-Identifier: Apache-2.0
"""Options that hold a length, in metres or with a unit."""

from __future__ import annotations

import typer

from rangesim.settings.lengths import metres


def length(text: str) -> float:
    """The length in metres of an option's text; ends with a message of the usage if the text is no length."""
    try:
        return metres(text, "the value")
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
