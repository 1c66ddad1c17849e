# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim run`, which carries out an experiment and writes its results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rangesim.cli.lengths import length
from rangesim.cli.progress import announce_cost, announce_linked_output, one_truncation_warning, progress_bar
from rangesim.errors import one_line
from rangesim.files.bundled_scenes import scene_names

if TYPE_CHECKING:
    from rangesim.experiment import Experiment
    from rangesim.instrument.instrument import Instrument
    from rangesim.results.experiment_results import Result


def run_command(
    scene: Annotated[
        Path | None,
        typer.Argument(
            help="Mitsuba 3 scene (.xml) or mesh (.ply, .obj, .glb, .stl, .off), in metres, or the name of a scene "
            f"that rangesim contains: {', '.join(scene_names())}."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Directory for the results; an older result is replaced. (required)"),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Experiment file (.toml); other options override it.")
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            "--sensor",
            "-s",
            help="gray, gray-phase, amcw, direct-tof or ideal-tof; a device such as kinect-v2 (rangesim presets "
            "lists them); FILE.toml for a device, FILE.py:NAME for a sensor of your own. Repeat the "
            "option for several sensors. (default: gray-phase, amcw, ideal-tof)",
            show_default=False,
        ),
    ] = None,
    spp: Annotated[
        int | None,
        typer.Option(help="Light paths per pixel. (default: 8, and up to --max-spp where readings need more)"),
    ] = None,
    max_spp: Annotated[
        int | None, typer.Option(help="Largest number of light paths per pixel without --spp. (default: 64)")
    ] = None,
    width: Annotated[int | None, typer.Option(help="Camera width, pixels. (default: the scene's)")] = None,
    height: Annotated[int | None, typer.Option(help="Camera height, pixels. (default: the scene's)")] = None,
    max_depth: Annotated[
        int | None,
        typer.Option(
            help="Largest number of segments of a light path between surfaces that scatter it. Glass and mirrors do "
            "not count. 2 means direct light only. (default: 5)"
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the random numbers. The same seed gives the same bytes. (default: 0)")
    ] = None,
    baseline: Annotated[
        float | None,
        typer.Option(
            parser=length,
            metavar="LENGTH",
            help="Distance from camera to emitter, for every sensor: metres, or with a unit, as 50mm. "
            "(default: a fifth of the working distance for structured light, 0.03 for time of flight)",
        ),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            parser=length,
            metavar="LENGTH",
            help="Largest error of a right reading, as the task sets it: metres, or with a unit, as 2mm. "
            "(default: 10mm)",
        ),
    ] = None,
    material: Annotated[
        str | None,
        typer.Option(help="Material of a bare mesh: matte, glossy, mirror or transparent. (default: matte)"),
    ] = None,
    unit_m: Annotated[
        float | None,
        typer.Option(help="Metres per unit of a bare mesh: 0.001 if it is in millimetres. (default: 1)"),
    ] = None,
    no_caustics: Annotated[
        bool,
        typer.Option(
            "--no-caustics", help="Leave out the projector's light that reaches surfaces through glass and off mirrors."
        ),
    ] = False,
    noise_free: Annotated[
        bool, typer.Option("--noise-free", help="Simulate ideal electronics, without noise and quantisation.")
    ] = False,
    estimate: Annotated[
        bool, typer.Option("--estimate", help="Print the estimated cost of the run and end. Nothing is written.")
    ] = False,
) -> None:
    """Measure a scene with several sensors, and write captures, clouds, segments and report.html.

    Examples:

      rangesim run tabletop --out out/tabletop

      rangesim run part.ply --material glossy --sensor gray --sensor gray-phase --tolerance 2mm --out out/part

      rangesim run --config examples/tabletop.toml --spp 16 --width 320 --height 240 --out out/quick
    """
    if out is None and not estimate:
        raise typer.BadParameter("expected --out DIRECTORY, unless --estimate is given.", param_hint="--out")
    given: dict[str, Any] = {
        "width": width,
        "height": height,
        "spp": spp,
        "max_spp": max_spp,
        "max_depth": max_depth,
        "seed": seed,
    }
    given |= {"material": material, "unit_m": unit_m, "tolerance_m": tolerance}
    experiment = _experiment(scene, config, {k: v for k, v in given.items() if v is not None}, sensor)
    if baseline is not None:
        experiment = replace(
            experiment, instruments=tuple(replace(i, baseline_m=baseline) for i in experiment.instruments)
        )
    if no_caustics:
        experiment = replace(experiment, caustics=False)
    if noise_free:
        experiment = replace(experiment, instruments=tuple(replace(i, noise=False) for i in experiment.instruments))
    from rangesim.files.atomic_directories import check_directory
    from rangesim.pipeline import experiment_run
    from rangesim.report.tables import automatic_exposures
    from rangesim.results.experiment_results import RESULT

    if estimate or out is None:
        cost = experiment_run.estimate(experiment)
        typer.echo(cost)
        cost.check_memory()
        return
    target = check_directory(out, RESULT, inputs=[experiment.scene])
    announce_linked_output(out, target)
    with one_truncation_warning(), progress_bar() as progress:
        result = experiment_run.run(experiment, out, progress, announce=announce_cost)
    _warn_of_instruments_without_points(result)
    if exposures := automatic_exposures({m.name: m.metadata for m in result.measurements}):
        typer.echo(f"rangesim: the exposure {exposures}", err=True)
    typer.echo(one_line(out / "report.html"))


def _warn_of_instruments_without_points(result: Result) -> None:
    """Print a line on stderr for the instruments that have no point at all.

    Instruments whose pixels most often fail by the same cause share a line. Where this cause is low signal or a
    distance that the sensor cannot read, the scene is most often not in metres, so the line says how to scale it.
    """
    from rangesim.causes.cause import DEFINITIONS, TITLES, Cause
    from rangesim.scene.mesh import MESH_SUFFIXES
    from rangesim.signals import ALL

    causes_of_wrong_scale = (Cause.LOW_SIGNAL, Cause.RANGE_AMBIGUITY, Cause.RESOLUTION)
    blind: dict[Cause, list[str]] = {}  # names by cause; Cause.NONE stands for a wrong scale
    for measurement in result.measurements:
        if not measurement.metadata.points:
            fractions = next(row["causes"] for row in measurement.rows if row["kind"] == ALL)
            cause = Cause[max(fractions, key=fractions.get).upper()] if fractions else Cause.NONE
            is_wrong_scale = cause in causes_of_wrong_scale
            blind.setdefault(Cause.NONE if is_wrong_scale else cause, []).append(measurement.name)
    for cause, names in blind.items():
        start = f"rangesim: {one_line(', '.join(names))} measured no pixel at all"
        if cause:
            typer.echo(f"{start}; the most frequent cause is {TITLES[cause]}: {DEFINITIONS[cause]}", err=True)
            continue
        is_mesh = Path(result.experiment.scene).suffix.lower() in MESH_SUFFIXES
        advice = (
            "a mesh in millimetres needs --unit-m 0.001" if is_mesh else "scale the scene's shapes and camera to metres"
        )
        typer.echo(
            f"{start}, at a working distance of {result.info.scene.working_distance_m:g} m; coordinates are metres "
            f"({advice}). If the scene is dark, a larger --spp or power_w helps.",
            err=True,
        )


def _instruments(sensors: list[str]) -> tuple[Instrument, ...]:
    """One instrument per sensor. Sensors from files that have the same `type_name` are named by the NAME of their class
    or object instead, because the names of instruments must differ."""
    from rangesim.presets import instrument
    from rangesim.sensors import is_file_name

    found = [instrument(name) for name in sensors]
    names = [one.name for one in found]
    return tuple(
        replace(one, name=name.rpartition(":")[2]) if is_file_name(name) and names.count(one.name) > 1 else one
        for name, one in zip(sensors, found, strict=True)
    )


def _experiment(
    scene: Path | None, config: Path | None, settings: dict[str, Any], sensors: list[str] | None
) -> Experiment:
    """The experiment of a file or of a scene. Options of the command line replace the settings of the file."""
    from rangesim.experiment import Experiment, load_experiment

    if config is None and scene is None:
        raise typer.BadParameter("expected a scene or --config FILE.", param_hint="SCENE")
    if sensors:
        settings["instruments"] = _instruments(sensors)
    if config is None:
        return Experiment(scene=str(scene), **settings)
    if scene is not None:
        settings["scene"] = str(scene)
    return replace(load_experiment(config), **settings)
