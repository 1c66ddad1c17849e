# SPDX-License-Identifier: Apache-2.0
"""What translucent objects do to range sensors, and what tracing them costs; prints the tables of docs/subsurface.md.

Usage: python benchmarks/subsurface.py
"""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
from plain_mitsuba import plain_scene, render, timed

import rangesim
from rangesim import AmcwToF, Detector, decode, expose, load_scene, transport
from rangesim.environment.backend import select_variant
from rangesim.response import Fringes

MEDIA = sorted(p.stem for p in (Path(__file__).parents[1] / "scenes" / "materials" / "media").glob("*.xml"))
PERIODS_MM = (1.0, 4.0, 16.0)
DISTANCE_M = 0.5
BLOCK = """<scene version="3.0.0">
    <sensor type="perspective"><float name="fov" value="8"/>
        <transform name="to_world"><lookat origin="0,0,0.5" target="0,0,0" up="0.1,1,0"/></transform>
        <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="48"/></film></sensor>
    <include filename="materials/media/{name}.xml"/>
    <shape type="cube"><transform name="to_world"><scale x="0.2" y="0.2" z="0.03"/><translate z="-0.03"/></transform>
        <bsdf type="null"/><ref id="{name}" name="interior"/></shape>
</scene>"""


def block(name: str, folder: Path) -> rangesim.Scene:
    """A block of a medium, 60 mm deep, half a metre below the camera."""
    path = folder / f"{name}.xml"
    path.write_text(BLOCK.format(name=name))
    return load_scene(path)


def shift_mm(signals: rangesim.Signals, stripes: Fringes, pixel_m: float) -> float:
    """Median shift of the stripes across the block, against where they meet its boundary."""
    c, s = signals.channels[stripes]
    turn = 2 * np.pi / stripes.period_px
    off = np.angle(np.exp(1j * (np.arctan2(s, c) - turn * signals.truth.projector_uv[..., 0])))
    return 1e3 * float(np.median(off)) / turn * pixel_m


def bias_mm(signals: rangesim.Signals, sensor: rangesim.Sensor) -> float:
    """Median of decoded minus true range over the valid pixels."""
    image = decode(expose(signals, sensor, Detector.ideal()))
    return 1e3 * float(np.nanmedian(np.where(image.valid, image.range_m - signals.truth.range_m, np.nan)))


def row(name: str, folder: Path) -> dict[str, float | str]:
    """Figures of one medium: fraction of single scattering, contrast and shift of stripes, range error."""
    scene = block(name, folder)
    rig = scene.rig(baseline_m=0.1)
    pixel_m = DISTANCE_M / rig.projector.fx
    stripes = [Fringes(0, 1e-3 * period / pixel_m) for period in PERIODS_MM]
    tof = AmcwToF()
    signals = transport(scene, rig, [*stripes, tof], spp=256)
    light = signals.energy.projector
    result: dict[str, float | str] = {"medium": name, "single": float((signals.energy.direct / light).mean())}
    for period, s in zip(PERIODS_MM, stripes, strict=True):
        result[f"contrast_{period:g}mm"] = float(np.median(np.hypot(*signals.channels[s]) / light))
    result["shift_16mm_mm"] = shift_mm(signals, stripes[-1], pixel_m)
    return result | {"tof_bias_mm": bias_mm(signals, tof)}


def cost(name: str, folder: Path, spp: int = 64) -> dict[str, float | str]:
    """Seconds of a white pass and of Mitsuba's `volpath` on the same block, second runs of each."""
    scene = block(name, folder)
    rig = scene.rig(baseline_m=0.1)
    plain = plain_scene(scene, rig, {"type": "hdrfilm", "pixel_format": "luminance"})
    volpath = mi.load_dict({"type": "volpath", "max_depth": 1 << 14, "rr_depth": 300})
    for seed in (0, 1):
        _, own_s = timed(lambda seed=seed: transport(scene, rig, [], spp=spp, seed=seed))
        _, plain_s = timed(lambda seed=seed: render(plain, volpath, spp, seed))
    return {"medium": name, "own_s": own_s, "volpath_s": plain_s, "ratio": own_s / plain_s}


def main() -> None:
    """Print one line of JSON per medium, then the costs."""
    import tempfile

    select_variant()
    with tempfile.TemporaryDirectory() as folder:
        for work in (row, cost):
            for name in MEDIA:
                print(
                    json.dumps(
                        {k: v if isinstance(v, str) else round(v, 4) for k, v in work(name, Path(folder)).items()}
                    )
                )


if __name__ == "__main__":
    main()
