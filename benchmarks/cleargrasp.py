# SPDX-License-Identifier: Apache-2.0
"""How range sensors fail on glass: a real stereo depth camera beside simulated structured light and time of flight.

Real: two scenes of the ClearGrasp data set (Sajjan et al. 2020; RealSense D435), whose transparent objects were
measured as they are and again sprayed opaque. Simulated: `scenes/glassware.xml` with the same intrinsics at the same
distance, with and without photons beyond glass. Figures on the objects, and on the background:

    lost       fraction of the pixels (whose true depth is known) without a measurement
    > 10 mm    fraction of the others that are off by more than 10 mm
    median     signed error in z, millimetres; positive is too far
    quartiles  25 % and 75 % of the signed error, millimetres

"Against what is behind" takes, on the simulated objects, the depth of table and wall without the objects for the truth.
The last line is JSON. Usage: python benchmarks/cleargrasp.py [--data DIR] [--width 320] [--spp 64]
"""

from __future__ import annotations

import argparse
import json
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from rangesim import AmcwToF, DirectToF, Rig, StructuredLight, decode, expose, load_scene, transport

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "glassware.xml"
DATA = Path("../shared/data/cleargrasp_d435")
REAL_SCENES = ("000000080", "000000123")
OFF_MM = 10.0
SENSORS = {
    "structured light, gray-phase": StructuredLight(),
    "AMCW ToF, 20 + 80 + 100 MHz": AmcwToF(),
    "direct ToF, 100 ps bins": DirectToF(bins=128, pulse_fwhm_s=200e-12),
}
BASELINE_M = 0.05
TRANSPARENT = ("pet", "glass")
Figures = dict[str, float]


def figures(measured: np.ndarray, true: np.ndarray, mask: np.ndarray) -> Figures:
    """Figures of the module's docstring over the pixels of `mask` whose true z (metres, NaN: unknown) is known."""
    known = mask & np.isfinite(true)
    error_mm = 1e3 * (measured - true)[known & np.isfinite(measured)]
    low, median, high = np.percentile(error_mm, [25, 50, 75])
    return {
        "lost": round(1 - error_mm.size / int(known.sum()), 3),
        "off": round(float((np.abs(error_mm) > OFF_MM).mean()), 3),
        "median_mm": round(float(median), 1),
        "low_mm": round(float(low), 1),
        "high_mm": round(float(high), 1),
    }


def real(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measured and true z, (h, w) metres, NaN where there is none, and the mask of the transparent objects."""
    import mitsuba as mi

    def depth(kind: str) -> np.ndarray:
        z = np.array(mi.Bitmap(str(folder / f"{name}-{kind}-depth-img.exr")), dtype=np.float64)[..., 0]
        return np.where(np.isfinite(z) & (z > 0), z, np.nan)

    return depth("transparent"), depth("opaque"), np.array(mi.Bitmap(str(folder / f"{name}-mask.png"))) > 0


def depth_behind(rig: Rig) -> np.ndarray:
    """(h, w) true z of the scene without its transparent objects."""
    tree = ET.parse(SCENE)
    root = tree.getroot()
    for shape in root.findall("shape"):
        if any(ref.get("id") in TRANSPARENT for ref in shape.findall("ref")):
            root.remove(shape)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "empty.xml"
        tree.write(path)
        return transport(load_scene(path), rig, [], spp=1, photons=0).truth.z


def show(label: str, on_glass: Figures, background: Figures) -> None:
    """One line of the table."""
    cells = [f"{f['lost']:>6.1%} {f['off']:>8.1%} {f['median_mm']:>+8.1f} {f['low_mm']:>+8.1f}..{f['high_mm']:<+8.1f}"
             for f in (on_glass, background)]  # fmt: skip
    print(f"{label:<46} {cells[0]} | {cells[1]}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--spp", type=int, default=64)
    args = parser.parse_args()

    scene = load_scene(SCENE)
    result: dict[str, tuple[Figures, Figures]] = {}
    print(f"{'':<46} on glass: lost, > 10 mm, median, quartiles in mm | background")
    if args.data.is_dir():
        for name in REAL_SCENES:
            measured, true, mask = real(args.data, name)
            result[f"real D435, scene {name[-3:]}"] = figures(measured, true, mask), figures(measured, true, ~mask)
            show(f"real D435, scene {name[-3:]}", *list(result.values())[-1])
    else:
        print(f"no real data: there is no directory {args.data}; name it with --data")

    rig = scene.rig(BASELINE_M, width=args.width)
    behind = depth_behind(rig)
    for light, settings in (("all light", {}), ("no light beyond glass", {"photons": 0, "glint": False})):
        signals = transport(scene, rig, list(SENSORS.values()), spp=args.spp, max_depth=12, **settings)
        truth = signals.truth
        mask = truth.material == truth.material_names.index("transparent")
        for label, sensor in SENSORS.items():
            image = decode(expose(signals, sensor))
            z = np.where(image.valid, image.z, np.nan)
            key = f"{label}, {light}"
            result[key] = figures(z, truth.z, mask), figures(z, truth.z, ~mask)
            show(key, *result[key])
            if light == "all light":
                result[f"{key}, against what is behind"] = figures(z, behind, mask), result[key][1]
                show("    against what is behind", *result[f"{key}, against what is behind"])
    print(json.dumps({k: {"glass": a, "background": b} for k, (a, b) in result.items()}))


if __name__ == "__main__":
    main()
