# SPDX-License-Identifier: Apache-2.0
"""The examples in the docstrings of every room run and print what they say."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

ROOMS = [
    "pcgraph.plumbing",
    "rangesim.calibration",
    "rangesim.decoding",
    "rangesim.electronics",
    "rangesim.fusion",
    "rangesim.geometry",
    "rangesim.motion",
    "rangesim.multiview",
    "rangesim.response",
    "rangesim.rig",
    "rangesim.sensors",
    "rangesim.settings",
    "rangesim.signals",
]
"""Packages whose docstrings are run, all of their modules."""
MODULES = ["rangesim.errors", "rangesim.sensor", "rangesim.triangle_mesh"]
"""Modules outside these packages whose docstrings are run."""


def modules_of(room: str) -> list[str]:
    """Full names of a package and of every module in it."""
    package = importlib.import_module(room)
    return [room, *(module.name for module in pkgutil.walk_packages(package.__path__, f"{room}."))]


@pytest.mark.parametrize("room", ROOMS)
def test_the_examples_of_a_room_print_what_they_say(room):
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    modules = modules_of(room)
    assert len(modules) > 1
    failures = {
        name: failed
        for name in modules
        if (failed := doctest.testmod(importlib.import_module(name), optionflags=options).failed)
    }
    assert not failures, f"failed examples per module: {failures}; doctest's report stands above."


@pytest.mark.parametrize("module", MODULES)
def test_the_examples_of_a_module_print_what_they_say(module):
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    tried = doctest.testmod(importlib.import_module(module), optionflags=options)
    assert tried.attempted > 0
    assert tried.failed == 0
