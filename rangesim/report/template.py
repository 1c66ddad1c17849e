# SPDX-License-Identifier: Apache-2.0
"""Pages rendered from the templates of this package: each is one HTML file with its style sheet and scripts inside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from pcgraph.viewer.content_policy import content_policy
from rangesim.report.content_security import StyleRules, visible_text

STYLES = ("style.css", "print.css")
"""Files of the style sheet of every page: the second one holds the rules for paper."""


def render_page(
    template: str, values: Mapping[str, Any], scripts: Sequence[str] = ("scroll.js", "print.js"), paper: str = ""
) -> str:
    """HTML page made from a template of this package and the values of its variables.

    Every page also gets the style sheet (`css`), the scripts (`script`), the rules that the template adds to the style
    sheet (`rules`) and the function that writes the page's security policy (`content_policy`).

    Parameters
    ----------
    template : name of the template's file. values : the other variables of the template, by name.
    scripts : names of the files whose JavaScript the page runs, in this order, of this package or, such as
        "pcgraph.viewer:points.js", of another one.
    paper : size of the paper for which the page is printed, as CSS names it, such as "A4"; "": the reader chooses it.

    Raises
    ------
    jinja2.UndefinedError
        The template uses a variable that is not there.
    """
    environment = Environment(
        autoescape=True, finalize=visible_text, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    own = {  # `Markup` is not escaped: these files are part of the package
        "css": Markup("\n".join(map(text_of_file, STYLES)) + (f"@page {{ size: {paper}; }}\n" if paper else "")),
        "script": Markup("\n".join(map(text_of_file, scripts))),
        "rules": StyleRules(),
        "content_policy": content_policy,
    }
    return environment.from_string(text_of_file(template)).render(own, **values)


def text_of_file(name: str) -> str:
    """Text of a file of this package or, as "package:name", of another one."""
    package, _, file = name.rpartition(":")
    return (files(package or "rangesim.report") / file).read_text(encoding="utf-8")
