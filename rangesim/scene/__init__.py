# SPDX-License-Identifier: Apache-2.0
"""Scenes: geometry and materials in Mitsuba, with named shapes, material classes and a camera."""

import rangesim.environment.backend  # noqa: F401  (chooses the LLVM before Dr.Jit is imported)
from rangesim.scene.load import load_scene
from rangesim.scene.scene import Instance, Scene

__all__ = ["Instance", "Scene", "load_scene"]
