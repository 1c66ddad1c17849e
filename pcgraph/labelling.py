# SPDX-License-Identifier: Apache-2.0
"""Labelled clouds: the labels of a segmentation as columns of its cloud, in memory and in files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import COLOR_NAMES, Cloud
from pcgraph.errors import CloudWriteError
from pcgraph.io import encode_cloud
from pcgraph.plumbing.plain_files import write_file
from pcgraph.segmentation import Segmentation, check_segmentation, segmented_cloud


def labelled_cloud(cloud: Any, segmentation: Segmentation, levels: Sequence[int] = (), colorize: bool = False) -> Cloud:
    """The cloud with the labels of its segmentation as further columns.

    Parameters
    ----------
    cloud : Cloud, or anything else that `as_cloud` takes
        The cloud that was segmented. Its own colours, normals, labels and columns keep their names.
    segmentation : Segmentation
    levels : sequence of int, optional
        Numbers of segments; each adds the column of one more cut.
    colorize : bool
        Whether the result has a colour for each object. The cloud's own colours then become columns.

    Returns
    -------
    Cloud
        The cloud with further int32 columns of the points' leading shape; -1 for points without a label:

        - ``object``: `Segmentation.labels`
        - ``part``: `Segmentation.parts`
        - ``supervoxel``: `Segmentation.supervoxels`
        - ``level_10`` and so on: the cut into 10 segments
        - ``original_red``, ``original_green``, ``original_blue``, uint8: with `colorize`, the cloud's own colours

        If the cloud has a column of such a name, in upper or lower case, the new column is called ``pcgraph_object``
        and so on; if it has that too, ``pcgraph2_object``.

    Raises
    ------
    ValueError
        The cloud has another shape than the points that were segmented, `segmentation` is not a `Segmentation`, or the
        tree has no cut into that many segments.

    Examples
    --------
    >>> import numpy as np, pcgraph
    >>> points = np.random.default_rng(0).random((300, 3)) * [1, 1, 0.01]
    >>> seen = pcgraph.segment(points)
    >>> list(labelled_cloud(points, seen, levels=[2]).columns)
    ['object', 'part', 'supervoxel', 'level_2']
    """
    check_segmentation(segmentation)
    cloud = segmented_cloud(cloud, segmentation)
    ours: dict[str, NDArray[np.generic]] = {
        "object": segmentation.labels,
        "part": segmentation.parts,
        "supervoxel": segmentation.supervoxels,
        **{f"level_{n}": segmentation.cut(n) for n in levels},
    }
    if colorize:
        if cloud.colors is not None:
            ours |= {f"original_{name}": np.asarray(cloud.colors)[..., i] for i, name in enumerate(COLOR_NAMES)}
        cloud = replace(cloud, colors=label_colors(segmentation.labels))
    return replace(cloud, columns={**cloud.columns, **_beside(cloud.columns, ours)})


def write_segmentation(
    path: str | PathLike[str],
    cloud: Any,
    segmentation: Segmentation,
    *,
    levels: Sequence[int] = (),
    colorize: bool = False,
) -> None:
    """Write a cloud with the labels of its segmentation to a file, and replace an existing one.

    The file holds the cloud that `labelled_cloud` returns: all its own columns, and the columns ``object``, ``part``,
    ``supervoxel`` and those of the levels. After an error the file is as it was before. `Segmentation.save` writes the
    graph and the tree, too.

    Parameters
    ----------
    path : str or path
        File in any format that `write_cloud` writes. Formats other than PCD, NPY and NPZ hold the finite points only.
    cloud, segmentation, levels, colorize
        As for `labelled_cloud`.

    Raises
    ------
    CloudWriteError
        The suffix is unknown, the file cannot be written, or the format cannot hold a column.
    ValueError
        As for `labelled_cloud`.

    Examples
    --------
    >>> import numpy as np, pathlib, pcgraph, tempfile
    >>> points = np.random.default_rng(0).random((300, 3)) * [1, 1, 0.01]
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "objects.ply"
    >>> write_segmentation(path, points, pcgraph.segment(points), colorize=True)
    >>> list(pcgraph.read_cloud(path).columns)
    ['object', 'part', 'supervoxel']
    """
    path = Path(path)
    write_file(path, encode_cloud(labelled_cloud(cloud, segmentation, levels, colorize), path.name), CloudWriteError)


def label_colors(labels: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Colour of each label, uint8 of the labels' shape + (3,); grey for negative labels.

    Hues are a golden angle apart, so that labels with close numbers look different.
    """
    hue = labels * 0.618033988749895 % 1.0
    value = 0.95 - 0.25 * (labels // 8 % 3) / 2.0
    ramp = np.abs((hue[..., None] * 6.0 + np.array([0.0, 4.0, 2.0])) % 6.0 - 3.0) - 1.0
    colors = np.rint(255.0 * value[..., None] * (0.35 + 0.65 * np.clip(ramp, 0.0, 1.0))).astype(np.uint8)
    colors[labels < 0] = 128
    return colors


def _beside(taken: Iterable[str], ours: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    """The new columns under names that no column of the cloud has, in upper or lower case."""
    lower = {name.lower() for name in taken}
    prefixes = ("", "pcgraph_", *(f"pcgraph{i}_" for i in range(2, len(lower) + 2)))
    return {next(p + name for p in prefixes if (p + name) not in lower): column for name, column in ours.items()}
