# SPDX-License-Identifier: Apache-2.0
"""Data sets of random scenes: drawn from a specification in TOML, measured, and kept in shards (docs/datasets.md)."""

from rangesim.dataset.bop_export import export_bop
from rangesim.dataset.coco_export import export_coco
from rangesim.dataset.dataset_spec import DatasetSpec, ObjectGroup, RoomLight, load_spec, spec_from_dict, spec_to_dict
from rangesim.dataset.production import make_dataset
from rangesim.dataset.random_scene import PlacedObject, RandomScene, random_scene
from rangesim.dataset.samples import Samples
from rangesim.dataset.store import Store
from rangesim.dataset.verification import verify_dataset

__all__ = [
    "DatasetSpec",
    "ObjectGroup",
    "PlacedObject",
    "RandomScene",
    "RoomLight",
    "Samples",
    "Store",
    "export_bop",
    "export_coco",
    "load_spec",
    "make_dataset",
    "random_scene",
    "spec_from_dict",
    "spec_to_dict",
    "verify_dataset",
]
