# SPDX-License-Identifier: Apache-2.0
"""Point clouds: the class `Cloud`, and its conversion from and to the named columns of files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.errors import CloudReadError, CloudWriteError
from pcgraph.plumbing.short_repr import ShortRepr

Columns = Mapping[str, NDArray[np.generic]]
"""One array per field of a file."""

NORMAL_NAMES = (("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz"))
PACKED_NAMES = ("rgb", "rgba")
COLOR_NAMES = ("red", "green", "blue")
COLOR_TRIPLES = (COLOR_NAMES, ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
LABEL_NAMES = ("label", "labels")
VIEWPOINT_NAMES = ("vp_x", "vp_y", "vp_z")
"""As in PCL's PointWithViewpoint."""


@dataclass(frozen=True, eq=False)
class Cloud(ShortRepr):
    """Points, and the columns that a file has for them.

    Attributes
    ----------
    points : (n, 3) or (h, w, 3) float32 or float64, metres, the file's frame
        Organised if the file is (PCD with HEIGHT > 1). NaN where the sensor saw nothing. They are float64 if the file
        has float64, integers of 64 bits, or whole numbers beyond 2**24, which float32 would round.
    colors : same leading shape + (3,), uint8, 0..255, or None
        Red, green, blue. Black where a text file has nan for a packed colour; None if it has nothing else.
    normals : same leading shape + (3,), float32 or float64, or None
        As stored; not checked for unit length.
    labels : same leading shape, int32, or None
        The file's own ``label`` or ``labels`` field, for example ground truth. Labels of unsigned 32 bits keep their
        bits: 4294967295, as PCL stores -1, is -1. A field of 64 bits that int32 does not hold stays in `columns`.
    viewpoint : (3,) or points' shape float64, metres, the file's frame, or None
        Position of the sensor: one for all points, or one for each point, as in files of several scans. None: unknown.
    columns : dict of name to array of the same leading shape, or that + (c,), of any dtype of numbers
        All other fields of the file, as stored: intensity, ring, time, classification and the like.
        `pcgraph.segment` takes them as `features` by name; `write_cloud` and `write_segmentation` write them back.

    Examples
    --------
    >>> import numpy as np
    >>> cloud = Cloud(np.zeros((2, 3)), columns={"intensity": np.array([7, 9], np.uint16)})
    >>> cloud.points.shape, cloud.organised, cloud.columns["intensity"].tolist()
    ((2, 3), False, [7, 9])
    """

    points: NDArray[np.floating]
    colors: NDArray[np.uint8] | None = None
    normals: NDArray[np.floating] | None = None
    labels: NDArray[np.int32] | None = None
    viewpoint: NDArray[np.float64] | None = None
    columns: dict[str, NDArray[np.generic]] = field(default_factory=dict)

    @property
    def organised(self) -> bool:
        """Whether the points lie on an image lattice."""
        return self.points.ndim == 3

    def finite(self) -> Cloud:
        """The points with finite coordinates as a list, in their order, with their colours, columns and so on."""
        return self.select(np.isfinite(self.points).all(axis=-1))

    def select(self, chosen: NDArray[np.bool_]) -> Cloud:
        """Some of the points as a list, in their order, with their colours, columns and so on.

        Parameters
        ----------
        chosen : the points' leading shape, bool

        Raises
        ------
        ValueError
            There is not one truth value for each point.

        Examples
        --------
        >>> import numpy as np, pcgraph
        >>> classes = np.array([2, 7, 2], np.uint8)
        >>> cloud = pcgraph.Cloud(np.eye(3), columns={"classification": classes})
        >>> cloud.select(cloud.columns["classification"] != 7).points.tolist()  # without the noise of LAS files
        [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
        """
        seen = np.asarray(chosen)
        if seen.dtype != np.bool_ or seen.shape != self.points.shape[:-1]:
            raise ValueError(
                f"expected one truth value for each point, bool of shape {self.points.shape[:-1]}, "
                f"got {seen.dtype} of shape {seen.shape}"
            )
        return Cloud(
            self.points[seen],
            None if self.colors is None else self.colors[seen],
            None if self.normals is None else self.normals[seen],
            None if self.labels is None else self.labels[seen],
            self.viewpoint if self.viewpoint is None or self.viewpoint.ndim == 1 else self.viewpoint[seen],
            {name: column[seen] for name, column in self.columns.items()},
        )


# ---- From columns --------------------------------------------------------------------------------------------------


class Roles(NamedTuple):
    """Lower-case names of the columns that are a cloud's colours, normals, labels and viewpoint; () if there are none.

    Attributes
    ----------
    colors : tuple of str
        The name of packed colours, or the names of red, green and blue.
    normals, viewpoint : tuple of str
        The names of x, y and z.
    labels : tuple of str
        One name.
    """

    colors: tuple[str, ...]
    normals: tuple[str, ...]
    labels: tuple[str, ...]
    viewpoint: tuple[str, ...]

    @classmethod
    def of(cls, columns: Columns) -> Roles:
        """Roles of columns by their lower-case names."""
        packed = (name for name in PACKED_NAMES if name in columns and columns[name].dtype.itemsize == 4)
        labels = (name for name in LABEL_NAMES if name in columns and are_labels(columns[name]))
        return cls(
            next(((name,) for name in packed), _all_of(COLOR_TRIPLES, columns)),
            _all_of(NORMAL_NAMES, columns),
            next(((name,) for name in labels), ()),
            _all_of((VIEWPOINT_NAMES,), columns),
        )


def _all_of(choices: Iterable[tuple[str, ...]], columns: Columns) -> tuple[str, ...]:
    """The first choice whose names are all columns; () if there is none."""
    return next((names for names in choices if all(name in columns for name in names)), ())


def cloud_from_columns(columns: Columns, shape: tuple[int, ...], viewpoint: NDArray[np.float64] | None = None) -> Cloud:
    """Cloud built from one array per field.

    Parameters
    ----------
    columns : mapping of field name to (n,) or (n, c) array
        Must hold ``x``, ``y``, ``z``. Colours (``rgb``/``rgba`` packed, or ``red``/``green``/``blue``, or these after
        ``diffuse_``, or ``r``/``g``/``b``), normals, labels and viewpoints (``vp_x`` and so on) are found under the
        names that PCL, Open3D and MeshLab write, in upper or lower case. White is 65535 in unsigned 16 bits, 1 in
        floats of at most 1, else 255. All other fields, and those of several numbers for each point, stay as they are.
        Fields called ``_``, the name of padding in PCD files, are left out.
    shape : (n,) or (h, w)
        Leading shape of the result.
    viewpoint : (3,) float64, metres, optional
        Position of the sensor, unless columns have one for each point.

    Raises
    ------
    CloudReadError
        A coordinate is missing, or is not one number for each point.
    """
    stored, names = columns, _names_by_lower_case(columns)
    columns = {lower: stored[name] for lower, name in names.items() if stored[name].ndim == 1}
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        vectors = [name for name in missing if name in names]
        if vectors:
            count = stored[names[vectors[0]]].shape[1]
            raise CloudReadError(f"expected one number for each point in the field {vectors[0]!r}, got {count}")
        raise CloudReadError(
            f"expected the fields x, y and z, but {', '.join(missing)} is missing; found: {', '.join(columns)[:200]}"
        )
    roles = Roles.of(columns)
    used = {"_", *(names[lower] for lower in ("x", "y", "z", *chain.from_iterable(roles)))}
    if roles.viewpoint:
        viewpoint = _stack(columns, roles.viewpoint, shape).astype(np.float64)
    return Cloud(
        points=_stack(columns, ("x", "y", "z"), shape),
        colors=_colors(columns, roles.colors, shape),
        normals=_stack(columns, roles.normals, shape) if roles.normals else None,
        labels=columns[roles.labels[0]].astype(np.int32).reshape(shape) if roles.labels else None,
        viewpoint=viewpoint,
        columns={name: _kept(column, shape) for name, column in stored.items() if name not in used},
    )


def _stack(columns: Columns, names: tuple[str, ...], shape: tuple[int, ...]) -> NDArray[np.floating]:
    dtype = np.float64 if any(_is_wide(columns[name]) for name in names) else np.float32
    stacked = np.empty((*shape, len(names)), dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, name in enumerate(names):
            stacked[..., axis] = columns[name].reshape(shape)
    return stacked


def float_points(rows: NDArray[np.generic]) -> NDArray[np.floating]:
    """Coordinates of any type of numbers as float32, or as float64 where that would round them."""
    with np.errstate(over="ignore", invalid="ignore"):
        return rows.astype(np.float64 if _is_wide(rows) else np.float32, copy=False)


def _is_wide(column: NDArray[np.generic]) -> bool:
    """Whether float32 would round the column: because of its type, or of whole numbers beyond 2**24."""
    if column.dtype.itemsize > 4:
        return True
    return column.dtype.kind in "iu" and max(abs(int(column.min(initial=0))), int(column.max(initial=0))) > 1 << 24


def _colors(columns: Columns, names: tuple[str, ...], shape: tuple[int, ...]) -> NDArray[np.uint8] | None:
    if len(names) == 1:
        bits = np.ascontiguousarray(columns[names[0]]).view(np.uint32)
        channels = [(bits >> shift) & 0xFF for shift in (16, 8, 0)]
        return np.stack(channels, axis=-1).astype(np.uint8).reshape(*shape, 3)
    if not names:
        return None
    stored = [columns[name] for name in names]
    if all(channel.dtype == np.uint8 for channel in stored):
        return np.stack(stored, axis=-1).astype(np.uint8).reshape(*shape, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        values = np.stack(stored, axis=-1).astype(np.float64)
        scaled = np.rint(values * (255.0 / _white(stored, values)))
    return np.clip(np.nan_to_num(scaled), 0, 255).astype(np.uint8).reshape(*shape, 3)


def color_bytes(colors: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Colours of any type of numbers, (..., 3), as uint8, with white as `cloud_from_columns` finds it."""
    channels = dict(zip(COLOR_NAMES, colors.reshape(-1, 3).T, strict=True))
    return _colors(channels, COLOR_NAMES, colors.shape[:-1])  # type: ignore[return-value]


def _white(stored: list[NDArray[np.generic]], values: NDArray[np.float64]) -> float:
    """The number that means white: 65535 in unsigned 16 bits, 1 in floats of at most 1, else 255."""
    if all(channel.dtype.kind == "u" and channel.dtype.itemsize == 2 for channel in stored):
        return 65535.0
    floats = all(channel.dtype.kind == "f" for channel in stored)
    return 1.0 if floats and values.max(initial=0.0, where=np.isfinite(values)) <= 1.0 else 255.0


def are_labels(column: NDArray[np.generic]) -> bool:
    """Whether a column holds whole numbers that stay distinct as int32."""
    if column.dtype.kind not in "iu" or column.dtype.itemsize <= 4:
        return column.dtype.kind in "iu"
    limits = np.iinfo(np.int32)
    return limits.min <= int(column.min(initial=0)) and int(column.max(initial=0)) <= limits.max


def _names_by_lower_case(columns: Columns) -> dict[str, str]:
    """Names of columns by their lower-case forms; if two names have one form, the lower-case name counts."""
    found: dict[str, str] = {}
    for name in sorted(columns, key=lambda name: name != name.lower()):
        found.setdefault(name.lower(), name)
    return found


def _kept(column: NDArray[np.generic], shape: tuple[int, ...]) -> NDArray[np.generic]:
    """A copy of a column in a shape, so that the file's bytes need not stay in memory."""
    return column.reshape(*shape, *column.shape[1:]).copy()


_MAX_COLUMNS_OF_SO_FEW = 64
"""Most columns of three or four points. Beyond them the rows are x, y, z and perhaps 1 of as many points. By eye:
sensors give some twenty columns."""


def cloud_from_array(values: ArrayLike) -> Cloud:
    """Cloud of an array whose last axis, or whose fields, are the columns.

    Parameters
    ----------
    values : (n, 3 + c) or (h, w, 3 + c) numbers; or (n,) or (h, w) with fields x, y, z and others
        Further columns of an array without fields are called ``column_3``, ``column_4`` and so on, because it is not
        known whether they are intensities, colours or labels. The type of the numbers stays. `cloud_from_columns`
        interprets the fields of a structured array.

    Raises
    ------
    ValueError
        The array has another shape, a coordinate is missing, or a field does not hold numbers.
    """
    if isinstance(values, np.ndarray) and values.dtype.names is not None:
        return _cloud_from_fields(values)
    array = as_numbers("points", values)
    if array.ndim not in (2, 3) or array.shape[-1] < 3:
        expected = "points of shape (n, 3) or (h, w, 3), or with further columns, (n, 4) and so on"
        raise ValueError(f"expected {expected}, got {array.shape}")
    if array.ndim == 2 and array.shape[0] in (3, 4) and array.shape[1] > _MAX_COLUMNS_OF_SO_FEW:
        raise ValueError(f"expected a row for each point, got {array.shape}: transpose the array")
    further = {f"column_{i}": array[..., i] for i in range(3, array.shape[-1])}
    return Cloud(array[..., :3] if further else array, columns=further)  # type: ignore[arg-type]


def _cloud_from_fields(table: NDArray[np.void]) -> Cloud:
    fields = {name: np.atleast_1d(np.asarray(without_mask(table[name]))) for name in table.dtype.names or ()}
    wrong = [name for name, values in fields.items() if values.dtype.kind not in "fiub"]
    if wrong:
        raise ValueError(f"expected fields of numbers, got {fields[wrong[0]].dtype} in the field {wrong[0]!r}")
    shape = table.shape if table.ndim else (1,)
    columns = {name: native(values).reshape(table.size, *_rest(values, shape)) for name, values in fields.items()}
    try:
        return cloud_from_columns(columns, shape)
    except CloudReadError as error:
        raise ValueError(str(error)) from None


def _rest(values: NDArray[np.generic], shape: tuple[int, ...]) -> tuple[int, ...]:
    """Shape of the values of one point: () for numbers, (c,) for vectors; further axes are flattened into c."""
    rest = values.shape[len(shape) :]
    return (int(np.prod(rest)),) if rest else ()


def native(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """The values in the byte order of this machine."""
    return values.astype(values.dtype.newbyteorder("="), copy=False)


# ---- Into columns --------------------------------------------------------------------------------------------------


def plain_cloud(cloud: Cloud) -> Cloud:
    """The cloud with arrays of the types that `Cloud` documents.

    Masked numbers become NaN, points float32 or float64, colours within 0..1 uint8, and labels int32.

    Raises
    ------
    CloudWriteError
        An array has another shape than the points, is not of numbers, or holds what its type cannot.
    """
    points = np.asarray(without_mask(cloud.points))
    if points.dtype.kind not in "fiu" or points.ndim not in (2, 3) or points.shape[-1] != 3:
        raise CloudWriteError(
            f"expected the cloud's points as numbers of shape (n, 3) or (h, w, 3), got {points.dtype} {points.shape}"
        )
    points = float_points(points)
    shape = points.shape[:-1]
    colors, normals = _own("colors", cloud.colors, points.shape), _own("normals", cloud.normals, points.shape)
    labels, viewpoint = _own("labels", cloud.labels, shape), cloud.viewpoint
    if normals is not None and normals.dtype.kind != "f":
        raise CloudWriteError(f"expected the cloud's normals as floats, got {normals.dtype}")
    if viewpoint is not None and np.shape(viewpoint) != (3,):
        viewpoint = _own("viewpoint", viewpoint, points.shape)  # type: ignore[assignment]
    return Cloud(
        points,
        None if colors is None else _bytes_of(colors),
        None if normals is None else float_points(normals),
        None if labels is None else _whole_labels(labels),
        None if viewpoint is None else np.asarray(viewpoint, np.float64),
        {name: _checked_column(name, column, shape) for name, column in cloud.columns.items()},
    )


def _own(name: str, given: ArrayLike | None, wanted: tuple[int, ...]) -> NDArray[np.generic] | None:
    """The cloud's own colours, normals, labels or viewpoints in the points' shape."""
    if given is None:
        return None
    values = np.asarray(without_mask(given))
    if values.shape != wanted:
        raise CloudWriteError(f"expected the cloud's {name} in the shape {wanted}, got {values.shape}")
    return values


def _bytes_of(colors: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Colours as uint8, from uint8 or from floats within 0..1; black where they are NaN."""
    if colors.dtype == np.uint8:
        return colors  # type: ignore[return-value]
    shades = np.nan_to_num(colors.astype(np.float64)) if colors.dtype.kind == "f" else np.array([np.inf])
    if not ((shades >= 0.0) & (shades <= 1.0)).all():
        raise CloudWriteError(f"expected the cloud's colors as uint8 or as floats within 0..1, got {colors.dtype}")
    return np.rint(255.0 * shades).astype(np.uint8)


def _whole_labels(labels: NDArray[np.generic]) -> NDArray[np.int32]:
    limits = np.iinfo(np.int32)
    is_whole = labels.dtype.kind in "iub" or (labels.dtype.kind == "f" and bool((labels == np.rint(labels)).all()))
    if not is_whole:
        raise CloudWriteError(f"expected the cloud's labels as whole numbers, got {labels.dtype}")
    if labels.size and not (limits.min <= labels.min() and labels.max() <= limits.max):
        raise CloudWriteError(f"expected the cloud's labels in 32 bits, got {labels.min()} to {labels.max()}")
    return labels.astype(np.int32, copy=False)


def _checked_column(name: str, column: NDArray[np.generic], shape: tuple[int, ...]) -> NDArray[np.generic]:
    if not isinstance(name, str) or not name.split() or not "".join(name.split()).isprintable():
        raise CloudWriteError(f"expected names of columns as printable words, got {ascii(name)[:80]}")
    if not isinstance(column, np.ndarray) or column.dtype.kind not in "fiub":
        kind = column.dtype if isinstance(column, np.ndarray) else type(column).__name__
        raise CloudWriteError(f"expected the column {name!r} as an array of numbers, got {kind}")
    if column.shape[: len(shape)] != shape or column.ndim > len(shape) + 1:
        raise CloudWriteError(f"expected the column {name!r} in the points' shape {shape}, got {column.shape}")
    return np.asarray(without_mask(column))


def columns_of_cloud(
    cloud: Cloud,
    colors: Sequence[tuple[str, ...]] = (COLOR_NAMES, PACKED_NAMES[:1]),
    normals: Sequence[tuple[str, ...]] = NORMAL_NAMES[::-1],
) -> dict[str, NDArray[np.generic]]:
    """One array per field of a cloud: the inverse of `cloud_from_columns`.

    Colours, normals, labels and viewpoints of each point get the first names under which `cloud_from_columns` finds
    them again. Usually these are ``red``, ``nx``, ``label`` and ``vp_x``. If the cloud has a further column ``red``,
    its colours are packed as ``rgb``. A viewpoint that all points share is not among the columns.

    Parameters
    ----------
    cloud : Cloud, as `plain_cloud` returns it
    colors, normals : names to choose from, the best first; a single name is that of packed colours

    Returns
    -------
    dict of name to (n,) array, or (n, c) of vectors
        Coordinates first, the cloud's further columns last.

    Raises
    ------
    CloudWriteError
        A further column has the name of a coordinate, or takes all names that the cloud's own arrays could have.
    """
    n = cloud.points[..., 0].size
    axes = dict(zip("xyz", cloud.points.reshape(-1, 3).T, strict=True))
    shape = cloud.points.shape[:-1]
    further = {name: column.reshape(n, *_rest(column, shape)) for name, column in cloud.columns.items()}
    clash = [name for name in further if name in (*axes, "_")]
    if clash:
        raise CloudWriteError(f"expected a column of another name than {clash[0]!r}, which files keep for themselves")
    places = cloud.viewpoint if cloud.viewpoint is not None and cloud.viewpoint.ndim > 1 else None
    given = (cloud.colors, cloud.normals, cloud.labels, places)
    choices: list[Sequence[tuple[str, ...]]] = [colors, normals, [(name,) for name in LABEL_NAMES], [VIEWPOINT_NAMES]]
    choices = [[()] if values is None else of for values, of in zip(given, choices, strict=True)]
    for names in product(*choices):
        own = dict(chain.from_iterable(_named(role, values) for role, values in zip(names, given, strict=True)))
        columns = {**axes, **own, **further}
        if len(columns) == len(axes) + len(own) + len(further) and _is_found(names, columns):
            return columns
    raise CloudWriteError(
        f"expected columns of other names than the cloud's own colours, normals and labels have, "
        f"got {', '.join(further)[:200]}; rename those columns"
    )


def _named(names: tuple[str, ...], values: NDArray[np.generic] | None) -> Iterable[tuple[str, NDArray[np.generic]]]:
    """The values with their names; three bytes under one name are packed as PCL packs colours."""
    if not names or values is None:
        return ()
    if names[0] in PACKED_NAMES:
        rows = values.reshape(-1, 3).astype(np.uint32)
        return ((names[0], rows[:, 0] << 16 | rows[:, 1] << 8 | rows[:, 2]),)
    return zip(names, values.reshape(-1, len(names)).T, strict=True)


def _is_found(chosen: Sequence[tuple[str, ...]], columns: Columns) -> bool:
    """Whether `cloud_from_columns` finds the chosen roles.

    It may find further roles among the cloud's columns, but not colours that 8 bits cannot hold.
    """
    lower = {name: columns[stored] for name, stored in _names_by_lower_case(columns).items()}
    found = Roles.of({name: values for name, values in lower.items() if values.ndim == 1})
    are_kept = found.colors in chosen or all(lower[name].dtype == np.uint8 for name in found.colors)
    return are_kept and all(names in ((), role) for names, role in zip(chosen, found, strict=True))


# ---- Arrays of callers ----------------------------------------------------------------------------------------------


def without_mask(values: ArrayLike) -> ArrayLike:
    """The numbers unchanged; a masked array becomes floats, with NaN where it is masked."""
    if not isinstance(values, np.ma.MaskedArray):
        return values
    if values.dtype.kind not in "fiu" or not np.ma.getmaskarray(values).any():
        return values.data
    return np.ma.filled(values.astype(np.result_type(values.dtype, np.float32)), np.nan)


def as_numbers(name: str, values: ArrayLike) -> NDArray[np.generic]:
    """The values as an array of numbers, with NaN for masked ones; ValueError if they are not numbers."""
    values = without_mask(values)
    try:
        array = np.asarray(values)
    except ValueError:
        raise ValueError(f"expected {name} as a regular array of numbers, got rows of different lengths") from None
    if array.dtype.kind not in "fiu":
        raise ValueError(f"expected {name} of a floating-point or integer dtype, got {array.dtype}")
    return array
