# SPDX-License-Identifier: Apache-2.0
"""Estimates the cost of a scan before it starts: the cost of its light transport, as for a run, and of the fusion."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rangesim.experiment import Experiment
from rangesim.experiment.camera_paths import Viewpoint
from rangesim.experiment.scan_settings import ScanSettings
from rangesim.pipeline.cost import FRAME_S, Cost, CostBesideTracing, estimate_cost
from rangesim.pipeline.views import poses_of

if TYPE_CHECKING:
    from rangesim.rig import Rig
    from rangesim.scene import Scene

VOXEL_SPACINGS = 1.5
"""Ratio of the default edge of a voxel to the distance between readings. Smaller voxels keep more detail and cost more
memory; larger ones average more readings. Below about 1, a single view leaves holes between its readings."""
MAX_FINER = 10 * VOXEL_SPACINGS
"""Ratio of the default voxel to the smallest one that `fuse` accepts, which is a tenth of the distance between
readings."""
TRIANGLES = 4.0
"""Triangles of the surface at the default voxel per pixel of one view, for any number of overlapping views. Measured:
3.1 to 3.9 on `matte`, `plane` and a part on a table, with 160 to 640 pixels across and 3 to 12 views."""
VIEW_PIXEL_S = 4e-6
"""Seconds per pixel of each view. Measured: 2e-6 for decoding, 1e-6 for fusion, 1e-6 for the file."""
TRIANGLE_S = 3e-6
"""Seconds per triangle, for each shape with which it is compared. Measured on two cores: 1.3e-6 on `plane`, 3.6e-6 on
`matte`."""
ALIGNED_VIEW_S = 6.0
"""Seconds per view to find its pose. Measured together with `ALIGNED_PAIR_S`: 44 to 180 s of processor time in all for
12 views, 240 s for 24."""
ALIGNED_PAIR_S = 0.3
"""Seconds per pair of views to find their poses; see `ALIGNED_VIEW_S` for the times that were measured."""
LIBRARY_BYTES = 2e8
"""Bytes of memory for Open3D, which a scan loads and a run does not. No measurement of it is recorded. A larger value
refuses more scans because of their memory; a smaller one lets scans start that run out of it."""
VIEW_BYTES = 62
"""Bytes of memory per pixel of each view, from the types of the arrays: 25 for the range image, 37 for the truth."""
TRIANGLE_BYTES = 500
"""Bytes of memory per triangle at the peak, voxels included. Measured: 1.2 GB in all at 1.2 million triangles."""
FILE_BYTES = 10
"""Bytes on the disk per pixel of each view, for its compressed range image, which takes 25 in memory. No measurement of
it is recorded. A rough value is enough, because it is only told to the user and refuses no scan."""
MESH_FILE_BYTES = 19
"""Bytes on the disk per triangle of mesh.ply, in binary PLY: 13 for the face, and 6 for half a vertex,
because a mesh has about half as many vertices as triangles."""
REPORT_BYTES = 1.5e6
"""Bytes on the disk of report.html, most of them for its pictures. A rough value is enough, for the reason at
`FILE_BYTES`."""


def estimate_scan_cost(settings: ScanSettings, scene: Scene, trial: bool = True) -> Cost:
    """Estimated cost of a scan of a scene that is already loaded.

    Parameters
    ----------
    trial : whether small passes of the scene may be rendered and timed if the scan is long.
    """
    rig = settings.instrument.rig(scene, settings.width, settings.height)
    views = len(poses_of(settings.path, Viewpoint(rig.T_world_camera, scene.working_distance_m)))
    experiment = Experiment(
        settings.scene, settings.material, settings.unit_m, settings.width, settings.height,
        instruments=(settings.instrument,), spp=settings.spp, max_depth=settings.max_depth, caustics=settings.caustics,
        glint=settings.glint, seed=settings.seed, ambient=settings.ambient,
    )  # fmt: skip
    passes = [(rig, [settings.instrument])]
    beside = _beside_tracing(settings, scene, rig, views)
    return estimate_cost(experiment, scene, passes, trial, places=views, beside=beside)


def _beside_tracing(settings: ScanSettings, scene: Scene, rig: Rig, views: int) -> CostBesideTracing:
    """Cost of the work with the signals of the views: decoding, registration, fusion, comparison, files."""
    pixels = rig.camera.width * rig.camera.height
    finer = 1.0
    if settings.voxel_m is not None:
        finer = min(VOXEL_SPACINGS * scene.working_distance_m * rig.camera.angle_of(1) / settings.voxel_m, MAX_FINER)
    triangles = TRIANGLES * pixels * finer**2
    seconds = views * pixels * (VIEW_PIXEL_S + FRAME_S * settings.instrument.sensor.n_frames)
    seconds += triangles * len(scene.instances) * TRIANGLE_S
    if settings.registration == "unknown":
        seconds += views * ALIGNED_VIEW_S + views * (views - 1) / 2 * ALIGNED_PAIR_S
    held = LIBRARY_BYTES + views * pixels * VIEW_BYTES
    disk = views * pixels * FILE_BYTES + triangles * MESH_FILE_BYTES + REPORT_BYTES
    return CostBesideTracing(seconds, int(held), int(held + triangles * TRIANGLE_BYTES), int(disk))
