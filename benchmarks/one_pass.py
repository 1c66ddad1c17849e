# SPDX-License-Identifier: Apache-2.0
"""One pass for all patterns against one plain Mitsuba render per pattern: same images, at what cost?

Both sides render the same scene with the same camera, projector, samples per pixel and path depth, in this
process, after warm-up. The plain side is Mitsuba's `path` integrator with its `projector` emitter showing one
pattern after the other. The last line printed is JSON:

    patterns          number of structured-light frames
    one_pass_s        one pass with all patterns, ground truth and energy split included (median)
    naive_s           one plain render per pattern, all together
    speedup           naive_s / one_pass_s
    cost_vs_one_render    one pass with all patterns, AMCW taps and time bins over ONE plain render (median of the ratios
                      of adjacent runs)
    max_abs_z         largest |z| over the frames; z = mean difference over its standard error
    max_abs_tile_z    largest |z| over all tiles of 40 x 40 pixels of all frames (expected: about 4.3 by chance)

Usage: python benchmarks/one_pass.py [SCENE] [--width 640] [--height 480] [--spp 16] [--max-depth 5] [--runs 5]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from rangesim import AmcwToF, DirectToF, Rig, Scene, StructuredLight, load_scene, transport
from rangesim.scene.load import MITSUBA_FROM_OPENCV

SCENES = Path(__file__).resolve().parent.parent / "scenes"
TILE = 40


def plain_scene(scene: Scene, rig: Rig) -> tuple[Any, Any]:
    """The same scene with Mitsuba's own sensor, projector and path integrator; and the projector's image."""
    import drjit as dr
    import mitsuba as mi

    def to_world(T: np.ndarray) -> Any:
        return mi.ScalarTransform4f(T @ MITSUBA_FROM_OPENCV)

    def fov(device: Any) -> float:
        return float(np.degrees(2 * np.arctan(0.5 * device.width / device.fx)))

    projector = rig.projector
    white = mi.Bitmap(np.ones((projector.height, projector.width, 1), np.float32))
    image = {"type": "bitmap", "bitmap": white, "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}
    parts: dict[str, Any] = {f"shape_{i}": shape for i, shape in enumerate(scene.mitsuba.shapes())}
    parts |= {
        f"emitter_{i}": e for i, e in enumerate(scene.mitsuba.emitters()) if mi.has_flag(e.flags(), mi.EmitterFlags.Infinite)
    }
    plain = mi.load_dict(
        {
            "type": "scene",
            **parts,
            "projector": {
                "type": "projector",
                "to_world": to_world(rig.T_world_projector),
                "fov": fov(projector),
                "scale": rig.projector_irradiance / np.pi,
                "irradiance": image,
            },
            "sensor": {
                "type": "perspective",
                "to_world": to_world(rig.T_world_camera),
                "fov": fov(rig.camera),
                "near_clip": 1e-4,
                "film": {
                    "type": "hdrfilm",
                    "width": rig.camera.width,
                    "height": rig.camera.height,
                    "pixel_format": "luminance",
                    "rfilter": {"type": "box"},
                },
            },
        }
    )
    params = mi.traverse(plain)
    key = next(k for k in params.keys() if k.endswith("irradiance.data"))
    dr.eval(params[key])
    return plain, (params, key)


def show(image: Any, pattern: np.ndarray) -> None:
    """Put `pattern` (height, width) on the plain scene's projector."""
    import mitsuba as mi

    params, key = image
    # Mitsuba's devices have x to the left: u grows the other way, and so do bitmap rows and columns alike
    params[key] = mi.TensorXf(np.ascontiguousarray(pattern[..., None], dtype=np.float32))
    params.update()


def plain_render(plain: Any, integrator: Any, spp: int, seed: int) -> np.ndarray:
    """(h, w) radiance of one `mi.render`."""
    import mitsuba as mi

    return np.array(mi.render(plain, integrator=integrator, spp=spp, seed=seed)).squeeze()


def z_score(a: np.ndarray, b: np.ndarray) -> float:
    """Mean of a - b over its standard error, pixels taken as independent samples."""
    d = (a - b).astype(np.float64).ravel()
    spread = d.std(ddof=1)
    return float(d.mean() / (spread / np.sqrt(d.size))) if spread > 0 else 0.0


def tile_z(a: np.ndarray, b: np.ndarray) -> float:
    """Largest |z| over tiles that have enough lit pixels for the mean to be normal."""
    h, w = (n // TILE * TILE for n in a.shape)
    cut = lambda x: x[:h, :w].reshape(h // TILE, TILE, w // TILE, TILE).swapaxes(1, 2).reshape(-1, TILE * TILE)  # noqa: E731
    da, db = cut(a), cut(b)
    lit = ((da + db) > 0).mean(axis=1) > 0.5
    return max((abs(z_score(x, y)) for x, y in zip(da[lit], db[lit], strict=True)), default=0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default=str(SCENES / "matte.xml"))
    for name, default in (("width", 640), ("height", 480), ("spp", 16), ("max-depth", 5), ("runs", 5)):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()

    scene = load_scene(args.scene)
    import mitsuba as mi

    rig = scene.rig(width=args.width, height=args.height)
    light = StructuredLight(rig.projector.width, rig.projector.height, code="gray", axes=("columns", "rows"))
    everything = [light, AmcwToF((20e6, 60e6, 100e6)), DirectToF(bins=256)]
    integrator = mi.load_dict({"type": "path", "max_depth": args.max_depth, "rr_depth": 5})
    plain, image = plain_scene(scene, rig)
    options = {"spp": args.spp, "max_depth": args.max_depth}

    def timed(work: Any) -> tuple[Any, float]:
        start = time.perf_counter()
        result = work()
        return result, time.perf_counter() - start

    patterns_s, everything_s, render_s = [], [], []
    for run in range(args.runs + 1):  # the first run warms up
        _, a = timed(lambda: transport(scene, rig, [light], seed=run, **options))
        _, b = timed(lambda: transport(scene, rig, everything, seed=run, **options))
        _, c = timed(lambda: plain_render(plain, integrator, args.spp, seed=run))
        if run:
            patterns_s.append(a), everything_s.append(b), render_s.append(c)
            print(f"run {run}: {light.n_frames} patterns {a:.2f} s, all sensors {b:.2f} s, one plain render {c:.2f} s")

    patterns = light.patterns()
    frames = transport(scene, rig, [light], seed=1000, **options).frames(light)
    scores, tiles, naive_s = [], [], 0.0
    for k, (pattern, frame) in enumerate(zip(patterns, frames, strict=True)):
        show(image, pattern)
        reference, seconds = timed(lambda: plain_render(plain, integrator, args.spp, seed=2000 + k))
        naive_s += seconds
        scores.append(z_score(frame, reference))
        tiles.append(tile_z(frame, reference))
        print(f"{light.frame_names()[k]:>22}: mean {frame.mean():.6f} plain {reference.mean():.6f} z {scores[-1]:+.2f} tiles {tiles[-1]:.2f}")

    one_pass_s = float(np.median(patterns_s))
    print(
        json.dumps(
            {
                "patterns": len(patterns),
                "one_pass_s": round(one_pass_s, 3),
                "naive_s": round(naive_s, 3),
                "speedup": round(naive_s / one_pass_s, 1),
                "patterns_vs_one_render": round(float(np.median(np.divide(patterns_s, render_s))), 3),
                "cost_vs_one_render": round(float(np.median(np.divide(everything_s, render_s))), 3),
                "max_abs_z": round(float(np.abs(scores).max()), 2),
                "max_abs_tile_z": round(float(max(tiles)), 2),
            }
        )
    )


if __name__ == "__main__":
    main()
