# SPDX-License-Identifier: Apache-2.0
"""A scene of glass rebuilt from two images of a depth camera: one of its objects sprayed opaque, one in colour.

The depth of the opaque objects gives the front surfaces, which become thin walls of glass. The depth around them gives
the room: its planes (a table, a wall), which go on behind the objects, and all other things as meshes. The grey values
of the colour image become reflectances. All of it is in coordinates of the colour camera, as OpenCV has them, metres.

Depth is handled as its inverse q = 1 / z, because planes are linear in pixel coordinates there, and because the noise
of a stereo camera is the same at all distances: sigma_q = (noise of the disparity in pixels) / (f B).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

from rangesim import Intrinsics
from rangesim.environment.backend import select_variant

FRONT_STEP = 3
"""Pixels between the vertices of a front surface. Finer than the camera resolves: the colour image, to which depth is
aligned, has 1.4 pixels for each of the infra-red images, and a match needs a window of several of these."""
ROOM_STEP = 4
"""Pixels between the vertices of the room, which is smoother than the objects."""
MARGIN = 12
"""Pixels around a mask whose depth belongs neither to the objects nor surely to the room: half a match window."""
OUTSIDE_PX = 320
"""Pixels by which the room goes on beyond the image, so that the wider infra-red cameras see no end of it."""
MIN_PLANE = 0.05
"""Least fraction of the room's pixels on a plane of the room; smaller planes are faces of things."""
ON_PLANE = 8.0
"""Standard deviations of the noise within which a pixel is on a plane. Stereo noise is correlated over a window, and a
table is no perfect plane, so three would leave holes."""
BEHIND_PLANE = 0.05
"""Largest fraction of the pixels on one plane of a room that another plane may hide: planes that bound a room from
outside hide nothing of each other, faces of things do."""
FARTHEST_M = 5.0
"""Largest depth of a room, metres. A plane that goes on behind the objects ends there, so that no mesh reaches the
horizon."""
CUT_M = 0.015
"""Jump of z between neighbouring vertices, metres, at which a mesh of the room is cut: at ROOM_STEP pixels and 0.5 m a
surface that is seen at 80 degrees changes by 12 mm."""
RIM_WALL_M = 1e-4
"""Least distance in metres between the faces of a second wall and of the first, or the room."""
LARGEST_REFLECTANCE = 0.85
"""Reflectance of the brightest pixels (99.5 %) of the colour image; white paint and paper."""
LEAST_REFLECTANCE = 0.02
"""Least reflectance; black plastic and leather."""
SHADOW = 24
"""Pixels around a mask whose grey values are not those of the room: the objects shade it when they are opaque."""
Glass = Literal["wall", "thin", "two walls", "solid", "none"]
"""What the front surfaces are made into; see `scene_dictionary`."""


@dataclass(frozen=True)
class Plane:
    """A plane with inverse depth q = ax x + ay y + c at pixel coordinates (x, y), per metre."""

    ax: float
    ay: float
    c: float

    def inverse_depth(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Inverse depth (per metre) at pixel coordinates; not positive where the plane is not in front."""
        return np.asarray(self.ax * x + self.ay * y + self.c)


@dataclass(frozen=True)
class Rebuilt:
    """A scene rebuilt from depth.

    camera : Intrinsics of the depth image.
    fronts : one (h, w) float64 for each object, z of its front surface, metres; NaN elsewhere.
    planes : planes of the room, the largest first.
    things : (h, w) float64, z of what is in the room beside its planes and the objects, metres; NaN where the planes
        are seen.
    """

    camera: Intrinsics
    fronts: list[np.ndarray]
    planes: list[Plane]
    things: np.ndarray

    @property
    def front(self) -> np.ndarray:
        """(h, w) float64, z of the nearest front surface, metres; NaN where there is none."""
        return np.fmin.reduce([np.full(self.things.shape, np.nan), *self.fronts])

    @property
    def behind(self) -> np.ndarray:
        """(h, w) float64, z of the room without the objects, metres."""
        return np.fmin(self.things, room_depth(self.planes, *_coordinates(self.things.shape)))


def rebuild(camera: Intrinsics, z: np.ndarray, mask: np.ndarray, sigma_q: float) -> Rebuilt:
    """The scene of a depth image.

    Parameters
    ----------
    z : (h, w) float, depth with opaque objects, metres; NaN where unknown.
    mask : (h, w) bool, where the objects are.
    sigma_q : standard deviation of 1 / z, per metre.
    """
    q = 1 / z
    near_objects = cv2.dilate(mask.astype(np.uint8), np.ones((2 * MARGIN + 1, 2 * MARGIN + 1))) > 0
    room = np.where(near_objects, np.nan, q)
    planes = room_planes(room, sigma_q)
    labels, n = ndimage.label(mask)
    parts = [labels == i for i in range(1, n + 1)]
    fronts = [front for part in parts if (front := front_surface(np.where(part, q, np.nan), part, sigma_q)) is not None]
    return Rebuilt(camera, fronts, planes, things_in_room(room, planes, sigma_q))


# ---- Planes ----------------------------------------------------------------------------------------------------------


def room_planes(q: np.ndarray, sigma_q: float, seed: int = 0) -> list[Plane]:
    """Planes of a room, at most three, from inverse depth (h, w), per metre, NaN where unknown.

    Each is the plane of most pixels that no plane before it holds (RANSAC, then least squares on those pixels).
    """
    y, x = np.nonzero(np.isfinite(q))
    values, rng = q[y, x], np.random.default_rng(seed)
    x, y = x + 0.5, y + 0.5
    left, planes, total = np.ones(len(values), bool), [], len(values)
    for _ in range(6):
        if left.sum() < max(3, MIN_PLANE * total):
            break
        plane, on = largest_plane(x[left], y[left], values[left], ON_PLANE * sigma_q, rng)
        if on.sum() < MIN_PLANE * total:
            break
        members = np.flatnonzero(left)[on]
        left[members] = False
        hidden = [plane.inverse_depth(x[m], y[m]) > values[m] + ON_PLANE * sigma_q for _, m in planes]
        hiding = [p.inverse_depth(x[members], y[members]) > values[members] + ON_PLANE * sigma_q for p, _ in planes]
        if all(h.mean() < BEHIND_PLANE for h in hidden + hiding):
            planes.append((plane, members))
    return [plane for plane, _ in planes[:3]]


def largest_plane(
    x: np.ndarray, y: np.ndarray, q: np.ndarray, tolerance: float, rng: np.random.Generator
) -> tuple[Plane, np.ndarray]:
    """The plane of most of n pixels (RANSAC, then least squares), and which pixels (n,) bool are on it.

    x, y : (n,) pixel coordinates. q : (n,) float, inverse depth, per metre.
    tolerance : largest distance from the plane of a pixel that is on it, per metre.
    """
    design = np.stack([x, y, np.ones_like(x)], axis=1)
    some = rng.choice(len(q), size=min(len(q), 4000), replace=False)
    best, most = np.zeros(3), -1
    for _ in range(500):  # finds a plane of 20 % of the pixels with a chance of 98 %
        three = rng.choice(len(q), size=3, replace=False)
        try:
            guess = np.linalg.solve(design[three], q[three])
        except np.linalg.LinAlgError:
            continue
        count = int((np.abs(design[some] @ guess - q[some]) < tolerance).sum())
        if count > most:
            best, most = guess, count
    for _ in range(10):
        on = np.abs(design @ best - q) < tolerance
        if on.sum() < 3:
            break
        best = np.linalg.lstsq(design[on], q[on], rcond=None)[0]
    return Plane(*map(float, best)), np.abs(design @ best - q) < tolerance


def room_depth(planes: list[Plane], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """z in metres of the nearest plane at pixel coordinates; NaN where none is in front of the camera within
    `FARTHEST_M`."""
    least = 1 / FARTHEST_M
    q = np.max([np.full(np.shape(x), least), *(plane.inverse_depth(x, y) for plane in planes)], axis=0)
    return np.where(q > least, 1 / q, np.nan)


# ---- Surfaces --------------------------------------------------------------------------------------------------------


def front_surface(q: np.ndarray, mask: np.ndarray, sigma_q: float, step: int = FRONT_STEP) -> np.ndarray | None:
    """(h, w) float64, z in metres of the smoothest surface through a depth image; NaN outside the mask.

    It minimises the sum of w (u - q)^2 over known pixels plus s times the squared second derivatives of u over all of
    the mask (a thin plate). So it also fills holes, and goes on straight where depth is missing at the boundary; a
    plane stays a plane. The stiffness s is as large as the noise allows: the residuals then have a standard deviation
    of `sigma_q` (Morozov's discrepancy principle). Weights w of outliers (Cauchy's) keep flying pixels away.

    Parameters
    ----------
    q : (h, w) inverse depth, per metre, NaN where unknown. mask : (h, w) bool.
    step : pixels between the nodes of the surface; between nodes it is linear.

    Returns
    -------
    None if the mask holds too few nodes with depth.
    """
    rows, columns = np.nonzero(mask)
    top, left = rows.min() - 2 * step, columns.min() - 2 * step
    height, width = (rows.max() - top) // step + 4, (columns.max() - left) // step + 4
    y, x = top + step * np.arange(height), left + step * np.arange(width)
    inside = cv2.dilate(mask.astype(np.uint8), np.ones((2 * step + 1, 2 * step + 1)))
    active = _read(inside, y, x) > 0  # one node beyond the mask, so that all of its pixels lie between nodes
    number = _numbered(active)
    known = np.isfinite(q)
    at_y, at_x = np.nonzero(known)
    if len(at_y) < 30:
        return None
    sample, thin = _interpolation(at_y, at_x, top, left, step, number), _second_derivatives(number)
    data, target = q[at_y, at_x], np.sqrt(2 / np.pi) * sigma_q
    weights = np.ones(len(data))
    low, high = -3.0, 9.0  # decades of the stiffness
    for _ in range(14):
        stiffness = 10 ** ((low + high) / 2)
        normal = sample.T @ sparse.diags(weights) @ sample + stiffness * thin.T @ thin
        u = spsolve((normal + 1e-9 * sparse.eye(normal.shape[0])).tocsc(), sample.T @ (weights * data))
        residual = sample @ u - data
        if np.average(np.abs(residual), weights=weights) > target:
            high = (low + high) / 2
        else:
            low = (low + high) / 2
        weights = 1 / (1 + (residual / (3 * sigma_q)) ** 2)
    in_y, in_x = np.nonzero(mask)
    result = np.full(mask.shape, np.nan)
    result[in_y, in_x] = 1 / (_interpolation(in_y, in_x, top, left, step, number) @ u)
    return result


def _read(image: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Values at the crossings of rows and columns; outside of the image, the nearest value of its border."""
    height, width = image.shape
    return np.asarray(image[np.clip(y, 0, height - 1)[:, None], np.clip(x, 0, width - 1)])


def _numbered(used: np.ndarray) -> np.ndarray:
    """(h, w) int, numbers from 0 of the nodes that are used, row by row; -1 for the others."""
    number = np.full(used.shape, -1)
    number[used] = np.arange(used.sum())
    return number


def _interpolation(y: np.ndarray, x: np.ndarray, top: int, left: int, step: int, number: np.ndarray) -> Any:
    """Sparse matrix of bilinear interpolation from nodes to pixels."""
    row, column = (y - top) // step, (x - left) // step
    v, u = (y - top) / step - row, (x - left) / step - column
    pixel = np.arange(len(y))
    weights = [(0, 0, (1 - v) * (1 - u)), (0, 1, (1 - v) * u), (1, 0, v * (1 - u)), (1, 1, v * u)]
    used = [(pixel, number[row + i, column + j], w) for i, j, w in weights]
    r, c, w = (np.concatenate(part) for part in zip(*used, strict=True))
    keep = c >= 0
    return sparse.csr_matrix((w[keep], (r[keep], c[keep])), shape=(len(y), int(number.max()) + 1))


def _second_derivatives(number: np.ndarray) -> Any:
    """Sparse matrix of u_xx, u_yy and sqrt(2) u_xy at the nodes (numbered, -1: none) whose neighbours exist."""
    stencils = (
        ([(0, -1), (0, 0), (0, 1)], [1, -2, 1]),
        ([(-1, 0), (0, 0), (1, 0)], [1, -2, 1]),
        ([(0, 0), (0, 1), (1, 0), (1, 1)], [2**0.5, -(2**0.5), -(2**0.5), 2**0.5]),
    )
    rows, columns, values, n = [], [], [], 0
    padded = np.pad(number, 1, constant_values=-1)
    for places, weights in stencils:
        nodes = np.stack([np.roll(padded, (-i, -j), axis=(0, 1)).ravel() for i, j in places])
        nodes = nodes[:, (nodes >= 0).all(axis=0)]
        count = nodes.shape[1]
        rows.append(np.tile(np.arange(n, n + count), len(places)))
        columns.append(nodes.ravel())
        values.append(np.repeat(np.array(weights, dtype=float), count))
        n += count
    at = (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_matrix((np.concatenate(values), at), shape=(n, int(number.max()) + 1))


def things_in_room(q: np.ndarray, planes: list[Plane], sigma_q: float) -> np.ndarray:
    """(h, w) float64, z in metres of what is not on the planes; NaN on the planes and where nothing is known.

    A hole takes the farther one of its two neighbours in the row, because it is the shadow of the nearer one
    (Hirschmueller, Stereo processing by semiglobal matching and mutual information, PAMI 30, 2008).
    """
    plane_q = 1 / room_depth(planes, *_coordinates(q.shape))
    on_plane = np.abs(q - plane_q) < ON_PLANE * sigma_q
    seen = np.where(on_plane, plane_q, q)
    farther = np.fmin(_carried(seen), _carried(seen[:, ::-1])[:, ::-1])
    filled = np.where(np.isfinite(q), seen, farther)
    filled = cv2.medianBlur(np.nan_to_num(filled, nan=0.0).astype(np.float32), 5).astype(np.float64)
    is_thing = (filled > 0) & ~(np.abs(filled - plane_q) < ON_PLANE * sigma_q)
    is_thing = cv2.morphologyEx(is_thing.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2 * ROOM_STEP + 1,) * 2)) > 0
    with np.errstate(divide="ignore"):
        return np.where(is_thing, 1 / filled, np.nan)


def _carried(values: np.ndarray) -> np.ndarray:
    """Values (h, w) in which each NaN takes the last number to its left."""
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(values.shape[1]), 0), axis=1)
    return np.take_along_axis(values, last, axis=1)


# ---- The scene -------------------------------------------------------------------------------------------------------


def reflectances(grey: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(h, w) float32, reflectances of the room from a grey image (0..255) of sRGB, without the objects.

    The image is taken for evenly lit, so shading counts as reflectance. Behind the objects, the room takes the mean of
    what is around them.
    """
    value = grey / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    size = 2 * SHADOW + 1
    seen = (cv2.dilate(mask.astype(np.uint8), np.ones((size, size))) == 0).astype(np.float64)
    total, weight = (cv2.GaussianBlur(image, (0, 0), 2.0 * SHADOW) for image in (linear * seen, seen))
    linear = np.where(seen > 0, linear, total / np.maximum(weight, 1e-12))
    scaled = LARGEST_REFLECTANCE * linear / np.quantile(linear, 0.995)
    return np.clip(scaled, LEAST_REFLECTANCE, LARGEST_REFLECTANCE).astype(np.float32)


def scene_dictionary(
    rebuilt: Rebuilt, reflectance: np.ndarray, folder: Path, glass: Glass = "wall", wall_m: float = 2.5e-3,
    int_ior: float = 1.5, alpha: float = 0.0,
) -> dict[str, Any]:  # fmt: skip
    """Mitsuba scene dictionary for `load_scene`, in metres, lit by a constant emitter of radiance 1 / pi.

    An open surface thus receives an irradiance of 1 W/m2. Meshes and the texture are files in `folder`.

    Parameters
    ----------
    reflectance : (h, w) float32 of the room.
    glass : "wall": a wall of `wall_m` of glass in each front surface, with nothing behind it; "thin": a
        `thindielectric`; "two walls": a second wall, which is the first one mirrored in the plane of its boundary;
        "solid": glass all the way between these; "none": no objects.
    int_ior : refractive index of the glass. alpha : its roughness; 0: smooth.
    """
    import mitsuba as mi

    select_variant()
    camera = rebuilt.camera
    bitmap = np.pad(reflectance, OUTSIDE_PX, mode="reflect")
    cv2.imwrite(str(folder / "reflectance.png"), np.round(65535 * bitmap).astype(np.uint16))
    paint = {
        "type": "twosided",
        "bsdf": {
            "type": "diffuse",
            "reflectance": {"type": "bitmap", "filename": str(folder / "reflectance.png"), "raw": True},
        },
    }
    smooth = {"type": "dielectric", "int_ior": int_ior}
    rough = {"type": "roughdielectric", "int_ior": int_ior, "alpha": alpha}
    material = {"type": "thindielectric", "int_ior": int_ior} if glass == "thin" else rough if alpha > 0 else smooth
    scene: dict[str, Any] = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx))),
            "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 0, 1], up=[0, -1, 0]),
            "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height},
        },
        "light": {"type": "constant", "radiance": 1 / np.pi},
    }
    for name, mesh in {"room": _room_mesh(rebuilt), "things": _things_mesh(rebuilt)}.items():
        if len(mesh[1]):
            _write_ply(folder / f"{name}.ply", *mesh, camera)
            scene[name] = {"type": "ply", "filename": str(folder / f"{name}.ply"), "face_normals": True, "bsdf": paint}
    for number, front in enumerate(rebuilt.fronts if glass != "none" else ()):
        for part, mesh in _glass_meshes(camera, front, rebuilt.behind, glass, wall_m).items():
            path = folder / f"glass_{number}_{part}.ply"
            _write_ply(path, *mesh, camera)
            scene[path.stem] = {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": material}
    return scene


def _coordinates(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the pixel centres of an image, each (h, w)."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    return x, y


def _points(camera: Intrinsics, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Points (..., 3) at depth z on the rays of pixel coordinates, metres."""
    return np.asarray(camera.directions(np.stack([x, y], axis=-1)) * z[..., None])


def _lattice_faces(number: np.ndarray) -> np.ndarray:
    """Triangles (m, 3) between numbered nodes (h, w) of a lattice; -1: no node. They face the camera."""
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = np.concatenate([np.stack([a, c, b], axis=-1).reshape(-1, 3), np.stack([b, c, d], axis=-1).reshape(-1, 3)])
    return np.asarray(faces[(faces >= 0).all(axis=1)])


def _sheet(camera: Intrinsics, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a surface over a lattice of pixel coordinates; NaN: no vertex."""
    used = np.isfinite(z)
    return _points(camera, x, y, z)[used], _lattice_faces(_numbered(used))


def _room_mesh(rebuilt: Rebuilt) -> tuple[np.ndarray, np.ndarray]:
    """The planes of the room, also beyond the image and behind objects and things; not where farther things are."""
    height, width = rebuilt.things.shape
    y, x = np.mgrid[-OUTSIDE_PX : height + OUTSIDE_PX : ROOM_STEP, -OUTSIDE_PX : width + OUTSIDE_PX : ROOM_STEP] + 0.5
    z = room_depth(rebuilt.planes, x, y)
    farther = np.nan_to_num(rebuilt.things) > room_depth(rebuilt.planes, *_coordinates(rebuilt.things.shape))
    inside = (x > 0) & (x < width) & (y > 0) & (y < height)
    z[inside] = np.where(farther[y[inside].astype(int), x[inside].astype(int)], np.nan, z[inside])
    return _sheet(rebuilt.camera, x, y, z)


def _things_mesh(rebuilt: Rebuilt) -> tuple[np.ndarray, np.ndarray]:
    """Things and a fringe of the planes around them, cut where z jumps."""
    near = cv2.dilate(np.isfinite(rebuilt.things).astype(np.uint8), np.ones((2 * ROOM_STEP + 1,) * 2)) > 0
    x, y = _coordinates(rebuilt.things.shape)
    z = np.where(near, rebuilt.behind, np.nan)
    vertices, faces = _sheet(rebuilt.camera, *(a[::ROOM_STEP, ::ROOM_STEP] for a in (x, y, z)))
    jump = np.ptp(vertices[faces][..., 2], axis=1)
    return vertices, faces[jump < CUT_M]


def _glass_meshes(
    camera: Intrinsics, front: np.ndarray, behind: np.ndarray, glass: Glass, wall_m: float
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Meshes of one object: its front wall, its second wall, or its whole body."""
    x, y = (a[::FRONT_STEP, ::FRONT_STEP] for a in _coordinates(front.shape))
    z, room = front[::FRONT_STEP, ::FRONT_STEP], behind[::FRONT_STEP, ::FRONT_STEP]
    used = np.isfinite(z)
    if glass == "thin":
        return {"front": _sheet(camera, x, y, z)}
    design = np.stack([x, y, np.ones_like(x)], axis=-1)
    boundary = used & ~ndimage.binary_erosion(used, iterations=2)
    rim = 1 / (design @ np.linalg.lstsq(design[boundary], 1 / z[boundary], rcond=None)[0])
    mirrored = np.fmin(np.fmax(2 * rim - z, z + 2 * wall_m + RIM_WALL_M), room - wall_m - RIM_WALL_M)
    if glass == "solid":
        return {"body": _shell(_points(camera, x, y, z), _points(camera, x, y, np.fmax(mirrored, z + wall_m)), used)}
    walls = {"front": _shell(points := _points(camera, x, y, z), points - wall_m * _normals(points), used)}
    if glass == "two walls":
        points = _points(camera, x, y, mirrored)
        walls["back"] = _shell(points, points - wall_m * _normals(points), used & (mirrored > z + wall_m + RIM_WALL_M))
    return walls


def _normals(points: np.ndarray) -> np.ndarray:
    """(h, w, 3) unit normals towards the camera of a lattice of points; central differences, one-sided at borders."""

    def difference(axis: int) -> np.ndarray:
        ahead = np.roll(points, -1, axis) - points
        back = points - np.roll(points, 1, axis)
        one = np.where(np.isfinite(ahead), ahead, back)
        both = np.where(np.isfinite(ahead + back), (ahead + back) / 2, one)
        return np.nan_to_num(both)

    normal = np.cross(difference(0), difference(1))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    toward = -points / np.linalg.norm(points, axis=-1, keepdims=True)
    return np.where(length > 0, normal / np.where(length > 0, length, 1), toward)


def _shell(near: np.ndarray, far: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the closed body between two lattices of points (h, w, 3); faces point outwards."""
    faces, n = _lattice_faces(_numbered(used)), int(used.sum())
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys, back = edges[:, 0] * n + edges[:, 1], edges[:, 1] * n + edges[:, 0]
    open_edges = edges[~np.isin(keys, back)]
    a, b = open_edges[:, 0], open_edges[:, 1]
    sides = np.concatenate([np.stack([b, a, a + n], axis=1), np.stack([b, a + n, b + n], axis=1)])
    return np.concatenate([near[used], far[used]]), np.concatenate([faces, faces[:, ::-1] + n, sides])


def _write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray, camera: Intrinsics) -> None:
    """A binary PLY whose texture coordinates are the places of the vertices in the padded image."""
    size = np.array([camera.width, camera.height]) + 2 * OUTSIDE_PX
    uv = (camera.project(vertices) + OUTSIDE_PX) / size
    table = np.empty(len(vertices), dtype=[(name, "<f4") for name in ("x", "y", "z", "u", "v")])
    for name, column in zip(table.dtype.names or (), np.column_stack([vertices, uv]).T, strict=True):
        table[name] = column
    triangles = np.empty(len(faces), dtype=[("n", "u1"), ("i", "<i4", 3)])
    triangles["n"], triangles["i"] = 3, faces
    names = "".join(f"property float {name}\n" for name in table.dtype.names or ())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{names}"
    header += f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(header.encode() + table.tobytes() + triangles.tobytes())
