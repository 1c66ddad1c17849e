# SPDX-License-Identifier: Apache-2.0
"""Estimate of what a scan will cost, before it starts: light transport as of a run, and what is done with its views."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rangesim.experiment import Experiment
from rangesim.experiment.camera_paths import Viewpoint
from rangesim.experiment.scan_settings import ScanSettings
from rangesim.pipeline.cost import FRAME_S, Cost, Rest, estimate_cost
from rangesim.pipeline.views import poses_of

if TYPE_CHECKING:
    from rangesim.rig import Rig
    from rangesim.scene import Scene

VOXEL_SPACINGS = 1.5
"""Ratio of the voxel to the distance between readings, if none is given."""
MAX_FINER = 10 * VOXEL_SPACINGS
"""That voxel over the least one that `fuse` accepts: a tenth of the distance between readings."""
TRIANGLES = 4.0
"""Triangles of the surface at that voxel, per pixel of one view, however many views overlap: 3.1 to 3.9 of
`matte`, `plane` and a part on a table, 160 to 640 pixels wide, 3 to 12 views."""
VIEW_PIXEL_S = 4e-6
"""Seconds per pixel of each view: decoding 2e-6, fusion 1e-6, the file 1e-6."""
TRIANGLE_S = 3e-6
"""Seconds per triangle and shape that it is compared with: 1.3e-6 of `plane`, 3.6e-6 of `matte`, on two cores."""
ALIGNED_VIEW_S = 6.0
"""Seconds to find the pose of each view: with those of pairs 44 to 180 s of processor time for 12 views, 240 s
for 24."""
ALIGNED_PAIR_S = 0.3
"""Seconds for each pair of views."""
LIBRARY_BYTES = 2e8
"""Memory that Open3D takes, which a run does without, in bytes."""
VIEW_BYTES = 62
"""Bytes per pixel of each view: 25 of its range image, 37 of its truth."""
TRIANGLE_BYTES = 500
"""Bytes per triangle at the peak, voxels included: 1.2 GB in all at 1.2 million triangles."""
FILE_BYTES = 10
"""Bytes on disk per pixel of each view, compressed."""
MESH_FILE_BYTES = 19
"""Bytes on disk per triangle of mesh.ply."""
REPORT_BYTES = 1.5e6
"""Bytes on disk of the page."""


def estimate_scan_cost(settings: ScanSettings, scene: Scene, trial: bool = True) -> Cost:
    """Cost of a scan of a scene that is loaded.

    Parameters
    ----------
    trial : whether small passes may be timed where the scan is long.
    """
    rig = settings.instrument.rig(scene, settings.width, settings.height)
    views = len(poses_of(settings.path, Viewpoint(rig.T_world_camera, scene.working_distance_m)))
    experiment = Experiment(
        settings.scene, settings.material, settings.unit_m, settings.width, settings.height,
        instruments=(settings.instrument,), spp=settings.spp, max_depth=settings.max_depth, photons=settings.photons,
        glint=settings.glint, seed=settings.seed, ambient=settings.ambient,
    )  # fmt: skip
    passes = [(rig, [settings.instrument])]
    return estimate_cost(experiment, scene, passes, trial, places=views, rest=_rest(settings, scene, rig, views))


def _rest(settings: ScanSettings, scene: Scene, rig: Rig, views: int) -> Rest:
    """Cost of what is done with the views."""
    pixels = rig.camera.width * rig.camera.height
    finer = 1.0
    if settings.voxel_m is not None:
        finer = min(VOXEL_SPACINGS * scene.working_distance_m / rig.camera.fx / settings.voxel_m, MAX_FINER)
    triangles = TRIANGLES * pixels * finer**2
    seconds = views * pixels * (VIEW_PIXEL_S + FRAME_S * settings.instrument.sensor.n_frames)
    seconds += triangles * len(scene.instances) * TRIANGLE_S
    if settings.registration == "unknown":
        seconds += views * ALIGNED_VIEW_S + views * (views - 1) / 2 * ALIGNED_PAIR_S
    held = LIBRARY_BYTES + views * pixels * VIEW_BYTES
    disk = views * pixels * FILE_BYTES + triangles * MESH_FILE_BYTES + REPORT_BYTES
    return Rest(seconds, int(held), int(held + triangles * TRIANGLE_BYTES), int(disk))
