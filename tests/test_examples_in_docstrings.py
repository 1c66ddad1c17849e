# SPDX-License-Identifier: Apache-2.0
"""The examples in the docstrings of every room run and print what they say."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
from functools import cache
from typing import Any

import pytest
from synthetic import plane_signals, stereo_rig

from rangesim import AmcwToF, Detector, compare, decode, expose

ROOMS = [
    "pcgraph.detection",
    "pcgraph.io",
    "pcgraph.plumbing",
    "pcgraph.tree",
    "pcgraph.viewer",
    "rangesim.calibration",
    "rangesim.capture",
    "rangesim.causes",
    "rangesim.codes",
    "rangesim.conventions",
    "rangesim.decoding",
    "rangesim.electronics",
    "rangesim.environment",
    "rangesim.evaluation",
    "rangesim.experiment",
    "rangesim.files",
    "rangesim.fusion",
    "rangesim.geometry",
    "rangesim.instrument",
    "rangesim.motion",
    "rangesim.multiview",
    "rangesim.pipeline",
    "rangesim.point_cloud",
    "rangesim.presets",
    "rangesim.recordings",
    "rangesim.report",
    "rangesim.response",
    "rangesim.results",
    "rangesim.rig",
    "rangesim.scene",
    "rangesim.sensors",
    "rangesim.settings",
    "rangesim.signals",
    "rangesim.sweep",
]
"""Packages whose docstrings are run, all of their modules."""
MODULES = [
    "pcgraph.cloud",
    "pcgraph.cloud_sources",
    "pcgraph.labelling",
    "pcgraph.scan",
    "rangesim",
    "rangesim.errors",
    "rangesim.light_transport.transport_settings",
    "rangesim.sensor",
    "rangesim.triangle_mesh",
]
"""Modules outside these packages whose docstrings are run."""


GIVEN_A_WALL = ["rangesim.capture", "rangesim.causes", "rangesim.evaluation", "rangesim.report"]
"""Packages whose examples start from the names of `a_wall`."""


@cache
def a_wall() -> dict[str, Any]:
    """Signals of a wall at 1 m, their sensor, a range image and its comparison with the truth; no renderer."""
    sensor = AmcwToF()
    signals = plane_signals(stereo_rig(64, 48, baseline_m=0.0), sensor)
    image = decode(expose(signals, sensor, Detector()))
    return {"signals": signals, "sensor": sensor, "image": image, "comparison": compare(image, signals)}


def modules_of(room: str) -> list[str]:
    """Full names of a package and of every module in it."""
    package = importlib.import_module(room)
    return [room, *(module.name for module in pkgutil.walk_packages(package.__path__, f"{room}."))]


@pytest.mark.parametrize("room", ROOMS)
def test_the_examples_of_a_room_print_what_they_say(room):
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    modules, given = modules_of(room), a_wall() if room in GIVEN_A_WALL else {}
    assert len(modules) > 1
    failures = {
        name: failed
        for name in modules
        if (failed := doctest.testmod(importlib.import_module(name), optionflags=options, extraglobs=given).failed)
    }
    assert not failures, f"failed examples per module: {failures}; doctest's report stands above."


@pytest.mark.parametrize("module", MODULES)
def test_the_examples_of_a_module_print_what_they_say(module):
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    tried = doctest.testmod(importlib.import_module(module), optionflags=options)
    assert tried.attempted > 0
    assert tried.failed == 0
