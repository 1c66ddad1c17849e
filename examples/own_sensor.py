# SPDX-License-Identifier: Apache-2.0
"""A sensor of your own, in one file: a range-gated camera, with its decoder.

A laser sends short pulses, and the shutter opens for as long as a pulse lasts, a little later from frame to frame. A
surface appears in two neighbouring gates, and the ratio of the two gives its place between them.

    rangesim run tabletop --sensor examples/own_sensor.py:GatedCamera --sensor amcw --out out/gated
    rangesim decode out/gated/gated-camera/capture --sensor examples/own_sensor.py:GatedCamera --out out/gated-decoded
    rangesim report out/gated --sensor examples/own_sensor.py:GatedCamera

In an experiment file: `sensor = "own_sensor.py:GatedCamera"`, or a table with `type = "own_sensor.py:GatedCamera"`.

Usage: python examples/own_sensor.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from rangesim import Capture, Decoder, Sensor, Status, compare, decode, expose, load_scene, transport
from rangesim.capture import bright_level
from rangesim.decoding.path_length import PathLengths
from rangesim.electronics.detector import Detector
from rangesim.response import SPEED_OF_LIGHT, DenseResponse, LightPath, Math
from rangesim.sensor import Background, Emitter, FrameContent, least_signal_for, of_type


@dataclass(frozen=True)
class Gates(DenseResponse):
    """Fraction of a pulse that each gate lets in. It is a triangle, because pulse and gate are boxes of one width."""

    delays_m: tuple[float, ...]
    """Path lengths in metres whose light fills a gate."""
    width_m: float

    type_name: ClassVar[str] = "gates"

    @property
    def channels(self) -> int:  # type: ignore[override]
        return len(self.delays_m)

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        overlaps = [1 - m.abs(path.path_length_m - delay) / self.width_m for delay in self.delays_m]
        return [m.select(overlap > 0, overlap, 0.0) for overlap in overlaps]


@dataclass(frozen=True)
class GatedCamera(Sensor):
    """A range-gated camera. Frames: one for each gate, each a pulse later, and one without the laser.

    Parameters
    ----------
    gates : int >= 2, number of gates.
    width_s : float, seconds, width of pulse and gate. first_s : float, seconds, delay of the first gate.
    duty : float, fraction of an exposure in which a gate is open.
    """

    gates: int = 8
    width_s: float = 2e-9
    first_s: float = 2e-9
    duty: float = 0.02

    type_name: ClassVar[str] = "gated-camera"

    @property
    def delays_s(self) -> np.ndarray:
        """(gates,) seconds, round trips whose light fills a gate."""
        return self.first_s + self.width_s * np.arange(self.gates)

    def responses(self) -> tuple[Gates]:
        return (Gates(tuple(SPEED_OF_LIGHT * self.delays_s), SPEED_OF_LIGHT * self.width_s),)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        lit = np.concatenate([channels[0], np.zeros_like(channels[0][:1])])
        return (lit + self.duty * ambient).astype(np.float32)

    def frame_names(self) -> list[str]:
        return [*(f"gate{i}" for i in range(self.gates)), "laser_off"]

    @property
    def default_emitter(self) -> Emitter:
        return Emitter(baseline_m=0.03)

    @property
    def default_detector(self) -> Detector:
        return Detector(full_well_e=30_000.0, read_noise_e=10.0)

    @property
    def default_decoder(self) -> GateRatio:
        return GateRatio()

    def is_beyond_range(self, path_length_m: np.ndarray) -> np.ndarray:
        first, *_, last = SPEED_OF_LIGHT * self.delays_s
        return (path_length_m < first) | (path_length_m > last)

    @property
    def title(self) -> str:
        return "Range-gated camera"

    @property
    def details(self) -> str:
        return f"{self.gates} gates of {self.width_s * 1e9:g} ns"

    def representative_frames(self, frames: np.ndarray) -> list[int]:
        return [0, self.gates // 2, self.gates]


@dataclass(frozen=True)
class GateRatio(Decoder):
    """Decodes path length from the ratio of the two neighbouring gates that hold most light.

    Parameters
    ----------
    sigmas : float, least light in the two gates, in standard deviations of its noise.
    relative_light : float, the same for noise-free captures, as a fraction of that in bright pixels.
    """

    sigmas: float = 5.0
    relative_light: float = 1e-3

    type_name: ClassVar[str] = "gate-ratio"
    reads: ClassVar[type[Sensor]] = GatedCamera

    def coordinates(self, capture: Capture) -> PathLengths:
        sensor = of_type(capture.sensor, GatedCamera)
        *gates, off = capture.frames.astype(np.float64)
        light = np.stack(gates) - off
        pairs = light[:-1] + light[1:]
        first = pairs.argmax(axis=0)[None]
        both, later = (np.take_along_axis(x, first, axis=0)[0] for x in (pairs, light[1:]))
        noise = [capture.noise(np.take_along_axis(np.stack(gates), first + k, axis=0)[0]) for k in (0, 1)]
        dark = capture.noise(off)
        if noise[0] is None or noise[1] is None or dark is None:
            least = self.relative_light * bright_level(both)
        else:
            least = self.sigmas * np.sqrt(noise[0] ** 2 + noise[1] ** 2 + 4 * dark**2)
        is_enough = both > least
        ratio = np.clip(later / np.where(is_enough, both, 1.0), 0, 1)
        length_m = SPEED_OF_LIGHT * (sensor.delays_s[first[0]] + ratio * sensor.width_s)
        status = np.where(is_enough, Status.OK, Status.LOW_SIGNAL)
        status[capture.saturated(capture.frames)] = Status.SATURATED
        return PathLengths(length_m=length_m, status=status, confidence=both / capture.full_scale, intensity=both)

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        if background.noise_variance is None:
            return background.floor(self.relative_light)
        frame = self.content(sensor).ambient * background.ambient + background.noise_variance
        return least_signal_for(self.sigmas**2, 1.0, 6 * frame)  # of two gates, minus twice the frame without the laser

    def content(self, sensor: Sensor) -> FrameContent:
        return FrameContent(signal=0.5, ambient=of_type(sensor, GatedCamera).duty)


def main() -> None:
    sensor = GatedCamera()
    scene = load_scene("matte")
    size, baseline_m = sensor.default_emitter
    signals = transport(scene, scene.rig(baseline_m, size, width=320, height=240), [sensor], spp=16)
    image = decode(expose(signals, sensor, sensor.default_detector))
    for row in compare(image, signals.truth).rows():
        print(f"{row['name']}: {row['right']:.1%} right, median error {1e3 * row['median_abs_m']:.1f} mm")


if __name__ == "__main__":
    main()
