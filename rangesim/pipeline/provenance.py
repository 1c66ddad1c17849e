# SPDX-License-Identifier: Apache-2.0
"""The provenance of a result: resolved settings, checksum of the scene, rigs of the instruments, and versions."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rangesim.environment.versions import versions
from rangesim.experiment import Experiment, experiment_to_dict
from rangesim.instrument.instrument import Instrument
from rangesim.results.experiment_results import InstrumentRecord, ResultRecord, SceneRecord, ShapeRecord
from rangesim.settings.config import to_dict

if TYPE_CHECKING:
    from rangesim.rig import Rig
    from rangesim.scene import Scene


def provenance(
    experiment: Experiment,
    scene: Scene,
    passes: Sequence[tuple[Rig, Sequence[Instrument]]],
    variant: str,
    times_s: dict[str, float],
) -> ResultRecord:
    """The contents of `experiment.json`.

    Parameters
    ----------
    passes : rig and instruments of each pass, as `rangesim.pipeline.shared_passes.group_by_rig` returns.
    variant : Mitsuba's variant, such as "llvm_ad_mono".
    times_s : seconds that each stage took.
    """
    placed = {i.name: (number, rig) for number, (rig, ones) in enumerate(passes, 1) for i in ones}
    return ResultRecord(
        experiment=experiment_to_dict(experiment),
        scene=SceneRecord(
            name=scene.name,
            sha256=_checksum(scene.source),
            working_distance_m=scene.working_distance_m,
            shapes=[ShapeRecord(name=i.name, material=i.material, object=i.object_name) for i in scene.instances],
        ),
        passes=len(passes),
        instruments=[
            InstrumentRecord(name=i.name, light_pass=placed[i.name][0], rig=to_dict(placed[i.name][1]))
            for i in experiment.instruments
        ],
        versions=dict(versions()),
        variant=variant,
        times_s=times_s,
    )


def _checksum(path: Path | None) -> str | None:
    """SHA-256 of the scene's file; None if the scene has no file, or if the file no longer exists."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path is not None and path.is_file() else None
