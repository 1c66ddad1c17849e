# SPDX-License-Identifier: Apache-2.0
"""Writing segmentations: coloured points to look at, arrays to compute with."""

from __future__ import annotations

import io
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.cloud import COLOR_NAMES, LABEL_NAMES, NORMAL_NAMES, PACKED_NAMES, Cloud, without_mask
from pcgraph.errors import CloudWriteError
from pcgraph.io.ply import encode_ply
from pcgraph.plumbing.plain_files import is_sealed, sealed, unsealed, write_file

if TYPE_CHECKING:
    from pcgraph.segmentation import Segmentation


FORMAT = "pcgraph-segmentation"
"""Mark of files that pcgraph wrote: a comment in the PLY or .npz file, followed by the SHA-256 of the file's bytes.

The sum is taken with zeros in its place. A file that was edited, for example to correct labels, no longer has that sum:
it is the user's own, and is not overwritten.
"""
_INSTEAD = {"i8": "f8", "u8": "f8", "f2": "f4", "f16": "f8", "b1": "u1"}
"""Types that PLY does not have, and those that are written in their place."""


def is_segmentation(path: Path) -> bool:
    """Whether `write_segmentation` wrote a file, and nobody has changed it."""
    return is_sealed(path, FORMAT, at_end=path.suffix.lower() != ".ply")


def write_segmentation(
    path: str | PathLike[str],
    cloud: Cloud | ArrayLike,
    segmentation: Segmentation,
    labels: ArrayLike | None = None,
) -> None:
    """Write a segmentation as a whole file, or none; an older file of that name is replaced.

    Parameters
    ----------
    path : str or path
        ``.ply``: the finite points, in input order, with a colour per label, the properties ``labels`` and
        ``supervoxels`` (int32), the cloud's own colours, normals and labels (``red`` and so on, ``nx`` and so on,
        ``label``), and its further columns, vectors as ``name_0``, ``name_1`` and so on. PLY has no integers of 64
        bits, so those become doubles. The cloud's columns keep their names. If the cloud has colours, labels or a
        column ``supervoxels`` of its own, the result's are called ``segment_red`` and so on, ``segment_labels``,
        ``segment_supervoxels``; if these exist, too, ``segment2_red`` and so on.

        ``.npz``: everything, in the input's shape: ``format``, ``labels``, ``supervoxels``; ``edges`` and
        ``edge_<feature>``; ``node_<feature>``; ``tree_parents``, ``tree_altitudes``; ``voxel_size``, ``seed_size``,
        ``viewpoint``; ``cloud_colors``, ``cloud_normals``, ``cloud_labels``, the cloud's own if it has them;
        ``column_<name>``, the further columns.
    cloud : Cloud, or points (n, 3) or (h, w, 3)
        The cloud that was segmented. A further column with the name of a coordinate, a colour, a normal or a label of
        the cloud, for example ``x`` or ``X``, is left out of the ``.ply``.
    segmentation : Segmentation
    labels : the points' leading shape, whole numbers within 32 bits, optional
        Labels to write in place of the default cut.

    Raises
    ------
    CloudWriteError
        The extension is another, or the place cannot be written; or a column has another shape than the points, is not
        of numbers, or has a name that is not one word; or the cloud's colours, normals or labels are not as `Cloud` has
        them.
    ValueError
        Points or labels have another shape than the points that were segmented, or labels are no whole numbers within
        32 bits.
    """
    path = Path(path)
    write_file(path, encode_segmentation(path.name, cloud, segmentation, labels), CloudWriteError)


def encode_segmentation(
    name: str, cloud: Cloud | ArrayLike, segmentation: Segmentation, labels: ArrayLike | None = None
) -> bytes:
    """Bytes that `write_segmentation` writes to a file of that name."""
    try:
        shape = segmentation.supervoxels.shape
    except AttributeError:  # no isinstance, because the class is in a layer above this module
        kind = type(segmentation).__name__
        raise ValueError(f"expected a Segmentation, as pcgraph.segment returns it, got {kind}") from None
    cloud = cloud if isinstance(cloud, Cloud) else Cloud(np.asarray(without_mask(cloud)))
    cloud = replace(cloud, points=np.asarray(without_mask(cloud.points)))
    labels = segmentation.labels if labels is None else _whole_labels(labels)
    if np.shape(cloud.points) != (*shape, 3):
        expected = f"the points that were segmented, of shape {(*shape, 3)}"
        raise ValueError(f"expected {expected}, got {np.shape(cloud.points)}; give the cloud of this segmentation")
    if labels.shape != shape:
        raise ValueError(f"expected a label for each point, of shape {shape}, got {labels.shape}")
    encoders = {".ply": _ply, ".npz": _npz}
    encode = encoders.get(Path(name).suffix.lower())
    if encode is None:
        raise CloudWriteError(f"expected an output file ending in {' or '.join(encoders)}, got {name!r}")
    return encode(cloud, segmentation, labels)


def _whole_labels(labels: ArrayLike) -> NDArray[np.int32]:
    """Labels as int32; raises ValueError if they are no whole numbers, or too large."""
    given, limits = np.asarray(labels), np.iinfo(np.int32)
    is_whole = given.dtype.kind in "iub" or (given.dtype.kind == "f" and bool((given == np.rint(given)).all()))
    if not is_whole:
        raise ValueError(f"expected labels as whole numbers, got {given.dtype}")
    if given.size and not (limits.min <= given.min() and given.max() <= limits.max):
        raise ValueError(f"expected labels of 32 bits, got {given.min()} to {given.max()}; number them anew")
    return given.astype(np.int32)


def label_colors(labels: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Colour of each label, (n, 3) uint8: hues a golden angle apart, so that near numbers differ; grey if negative."""
    hue = labels * 0.618033988749895 % 1.0
    value = 0.95 - 0.25 * (labels // 8 % 3) / 2.0
    ramp = np.abs((hue[:, None] * 6.0 + np.array([0.0, 4.0, 2.0])) % 6.0 - 3.0) - 1.0
    colors = np.rint(255.0 * value[:, None] * (0.35 + 0.65 * np.clip(ramp, 0.0, 1.0))).astype(np.uint8)
    colors[labels < 0] = 128
    return colors


def _ply(cloud: Cloud, segmentation: Segmentation, labels: NDArray[np.int32]) -> bytes:
    finite = np.isfinite(cloud.points.reshape(-1, 3)).all(axis=1)
    points = cloud.points.reshape(-1, 3)[finite]
    points = _for_ply("points", points.astype(np.result_type(points, np.float32), copy=False))
    kept = labels.reshape(-1)[finite]
    columns: dict[str, NDArray[np.generic]] = {name: points[:, i] for i, name in enumerate("xyz")}
    further = _ply_parts(cloud, finite)
    columns |= _ply_own(cloud, finite, {part.lower() for part in further})
    own = set(columns)
    further = {part: values for part, values in further.items() if part.lower() not in own}
    taken = own | {part.lower() for part in further}
    color_names = (*COLOR_NAMES, *own.intersection(PACKED_NAMES))
    columns |= _beside(taken, dict(zip(COLOR_NAMES, label_colors(kept).T, strict=True)), color_names)
    columns |= _beside(taken, {"labels": kept}, LABEL_NAMES)
    columns |= _beside(taken, {"supervoxels": segmentation.supervoxels.reshape(-1)[finite]}, ("supervoxels",))
    columns |= further
    return sealed(encode_ply(columns, unsealed(FORMAT)), FORMAT)


def _ply_parts(cloud: Cloud, finite: NDArray[np.bool_]) -> dict[str, NDArray[np.generic]]:
    """The cloud's further columns at the finite points, one column per number of a vector."""
    parts: dict[str, NDArray[np.generic]] = {}
    for name, stored in _further_columns(cloud).items():
        rows = _for_ply(name, stored.reshape(len(finite), -1)[finite])
        vector = stored.ndim > cloud.points.ndim - 1
        for i in range(rows.shape[1]):
            parts.setdefault(f"{name}_{i}" if vector else name, rows[:, i])
    return parts


def _ply_own(cloud: Cloud, finite: NDArray[np.bool_], taken: set[str]) -> dict[str, NDArray[np.generic]]:
    """The cloud's own colours, normals and labels at the finite points, under names that `read_cloud` knows.

    Each gets the first of its names that no further column has; `taken` are the names of those columns, in lower case.
    """
    rows = {
        name: _for_ply(name, stored.reshape(len(finite), -1)[finite]) for name, stored in _own_arrays(cloud).items()
    }
    if "colors" in rows and not taken.isdisjoint((*COLOR_NAMES, *PACKED_NAMES)):  # read_cloud prefers packed ones
        rows["packed"] = rows.pop("colors").astype(np.uint32) @ np.array([[1 << 16], [1 << 8], [1]], np.uint32)
    choices: dict[str, Sequence[tuple[str, ...]]] = {
        "colors": [COLOR_NAMES],
        "packed": [PACKED_NAMES[:1]],
        "normals": NORMAL_NAMES[::-1],
        "labels": [(name,) for name in LABEL_NAMES],
    }
    columns: dict[str, NDArray[np.generic]] = {}
    for name, values in rows.items():
        names = next((names for names in choices[name] if taken.isdisjoint(names)), choices[name][0])
        columns |= dict(zip(names, values.T, strict=True))
    return columns


def _own_arrays(cloud: Cloud) -> dict[str, NDArray[np.generic]]:
    """The cloud's own colours (uint8), normals and labels (int32), if it has them, checked."""
    shape = cloud.points.shape[:-1]
    arrays: dict[str, NDArray[np.generic]] = {}
    for name, wanted in (("colors", (*shape, 3)), ("normals", (*shape, 3)), ("labels", shape)):
        if getattr(cloud, name) is None:
            continue
        given = np.asarray(getattr(cloud, name))
        if given.shape != wanted:
            raise CloudWriteError(f"expected the cloud's {name} in the shape {wanted}, got {given.shape}")
        arrays[name] = given
    if "colors" in arrays and arrays["colors"].dtype != np.uint8:
        arrays["colors"] = _bytes_of(arrays["colors"])
    if "normals" in arrays and arrays["normals"].dtype.kind != "f":
        raise CloudWriteError(f"expected the cloud's normals as floats, got {arrays['normals'].dtype}")
    if "labels" in arrays:
        try:
            arrays["labels"] = _whole_labels(arrays["labels"])
        except ValueError as error:
            raise CloudWriteError(f"the cloud's own labels: {error}") from None
    return arrays


def _bytes_of(colors: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Colours as uint8, from floats within 0..1, which `segment` takes, too; black where they are NaN."""
    shades = np.nan_to_num(colors.astype(np.float64)) if colors.dtype.kind == "f" else np.array([np.inf])
    if not ((shades >= 0.0) & (shades <= 1.0)).all():
        raise CloudWriteError(f"expected the cloud's colors as uint8 or as floats within 0..1, got {colors.dtype}")
    return np.rint(255.0 * shades).astype(np.uint8)


def _beside(
    taken: set[str], ours: dict[str, NDArray[np.generic]], names: tuple[str, ...]
) -> dict[str, NDArray[np.generic]]:
    """The result's columns; if one of `names` is taken, with a prefix ``segment_``, else ``segment2_`` and so on."""
    prefixes = ("", "segment_", *(f"segment{i}_" for i in range(2, len(taken) + 2)))
    free = next(prefix for prefix in prefixes if taken.isdisjoint(prefix + name for name in names))
    return {free + name: column for name, column in ours.items()}


def _npz(cloud: Cloud, segmentation: Segmentation, labels: NDArray[np.int32]) -> bytes:
    graph, tree = segmentation.graph, segmentation.tree
    arrays: dict[str, NDArray[np.generic]] = {"format": np.array(FORMAT)}
    arrays |= {"labels": labels, "supervoxels": segmentation.supervoxels}
    arrays["edges"] = graph.edges
    arrays |= {f"edge_{name}": column for name, column in graph.edge_features.columns().items()}
    arrays |= {f"node_{name}": column for name, column in graph.node_features.columns().items()}
    arrays |= {"tree_parents": tree.parents, "tree_altitudes": tree.altitudes}
    arrays["voxel_size"] = np.array(segmentation.voxel_size)
    arrays["seed_size"] = np.array(segmentation.seed_size)
    arrays["viewpoint"] = segmentation.viewpoint
    arrays |= {f"cloud_{name}": array for name, array in _own_arrays(cloud).items()}
    arrays |= {f"column_{name}": column for name, column in _further_columns(cloud).items()}
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    with zipfile.ZipFile(stream, "a") as archive:
        archive.comment = unsealed(FORMAT).encode()
    return sealed(stream.getvalue(), FORMAT, at_end=True)


def _further_columns(cloud: Cloud) -> dict[str, NDArray[np.generic]]:
    """The cloud's columns, checked."""
    shape = cloud.points.shape[:-1]
    for name, column in cloud.columns.items():
        if not (isinstance(name, str) and all(0 < ord(letter) < 256 for letter in name) and _is_word(name)):
            raise CloudWriteError(f"expected names of columns as one word of Latin letters, got {ascii(name)[:80]}")
        if not isinstance(column, np.ndarray) or column.dtype.kind not in "fiub":
            kind = column.dtype if isinstance(column, np.ndarray) else type(column).__name__
            raise CloudWriteError(f"expected the column {name!r} as an array of numbers, got {kind}")
        if column.shape[: len(shape)] != shape or column.ndim > len(shape) + 1:
            raise CloudWriteError(f"expected the column {name!r} in the points' shape {shape}, got {column.shape}")
    return {name: np.asarray(without_mask(column)) for name, column in cloud.columns.items()}


def _is_word(name: str) -> bool:
    """Whether a name of Latin letters is one word, as the readers of files split words."""
    encoded = name.encode("latin-1")
    return encoded.split() == [encoded]


def _for_ply(name: str, values: NDArray[np.generic]) -> NDArray[np.generic]:
    """The values in a type that PLY has; only whole numbers beyond 2**53 are rounded."""
    instead = _INSTEAD.get(values.dtype.str[1:])
    if instead is None:
        return values
    with np.errstate(over="ignore"):
        written = values.astype(instead)
    if values.dtype.kind in "iu" and int(np.abs(written).max(initial=0)) > 1 << 53:
        warnings.warn(
            f"the .ply rounds the column {name!r} to doubles, as PLY has no integers of 64 bits; the .npz keeps them",
            stacklevel=2,
        )
    return written
