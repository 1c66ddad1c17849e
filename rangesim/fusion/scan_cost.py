# SPDX-License-Identifier: Apache-2.0
"""What a scan will cost: the light transport as of a run, and what becomes of its views, before the work starts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rangesim.experiment import Experiment
from rangesim.experiment.cost import FRAME_S, Cost, Rest, estimate_cost
from rangesim.fusion.paths import Viewpoint
from rangesim.fusion.scan_settings import ScanSettings
from rangesim.fusion.views import poses_of

if TYPE_CHECKING:
    from rangesim.rig import Rig
    from rangesim.scene import Scene

VOXEL_SPACINGS = 1.5
"""Voxel over the distance between readings, if none is given."""
MAX_FINER = 10 * VOXEL_SPACINGS
"""That voxel over the least one that `fuse` accepts: a tenth of the distance between readings."""
TRIANGLES = 4.0
"""Of the surface at that voxel, per pixel of one view, however many views overlap: 3.1 to 3.9 of `matte`, `plane` and a
part on a table, 160 to 640 pixels wide, 3 to 12 views."""
VIEW_PIXEL_S = 4e-6
"""Seconds per pixel of each view: decoding 2e-6, fusion 1e-6, the file 1e-6."""
TRIANGLE_S = 3e-6
"""Seconds per triangle and shape that it is compared with: 1.3e-6 of `plane`, 3.6e-6 of `matte`, on two cores."""
ALIGNED_VIEW_S, ALIGNED_PAIR_S = 6.0, 0.3
"""Seconds to find the pose of a view, and of each pair of views: 44 to 180 s of processor time of twelve, 240 of 24."""
LIBRARY_BYTES = 2e8
"""Of Open3D, which a run does without."""
VIEW_BYTES = 62
"""Per pixel of each view: its range image 25, its truth 37."""
TRIANGLE_BYTES = 500
"""Per triangle at the peak, voxels included: 1.2 GB in all at 1.2 million triangles."""
FILE_BYTES, MESH_FILE_BYTES, REPORT_BYTES = 10, 19, 1.5e6
"""On disk: per pixel of each view, compressed; per triangle of mesh.ply; the page."""


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
    """What becomes of the views."""
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
