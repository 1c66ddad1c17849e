# SPDX-License-Identifier: Apache-2.0
"""Projector light through glass and off mirrors against references that share no code with the pass.

    make     computes the references (about 9 minutes on two busy cores) and writes benchmarks/references/*.npz; those
             of one case with `--case pane`, of one of them with `--method path`
    compare  renders the same cases with `transport` and compares (the default)

Two references. `ptracer` is Mitsuba's particle tracer with its `projector` plugin: it is the reference for all that
the camera sees directly. `path` is a plain path tracer whose projector is a disc of finite size
(`finite_aperture.py`): it is the reference for what the camera sees through glass or off a mirror; its images are
extrapolated to a point, from two radii, a and 2 a. Where both apply, for caustics that the camera sees directly, the
two are compared with each other. The last line of `compare` is JSON:

    max_region_error        largest relative error of the mean radiance of white over the marked regions and references
    min_stripe_correlation  smallest correlation of a stripe image with its reference within a marked region

Usage: python benchmarks/caustic_references.py [make | compare] [--spp N]; without N, those of `transport`
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from plain_mitsuba import plain_scene, render, show
from reference_scenes import PROJECTOR_PIXELS, STRIPES, Case, cases

from rangesim import StructuredLight, transport

HERE = Path(__file__).resolve().parent / "references"
MAX_DEPTH = 12
PTRACER_SPP = 12_000
PATH_SAMPLES = 400_000_000
"""Camera paths per case of the path tracer with the aperture of the case; a quarter of that with twice the radius,
which four times as many paths meet."""
IMAGES = ("white", *STRIPES)


class Reference(NamedTuple):
    """Images (3, h, w) of `IMAGES`, NaN outside the regions, and the relative standard error of each region's mean of
    white."""

    images: np.ndarray
    error: dict[str, float]


def stripes() -> tuple[StructuredLight, list[int]]:
    """The sensor whose frames are rendered, and which frames."""
    light = StructuredLight(*PROJECTOR_PIXELS, code="gray", axes=("columns", "rows"))
    return light, [light.frame_names().index(name) for name in IMAGES]


def seen(name: str, case: Case) -> dict[str, np.ndarray]:
    """Masks of the regions that a reference is made for: what the camera sees directly has `ptracer`; `path` has all
    but the plain floor, to which the other is a better guide."""
    masks = case.masks()
    return {k: m for k, m in masks.items() if (k != "floor" if name == "path" else not case.regions[k].through)}


def ptracer(case: Case, scale: float) -> Reference:
    """Mitsuba's particle tracer, in two independent halves."""
    import mitsuba as mi
    from finite_aperture import MAX_SURFACES

    large = case.enlarged()
    plain = plain_scene(large.scene, large.rig, {"type": "hdrfilm", "pixel_format": "luminance"})
    integrator = mi.load_dict({"type": "ptracer", "max_depth": MAX_SURFACES, "rr_depth": MAX_SURFACES})
    light, frames = stripes()
    halves = np.empty((2, len(frames), case.rig.camera.height, case.rig.camera.width))
    for i, frame in enumerate(frames):
        show(plain, light.patterns()[frame])
        for half in range(2):
            halves[half, i] = render(plain, integrator, max(1, int(PTRACER_SPP * scale) // 2), 2 * i + half)
    return _reference(halves, seen("ptracer", case))


def path(case: Case, scale: float) -> Reference:
    """The path tracer with a finite projector, in two independent halves; the pixels of the regions alone."""
    from finite_aperture import Lamp, finite_aperture

    masks = seen("path", case)
    row, column = np.nonzero(np.any(list(masks.values()), axis=0))
    pixels = np.stack([column, row], axis=-1)
    light, frames = stripes()
    patterns = light.patterns()[frames[1:]]
    spp = max(1, int(PATH_SAMPLES * scale) // (2 * len(pixels)))
    large = case.enlarged()
    h, w = case.rig.camera.height, case.rig.camera.width
    halves = np.full((2, len(frames), h, w), np.nan)
    for half in range(2):
        seed = half << 32 | sum(map(ord, str(pixels.shape)))
        point, wide = (
            finite_aperture(
                large.scene.mitsuba,
                Lamp(large.rig, factor * large.aperture_radius_m, large.focus_m, patterns),
                large.guide,
                pixels,
                spp // factor**2,
                seed + factor,
            )[[0, 2, 3]]
            for factor in (1, 2)
        )
        halves[half][:, row, column] = point + (point - wide) / 3  # what the aperture does grows as its area
    return _reference(halves, masks)


def _reference(halves: np.ndarray, masks: dict[str, np.ndarray]) -> Reference:
    mean = halves.mean(0)
    error = {}
    for name, mask in masks.items():
        difference = 0.5 * (halves[0, 0] - halves[1, 0])[mask]
        error[name] = float(np.sqrt((difference**2).mean() / mask.sum()) / mean[0][mask].mean())
    return Reference(np.where(np.any(list(masks.values()), axis=0), mean, np.nan), error)


METHODS = {"ptracer": ptracer, "path": path}


def make(scale: float, case_names: list[str], methods: list[str]) -> None:
    """Compute and write references."""
    HERE.mkdir(exist_ok=True)
    for case_name in case_names:
        for name in methods:
            start = time.perf_counter()
            reference = METHODS[name](cases()[case_name], scale)
            error = np.array(json.dumps(reference.error))
            np.savez_compressed(_file(case_name, name), images=reference.images.astype(np.float32), error=error)
            print(f"{case_name:<22} {name:<8} {time.perf_counter() - start:4.0f} s, standard error of regions at most "
                  f"{max(reference.error.values()):.2%}", flush=True)  # fmt: skip


def load(case_name: str, name: str) -> Reference:
    """A reference that `make` wrote."""
    with np.load(_file(case_name, name)) as file:
        return Reference(file["images"], json.loads(str(file["error"])))


def _file(case_name: str, name: str) -> Path:
    return HERE / f"{case_name.replace(', ', '_').replace(' ', '_')}-{name}.npz"


def compare(options: dict[str, int]) -> dict[str, float]:
    """Print the table and return the figures of the last line; `options` are those of `transport`."""
    light, frames = stripes()
    errors, correlations = [], []
    print(f"{'case':<22} {'region':<30} {'reference':<9} {'error':>7} {'+-':>6}  correlation: white, columns, rows")
    for case_name, case in cases().items():
        signals = transport(case.scene, case.rig, [light], max_depth=MAX_DEPTH, glint=False, **options)
        ours = signals.frames(light)[frames]
        references = {name: load(case_name, name) for name in METHODS}
        for name, reference in references.items():
            for region, mask in seen(name, case).items():
                if name == "path" and region in references["ptracer"].error:
                    continue  # the two are compared below
                errors.append(float(ours[0][mask].mean() / reference.images[0][mask].mean() - 1))
                both = zip(ours[:, mask], reference.images[:, mask], strict=True)
                r = [float(np.corrcoef(a, b)[0, 1]) for a, b in both]
                correlations += r[1:]
                print(f"{case_name:<22} {region:<30} {name:<9} {errors[-1]:>+7.2%} {reference.error[region]:>6.2%}  "
                      + ", ".join(f"{x:.4f}" for x in r))  # fmt: skip
        _references_agree(case_name, case, references)
    return {"max_region_error": round(max(map(abs, errors)), 5), "min_stripe_correlation": round(min(correlations), 5)}


def _references_agree(case_name: str, case: Case, references: dict[str, Reference]) -> None:
    a, b = references["ptracer"], references["path"]
    masks = seen("ptracer", case)
    for region in masks.keys() & b.error.keys():
        mask = masks[region]
        ratio = b.images[0][mask].mean() / a.images[0][mask].mean()
        r = [float(np.corrcoef(x, y)[0, 1]) for x, y in zip(a.images[:, mask], b.images[:, mask], strict=True)]
        error = np.hypot(a.error[region], b.error[region])
        print(f"{case_name:<22} {region:<30} path : ptracer {ratio - 1:>+.2%} {error:>6.2%}  "
              + ", ".join(f"{x:.4f}" for x in r))  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=("make", "compare"), default="compare")
    parser.add_argument("--spp", type=int, default=argparse.SUPPRESS)
    parser.add_argument("--scale", type=float, default=1.0, help="of the samples of `make`")
    parser.add_argument("--case", choices=(names := list(cases())), help="of `make`, alone")
    parser.add_argument("--method", choices=METHODS, help="of `make`, alone")
    args = parser.parse_args()
    if args.what == "make":
        make(args.scale, [args.case] if args.case else names, [args.method] if args.method else list(METHODS))
    else:
        print(json.dumps(compare({k: v for k, v in vars(args).items() if k == "spp"})))


if __name__ == "__main__":
    main()
