# SPDX-License-Identifier: Apache-2.0
"""A whole scan: scene -> views -> poses -> surface -> errors, what was seen, report; and its directory of results."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rangesim import __version__
from rangesim.experiment.camera_paths import Viewpoint
from rangesim.experiment.scan_settings import ScanSettings
from rangesim.files.result_directories import new_directory
from rangesim.fusion.mesh_error import SurfaceError, distances_to, surface_error
from rangesim.fusion.multiway_registration import align, check_first_pair, pose_errors
from rangesim.fusion.scan import Scan
from rangesim.fusion.seen_volume import occupancy
from rangesim.fusion.truncated_average import fuse
from rangesim.fusion.voxel_grid import VoxelGrid
from rangesim.pipeline.scan_cost import VOXEL_SPACINGS, estimate_scan_cost
from rangesim.pipeline.views import poses_of, taken
from rangesim.results.scan_files import SCAN, ScanResult, ShapeStatistics, write_scan
from rangesim.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from rangesim.decoding.range_image import RangeImage
    from rangesim.pipeline.cost import Cost
    from rangesim.scene import Scene

Progress = Callable[[str, float], None]
"""Called with the name of the stage and the fraction of the whole job done, 0..1."""
MAX_COMPARED_VOXELS = 1_000_000
"""Of the grid on which seen and true volume are compared."""
BACKGROUND = 0.3
"""Shapes with a larger fraction of the scene's extent are background (a table, a wall), as long as there are others."""
SAMPLES = 20_000


def run_scan(
    settings: ScanSettings,
    out: str | Path,
    progress: Progress | None = None,
    scene: Scene | None = None,
    announce: Callable[[Cost], None] | None = None,
) -> ScanResult:
    """Carry out a scan and write its results, with `report.html`, to the directory `out`.

    The files appear when all is done; a failure leaves nothing behind. See `rangesim.files.result_directories`.

    Parameters
    ----------
    scene : a scene that is loaded already; `settings.scene` then only names it.
    announce : called with the estimated cost before the work starts.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        A setting out of range, more memory than there is, a scene that cannot be loaded, poses that cannot be found, no
        surface, or an `out` that cannot take a result (see `rangesim.files.result_directories.check_directory`).
    """
    from rangesim.report.scan_page import render_scan_page

    with new_directory(out, SCAN, inputs=[settings.scene]) as folder:
        result = carry_out_scan(settings, progress, scene, announce)
        tell = progress or _unwatched
        tell("Writing the results", 0.93)
        write_scan(result, folder, {"report.html": render_scan_page(result).encode()})
    return result


def estimate_scan(settings: ScanSettings) -> Cost:
    """Cost of `run_scan`; the scene is loaded, and rendered small if it may take long. Errors as `run_scan`."""
    from rangesim.scene import load_scene

    scene = load_scene(settings.scene, material=settings.material, unit_m=settings.unit_m)
    return estimate_scan_cost(settings, scene)


def carry_out_scan(
    settings: ScanSettings,
    progress: Progress | None = None,
    scene: Scene | None = None,
    announce: Callable[[Cost], None] | None = None,
) -> ScanResult:
    """The result of a scan; nothing is written. Errors as `run_scan`."""
    import mitsuba as mi

    from rangesim.scene import load_scene
    from rangesim.scene.triangles import true_surfaces

    tell, times = progress or _unwatched, dict[str, float]()
    tell("Loading the scene", 0.0)
    with _timed(times, "load"):
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
    registration_seed = settings.seed & 0x7FFFFFFF
    with _timed(times, "views"):
        images, truths = [], []
        for number, (image, truth) in enumerate(
            taken(
                scene, rig, settings.instrument, poses, settings.transport_settings(), settings.ambient, settings.seed
            ),
            1,
        ):
            images.append(image)
            truths.append(truth)
            tell(f"View {number} of {len(poses)}", 0.05 + 0.6 * number / len(poses))
            if number == 2 < len(poses) and settings.registration == "unknown":  # before the others take their time
                _check_readings(images)
                check_first_pair(Scan(tuple(images)), seed=registration_seed)
    _check_readings(images)
    views, found = Scan(tuple(images), tuple(truths), poses), None
    if settings.registration == "unknown":
        tell("Finding poses", 0.66)
        with _timed(times, "registration"):
            first = np.stack([poses[0]] * len(poses))
            views = align(views.with_poses(first), seed=registration_seed).scan
        found = pose_errors(views.poses, poses)
    tell("Fusing", 0.8)
    with _timed(times, "fusion"):
        fused = fuse(
            views.images, settings.voxel_m or _voxel_m(views), truncation_m=settings.truncation_m,
            weights=settings.weights, min_weight=settings.min_weight,
        )  # fmt: skip
    tell("Comparing with the truth", 0.85)
    with _timed(times, "comparison"):
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
    """Errors of the part of a mesh that is nearest to each shape; None for shapes that no part is nearest to."""
    middles = mesh.corners.mean(axis=1)
    nearest = np.stack([distances_to(middles, surface) for surface in surfaces.values()]).argmin(axis=0)
    result: dict[str, SurfaceError | None] = {}
    for number, (name, surface) in enumerate(surfaces.items()):
        of_shape = TriangleMesh(mesh.vertices, mesh.faces[nearest == number])
        has_area = len(of_shape.faces) and of_shape.area_m2 > 0 and surface.area_m2 > 0
        result[name] = surface_error(of_shape, surface, threshold_m, samples=SAMPLES) if has_area else None
    return result


def _voxel_m(views: Scan) -> float:
    spacings = [
        float(np.median(i.z[i.valid])) / i.camera.fx for i in views.images if i.camera is not None and i.valid.any()
    ]
    return float(f"{VOXEL_SPACINGS * np.median(spacings):.2g}")


def _check_readings(images: Sequence[RangeImage]) -> None:
    if not any(image.valid.any() for image in images):
        raise ValueError(
            f"expected readings in some of {len(images)} views, got none: the path may look past the scene, its poses "
            "not be T_world_camera in metres, or the scene not be in metres (a mesh in millimetres needs unit_m = "
            "0.001)."
        )


def _things(surfaces: Mapping[str, TriangleMesh]) -> tuple[str, ...]:
    """Shapes that are no background, by their size; all if there are no others."""
    sizes = {name: float(np.linalg.norm(np.ptp(m.vertices, axis=0))) for name, m in surfaces.items()}
    largest = max(sizes.values())
    return tuple(n for n, size in sizes.items() if size <= BACKGROUND * largest) or tuple(surfaces)


def _unwatched(stage: str, fraction: float) -> None:
    """Tell nobody how far the work is."""


@contextmanager
def _timed(times: dict[str, float], stage: str) -> Iterator[None]:
    start = time.monotonic()
    yield
    times[stage] = time.monotonic() - start
