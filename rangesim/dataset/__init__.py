# SPDX-License-Identifier: Apache-2.0
"""Data sets of random scenes: what is drawn, from a specification in TOML (docs/datasets.md)."""

from rangesim.dataset.dataset_spec import DatasetSpec, ObjectGroup, RoomLight, load_spec, spec_from_dict, spec_to_dict
from rangesim.dataset.random_scene import PlacedObject, RandomScene, random_scene

__all__ = [
    "DatasetSpec",
    "ObjectGroup",
    "PlacedObject",
    "RandomScene",
    "RoomLight",
    "load_spec",
    "random_scene",
    "spec_from_dict",
    "spec_to_dict",
]
