# SPDX-License-Identifier: Apache-2.0
"""The material catalogue: its constants follow from their sources, its files load, nothing shines by itself."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from delta_scenes import thrown_w
from tiers import to_validate

import rangesim
from rangesim.environment.backend import select_variant
from rangesim.light_transport.narrow_lobes import thrown_light
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.scene import retroreflector
from rangesim.scene.materials import material_class

MATERIALS = Path(__file__).resolve().parent.parent / "scenes" / "materials"
NAMES = sorted(p.stem for p in MATERIALS.glob("*.xml"))
NEAR_INFRARED = [n for n in NAMES if not n.endswith("_550nm")]
VIEW = """<sensor type="perspective"><float name="fov" value="{fov}"/>
    <transform name="to_world"><lookat origin="0,-12,0" target="0,0,0" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="96"/><integer name="height" value="96"/></film></sensor>
    <emitter type="constant"><spectrum name="radiance" value="1"/></emitter>"""
CLASSES = {
    "matte": "black_board black_fabric black_rubber grey_cardboard raw_wood skin white_paper white_target",
    "glossy": "brushed_aluminium brushed_steel car_paint clear_coated_aluminium glossy_plastic lacquered_wood "
    "print_under_glass sandblasted_aluminium satin_plastic",
    "mirror": "aluminium chromium copper gold silver steel",
    "transparent": "antiglare_glass bk7 pmma polycarbonate soda_lime_glass water window_pane",
    "translucent": "frosted_glass lampshade paper_sheet",
    "other": "retroreflective_sheeting",
}


def numbers(name: str) -> dict[str, float]:
    """All numbers of a catalogue file by name."""
    elements = ET.parse(MATERIALS / f"{name}.xml").iter()
    return {e.attrib["name"]: float(e.attrib["value"]) for e in elements if e.tag in ("float", "spectrum")}


def sellmeier(wavelength_um: float, terms: list[tuple[float, float]]) -> float:
    """n^2 = 1 + sum of B lambda^2 / (lambda^2 - C)."""
    square = wavelength_um**2
    return float(np.sqrt(1 + sum(b * square / (square - c) for b, c in terms)))


# Sources: docs/materials.md
SELLMEIER = {
    "bk7": [(1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)],
    "pmma": [(1.1819, 0.011313)],
    "polycarbonate": [(1.4182, 0.021304)],
}
# Rows of the published tables on both sides of 850 and 550 nm: wavelength in um, n, k
TABLES = {
    "silver": [(0.8211, 0.04, 5.727), (0.8920, 0.04, 6.312), (0.5486, 0.06, 3.586), (0.5821, 0.05, 3.858)],
    "aluminium": [
        (0.83774, 2.6945, 8.1878), (0.88561, 2.2802, 8.1134), (0.51660, 0.8734, 6.2418), (0.56357, 1.0728, 6.7839)
    ],
    "gold": [(0.8211, 0.16, 5.083), (0.8920, 0.17, 5.663), (0.5486, 0.43, 2.455), (0.5821, 0.29, 2.863)],
    "copper": [(0.8211, 0.26, 5.180), (0.8920, 0.30, 5.768), (0.5486, 1.02, 2.577), (0.5821, 0.70, 2.704)],
    "chromium": [(0.821, 3.20, 3.48), (0.892, 3.30, 3.52), (0.549, 3.18, 3.33), (0.582, 3.22, 3.30)],
    "steel": [(0.821, 2.94, 3.39), (0.892, 2.96, 3.56), (0.549, 2.95, 2.93), (0.582, 2.94, 2.99)],
}  # fmt: skip


@pytest.mark.parametrize(("band", "wavelength_um"), [("", 0.85), ("_550nm", 0.55)])
def test_indices_of_glass_follow_from_the_dispersion_formulas(band: str, wavelength_um: float) -> None:
    for name, terms in SELLMEIER.items():
        assert numbers(name + band)["int_ior"] == pytest.approx(sellmeier(wavelength_um, terms), abs=5e-5)
        assert numbers(name + band)["ext_ior"] == 1.0  # catalogue indices are those against air
    rubin = 1.5130 - 0.003169 * wavelength_um**2 + 0.003962 / wavelength_um**2
    for name in ("soda_lime_glass", "window_pane", "frosted_glass", "antiglare_glass"):
        assert numbers(name + band)["int_ior"] == pytest.approx(rubin, abs=5e-5)


def test_bk7_has_the_index_of_its_data_sheet() -> None:
    """Schott states n_d = 1.5168 at 587.6 nm; the formula of the test is that of the data sheet."""
    assert sellmeier(0.5876, SELLMEIER["bk7"]) == pytest.approx(1.5168, abs=1e-5)


# Rows of the published tables of k on both sides of 850 and 550 nm: wavelength in um, k
EXTINCTIONS = {
    "water": [(0.850, 2.93e-7), (0.875, 3.91e-7), (0.550, 1.96e-9), (0.575, 3.60e-9)],
    "bk7": [(0.700, 8.9305e-9), (1.060, 1.0137e-8), (0.546, 6.9658e-9), (0.580, 9.2541e-9)],
    "soda_lime_glass": [(0.85, 3.150e-6), (0.86, 3.274e-6), (0.55, 2.200e-7), (0.56, 2.529e-7)],
    "pmma": [(0.85, 1.05e-7), (0.86, 1.50e-7), (0.55, 1.74e-7), (0.56, 1.78e-7)],
    "polycarbonate": [(0.85, 1.06e-7), (0.86, 1.35e-7), (0.55, 4.08e-7), (0.56, 4.27e-7)],
}
EXTINCTIONS |= dict.fromkeys(("frosted_glass", "antiglare_glass"), EXTINCTIONS["soda_lime_glass"])


@pytest.mark.parametrize("name", EXTINCTIONS)
def test_clear_materials_absorb_what_their_tables_say(name: str) -> None:
    """sigma_a = 4 pi k / lambda."""
    rows = np.array(EXTINCTIONS[name])
    for band, wavelength_um, pair in (("", 0.85, rows[:2]), ("_550nm", 0.55, rows[2:])):
        found = numbers(name + band)
        k = np.interp(wavelength_um, pair[:, 0], pair[:, 1])
        assert found["sigma_t"] == pytest.approx(4 * np.pi * k / (wavelength_um * 1e-6), rel=1e-3)
        assert found["albedo"] == 0


@pytest.mark.parametrize("name", ["bk7", *to_validate(*(n for n in EXTINCTIONS if n != "bk7"))])
def test_a_body_of_a_clear_material_is_filled_by_its_interior(tmp_path: Path, name: str) -> None:
    """A slab of 1 m, so that each of them takes some of the light."""
    filled = f'<ref id="{name}_interior" name="interior"/>'
    seen = []
    for interior in ("", filled):
        body = f'<include filename="materials/{name}.xml"/><shape type="cube"><ref id="{name}"/>{interior}'
        body += '<transform name="to_world"><scale x="5" y="0.5" z="5"/></transform></shape>'
        scene = load(tmp_path, VIEW.format(fov=8) + body)
        signals = rangesim.transport(
            scene, scene.rig(baseline_m=0.1, width=16), [], spp=32, glint=False, caustics=False
        )
        seen.append(signals.energy.ambient.mean())
    assert seen[1] < seen[0] - 0.5 * (1 - np.exp(-numbers(name)["sigma_t"]))


@pytest.mark.parametrize("name", TABLES)
def test_constants_of_metals_lie_on_their_tables(name: str) -> None:
    rows = np.array(TABLES[name])
    for band, wavelength_um, pair in (("", 0.85, rows[:2]), ("_550nm", 0.55, rows[2:])):
        found = numbers(name + band)
        for column, key in enumerate(("eta", "k"), start=1):
            assert found[key] == pytest.approx(np.interp(wavelength_um, pair[:, 0], pair[:, column]), abs=1e-4)


@pytest.mark.parametrize(("name", "symbol"), [("silver", "Ag"), ("aluminium", "Al"), ("gold", "Au"), ("copper", "Cu")])
def test_metals_reflect_what_other_measurements_say(name: str, symbol: str) -> None:
    """Normal incidence at 850 nm, against Palik's handbook, whose samples are others (the data Mitsuba carries)."""
    import mitsuba as mi

    handbook = [
        np.interp(850, *np.loadtxt(Path(mi.__file__).parent / "data" / "ior" / f"{symbol}.{q}.spd", unpack=True))
        for q in ("eta", "k")
    ]
    tolerance = 0.015 if name == "silver" else 0.01  # the handbook's silver film is lossier: 0.982
    assert reflectance(*handbook) == pytest.approx(reflectance(numbers(name)["eta"], numbers(name)["k"]), abs=tolerance)


def reflectance(n: float, k: float) -> float:
    return float(((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2))


def test_every_material_is_classified_and_listed_in_the_docs() -> None:
    listed = sorted(" ".join(CLASSES.values()).split())
    assert listed == NEAR_INFRARED
    text = (MATERIALS.parents[1] / "docs" / "materials.md").read_text()
    assert [n for n in NEAR_INFRARED if f"`{n}`" not in text] == []


@pytest.mark.filterwarnings("ignore::rangesim.errors.TruncationWarning")
@pytest.mark.parametrize(
    "names", [*to_validate((NEAR_INFRARED,)), [n for n in NAMES if n.endswith("_550nm")]], ids=["850", "550"]
)
def test_no_material_returns_more_than_it_receives(tmp_path: Path, names: list[str]) -> None:
    """White furnace: balls of all materials in a uniform light of 1 look no brighter than it, and black ones dark."""
    columns, body = 6, ""
    for i, name in enumerate(names):
        body += f'<include filename="materials/{name}.xml"/><shape type="sphere" id="ball {name}"><float name="radius" '
        body += f'value="0.7"/><point name="center" x="{2 * (i % columns) - 5}" y="0" z="{2 * (i // columns) - 5}"/>'
        body += f'<ref id="{name.removesuffix("_550nm")}"/></shape>'
    scene = load(tmp_path, VIEW.format(fov=60) + body)
    classes = {i.name.removeprefix("ball "): i.material for i in scene.instances}
    for kind, members in CLASSES.items():
        assert {classes[n] for n in names if n.removesuffix("_550nm") in members.split()} <= {kind}
    signals = rangesim.transport(scene, scene.rig(baseline_m=0.1, width=96), [], spp=64, max_depth=24, rr_depth=24)
    levels = {n: np.median(signals.energy.ambient[signals.truth.instance == i]) for i, n in enumerate(classes)}
    assert all(np.isfinite(list(levels.values())))
    assert max(levels.values()) < 1.003
    assert signals.energy.ambient.max() < 1.1  # one pixel of 64 samples
    if "black_rubber" in levels:
        assert levels["black_rubber"] == pytest.approx(0.02, abs=0.005)
        assert levels["black_fabric"] == pytest.approx(0.35, abs=0.02)


@pytest.mark.validation
@pytest.mark.parametrize("name", ["bk7", "pmma", "window_pane"])
def test_clear_materials_lose_nothing(tmp_path: Path, name: str) -> None:
    body = f'<include filename="materials/{name}.xml"/><shape type="sphere"><ref id="{name}"/></shape>'
    scene = load(tmp_path, VIEW.format(fov=8) + body)
    signals = rangesim.transport(scene, scene.rig(baseline_m=0.1, width=16), [], spp=32, max_depth=64, rr_depth=64)
    assert signals.energy.ambient.mean() == pytest.approx(1, abs=0.01)


def load(folder: Path, body: str) -> rangesim.Scene:
    (folder / "scene.xml").write_text(f'<scene version="3.0.0">{body}</scene>')
    return rangesim.load_scene(folder / "scene.xml")


def test_a_scene_s_own_material_comes_first(tmp_path: Path) -> None:
    (tmp_path / "materials").mkdir()
    own = '<scene version="3.0.0"><bsdf type="diffuse" id="silver"/></scene>'
    (tmp_path / "materials" / "silver.xml").write_text(own)
    body = '<include filename="materials/silver.xml"/><shape type="sphere"><ref id="silver"/></shape>'
    assert load(tmp_path, VIEW.format(fov=8) + body).instances[0].material == "matte"


def test_translucent_sheets_scatter_the_projector_s_light_to_both_sides(tmp_path: Path) -> None:
    """A sheet between lamp and camera glows by the diffuse law: radiance = T / pi times the irradiance behind it."""
    sheet = (
        '<shape type="rectangle"><transform name="to_world"><scale value="20"/><rotate x="1" angle="90"/></transform>'
    )
    body = VIEW.format(fov=30).replace('value="1"', 'value="0"')
    body += f'<include filename="materials/lampshade.xml"/>{sheet}<ref id="lampshade"/></shape>'
    scene = load(tmp_path, body)
    front = scene.rig(baseline_m=0.1, width=8)
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])  # the lamp behind the sheet, as far away, looking back
    turned[2, 3] = 24.0
    behind = rangesim.Rig(
        camera=front.camera, projector=front.projector, T_world_camera=front.T_world_camera,
        T_camera_projector=turned, projector_power_w=front.projector_power_w,
    )  # fmt: skip
    back, through = (rangesim.transport(scene, r, [], spp=16).energy.direct[4, 4] for r in (front, behind))
    assert through / back == pytest.approx(0.5 / 0.4, rel=0.3)  # Burley's diffuse law is not quite Lambert's
    assert through > 0


# ---- Retro-reflector ---------------------------------------------------------------------------------


def returned(bsdf: object, observation_deg: float, entrance_deg: float) -> float:
    """Coefficient of retro-reflection R_A, cd/lx/m2: intensity to the observer per irradiance across the beam."""
    import drjit as dr
    import mitsuba as mi

    o, e = np.radians([observation_deg, entrance_deg])
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(float(np.sin(e)), 0, float(np.cos(e)))
    wo = mi.Vector3f(float(np.sin(e) * np.cos(o)), float(np.sin(o)), float(np.cos(e) * np.cos(o)))
    return float(np.array(bsdf.eval(mi.BSDFContext(), si, wo)).ravel()[0] * np.cos(e))  # type: ignore[attr-defined]


def test_sheeting_returns_what_its_standard_asks_for(tmp_path: Path) -> None:
    """ASTM D4956 Type III, white: observation angle, entrance angle, R_A."""
    body = '<include filename="materials/retroreflective_sheeting.xml"/><shape type="sphere">'
    scene = load(tmp_path, VIEW.format(fov=8) + body + '<ref id="retroreflective_sheeting"/></shape>')
    bsdf = scene.mitsuba.shapes()[0].bsdf()
    for observation, entrance, standard in [(0.1, 4, 300), (0.2, 4, 250), (0.5, 4, 95), (0.1, 30, 180), (0.2, 30, 150)]:
        assert returned(bsdf, observation, entrance) == pytest.approx(standard, rel=0.1)
    assert returned(bsdf, 15, 4) == pytest.approx(0.27 / np.pi, rel=0.05)  # off the lobe, the diffuse base is left


def test_light_comes_back_to_a_lamp_beside_the_camera(tmp_path: Path) -> None:
    bodies = [
        f'<include filename="materials/{n}.xml"/><shape type="sphere"><ref id="{n}"/></shape>'
        for n in ("retroreflective_sheeting", "white_paper")
    ]
    scenes = [load(tmp_path, VIEW.format(fov=8) + body) for body in bodies]
    sheeting, paper = (rangesim.transport(s, s.rig(baseline_m=0.02, width=32), [], spp=8).energy.direct for s in scenes)
    assert sheeting[16, 16] > 100 * paper[16, 16]
    assert sheeting[16, 4] > 30 * paper[16, 4]  # and from slanted places too, where a mirror would send it off


@pytest.mark.parametrize("falloff", [3.0, *to_validate(0.0)])
def test_retro_reflection_is_sampled_as_it_is_evaluated(falloff: float, tmp_path: Path, monkeypatch: object) -> None:
    """Chi-square test of sample() against pdf(); weight = eval / pdf; reciprocity; no energy gained."""
    import drjit as dr
    import mitsuba as mi
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    monkeypatch.chdir(tmp_path)  # type: ignore[attr-defined]  # the test writes a file where it fails
    select_variant()
    retroreflector.register()
    retroreflector.register()  # twice is harmless
    inside = (
        f'<float name="falloff" value="{falloff}"/><bsdf type="roughconductor"><float name="alpha" value="0.3"/></bsdf>'
    )
    for wi in ([0.0, 0.0, 1.0], [0.48, 0.36, 0.8]):
        sample, pdf = BSDFAdapter("retroreflector", inside, wi=wi)
        assert ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=3).run()
    bsdf = mi.load_string(f'<bsdf version="3.0.0" type="retroreflector">{inside}</bsdf>')
    rng = mi.PCG32(20_000)
    si = dr.zeros(mi.SurfaceInteraction3f, 20_000)
    si.wi = mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    bs, weight = bsdf.sample(mi.BSDFContext(), si, 0.5, mi.Point2f(rng.next_float32(), rng.next_float32()))
    value, density = bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo)
    good = density.numpy() > 1e-3
    np.testing.assert_allclose((value[0] / density).numpy()[good], weight[0].numpy()[good], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(density.numpy()[good], bs.pdf.numpy()[good], rtol=1e-3)
    assert weight[0].numpy().max() <= 1 + 1e-3
    turned = mi.SurfaceInteraction3f(si)
    turned.wi = bs.wo
    swapped = bsdf.eval(mi.BSDFContext(), turned, si.wi)[0]
    wide = (bs.wo.z.numpy() > 0.05) & (si.wi.z.numpy() > 0.05)
    there, back = value[0].numpy() / bs.wo.z.numpy(), swapped.numpy() / si.wi.z.numpy()
    np.testing.assert_allclose(there[wide], back[wide], rtol=2e-2, atol=1e-4)


def test_retro_reflectors_show_what_they_wrap() -> None:
    import mitsuba as mi

    select_variant()
    retroreflector.register()
    bsdf = mi.load_dict({"type": "retroreflector", "bsdf": {"type": "roughconductor", "alpha": 0.3}})
    assert material_class(bsdf) == "glossy"
    assert any(key.startswith("nested.alpha") for key, _ in mi.traverse(bsdf))
    for wrong in ({"type": "retroreflector"}, {"type": "retroreflector", "bsdf": {"type": "dielectric"}}):
        with pytest.raises(RuntimeError, match="expected"):
            mi.load_dict(wrong)


def test_principled_roughness_is_the_root_of_alpha() -> None:
    import mitsuba as mi

    select_variant()
    for roughness, kind in ((0.2, "mirror"), (0.3, "glossy")):  # alpha 0.04 and 0.09
        assert material_class(mi.load_dict({"type": "principled", "metallic": 1.0, "roughness": roughness})) == kind


# ---- Roughness by a texture --------------------------------------------------------------------------


def grey(*values: float) -> dict[str, object]:
    """A bitmap of these pixels, one row."""
    import mitsuba as mi

    pixels = np.array(values, np.float32).reshape(1, -1, 1)
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(pixels)}


def checks(first: float, second: float) -> dict[str, object]:
    colours = {"color0": {"type": "uniform", "value": first}, "color1": {"type": "uniform", "value": second}}
    return {"type": "checkerboard", **colours}


@pytest.mark.parametrize("texture", [lambda low, high: grey(low, high, low, high), checks], ids=["bitmap", "checks"])
@pytest.mark.parametrize(
    ("kind", "key", "low", "high", "expected"),
    [
        ("roughconductor", "alpha", 0.2, 0.4, "glossy"),
        ("roughconductor", "alpha", 0.01, 0.4, "glossy"),
        ("roughconductor", "alpha", 0.01, 0.02, "mirror"),
        ("roughconductor", "alpha_u", 0.2, 0.4, "glossy"),
        ("roughdielectric", "alpha", 0.2, 0.4, "translucent"),
        ("roughdielectric", "alpha", 0.01, 0.02, "transparent"),
        ("principled", "roughness", 0.3, 0.5, "glossy"),
        ("principled", "roughness", 0.1, 0.2, "mirror"),
    ],
)
def test_roughness_by_a_texture_counts_as_its_mean(
    texture: object, kind: str, key: str, low: float, high: float, expected: str
) -> None:
    import mitsuba as mi

    select_variant()
    bsdf: dict[str, object] = {"type": kind, key: texture(low, high)}  # type: ignore[operator]
    bsdf |= {"alpha_v": 0.01} if key == "alpha_u" else {}
    bsdf |= {"metallic": 1.0} if kind == "principled" else {}
    assert material_class(mi.load_dict(bsdf)) == expected
    wrapped = {"type": "mask", "opacity": 0.5, "bsdf": bsdf | {key: texture(low, high)}}  # type: ignore[operator]
    assert material_class(mi.load_dict(wrapped)) == expected


def test_roughness_by_the_corners_of_a_mesh_is_not_taken_for_polished() -> None:
    import mitsuba as mi

    select_variant()
    attribute = {"type": "mesh_attribute", "name": "vertex_roughness"}
    assert material_class(mi.load_dict({"type": "roughconductor", "alpha": attribute})) == "glossy"
    assert material_class(mi.load_dict({"type": "roughconductor", "alpha": 0.01})) == "mirror"


def test_a_texture_says_how_metallic_a_surface_is() -> None:
    import mitsuba as mi

    select_variant()
    for low, high, expected in ((0.9, 1.0, "mirror"), (0.0, 0.2, "glossy")):
        bsdf = {"type": "principled", "roughness": 0.1, "metallic": checks(low, high)}
        assert material_class(mi.load_dict(bsdf)) == expected


# ---- Narrow lobes ------------------------------------------------------------------------------------


def corner(paint: dict[str, object], turn_deg: float = 0.0, slab: bool = False) -> rangesim.Scene:
    """A matte wall behind a plate, which lies before it, or stands as a slab of 6 mm."""
    import mitsuba as mi

    select_variant()
    T = mi.ScalarTransform4d()
    shape, size = ("cube", [0.3, 0.003, 0.3]) if slab else ("rectangle", [0.4, 0.5, 1.0])
    matte = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    return rangesim.load_scene(
        {
            "type": "scene",
            "camera": {
                "type": "perspective",
                "fov": 40.0,
                "to_world": T.look_at(origin=[0, -1.2, 0.3], target=[0, 0, 0.2], up=[0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 16, "height": 12},
            },
            "wall": {"type": "rectangle", "to_world": T.translate([0, 0.5, 0]).rotate([1, 0, 0], 90), "bsdf": matte},
            "plate": {"type": shape, "to_world": T.rotate([1, 0, 0], turn_deg).scale(size), "bsdf": paint},
        }
    )


def said_of(scene: rangesim.Scene, caustics: bool = False) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rangesim.transport(scene, scene.rig(), [], spp=1, caustics=caustics, glint=False)
    return [str(warning.message) for warning in caught if "narrow lobes" in str(warning.message)]


@pytest.mark.parametrize("turn_deg", [0.0, 10.0])
@pytest.mark.parametrize("alpha", [0.001, 0.003])
def test_narrow_lobes_throw_as_much_light_as_the_mirror_they_nearly_are(alpha: float, turn_deg: float) -> None:
    mirror, rough = (
        corner(paint, turn_deg) for paint in ({"type": "conductor"}, {"type": "roughconductor", "alpha": alpha})
    )
    rig = mirror.rig()
    mirrored = thrown_w(mirror, rig)
    thrown = thrown_light(TracedScene.of(rough.mitsuba, rough.in_renderer(rig)), caustics=False)
    assert thrown is not None
    assert thrown.onto.sum() == pytest.approx(mirrored, rel=0.02)
    assert mirrored > 0.05
    wall, plate = (["wall", "plate"].index(instance.name) for instance in rough.instances)
    assert thrown.onto[wall] == pytest.approx(thrown.by[plate]) == thrown.onto.sum()
    assert thrown_light(TracedScene.of(mirror.mitsuba, mirror.in_renderer(rig)), caustics=False) is None


@pytest.mark.parametrize(
    ("paint", "slab"),
    [
        ({"type": "roughconductor", "alpha": 0.003}, False),
        ({"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.02}}, False),
        ({"type": "principled", "metallic": 1.0, "roughness": 0.05}, False),
        ({"type": "principled", "spec_trans": 1.0, "roughness": 0.0}, True),
        ({"type": "roughdielectric", "alpha": 0.01}, True),
    ],
)
def test_light_that_narrow_lobes_throw_is_told(paint: dict[str, object], slab: bool) -> None:
    (said,) = said_of(corner(paint, slab=slab))
    assert "light reaches 'wall' over narrow lobes of 'plate'" in said


def test_light_of_polished_metal_is_not_told_if_caustics_carry_it() -> None:
    polished, painted = (
        {"type": "roughconductor", "alpha": 0.003},
        {"type": "principled", "metallic": 1.0, "roughness": 0.05},
    )
    assert said_of(corner(polished), caustics=True) == []
    assert len(said_of(corner(painted), caustics=True)) == 1


@pytest.mark.parametrize(
    ("paint", "slab"),
    [
        ({"type": "conductor"}, False),
        ({"type": "roughconductor", "alpha": 0.1}, False),
        ({"type": "principled", "metallic": 1.0, "roughness": 0.5}, False),
        ({"type": "principled", "spec_trans": 1.0, "roughness": 0.5}, True),
        ({"type": "dielectric"}, True),
        ({"type": "plastic"}, False),
    ],
)
def test_light_that_is_carried_is_not_told(paint: dict[str, object], slab: bool) -> None:
    assert said_of(corner(paint, slab=slab)) == []


def test_a_narrow_lobe_that_lights_nothing_is_not_told() -> None:
    assert said_of(corner({"type": "roughconductor", "alpha": 0.003}, turn_deg=-60.0)) == []
