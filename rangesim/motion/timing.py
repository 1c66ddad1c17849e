# SPDX-License-Identifier: Apache-2.0
"""Timing of the frames of a capture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np

from rangesim.rig import Array, Camera
from rangesim.sensor import Sensor
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, Pause, check_fields, whole


class Window(NamedTuple):
    """Rectangle of an image: rows `top` to `bottom` - 1, columns `left` to `right` - 1."""

    top: int
    bottom: int
    left: int
    right: int

    @classmethod
    def whole(cls, camera: Camera) -> Window:
        """The window that is the whole image of a camera."""
        return cls(0, camera.height, 0, camera.width)

    def of(self, image: np.ndarray) -> np.ndarray:
        """Pixels of an image (..., h, w) inside the window: (..., rows, columns), a view and no copy."""
        return image[..., self.top : self.bottom, self.left : self.right]


class Instant(NamedTuple):
    """One moment at which a window of the image is rendered.

    time_s : seconds, on the clock of the pose tracks.
    window : part of the image.
    fraction : fraction (0..1) of the exposure that the moment stands for.
    """

    time_s: float
    window: Window
    fraction: float


@dataclass(frozen=True)
class Timing:
    """Timing of a sensor's frames, in seconds on the clock of the pose tracks.

    The middle of exposure k in line r is at start_s + k frame_period_s + r line_period_s. The sensor decides which
    frames share an exposure. Each pattern of structured light has its own exposure. All bins of a direct time-of-flight
    camera share one. The four taps of an AMCW frequency share one too, but with `single_tap` each tap has its own.

    A camera whose rays have times of their own, such as `rangesim.rig.Spinning`, starts its scan at start_s. It takes
    sensors of one exposure.

    Parameters
    ----------
    frame_period_s : float >= 0, seconds from one exposure to the next.
    line_period_s : float >= 0, seconds from one line to the next as the camera reads them. 0: all lines at once (global
        shutter). The emitter lights its whole field for every line. So a line period makes a rolling shutter, not a
        scanning beam: a beam would light one line at a time with its full power, without multipath from other lines.
    lines : "rows" from top to bottom, or "columns" from left to right.
    bands : int >= 1, number of bands of lines (fewer if there are fewer lines), if lines are read one by one. Each band
        is a pass of its own, rendered at the time of its middle line. For a camera whose rays have times: of columns
        or rows that are measured about the same time, if objects move; motion of the rig needs no bands there.
    single_tap : bool, whether an AMCW camera takes its taps one after another. This sets the times of the taps, not
        their signal: a tap has the light that `AmcwToF` gives it, by default a quarter of an exposure.
        `AmcwToF(taps_per_exposure=1)` has the same times, and the light of a real pixel with a single tap, half of an
        exposure.
    start_s : float, seconds, middle of the first exposure.
    exposure_s : float >= 0, seconds, over which the moments of `exposure_samples` are spread. 0: the motion within an
        exposure is neglected.
    exposure_samples : int >= 1, number of moments in an exposure that are rendered and averaged.

    Raises
    ------
    ValueError
        A number out of its range.

    Examples
    --------
    >>> from rangesim import AmcwToF
    >>> from rangesim.motion import Timing
    >>> timing = Timing(frame_period_s=0.002)
    >>> sensor = AmcwToF()
    >>> timing.exposure_of_frames(sensor).tolist()
    [0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2]
    >>> timing.exposure_times_s(sensor).tolist()
    [0.0, 0.002, 0.004]
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
        """Index of the exposure of each frame of a sensor: (k,) int64."""
        return sensor.exposure_of_frames(self.single_tap)

    def exposure_times_s(self, sensor: Sensor) -> Array:
        """Middle of each exposure, in line 0: (e,) float64, seconds."""
        exposures = int(self.exposure_of_frames(sensor).max()) + 1
        bands = self.bands if self.line_period_s else 1
        passes = exposures * bands * self.exposure_samples
        limits.check("passes", passes, f"passes for {exposures} exposures in {bands} bands")
        return np.asarray(self.start_s + self.frame_period_s * np.arange(exposures), dtype=np.float64)

    def reference_s(self, sensor: Sensor, camera: Camera) -> float:
        """Time of the middle of the acquisition, in seconds.

        It is halfway between the first line of the first exposure and the last line of the last exposure.
        """
        times = self.exposure_times_s(sensor)
        if camera.times_s is not None:
            return float(times[0] + 0.5 * (camera.times_s.min() + camera.times_s.max()))
        return float(0.5 * (times[0] + times[-1] + self.line_period_s * (self._lines(camera) - 1)))

    def instants(self, exposure_time_s: float, camera: Camera) -> list[Instant]:
        """Moments at which the windows of the image are rendered, for one exposure.

        exposure_time_s : seconds, middle of the exposure in line 0.
        """
        if camera.times_s is not None:
            return self._scan(exposure_time_s, camera.times_s)
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

    def _scan(self, start_s: float, times: Array) -> list[Instant]:
        """Moments of the bands of a scan whose rays have times (h, w) after its start."""
        by_columns = np.ptp(times.mean(axis=0)) >= np.ptp(times.mean(axis=1))
        count = times.shape[1 if by_columns else 0]
        edges = np.linspace(0, count, min(self.bands, count) + 1).round().astype(int)
        result = []
        for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            whole = Window(0, times.shape[0], 0, times.shape[1])
            window = whole._replace(left=begin, right=end) if by_columns else whole._replace(top=begin, bottom=end)
            inside = window.of(times)
            result.append(Instant(start_s + 0.5 * float(inside.min() + inside.max()), window, 1.0))
        return result

    def check_scan(self, sensor: Sensor) -> None:
        """Raise ValueError if a camera whose rays have times cannot take a sensor's frames with this timing."""
        if len(self.exposure_times_s(sensor)) > 1:
            raise ValueError(
                f"expected a sensor that takes all frames in one exposure for a camera that scans, got {sensor}."
            )
        if self.line_period_s or self.exposure_samples > 1:
            raise ValueError(
                "expected a timing without line_period_s and exposure_samples for a camera that scans: its rays have "
                "times of their own."
            )

    def _lines(self, camera: Camera) -> int:
        return camera.height if self.lines == "rows" else camera.width
