# SPDX-License-Identifier: Apache-2.0
"""Orders in which people show the frames of a code: axes, blocks, inverses, white and black."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations, product, zip_longest
from typing import NamedTuple

import numpy as np

from rangesim.codes import AXES
from rangesim.codes.frame_order import in_order
from rangesim.sensors import StructuredLight

INVERSE = "_inverse"
"""End of the names of frames that are the inverse of another frame."""

INVERSES = {
    "": "each pattern is followed by its inverse",
    "before": "each inverse stands before its pattern",
    "none": "there are no inverses",
    "only": "only the inverses were shown: a pattern is dark where its code is 1",
    "after all": "all patterns of an axis come before all inverses",
    "before all": "all inverses of an axis come before all patterns",
}
"""Places of the inverses, each with the sentence that says so."""

ENDS = {
    ((), ("white", "black")): "white and black come last",
    (("white", "black"), ()): "white and black come first",
    ((), ("black", "white")): "black and white come last, black before white",
    (("black", "white"), ()): "black and white come first, black before white",
    (("white",), ("black",)): "white comes first and black last",
    (("black",), ("white",)): "black comes first and white last",
    ((), ()): "there are no white and black images",
    ((), ("white",)): "white comes last, and there is no black image",
    (("white",), ()): "white comes first, and there is no black image",
    ((), ("black",)): "black comes last, and there is no white image",
    (("black",), ()): "black comes first, and there is no white image",
}
"""White and black before and after the patterns, each with the sentence that says so."""


class Layout(NamedTuple):
    """An order of the frames of a code.

    axes : axes in the order in which they are shown. ends : key of `ENDS`. inverses : key of `INVERSES`.
    is_reversed : whether the patterns come from the finest to the coarsest.
    blocks : order of the kinds of patterns, such as bits and fringes, as indices of the code's own order.
    is_by_block : whether each kind of patterns is shown along both axes before the next kind.
    is_interleaved : whether the axes take turns from pattern to pattern.
    """

    axes: tuple[str, ...]
    ends: tuple[tuple[str, ...], tuple[str, ...]] = ((), ("white", "black"))
    inverses: str = ""
    is_reversed: bool = False
    blocks: tuple[int, ...] = (0,)
    is_by_block: bool = False
    is_interleaved: bool = False

    def names(self, sensor: StructuredLight) -> list[str]:
        """Names of the frames in this order."""
        groups = {axis: self._groups(sensor, axis) for axis in self.axes}
        if self.is_interleaved:
            columns = [[group for groups_of in groups[axis] for group in groups_of] for axis in self.axes]
            middle = [group for turn in zip_longest(*columns, fillvalue=[]) for group in turn]
        elif self.is_by_block:
            middle = [group for i in range(len(self.blocks)) for axis in self.axes for group in groups[axis][i]]
        else:
            middle = [group for axis in self.axes for block in groups[axis] for group in block]
        return [*self.ends[0], *(name for group in middle for name in group), *self.ends[1]]

    def _groups(self, sensor: StructuredLight, axis: str) -> list[list[list[str]]]:
        """Names along an axis: for each block, groups of names that stay together."""
        names = sensor.code.names(sensor.size(axis))
        result = []
        for i in self.blocks:
            kind = kinds(sensor)[i]
            own = [n for n, k in zip(names, kinds_of(names), strict=True) if k == kind and not n.endswith(INVERSE)]
            if self.is_reversed and kind in refined_kinds(sensor):
                own.reverse()
            pairs = [(f"{axis}_{name}", f"{axis}_{name}{INVERSE}" if name + INVERSE in names else None) for name in own]
            patterns, inverses = [[p] for p, _ in pairs], [[q] for _, q in pairs if q]
            result.append(
                {
                    "": [[p, q] if q else [p] for p, q in pairs],
                    "before": [[q, p] if q else [p] for p, q in pairs],
                    "none": patterns,
                    "only": inverses or patterns,
                    "after all": patterns + inverses,
                    "before all": inverses + patterns,
                }[self.inverses]
            )
        return result


def kinds_of(names: list[str]) -> list[str]:
    """Kind of each pattern of a code: its name without its number, and without what tells inverses.

    Fringes of several periods are one kind beside other patterns. Alone, each period is a kind.
    """
    each = [re.sub(r"\d+$", "", name.removesuffix(INVERSE)) for name in names]
    merged = [re.sub(r"^period\d+_", "", kind) for kind in each]
    return merged if len(set(merged)) > 1 else each


def kinds(sensor: StructuredLight) -> list[str]:
    """Kinds of patterns of a sensor's code in its own order, such as "bit" and "phase"."""
    return list(dict.fromkeys(kinds_of(sensor.code.names(sensor.size(sensor.axes[0])))))


def refined_kinds(sensor: StructuredLight) -> list[str]:
    """Kinds whose patterns become finer, such as bits, so that they may come in reverse."""
    size = sensor.size(sensor.axes[0])
    variation: dict[str, list[float]] = {}
    names = sensor.code.names(size)
    for name, kind, total in zip(names, kinds_of(names), variations(sensor.code.patterns(size)), strict=True):
        if not name.endswith(INVERSE):
            variation.setdefault(kind, []).append(float(total))
    return [kind for kind, totals in variation.items() if (np.diff(totals) >= 0).all() and totals[-1] > totals[0]]


def variations(patterns: np.ndarray) -> np.ndarray:
    """(n,) total variation of patterns (n, size): the sum of the changes from pixel to pixel."""
    return np.asarray(np.abs(np.diff(patterns.astype(np.float64), axis=1)).sum(axis=1))


def layouts(sensor: StructuredLight, n: int) -> Iterator[Layout]:
    """Layouts of `n` frames of the sensor's code, the most usual ones first.

    The axes may be exchanged, and one of two may be missing.
    """
    has_inverses = any(name.endswith(INVERSE) for name in sensor.code.names(sensor.size(sensor.axes[0])))
    n_kinds = len(kinds(sensor))
    subsets: list[tuple[str, ...]] = list(permutations(sensor.axes))
    if len(sensor.axes) == 2:
        subsets += [(axis,) for axis in AXES]
    own = tuple(range(n_kinds))
    orders = dict.fromkeys((own, own[::-1]))
    counts: dict[tuple[object, ...], int] = {}
    for axes, inverses, ends, is_reversed, blocks, (is_by_block, is_interleaved) in product(
        subsets,
        INVERSES if has_inverses else [""],
        ENDS,
        (False, True) if refined_kinds(sensor) else (False,),
        orders,
        ((False, False), (True, False), (False, True)),
    ):
        if (is_by_block and (len(axes) < 2 or n_kinds < 2)) or (is_interleaved and len(axes) < 2):
            continue
        layout = Layout(axes, ends, inverses, is_reversed, blocks, is_by_block, is_interleaved)
        size = (axes, inverses)
        if size not in counts:
            counts[size] = len(layout._replace(ends=((), ())).names(sensor))
        if counts[size] + len(ends[0]) + len(ends[1]) == n:
            yield layout


def with_layout(sensor: StructuredLight, layout: Layout) -> StructuredLight:
    """The sensor with this order of its frames, written as shortly as it can be.

    Raises
    ------
    ValueError
        The code cannot be decoded from these frames.
    """
    names = layout.names(sensor)
    first, last = layout.ends
    plain = replace(sensor, axes=layout.axes, order=())  # type: ignore[arg-type]
    if plain.frame_names() == names:
        return plain
    by_axis = tuple(f"{axis}_*" for axis in layout.axes)
    for order in ((*first, "*"), (*first, *by_axis, *last)):
        shown = _with_order(plain, order, names)
        if shown is not None:
            return shown
    return replace(plain, order=tuple(names))


def _with_order(plain: StructuredLight, order: tuple[str, ...], names: list[str]) -> StructuredLight | None:
    """The sensor with that order if it means these names; None if not."""
    try:
        meant = in_order(plain.frame_names(), order)
    except ValueError:
        return None
    return replace(plain, order=order) if meant == names else None
