# SPDX-License-Identifier: Apache-2.0
"""Decides which instruments share a light-transport pass: those whose emitter, wavelength and camera agree."""

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

    The passes are in the order in which their first instruments appear. An ideal instrument has no wavelength, so it
    joins the first pass with its camera and emitter. If something moves, each instrument has a pass of its own, because
    each takes its frames at other times.
    """
    groups: list[tuple[Rig, list[Instrument]]] = []
    for instrument in experiment.instruments:
        rig = instrument.rig(scene, experiment.width, experiment.height)
        shared = None if experiment.motion is not None else first_that_agrees(groups, rig, instrument)
        if shared is None:
            groups.append((rig, [instrument]))
        else:
            of_group, members = groups[shared]
            groups[shared] = (of_group if rig.wavelength_m is None else rig, [*members, instrument])
    return groups


def first_that_agrees(groups: list[tuple[Rig, list[Instrument]]], rig: Rig, instrument: Instrument) -> int | None:
    """Index of the first group whose emitter, wavelength and cameras are those of a rig and an instrument; None if
    there is none."""
    for index, (other, members) in enumerate(groups):
        is_same_light = None in (rig.wavelength_m, other.wavelength_m) or rig.wavelength_m == other.wavelength_m
        if not is_same_light or replace(rig, wavelength_m=other.wavelength_m) != other:
            continue
        if members[0].sensor.rigs(rig)[1:] == instrument.sensor.rigs(rig)[1:]:
            return index
    return None
