# SPDX-License-Identifier: Apache-2.0
"""A picture of the fields of view of devices: from above, each with its range."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rangesim.presets.preset import Preset

COLUMNS = 4
"""Panels in a row of the picture."""
PANEL_INCH = 2.6
"""Width and height of a panel, inches."""
ARC = 90
"""Number of corners with which an arc is drawn."""


def fields_of_view_png(found: Sequence[Preset]) -> bytes:
    """PNG file with a panel for each device: the area that it sees from above, and its view down as a second shade.

    The device stands at the origin and looks up the page. Both axes are metres, and each panel has its own scale.

    Examples
    --------
    >>> from rangesim import presets
    >>> fields_of_view_png([presets.describe("kinect-v2")])[1:4]
    b'PNG'
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    across = min(COLUMNS, len(found))
    down = math.ceil(len(found) / across)
    figure = Figure(figsize=(PANEL_INCH * across, PANEL_INCH * down), layout="constrained")
    for number, preset in enumerate(found, 1):
        sheet = preset.sheet
        axes = figure.add_subplot(down, across, number)
        for angle_deg, colour, label in zip(
            sheet.field_of_view_deg, ("#4477aa", "#ee6677"), ("from above", "from the side"), strict=True
        ):
            outline = sector(math.radians(angle_deg), *sheet.range_m, is_flat=sheet.range_along == "z")
            axes.fill(*outline.T, color=colour, alpha=0.45, linewidth=0, label=label)
        axes.plot(0, 0, "k^", markersize=4)
        axes.set_title(preset.name, fontsize=9)
        axes.set_aspect("equal", adjustable="datalim")
        axes.tick_params(labelsize=7)
        if number == 1:
            axes.legend(fontsize=6, loc="lower right")
    figure.supxlabel("metres", fontsize=8)
    file = io.BytesIO()
    FigureCanvasAgg(figure).print_png(file)
    return file.getvalue()


def sector(angle_rad: float, near_m: float, far_m: float, is_flat: bool) -> np.ndarray:
    """(n, 2) float64, metres, corners of the area that is seen in a plane through the optical axis.

    Parameters
    ----------
    angle_rad : full angle of the field of view.
    near_m, far_m : limits of the range.
    is_flat : whether the limits are planes, as for a depth, or arcs, as for a distance along the ray.

    Examples
    --------
    >>> sector(math.pi / 2, 1.0, 2.0, is_flat=True).round(1)[[0, -1]]
    array([[-1.,  1.],
           [-2.,  2.]])
    """
    angles = np.linspace(-angle_rad / 2, angle_rad / 2, ARC)
    rays = np.stack([np.sin(angles), np.cos(angles)], axis=1)
    if is_flat and angle_rad < math.pi:
        rays /= rays[:, 1:]
    return np.concatenate([near_m * rays, far_m * rays[::-1]])
