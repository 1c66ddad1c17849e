# SPDX-License-Identifier: Apache-2.0
"""Carries out a scan, from the views of a scene to the fused surface and its errors.

`carry_out_scan` computes the result and writes nothing. `run_scan` computes it and writes its directory.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rangesim import __version__
from rangesim.experiment.camera_paths import Viewpoint
from rangesim.experiment.scan_settings import ScanSettings
from rangesim.files.atomic_directories import new_directory
from rangesim.fusion.mesh_error import SurfaceError, distances_to, surface_error
from rangesim.fusion.multiway_registration import align, check_first_pair, pose_errors
from rangesim.fusion.posed_images import Scan
from rangesim.fusion.seen_volume import occupancy
from rangesim.fusion.truncated_average import fuse
from rangesim.fusion.virtual_cameras import local_views
from rangesim.fusion.voxel_grid import VoxelGrid
from rangesim.pipeline.scan_cost import VOXEL_SPACINGS, estimate_scan_cost
from rangesim.pipeline.stages import Progress, timed, unwatched
from rangesim.pipeline.views import poses_of, rendered_views
from rangesim.results.scan_results import SCAN, ScanResult, ShapeStatistics, write_scan
from rangesim.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from rangesim.decoding.range_image import RangeImage
    from rangesim.pipeline.cost import Cost
    from rangesim.scene import Scene

MAX_COMPARED_VOXELS = 1_000_000
"""Largest number of voxels of the grid on which the seen and the true volume are compared. If voxels of the size of the
fusion's would be more than that, the voxels of this grid are larger. Time and memory of the comparison grow with this
number; a smaller number makes the comparison coarser."""
BACKGROUND = 0.3
"""Ratio of the size of a shape to that of the largest shape. Above it the shape is background, such as a table or a
wall. The statistics of what the views saw leave background out, as long as there are other shapes. A larger ratio would
count tables as things, a smaller one would leave out large things."""
SAMPLES = 20_000
"""Number of points sampled on each surface to measure its error. The standard error of a fraction of them, such as the
recall, is then at most 0.5 / sqrt(20 000) = 0.35 %."""
REGISTRATION_SEEDS = 0x7FFFFFFF
"""Bit mask that makes a seed of the registration from the seed of a scan, because Open3D takes seeds of 31 bits."""


def run_scan(
    settings: ScanSettings,
    out: str | Path,
    progress: Progress | None = None,
    scene: Scene | None = None,
    announce: Callable[[Cost], None] | None = None,
) -> ScanResult:
    """Carry out a scan and write its results, with `report.html`, to the directory `out`.

    The files appear when all of them are complete, and a failure leaves nothing behind. See
    `rangesim.files.atomic_directories`.

    Parameters
    ----------
    settings, progress, scene, announce : as for `carry_out_scan`.
    out : directory of the results.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        As `carry_out_scan`, or `out` cannot take a result (see `rangesim.files.atomic_directories.check_directory`).

    Examples
    --------
    >>> from rangesim.experiment import ScanSettings, Turntable
    >>> settings = ScanSettings("tabletop", path=Turntable(views=12), width=320)
    >>> result = run_scan(settings, "out/scan")  # doctest: +SKIP
    """
    from rangesim.report.scan_page import render_scan_page

    with new_directory(out, SCAN, inputs=[settings.scene]) as folder:
        result = carry_out_scan(settings, progress, scene, announce)
        tell = progress or unwatched
        tell("Writing the results", 0.93)
        write_scan(result, folder, {"report.html": render_scan_page(result).encode()})
    return result


def estimate_scan(settings: ScanSettings) -> Cost:
    """Estimated cost of `run_scan` in light paths, memory, time and space on the disk.

    The scene is loaded. If the scan may take long, small images of it are rendered to measure the time.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        As `carry_out_scan`, except that too little memory raises nothing; `Cost.check_memory` does.
    """
    from rangesim.scene import load_scene

    scene = load_scene(settings.scene, material=settings.material, unit_m=settings.unit_m)
    return estimate_scan_cost(settings, scene)


def carry_out_scan(
    settings: ScanSettings,
    progress: Progress | None = None,
    scene: Scene | None = None,
    announce: Callable[[Cost], None] | None = None,
) -> ScanResult:
    """The result of a scan. Nothing is written.

    Parameters
    ----------
    progress : function that is called with the name of the stage and the fraction done, 0..1.
    scene : a scene that is already loaded. `settings.scene` is then only its name.
    announce : function that is called with the estimated cost before the work starts.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        A setting is out of its range, the memory does not suffice, the scene cannot be loaded, poses cannot be found,
        or the readings make no surface.
    """
    import mitsuba as mi

    from rangesim.scene import load_scene
    from rangesim.scene.triangles import true_surfaces

    tell, times = progress or unwatched, dict[str, float]()
    tell("Loading the scene", 0.0)
    with timed(times, "load"):
        scene = scene or load_scene(settings.scene, material=settings.material, unit_m=settings.unit_m)
        if settings.ambient is not None:
            settings.ambient.check_emitters(scene.has_ambient)
        rig = settings.instrument.rig(scene, settings.width, settings.height)
        surfaces = true_surfaces(scene)
    cost = estimate_scan_cost(settings, scene, trial=announce is not None)
    cost.check_memory()
    if announce is not None:
        announce(cost)
    poses = poses_of(settings.path, Viewpoint(rig.T_world_camera, scene.working_distance_m))
    registration_seed = settings.seed & REGISTRATION_SEEDS
    with timed(times, "views"):
        images, truths = [], []
        for number, (image, truth) in enumerate(
            rendered_views(
                scene, rig, settings.instrument, poses, settings.transport_settings(), settings.ambient, settings.seed
            ),
            1,
        ):
            images.append(image)
            truths.append(truth)
            tell(f"View {number} of {len(poses)}", 0.05 + 0.6 * number / len(poses))
            if number == 2 < len(poses) and settings.registration == "unknown":  # fail early
                _check_readings(images)
                check_first_pair(Scan(tuple(images)), seed=registration_seed)
    _check_readings(images)
    views, found = Scan(tuple(images), tuple(truths), poses), None
    if settings.registration == "unknown":
        tell("Finding poses", 0.66)
        with timed(times, "registration"):
            first = np.stack([poses[0]] * len(poses))
            views = align(views.with_poses(first), seed=registration_seed).scan
        found = pose_errors(views.poses, poses)
    tell("Fusing", 0.8)
    with timed(times, "fusion"):
        fused = fuse(
            views.images, settings.voxel_m or _voxel_m(views), truncation_m=settings.truncation_m,
            weights=settings.weights, min_weight=settings.min_weight,
        )  # fmt: skip
    tell("Comparing with the truth", 0.85)
    with timed(times, "comparison"):
        errors = errors_by_shape(fused.mesh, surfaces, fused.voxel_m)
        things = _things(surfaces)
        around = np.concatenate([surfaces[name].vertices for name in things])
        extent = np.ptp(around, axis=0) + 4 * fused.voxel_m
        coarse = max(fused.voxel_m, float(np.cbrt(extent.prod() / MAX_COMPARED_VOXELS)))
        grid = VoxelGrid.around(around, coarse, 2 * fused.voxel_m)
        seen = occupancy(views.images, {n: surfaces[n] for n in things}, grid)
    materials = {i.name: i.material for i in scene.instances}
    shapes = {n: ShapeStatistics.of(materials[n], errors[n], seen.shapes.get(n)) for n in surfaces}
    versions = {"python": platform.python_version(), "rangesim": __version__}
    return ScanResult(settings, views, fused, surfaces, shapes, things, seen, found, versions, mi.variant(), times)


def errors_by_shape(
    mesh: TriangleMesh, surfaces: Mapping[str, TriangleMesh], threshold_m: float
) -> dict[str, SurfaceError | None]:
    """Errors of a mesh by the shape that each of its triangles is nearest to; None for a shape without triangles.

    Parameters
    ----------
    mesh : the fused surface. surfaces : true surface of each shape by name.
    threshold_m : distance up to which a point counts for precision and recall, metres.
    """
    middles = mesh.corners.mean(axis=1)
    nearest = np.stack([distances_to(middles, surface) for surface in surfaces.values()]).argmin(axis=0)
    result: dict[str, SurfaceError | None] = {}
    for number, (name, surface) in enumerate(surfaces.items()):
        of_shape = TriangleMesh(mesh.vertices, mesh.faces[nearest == number])
        has_area = len(of_shape.faces) and of_shape.area_m2 > 0 and surface.area_m2 > 0
        result[name] = surface_error(of_shape, surface, threshold_m, samples=SAMPLES) if has_area else None
    return result


def _voxel_m(views: Scan) -> float:
    """Default edge of a voxel in metres, from the median distance between neighbouring readings of the views."""
    seen = [view for image in views.images for view in local_views(image) if view.valid.any()]
    spacings = [float(np.median(view.z[view.valid])) / view.pinhole.fx for view in seen]
    return float(f"{VOXEL_SPACINGS * np.median(spacings):.2g}")


def _check_readings(images: Sequence[RangeImage]) -> None:
    """Raise ValueError if no view has a reading."""
    if not any(image.valid.any() for image in images):
        raise ValueError(
            f"expected readings in some of {len(images)} views, got none. Perhaps the path looks past the scene, its "
            "poses are not T_world_camera in metres, or the scene is not in metres (a mesh in millimetres needs "
            "unit_m = 0.001)."
        )


def _things(surfaces: Mapping[str, TriangleMesh]) -> tuple[str, ...]:
    """Names of the shapes that are not background by their size; all shapes if all are background."""
    sizes = {name: float(np.linalg.norm(np.ptp(m.vertices, axis=0))) for name, m in surfaces.items()}
    largest = max(sizes.values())
    return tuple(n for n, size in sizes.items() if size <= BACKGROUND * largest) or tuple(surfaces)
