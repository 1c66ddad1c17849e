# SPDX-License-Identifier: Apache-2.0
"""Saved segmentations: `load_segmentation` opens the files that `Segmentation.save` writes.

Shape, range and order of each array are checked before a kernel uses it. `ARRAYS` has a row for each array that a file
may hold.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from fnmatch import fnmatchcase
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import NDArray

from pcgraph.columns import CLIP
from pcgraph.disjoint_sets import connected_components
from pcgraph.errors import MAX_WORD, CloudReadError, one_line
from pcgraph.families import members
from pcgraph.graph.continuations import Continuations
from pcgraph.hierarchy import checked_parents
from pcgraph.plumbing.array_archive import (
    OWN,
    Archive,
    DamagedError,
    UnknownClassError,
    class_name,
    decode_archive,
    field_names,
    rebuild,
)
from pcgraph.plumbing.plain_files import check_file, is_sealed, read_file
from pcgraph.segmentation import NOT_STORED, SAVED_FORMAT, SAVED_MARK, SAVED_VERSION, Segmentation, Settings
from pcgraph.supervoxels.method import SupervoxelMethod
from pcgraph.tree.linkage import Linkage
from pcgraph.voxels.grading import enlarged
from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.warp import CameraWarp, RangeWarp, Warp

_FOR_TYPE_CHECKERS = {"Continuations": Continuations}
"""Types of fields that their modules import only for type checkers."""
_MAX_LEVEL = 4
"""Largest count of times that the edge of a voxel is doubled. Source: `Grading`."""
_MAX_LENGTH = 1e102
"""Largest length, metres: coordinates of clouds are 1e100 at most (`pcgraph.inputs`), and ranges a few times that.
Squares of far larger lengths overflow. A loop that waits for a least distance does not end where all are NaN."""
_MAX_SCATTER = 1e225
"""Largest scatter, square metres, because the squares of such lengths, summed over 10^18 points, are 1e222."""
_MAX_COUNT = 1 << 53
"""The count of points in a voxel or a node is below this, so that sums of counts are exact as float64, too."""
_ROUNDING = 1e-6
"""Largest relative difference that rounding may make, a fraction, also between two machines. Chosen by eye; not
varied."""
_UNIT = 1.0 + _ROUNDING
"""Largest absolute value of numbers that are 1 at most, dimensionless, because they may have been rounded up."""


class Row(NamedTuple):
    """Shape and range of one array of a saved segmentation, or of several similar ones.

    Attributes
    ----------
    shape : str
        Numbers and names of dimensions, separated by spaces. A name means the same number throughout the file: n
        points that have a supervoxel; v voxels; e entries of the lists of touching voxels; k supervoxels; t nodes of
        the tree; m edges, g gaps, r continuations and b bridges; d columns of features; c blocks;
        p supervoxels before the last update. "points" is the leading shape of the input. "..." is any shape.
    least, below : int, or the name of a dimension
        Range of whole numbers, least <= number < below. None: no limit.
    largest : float, or None
        Largest absolute value of floats. None: no limit; NaN and infinite numbers are allowed.
    """

    shape: str
    least: int | None = None
    below: int | str | None = None
    largest: float | None = _MAX_LENGTH


ARRAYS: dict[str, Row] = {
    "labels": Row("points", -1),
    "outliers": Row("points"),
    "supervoxels": Row("points", -1, "k"),
    "objects": Row("k", 0),
    "ages": Row("k", 0),
    "supervoxel_of_earlier": Row("p", -1, "k"),
    "viewpoint": Row("..."),
    "feature_scaling/*": Row("d", largest=None),
    "graph/edges": Row("m 2", 0, "k"),
    "graph/edge_features/contact_voxels": Row("m", 1),
    "graph/edge_features/*": Row("m"),
    "graph/node_features/size": Row("k", 1),
    "graph/node_features/centroid": Row("k 3"),
    "graph/node_features/normal": Row("k 3"),
    "graph/node_features/covariance": Row("k 3 3", largest=_MAX_SCATTER),
    "graph/node_features/color": Row("k 3", largest=None),
    "graph/node_features/color_covariance": Row("k 3 3", largest=None),
    "graph/node_features/deviations": Row("k 3"),
    "graph/node_features/features": Row("k d"),
    "graph/node_features/*": Row("k"),
    "graph/gaps/edges": Row("g 2", 0, "k"),
    "graph/gaps/edge_features/contact_voxels": Row("g", 1),
    "graph/gaps/*": Row("g"),
    "graph/continuations/pairs": Row("r 2", 0, "k"),
    "graph/continuations/*": Row("r"),
    "graph/bridges/edges": Row("b 2", 0, "k"),
    "graph/bridges/*": Row("b"),
    "graph/acquisition*/places": Row("...", largest=None),
    "graph/acquisition*": Row("3"),
    "tree/parents": Row("t", 0, "t"),
    "tree/altitudes": Row("t", largest=None),
    "tree/moments/counts": Row("t", 1, _MAX_COUNT),
    "tree/moments/centroids": Row("t 3"),
    "tree/moments/scatters": Row("t 3 3", largest=_MAX_SCATTER),
    "tree/moments/colors": Row("t 3", largest=_UNIT),
    "tree/moments/color_scatters": Row("t 3 3", largest=float(_MAX_COUNT)),
    "tree/moments/normals": Row("t 3", largest=_UNIT),
    "tree/moments/features": Row("t d", largest=CLIP * _UNIT),
    "surface/normals": Row("v 3", largest=_UNIT),
    "surface/supervoxels": Row("v", 0, "k"),
    "surface/grid/warp/*": Row("3"),
    "surface/grid/cells": Row("v 3", largest=sys.float_info.max),
    "surface/grid/voxel_of_point": Row("n", 0, "v"),
    "surface/grid/order": Row("n", 0, "n"),
    "surface/grid/starts": Row("v+1", 0),
    "surface/grid/counts": Row("v", 1, _MAX_COUNT),
    "surface/grid/warped": Row("v 3"),
    "surface/grid/centroids": Row("v 3"),
    "surface/grid/edge_lengths": Row("v"),
    "surface/grid/colors": Row("v 3", largest=_UNIT),
    "surface/grid/indptr": Row("v+1", 0),
    "surface/grid/neighbours": Row("e", 0, "v"),
    "surface/grid/features": Row("v d", largest=CLIP * _UNIT),
    "surface/grid/levels": Row("v", 0, _MAX_LEVEL + 1),
    "surface/grid/grading/blocks": Row("c 3"),
    "surface/grid/grading/levels": Row("c", 1, _MAX_LEVEL + 1),
}
"""The arrays of a saved segmentation by path, in which * is any text. If several rows fit a path, the first counts."""


def load_segmentation(
    path: str | PathLike[str], *, linkage: Linkage | None = None, method: SupervoxelMethod | None = None
) -> Segmentation:
    """Segmentation from a file that `Segmentation.save` wrote, equal to the saved one in every field and every bit.

    Cuts, detection, metrics and `pcgraph.update` continue from it as from the saved one.

    Parameters
    ----------
    path : str or path
    linkage, method : optional
        Needed if the segmentation was made with a linkage or method class of your own, unless that is a loaded
        dataclass of plain values. Opening a file imports no module and runs no code from it.

    Raises
    ------
    CloudReadError
        The file cannot be read, is not a saved segmentation, has another version, or was changed or cut off. Or it was
        made with a linkage or a method whose class is not loaded.
    ValueError
        `linkage` or `method` is not one, or its class is not the saved one.

    Examples
    --------
    >>> import numpy as np, pcgraph, tempfile
    >>> x, y = np.meshgrid(np.linspace(-1.0, 1.0, 64), np.linspace(-1.0, 1.0, 64))
    >>> seen = pcgraph.segment(np.stack((x, y, 2.0 + np.abs(x)), axis=-1))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     seen.save(f"{folder}/roof.npz")
    ...     again = pcgraph.load_segmentation(f"{folder}/roof.npz")
    >>> bool((again.cut(2) == seen.cut(2)).all())
    True
    """
    path = Path(path)
    Settings.of(method, linkage, None)
    for family in ("SupervoxelMethod", "Linkage"):  # a class is known once it is loaded
        members(family)
    check_file(path, CloudReadError)
    try:
        return _segmentation(_archive(path), {"linkage": linkage, "method": method})
    except UnknownClassError as error:
        name = one_line(error.name.removeprefix(OWN).removesuffix(NOT_STORED))[:MAX_WORD]
        raise CloudReadError(
            f"{path} was made with a {error.path} of your own, {name}: "
            f"give it, as in load_segmentation(..., {error.path}={name}())"
        ) from None
    except DamagedError as error:
        raise CloudReadError(f"cannot read {path}: {one_line(error)}") from None


def _archive(path: Path) -> Archive:
    """The archive in a file that `Segmentation.save` wrote, without the cloud."""
    try:
        is_whole = is_sealed(path, SAVED_MARK, at_end=True)
    except OSError as error:
        raise CloudReadError(f"cannot read {path}: {error.strerror or error}.") from error
    content = read_file(path, CloudReadError)
    if not is_whole:
        raise DamagedError("expected a file that Segmentation.save wrote, whole and not changed since")
    header, archive = decode_archive(content, skipped="cloud/")
    if header.get("format") != SAVED_FORMAT:
        raise DamagedError("expected a file that Segmentation.save wrote, got other arrays")
    if header.get("version") != SAVED_VERSION:
        got = f"{header.get('version')!r:.20}"
        raise DamagedError(f"it was saved by another version of pcgraph: format {got}, expected {SAVED_VERSION}")
    of_cloud = [name for name in archive.values if name == "cloud" or name.startswith("cloud/")]
    for name in of_cloud:
        del archive.values[name]
    return archive


def _segmentation(archive: Archive, given: Mapping[str, Any]) -> Segmentation:
    """The checked segmentation of an archive, with the linkage and the method that the caller gave, if any."""
    kinds, found = get_type_hints(Segmentation), {}
    for name in field_names(Segmentation):
        if given.get(name) is None:
            found[name] = rebuild(archive, kinds[name], name, _FOR_TYPE_CHECKERS)
            continue
        found[name] = given[name]
        saved, own = archive.values.get(name), class_name(type(given[name]))
        if saved not in (own, own + NOT_STORED):
            raise ValueError(f"expected the {name} that was saved, {saved!r:.80}, got {own.removeprefix(OWN)}")
    result = Segmentation(**found)
    _check_all_used(archive, result, [name for name, one in given.items() if one is not None])
    _check_arrays(archive.arrays)
    _check(result)
    return result


def _check_all_used(archive: Archive, result: Segmentation, given: list[str]) -> None:
    """Raise DamagedError if an archive holds values that the result does not have."""
    used = Archive()
    for name in field_names(Segmentation):
        if name not in given:
            used.flatten(getattr(result, name), name)
    stored = [*archive.arrays, *archive.values]
    further = {name for name in stored if name.partition("/")[0] not in given} - {*used.arrays, *used.values}
    if further:
        raise DamagedError(f"it holds {min(further)[:MAX_WORD]!r}, which no segmentation has")


# --- checks of each array ---------------------------------------------------------------------------------------------


def _check_arrays(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise DamagedError unless each array has the shape and range of its row of `ARRAYS`."""
    sizes: dict[str, tuple[int, ...]] = {}
    rows = {name: row for name in arrays if (row := row_of(name)) is not None}
    for name, row in rows.items():
        _check_shape(name, arrays[name], row, sizes)
    for name, row in rows.items():
        below = row.below if isinstance(row.below, int | None) else sizes.get(row.below, (0,))[0]
        _check_range(name, arrays[name], row, below)


def row_of(name: str) -> Row | None:
    """The row of `ARRAYS` for an array; None for the arrays of a method or linkage."""
    if name.startswith(("method/", "linkage/")):
        return None
    found = next((row for pattern, row in ARRAYS.items() if fnmatchcase(name, pattern)), None)
    if found is None:
        raise DamagedError(f"it holds {name[:MAX_WORD]!r}, which no segmentation has")
    return found


def _check_shape(name: str, array: NDArray[Any], row: Row, sizes: dict[str, tuple[int, ...]]) -> None:
    """Raise DamagedError if a dimension has another size than in `sizes`; new dimensions are added to `sizes`."""
    if row.shape == "...":
        return
    names = row.shape.split()
    got = [array.shape] if names == ["points"] else [(length,) for length in array.shape]
    fits = len(got) == len(names) and (names != ["points"] or array.ndim in (1, 2))
    for one, length in zip(names, got, strict=False):
        if one.isdigit():
            fits = fits and length == (int(one),)
        else:
            base, _, more = one.partition("+")
            length = (length[0] - int(more),) if more else length
            fits = fits and sizes.setdefault(base, length) == length and min(length, default=0) >= 0
    if not fits:
        known = {one: "x".join(map(str, size)) for one, size in sizes.items() if one in row.shape}
        raise DamagedError(f"expected the array {name} of shape ({row.shape}) with {known}, got {array.shape}")


def _check_range(name: str, array: NDArray[Any], row: Row, below: int | None) -> None:
    if array.dtype.kind == "f":
        if row.largest is not None and not (np.abs(array) <= row.largest).all():
            raise DamagedError(f"expected numbers up to {row.largest:g} in size in the array {name}")
    elif array.size and array.dtype.kind in "iu":
        least, most = int(array.min()), int(array.max())
        if (row.least is not None and least < row.least) or (below is not None and most >= below):
            upper = "" if below is None else f" to {below - 1}"
            raise DamagedError(f"expected numbers from {row.least}{upper} in the array {name}, got {least} to {most}")


# --- checks of several arrays together --------------------------------------------------------------------------------


def _check(found: Segmentation) -> None:
    """Raise DamagedError unless the parts of a segmentation fit each other; each array was checked before."""
    _expect(found.tree.moments is not None, "moments of the tree")
    _check_lists(found.surface.grid)
    with np.errstate(all="ignore"):  # of numbers that are then refused
        _check_places(found.surface.grid)
    _check_columns(found)
    _check_tree(found)
    _check_graph(found)
    inside = found.supervoxels >= 0
    _expect(not (found.outliers & inside).any(), "no supervoxel of an outlier")
    surface, k = found.surface, found.tree.n_leaves
    _expect(np.count_nonzero(inside) == len(surface.grid.voxel_of_point), "as many points as have a supervoxel")
    _expect(bool(np.bincount(surface.supervoxels, minlength=k).all()), "a voxel of each supervoxel")
    touching = surface.grid.touching_pairs()
    within = touching[surface.supervoxels[touching[:, 0]] == surface.supervoxels[touching[:, 1]]]
    n_pieces = int(connected_components(within, surface.grid.n_voxels).max()) + 1
    _expect(n_pieces == k, "each supervoxel in one piece")
    _expect(bool((np.linalg.norm(surface.normals, axis=1) <= _UNIT).all()), "normals of unit length")
    _expect(0 <= int(found.objects.max()) < found.next_object, "numbers of objects below the next one")
    _expect(found.next_object < 1 << 31, "numbers of objects in 31 bits")
    _expect(found.viewpoint.shape in ((3,), (np.count_nonzero(inside), 3)), "one viewpoint, or one for each point")
    _expect(_is_length(found.seed_size), "a positive distance of seeds")
    _expect(0.0 <= found.object_altitude < np.inf, "an altitude of objects that is not negative")


def _check_lists(grid: VoxelGrid) -> None:
    """Raise DamagedError unless each point is in one voxel, and voxels that touch are listed with each other."""
    n, v = len(grid.voxel_of_point), len(grid.counts)
    _expect(v > 0, "a voxel")
    for starts, end, name in ((grid.starts, n, "points"), (grid.indptr, len(grid.neighbours), "neighbours")):
        follow = starts[0] == 0 and starts[-1] == end and bool((np.diff(starts) >= 0).all())
        _expect(bool(follow), f"lists of the {name} of each voxel, one after the other")
    held = np.diff(grid.starts)
    listed = np.array_equal(grid.voxel_of_point[grid.order], np.repeat(np.arange(v), held))
    _expect(listed and bool((np.bincount(grid.order, minlength=n) == 1).all()), "each point in the list of its voxel")
    _expect(bool((held <= grid.counts).all()), "no more points in a voxel than it counts")
    owner = np.repeat(np.arange(v), np.diff(grid.indptr))
    pairs = owner * np.int64(v) + grid.neighbours
    _expect(bool((np.diff(pairs) > 0).all()) and bool((owner != grid.neighbours).all()), "neighbours that ascend")
    there_and_back = np.sort(grid.neighbours * np.int64(v) + owner)
    _expect(np.array_equal(there_and_back, pairs), "voxels that touch each other")


def _check_places(grid: VoxelGrid) -> None:
    """Raise DamagedError unless each voxel lies in its cell, and the cells ascend."""
    _check_warp(grid.warp)
    _expect(_is_length(grid.size) and bool((grid.edge_lengths > 0.0).all()), "voxels of positive size")
    _expect((grid.levels is None) == (grid.grading is None), "levels and their grading, or neither")
    levels = np.zeros(grid.n_voxels, np.int8) if grid.levels is None else grid.levels
    _expect(bool((grid.cells == np.floor(grid.cells)).all()), "cells at whole numbers")
    _expect(_are_ascending(np.column_stack((levels, grid.cells))), "voxels in the order of their cells")
    in_cells = grid.warped / grid.warped_edges[:, None] - grid.cells
    slack = _ROUNDING * (1.0 + np.abs(grid.cells))
    _expect(bool(((in_cells >= -slack) & (in_cells <= 1.0 + slack)).all()), "voxels in their cells")
    reach = _ROUNDING * (grid.edge_lengths[:, None] + np.abs(grid.centroids).max())
    off = np.abs(grid.warp.backward(grid.warped) - grid.centroids)
    _expect(bool((off <= reach).all()), "centroids where the warp has them")
    edges = enlarged(grid.size * grid.warp.scale(grid.centroids), grid.levels)
    _expect(bool((np.abs(edges - grid.edge_lengths) <= _ROUNDING * edges).all()), "edges as the warp has them")
    if grid.grading is not None:
        blocks = grid.grading.blocks
        _expect(len(np.unique(blocks, axis=0)) == len(blocks), "each block once")


def _check_columns(found: Segmentation) -> None:
    grid, moments = found.surface.grid, found.leaves
    colored = {part is not None for part in (grid.colors, moments.colors, moments.color_scatters)}
    with_features = {part is not None for part in (grid.features, moments.features, found.feature_scaling)}
    _expect(len(colored) == len(with_features) == 1, "colours, and features, of voxels and supervoxels or of neither")
    _expect(moments.normals is not None, "normals of supervoxels")


def _check_warp(warp: Warp) -> None:
    if isinstance(warp, RangeWarp):
        _expect(_is_length(warp.reference_range) and 0.0 <= warp.growth < 1.0, "a range and a growth of voxels")
    if isinstance(warp, CameraWarp):
        is_unit = abs(float(np.linalg.norm(warp.axis)) - 1.0) <= _ROUNDING
        _expect(is_unit and _is_length(warp.reference_depth), "an axis and a depth of a camera")


def _is_length(value: float) -> bool:
    return 0.0 < value <= _MAX_LENGTH


def _check_tree(found: Segmentation) -> None:
    tree, k = found.tree, len(found.objects)
    try:
        checked_parents(tree.parents)
    except ValueError as error:
        raise DamagedError(f"tree/parents: {error}") from None
    children = np.bincount(tree.parents[:-1], minlength=len(tree.parents))
    _expect(len(tree.parents) == 2 * k - 1 and bool((children[k:] == 2).all()), "two children of each inner node")
    counts = np.bincount(tree.parents[:-1], tree.sizes[:-1], len(tree.parents))
    _expect(bool((counts[k:] == tree.sizes[k:]).all()), "the points of two nodes in the one above them")
    levels = tree.altitudes
    _expect(not levels[:k].any() and bool((levels[1:] >= levels[:-1]).all()), "altitudes from 0 that do not decrease")


def _check_graph(found: Segmentation) -> None:
    graph = found.graph
    _expect(0.0 <= graph.color_evidence <= 1.0, "evidence of colours from 0 to 1")
    pairs, lengths = {"edges": graph.edges}, [graph.edge_features.contact_length]
    if graph.gaps is not None:
        pairs["gaps/edges"] = graph.gaps.edges
        lengths.append(graph.gaps.edge_features.contact_length)
    if graph.continuations is not None:
        pairs["continuations/pairs"] = graph.continuations.pairs
    if graph.bridges is not None:
        pairs["bridges/edges"] = graph.bridges.edges
    for name, some in pairs.items():
        are_sorted = bool((some[:, 0] < some[:, 1]).all()) and _are_ascending(some)
        _expect(are_sorted, f"pairs i < j in ascending order, each once, in graph/{name}")
    _expect(all(bool((one > 0.0).all()) for one in lengths), "contacts of positive length")


def _are_ascending(rows: NDArray[Any]) -> bool:
    """Whether rows ascend by the first column, then the second and so on, and no two are equal."""
    is_above = np.zeros(max(len(rows) - 1, 0), np.bool_)
    for before, after in zip(rows[:-1].T[::-1], rows[1:].T[::-1], strict=True):
        is_above = (after > before) | ((after == before) & is_above)
    return bool(is_above.all())


def _expect(holds: bool, what: str) -> None:
    if not holds:
        raise DamagedError(f"expected {what}")
