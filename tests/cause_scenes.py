# SPDX-License-Identifier: Apache-2.0
"""Small scenes, each of which makes a sensor fail in one way, and for every failed pixel the cause decided without
the rules of `rangesim.causes`: from the energy split of the scene, from its geometry on paper, or by taking the cause
away and looking whether the pixel is healed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rangesim
from rangesim import AmcwToF, Capture, Detector, RangeImage, Rig, Scene, Signals, StructuredLight, transport
from rangesim.causes import Cause
from rangesim.decoding.working_range import WorkingRange
from rangesim.electronics.spad import SpadDetector
from rangesim.environment.backend import select_variant
from rangesim.errors import RangesimWarning
from rangesim.motion import ConstantTwist, Motion, Timing, transport_moving
from rangesim.response import Dots
from rangesim.rig import CoverGlass
from rangesim.sensors import ActiveStereo, DirectToF

SCENES = Path(__file__).resolve().parent.parent / "scenes"
SIZE = {"width": 80, "height": 60}
TOLERANCE_M = 0.01
MATTE = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
SILVER = {"type": "twosided", "bsdf": {"type": "conductor", "eta": 0.04, "k": 5.8}}


@dataclass(frozen=True, eq=False)
class Case:
    """signals, capture, image : of a sensor in a scene. decided : (h, w) `Cause`, of the failed pixels at least."""

    signals: Signals
    capture: Capture
    image: RangeImage
    decided: np.ndarray

    @property
    def failed(self) -> np.ndarray:
        """(h, w) bool."""
        return np.isfinite(self.signals.truth.z) & ~right(self.image, self.signals)


def right(image: RangeImage, signals: Signals) -> np.ndarray:
    """(h, w) bool, a reading to the tolerance."""
    return np.asarray(np.abs(image.z - signals.truth.z) <= TOLERANCE_M)


def room(**shapes: Any) -> Scene:
    """A camera at the origin that looks along z, and these shapes."""
    import mitsuba as mi

    select_variant()
    camera = {
        "type": "perspective",
        "fov": 40.0,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0]),
        "film": {"type": "hdrfilm", **SIZE},
    }
    return rangesim.load_scene({"type": "scene", "sensor": camera, **shapes})


def rig_of(scene: Scene, baseline_m: float) -> Rig:
    """Camera and a projector whose pixels are about as coarse as the camera's."""
    return scene.rig(baseline_m, (256, 160), **SIZE)


def board(x: float, y: float, z: float, half: float, bsdf: dict[str, Any] = MATTE, turn_deg: float = 0.0) -> Any:
    """A square that faces the camera, turned about its vertical axis."""
    import mitsuba as mi

    select_variant()
    T = mi.ScalarTransform4f
    place = T().translate([x, y, z]).rotate([0, 1, 0], 180 + turn_deg).scale(half)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def measure(
    signals: Signals, sensor: Any, detector: Any = None, exposure_s: float | None = None
) -> tuple[Capture, RangeImage]:
    """Capture and range image."""
    capture = rangesim.expose(signals, sensor, detector, exposure_s, seed=5)
    return capture, rangesim.decode(capture)


def case(
    signals: Signals, sensor: Any, detector: Any, decide: Callable[[Capture, RangeImage], list[tuple[Any, Cause]]]
) -> Case:
    """What `sensor` makes of the signals; `decide` lists masks and causes, of which the first that holds counts."""
    capture, image = measure(signals, sensor, detector)
    masks, causes = zip(*decide(capture, image), strict=True)
    shape = image.z.shape
    decided = np.select([np.broadcast_to(m, shape) for m in masks], causes, default=Cause.NONE)
    return Case(signals, capture, image, decided)


def is_instance(signals: Signals, name: str) -> np.ndarray:
    """(h, w) bool, pixels whose centre sees this shape."""
    return np.asarray(signals.truth.instance == signals.truth.instance_names.index(name))


def crossed(signals: Signals, x: float, y: float, z: float, half: float) -> np.ndarray:
    """(h, w) bool, pixels that the outline of an upright `board` runs through, by projecting it."""
    camera = signals.rig.camera
    corners = np.array([[x + sx * half, y + sy * half, z] for sx in (-1, 1) for sy in (-1, 1)])
    in_camera = (corners - signals.rig.T_world_camera[:3, 3]) @ signals.rig.T_world_camera[:3, :3]
    low, high = (f(camera.project(in_camera), axis=0) for f in (np.min, np.max))
    pixel = camera.pixel_centres()
    touched = ((pixel > low - 0.5) & (pixel < high + 0.5)).all(axis=-1)
    inside = ((pixel > low + 0.5) & (pixel < high - 0.5)).all(axis=-1)
    return np.asarray(touched & ~inside)


# ---- Geometry ---------------------------------------------------------------------------------------


def shadowed() -> Case:
    """Structured light on a board before a wall: no direct light beside the board."""
    scene = room(wall=board(0, 0, 1.5, 2), board=board(0.05, 0.02, 1.0, 0.2))
    sensor = StructuredLight(256, 160)
    signals = transport(scene, rig_of(scene, 0.3), [sensor], spp=64, max_depth=2)
    lit = np.where(is_instance(signals, "board"), 1.0**-2, 1.5**-2)  # irradiance falls with the square of depth
    dark = signals.energy.direct < 0.6 * lit * np.max(signals.energy.direct / lit)
    edge = crossed(signals, 0.05, 0.02, 1.0, 0.2)
    none = signals.energy.direct == 0
    known = [(none, Cause.SHADOWED), (edge, Cause.DEPTH_EDGE), (dark, Cause.SHADOWED)]
    return case(signals, sensor, Detector(), lambda c, i: known)


def depth_edge() -> Case:
    """An AMCW camera on the same board: pixels that its outline runs through, of direct light alone."""
    scene = room(wall=board(0, 0, 1.5, 2), board=board(0.05, 0.02, 1.0, 0.2))
    sensor = AmcwToF()
    signals = transport(scene, scene.rig(0.005, **SIZE), [sensor], spp=64, max_depth=2)
    edge = crossed(signals, 0.05, 0.02, 1.0, 0.2)
    detector = Detector.time_of_flight()
    return case(signals, sensor, detector, lambda c, i: [(edge, Cause.DEPTH_EDGE), (True, Cause.SHADOWED)])


def motion() -> Case:
    """A board that comes nearer while the patterns are shown; healed when it stands still."""
    scene = room(wall=board(0, 0, 1.5, 2), board=board(0.05, 0.02, 1.0, 0.2))
    sensor = StructuredLight(256, 160)
    rig = rig_of(scene, 0.3)
    timing = Timing(frame_period_s=1 / 60)
    timing = replace(timing, start_s=-timing.reference_s(sensor, rig.camera))
    options = {"spp": 64, "max_depth": 2}
    moves = Motion({"board": ConstantTwist((0.0, 0.0, -0.3))})
    signals = transport_moving(scene, rig, {sensor: timing}, moves, **options)[sensor]
    at_rest = transport(scene, rig, [sensor], **options)
    healed = right(measure(at_rest, sensor, Detector())[1], at_rest)
    shift = 0.5 * 0.3 * (sensor.n_frames - 1) / 60
    passes = np.any([crossed(signals, 0.05, 0.02, 1.0 + dz, 0.2) for dz in np.linspace(-shift, shift, 50)], axis=0)
    none = at_rest.energy.direct == 0
    ends = (transport(room(wall=board(0, 0, 1.5, 2), board=board(0.05, 0.02, 1.0 + dz, 0.2)), rig, [], **options)
            for dz in (-shift, shift))  # fmt: skip
    near, far = (s.energy.direct for s in ends)
    swept = np.abs(near - far) > 0.05 * far.max()  # the shadow's edge has passed, or the board's
    known = [(none, Cause.SHADOWED), (healed | passes | swept, Cause.MOTION)]
    with pytest.warns(RangesimWarning, match="contradict the Gray code .* whether something moved"):
        return case(signals, sensor, Detector(), lambda c, i: known)


# ---- Surfaces that pass the light on ----------------------------------------------------------------


def specular_away() -> Case:
    """A mirror that sends the light into the dark: hardly any light of any kind returns."""
    scene = room(wall=board(-0.5, 0, 1.5, 0.6), mirror=board(0.25, 0, 1.2, 0.2, SILVER, turn_deg=35))
    sensor = StructuredLight(256, 160)
    signals = transport(scene, rig_of(scene, 0.3), [sensor], spp=64)
    return case(signals, sensor, Detector(), lambda c, i: mirror_by_energy(signals))


def mirrored_ghost() -> Case:
    """A wall and its image in a mirror on the floor: time of flight reads the image, beneath the floor."""
    import mitsuba as mi

    select_variant()
    floor = mi.ScalarTransform4f().translate([0, -0.3, 1.0]).rotate([1, 0, 0], -90).scale([0.5, 0.3, 1])
    mirror = {"type": "rectangle", "to_world": floor, "bsdf": SILVER}
    scene = room(wall=board(0, 0, 1.5, 0.6), mirror=mirror)
    sensor = AmcwToF()
    signals = transport(scene, scene.rig(0.03, **SIZE), [sensor], spp=64)
    plain = transport(scene, scene.rig(0.03, **SIZE), [sensor], spp=64, caustics=False)
    detector = Detector.time_of_flight()
    healed = right(measure(plain, sensor, detector)[1], plain)
    known = [(healed, Cause.CAUSTIC), *mirror_by_energy(signals)]
    return case(signals, sensor, detector, lambda c, i: known)


def mirror_by_energy(signals: Signals) -> list[tuple[Any, Cause]]:
    """On the mirror, whose own direct light is none: a hundredth of the light of the wall is a ghost, or the wall's
    where it is direct. Off it: shadow without direct light, or edges."""
    e = signals.energy
    mirror = is_instance(signals, "mirror")
    off_mirror = e.specular + e.caustic + e.multipath
    little = 0.01 * np.median(e.direct[e.direct > 0])
    return [
        (mirror & (e.direct > little) & (e.direct > off_mirror), Cause.DEPTH_EDGE),
        (mirror & (e.projector > little), Cause.MIRRORED_GHOST),
        (mirror, Cause.SPECULAR_AWAY),
        (e.direct == 0, Cause.SHADOWED),
        (True, Cause.DEPTH_EDGE),
    ]


def seen_through() -> Case:
    """A pane of glass before a wall: no light of the pane's own, and time of flight reads the wall behind."""
    pane = board(0.05, 0.0, 1.0, 0.2, {"type": "thindielectric"}, turn_deg=20)
    scene = room(wall=board(0, 0, 1.5, 2), pane=pane)
    sensor = AmcwToF()
    # Photons are gathered over a disc, and fewer of them over a larger one, which blurs the edges of the caustic.
    signals = transport(scene, scene.rig(0.03, **SIZE), [sensor], spp=64)
    e = signals.energy
    on_pane = is_instance(signals, "pane") & (e.direct < 0.5 * e.projector)
    known = [(on_pane, Cause.SEEN_THROUGH), (e.caustic > 0.5 * e.projector, Cause.CAUSTIC), (True, Cause.DEPTH_EDGE)]
    return case(signals, sensor, Detector.time_of_flight(), lambda c, i: known)


# ---- Other light ------------------------------------------------------------------------------------


def multipath() -> Case:
    """An AMCW camera in a corner; healed where light is followed for one bounce alone."""
    scene = rangesim.load_scene(SCENES / "corner.xml")
    sensor, detector = AmcwToF((20e6,)), Detector.time_of_flight()
    rig = scene.rig(0.03, **SIZE)
    signals = transport(scene, rig, [sensor], spp=64, max_depth=8)
    exposure_s = measure(signals, sensor, detector)[0].exposure_s
    direct = transport(scene, rig, [sensor], spp=64, max_depth=2)
    healed = right(measure(direct, sensor, None)[1], direct)
    return case(signals, sensor, detector, lambda c, i: [(healed, Cause.MULTIPATH), (exposure_s < 0, Cause.NONE)])


def caustic() -> Case:
    """A mirror beside a wall throws light onto it: an AMCW camera reads the detour; healed without photons."""
    scene = room(wall=board(0, 0, 1.5, 2), mirror=board(0.45, 0, 1.2, 0.25, SILVER, turn_deg=80))
    sensor, detector = AmcwToF(), Detector.time_of_flight()
    options = {"spp": 64, "max_depth": 4}
    signals = transport(scene, scene.rig(0.03, **SIZE), [sensor], **options)
    plain = transport(scene, scene.rig(0.03, **SIZE), [sensor], caustics=False, **options)
    healed = right(measure(plain, sensor, None)[1], plain)
    known = [(is_instance(signals, "wall") & healed, Cause.CAUSTIC), *mirror_by_energy(signals)]
    return case(signals, sensor, detector, lambda c, i: known)


def glint() -> Case:
    """A polished knob before a wall, exposed for the wall: more electrons than the well holds where it shines."""
    knob = {"type": "sphere", "center": [0, 0, 1.0], "radius": 0.15}
    knob["bsdf"] = {"type": "roughconductor", "eta": 2.9, "k": 3.3, "alpha": 0.08}
    scene = room(wall=board(0, 0, 1.5, 2), knob=knob)
    sensor = StructuredLight(256, 160)
    signals = transport(scene, rig_of(scene, 0.3), [sensor], spp=64, max_depth=2)
    return case(signals, sensor, Detector(), lambda c, i: glint_by_energy(signals, c))


def glint_by_energy(signals: Signals, capture: Capture) -> list[tuple[Any, Cause]]:
    detector = capture.detector
    assert isinstance(detector, Detector)
    electrons = signals.energy.projector * detector.electron_rate_per_radiance(signals.rig) * capture.exposure_s
    knob = is_instance(signals, "knob")
    unlit = ~signals.truth.projector_visible & (signals.energy.direct == 0)
    known = [(electrons > detector.full_well_e, Cause.GLINT), (unlit, Cause.SHADOWED)]
    steps = [np.roll(knob, step, axis=(0, 1)) != knob for step in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    outline = np.any(steps, axis=0)
    wall = np.median(signals.energy.direct[~knob])
    some_wall = outline & (signals.energy.direct > 0.1 * wall)
    dim = knob & ~some_wall & (signals.energy.direct < 0.5 * wall)  # though much nearer
    return [*known, (dim, Cause.SPECULAR_AWAY), (outline, Cause.DEPTH_EDGE), (True, Cause.SHADOWED)]


# ---- Noise and decoder ------------------------------------------------------------------------------


def low_signal() -> Case:
    """A wall under a weak lamp; healed by a thousand times the power."""
    scene = room(wall=board(0, 0, 1.5, 2))
    sensor, detector = StructuredLight(256, 160), Detector()
    rig = replace(rig_of(scene, 0.3), projector_power_w=4e-4)
    signals = transport(scene, rig, [sensor], spp=64)
    bright = transport(scene, replace(rig, projector_power_w=0.4), [sensor], spp=64)
    healed = right(measure(bright, sensor, detector)[1], bright)
    return timed_case(signals, sensor, detector, 0.01, [(healed, Cause.LOW_SIGNAL)])


def pile_up() -> Case:
    """A wall under so strong a laser that every pulse brings photons before the peak; healed by less power."""
    scene = room(wall=board(0, 0, 1.5, 2))
    sensor, detector = DirectToF(), SpadDetector(bits=16)
    rig = replace(scene.rig(0.02, **SIZE), projector_power_w=100.0)
    signals, weak = (
        transport(scene, replace(rig, projector_power_w=power_w), [sensor], spp=64) for power_w in (100.0, 1.0)
    )
    healed = right(measure(weak, sensor, detector, 1e-3)[1], weak)
    return timed_case(signals, sensor, detector, 1e-3, [(healed, Cause.PILE_UP)])


def cover_glass() -> Case:
    """An AMCW camera behind a smeared window, a wall at 1.5 m; healed without the window."""
    scene = room(wall=board(0, 0, 1.5, 2))
    sensor, detector = AmcwToF(), Detector.time_of_flight()
    signals = transport(scene, replace(scene.rig(0.03, **SIZE), cover_glass=CoverGlass(1e-10)), [sensor], spp=64)
    exposure_s = measure(signals, sensor, detector)[0].exposure_s
    bare = replace(signals, rig=replace(signals.rig, cover_glass=None))
    healed = right(measure(bare, sensor, detector, exposure_s)[1], bare)
    return case(signals, sensor, detector, lambda c, i: [(healed, Cause.COVER_GLASS)])


def stray_light() -> Case:
    """An AMCW camera whose lens scatters 5 % of the light, a board at 0.5 m before a wall at 1.6 m; healed by a clean
    lens."""
    scene = room(near=board(-0.2, 0, 0.5, 0.2), wall=board(0, 0, 1.6, 2))
    sensor, detector = AmcwToF(), Detector.time_of_flight()
    clean = scene.rig(1e-6, **SIZE)
    signals = transport(scene, clean, [sensor], spp=64, max_depth=2)
    veiled = replace(signals, rig=replace(clean, camera_lens=replace(clean.camera_lens, stray_light=0.05)))
    exposure_s = measure(signals, sensor, detector)[0].exposure_s
    healed = right(measure(signals, sensor, detector, exposure_s)[1], signals)
    return timed_case(
        veiled, sensor, detector, exposure_s, [(healed, Cause.STRAY_LIGHT), (np.ones_like(healed), Cause.DEPTH_EDGE)]
    )


def occluded() -> Case:
    """Active stereo on a wall, whose left border the second camera does not see; the other pixels are right, but for
    windows that the border cuts."""
    scene = room(wall=board(0, 0, 1.0, 2))
    sensor = ActiveStereo(Dots(256, 160, spacing_px=12.0, dot_px=2.5), baseline_m=0.2)
    signals = transport(scene, sensor.rigs(rig_of(scene, 0.1)), [sensor], spp=64, max_depth=2)
    second = signals[1].rig
    place = second.camera.project(points_of(signals) @ second.T_world_camera[:3, :3] + origin_of(second))
    outside = ~((place >= 0) & (place <= [SIZE["width"], SIZE["height"]])).all(axis=-1)
    return case(signals, sensor, Detector(), lambda c, i: [(outside, Cause.OCCLUDED), (True, Cause.RESOLUTION)])


def no_texture() -> Case:
    """Passive stereo on a white wall in room light; healed by a wall with texture."""
    import mitsuba as mi

    select_variant()
    grey = np.random.default_rng(0).uniform(0.1, 0.9, (256, 256, 1)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(grey), "raw": True}
    painted = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}
    lamp = {"type": "constant", "radiance": 1.0}
    sensor = ActiveStereo(None, baseline_m=0.2)
    scenes = room(wall=board(0, 0, 1.0, 2), room=lamp), room(wall=board(0, 0, 1.0, 2, painted), room=lamp)
    signals, on_texture = (
        transport(s, sensor.rigs(rig_of(s, 0.1)), [sensor], spp=64, max_depth=2, caustics=False) for s in scenes
    )
    healed = right(measure(on_texture, sensor, Detector())[1], on_texture)
    second = signals[1].rig
    place = second.camera.project(points_of(signals) @ second.T_world_camera[:3, :3] + origin_of(second))
    outside = ~((place >= 0) & (place <= [SIZE["width"], SIZE["height"]])).all(axis=-1)
    assert healed[~outside].mean() > 0.95  # not where the border cuts the window
    return case(signals, sensor, Detector(), lambda c, i: [(outside, Cause.OCCLUDED), (True, Cause.NO_TEXTURE)])


def points_of(signals: Signals) -> np.ndarray:
    """(h, w, 3) true points in the world, metres."""
    rig = signals.rig
    rays = rig.camera.directions(rig.camera.pixel_centres())
    return np.asarray((rays * signals.truth.z[..., None]) @ rig.T_world_camera[:3, :3].T + rig.T_world_camera[:3, 3])


def origin_of(rig: Rig) -> np.ndarray:
    """(3,) origin of the world in coordinates of a camera, metres."""
    return np.asarray(np.linalg.inv(rig.T_world_camera)[:3, 3])


def ambient() -> Case:
    """A wall in sunlight; healed in the dark, with the same exposure."""
    lamp = {"type": "constant", "radiance": 60.0}
    scene, dark_scene = room(wall=board(0, 0, 1.5, 2), sun=lamp), room(wall=board(0, 0, 1.5, 2))
    sensor, detector = AmcwToF(), Detector.time_of_flight()
    exposure_s = 8e-4
    signals, dark = (transport(s, s.rig(0.03, **SIZE), [sensor], spp=64) for s in (scene, dark_scene))
    healed = right(measure(dark, sensor, detector, exposure_s)[1], dark)
    return timed_case(signals, sensor, detector, exposure_s, [(healed, Cause.AMBIENT)])


def range_ambiguity() -> Case:
    """A wall beyond the unambiguous range of one frequency; healed by a lower one."""
    scene = room(wall=board(0, 0, 3.0, 4), post=board(0.3, 0, 1.5, 0.2))
    sensor, slow, detector = AmcwToF((80e6,)), AmcwToF((20e6,)), Detector.time_of_flight()
    signals = transport(scene, scene.rig(0.001, **SIZE), [sensor, slow], spp=64, max_depth=2)
    healed = right(measure(signals, slow, None)[1], signals)
    with pytest.warns(RangesimWarning, match="that no surface is beyond 1.874 m"):
        return case(signals, sensor, detector, lambda c, i: [(healed, Cause.RANGE_AMBIGUITY), (True, Cause.DEPTH_EDGE)])


def out_of_range() -> Case:
    """A wall beyond the range that the device promises; healed by a decoder that promises nothing."""
    scene = room(wall=board(0, 0, 3.0, 4), post=board(0.3, 0, 1.5, 0.2))
    sensor = AmcwToF((80e6, 16e6))
    signals = transport(scene, scene.rig(0.001, **SIZE), [sensor], spp=64, max_depth=2)
    capture, unlimited = measure(signals, sensor, Detector.time_of_flight())
    image = rangesim.decode(capture, replace(sensor.default_decoder, working_range=WorkingRange(0.5, 2.0)))
    healed = right(unlimited, signals) & (signals.truth.z > 2.5)
    decided = np.where(healed, Cause.OUT_OF_RANGE, np.where(signals.truth.z > 2.5, Cause.LOW_SIGNAL, Cause.DEPTH_EDGE))
    return Case(signals, capture, image, decided)


def resolution() -> Case:
    """Gray code of wide stripes on a wall; healed by narrow ones, everything else the same."""
    scene = room(wall=board(0, 0, 1.5, 2))
    coarse, fine = StructuredLight(64, 40, code="gray"), StructuredLight(512, 320)
    signals, sharp = (
        transport(scene, scene.rig(0.3, (s.projector_width, s.projector_height), **SIZE), [s], spp=64)
        for s in (coarse, fine)
    )
    healed = right(measure(sharp, fine, Detector())[1], sharp)
    return case(signals, coarse, Detector(), lambda c, i: [(healed, Cause.RESOLUTION)])


def timed_case(signals: Signals, sensor: Any, detector: Any, exposure_s: float, known: list[tuple[Any, Cause]]) -> Case:
    """A `case` of a given exposure, of what is known of it."""
    capture, image = measure(signals, sensor, detector, exposure_s)
    masks, causes = zip(*known, strict=True)
    return Case(signals, capture, image, np.select(masks, causes, default=Cause.NONE))
