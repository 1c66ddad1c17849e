# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim scan`, which takes many views of a scene and fuses them to one surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rangesim.cli.progress import announce_cost, announce_linked_output, one_truncation_warning, progress_bar
from rangesim.errors import one_line

if TYPE_CHECKING:
    from rangesim.experiment.camera_paths import CameraPath
    from rangesim.experiment.scan_settings import ScanSettings
    from rangesim.results.scan_results import ScanResult

PATHS = ("turntable", "dome", "hand-held")
"""Names of the camera paths that need no file of poses."""


def scan_command(
    scene: Annotated[
        Path | None,
        typer.Argument(
            help="Scene (.xml), mesh, or name of a scene that rangesim contains, as for `rangesim run`.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Directory for the results; an older scan is replaced. (required)"),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Settings of the scan (.toml); other options override them.")
    ] = None,
    path: Annotated[
        str | None,
        typer.Option(
            help=f"Camera path: {', '.join(PATHS)}, or a .json file with poses T_world_camera (n, 4, 4). "
            "(default: turntable)"
        ),
    ] = None,
    views: Annotated[
        int | None, typer.Option(help="Number of views. (default: 12 for turntable, 24 for dome and hand-held)")
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option("--sensor", "-s", help="One sensor, named as for `rangesim run`. (default: gray-phase)"),
    ] = None,
    voxel: Annotated[
        float | None,
        typer.Option(help="Edge of a voxel in metres. (default: 1.5 times the distance between readings)"),
    ] = None,
    unknown_poses: Annotated[
        bool, typer.Option("--unknown-poses", help="Find the poses from the readings and ignore those of the path.")
    ] = False,
    uniform: Annotated[
        bool, typer.Option("--uniform", help="Give all readings the same weight. (default: by their confidence)")
    ] = False,
    spp: Annotated[
        int | None, typer.Option(help="Light paths per pixel. (default: 8, and up to 64 where readings need more)")
    ] = None,
    width: Annotated[int | None, typer.Option(help="Camera width, pixels. (default: the scene's)")] = None,
    height: Annotated[int | None, typer.Option(help="Camera height, pixels. (default: the scene's)")] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the random numbers. The same seed gives the same bytes. (default: 0)")
    ] = None,
    material: Annotated[
        str | None,
        typer.Option(help="Material of a bare mesh: matte, glossy, mirror or transparent. (default: matte)"),
    ] = None,
    unit_m: Annotated[
        float | None,
        typer.Option(help="Metres per unit of a bare mesh: 0.001 if it is in millimetres. (default: 1)"),
    ] = None,
    estimate: Annotated[
        bool, typer.Option("--estimate", help="Print the estimated cost of the scan and end. Nothing is written.")
    ] = False,
) -> None:
    """Scan a scene from many sides, fuse the views, and write mesh.ply, poses, range images and report.html.

    Examples:

      rangesim scan part.ply --unit-m 0.001 --views 24 --voxel 0.0005 --out out/part

      rangesim scan tabletop --path dome --width 320 --out out/dome

      rangesim scan --config scan.toml --unknown-poses --out out/unknown
    """
    if out is None and not estimate:
        raise typer.BadParameter("expected --out DIRECTORY, unless --estimate is given.", param_hint="--out")
    from rangesim.files.atomic_directories import check_directory
    from rangesim.pipeline.scan_run import estimate_scan, run_scan
    from rangesim.results.scan_results import SCAN

    given: dict[str, Any] = {"spp": spp, "width": width, "height": height, "seed": seed, "voxel_m": voxel}
    given |= {"material": material, "unit_m": unit_m}
    if sensor and len(sensor) > 1:
        raise ValueError(f"expected one --sensor, got {', '.join(sensor)}; run one scan for each.")
    settings = _settings(
        scene, config, {k: v for k, v in given.items() if v is not None}, sensor[0] if sensor else None
    )
    if path is not None or views is not None:
        settings = replace(settings, path=_path(settings.path, path, views))
    if unknown_poses:
        settings = replace(settings, registration="unknown")
    if uniform:
        settings = replace(settings, weights="uniform")
    if estimate or out is None:
        cost = estimate_scan(settings)
        typer.echo(cost)
        cost.check_memory()
        return
    target = check_directory(out, SCAN, inputs=[settings.scene])
    announce_linked_output(out, target)
    with one_truncation_warning(), progress_bar() as progress:
        result = run_scan(settings, out, progress, announce=announce_cost)
    typer.echo(_table(result))
    typer.echo(one_line(out / "report.html"))


def _settings(scene: Path | None, config: Path | None, given: dict[str, Any], sensor: str | None) -> ScanSettings:
    """The scan of a file of settings or of a scene. Options of the command line replace the settings of the file."""
    from rangesim.experiment.scan_settings import ScanSettings, load_scan_settings
    from rangesim.presets import instrument

    if config is None and scene is None:
        raise typer.BadParameter("expected a scene or --config FILE.", param_hint="SCENE")
    if sensor is not None:
        given["instrument"] = instrument(sensor)
    if config is None:
        return ScanSettings(scene=str(scene), **given)
    if scene is not None:
        given["scene"] = str(scene)
    return replace(load_scan_settings(config), **given)


def _path(before: CameraPath, name: str | None, views: int | None) -> CameraPath:
    """The camera path that the options ask for.

    before : the path of the settings. name : name of a path, or a .json file of poses; None: the path of the settings.
    views : number of views; None: as the path says.
    """
    from rangesim.experiment.camera_paths import CameraPath, PoseList
    from rangesim.files.text_files import read_json
    from rangesim.settings.config import nearest, shown

    if name is not None and name.endswith(".json"):
        if views is not None:
            raise ValueError("expected no --views with a list of poses, which has its own number of views.")
        data = read_json(Path(name))
        if isinstance(data, dict) and "T_world_camera" not in data:
            raise ValueError(f"{name}: expected a list of poses, or the key 'T_world_camera', got {shown(list(data))}.")
        try:
            return PoseList(data["T_world_camera"] if isinstance(data, dict) else data)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    if name is not None and name not in PATHS:
        raise ValueError(
            f"expected --path to be one of {', '.join(PATHS)} or a .json file, got {name!r}{nearest(name, PATHS)}."
        )
    chosen = before if name in (None, before.type_name) else CameraPath.known[name]()
    if views is None:
        return chosen
    if isinstance(chosen, PoseList):
        raise ValueError("expected no --views with a list of poses, which has its own number of views.")
    return replace(chosen, views=views)  # type: ignore[type-var]


def _table(result: ScanResult) -> str:
    """Text table with the errors of each shape, and a line with the errors of the poses that were found."""
    lines = [f"{'shape':20s}{'material':14s}{'accuracy':>10s}{'complete':>10s}{'seen':>8s}"]
    for name in result.things:
        shape = result.shapes[name]
        accuracy = "-" if shape.accuracy_m is None else f"{1e3 * shape.accuracy_m:.3f} mm"
        recall = "-" if shape.recall is None else f"{shape.recall:.1%}"
        seen = f"{result.seen.shapes[name].surface:.1%}"
        lines.append(f"{one_line(name)[:19]:20s}{one_line(shape.material):14s}{accuracy:>10s}{recall:>10s}{seen:>8s}")
    if all(result.shapes[name].accuracy_m is None for name in result.things):
        from rangesim.report.scan_page import NOTHING_SEEN

        lines.append(f"no view measured any of these: {NOTHING_SEEN}")
    if result.poses is not None:
        angle, centre = result.poses.angle_deg.max(), 1e3 * result.poses.centre_m.max()
        lines.append(f"largest error of the poses found: {angle:.3f} degrees, camera centre {centre:.3f} mm")
    return "\n".join(lines)
