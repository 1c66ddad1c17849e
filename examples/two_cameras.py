# SPDX-License-Identifier: Apache-2.0
"""What a second camera adds to a scanner: surface that one camera cannot see, or reads wrongly.

Both cameras watch one projector. The surface is sampled in cells of 15 mm; one counts as measured where a camera
reads a point within 2 mm of the true one.

Usage: python examples/two_cameras.py [SCENE] [--width 160]
"""

from __future__ import annotations

import argparse

import numpy as np

from rangesim import Signals, StructuredLight, decode, expose, load_scene, look_at, transport

CELL_M, WITHIN_M = 0.015, 2e-3


def cells(points: np.ndarray) -> set[tuple[int, ...]]:
    """Cells of the world that hold one of the points (n, 3)."""
    return set(map(tuple, np.floor(points / CELL_M).astype(int).tolist()))


def world_points(signals: Signals, z: np.ndarray) -> np.ndarray:
    """(h, w, 3) points in the world at depths z (h, w) of a camera."""
    camera, T = signals.rig.camera, signals.rig.T_world_camera
    rays = camera.directions(camera.pixel_centres())
    return np.asarray((rays * z[..., None]) @ T[:3, :3].T + T[:3, 3])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scene", nargs="?", default="tabletop")
    parser.add_argument("--width", type=int, default=160, help="pixels of each camera")
    arguments = parser.parse_args()

    scene, sensor = load_scene(arguments.scene), StructuredLight(640, 400)
    left = scene.rig(projector_size=(640, 400), width=arguments.width)
    baseline_m = 2 * left.baseline_m  # the projector stands between the two
    right = left.with_camera(look_at((baseline_m, 0, 0), (0, 0, scene.working_distance_m), up=(0, -1, 0)))
    measured: list[set[tuple[int, ...]]] = []
    surface: set[tuple[int, ...]] = set()
    for name, signals in zip(("left", "right"), transport(scene, [left, right], [sensor], spp=8), strict=True):
        image = decode(expose(signals, sensor, sensor.default_detector))
        seen = np.isfinite(signals.truth.z)
        right_ones = image.valid & (np.abs(image.z - signals.truth.z) < WITHIN_M)
        points = world_points(signals, signals.truth.z)
        surface |= cells(points[seen])
        measured.append(cells(points[right_ones]))
        print(f"{name}: {right_ones.sum() / seen.sum():.1%} of its pixels read to {1e3 * WITHIN_M:g} mm")
    for name, found in (("left alone", measured[0]), ("right alone", measured[1]), ("both", measured[0] | measured[1])):
        print(f"{name}: {len(found) / len(surface):.1%} of the surface that either camera sees")


if __name__ == "__main__":
    main()
