# SPDX-License-Identifier: Apache-2.0
"""The other side of the comparisons: the same scene and rig with Mitsuba's own camera and projector plugins."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from rangesim import Intrinsics, Rig, Scene
from rangesim.scene.camera import MITSUBA_FROM_OPENCV

TILE = 40
T = TypeVar("T")


def plain_scene(scene: Scene, rig: Rig, film: dict[str, Any], **plugins: dict[str, Any]) -> Any:
    """mitsuba.Scene with the shapes of `scene`, a `perspective` sensor, a `projector` that shows white, and `plugins`.

    `film` completes the film's parameters; size and box filter are set here.
    """
    import mitsuba as mi

    here = scene.in_renderer(rig)

    def device(intrinsics: Intrinsics, T_world_device: np.ndarray) -> dict[str, Any]:
        fov = np.degrees(2 * np.arctan(0.5 * intrinsics.width / intrinsics.fx))
        return {"fov": float(fov), "to_world": mi.ScalarTransform4f(T_world_device @ MITSUBA_FROM_OPENCV)}

    infinite = [e for e in scene.mitsuba.emitters() if mi.has_flag(e.flags(), mi.EmitterFlags.Infinite)]
    parts = {f"part_{i}": part for i, part in enumerate([*scene.mitsuba.shapes(), *infinite])}
    white = mi.Bitmap(np.ones((rig.projector.height, rig.projector.width, 1), np.float32))
    size = {"width": rig.camera.width, "height": rig.camera.height}
    return mi.load_dict(
        {
            "type": "scene",
            **parts,
            **plugins,
            "projector": {
                "type": "projector",
                **device(rig.projector, here.T_world_projector),
                "scale": rig.projector_irradiance / np.pi,
                "irradiance": {"type": "bitmap", "bitmap": white, "raw": True, "filter_type": "nearest"},
            },
            "sensor": {
                "type": "perspective",
                **device(rig.camera, here.T_world_camera),
                "near_clip": 1e-5,
                "film": {"rfilter": {"type": "box"}, **size, **film},
            },
        }
    )


def show(plain: Any, pattern: np.ndarray) -> None:
    """Put `pattern` (height, width) on the projector of a plain scene."""
    import mitsuba as mi

    params = mi.traverse(plain)
    key = next(k for k, _ in params if k.endswith("irradiance.data"))
    params[key] = mi.TensorXf(np.ascontiguousarray(pattern[..., None], dtype=np.float32))
    params.update()


def render(plain: Any, integrator: Any, spp: int, seed: int) -> np.ndarray:
    """(h, w) radiance of one `mi.render`."""
    import mitsuba as mi

    return np.array(mi.render(plain, integrator=integrator, spp=spp, seed=seed)).squeeze()


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """Result of `work` and the seconds it took."""
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start


def z_score(a: np.ndarray, b: np.ndarray) -> float:
    """Mean of a - b over its standard error, pixels taken as independent samples."""
    d = (a - b).astype(np.float64).ravel()
    spread = d.std(ddof=1)
    return float(d.mean() / (spread / np.sqrt(d.size))) if spread > 0 else 0.0


def tile_z(a: np.ndarray, b: np.ndarray) -> float:
    """Largest |z| over the tiles in which most pixels are lit, so that the mean is about normal."""
    h, w = (n // TILE * TILE for n in a.shape)

    def cut(x: np.ndarray) -> np.ndarray:
        return x[:h, :w].reshape(h // TILE, TILE, w // TILE, TILE).swapaxes(1, 2).reshape(-1, TILE * TILE)

    tiles = zip(cut(a), cut(b), strict=True)
    return max((abs(z_score(x, y)) for x, y in tiles if ((x + y) > 0).mean() > 0.5), default=0.0)
