# SPDX-License-Identifier: Apache-2.0
"""When the frames of a capture are taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np

from rangesim.rig import Array, Intrinsics
from rangesim.sensor import Sensor
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, Pause, check_fields, whole


class Window(NamedTuple):
    """A part of the image: rows from `top` to before `bottom`, columns from `left` to before `right`."""

    top: int
    bottom: int
    left: int
    right: int

    @classmethod
    def whole(cls, camera: Intrinsics) -> Window:
        """All of a camera's image."""
        return cls(0, camera.height, 0, camera.width)

    def of(self, image: np.ndarray) -> np.ndarray:
        """The window's pixels (..., rows, columns) of an image (..., h, w); a view."""
        return image[..., self.top : self.bottom, self.left : self.right]


class Instant(NamedTuple):
    """A time at which a window of the image is exposed, in seconds, and its fraction of the exposure."""

    time_s: float
    window: Window
    fraction: float


@dataclass(frozen=True)
class Timing:
    """When a sensor takes its frames, in seconds on the clock of the pose tracks.

    The middle of exposure k, in line r, is at start_s + k frame_period_s + r line_period_s. What fills one exposure
    is up to the sensor: each pattern of structured light has its own, all bins of a direct time-of-flight camera
    share one, and so do the four taps of an AMCW frequency, unless its pixels have but a `single_tap`.

    Parameters
    ----------
    frame_period_s : float >= 0, from one exposure to the next.
    line_period_s : float >= 0, from one line to the next as the camera reads them. 0: all lines at once (flash, global
        shutter). The projector lights its whole field for every line, as it does at once. So this is a rolling shutter,
        not a scanning beam: a beam would light one line alone, with all of its power and without the multipath of the
        others.
    lines : "rows" from top to bottom, or "columns" from left to right.
    bands : int >= 1, lines that are read one by one are rendered in so many bands (fewer if there are fewer lines),
        each at the time of its middle. Every band is a pass of its own.
    single_tap : bool, an AMCW camera takes its taps one after another. That is when they are taken, not how bright they
        are: a pixel that collects half of the light for each has twice as much as `AmcwToF` gives a tap in an exposure.
    start_s : float, middle of the first exposure.
    exposure_s, exposure_samples : float >= 0 and int >= 1: the exposure is rendered at so many times, evenly spread,
        and averaged. By default the motion within an exposure is neglected.

    Raises
    ------
    ValueError
        A number out of its range.
    """

    frame_period_s: Pause = 1 / 60
    line_period_s: Pause = 0.0
    lines: Literal["rows", "columns"] = "rows"
    bands: Annotated[int, whole(1, "passes")] = 16
    single_tap: bool = False
    start_s: Annotated[float, Bounds("a time in seconds", -1e12, 1e12)] = 0.0
    exposure_s: Pause = 0.0
    exposure_samples: Annotated[int, whole(1, "passes")] = 1

    def __post_init__(self) -> None:
        check_fields(self)

    def exposure_of_frames(self, sensor: Sensor) -> np.ndarray:
        """(k,) int64, index of the exposure that fills each frame of a sensor."""
        return np.arange(sensor.n_frames) // sensor.frames_per_exposure(self.single_tap)

    def exposure_times_s(self, sensor: Sensor) -> Array:
        """(e,) float64, seconds, middle of each exposure in line 0."""
        exposures = int(self.exposure_of_frames(sensor)[-1]) + 1
        bands = self.bands if self.line_period_s else 1
        passes = exposures * bands * self.exposure_samples
        limits.check("passes", passes, f"passes for {exposures} exposures in {bands} bands")
        return np.asarray(self.start_s + self.frame_period_s * np.arange(exposures), dtype=np.float64)

    def reference_s(self, sensor: Sensor, camera: Intrinsics) -> float:
        """Middle of the acquisition, seconds: between the first line of the first exposure and the last of the last."""
        times = self.exposure_times_s(sensor)
        return float(0.5 * (times[0] + times[-1] + self.line_period_s * (self._lines(camera) - 1)))

    def instants(self, exposure_time_s: float, camera: Intrinsics) -> list[Instant]:
        """When which window of the image is rendered for an exposure with that middle in line 0."""
        n, whole = self.exposure_samples, Window.whole(camera)
        offsets = [self.exposure_s * ((i + 0.5) / n - 0.5) for i in range(n)]
        if self.line_period_s == 0:
            return [Instant(exposure_time_s + offset, whole, 1 / n) for offset in offsets]
        edges = np.linspace(0, self._lines(camera), min(self.bands, self._lines(camera)) + 1).round().astype(int)
        result = []
        for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            window = whole._replace(top=begin, bottom=end)
            if self.lines == "columns":
                window = whole._replace(left=begin, right=end)
            middle = exposure_time_s + self.line_period_s * 0.5 * (begin + end - 1)
            result += [Instant(middle + offset, window, 1 / n) for offset in offsets]
        return result

    def _lines(self, camera: Intrinsics) -> int:
        return camera.height if self.lines == "rows" else camera.width
