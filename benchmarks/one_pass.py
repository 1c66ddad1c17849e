# SPDX-License-Identifier: Apache-2.0
"""One pass for all patterns against one plain Mitsuba render per pattern: same images, at what cost?

Both sides render the same scene with the same camera, projector, samples per pixel and path depth, in this
process, after warm-up, in turns, so that other load on the machine hits both alike. The plain side is Mitsuba's
`path` integrator with its `projector` emitter showing one pattern after the other. The last line is JSON:

    patterns                number of structured-light frames
    one_pass_s              one pass with all patterns, ground truth and energy split included (median)
    naive_s                 one plain render per pattern, all together
    speedup                 naive_s / one_pass_s
    patterns_vs_one_render  one pass over ONE plain render (medians)
    cost_vs_one_render      one pass with all patterns, 3 x 4 AMCW taps and 256 time bins over ONE plain render
    default_vs_one_render   the same with the sampling error and with light that neighbours share, as by default
    max_abs_z               largest |z| over the frames; z = mean difference over its standard error
    max_abs_tile_z          largest |z| over all lit tiles of 40 x 40 pixels of all frames (about 4 by chance)

Usage: python benchmarks/one_pass.py [SCENE] [--width 640] [--height 480] [--spp 16] [--max-depth 5]
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path

import numpy as np
from plain_mitsuba import plain_scene, render, show, tile_z, timed, z_score

from rangesim import AmcwToF, DirectToF, StructuredLight, load_scene, transport

SCENES = Path(__file__).resolve().parent.parent / "scenes"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default=str(SCENES / "matte.xml"))
    for name, default in (("width", 640), ("height", 480), ("spp", 16), ("max-depth", 5)):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()

    scene = load_scene(args.scene)
    import mitsuba as mi

    rig = scene.rig(width=args.width, height=args.height)
    light = StructuredLight(rig.projector.width, rig.projector.height, code="gray", axes=("columns", "rows"))
    everything = [light, AmcwToF((20e6, 60e6, 100e6)), DirectToF(bins=256)]
    plain = plain_scene(scene, rig, {"type": "hdrfilm", "pixel_format": "luminance"})
    integrator = mi.load_dict({"type": "path", "max_depth": args.max_depth, "rr_depth": 5})
    # Mitsuba's path integrator finds no projector light through glass
    one_pass = partial(transport, scene, rig, spp=args.spp, max_depth=args.max_depth, caustics=False, glint=False)
    default, one_pass = one_pass, partial(one_pass, indirect="raw", sampling_error=False)

    frames = one_pass([light], seed=1).frames(light)
    one_pass(everything), default([light]), render(plain, integrator, args.spp, seed=0)  # warm-up

    patterns_s, everything_s, default_s, naive_s, scores, tiles = [], [], [], [], [], []
    for k, pattern in enumerate(light.patterns()):
        show(plain, pattern)
        reference, seconds = timed(partial(render, plain, integrator, args.spp, seed=1000 + k))
        naive_s.append(seconds)
        if k % 4 == 0:
            patterns_s.append(timed(partial(one_pass, [light], seed=k))[1])
            default_s.append(timed(partial(default, [light], seed=k))[1])
            everything_s.append(timed(partial(one_pass, everything, seed=k))[1])
        scores.append(z_score(frames[k], reference))
        tiles.append(tile_z(frames[k], reference))
        print(
            f"{light.frame_names()[k]:>22}: mean {frames[k].mean():.6f}, plain {reference.mean():.6f}, "
            f"z {scores[-1]:+.2f}, worst tile {tiles[-1]:.2f}, {seconds:.2f} s"
        )

    one_pass_s, render_s = np.median(patterns_s), np.median(naive_s)
    result = {
        "patterns": light.n_frames,
        "one_pass_s": round(float(one_pass_s), 3),
        "naive_s": round(sum(naive_s), 3),
        "speedup": round(float(sum(naive_s) / one_pass_s), 1),
        "patterns_vs_one_render": round(float(one_pass_s / render_s), 3),
        "cost_vs_one_render": round(float(np.median(everything_s) / render_s), 3),
        "default_vs_one_render": round(float(np.median(default_s) / render_s), 3),
        "max_abs_z": round(float(np.abs(scores).max()), 2),
        "max_abs_tile_z": round(max(tiles), 2),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
