# SPDX-License-Identifier: Apache-2.0
"""The walls between the data of a result and the page that shows it.

Names in a result directory may come from anyone. The template escapes them and the script writes them as text. Behind
that stands the page's own content security policy: the one script and the one style sheet of the package are named by
their hash, pictures lie in the page, and all else is refused, by default and for good: markup out of strings, handlers
and styles in attributes, requests, frames, forms.
"""

from __future__ import annotations

import base64
import hashlib
import re
from typing import Any

from markupsafe import Markup

from rangesim.errors import visible

_DECLARATIONS = re.compile(r"[a-z]+:[-#%.,() a-z0-9]+(;[a-z]+:[-#%.,() a-z0-9]+)*")


def content_policy(style: str, script: str) -> str:
    """The page's Content-Security-Policy: nothing but this style sheet, this script and pictures in the page itself."""
    return "; ".join(
        (
            "default-src 'none'",
            "img-src data:",
            f"style-src '{_hash(style)}'",
            f"script-src '{_hash(script)}'",
            "base-uri 'none'",
            "form-action 'none'",
            "require-trusted-types-for 'script'",
            "trusted-types 'none'",
        )
    )


def visible_text(value: Any) -> Any:
    """Text of a result with its control characters spelt out; anything else as it is."""
    return visible(value) if isinstance(value, str) and not isinstance(value, Markup) else value


class StyleRules:
    """Declarations that the numbers decide (a colour, a width), as classes of the page's one style sheet.

    The policy allows no style attributes, and a page without scripts must look the same.
    """

    def __init__(self) -> None:
        self._names: dict[str, str] = {}

    def name(self, declarations: str) -> str:
        """Class that carries these declarations; ValueError for what is more than plain properties and values."""
        if not _DECLARATIONS.fullmatch(declarations):
            raise ValueError(f"expected plain CSS declarations, got {declarations!r}.")
        return self._names.setdefault(declarations, f"r{len(self._names)}")

    def css(self) -> Markup:
        """The rules of all names given out so far."""
        rules = (f".{name} {{ {declarations} }}\n" for declarations, name in self._names.items())
        return Markup("".join(rules))  # each was checked when it was named


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
