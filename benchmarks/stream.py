# SPDX-License-Identifier: Apache-2.0
"""Streams: a camera in a room, and a scanner that drives along a corridor and forgets.

    python benchmarks/stream.py --frames 12 --scans 60

Room: a VGA depth camera moves and turns through the office of `scanned_rooms.py`; its noise grows with the square of
the range. For each image after the first, `update` adds it to the scene, and `segment` takes it alone, in turns.

Corridor: a scanner of 64 beams drives 60 cm between scans, whose poses are 1 cm and 0.1 degrees off. Midway a carton
before it is pushed aside. It runs three times: with `max_age`, with `carve_free_space` as well, and with neither.

The last line is JSON. Of the room: medians `update_s` and `segment_s`, `ratio`, `last_update_s` of the largest scene,
`kept` (the fraction of the points seen before an update whose object keeps its number, median and least) and `voxels`.
Of each run in the corridor, at a third of the way and at its end: `voxels`, `update_s` (median of ten) and `rss_mb`;
`old_left`, the fraction of the carton's old voxels that is left two scans after it moved; `others_lost`, the fraction
of all other voxels that the update after it moved took away.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

import numpy as np
from ablation_clouds import HEIGHT, WIDTH, axes_of_a_look, pixel_rays
from scanned_rooms import office
from scanned_scenes import Floats, Scene, box, caster_of, scan, sphere_of_rays
from scipy.spatial.transform import Rotation

import pcgraph

STEP_M = (0.05, 0.02, 0.0)
TURN = 0.06  # radians per image
NOISE = 0.0015  # metres at 1 m

DRIVE_M = 0.6  # between scans
REACH_M = 12.0
MAX_AGE = 5  # scans
CARTON_M = (0.6, 0.5, 0.7)
PUSHED_M = 0.8  # to the side
POSE_NOISE = (0.01, 0.1)  # metres, degrees


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


def corridor(length: float, carton: Floats) -> Scene:
    """A corridor along x, 3 m wide, with pillars and boxes along its walls, and a carton on its floor."""
    random, made = np.random.default_rng(0), Scene()
    for low, high in (((-20, -1.6, -0.1), (length, 1.6, 0.0)), ((-20, -1.6, 2.5), (length, 1.6, 2.6))):
        made.add(made.thing("level"), box(low, high))
    for side in (-1.0, 1.0):
        y = sorted((side * 1.5, side * 1.6))
        made.add(made.thing("wall"), box((-20.0, y[0], 0.0), (length, y[1], 2.5)))
        for x in np.arange(-18.0, length, 2.0) + random.uniform(0.0, 0.6):
            deep, wide, high = random.uniform((0.15, 0.2, 0.4), (0.45, 0.9, 2.4))
            y = sorted((side * 1.5, side * (1.5 - deep)))
            made.add(made.thing("thing"), box((x, y[0], 0.0), (x + wide, y[1], high)))
    made.add(made.thing("carton"), box(tuple(carton), tuple(carton + CARTON_M)))
    return made


def drive(number: int) -> list[tuple[Floats, Floats]]:
    """Points (n, 3), metres, of so many scans along the corridor, and the scanner's place of each, (3,)."""
    random, rays = np.random.default_rng(1), sphere_of_rays(np.arange(0.0, 360.0, 0.4), np.linspace(-30.0, 30.0, 64))
    length, found = number * DRIVE_M + 20.0, []
    for step in range(number):
        place, is_pushed = np.array([step * DRIVE_M, -0.2, 1.0]), step >= number // 2
        made = corridor(length, carton_place(number) + np.array([0.0, PUSHED_M * is_pushed, 0.0]))
        points = scan(made, place[None], [rays], 0.01, random, REACH_M).points
        off, turn = POSE_NOISE[0] * random.standard_normal(3), POSE_NOISE[1] * random.standard_normal(3)
        turned = (points - place) @ Rotation.from_rotvec(turn / np.sqrt(3.0), degrees=True).as_matrix().T
        found.append((turned + place + off / np.sqrt(3.0), place))
    return found


def carton_place(number: int) -> Floats:
    """Lowest corner of the carton before it is pushed, (3,), metres: 2.5 m before the scanner at that time."""
    return np.array([(number // 2) * DRIVE_M + 2.5, -0.6, 0.0])


def run_along(scans: list[tuple[Floats, Floats]], **forgetting) -> dict[str, object]:
    """Voxels, seconds and memory of a stream of scans, and what becomes of the carton."""
    points, place = scans[0]
    result = pcgraph.segment(points, viewpoint=place, range_growth=0.0)
    low, pushed = carton_place(len(scans)), len(scans) // 2
    seconds, voxels, rss, row = [], [], [], {}
    for step, (points, place) in enumerate(scans[1:], 1):
        before = result
        spent, result = timed(pcgraph.update, before, points, viewpoint=place, **forgetting)
        seconds.append(spent)
        voxels.append(result.surface.grid.n_voxels)
        rss.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6)
        if step == pushed - 1:
            was = in_carton(result, low)
            number = np.bincount(result.objects[result.surface.supervoxels[was]]).argmax()
        elif step == pushed:
            is_gone = before_gone(before, result)
            row["others_lost"] = round(float(is_gone[~in_carton(before, low)].mean()), 4)
        elif step == pushed + 2:
            row["old_left"] = round(float(in_carton(result, low).sum() / was.sum()), 3)
            now = in_carton(result, low + np.array([0.0, PUSHED_M, 0.0]))
            row["carton_keeps_number"] = bool(
                np.bincount(result.objects[result.surface.supervoxels[now]]).argmax() == number
            )
    third = len(seconds) // 3
    for name, values in (("voxels", voxels), ("update_s", seconds), ("rss_mb", rss)):
        row[name] = [round(float(np.median(values[max(0, end - 10) : end])), 3) for end in (third, len(values))]
    return row


def in_carton(result: pcgraph.Segmentation, low: Floats) -> np.ndarray:
    """Voxels, (v,) bool, on the carton whose lowest corner is at a place, without its lowest 10 cm."""
    centroids, margin = result.surface.grid.centroids, 0.05
    inside = (centroids > low - margin) & (centroids < low + CARTON_M + margin)
    return inside.all(axis=1) & (centroids[:, 2] > 0.1)


def before_gone(before: pcgraph.Segmentation, result: pcgraph.Segmentation) -> np.ndarray:
    """Voxels of the segmentation before an update, (v,) bool, whose supervoxel was seen through, and not just old."""
    numbers = result.supervoxel_of_earlier[before.surface.supervoxels]
    return (numbers < 0) & (before.ages[before.surface.supervoxels] < MAX_AGE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--scans", type=int, default=60)
    given = parser.parse_args()
    scans, runs = drive(given.scans), {}
    for name, forgetting in (
        ("max_age", {"max_age": MAX_AGE}),
        ("carved", {"max_age": MAX_AGE, "carve_free_space": True}),
        ("everything", {}),
    ):
        runs[name] = run_along(scans, **forgetting)
        print(name, runs[name])
    frames = images(given.frames)
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
        **runs,
        "load": round(os.getloadavg()[0], 1),
    }
    print(json.dumps(row))


if __name__ == "__main__":
    main()
