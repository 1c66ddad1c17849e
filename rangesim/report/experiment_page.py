# SPDX-License-Identifier: Apache-2.0
"""The report of an experiment's result: one HTML file that needs no other file and no network."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pcgraph.plumbing.plain_files import write_file
from pcgraph.viewer.packing import pack
from rangesim.errors import FileFormatError
from rangesim.report import figures, palette, point_viewer, tables
from rangesim.report.content_security import visible_text
from rangesim.report.objects_section import objects_table, totals
from rangesim.report.template import render_page
from rangesim.report.verdict import verdict
from rangesim.results.experiment_results import Measurement, Result
from rangesim.rig import Beam, Rig
from rangesim.signals import GroundTruth

FEW_PX = 64
"""Width of an image, in pixels, below which its pixels are shown as squares: a sensor of 8 x 8 zones has no image that
could be smoothed. With a larger value the pictures of small trial runs would be squares, too."""
SCRIPTS = (
    "scroll.js",
    "print.js",
    "pcgraph.viewer:three.js",
    "pcgraph.viewer:points.js",
    "sensor_views.js",
    "report.js",
)
"""Files of the page's JavaScript, in the order in which they use each other."""


def write_report(result: Result, path: Path) -> None:
    """Write the report of a result to a file, which appears only when it is complete.

    Raises
    ------
    FileFormatError
        The file cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> from rangesim.report import write_report
    >>> from rangesim.results.experiment_results import load_result
    >>> write_report(load_result("out/demo"), Path("report.html"))  # doctest: +SKIP
    """
    write_file(path, render_report(result).encode(), FileFormatError)


def render_report(result: Result, paper: str = "") -> str:
    """HTML page of the report of a result; `paper` is the size with which it is printed, such as "A4"."""
    return render_page("report.html.j2", context(result), SCRIPTS, paper)


def context(result: Result) -> dict[str, Any]:
    """Values of the variables of the template, by name."""
    measurements = result.measurements
    names = tables.titles(measurements)
    cameras = by_camera(measurements)
    depth, error = palette.color_table("viridis"), palette.color_table("RdBu_r")
    limits = palette.depth_limits(measurements)
    return {
        "scene": result.info.scene,
        "titles": names,
        "references": [m.name for m in measurements if tables.is_reference(m)],
        "settings_line": tables.settings_line(result.experiment, measurements),
        "verdict": verdict(measurements),
        "cameras": [_camera(result, group) for group in cameras],
        "columns": tables.COLUMNS,
        "along_rays": _along_rays(measurements, names),
        "comparison": tables.comparison_table(measurements),
        "outcome_columns": tables.OUTCOMES,
        "outcomes": tables.outcome_table(measurements),
        "objects": objects_table(measurements),
        "object_totals": totals(measurements),
        "noise": tables.noise_table(measurements),
        "tolerance_mm": f"{1e3 * measurements[0].causes.tolerance_m:g}",
        "definitions": tables.definitions(measurements),
        "maps": [_maps(m, limits, depth, error) for m in measurements],
        "depth_bar": {"uri": figures.color_bar(depth), "ticks": palette.depth_ticks(*limits)},
        "error_bar": {"uri": figures.color_bar(error), "ticks": palette.error_ticks()},
        "captures": [_frames(m) for m in measurements],
        "light": [_light(result, number) for number in range(len(result.passes))],
        "costs": tables.cost_table(measurements),
        "transport": _transport(result, names),
        "viewer": _viewer_data(result, cameras, names, error),
        "settings": _flat(result.info.experiment),
        "versions": {**result.info.versions, "Mitsuba variant": result.info.variant},
    }


def by_camera(measurements: Sequence[Measurement]) -> list[list[Measurement]]:
    """Measurements in groups. A group shares the camera and its place, so a pixel is the same ray in the whole group.

    The groups are in the order of their first measurements.
    """
    groups: list[list[Measurement]] = []
    for m in measurements:
        shared = (group for group in groups if _shares_camera(group[0], m))
        group = next(shared, None)
        if group is None:
            groups.append([m])
        else:
            group.append(m)
    return groups


def _along_rays(measurements: Sequence[Measurement], names: dict[str, str]) -> str:
    """Sentence that names the instruments whose readings are ranges; empty if all of them read depths."""
    found = [names[m.name] for m in measurements if not m.camera.is_pinhole]
    if not found:
        return ""
    of_whom = "" if len(found) == len(measurements) else f" of {', '.join(found)}"
    return f" Here, z{of_whom} is the range along the ray."


def _shares_camera(one: Measurement, other: Measurement) -> bool:
    """Whether two instruments look through the same camera from the same place."""
    rig, other_rig = one.capture.reference.rig, other.capture.reference.rig
    assert rig is not None
    assert other_rig is not None
    return rig.camera == other_rig.camera and rig.shares_camera_pose(other_rig)


def _camera(result: Result, group: Sequence[Measurement]) -> dict[str, Any]:
    """Pictures of the scene from the camera that a group of measurements shares."""
    materials, legend = figures.material_picture(group[0].truth, group[0].camera)
    return {
        "names": [m.name for m in group],
        "few": group[0].camera.width < FEW_PX,
        "size": tables.size_text(group[0].truth.z.shape),
        "scene": figures.scene_picture(result.passes[group[0].light_pass - 1].energy, group[0].camera),
        "materials": materials,
        "legend": legend,
    }


def _maps(m: Measurement, limits: tuple[float, float], depth: Any, error: Any) -> dict[str, Any]:
    """Maps of depth, of error and of causes of one instrument, with the legend of the causes."""
    causes, legend = figures.cause_map(m)
    return {
        "name": m.name,
        "few": m.camera.width < FEW_PX,
        "depth_name": "depth z" if m.camera.is_pinhole else "range",
        "letter": "z" if m.camera.is_pinhole else "range",
        "depth": figures.depth_map(m, limits, depth),
        "error": figures.error_map(m, error),
        "causes": causes,
        "legend": legend,
    }


def _frames(m: Measurement) -> dict[str, Any]:
    """Representative frames of one instrument, and how they were taken."""
    f = m.metadata
    taken = f"{f.frames} frame{'s' * (f.frames != 1)}"
    if f.exposure_s is not None:
        taken += f", {tables.exposure(f)}{' each' * (f.frames != 1)}"
    else:
        taken += ", noise-free"
    details = [m.capture.sensor.details]
    if f.photons_per_pulse is not None:
        details.append(tables.photons(f.photons_per_pulse))
    return {
        "name": m.name,
        "few": m.camera.width < FEW_PX,
        "taken": taken,
        "details": " · ".join(details),
        "frames": figures.captured_frames(m.capture),
    }


def _light(result: Result, number: int) -> dict[str, Any]:
    """Pictures of the light of pass `number` (from 0) by the kind of light path, and its emitter."""
    of_pass = [m for m in result.measurements if m.light_pass == number + 1]
    rig = of_pass[0].capture.reference.rig
    assert rig is not None
    return {
        "names": [m.name for m in of_pass],
        "few": rig.camera.width < FEW_PX,
        "emitter": _emitter(rig),
        "power_w": f"{rig.projector_power_w:g}",
        "pictures": figures.light_pictures(result.passes[number].energy, rig.camera),
    }


def _emitter(rig: Rig) -> str:
    """Text that names the emitter and its place."""
    if isinstance(rig.projector, Beam):
        beside = 1e3 * math.hypot(*rig.projector.offset_m)
        wide, high = (1e3 * angle for angle in rig.projector.divergence_rad)
        place = f", {beside:.0f} mm beside it" if beside else ""
        return f"A beam of {wide:.3g} × {high:.3g} mrad along each ray{place}"
    return f"Emitter {1e3 * rig.baseline_m:.0f}\u00a0mm beside the camera"


def _transport(result: Result, names: dict[str, str]) -> list[dict[str, str]]:
    """Per transport pass: its instruments, the number of their frames, and the time that it took."""
    times = result.info.times_s
    return [
        {
            "names": ", ".join(names[m.name] for m in result.measurements if m.light_pass == number),
            "frames": str(sum(m.metadata.frames for m in result.measurements if m.light_pass == number)),
            "time": tables.seconds(times[f"transport_{number}"]),
        }
        for number in range(1, len(result.passes) + 1)
    ]


def _viewer_data(
    result: Result, cameras: Sequence[Sequence[Measurement]], names: dict[str, str], error: Any
) -> dict[str, Any]:
    """Data of the page's script: every instrument, by its camera and its light pass, and the colours of all."""
    camera_of = {m.name: number for number, group in enumerate(cameras) for m in group}
    far = [point_viewer.far_limit(group) for group in cameras]
    return {
        "instruments": [
            point_viewer.packed_measurement(m, visible_text(names[m.name]), camera_of[m.name], far[camera_of[m.name]])
            for m in result.measurements
        ],
        "passes": [_pass_materials(light_pass.truth) for light_pass in result.passes],
        "errorColors": error.ravel().tolist(),
        "errorKneeM": palette.ERROR_KNEE_M,
        "errorLimitM": palette.ERROR_LIMIT_M,
        "errorStepM": point_viewer.ERROR_STEP_M,
        "status": list(palette.STATUS_NAMES.values()),
        "causes": palette.OUTCOME_NAMES,
        "causeColors": palette.OUTCOME_COLORS.ravel().tolist(),
    }


def _pass_materials(truth: GroundTruth) -> dict[str, Any]:
    """Material of each pixel of a light pass, as an index into the names and colours of the materials; -1 for none."""
    return {
        "materials": [visible_text(n) for n in truth.material_names],
        "materialColors": [palette.MATERIAL_COLORS.get(n, palette.NO_DATA) for n in truth.material_names],
        "material": pack(truth.material.astype("int8")),
    }


def _flat(data: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Dotted names of nested settings with their values, in their order."""
    if isinstance(data, dict):
        return [pair for key, value in data.items() for pair in _flat(value, f"{prefix}.{key}" if prefix else key)]
    if isinstance(data, list) and data and isinstance(data[0], dict):
        return [pair for i, value in enumerate(data) for pair in _flat(value, f"{prefix}[{i}]")]
    return [(prefix, "default" if data is None else str(data))]
