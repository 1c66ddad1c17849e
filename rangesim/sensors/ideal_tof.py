# SPDX-License-Identifier: Apache-2.0
"""Ideal time of flight: the path length of the first return, and its decoder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.decoding.path_length import PathLengths
from rangesim.decoding.status import Status
from rangesim.response import FirstReturn, Response
from rangesim.sensor import TOF_BASELINE_M, Background, Decoder, Emitter, FrameContent, Sensor, of_type


@dataclass(frozen=True)
class IdealToF(Sensor):
    """Time of flight that reads only the path length of the first return: the best that any such sensor could do.

    Frames: `radiance` of the first return, W/m2/sr, and `radiance_x_length`, this radiance times the path length in
    metres.

    Examples
    --------
    >>> IdealToF().frame_names()
    ['radiance', 'radiance_x_length']
    """

    type_name: ClassVar[str] = "ideal-tof"
    is_ideal: ClassVar[bool] = True
    first_return_frame: ClassVar[int | None] = 0

    def responses(self) -> tuple[Response, ...]:
        return (FirstReturn(),)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        return np.asarray(channels[0], dtype=np.float32)

    def frames_per_exposure(self, single_tap: bool = False) -> int:
        return self.n_frames

    def frame_names(self) -> list[str]:
        return ["radiance", "radiance_x_length"]

    @property
    def default_emitter(self) -> Emitter:
        return Emitter(baseline_m=TOF_BASELINE_M)

    @property
    def default_decoder(self) -> IdealToFDecoder:
        return IdealToFDecoder()

    @property
    def default_detector(self) -> None:
        return None

    @property
    def title(self) -> str:
        return "Ideal time of flight"

    @property
    def details(self) -> str:
        return "no noise, first return alone"

    def representative_frames(self, frames: np.ndarray) -> list[int]:
        return [0]


@dataclass(frozen=True)
class IdealToFDecoder(Decoder):
    """Decodes the path length as radiance_x_length / radiance. Pixels without radiance are `LOW_SIGNAL`.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.array([[[0.5, 0.0]], [[1.5, 0.0]]], dtype=np.float32)  # 0.5 W/m2/sr after 3 m, and darkness
    >>> IdealToFDecoder().coordinates(Capture(frames, IdealToF())).length_m
    array([[ 3., nan]])
    """

    type_name: ClassVar[str] = "ideal-tof"
    reads: ClassVar[type[Sensor]] = IdealToF

    def coordinates(self, capture: Capture) -> PathLengths:
        of_type(capture.sensor, IdealToF)
        radiance, weighted = (frame.astype(np.float64) for frame in capture.frames)
        dark = ~(radiance > 0)
        length = weighted / np.where(dark, 1.0, radiance)
        status = np.where(dark, Status.LOW_SIGNAL, Status.OK)
        confidence = radiance / (bright_level(radiance) or 1.0)
        return PathLengths(length_m=length, status=status, confidence=confidence, intensity=radiance)

    def pixel_reader(self, sensor: Sensor) -> Callable[[Capture], PathLengths]:
        return self.coordinates  # which checks nothing of the capture as a whole

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        return background.floor(0.0)

    def content(self, sensor: Sensor) -> FrameContent:
        return FrameContent(signal=1.0, ambient=0.0)
