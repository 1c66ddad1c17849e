# SPDX-License-Identifier: Apache-2.0
"""A stream of depth images: `update` against `segment` of the same image, and how many points keep their object.

    python benchmarks/stream.py --frames 12

A VGA depth camera moves and turns through the office of `scanned_rooms.py`; its noise grows with the square of the
range. For each image after the first, `update` adds it to the scene, and `segment` takes it alone, in turns. The last
line is JSON: medians `update_s` and `segment_s`, `ratio`, `last_update_s` of the largest scene, `kept` (the fraction of
the points seen before an update whose object keeps its number, median and least), `voxels` and `load`.
"""

from __future__ import annotations

import argparse
import json
import os
import time

import numpy as np
from ablation_clouds import HEIGHT, WIDTH, axes_of_a_look, pixel_rays
from scanned_rooms import office
from scanned_scenes import Floats, caster_of

import pcgraph

STEP_M = (0.05, 0.02, 0.0)
TURN = 0.06  # radians per image
NOISE = 0.0015  # metres at 1 m


def images(number: int, seed: int = 0) -> list[tuple[Floats, Floats]]:
    """Organised points (h, w, 3), metres, in the room's frame, and the place of the camera, (3,), of each image."""
    import open3d as o3d

    random, (scene, places) = np.random.default_rng(seed), office()
    caster, start, found = caster_of(scene)[0], np.asarray(places[0], float), []
    ahead = np.mean(places, axis=0) - start
    first = np.arctan2(ahead[1], ahead[0]) - TURN * number / 2.0
    for step in range(number):
        place, bearing = start + step * np.array(STEP_M), first + TURN * step
        rays = pixel_rays() @ axes_of_a_look(np.array([np.cos(bearing), np.sin(bearing)]))
        sent = np.concatenate((np.broadcast_to(place, rays.shape), rays), axis=-1).astype(np.float32)
        depths = caster.cast_rays(o3d.core.Tensor(sent.reshape(-1, 6)))["t_hit"].numpy().reshape(HEIGHT, WIDTH)
        depths = np.where(np.isfinite(depths), depths, np.nan).astype(float)
        depths += NOISE * depths**2 * random.standard_normal(depths.shape)
        found.append((place + depths[..., None] * rays, place))
    return found


def timed(function, *arguments, **settings) -> tuple[float, pcgraph.Segmentation]:
    """Seconds, and the result."""
    started = time.perf_counter()
    result = function(*arguments, **settings)
    return time.perf_counter() - started, result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=12)
    frames = images(parser.parse_args().frames)
    points, place = frames[0]
    result = pcgraph.segment(points, viewpoint=place)
    pcgraph.update(result, *frames[1][:1], viewpoint=frames[1][1])  # compiled
    updates, alone, kept = [], [], []
    for points, place in frames[1:]:
        before = result
        seconds, result = timed(pcgraph.update, before, points, viewpoint=place)
        updates.append(seconds)
        alone.append(timed(pcgraph.segment, points, viewpoint=place)[0])
        weights = before.leaves.counts
        kept.append(float(weights[result.objects[: len(weights)] == before.objects].sum() / weights.sum()))
        print(f"update {seconds:.3f} s, segment {alone[-1]:.3f} s, kept {kept[-1]:.3f}: {result}")
    row = {
        "update_s": round(float(np.median(updates)), 3),
        "segment_s": round(float(np.median(alone)), 3),
        "ratio": round(float(np.median(np.array(updates) / np.array(alone))), 2),
        "last_update_s": round(updates[-1], 3),
        "kept_median": round(float(np.median(kept)), 3),
        "kept_least": round(min(kept), 3),
        "voxels": result.surface.grid.n_voxels,
        "load": round(os.getloadavg()[0], 1),
    }
    print(json.dumps(row))


if __name__ == "__main__":
    main()
