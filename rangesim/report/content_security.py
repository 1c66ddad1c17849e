# SPDX-License-Identifier: Apache-2.0
"""Content security of the pages: text of a result can never become markup or code.

Names in a result directory may come from anyone. The template escapes them, and the script writes them as text. As a
second defence, each page has a content security policy. It allows the package's own script and style sheet, which it
names by their hashes, and pictures inside the page. It refuses everything else: markup from strings, handlers and
styles in attributes, requests, frames and forms.
"""

from __future__ import annotations

import re
from typing import Any

from markupsafe import Markup

from rangesim.errors import visible

_DECLARATIONS = re.compile(r"[a-z-]+:[-#%.,() a-z0-9]+(;[a-z-]+:[-#%.,() a-z0-9]+)*")
"""CSS declarations that `StyleRules` takes: properties with plain values, and no URL or quote."""


def visible_text(value: Any) -> Any:
    """The value; if it is text of a result, its control characters are spelt out."""
    return visible(value) if isinstance(value, str) and not isinstance(value, Markup) else value


class StyleRules:
    """CSS classes for declarations that depend on the data, such as a colour or a width.

    The pages need them because the content security policy allows no style attributes. A script could set the styles,
    but a page without scripts must look the same.

    Examples
    --------
    >>> rules = StyleRules()
    >>> rules.name("width:50%"), rules.name("width:20%"), rules.name("width:50%")
    ('r0', 'r1', 'r0')
    >>> print(rules.css(), end="")
    .r0 { width:50% }
    .r1 { width:20% }
    """

    def __init__(self) -> None:
        self._names: dict[str, str] = {}

    def name(self, declarations: str) -> str:
        """Name of the class with these declarations.

        Raises
        ------
        ValueError
            The declarations hold more than properties with plain values.
        """
        if not _DECLARATIONS.fullmatch(declarations):
            raise ValueError(f"expected plain CSS declarations, got {declarations!r}.")
        return self._names.setdefault(declarations, f"r{len(self._names)}")

    def css(self) -> Markup:
        """Rules of all classes that were named so far, for the page's style sheet."""
        rules = (f".{name} {{ {declarations} }}\n" for declarations, name in self._names.items())
        return Markup("".join(rules))  # each was checked when it was named
