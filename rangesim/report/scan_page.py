# SPDX-License-Identifier: Apache-2.0
"""The HTML page of a fused scan: its mesh, the errors of the mesh, and the parts of the scene that the views saw."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rangesim.fusion.mesh_error import distances_to, nearest_on
from rangesim.fusion.seen_volume import VoxelState, is_measured
from rangesim.report import figures, palette
from rangesim.report.mesh_pictures import mesh_picture
from rangesim.report.template import render_page
from rangesim.rig import Intrinsics
from rangesim.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from rangesim.results.scan_results import ScanResult
    from rangesim.rig import Camera

PICTURES = 3
"""Count of views, spread over the path, from which pictures of the mesh are taken: that many pictures stand side by
side."""
WIDTH_PX = 480
"""Width of the pictures in pixels; larger ones make a larger page, smaller ones show less of the mesh's detail."""
SAMPLES = 20_000
"""Number of points on the mesh. The first sentence of the page summarises their distances from the true surface.

The standard error of a fraction of these points is below 0.4 %.
"""
NOTHING_SEEN = "does the path look at them, and are its poses T_world_camera in metres?"
"""Question that the page and the command line ask the user if no view measured anything."""
SEEN = (94, 147, 190)
"""Colour of surfaces that some view measured, RGB 0..255."""
UNSEEN = (222, 122, 60)
"""Colour of surfaces that no view measured, RGB 0..255."""
STATE_COLORS = {VoxelState.NEVER_SEEN: (90, 90, 96), VoxelState.FREE: (240, 240, 236), VoxelState.SURFACE: SEEN}
"""Colour of each state of a voxel, RGB 0..255."""
STATE_NAMES = {
    VoxelState.SURFACE: "a surface was measured",
    VoxelState.FREE: "seen to be free",
    VoxelState.NEVER_SEEN: "never seen",
}
"""Text of each state of a voxel."""
SOLID = (196, 160, 96)
"""Colour of voxels inside a shape, RGB 0..255."""


def render_scan_page(result: ScanResult, paper: str = "") -> str:
    """HTML page of a scan; `paper` is the size with which it is printed, such as "A4"."""
    return render_page("scan.html.j2", context(result), paper=paper)


def context(result: ScanResult) -> dict[str, Any]:
    """Values of the variables of the template, by name."""
    error = palette.color_table("RdBu_r")
    truth = TriangleMesh.joined(list(result.surfaces.values()))
    camera = _picture_camera(result.scan.images[0].camera)
    number = len(result.scan)
    places = _places(result)
    fused = result.fused
    return {
        "scene": result.settings.scene,
        "line": _line(result),
        "verdict": _verdict(result),
        "rows": [_row(result, places, camera, truth, error, which) for which in ("shaded", "error", "seen")],
        "error_bar": {"uri": figures.color_bar(error), "ticks": palette.error_ticks()},
        "slices": _slices(result),
        "states": [(STATE_NAMES[s], palette.hexadecimal(np.array(STATE_COLORS[s]))) for s in STATE_NAMES]
        + [("solid", palette.hexadecimal(np.array(SOLID)))],
        "shapes": [_shape_cells(result, name) for name in result.shapes],
        "views": [_view_cells(result, k) for k in range(number)],
        "poses_found": result.poses is not None,
        "truncation_mm": f"{1e3 * fused.truncation_m:.3g}",
        "min_weight": f"{fused.min_weight:.2g}",
        "voxel_mm": f"{1e3 * fused.voxel_m:.3g}",
        "grid_mm": f"{1e3 * result.seen.grid.voxel_m:.3g}",
        "open_shapes": _open_shapes(result),
        "fractions": [(STATE_NAMES[s], _percent(result.seen.fraction(s))) for s in STATE_NAMES],
        "times": [(name, f"{seconds:.1f} s") for name, seconds in result.times_s.items()],
        "seen_color": palette.hexadecimal(np.array(SEEN)),
        "unseen_color": palette.hexadecimal(np.array(UNSEEN)),
    }


def _picture_camera(camera: Camera | None) -> Intrinsics:
    """Camera of the pictures: that of the views, or one of 90 degrees if that is no pinhole."""
    if not isinstance(camera, Intrinsics):
        camera = Intrinsics.from_fov(4, 3, 90.0)
    return camera.resized(WIDTH_PX, max(1, round(WIDTH_PX * camera.height / camera.width)))


def _places(result: ScanResult) -> list[int]:
    """Indices of up to `PICTURES` views, spread over the path, that have at least half as many readings as the best."""
    readings = np.array([image.valid.sum() for image in result.scan.images])
    good = np.nonzero(readings >= 0.5 * readings.max())[0]
    return sorted({int(good[round(k * len(good) / PICTURES) % len(good)]) for k in range(PICTURES)})


def _line(result: ScanResult) -> str:
    """The settings of the scan in one line."""
    height, width = result.scan.images[0].z.shape
    s, fused = result.settings, result.fused
    is_automatic = s.instrument.exposure_s is None and s.instrument.detector_in_use is not None
    exposure = ", exposure automatic in each view" if is_automatic and not s.instrument.sensor.is_ideal else ""
    known = "poses known" if s.registration == "known" else "poses found from the readings"
    return (
        f"{len(result.scan)} views of {width} × {height} pixels, {s.path.type_name} · "
        f"{s.instrument.sensor.title}{exposure} · {known} · voxels of {1e3 * fused.voxel_m:.3g} mm, truncation "
        f"{1e3 * fused.truncation_m:.3g} mm, weights by {s.weights}"
    )


def _verdict(result: ScanResult) -> list[str]:
    """Sentences at the top of the page: how accurate and how complete the mesh is, and what was not seen."""
    off = _distances_of_things(result)
    of = "" if len(result.things) == len(result.surfaces) else ", background left out,"
    said = [f"No view measured any of {_count(len(result.things), 'thing')}: {NOTHING_SEEN}"]
    if len(off):
        within = float((off <= result.fused.voxel_m).mean())
        said = [
            f"Half of the fused surface{of} lies within {1e3 * float(np.median(off)):.2g} mm of the true one, "
            f"{_percent(within)} within a voxel."
        ]
    areas = {n: s.area_m2 for n, s in result.seen.shapes.items()}
    seen = sum(areas[n] * s.surface for n, s in result.seen.shapes.items()) / sum(areas.values())
    said.append(f"The views measured {_percent(seen)} of the true surface of {_count(len(areas), 'thing')}.")
    lost = [n for n, s in result.seen.shapes.items() if s.volume_m3 > 0 and s.volume_free > 0.5]
    if lost:
        said.append(f"Taken for empty space by more than half: {', '.join(lost)}.")
    blind = [str(k + 1) for k, image in enumerate(result.scan.images) if not image.valid.any()]
    if blind:
        said.append(f"No reading in view {', '.join(blind)}: something stands before the camera, or nothing does.")
    if result.poses is not None:
        said.append(
            f"Poses were found from the readings alone, to {result.poses.angle_deg.max():.2g}° and "
            f"{1e3 * result.poses.centre_m.max():.2g} mm at worst."
        )
    return said


def _distances_of_things(result: ScanResult) -> np.ndarray:
    """(n,) float64 distances, in metres, of samples of the mesh from the true surfaces.

    Samples whose nearest surface is background are left out.
    """
    points = result.fused.mesh.sample(SAMPLES)[0]
    off = np.stack([distances_to(points, surface) for surface in result.surfaces.values()])
    is_thing = np.array([name in result.things for name in result.surfaces])
    return np.asarray(off.min(axis=0)[is_thing[off.argmin(axis=0)]])


def _row(
    result: ScanResult, places: list[int], camera: Intrinsics, truth: TriangleMesh, error: np.ndarray, which: str
) -> list[dict[str, str]]:
    """Pictures of a mesh from some views.

    Parameters
    ----------
    places : indices of the views.
    camera : Intrinsics of the pictures.
    truth : all true surfaces together.
    error : (256, 3) uint8, colours of the error scale.
    which : "shaded" or "error", pictures of the fused mesh; or "seen", pictures of the true surface.
    """
    mesh = truth if which == "seen" else result.fused.mesh
    colors = None

    def by_error(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
        place = palette.error_fraction(_signed_error(points, truth, mesh.face_normals[faces]))
        return np.asarray(error[np.rint(255 * place).astype(int)], dtype=np.float64)

    def by_seen(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
        tolerance_m, normals = result.seen.tolerance_m, truth.face_normals[faces]
        seen = is_measured(result.scan.images, points, normals, tolerance_m, one_sided=False)
        return np.where(seen[:, None], SEEN, UNSEEN)

    colors = {"shaded": None, "error": by_error, "seen": by_seen}[which]
    pictures = []
    for k in places:
        uri = figures.png(mesh_picture(mesh, camera, result.scan.poses[k], colors))
        pictures.append({"uri": uri, "alt": f"{which}, view {k + 1}", "note": f"from view {k + 1}"})
    return pictures


def _signed_error(points: np.ndarray, truth: TriangleMesh, normals: np.ndarray) -> np.ndarray:
    """(n,) float64 distances, in metres, of points of the mesh from the true surface.

    They are positive outside of the true surface, by the normals (n, 3) of the mesh.
    """
    off = points - nearest_on(points, truth)
    length = np.linalg.norm(off, axis=-1)
    return np.where((off * np.nan_to_num(normals)).sum(axis=-1) >= 0, length, -length)


def _slices(result: ScanResult) -> list[dict[str, str]]:
    """Pictures of a level and an upright slice through the middle of the things: true solids, and states of voxels."""
    states, truth = result.seen.states, result.seen.truth
    solid = truth >= 0
    if solid.any():
        # Half of the solid lies on either side of the slice. The fullest slice is often the one that touches the table.
        filled_to = [np.cumsum(solid.sum(axis=tuple(j for j in range(3) if j != axis))) for axis in (2, 1)]
        middle = [int(np.searchsorted(c, c[-1] / 2)) for c in filled_to]
    else:
        middle = [states.shape[2] // 2, states.shape[1] // 2]
    made = []
    for name, axis, place in (("level", 2, middle[0]), ("upright", 1, middle[1])):
        filled, known_states = (np.asarray(volume.take(place, axis)) for volume in (solid, states))
        there = np.where(filled.T[::-1, :, None], SOLID, (240, 240, 236)).astype(np.uint8)
        table = np.array([STATE_COLORS[VoxelState(k)] for k in range(3)], np.uint8)
        known = table[known_states.T[::-1]]
        for title, picture in ((f"what is there, {name} slice", there), (f"what the views know, {name} slice", known)):
            larger = max(1, round(WIDTH_PX / picture.shape[1]))
            picture = picture.repeat(larger, axis=0).repeat(larger, axis=1)
            made.append({"uri": figures.png(picture), "alt": title, "note": title})
    return made


def _open_shapes(result: ScanResult) -> list[str]:
    """Names of the things whose surface encloses no voxel, because the surface is not closed or the thing is thin."""
    return [name for name, seen in result.seen.shapes.items() if np.isnan(seen.volume_surface)]


def _shape_cells(result: ScanResult, name: str) -> list[str]:
    """Row of the table of shapes, as text."""
    shape = result.shapes[name]
    cells = [name, shape.material]
    cells += [_number(v, 1e3, 3) for v in (shape.accuracy_m, shape.accuracy_rms_m, shape.accuracy_p95_m)]
    cells += [_number(shape.chamfer_m, 1e3, 2), _number(shape.f_score, 1, 3)]
    seen = result.seen.shapes.get(name)
    if seen is None:
        return [*cells, *["background"] * 4] if name not in result.things else [*cells, *["-"] * 4]
    return [*cells, *(_percent(v) for v in (seen.surface, seen.volume_surface, seen.volume_never, seen.volume_free))]


def _view_cells(result: ScanResult, number: int) -> list[str]:
    """Row of the table of views, as text; `number` counts from 0."""
    image = result.scan.images[number]
    cells = [str(number + 1), str(int(image.valid.sum())), _percent(float(image.valid.mean()))]
    if result.poses is not None:
        cells += [f"{result.poses.angle_deg[number]:.4f}", f"{1e3 * result.poses.centre_m[number]:.3f}"]
    return cells


def _number(value: float | None, factor: float, digits: int) -> str:
    """Text of a value times a factor; a dash for None."""
    return "-" if value is None else f"{factor * value:.{digits}f}"


def _count(n: int, what: str) -> str:
    """Number with a noun in singular or plural."""
    return f"{n} {what}{'s' * (n != 1)}"


def _percent(value: float) -> str:
    """Text of a fraction in percent; a dash for NaN."""
    return "-" if np.isnan(value) else f"{100 * value:.1f} %"
