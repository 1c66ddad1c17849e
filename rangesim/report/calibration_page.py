# SPDX-License-Identifier: Apache-2.0
"""The HTML page of a calibration: the rig that was found, its uncertainty, and the boards that do not fit it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from pcgraph.plumbing.plain_files import sealed, unsealed
from rangesim.report.figures import grey
from rangesim.report.template import render_page
from rangesim.rig.calibration_files import SEAL

if TYPE_CHECKING:
    from rangesim.calibration import BoardView, RigCalibration
    from rangesim.rig import Intrinsics

CELLS = (8, 6)
"""Counts of cells across and down an image in which corners are sought; the cells are square in images of 4 : 3. With
more cells, more views are needed until all have corners; fewer cells hide gaps between the corners."""
MIN_COVERED = 0.6
"""Fraction of the cells with corners below which the page warns, because distortion is unknown in the other cells."""
WORSE_FACTOR = 2.0
"""The page names a board as worse above this multiple of the median error of all boards. A smaller multiple would name
boards that are worse by chance, a larger one would miss bad boards; other values were not measured."""
SHOWN_WIDTH = 400
"""Approximate width of a view in the page, in pixels; larger images are averaged so that the page stays small."""
ARROW_LENGTH = 0.03
"""Length of the arrow of a typical error, as a fraction of the image's width, so that patterns are visible."""
PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Names of a device's parameters: pixels for the first four, OpenCV's distortion coefficients for the others."""


def render_calibration(found: RigCalibration, names: Sequence[str], images: Sequence[np.ndarray] | None = None) -> str:
    """HTML page of a calibration.

    Parameters
    ----------
    found : RigCalibration.
    names : name of each capture, in their order.
    images : (h, w) image of each capture; None: the views are drawn without images.

    Raises
    ------
    ValueError
        The number of names or of images is not that of the captures.
    """
    if len(names) != len(found.camera_views) or (images is not None and len(images) != len(names)):
        raise ValueError(f"expected a name and an image for each of the {len(found.camera_views)} captures.")
    page = render_page("calibration.html.j2", context(found, [str(name) for name in names], images))
    return sealed(f"{page}<!-- {unsealed(SEAL)} -->\n".encode(), SEAL, at_end=True).decode()


def context(found: RigCalibration, names: list[str], images: Sequence[np.ndarray] | None) -> dict[str, Any]:
    """Values of the variables of the template, by name."""
    camera, projector = found.rig.pinhole, found.rig.image_projector
    devices = [
        _device("camera", camera, found.camera_deviations, found.camera_views, found.camera_residuals),
        _device("projector", projector, found.projector_deviations, found.projector_views, found.projector_residuals),
    ]
    boards = _boards(found, names)
    by_name = {"camera": found.camera_rms_px, "projector": found.projector_rms_px}
    T = found.rig.T_camera_projector
    return {
        "verdict": _verdict(found, names, devices, boards),
        "rms": {name: f"{value:.3f}" for name, value in by_name.items()},
        "devices": devices,
        "parameters": PARAMETERS,
        "baseline": f"{1e3 * found.baseline_m:.4f} ± {1e3 * found.baseline_deviation_m:.2g}",
        "place": ", ".join(f"{1e3 * x:.3f}" for x in T[:3, 3]),
        "turn": ", ".join(f"{x:.4f}" for x in Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)),
        "boards": boards,
        "views": [_view(found, k, names[k], None if images is None else images[k]) for k in range(len(names))],
        "enlarged": _enlargement(camera, found.camera_rms_px),
        "suspects": [(names[s.view], s.device, str(s.point), f"{s.error_px:.2f}") for s in found.suspects],
    }


def _device(
    name: str,
    device: Intrinsics,
    deviations: np.ndarray,
    views: Sequence[BoardView],
    residuals: Sequence[np.ndarray],
) -> dict[str, Any]:
    """Parameters of a device, its coverage with corners and its errors of reprojection, as the template shows them."""
    pixels, errors = np.concatenate([view.pixels for view in views]), np.concatenate(residuals)
    rms = float(np.sqrt(np.square(errors).sum(axis=1).mean()))
    across, down = CELLS
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], bins=(down, across), range=((0, device.height), (0, device.width))
    )
    cell_w, cell_h = device.width / across, device.height / down
    scale = _enlargement(device, rms)
    limit = max(3.5 * rms, float(np.quantile(np.linalg.norm(errors, axis=-1), 0.995)), 1e-6)
    return {
        "name": name,
        "width": device.width,
        "height": device.height,
        "values": [
            (p, f"{v:.3f}" if k < 4 else f"{v:.5f}", "held" if d == 0 else f"{d:.2g}")
            for k, (p, v, d) in enumerate(zip(PARAMETERS, _values(device), deviations, strict=True))
        ],
        "covered": float((counts > 0).mean()),
        "empty": [
            (f"{c * cell_w:.1f}", f"{r * cell_h:.1f}", f"{cell_w:.1f}", f"{cell_h:.1f}")
            for r, c in np.argwhere(counts == 0)
        ],
        "dot": f"{device.width / 250:.1f}",
        "stroke": f"{device.width / 500:.2f}",
        "broad": f"{device.width / 250:.2f}",
        "arrows": _arrows(pixels, errors, scale),
        "enlarged": scale,
        "limit": f"{limit:.2g}",
        "scatter": [(f"{x / limit:.3f}", f"{y / limit:.3f}") for x, y in errors if max(abs(x), abs(y)) <= limit],
        "beyond": int((np.abs(errors).max(axis=1) > limit).sum()),
        "circle": f"{rms / limit:.3f}",
        "rms": f"{rms:.3f}",
        "points": len(pixels),
    }


def _values(device: Intrinsics) -> tuple[float, ...]:
    """Values of `PARAMETERS` of a device."""
    return (device.fx, device.fy, device.cx, device.cy, *device.coefficients)


def _enlargement(device: Intrinsics, rms: float) -> int:
    """Factor by which the page enlarges errors: the largest one of 1, 2 or 5 times a power of 10 with which an error of
    `rms` pixels is not longer than `ARROW_LENGTH`."""
    wanted = max(ARROW_LENGTH * device.width / max(rms, 1e-9), 1.0)
    power = 10.0 ** np.floor(np.log10(wanted))
    return int(power * max(n for n in (1, 2, 5) if n * power <= wanted))


def _arrows(pixels: np.ndarray, errors: np.ndarray, scale: float) -> list[tuple[str, ...]]:
    """Start and end, as text, of the arrow of each error: x and y of the corner, and x and y of the enlarged error."""
    return [tuple(f"{v:.1f}" for v in (*p, *(p + scale * e))) for p, e in zip(pixels, errors, strict=True)]


def _boards(found: RigCalibration, names: list[str]) -> list[dict[str, Any]]:
    """Distance, tilt and errors of each board, as the template shows them."""
    rms = np.array(
        [
            [np.sqrt(np.square(r).sum(axis=1).mean()) for r in residuals]
            for residuals in (found.camera_residuals, found.projector_residuals)
        ]
    )
    largest = rms.max(axis=1)
    result = []
    for k, name in enumerate(names):
        T = found.T_camera_board[k]
        errors = [np.linalg.norm(r[k], axis=-1) for r in (found.camera_residuals, found.projector_residuals)]
        result.append(
            {
                "name": name,
                "points": (len(errors[0]), len(errors[1])),
                "distance": f"{T[2, 3]:.3f}",
                "tilt": f"{np.degrees(np.arccos(np.clip(abs(T[2, 2]), 0, 1))):.0f}",
                "rms": [f"{value:.3f}" for value in rms[:, k]],
                "bars": [100 * float(value / most) for value, most in zip(rms[:, k], largest, strict=True)],
                "worst": [f"{e.max():.2f}" for e in errors],
                "is_worse": [
                    bool(value > WORSE_FACTOR * np.median(all_)) for value, all_ in zip(rms[:, k], rms, strict=True)
                ],
            }
        )
    return result


def _view(found: RigCalibration, k: int, name: str, image: np.ndarray | None) -> dict[str, Any]:
    """Image of capture k with the errors of its corners, as the template shows it."""
    camera, view = found.rig.pinhole, found.camera_views[k]
    picture = None
    if image is not None:
        every = max(1, round(camera.width / SHOWN_WIDTH))
        h, w = (n // every * every for n in image.shape)
        small = np.asarray(image[:h, :w], np.float64).reshape(h // every, every, w // every, every).mean(axis=(1, 3))
        picture = grey(small, max(float(np.quantile(small, 0.999)), 1e-12), float(np.quantile(small, 0.001)))
    return {
        "name": name,
        "picture": picture,
        "arrows": _arrows(view.pixels, found.camera_residuals[k], _enlargement(camera, found.camera_rms_px)),
        "rms": f"{np.sqrt(np.square(found.camera_residuals[k]).sum(axis=1).mean()):.3f}",
    }


def _verdict(
    found: RigCalibration, names: list[str], devices: list[dict[str, Any]], boards: list[dict[str, Any]]
) -> list[tuple[str, str]]:
    """Sentences at the top of the page, each in two parts: its subject, which is shown in bold, and the rest."""
    lines = []
    for device, deviations, said in (
        (found.rig.pinhole, found.camera_deviations, devices[0]),
        (found.rig.image_projector, found.projector_deviations, devices[1]),
    ):
        focal = 100 * float((deviations[:2] / [device.fx, device.fy]).max())
        lines.append(
            (
                f"The {said['name']}",
                f"has a focal length of {device.fx:.2f} px, known to {focal:.2g} %, and its principal point to "
                f"{float(deviations[2:4].max()):.2g} px; errors of reprojection are {said['rms']} px.",
            )
        )
    lines.append(
        (
            "The baseline",
            f"is {1e3 * found.baseline_m:.3f} mm, known to {1e3 * found.baseline_deviation_m:.2g} mm, if the size "
            "of the board is right: a relative error of its size is the same relative error of all lengths.",
        )
    )
    for said in devices:
        if said["covered"] < MIN_COVERED:
            lines.append(
                (
                    f"The {said['name']}'s image",
                    f"has corners in {100 * said['covered']:.0f}\u00a0% of its parts: its distortion is unknown in the "
                    "others; show the board there.",
                )
            )
    for number, said in enumerate(devices):
        worse = [board["name"] for board in boards if board["is_worse"][number]]
        if worse:
            lines.append(
                (
                    ", ".join(worse),
                    f"fit{'s' if len(worse) == 1 else ''} the {said['name']} worse than the other boards: look at it "
                    "below, or leave it out.",
                )
            )
    if found.suspects:
        first = found.suspects[0]
        count = len(found.suspects)
        lines.append(
            (
                f"{count} corner{'s' if count != 1 else ''}",
                f"{'are' if count != 1 else 'is'} off by more than noise can explain, up to {first.error_px:.1f} px in "
                f"{names[first.view]}: leave such captures out.",
            )
        )
    return lines
