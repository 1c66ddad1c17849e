# SPDX-License-Identifier: Apache-2.0
"""Real sweeps of Ouster's scanners, of 8 to 128 beams: is the place from which they were taken found, and which side?

Recordings (.pcap) are read as they are, with the sensor's metadata beside them (.json):

    python benchmarks/ouster_sweeps.py ../shared/data/lidar [--pictures out/]

More come as tests with the source distribution of `ouster-sdk` (BSD-3-Clause), some as .osf, which it reads in an
environment of its own, because its versions of other packages contradict ours:

    pip download --no-deps --no-binary :all: ouster-sdk && tar xzf ouster_sdk-*.tar.gz
    python -m venv sdk && sdk/bin/pip install ouster-sdk
    sdk/bin/python benchmarks/ouster_sweeps.py --unpack ouster_sdk-*/sdk/tests sweeps/
    python benchmarks/ouster_sweeps.py sweeps/ [--pictures out/]

The true place is that of the lenses in the scanner's own frame, by its calibration. Each sweep is turned and moved four
times, as a list of points, and nothing else is said of it.

    told        by `rings`, `spacing`, or neither
    off, worst  distance of the place from the true one, over the median range
    facing      voxels whose normals are turned to the scanner, of those not seen edge-on, in the worst turn
    objects     least and most of the four turns
"""

from __future__ import annotations

import argparse
import json
import warnings
from pathlib import Path

import numpy as np

TURNS = 4
CAPTURES = (
    *("osfs/osf_fw_3.2_10scans.osf", "pcaps/OS-0-32-U1_v2.2.0_1024x10.pcap", "pcaps/OS-1-32-G_v2.1.1_1024x10.pcap"),
    *("pcaps/OS-2-32-U0_v2.0.0_1024x10.pcap", "pcaps/OS-1-64_1024x10_fw20.pcap", "osfs/single_scan_016.osf"),
    *("pcaps/OS-0-128-U1_v2.3.0_1024x10.pcap", "osfs/OS-0-128_v3.0.1_1024x10_20241017_141645.osf"),
    *("zone_monitor/single_frame_zm.osf", "osfs/pose_delta_1_128.osf", "osfs/OS-1-128_v2.3.0_1024x10_lb_n3.osf"),
    "pcaps/OS-2-128-U1_v2.3.0_1024x10.pcap",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of unpacked sweeps and of recordings")
    parser.add_argument("--unpack", type=Path, metavar="TESTS", help="folder of the SDK's tests, from which to unpack")
    parser.add_argument("--pictures", type=Path, metavar="OUT", help="folder for range, reflectivity and objects")
    arguments = parser.parse_args()
    if arguments.unpack:
        unpack(arguments.unpack, arguments.folder)
    else:
        measure(arguments.folder, arguments.pictures)


def unpack(tests: Path, folder: Path) -> None:
    """Write the first sweep of each sensor in each capture, its rows from the highest beam to the lowest."""
    from ouster.sdk import open_source
    from ouster.sdk.core import ChanField, XYZLut, destagger

    folder.mkdir(parents=True, exist_ok=True)
    for capture in CAPTURES:
        frames = next(iter(open_source(str(tests / capture))))
        for number, scan in enumerate(scan for scan in frames if scan is not None):
            ranges = scan.field(ChanField.RANGE)
            points = XYZLut(scan.sensor_info)(scan).reshape(*ranges.shape, 3)
            points[ranges == 0] = np.nan
            image = {"points": points, "reflectivity": scan.field(ChanField.REFLECTIVITY)}
            image = {name: destagger(scan.sensor_info, values) for name, values in image.items()}
            lenses = scan.sensor_info.lidar_to_sensor_transform[:3, 3] / 1000.0
            np.savez_compressed(folder / f"{Path(capture).stem}_{number}.npz", **image, place=lenses)


def read(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (h, w, 3), reflectivities (h, w), and the place of the lenses, of an unpacked sweep or of a recording."""
    if file.suffix == ".npz":
        with np.load(file) as columns:
            return columns["points"], columns["reflectivity"], columns["place"]
    from rangesim.recordings import read_ouster

    sweep = read_ouster(file)
    cloud = sweep.to_point_cloud(coordinates="world", destaggered=True)
    assert cloud.intensity is not None
    return cloud.points, cloud.intensity, sweep.T_world_camera[:3, 3]


def measure(folder: Path, pictures: Path | None) -> None:
    """Print one line per sweep, and JSON."""
    from scipy.spatial.transform import Rotation
    from scores import fraction_facing

    import pcgraph
    from pcgraph.acquisition.spacing_law import law_on_rings, spacing_law
    from pcgraph.voxels.spacing import spacing_and_rows

    warnings.simplefilter("ignore")  # of viewpoints edge-on and the like: none is given here
    print(f"{'':42s}{'beams':>6s}{'points':>8s}{'told':>9s}{'off':>7s}{'worst':>7s}{'facing':>8s}   objects")
    report = {}
    for file in sorted((*folder.glob("*.npz"), *folder.glob("*.pcap"))):
        image, reflectivity, lenses = read(file)
        points = image[np.isfinite(image).all(axis=-1)]
        off, facing, objects, told = [], [], [], []
        for seed in range(TURNS):
            rng = np.random.default_rng(seed)
            turn, shift = Rotation.random(rng=rng).as_matrix(), rng.uniform(-100.0, 100.0, 3)
            moved, place = points @ turn.T + shift, turn @ lenses + shift
            law = law_on_rings(moved, spacing_law(moved), spacing_and_rows(moved)[1])
            told.append("rings" if law.axis is not None else "spacing" if law.holds else "neither")
            result = pcgraph.segment(moved)
            off.append(np.linalg.norm(result.viewpoint - place) / np.median(np.linalg.norm(points - lenses, axis=1)))
            facing.append(fraction_facing(result, place))
            objects.append(int(result.objects.max()) + 1)
        how = max(set(told), key=told.count)
        row = {"told": how, "off": np.median(off), "worst": max(off), "facing": min(facing)}
        report[file.stem] = {"points": len(points), "beams": len(image), **row, "objects": objects}
        numbers = f"{row['off']:7.3f}{row['worst']:7.3f}{row['facing']:8.3f}{min(objects):6d} to {max(objects)}"
        print(f"{file.stem:42s}{len(image):6d}{len(points):8d}{how:>9s}{numbers}", flush=True)
        if pictures:
            _picture(image, reflectivity, pcgraph.segment(image).labels, pictures / f"{file.stem}.png")
    print(json.dumps(report, default=float))


def _picture(image: np.ndarray, reflectivity: np.ndarray, labels: np.ndarray, path: Path) -> None:
    """Range, reflectivity and objects, one above the other, a column per azimuth."""
    from PIL import Image
    from scores import largest

    from pcgraph.labelling import label_colors

    ranges = np.linalg.norm(image, axis=-1)
    bands = [np.log(ranges), np.log1p(reflectivity.astype(float))]
    low_high = [np.nanpercentile(band[labels >= 0], (2, 98)) for band in bands]
    greys = [np.clip((band - low) / (high - low), 0.0, 1.0) for band, (low, high) in zip(bands, low_high, strict=True)]
    rows = [np.repeat((255 * np.nan_to_num(grey)).astype(np.uint8)[..., None], 3, axis=2) for grey in greys]
    by_size = np.where(labels >= 0, largest(labels, labels.size), -1)  # so that the colours of large ones differ
    colors = label_colors(by_size.reshape(-1)).reshape(*labels.shape, 3)
    tall = max(1, round(image.shape[1] / 4 / len(image)))
    path.parent.mkdir(parents=True, exist_ok=True)
    seen = np.isfinite(ranges)[..., None]
    Image.fromarray(np.repeat(np.concatenate([np.where(seen, row, 0) for row in (*rows, colors)]), tall, axis=0)).save(
        path
    )


if __name__ == "__main__":
    main()
