# SPDX-License-Identifier: Apache-2.0
"""Range images of scanners and fisheyes as depth images, which the rest of this room takes.

The directions of the rays are triangulated on the unit sphere (their Delaunay triangulation is the convex hull of the
unit vectors, Brown 1979). The triangles whose readings lie on one surface are a mesh. Virtual pinhole cameras at the
centre of the rays, one for each face of a cube, see this mesh. So no order of the rays is needed: rings, fisheyes, and
the patterns of mirrors and prisms are treated alike.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.fusion.mesh_error import raycasting_scene
from rangesim.fusion.sdf import MAX_DEPTH_STEP, check_view
from rangesim.rig import Array, Camera, Intrinsics
from rangesim.triangle_mesh import TriangleMesh

MAX_CENTRE_SPREAD = 0.05
"""Largest distance between the origin of a ray and the mean of all, as a fraction of the median range. Up to it, rays
are taken to start at one centre. The readings keep their places; only the space that counts as seen in front of them is
that of the centre. Turning heads have a few percent, telecentric lenses far more."""
MAX_GAP = 4.0
"""Largest radius of the circle through the directions of a triangle, in medians of all. Larger triangles lie where no
ray leads, such as below the lowest ring. A larger value closes such gaps, a smaller one opens the space between rings
that are unevenly spaced."""
MIN_BEND_COSINE = np.cos(np.radians(30.0))
"""Smallest cosine (a ratio) of the angle by which a slanted surface bends from one reading to the next but one.
Readings one ring apart on the ground differ by far more than `MAX_DEPTH_STEP`; they are connected because the ground
goes on in the same direction. A larger angle connects objects with what is behind them."""
MARGIN_PX = 4
"""Pixels by which the virtual cameras overlap on each side, so that the pixels at their borders have neighbours."""
MAX_FACE_PX = 2048
"""Largest width of a virtual camera in pixels; 16 million pixels for a whole sphere. Finer scanners are read more
coarsely."""


def pinhole_views(image: RangeImage) -> tuple[RangeImage, ...]:
    """Depth images of pinhole cameras that together show what a range image shows.

    Of a pinhole camera, it is the image itself. Of every other camera, there are up to six images, each of one face of
    a cube around the centre of the rays, cropped to the readings; none if no readings are neighbours. A virtual pixel
    is as wide as the typical distance of a ray to its nearest neighbour. Its depth is that of the plane through the
    three readings around it. Between readings of different surfaces, and beside failed ones, its status is LOW_SIGNAL.

    Raises
    ------
    ValueError
        The image has no camera or pose, or another size than its camera; its rays start at places too far apart, or all
        of them lie in one plane.

    Examples
    --------
    A head with 16 rings turns in the middle of a ball of 2 m radius:

    >>> import numpy as np
    >>> from rangesim import RangeImage, Spinning
    >>> from rangesim.fusion import pinhole_views
    >>> head = Spinning(elevations_deg=tuple(range(-16, 16, 2)), columns=360)
    >>> range_m = np.full((16, 360), 2.0, np.float32)
    >>> z = head.z_of(range_m).astype(np.float32)
    >>> one = np.ones(z.shape, np.float32)
    >>> views = pinhole_views(RangeImage(z, range_m, one, np.zeros(z.shape, np.uint8), one, head, np.eye(4)))
    >>> len(views), views[0].z.shape, round(float(np.nanmax(views[0].range_m)), 3)
    (4, (45, 122), 2.0)
    """
    T = check_view(image)
    return tuple(replace(view, T_world_camera=T @ np.asarray(view.T_world_camera)) for view in local_views(image))


def local_views(image: RangeImage) -> tuple[RangeImage, ...]:
    """The images of `pinhole_views`, whose poses are in coordinates of the camera instead of the world."""
    camera = image.camera
    if camera is None:
        raise ValueError("expected a calibrated range image: without a rig it has no place among other views.")
    if camera.is_pinhole:
        return (replace(image, T_world_camera=np.eye(4)),)
    if not image.valid.any():
        return ()
    surface = _Surface.of(image, camera)
    if not len(surface.mesh.faces):
        return ()
    scene, scene_origin = raycasting_scene(surface.mesh)
    seen = (surface.seen_by(R, scene, scene_origin) for R in _cube_faces())
    return tuple(view for view in seen if view is not None)


class _Surface(NamedTuple):
    """The surface between the readings of an image, around the centre of its rays.

    centre : (3,) float64, metres, camera coordinates.
    mesh : its corners are the readings, metres, relative to the centre.
    values : (n, 2) float32, confidence and intensity of each corner.
    pixel_rad : radians, median distance of a ray to its nearest neighbour.
    """

    centre: Array
    mesh: TriangleMesh
    values: np.ndarray
    pixel_rad: float

    @classmethod
    def of(cls, image: RangeImage, camera: Camera) -> _Surface:
        """The surface of the readings of an image."""
        origins = camera.rays.origins.reshape(-1, 3)
        centre = origins.mean(axis=0)
        spread = float(np.linalg.norm(origins - centre, axis=-1).max())
        typical_m = float(np.median(image.range_m[image.valid]))
        if spread > MAX_CENTRE_SPREAD * typical_m:
            raise ValueError(
                f"expected rays from one place, whose range images can be fused to a surface, got origins up to "
                f"{spread:.3g} m from their mean at a median range of {typical_m:.3g} m ({type(camera).__name__})."
            )
        order = _ray_order(camera)
        points = np.where(image.valid[..., None], camera.points(image), np.nan)[order.leads] - centre
        used, corners = np.unique(order.triangles[_is_surface(points, order)], return_inverse=True)
        values = np.stack([image.confidence, image.intensity], axis=-1)[order.leads][used]
        return cls(centre, TriangleMesh(points[used], corners.reshape(-1, 3)), values, order.pixel_rad)

    def seen_by(self, R: Array, scene: Any, scene_origin: Array) -> RangeImage | None:
        """The surface as a virtual camera at the centre sees it; None if it sees nothing.

        R : (3, 3), rotation from the virtual camera to the one of the image.
        scene, scene_origin : Open3D's scene of the mesh, and its origin (3,), metres, see `raycasting_scene`.
        """
        import open3d as o3d

        half = min(MAX_FACE_PX, int(np.ceil(2.0 / self.pixel_rad))) / 2
        size = int(2 * half) + 2 * MARGIN_PX
        whole = Intrinsics(size, size, half, half, size / 2, size / 2)
        pixels = whole.project(self.mesh.vertices @ R)
        inside = pixels[((pixels >= 0) & (pixels < size)).all(axis=-1)]  # False with NaN
        if not len(inside):
            return None
        left, top = np.floor(inside.min(axis=0)).astype(int)
        right, bottom = np.floor(inside.max(axis=0)).astype(int) + 1
        camera = whole.cropped(top, bottom, left, right)
        rays = camera.directions(camera.pixel_centres())
        starts = np.broadcast_to(-scene_origin, rays.shape)
        hit = scene.cast_rays(o3d.core.Tensor(np.concatenate([starts, rays @ R.T], axis=-1).astype(np.float32)))
        z, uv = hit["t_hit"].numpy(), hit["primitive_uvs"].numpy()
        is_hit = np.isfinite(z)
        z = np.where(is_hit, z, np.float32(np.nan))
        corners = self.mesh.faces[np.where(is_hit, hit["primitive_ids"].numpy(), 0).astype(np.int64)]
        shares = np.stack([1 - uv.sum(axis=-1), uv[..., 0], uv[..., 1]], axis=-1) * is_hit[..., None]
        confidence, intensity = np.moveaxis((shares[..., None] * self.values[corners]).sum(axis=-2), -1, 0)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, self.centre
        return RangeImage(
            z, (z * np.linalg.norm(rays, axis=-1)).astype(np.float32), confidence.astype(np.float32),
            np.where(is_hit, Status.OK, Status.LOW_SIGNAL).astype(np.uint8), intensity.astype(np.float32), camera, T,
        )  # fmt: skip


class _RayOrder(NamedTuple):
    """Neighbourhood of the rays of a camera.

    leads : (h, w) bool, pixels that have a ray; those beside the image of a fisheye have none. n of them do.
    triangles : (m, 3) int32, indices of neighbouring rays, without triangles that cover a gap between rays.
    beside : (m, 3) int64, triangle beyond the edge opposite each corner; -1: none.
    pixel_rad : radians, median distance of a ray to its nearest neighbour.
    """

    leads: np.ndarray
    triangles: np.ndarray
    beside: np.ndarray
    pixel_rad: float


@lru_cache(maxsize=4)  # the views of a scan have one camera, and the hull of 65 000 rays takes a second
def _ray_order(camera: Camera) -> _RayOrder:
    """Neighbourhood of the rays of a camera."""
    leads = np.asarray(np.isfinite(camera.rays.directions).all(axis=-1))
    directions = camera.rays.directions[leads]
    try:
        hull = ConvexHull(directions)
    except QhullError:
        raise ValueError("expected rays that do not all lie in one plane, whose readings span a surface.") from None
    radius = np.arccos(np.clip(-hull.equations[:, 3], -1.0, 1.0))  # the plane's distance is the cosine of the circle
    is_near = radius <= MAX_GAP * np.median(radius)
    number = np.where(is_near, np.cumsum(is_near) - 1, -1)
    triangles = hull.simplices[is_near]
    sides = directions[triangles] - directions[np.roll(triangles, 1, axis=1)]
    pixel_rad = float(np.median(np.linalg.norm(sides, axis=-1).min(axis=1)))
    return _RayOrder(leads, triangles.astype(np.int32), number[hull.neighbors[is_near]], pixel_rad)


def _is_surface(points: Array, order: _RayOrder) -> np.ndarray:
    """Whether the readings of each triangle lie on one surface: (m,) bool.

    They do if their ranges differ by `MAX_DEPTH_STEP` at most, or if the surface goes straight on through the edge
    along which the range changes least, from the third corner of the triangle beyond this edge to that of the triangle
    itself. Across an edge of an object it does not. Noise along that edge, where readings are close together, does not
    count.

    points : (n, 3), metres, readings from the centre; NaN where there is none.
    """
    ranges = np.linalg.norm(points, axis=-1)[order.triangles]
    with np.errstate(invalid="ignore", divide="ignore"):
        is_level = np.ptp(ranges, axis=-1) <= MAX_DEPTH_STEP * ranges.min(axis=-1)  # False with NaN
    steps = np.abs(np.roll(ranges, -1, axis=1) - np.roll(ranges, -2, axis=1))  # along the edge opposite each corner
    number = np.arange(len(steps))
    third = np.nan_to_num(steps, nan=np.inf).argmin(axis=1)
    beyond = order.beside[number, third]
    ends = order.triangles[number[:, None], (third[:, None] + [1, 2]) % 3]
    apex = order.triangles[number, third]
    other = order.triangles[beyond].sum(axis=1) - ends.sum(axis=1)  # the third corner beyond the edge
    middle = points[ends].mean(axis=1)
    towards, onwards = middle - points[np.where(beyond >= 0, other, apex)], points[apex] - middle
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = (towards * onwards).sum(axis=-1) / np.linalg.norm(towards, axis=-1) / np.linalg.norm(onwards, axis=-1)
    return np.asarray(is_level | ((beyond >= 0) & (cosine >= MIN_BEND_COSINE)))


def _cube_faces() -> tuple[Array, ...]:
    """Rotations (3, 3) from six cameras, whose axes are those of the faces of a cube, to the one they stand in."""
    turns = [Rotation.from_euler("y", angle, degrees=True) for angle in (0, 90, 180, 270)]
    tilts = [Rotation.from_euler("x", angle, degrees=True) for angle in (90, -90)]
    return tuple(np.round(turn.as_matrix()) for turn in turns + tilts)
