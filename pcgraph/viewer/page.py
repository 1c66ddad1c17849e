# SPDX-License-Identifier: Apache-2.0
"""The viewer's page: one HTML file with style sheet, script and data inside, which asks the network for nothing."""

from __future__ import annotations

import html
import json
from collections.abc import Iterator, Sequence
from importlib.resources import files
from os import PathLike
from pathlib import Path
from string import Template

import numpy as np

from pcgraph.cloud import Cloud
from pcgraph.errors import CloudWriteError, visible
from pcgraph.plumbing.plain_files import write_file
from pcgraph.segmentation import Segmentation
from pcgraph.viewer.cloud_data import Shown, cloud_data
from pcgraph.viewer.content_policy import content_policy

SCRIPTS = ("three.js", "points.js", "boxes.js", "tree.js", "viewer.js")
"""Files of this package whose JavaScript a page runs, in this order."""
MAX_PAGE_BYTES = 1 << 29
"""Largest page, bytes: V8, which most browsers run, has no longer strings (2**29 - 24 characters)."""


def view_page(cloud: Cloud, segmentation: Segmentation | None = None, title: str | None = None) -> str:
    """HTML page that shows a cloud, coloured by its columns or by any level of its segmentation.

    Parameters
    ----------
    cloud : Cloud
    segmentation : Segmentation, optional
        Of this very cloud; it adds the slider through the tree, objects, graph and boxes.
    title : str, optional
        Default: "Point cloud".

    Raises
    ------
    ValueError
        The segmentation is none, or that of another cloud, or the page would be larger than browsers load.

    Notes
    -----
    Positions are rounded to 1/65535 of the box of the points along each axis, from a float64 corner.

    Examples
    --------
    >>> import numpy as np, pcgraph
    >>> from pcgraph.viewer import view_page
    >>> page = view_page(pcgraph.Cloud(np.random.default_rng(0).random((1000, 3)).astype(np.float32)))
    >>> page.startswith("<!doctype html>")
    True
    """
    name = "Point cloud" if title is None else title
    return views_page([Shown.of(name, cloud, segmentation)], name)


def write_view(
    path: str | PathLike[str], cloud: Cloud, segmentation: Segmentation | None = None, title: str | None = None
) -> None:
    """Write the page of `view_page` to a file: the whole page, or nothing.

    Raises
    ------
    CloudWriteError
        The place cannot be written.
    ValueError
        As for `view_page`.

    Examples
    --------
    >>> import numpy as np, pathlib, pcgraph, tempfile
    >>> from pcgraph.viewer import write_view
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "cloud.html"
    >>> write_view(path, pcgraph.Cloud(np.zeros((5, 3))), title="Five points")
    >>> path.stat().st_size > 500_000
    True
    """
    write_file(Path(path), view_page(cloud, segmentation, title).encode("utf-8"), CloudWriteError)


def views_page(shown: Sequence[Shown], title: str) -> str:
    """HTML page with a chooser over several clouds; see `view_page`.

    Raises
    ------
    ValueError
        There is no cloud, or the page would be larger than browsers load.

    Examples
    --------
    >>> import numpy as np, pcgraph
    >>> from pcgraph.viewer import Shown, views_page
    >>> page = views_page([Shown(name, pcgraph.Cloud(np.zeros((1, 3)))) for name in ("first", "second")], "Both")
    >>> '<option value="1">second</option>' in page
    True
    """
    if not shown:
        raise ValueError("expected at least one cloud to show, got none")
    blocks = []
    for number, text in enumerate(_data_blocks(shown)):
        blocks.append(f'<script type="application/json" id="cloud-{number}">{text}</script>')
        if sum(map(len, blocks)) > MAX_PAGE_BYTES:
            raise ValueError(
                f"expected clouds whose page is at most {MAX_PAGE_BYTES >> 20} MB, as browsers load no larger ones: "
                "choose fewer files or thin them out"
            )
    style, script = _file("viewer.css"), "\n".join(map(_file, SCRIPTS))
    return Template(_file("viewer.html")).substitute(
        policy=html.escape(content_policy(style, script)),
        title=html.escape(visible(title)),
        style=style,
        script=script,
        options="".join(
            f'<option value="{i}">{html.escape(visible(one.name))}</option>' for i, one in enumerate(shown)
        ),
        data="\n".join(blocks),
    )


def _data_blocks(shown: Sequence[Shown]) -> Iterator[str]:
    """JSON of each cloud; no text in it can end the element that holds it."""
    for one in shown:
        yield json.dumps({**cloud_data(one), "colorTable": _color_table()}, allow_nan=False).replace("<", "\\u003c")


def _color_table() -> list[int]:
    """256 colours from low to high, 768 numbers 0..255: viridis, which people without some cones read, too."""
    from matplotlib import colormaps

    return [int(v) for v in np.rint(colormaps["viridis"](np.arange(256) / 255)[:, :3] * 255).astype(np.uint8).ravel()]


def _file(name: str) -> str:
    """Text of a file of this package."""
    return (files("pcgraph.viewer") / name).read_text(encoding="utf-8")
