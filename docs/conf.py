# SPDX-License-Identifier: Apache-2.0
"""The documentation as a site: `make docs` (Sphinx and MyST)."""

import re
from importlib.metadata import version as installed

project = "rangesim and pcgraph"
author = "The rangesim authors"
release = version = installed("rangesim")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = project
html_copy_source = False

# Anchors of headings as repositories name them; links to files outside docs/ lead to the repository's copy.
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say more: shapes, units, frames
autodoc_default_options = {"members": True, "undoc-members": False, "show-inheritance": False}
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
napoleon_use_param = False
suppress_warnings = ["ref.python"]  # attributes of one name, such as the width of several classes
default_role = "code"  # a name between single backticks


_NUMPYDOC_SECTION = re.compile("-{3,}")
_ATTRIBUTE = re.compile(r"(\w+(?:, \w+)*) : (.*)")


def _to_restructured_text(app, what, name, obj, options, lines):
    """Let |A| be the size of A, no substitution; and make a list of the attributes that stand before the sections."""
    end = next((i for i, line in enumerate(lines) if _NUMPYDOC_SECTION.fullmatch(line)), len(lines))
    prose, in_list = [], False
    for line in lines[:end]:
        attribute = _ATTRIBUTE.fullmatch(line)
        if attribute:
            prose += [] if in_list else [""]
            prose.append(f"- `{attribute[1]}`: {attribute[2]}")
        elif in_list and line and not line.startswith(" "):
            prose += ["", line]
        else:
            prose.append(f"  {line.strip()}" if in_list and line else line)
        in_list = bool(attribute) or (in_list and line.startswith(" "))
    lines[:] = [_with_escaped_bars(line) for line in [*prose, *lines[end:]]]


def _with_escaped_bars(line):
    pieces = line.split("``")
    return "``".join(piece if k % 2 else piece.replace("|", r"\|") for k, piece in enumerate(pieces))


def _is_skipped(app, what, name, obj, skip, options):
    """Leave out what other packages put into classes."""
    return True if (getattr(obj, "__module__", None) or "").startswith(("sklearn", "numpy")) else None


def setup(app):
    app.connect("autodoc-process-docstring", _to_restructured_text, priority=400)  # before napoleon
    app.connect("autodoc-skip-member", _is_skipped)
