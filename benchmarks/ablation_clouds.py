# SPDX-License-Identifier: Apache-2.0
"""The clouds on which parts are switched off: those of `domain_clouds.py`, heaps, depth cameras, scans of one place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from domain_clouds import DATA, Domain, MissingDataError, Sample, domains, mosd_organised, turned
from numpy.typing import NDArray
from scan_places import KINDS
from scanned_rooms import flat, office
from scanned_scenes import Scene, caster_of

import pcgraph

STEP_PER_M = 2.85e-3  # of a Kinect's inverse depth
WIDTH, HEIGHT, FOCAL = 640, 480, 525.0
TILT = -0.3  # sine of the elevation at which cameras look
VIEWS = 2  # of each room


def all_domains(turns: int) -> list[Domain]:
    """Domains of `domains.py`, then others; those with one cloud have so many draws of it."""
    levels, fine = ("wov", "oracle"), (0.02,)
    found = [replace(domain, load=partial(_drawn, domain, turns)) for domain in domains()]
    others: dict[str, Callable[[], list[Sample]]] = {
        "heaps": _heaps,
        "heaps as turned lists": _heaps_as_lists,
        "tables as turned images": _turned_images,
        "rooms by structured light": partial(_by_camera, "structured light"),
        "rooms by time of flight": partial(_by_camera, "time of flight"),
    }
    found += [Domain(name, levels, load, 100, fine, 0.01) for name, load in others.items()]
    for name in KINDS:
        found.append(Domain(f"place: {name}", ("wov", "facing"), partial(_of_place, name, turns), 100, fine, 0.02))
    return found


def _drawn(domain: Domain, turns: int) -> list[Sample]:
    samples = domain.load()
    return samples[0].turned(turns) if len(samples) == 1 else samples


def _heaps() -> list[Sample]:
    """Heaps of some twenty things as their files are: images, or a list."""
    folder = DATA / "mosd_clutter"
    if not folder.exists():
        raise MissingDataError(f"{folder} is not there")
    found = []
    for path in sorted(folder.glob("*.pcd")):
        cloud = pcgraph.read_cloud(path)
        assert cloud.labels is not None
        is_true = (cloud.labels > 0) & np.isfinite(cloud.points).all(axis=-1)
        found.append(Sample(cloud.points, np.where(is_true, cloud.labels // 10, -1).astype(np.int32), cloud.colors))
    return found


def _heaps_as_lists() -> list[Sample]:
    found = []
    for seed, sample in enumerate(_heaps()):
        kept = np.isfinite(sample.points).all(axis=-1)
        colors = None if sample.colors is None else sample.colors[kept]
        found.append(turned(Sample(sample.points[kept], sample.truth[kept], colors), seed))
    return found


def _turned_images() -> list[Sample]:
    return [turned(sample, seed) for seed, sample in enumerate(mosd_organised()[::3])]


def _of_place(name: str, turns: int) -> list[Sample]:
    first = replace(next(iter(KINDS[name]())), colors=None)
    return [turned(first, seed) for seed in range(turns)]


# --- Depth cameras in rooms -------------------------------------------------------------------------------------------


def _by_camera(kind: str) -> list[Sample]:
    """Images of two rooms, in the camera's frame: depth in steps, or a mean over each pixel, across edges, too."""
    random = np.random.default_rng(0)
    found = []
    for scene, places in (office(), flat()):
        middle = np.mean(places, axis=0)
        for place in places[:VIEWS]:
            depths, things = _cast(scene, place, middle - place)
            if kind == "time of flight":
                depth = depths.mean(axis=-1) + random.normal(0.0, 0.003, depths.shape[:2])
            else:
                inverse = 1.0 / depths[..., 0] + random.normal(0.0, 0.3 * STEP_PER_M, depths.shape[:2])
                depth = 1.0 / (STEP_PER_M * np.rint(inverse / STEP_PER_M))
            points = depth[..., None] * pixel_rays()
            found.append(Sample(points.astype(np.float32), np.where(np.isfinite(depth), things, -1).astype(np.int32)))
    return found


def axes_of_a_look(ahead: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axes (3, 3), rows, of a camera that looks along a level direction and somewhat down: right, down, forwards."""
    level = ahead[:2] / np.linalg.norm(ahead[:2])
    forward = np.array([*(level * np.sqrt(1.0 - TILT**2)), TILT])
    right = np.array([level[1], -level[0], 0.0])
    return np.stack((right, np.cross(forward, right), forward))


def pixel_rays() -> NDArray[np.float64]:
    """Directions (h, w, 3) of a depth of 1 through the pixels; x right, y down, z forwards."""
    return _rays(1).reshape(HEIGHT, WIDTH, 3)


def _rays(finer: int) -> NDArray[np.float64]:
    """Directions (h, w, finer^2, 3) of so many rays along each side of a pixel, of depth 1; x right, y down."""
    of_pixel = (np.arange(finer) + 0.5) / finer - 0.5
    v, u, dv, du = np.meshgrid(np.arange(HEIGHT), np.arange(WIDTH), of_pixel, of_pixel, indexing="ij")
    x, y = (u + du - (WIDTH - 1) / 2.0) / FOCAL, (v + dv - (HEIGHT - 1) / 2.0) / FOCAL
    return np.stack((x, y, np.ones(x.shape)), axis=-1).reshape(HEIGHT, WIDTH, finer * finer, 3)


def _cast(
    scene: Scene, place: NDArray[np.float64], ahead: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Depths of four rays per pixel, (h, w, 4), NaN where there is nothing, and the thing that the first one hits."""
    import open3d as o3d

    caster, part = caster_of(scene)
    directions = _rays(2) @ axes_of_a_look(ahead)
    rays = np.concatenate((np.broadcast_to(place, directions.shape), directions), axis=-1).astype(np.float32)
    hits = caster.cast_rays(o3d.core.Tensor(rays.reshape(-1, 6)))
    depths = hits["t_hit"].numpy().reshape(directions.shape[:3]).astype(np.float64)  # directions have a depth of 1
    triangles = hits["primitive_ids"].numpy().reshape(depths.shape)[..., 0].astype(np.int64)
    things = np.array(scene.things)[part[np.minimum(triangles, len(part) - 1)]]
    return np.where(np.isfinite(depths), depths, np.nan), things
