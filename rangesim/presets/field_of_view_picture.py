# SPDX-License-Identifier: Apache-2.0
"""A picture of the fields of view of devices, from above and from the side, with their ranges."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rangesim.rig import ScanningCamera

if TYPE_CHECKING:
    from rangesim.presets.preset import Preset

PANELS_IN_A_ROW = 4
"""Number of panels side by side; the 17 devices of the package make five rows."""
PANEL_INCH = 2.6
"""Width and height of a panel, inches: the titles, in 9 points, fit."""
ARC_CORNERS = 90
"""Number of corners with which an arc is drawn: a whole turn has one every 4 degrees and looks round."""


def fields_of_view_png(found: Sequence[Preset]) -> bytes:
    """PNG file with a panel for each device: the area that it sees from above, and from the side as a second shade.

    The device stands at the origin and looks up the page; from the side, what is above it is to the right. Both axes
    are metres, and each panel has its own scale.

    Examples
    --------
    >>> from rangesim import presets
    >>> fields_of_view_png([presets.describe("kinect-v2")])[1:4]
    b'PNG'
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    across = min(PANELS_IN_A_ROW, len(found))
    down = math.ceil(len(found) / across)
    figure = Figure(figsize=(PANEL_INCH * across, PANEL_INCH * down), layout="constrained")
    for number, preset in enumerate(found, 1):
        sheet = preset.sheet
        axes = figure.add_subplot(down, across, number)
        for limits_rad, colour, label in zip(
            limits(preset), ("#4477aa", "#ee6677"), ("from above", "from the side"), strict=True
        ):
            outline = sector(limits_rad, *sheet.range_m, is_flat=sheet.range_along == "z")
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


def limits(preset: Preset) -> tuple[tuple[float, float], tuple[float, float]]:
    """Least and largest azimuth (to the right), and elevation (up), that a device sees, radians.

    Examples
    --------
    >>> from rangesim import presets
    >>> np.degrees(limits(presets.describe("livox-mid-360"))[1]).round(1)
    array([-7., 52.])
    """
    across, down = np.radians(preset.sheet.field_of_view_deg) / 2
    elevation = float(-down), float(down)
    if isinstance(preset.instrument.camera, ScanningCamera):
        up = np.arcsin(-preset.instrument.camera.rays.directions[..., 1])
        elevation = float(up.min()), float(up.max())
    return (float(-across), float(across)), elevation


def sector(limits_rad: tuple[float, float], near_m: float, far_m: float, is_flat: bool) -> np.ndarray:
    """(n, 2) float64, metres, corners of the area that is seen in a plane through the optical axis.

    Parameters
    ----------
    limits_rad : least and largest angle to the axis, radians.
    near_m, far_m : limits of the range.
    is_flat : whether the limits are planes, as for a depth, or arcs, as for a distance along the ray.

    Examples
    --------
    >>> sector((-math.pi / 4, math.pi / 4), 1.0, 2.0, is_flat=True).round(1)[[0, -1]]
    array([[-1.,  1.],
           [-2.,  2.]])
    """
    angles = np.linspace(*limits_rad, ARC_CORNERS)
    rays = np.stack([np.sin(angles), np.cos(angles)], axis=1)
    if is_flat and max(map(abs, limits_rad)) < math.pi / 2:
        rays /= rays[:, 1:]
    return np.concatenate([near_m * rays, far_m * rays[::-1]])
