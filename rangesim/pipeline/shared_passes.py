# SPDX-License-Identifier: Apache-2.0
"""Decides which instruments share a light-transport pass: those whose emitter and camera agree."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.rig import Rig

if TYPE_CHECKING:
    from rangesim.scene import Scene


def group_by_rig(experiment: Experiment, scene: Scene) -> list[tuple[Rig, list[Instrument]]]:
    """The passes of an experiment, each as a rig and the list of instruments that share it.

    A sensor of several cameras has its pass with all of them; the rig of a pass is that of the first camera.

    The passes are in the order in which their first instruments appear. Instruments of different wavelengths share
    their light, see `rig_of_pass`. If something moves, each instrument has a pass of its own, because each takes its
    frames at other times.
    """
    groups: list[tuple[Rig, list[Instrument]]] = []
    for instrument in experiment.instruments:
        rig = rig_of_pass(instrument, scene, experiment.width, experiment.height)
        shared = None if experiment.motion is not None else first_that_agrees(groups, rig, instrument)
        if shared is None:
            groups.append((rig, [instrument]))
        else:
            groups[shared][1].append(instrument)
    return groups


def rig_of_pass(instrument: Instrument, scene: Scene, width: int | None, height: int | None) -> Rig:
    """Rig of an instrument's light-transport pass; parameters as of `Instrument.rig`.

    It states no wavelength: the renderer is monochrome, and no material depends on the wavelength.
    """
    return replace(instrument.rig(scene, width, height), wavelength_m=None)


def first_that_agrees(groups: list[tuple[Rig, list[Instrument]]], rig: Rig, instrument: Instrument) -> int | None:
    """Index of the first group whose emitter and cameras are those of a rig and an instrument; None if there is
    none."""
    for index, (other, members) in enumerate(groups):
        if rig == other and members[0].sensor.rigs(rig)[1:] == instrument.sensor.rigs(rig)[1:]:
            return index
    return None
