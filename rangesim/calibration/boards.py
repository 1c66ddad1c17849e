# SPDX-License-Identifier: Apache-2.0
"""Calibration boards: the points of a board, its picture, the detection of its points, and a scene with the board.

The frame of a board has its origin at the first point, x along a row of points, y along a column and z into the board.
A camera straight in front of the board has the same axes. Pixel centres are at integer + 0.5. OpenCV, which finds the
points, has pixel centres at integers; only this module adds the difference.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangesim.rig import Intrinsics, pose
from rangesim.settings.bounds import Bounds, check_fields, whole

Array = NDArray[np.float64]

EDGE_POINTS = 64
"""Number of points on the edge of a disc. Their polygon gives the centroid of the disc's image. The centroids of
polygon and disc are equal to rounding, as long as the distortion of the lens hardly bends one side of the polygon.
Fewer points make longer sides, which it bends more; more points take longer."""
INK_REFLECTANCE = 0.05
"""Reflectance of the ink of a rendered board, a fraction, like black print. A higher value leaves less contrast at the
corners."""
BOARD_REFLECTANCE = 0.8
"""Reflectance of a rendered board beside the ink, a fraction, like white paper. A lower value leaves less contrast at
the corners."""
MIN_MOVE_PX = 0.15
"""Smallest value, in pixels, of the limit on how far a corner may move when the search window becomes half as wide.
Measured in 36 rendered views: good corners move by at most 0.14 px, and corners beside the edge of the light by 3.5 to
4.1 px."""
MAX_MOVE_RATIO = 8.0
"""Limit on the same move, as a multiple of the median move of all corners of the view, if that is larger than
`MIN_MOVE_PX`. It grows with the median, because in a blurred or noisy view all corners move more. A smaller multiple
would leave out good corners, a larger one would keep corners that another edge draws away."""
Count = Annotated[int, whole(2)]
"""A number of points along a side of a board, at least two: one row has no second direction."""
Length = Annotated[float, Bounds("positive metres", 1e-6, 1e3)]
"""A length on a board, metres, from a micrometre to a kilometre. A number outside these bounds is in another unit by
mistake."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """The points of a board that were found in an image.

    indices : (m,) int64, rows of `Board.points`, ascending. Points that are hidden, or beside the edge of a shadow or
        of the light, are missing.
    pixels : (m, 2) float64, their pixels (x, y), with pixel centres at integer + 0.5.

    Examples
    --------
    >>> board = Checkerboard(columns=5, rows=4, square_m=0.03)
    >>> view = board.find(board.image(32))  # its own picture, with squares of 32 pixels
    >>> view.indices.size, view.pixels[0].round(2)
    (20, array([64., 64.]))
    """

    indices: NDArray[np.int64]
    pixels: Array


@dataclass(frozen=True)
class Board(ABC):
    """A plane with a grid of points that a camera can find.

    columns, rows : numbers of points along x and y.

    Examples
    --------
    See `Checkerboard`, `CharucoBoard` and `CircleGrid`.
    """

    columns: Count
    rows: Count

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    @abstractmethod
    def spacing_m(self) -> float:
        """Distance between neighbouring points, metres."""

    @property
    def points(self) -> Array:
        """(columns * rows, 3) float64, the points in board coordinates, metres, row by row; z = 0."""
        y, x = np.mgrid[: self.rows, : self.columns].reshape(2, -1) * self.spacing_m
        return np.stack([x, y, np.zeros(len(x))], axis=-1)

    def seen_points(self, camera: Intrinsics, T_camera_board: ArrayLike) -> Array:
        """(columns * rows, 3) float64, the positions on the board that `find` detects as its points, metres.

        They are `points` for corners, which have no size. A `CircleGrid` overrides this.

        T_camera_board : (4, 4) maps board coordinates to those of the camera.
        """
        return self.points

    @property
    @abstractmethod
    def margin(self) -> int:
        """Distance from the first and the last point to the edges of the board, in spacings."""

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the board, metres."""
        return tuple((n - 1 + 2 * self.margin) * self.spacing_m for n in (self.columns, self.rows))  # type: ignore[return-value]

    @abstractmethod
    def image(self, pixels_per_spacing: int = 64) -> Array:
        """(h, w) float64, the picture of the board, 0 for ink and 1 for board; x to the right, y down."""

    @abstractmethod
    def _find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.int64], Array] | None:
        """Indices (m,) and pixels (m, 2) of the points, with pixel centres at integers; None if there is no board."""

    def find(self, image: ArrayLike) -> BoardView:
        """The points of the board in an image.

        Parameters
        ----------
        image : (h, w), brightness in any unit and of any number type. Its range is scaled to 8 bits, with the 0.1 %
            darkest and brightest pixels clipped.

        Raises
        ------
        ValueError
            The image is not an array (h, w) of finite numbers, or no board is found in it.

        Examples
        --------
        See `BoardView`.
        """
        values = np.asarray(image)
        if values.ndim != 2 or values.dtype.kind not in "uif" or not values.size:
            raise ValueError(f"expected a grey image (h, w), got shape {values.shape} of {values.dtype}.")
        values = values.astype(np.float64)
        if not np.isfinite(values).all():
            raise ValueError("expected an image with finite values, got NaN or infinity.")
        low, high = np.quantile(values, [0.001, 0.999])
        grey = (255.0 * np.clip((values - low) / max(high - low, 1e-300), 0.0, 1.0)).astype(np.uint8)
        found = self._find(grey)
        if found is None:
            raise ValueError(
                f"expected a {type(self).__name__} of {self.columns} x {self.rows} points in the image, found none; "
                "the whole board must be in the image, sharp and evenly lit (for a CharucoBoard, parts are enough)."
            )
        indices, pixels = found
        order = np.argsort(indices)
        return BoardView(indices[order].astype(np.int64), pixels[order].astype(np.float64) + 0.5)

    def scene(self, T_world_board: ArrayLike, width: int = 640, height: int = 480) -> dict[str, Any]:
        """A Mitsuba scene dictionary for `rangesim.load_scene`: the diffuse board and a camera at the origin.

        Parameters
        ----------
        T_world_board : (4, 4) maps board coordinates to the world, metres. The axes of the world are those of the
            camera: x right, y down, z forward.
        width, height : size of the camera's image, pixels.
        """
        from rangesim.environment.backend import select_variant

        select_variant()
        import mitsuba as mi

        drawn = INK_REFLECTANCE + (BOARD_REFLECTANCE - INK_REFLECTANCE) * self.image()[::-1]  # Mitsuba's v points up
        half = np.diag([self.size_m[0] / 2, self.size_m[1] / 2, 1.0, 1.0])
        middle = np.eye(4)
        middle[:2, 3] = [(n - 1) * self.spacing_m / 2 for n in (self.columns, self.rows)]
        facing = np.diag([1.0, -1.0, -1.0, 1.0])  # a rectangle has y up and its normal towards the camera
        to_world = pose(T_world_board, "T_world_board") @ middle @ facing @ half
        texture = {
            "type": "bitmap",
            "data": mi.TensorXf(np.ascontiguousarray(drawn[:, :, None], dtype=np.float32)),
            "raw": True,
            "wrap_mode": "clamp",
        }
        camera = {
            "type": "perspective",
            "fov": 45.0,
            "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 0, 1], up=[0, -1, 0]),
            "film": {"type": "hdrfilm", "width": width, "height": height},
        }
        board = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(to_world),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}},
        }
        return {"type": "scene", "board": board, "camera": camera}


@dataclass(frozen=True)
class Checkerboard(Board):
    """A chessboard, whose points are its inner corners.

    If `columns` and `rows` are both odd or both even, the board looks the same after half a turn. The first point of a
    view may then be at either end, which only matters if several cameras see the same board.

    columns, rows : numbers of inner corners. square_m : side of a square, metres.

    Examples
    --------
    >>> board = Checkerboard(columns=9, rows=6, square_m=0.025)
    >>> board.points.shape, board.points[1]  # metres
    ((54, 3), array([0.025, 0.   , 0.   ]))
    """

    square_m: Length

    @property
    def spacing_m(self) -> float:
        """Distance between neighbouring corners, metres."""
        return self.square_m

    @property
    def margin(self) -> int:
        """Two spacings: the outer squares, and a white border as wide as a square."""
        return 2

    def image(self, pixels_per_spacing: int = 64) -> Array:
        """(h, w) float64, the picture of the board, 0 for ink and 1 for board; the square before the first corner is
        black."""
        squares = np.ones((self.rows + 3, self.columns + 3))
        squares[1:-1, 1:-1] = np.indices((self.rows + 1, self.columns + 1)).sum(axis=0) % 2
        return squares.repeat(pixels_per_spacing, axis=0).repeat(pixels_per_spacing, axis=1)

    def _find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.int64], Array] | None:
        import cv2

        found, corners = cv2.findChessboardCornersSB(
            image, (self.columns, self.rows), flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
        )
        if not found:
            return None
        pixels, is_corner = _refined(image, corners, 0.35)
        order = np.arange(len(pixels)) if self._starts_black(image, pixels) else np.arange(len(pixels))[::-1]
        return order[is_corner], pixels[is_corner]

    def _starts_black(self, image: NDArray[np.uint8], pixels: Array) -> bool:
        """Whether the square between the first four corners is darker than its neighbours, as in `image`."""
        grid = pixels.reshape(self.rows, self.columns, 2)
        centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4.0
        at = np.rint(centres).astype(int)
        values = image[at[..., 1], at[..., 0]].astype(np.float64)
        is_odd = np.indices(values.shape).sum(axis=0) % 2 == 1
        return bool(values[~is_odd].mean() < values[is_odd].mean())


@dataclass(frozen=True)
class CharucoBoard(Board):
    """A chessboard with ArUco markers in its white squares; a view of a part of the board is enough.

    The markers say which corner is which.

    columns, rows : numbers of inner corners. square_m, marker_m : sides of a square and of a marker, metres.
    dictionary : OpenCV's name of the dictionary of markers.

    Raises
    ------
    ValueError
        The markers do not fit into the squares, or the dictionary is unknown or has too few markers.

    Examples
    --------
    >>> board = CharucoBoard(columns=4, rows=3, square_m=0.04, marker_m=0.03)
    >>> whole = board.image(64)
    >>> board.find(whole).indices.size, board.find(whole[:, :320]).indices.size  # the right part is cut off
    (12, 9)
    """

    square_m: Length
    marker_m: Length
    dictionary: str = "DICT_5X5_250"

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.marker_m < self.square_m:
            raise ValueError(f"expected marker_m below square_m, got {self.marker_m} of {self.square_m}.")
        self._opencv_board()

    @property
    def spacing_m(self) -> float:
        """Distance between neighbouring corners, metres."""
        return self.square_m

    @property
    def margin(self) -> int:
        """Two spacings: the outer squares, and a white border as wide as a square."""
        return 2

    def _opencv_board(self) -> Any:
        """The board as an object of OpenCV; ValueError if there is no such dictionary, or too few markers in it."""
        import cv2

        known = {name for name in dir(cv2.aruco) if name.startswith("DICT_")}
        if self.dictionary not in known:
            raise ValueError(
                f"expected dictionary to be one of OpenCV's, such as DICT_5X5_250, got {self.dictionary!r}."
            )
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        needed, there = (self.columns + 1) * (self.rows + 1) // 2, len(markers.bytesList)
        if needed > there:
            raise ValueError(f"expected a dictionary of {needed} markers, got {self.dictionary} with {there}.")
        return cv2.aruco.CharucoBoard((self.columns + 1, self.rows + 1), self.square_m, self.marker_m, markers)

    def image(self, pixels_per_spacing: int = 64) -> Array:
        """(h, w) float64, the picture of the board, 0 for ink and 1 for board."""
        size = ((self.columns + 1) * pixels_per_spacing, (self.rows + 1) * pixels_per_spacing)
        drawn = self._opencv_board().generateImage(size, marginSize=0) / 255.0
        return np.pad(drawn, pixels_per_spacing, constant_values=1.0)

    def _find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.int64], Array] | None:
        import cv2

        corners, indices, _, _ = cv2.aruco.CharucoDetector(self._opencv_board()).detectBoard(image)
        if indices is None or len(indices) < 4:
            return None
        free = 0.5 * (1.0 - self.marker_m / self.square_m)  # distance from a corner to the next marker, in squares
        pixels, is_corner = _refined(image, corners, 0.8 * free)
        return indices.ravel()[is_corner], pixels[is_corner]


@dataclass(frozen=True)
class CircleGrid(Board):
    """A grid of discs, whose points are the centres of the discs.

    The centroid of the image of a disc is not the image of its centre (Heikkilae: "Geometric camera calibration using
    circular control points", PAMI 2000). `seen_points` returns the position on the board whose image is the centroid,
    and calibration uses it. Corners have no such error.

    columns, rows : numbers of discs. distance_m : distance between the centres of neighbours, metres. diameter_m :
    diameter of a disc, metres.

    Raises
    ------
    ValueError
        The discs touch each other.

    Examples
    --------
    >>> board = CircleGrid(columns=5, rows=4, distance_m=0.04, diameter_m=0.02)
    >>> board.find(board.image(32)).pixels[0].round(1)
    array([32., 32.])
    """

    distance_m: Length
    diameter_m: Length

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.diameter_m < self.distance_m:
            raise ValueError(f"expected diameter_m below distance_m, got {self.diameter_m} of {self.distance_m}.")

    @property
    def spacing_m(self) -> float:
        """Distance between the centres of neighbouring discs, metres."""
        return self.distance_m

    @property
    def margin(self) -> int:
        """One spacing on each side."""
        return 1

    def seen_points(self, camera: Intrinsics, T_camera_board: ArrayLike) -> Array:
        """(columns * rows, 3) float64, the positions on the board whose images are the centroids of the discs,
        metres.

        The centroid is that of a polygon of `EDGE_POINTS` points on the edge of the disc, projected through the lens.
        NaN for a disc that is not in front of the camera as a whole.
        """
        T = pose(T_camera_board, "T_camera_board")
        angle = np.arange(EDGE_POINTS) * (2 * np.pi / EDGE_POINTS)
        around = np.stack([np.cos(angle), np.sin(angle), np.zeros(EDGE_POINTS)], axis=-1)
        edge = self.points[:, None] + 0.5 * self.diameter_m * around
        image = camera.project(edge @ T[:3, :3].T + T[:3, 3])
        about = image - image.mean(axis=1, keepdims=True)  # rounding loses less of small numbers
        following = np.roll(about, -1, axis=1)
        area = about[..., 0] * following[..., 1] - about[..., 1] * following[..., 0]
        middle = ((about + following) * area[..., None]).sum(axis=1) / (3 * area.sum(axis=1))[:, None]
        rays = camera.directions(middle + image.mean(axis=1))
        X = rays * ((T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2]))[:, None]
        return np.asarray((X - T[:3, 3]) @ T[:3, :3])

    def image(self, pixels_per_spacing: int = 64) -> Array:
        """(h, w) float64, the picture of the board, 0 for ink and 1 for board."""
        n = pixels_per_spacing
        y, x = ((np.arange((k + 1) * n) + 0.5) / n for k in (self.rows, self.columns))  # in spacings
        off_y, off_x = y - np.clip(np.rint(y), 1, self.rows), x - np.clip(np.rint(x), 1, self.columns)
        distance = np.hypot(off_y[:, None], off_x[None]) - 0.5 * self.diameter_m / self.distance_m
        return np.clip(0.5 + distance * n, 0.0, 1.0)

    def _find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.int64], Array] | None:
        import cv2

        found, centres = cv2.findCirclesGrid(image, (self.columns, self.rows), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
        if not found:
            return None
        return np.arange(self.columns * self.rows), np.asarray(centres, np.float64).reshape(-1, 2)


def _refined(image: NDArray[np.uint8], corners: Any, reach: float) -> tuple[Array, NDArray[np.bool_]]:
    """(n, 2) float64, corners with subpixel accuracy, and (n,) bool, whether a window half as wide agrees.

    A corner is the point where the gradients around it meet (Foerstner 1987). If the narrow window finds another point,
    the wide window has another edge in it, for example of a shadow, of the projected light, or of a finger, which draws
    the corner away by pixels.

    reach : half the width of the wide window, as a fraction of the smallest distance between two corners.
    """
    import cv2

    start = np.asarray(corners, np.float32).reshape(-1, 1, 2)
    apart = np.linalg.norm(start[:, None, 0] - start[None, :, 0], axis=-1)
    np.fill_diagonal(apart, np.inf)
    window = int(np.clip(reach * apart.min(), 2, 11))
    done = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    wide, narrow = (
        np.asarray(cv2.cornerSubPix(image, start.copy(), (w, w), (-1, -1), done), np.float64).reshape(-1, 2)
        for w in (window, max(2, window // 2))
    )
    moved = np.linalg.norm(wide - narrow, axis=-1)
    return wide, moved <= max(MAX_MOVE_RATIO * float(np.median(moved)), MIN_MOVE_PX)
