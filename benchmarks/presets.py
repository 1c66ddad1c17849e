# SPDX-License-Identifier: Apache-2.0
"""Do the devices of `rangesim.presets` have the noise, the pixels, the view and the range of their data sheets?

Each device reads a matte wall that faces it, at the distances at which somebody published its noise. The emitter's
power, as it stands in the file of the device, was fitted at one of these distances (marked *); the others are
predictions. The wall is seen by a few pixels in the middle of the image. Where the emitter lights the whole field of
view, the light is computed in closed form; beams are traced.

For a figure that is an upper bound ("<="), noise below the bound counts as a ratio of 1. At mid-range, most pixels
have to give a reading, and none closer or farther than the sheet allows may.

`--fit` prints the power that makes the noise at the marked distance equal to the published one. Without a mark, it is
the least power with which the device reads a wall at the end of its range.

The last line is JSON:

    presets                 number of devices whose pixels, field of view and range agree with their sheet
    with_published_noise    number of devices with a published figure
    worst_noise_ratio       largest ratio of simulated and published noise, or its inverse, at all distances

Usage: python benchmarks/presets.py [--devices kinect-v2 ...] [--fit]
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any

import numpy as np

from rangesim import (
    Ambient,
    Intrinsics,
    RangeImage,
    Rig,
    Sensor,
    Status,
    StillSignals,
    decode,
    expose,
    load_scene,
    presets,
    transport,
)
from rangesim.environment.backend import select_variant
from rangesim.instrument.instrument import Instrument
from rangesim.presets import Preset, PublishedNoise
from rangesim.presets.preset import standing
from rangesim.response import LightPath, NumpyMath, Response, SparseResponse
from rangesim.rig import Camera, Fisheye, RayTable, ScanningCamera, Zones
from rangesim.robust_scale import sigma_from_median
from rangesim.sensors import ActiveStereo, ReferencePatternStereo
from rangesim.signals import EnergySplit, GroundTruth, Signals, SignalSet

PIXELS = 64
"""Pixels across and down that look at the wall: 4096 readings tell a standard deviation to 1 %."""
RAYS = 32
"""Beams across and down that look at the wall: 1024 readings tell a standard deviation to 2 %."""
STEREO_PIXELS = (320, 96)
"""Pixels of both cameras of a stereo device; twice the disparity of the nearest wall across."""
LEFT_PX, BORDER_PX = 136, 10
"""Columns at the left that no pixel of the other camera need match, and the reach of a window at the other sides."""
PHASES = (-0.359, -0.078, 0.203, 0.484)
"""Disparities of the wall of a stereo device, pixels from that of the stated distance: about even fractions of a pixel,
and of the steps of 1/8 pixel to which a Kinect v1 rounds."""
FINENESS = 4
"""Samples across a pixel of a stereo camera; its dots are at least a pixel wide."""
SPP = 16
"""Light paths of each traced beam. The wall is even, so its sampling error is far below the noise of the photons."""
REFLECTANCE = 0.8
"""Reflectance of the wall where no published figure states one: white paint, as in most data sheets."""
NEARLY_ALL = 0.95
"""Fraction of the pixels that read a wall at the end of the range of a device whose power is fitted to its range."""
MIN_VALID = 0.9
"""Least fraction of the pixels with a reading of a wall at mid-range."""
OUTLIER_SIGMAS = 6.0
"""Robust standard deviations from the median beyond which a reading is an outlier: a wrong match or a wrong wrap."""
MIN_SIGMA = 1e-4
"""Least robust standard deviation that counts, as a fraction of the distance. Readings that are rounded to steps may
have a median deviation of 0."""
MAX_BEYOND = 0.05
"""Largest fraction of the pixels with a reading of a wall that is too near or too far: noise that reaches into the
range, noise that is taken for a wall, wrong matches."""
POWERS_W = (1e-6, 1e4)
"""Powers between which `--fit` searches."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", nargs="+", choices=presets.names(), default=presets.names())
    parser.add_argument("--fit", action="store_true", help="print the fitted power of each device and end")
    args = parser.parse_args()
    found = [presets.describe(name) for name in args.devices]
    if args.fit:
        for preset in found:
            if standing(preset.sources["instrument.power_w"]) == "fitted":
                print(f"{preset.name:28s}power_w = {fitted_power_w(preset):.3g}", flush=True)
        return
    agree, ratios = 0, []
    for preset in found:
        faults = contradictions(preset)
        agree += not faults
        print(f"{preset.name}: {'as its sheet' if not faults else '; '.join(faults)}")
        ratios += noise_ratios(preset)
    published = sum(preset.sheet.noise is not None for preset in found)
    worst = round(max(ratios, default=math.nan), 3)
    print(json.dumps({"presets": agree, "with_published_noise": published, "worst_noise_ratio": worst}))


def noise_ratios(preset: Preset) -> list[float]:
    """Ratio, or its inverse, of simulated and published noise at each distance; prints a line for each."""
    noise = preset.sheet.noise
    if noise is None:
        print("    no published figure")
        return []
    ratios, simulated = [], []
    for distance_m, published_m in zip(noise.range_m, noise.sigma_m, strict=True):
        sigma_m, valid = noise_at_m(preset.instrument, distance_m, noise)
        simulated.append(sigma_m)
        simulated_ratio = sigma_m / published_m
        worst = max(simulated_ratio, 1.0 if noise.is_bound else 1 / simulated_ratio)
        ratios.append(math.inf if math.isnan(worst) else worst)  # no reading where there should be one
        mark, relation = "*" if distance_m == noise.fitted_at_m else " ", "<=" if noise.is_bound else "  "
        print(
            f"    {distance_m:7.2f} m{mark} published {relation} {1e3 * published_m:7.2f} mm  "
            f"simulated {1e3 * sigma_m:7.2f} mm  ratio {simulated_ratio:5.2f}  readings {valid:4.0%}"
        )
    if len(noise.range_m) > 1:
        slope = math.log(simulated[-1] / simulated[0]) / math.log(noise.range_m[-1] / noise.range_m[0])
        print(f"    exponent of the distance: published {noise.slope:.2f}, simulated {slope:.2f}")
    return ratios


def contradictions(preset: Preset) -> list[str]:
    """What of the instrument does not agree with the sheet, in words."""
    sheet, faults = preset.sheet, []
    camera = preset.instrument.camera
    assert camera is not None
    if (camera.width, camera.height) != sheet.resolution_px:
        faults.append(f"{camera.width} x {camera.height} pixels instead of {sheet.resolution_px}")
    view = field_of_view_deg(camera)
    if not np.allclose(view, sheet.field_of_view_deg, rtol=0.02):
        faults.append(f"field of view {view} instead of {sheet.field_of_view_deg}")
    near_m, far_m = sheet.range_m
    middle_m = math.sqrt(max(near_m, 0.01) * far_m)
    valid = of_wall(preset.instrument, middle_m, REFLECTANCE, 0.0).valid.mean()
    if valid < MIN_VALID:
        faults.append(f"readings in {valid:.0%} of the pixels at {middle_m:.2f} m")
    for distance_m in (0.9 * near_m, 1.1 * far_m):
        valid = of_wall(preset.instrument, distance_m, REFLECTANCE, 0.0).valid.mean() if distance_m > 0 else 0.0
        if valid > MAX_BEYOND:
            faults.append(f"readings in {valid:.0%} of the pixels at {distance_m:.2f} m, outside its range")
    return faults


def field_of_view_deg(camera: Camera) -> tuple[float, float]:
    """Full angles across and down, degrees: of an image between its edges, of a scanner between its outermost rays."""
    if isinstance(camera, Intrinsics):
        x = np.degrees(np.arctan([camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx])).sum()
        y = np.degrees(np.arctan([camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy])).sum()
        return float(x), float(y)
    if isinstance(camera, Zones):
        return field_of_view_deg(camera.camera)
    if isinstance(camera, Fisheye):
        return float(np.degrees(camera.width / camera.fx)), float(np.degrees(camera.height / camera.fy))
    x, y, z = np.moveaxis(camera.pixel_rays().directions, -1, 0)
    azimuth, elevation = np.degrees(np.arctan2(x, z)), np.degrees(np.arcsin(-y))
    across = np.ptp(np.unwrap(azimuth, axis=1, period=360), axis=1)
    is_whole_turn = across.min() > 360 * (1 - 1.5 / camera.width)
    return 360.0 if is_whole_turn else float(np.ptp(azimuth)), float(np.ptp(elevation))


def fitted_power_w(preset: Preset) -> float:
    """Power at which the noise at the marked distance is the published one; without such a mark, the least power at
    which nearly all pixels read a wall at the end of the range."""
    noise, far_m = preset.sheet.noise, preset.sheet.range_m[1]
    reflectance, sunlight_lux = (noise.reflectance, noise.sunlight_lux) if noise else (REFLECTANCE, 0.0)
    distance_m = noise.fitted_at_m if noise and noise.fitted_at_m else far_m
    wanted_m = noise.sigma_m[noise.range_m.index(distance_m)] if noise and noise.fitted_at_m else math.inf
    low, high = np.log(POWERS_W)
    for _ in range(30):
        middle = (low + high) / 2
        instrument = replace(unlimited(preset.instrument), power_w=float(np.exp(middle)))
        image = of_wall(instrument, distance_m, reflectance, sunlight_lux)
        is_bright = (image.status == Status.SATURATED).mean() > 0.5
        is_weak = (
            image.valid.mean() < (0.5 if math.isfinite(wanted_m) else NEARLY_ALL)
            or scatter_m(image.z[image.valid], distance_m) > wanted_m
        )
        low, high = (middle, high) if is_weak and not is_bright else (low, middle)
    return float(np.exp((low + high) / 2))


def unlimited(instrument: Instrument) -> Instrument:
    """The device without its limits of range, which cut off half of the readings of a wall at a limit."""
    assert instrument.decoder is not None
    return replace(instrument, decoder=replace(instrument.decoder, working_range=None))  # type: ignore[call-arg]


def noise_at_m(instrument: Instrument, distance_m: float, noise: PublishedNoise) -> tuple[float, float]:
    """Standard deviation of the readings of a wall, metres, and the fraction of the pixels with a reading.

    The error of a stereo camera depends on the fraction of a pixel that the disparity has. So its wall stands at
    several places, over a pixel of disparity, whose errors are scaled to the distance.
    """
    places = [distance_m]
    if isinstance(instrument.sensor, (ActiveStereo, ReferencePatternStereo)):
        assert isinstance(instrument.camera, Intrinsics)
        one_px_m = instrument.camera.fx * instrument.sensor.baseline_m
        places = [one_px_m / (one_px_m / distance_m + phase) for phase in PHASES]
    errors, valid = [], []
    for place in places:
        image = of_wall(unlimited(instrument), place, noise.reflectance, noise.sunlight_lux)
        errors.append((image.z[image.valid].astype(np.float64) - place) * (distance_m / place) ** 2)
        valid.append(image.valid.mean())
    return scatter_m(np.concatenate(errors), distance_m), float(np.mean(valid))


def scatter_m(errors_m: np.ndarray, distance_m: float) -> float:
    """Standard deviation of errors (n,) without outliers, metres; NaN without readings."""
    if not len(errors_m):
        return math.nan
    middle = float(np.median(errors_m))
    sigma_m = max(sigma_from_median(errors_m, middle), MIN_SIGMA * distance_m)
    return float(errors_m[np.abs(errors_m - middle) <= OUTLIER_SIGMAS * sigma_m].std())


def of_wall(instrument: Instrument, distance_m: float, reflectance: float, sunlight_lux: float) -> RangeImage:
    """Range image of a matte wall that faces the device, by pixels in the middle of its view."""
    sun = Ambient("sun", illuminance_lux=sunlight_lux) if sunlight_lux else None
    daylight_w_m2 = 1.0 if sunlight_lux else 0.0
    sensor, rig = instrument.sensor, rig_of(instrument)
    if not isinstance(rig.projector, Intrinsics):
        signals: Signals = traced_wall(instrument, distance_m, reflectance, daylight_w_m2)
    elif sensor.compares_texture:
        signals = SignalSet.of([patterned_wall(r, sensor, distance_m, reflectance) for r in sensor.rigs(rig)])
        signals = signals if sensor.n_cameras > 1 else signals[0]
    else:
        signals = flooded_wall(rig, sensor, distance_m, reflectance, daylight_w_m2)
    capture = expose(signals, sensor, instrument.detector, instrument.exposure_s, seed=0, ambient=sun)
    image = decode(capture, instrument.decoder)
    return inner(image) if sensor.compares_texture else image


def inner(image: RangeImage) -> RangeImage:
    """The part of a stereo image in which no window reaches beyond either image."""
    part = slice(BORDER_PX, -BORDER_PX), slice(LEFT_PX, -BORDER_PX)
    names = ("z", "range_m", "confidence", "status", "intensity")
    return replace(image, camera=None, T_world_camera=None, **{name: getattr(image, name)[part] for name in names})


def rig_of(instrument: Instrument) -> Rig:
    """The rig of a device at the origin, with few pixels, all of which look along z or nearly so."""
    camera = instrument.camera
    assert camera is not None
    assert instrument.projector is not None
    width, height = STEREO_PIXELS if instrument.sensor.compares_texture else (PIXELS, PIXELS)
    middle = {"width": width, "height": height, "cx": width / 2, "cy": height / 2}
    if isinstance(camera, (Intrinsics, Fisheye)):
        camera = replace(camera, **middle)
    else:
        ahead = np.tile([0.0, 0.0, 1.0], (RAYS, RAYS, 1))
        camera = RayTable(ahead, field_rad=field_rad(camera), acceptance=camera.acceptance)
    pose = np.eye(4) if instrument.T_camera_projector is None else instrument.T_camera_projector
    return Rig(
        camera,
        instrument.projector,
        T_camera_projector=pose,
        camera_lens=instrument.camera_lens,
        projector_lens=instrument.projector_lens,
        projector_power_w=instrument.power_w,
        wavelength_m=instrument.emitter_wavelength_m,
    )


def field_rad(camera: Camera) -> tuple[float, float]:
    """Full widths of the field of a ray of a scanner, or of the zone in the middle, radians."""
    if isinstance(camera, ScanningCamera):
        return camera.field_rad
    across, down = np.linalg.norm(camera.pixel_rays().steps[camera.height // 2, camera.width // 2], axis=-1)
    return float(across), float(down)


@lru_cache(maxsize=64)  # the search for a power asks for the same wall again
def bright_wall(instrument: Instrument, distance_m: float, reflectance: float, daylight_w_m2: float) -> StillSignals:
    """Signals of the wall that beams of 1 W light, traced."""
    import mitsuba as mi

    select_variant()
    to_world = mi.ScalarTransform4f()
    size = max(1.0, 0.1 * distance_m)
    parts: dict[str, Any] = {
        "sensor": {"type": "perspective", "to_world": to_world.look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])},
        "wall": {
            "type": "rectangle",
            "to_world": to_world.translate([0, 0, distance_m]).scale([size, size, -1]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": reflectance}},
        },
    }
    if daylight_w_m2:
        light = {"type": "spectrum", "value": daylight_w_m2 / np.pi}
        parts["sky"] = {"type": "constant", "radiance": light}
    scene = load_scene({"type": "scene", **parts})
    return transport(scene, rig_of(instrument), [instrument.sensor], spp=SPP, max_depth=2, caustics=False, glint=False)


def traced_wall(instrument: Instrument, distance_m: float, reflectance: float, daylight_w_m2: float) -> StillSignals:
    """Signals of the wall that beams light: traced once for 1 W, and scaled."""
    one = bright_wall(replace(instrument, power_w=1.0), distance_m, reflectance, daylight_w_m2)
    factor, energy = np.float32(instrument.power_w), one.energy
    kinds = {f.name: factor * getattr(energy, f.name) for f in fields(energy) if f.name != "ambient"}
    return replace(
        one,
        rig=replace(one.rig, projector_power_w=instrument.power_w),
        energy=replace(energy, **kinds),
        channels={response: factor * values for response, values in one.channels.items()},
        sampling=None,
    )


def patterned_wall(rig: Rig, sensor: Sensor, distance_m: float, reflectance: float) -> StillSignals:
    """Signals of the wall under a pattern, in closed form; each pixel is the mean over its area."""
    camera, n = rig.camera, FINENESS
    assert isinstance(camera, Intrinsics)
    fine = Intrinsics(n * camera.width, n * camera.height, n * camera.fx, n * camera.fy, n * camera.cx, n * camera.cy)
    seen = flooded_wall(replace(rig, camera=fine), sensor, distance_m, reflectance, 0.0)
    coarse = flooded_wall(rig, sensor, distance_m, reflectance, 0.0)
    blocks = (camera.height, n, camera.width, n)
    means = {r: c.reshape(len(c), *blocks).mean(axis=(2, 4)) for r, c in seen.channels.items()}
    return replace(coarse, channels=means)


def flooded_wall(rig: Rig, sensor: Sensor, distance_m: float, reflectance: float, daylight_w_m2: float) -> StillSignals:
    """Signals of the wall that the emitter lights at once, in closed form: direct light, and broadband daylight of an
    irradiance on the wall."""
    emitter = rig.projector
    assert isinstance(emitter, Intrinsics)
    rays = rig.camera.pixel_rays().directions
    points = rays / rays[..., 2:] * distance_m
    in_projector = (points - rig.T_camera_projector[:3, 3]) @ rig.T_camera_projector[:3, :3]
    uv, range_m = emitter.project(in_projector), np.linalg.norm(points, axis=-1)
    out_m = np.linalg.norm(in_projector, axis=-1)
    with np.errstate(invalid="ignore"):
        lit = ((uv >= 0) & (uv <= [emitter.width, emitter.height])).all(axis=-1)
    cosine = (distance_m - rig.T_camera_projector[2, 3]) / out_m  # of the wall's normal and the light
    irradiance = rig.projector_irradiance * (out_m / in_projector[..., 2]) ** 3 / out_m**2 * cosine
    radiance = np.where(lit, reflectance / np.pi * irradiance, 0.0)
    path = LightPath(*(np.nan_to_num(a) * lit for a in (uv[..., 0], uv[..., 1], range_m + out_m)), lit)
    channels = {r: weighted(r, path, radiance) for r in sensor.responses()}
    zero = np.zeros(radiance.shape, dtype=np.float32)
    ambient = zero + np.float32(reflectance / np.pi * daylight_w_m2)
    energy = EnergySplit(radiance.astype(np.float32), zero, zero, zero, zero, ambient)
    truth = GroundTruth(
        z=zero + np.float32(distance_m),
        range_m=range_m.astype(np.float32),
        normal=np.tile(np.float32([0, 0, -1]), (*radiance.shape, 1)),
        instance=np.zeros(radiance.shape, dtype=np.int32),
        material=np.zeros(radiance.shape, dtype=np.int32),
        projector_uv=uv.astype(np.float32),
        projector_visible=lit,
        instance_names=("wall",),
        material_names=("matte",),
    )
    return StillSignals(rig, energy, truth, channels=channels)


def weighted(response: Response, path: LightPath, radiance: np.ndarray) -> np.ndarray:
    """(c, h, w) float32, W/m2/sr, what the channels of a response read of the direct light."""
    if isinstance(response, SparseResponse):
        weights = response.bin_weights(path, NumpyMath())
        bins: Sequence[Any] = range(response.channels)
        return np.stack([sum(np.where(i == b, radiance * w, 0) for i, w in weights) for b in bins]).astype(np.float32)
    return np.stack([radiance * w for w in response.weights(path, NumpyMath())]).astype(np.float32)  # type: ignore[attr-defined]


if __name__ == "__main__":
    main()
