# SPDX-License-Identifier: Apache-2.0
"""Plots of curves, points and stacked bars as inline SVG, which take the colours of the page around them.

The content security policy of the pages allows no styles in attributes, so colours are classes of the style sheet
(`style_of_curves`, `.plot`) or presentation attributes. A plot is 440 units wide, so text is legible on a telephone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from markupsafe import Markup, escape

WIDTH, HEIGHT = 440.0, 280.0
"""Size of a plot in its own units; text has a size of 13 of them."""
LEFT, RIGHT, TOP, BOTTOM = 58.0, 12.0, 12.0, 46.0
"""Margins around the axes, in the units of the plot: room for labels."""
LOG_RATIO = 4.0
"""Ratio of the largest to the least value from which an axis is logarithmic."""
MAX_DOTS = 24
"""Points of a curve up to which each has a dot; more dots would be a line of their own."""
CHARACTER = 7.0
"""Mean width of a character of the labels, in the units of the plot."""
COLORS = ("#2d69d2", "#a55a00", "#00b4a5", "#b44b69", "#b4a500", "#00a5ff", "#d20096", "#5a964b", "#ff7878", "#ff4b96")
"""Colours of curves, legible on white and on dark grey.

The first six differ by a CIEDE2000 of 17 or more, all ten by 10, also without red or without green cones (simulated
after Machado et al., see tests/test_report.py). They were found by exchange among colours of a lightness of 46 to 67.
"""


class PlotPoint(NamedTuple):
    """A point of a curve, with the ends of its interval; NaN where there is none."""

    x: float
    y: float
    low: float = math.nan
    high: float = math.nan


@dataclass(frozen=True)
class Curve:
    """A curve of a plot.

    name : of the legend. color : index into `COLORS`. points : in order of x. theory : points of a dashed curve.
    """

    name: str
    color: int
    points: Sequence[PlotPoint]
    theory: Sequence[PlotPoint] = ()


@dataclass(frozen=True)
class Axis:
    """An axis of a plot.

    label : its text. kind : "even" puts values side by side, at 0, 1, 2 ... low, high : values at its ends. labels : of
    the values of an even axis. marks : values of the ticks of other axes; (): round numbers.
    """

    label: str
    kind: Literal["linear", "log", "even"] = "linear"
    low: float = 0.0
    high: float = 1.0
    labels: Sequence[str] = ()
    marks: Sequence[float] = ()

    def fraction(self, value: float) -> float:
        """Place of a value between the ends of the axis, 0..1."""
        if self.kind == "log":
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def ticks(self) -> list[tuple[float, str]]:
        """Values of the ticks with their labels."""
        if self.kind == "even":
            return [(float(place), text) for place, text in enumerate(self.labels)]
        if self.marks:
            return [(v, number_text(v)) for v in self.marks]
        if self.kind == "log":
            steps = (1, 2, 5) if self.high / self.low < 200 else (1,)
            decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            values = [s * 10.0**d for d in decades for s in steps]
        else:
            step = 10.0 ** math.floor(math.log10(max(self.high - self.low, 1e-30)))
            step *= next(f for f in (0.1, 0.2, 0.5, 1.0, 2.0) if (self.high - self.low) / (step * f) <= 6)
            values = [
                k * step for k in range(math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9) + 1)
            ]
        inside = [v for v in values if self.low * (1 - 1e-9) <= v <= self.high * (1 + 1e-9)]
        return [(v, number_text(v)) for v in inside]


def style_of_curves() -> str:
    """Rules of the style sheet for the classes k0 to k9, the colours of curves."""
    return "\n".join(
        f".plot .k{i}.curve, .plot .k{i}.theory {{ stroke: {c}; }} .plot .k{i}.band, .plot .k{i}.dot {{ fill: {c}; }}"
        for i, c in enumerate(COLORS)
    )


def axis_of(values: Sequence[float], label: str, is_logarithmic: bool | None = None) -> Axis:
    """An axis that holds all values, logarithmic where they differ by a factor of `LOG_RATIO` and none is 0."""
    known = [v for v in values if math.isfinite(v)]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    if is_logarithmic is None:
        is_logarithmic = low > 0 and high / low >= LOG_RATIO
    if is_logarithmic and low > 0:
        return Axis(label, "log", low / 1.15, high * 1.15) if high > low else Axis(label, "log", low / 2, high * 2)
    margin = 0.05 * (high - low) or max(abs(high), 1.0) * 0.5
    return Axis(label, "linear", 0.0 if 0 <= low < 0.5 * high else low - margin, high + margin)


def number_text(value: float) -> str:
    """A number of a label, without needless digits.

    Examples
    --------
    >>> [number_text(v) for v in (0.05, 3.0, 100000.0, 0.00002)]
    ['0.05', '3', '100k', '2e-05']
    """
    if abs(value) >= 10_000:
        return f"{value / 1000:g}k"
    return f"{value:g}"


def line_plot(curves: Sequence[Curve], x: Axis, y: Axis, alt: str, bound: float | None = None) -> Markup:
    """A plot of curves with the bands of their intervals; dashed curves are theory.

    Parameters
    ----------
    alt : text in place of the plot. bound : value of y at which a dotted line is drawn, such as a tolerance.
    """
    place = _placed(x, y)
    parts = [_axes(x, y)]
    if bound is not None and y.low < bound < y.high:
        (x0, y0), (x1, _) = place(x.low, bound), place(x.high, bound)
        parts.append(f'<path class="bound" d="M{x0:.1f} {y0:.1f}H{x1:.1f}"/>')
    for curve in curves:
        shown = [p for p in curve.points if math.isfinite(p.y) and (y.kind != "log" or p.y > 0)]
        for run in _runs(shown):
            ends = [*(place(p.x, p.high) for p in run), *(place(p.x, p.low) for p in reversed(run))]
            parts.append(f'<path class="band k{curve.color}" d="M{_path(ends)}Z"/>')
        if theory := [place(p.x, p.y) for p in curve.theory if math.isfinite(p.y) and (y.kind != "log" or p.y > 0)]:
            parts.append(f'<path class="theory k{curve.color}" d="M{_path(theory)}"/>')
        parts.append(
            f'<path class="curve k{curve.color}" d="M{_path([place(p.x, p.y) for p in shown])}"/>' if shown else ""
        )
        if len(shown) <= MAX_DOTS:
            parts += [_dot(place(p.x, p.y), curve.color) for p in shown]
    return _svg(parts, alt)


def point_plot(points: Sequence[tuple[str, int, float, float]], x: Axis, y: Axis, alt: str) -> Markup:
    """A plot of points with their names beside them: (name, colour, x, y)."""
    place, parts = _placed(x, y), [_axes(x, y)]
    taken: list[tuple[float, float]] = []
    for name, color, at_x, at_y in points:
        px, py = place(at_x, at_y)
        is_right = px > WIDTH - RIGHT - CHARACTER * len(name) - 8
        ty = py + 4
        while any(abs(ty - other) < 13 and abs(px - ox) < CHARACTER * len(name) + 20 for ox, other in taken):
            ty -= 13
        taken.append((px, ty))
        anchor = ' text-anchor="end"' if is_right else ""
        parts.append(_dot((px, py), color, 5))
        parts.append(f'<text x="{px + (-9 if is_right else 9):.1f}" y="{ty:.1f}"{anchor}>{escape(name)}</text>')
    return _svg(parts, alt)


def stacked_bars(
    labels: Sequence[str], stacks: Sequence[Sequence[tuple[str, float]]], x_label: str, alt: str
) -> Markup:
    """Bars side by side, each a stack of parts (colour as #rrggbb, fraction 0..1) from below."""
    x = Axis(x_label, "even", -0.6, len(labels) - 0.4, labels)
    y = Axis("fraction of the pixels, %", "linear", 0.0, 100.0)
    place, parts = _placed(x, y), [_axes(x, y)]
    for number, stack in enumerate(stacks):
        below = 0.0
        for color, fraction in stack:
            (x0, y0), (x1, y1) = place(number - 0.4, 100 * below), place(number + 0.4, 100 * (below + fraction))
            if fraction > 0:
                size = f'width="{x1 - x0:.1f}" height="{y0 - y1:.1f}"'
                parts.append(f'<rect x="{x0:.1f}" y="{y1:.1f}" {size} fill="{color}"/>')
            below += fraction
    return _svg(parts, alt)


def _placed(x: Axis, y: Axis) -> Callable[[float, float], tuple[float, float]]:
    """Function that places values in the plot; values beyond the axes are put at their ends."""
    bottom = _bottom(x)

    def place(at_x: float, at_y: float) -> tuple[float, float]:
        fx = min(max(x.fraction(at_x), 0.0), 1.0)
        fy = min(max(y.fraction(at_y), 0.0), 1.0) if y.kind != "log" or at_y > 0 else 0.0
        return LEFT + fx * (WIDTH - LEFT - RIGHT), HEIGHT - bottom - fy * (HEIGHT - TOP - bottom)

    return place


def _is_slanted(x: Axis) -> bool:
    """Whether labels of an even axis do not fit side by side."""
    room = (WIDTH - LEFT - RIGHT) / max(len(x.labels), 1)
    return x.kind == "even" and max(map(len, x.labels), default=0) * CHARACTER > room


def _bottom(x: Axis) -> float:
    """Margin below the axes: slanted labels need more."""
    return BOTTOM + (0.5 * CHARACTER * max(map(len, x.labels)) if _is_slanted(x) else 0.0)


def _axes(x: Axis, y: Axis) -> str:
    """Axes, grid lines and labels."""
    place, bottom, slanted = _placed(x, y), _bottom(x), _is_slanted(x)
    floor, parts = HEIGHT - bottom, []
    for value, text in y.ticks():
        _, at = place(x.low, value)
        parts.append(f'<path class="grid" d="M{LEFT:.1f} {at:.1f}H{WIDTH - RIGHT:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6:.1f}" y="{at + 4:.1f}" text-anchor="end">{escape(text)}</text>')
    end = -1e9
    for value, text in x.ticks():
        at, _ = place(value, y.low)
        half = CHARACTER * len(text) / 2
        if not slanted and at - half < end + 4:
            continue  # it would overlap the label before it
        end = at + half
        turn = (
            f' transform="rotate(-30 {at:.1f} {floor + 14:.1f})" text-anchor="end"'
            if slanted
            else ' text-anchor="middle"'
        )
        parts.append(f'<text x="{at:.1f}" y="{floor + 17:.1f}"{turn}>{escape(text)}</text>')
    parts.append(f'<path class="axis" d="M{LEFT:.1f} {TOP:.1f}V{floor:.1f}H{WIDTH - RIGHT:.1f}"/>')
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(
        f'<text class="label" x="{middle:.1f}" y="{HEIGHT - 8:.1f}" text-anchor="middle">{escape(x.label)}</text>'
    )
    centre = (TOP + floor) / 2
    parts.append(
        f'<text class="label" x="14" y="{centre:.1f}" text-anchor="middle" transform="rotate(-90 14 {centre:.1f})">'
        f"{escape(y.label)}</text>"
    )
    return "".join(parts)


def _runs(points: Sequence[PlotPoint]) -> list[list[PlotPoint]]:
    """Runs of two points or more that have intervals."""
    runs: list[list[PlotPoint]] = [[]]
    for point in points:
        if math.isfinite(point.low) and math.isfinite(point.high):
            runs[-1].append(point)
        elif runs[-1]:
            runs.append([])
    return [run for run in runs if len(run) > 1]


def _path(places: Sequence[tuple[float, float]]) -> str:
    return "L".join(f"{x:.1f} {y:.1f}" for x, y in places)


def _dot(place: tuple[float, float], color: int, radius: float = 3) -> str:
    return f'<circle class="dot k{color}" cx="{place[0]:.1f}" cy="{place[1]:.1f}" r="{radius:g}"/>'


def _svg(parts: Sequence[str], alt: str) -> Markup:
    """An SVG element. Its texts are escaped by those who make them."""
    body = "".join(parts)
    return Markup(
        f'<svg class="plot" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{escape(alt)}">{body}</svg>'
    )
