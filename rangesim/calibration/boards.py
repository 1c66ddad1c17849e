# SPDX-License-Identifier: Apache-2.0
"""Calibration boards: where their points are, what they look like, how a camera finds them, a scene that holds one.

A board's frame has its origin at its first point, x along a row of points, y along a column and z into the board, so
that a camera straight in front of it has the board's axes. Pixels have their centres at integer + 0.5; OpenCV, which
finds the points, has them at integers, and the difference is added here and nowhere else.
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
"""Of a disc: its polygon's centroid is the disc's to rounding, as far as a lens bends no edge within a side."""
BLACK, WHITE = 0.05, 0.8
"""Reflectances of ink and of the board."""
MAX_MOVE, LEAST_MOVE_PX = 8.0, 0.15
"""How far the place of a corner may depend on the window that is looked at: times the median of all corners, or pixels.
Measured in 36 rendered views: at most 0.14 px, and 3.5 to 4.1 px where the edge of the light was near."""
Count = Annotated[int, whole(2)]
Length = Annotated[float, Bounds("positive metres", 1e-6, 1e3)]


@dataclass(frozen=True, eq=False)
class BoardView:
    """Points of a board as a camera saw them.

    indices : (m,) int64, which of `Board.points`, ascending; not all, where some are hidden or beside the edge of a
    shadow or of the light. pixels : (m, 2) float64.
    """

    indices: NDArray[np.int64]
    pixels: Array


@dataclass(frozen=True)
class Board(ABC):
    """A plane with points that a camera can find.

    columns, rows : points along x and y.
    """

    columns: Count
    rows: Count

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    @abstractmethod
    def spacing_m(self) -> float:
        """Metres between neighbouring points."""

    @property
    def points(self) -> Array:
        """(columns * rows, 3) float64, metres, board coordinates, row by row; z = 0."""
        y, x = np.mgrid[: self.rows, : self.columns].reshape(2, -1) * self.spacing_m
        return np.stack([x, y, np.zeros(len(x))], axis=-1)

    def seen_points(self, camera: Intrinsics, T_camera_board: ArrayLike) -> Array:
        """(columns * rows, 3) the places on the board that a camera takes for its points: `points`, where what is found
        in an image has no size."""
        return self.points

    @property
    @abstractmethod
    def margin(self) -> int:
        """Spacings from the first point to the edges of the board, and from the last."""

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the board, metres."""
        return tuple((n - 1 + 2 * self.margin) * self.spacing_m for n in (self.columns, self.rows))  # type: ignore[return-value]

    @abstractmethod
    def image(self, pixels_per_spacing: int = 64) -> Array:
        """(h, w) float64, 0 ink, 1 board; x to the right, y down."""

    @abstractmethod
    def _find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.int64], Array] | None:
        """Indices and pixels as OpenCV has them; None if there is no board."""

    def find(self, image: ArrayLike) -> BoardView:
        """The points of the board in an image.

        Parameters
        ----------
        image : (h, w), brightness in any unit and of any type; the range that it uses is stretched.

        Raises
        ------
        ValueError
            Not an image with finite values, or no board is found in it.
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
                "it must be in the image as a whole, sharp and evenly lit (of a CharucoBoard parts are enough)."
            )
        indices, pixels = found
        order = np.argsort(indices)
        return BoardView(indices[order].astype(np.int64), pixels[order].astype(np.float64) + 0.5)

    def scene(self, T_world_board: ArrayLike, width: int = 640, height: int = 480) -> dict[str, Any]:
        """A Mitsuba scene dictionary for `rangesim.load_scene`: the board, matte, before a camera at the origin.

        Parameters
        ----------
        T_world_board : (4, 4) metres. The camera has the world's axes: x right, y down, z forward.
        """
        from rangesim.environment.backend import select_variant

        select_variant()
        import mitsuba as mi

        drawn = BLACK + (WHITE - BLACK) * self.image()[::-1]  # Mitsuba's v points up
        half = np.diag([self.size_m[0] / 2, self.size_m[1] / 2, 1.0, 1.0])
        middle = np.eye(4)
        middle[:2, 3] = [(n - 1) * self.spacing_m / 2 for n in (self.columns, self.rows)]
        facing = np.diag([1.0, -1.0, -1.0, 1.0])  # a rectangle's y is up and its normal towards the camera
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
    """A chessboard; its points are the inner corners.

    With an odd number of both or an even number of both it looks the same turned by half: a view then has either end
    for the first point, which matters only where views of several cameras belong together.

    columns, rows : inner corners. square_m : side of a square.
    """

    square_m: Length

    @property
    def spacing_m(self) -> float:
        """Metres between neighbouring corners."""
        return self.square_m

    @property
    def margin(self) -> int:
        """A square and a white one around it."""
        return 2

    def image(self, pixels_per_spacing: int = 64) -> Array:
        """(h, w) float64, 0 ink, 1 board; the square before the first corner is black."""
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
        """Whether the square between the first four corners is darker than its neighbours, as it is drawn."""
        grid = pixels.reshape(self.rows, self.columns, 2)
        centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4.0
        at = np.rint(centres).astype(int)
        values = image[at[..., 1], at[..., 0]].astype(np.float64)
        is_odd = np.indices(values.shape).sum(axis=0) % 2 == 1
        return bool(values[~is_odd].mean() < values[is_odd].mean())


@dataclass(frozen=True)
class CharucoBoard(Board):
    """A chessboard with ArUco markers in its white squares, which name the corners: parts of it are enough.

    columns, rows : inner corners. square_m, marker_m : sides of a square and of a marker. dictionary : OpenCV's name of
    the markers.
    """

    square_m: Length
    marker_m: Length
    dictionary: str = "DICT_5X5_250"

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.marker_m < self.square_m:
            raise ValueError(f"expected marker_m below square_m, got {self.marker_m} of {self.square_m}.")
        self._board()

    @property
    def spacing_m(self) -> float:
        """Metres between neighbouring corners."""
        return self.square_m

    @property
    def margin(self) -> int:
        """A square and a white one around it."""
        return 2

    def _board(self) -> Any:
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
        """(h, w) float64, 0 ink, 1 board."""
        size = ((self.columns + 1) * pixels_per_spacing, (self.rows + 1) * pixels_per_spacing)
        drawn = self._board().generateImage(size, marginSize=0) / 255.0
        return np.pad(drawn, pixels_per_spacing, constant_values=1.0)

    def _find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.int64], Array] | None:
        import cv2

        corners, indices, _, _ = cv2.aruco.CharucoDetector(self._board()).detectBoard(image)
        if indices is None or len(indices) < 4:
            return None
        free = 0.5 * (1.0 - self.marker_m / self.square_m)  # of a square, from a corner to the next markers
        pixels, is_corner = _refined(image, corners, 0.8 * free)
        return indices.ravel()[is_corner], pixels[is_corner]


@dataclass(frozen=True)
class CircleGrid(Board):
    """A grid of discs; its points are their centres.

    The middle of a disc's image is not the image of its middle (Heikkilae: "Geometric camera calibration using circular
    control points", PAMI 2000); `seen_points` says of which place it is, and calibration takes that. Corners have no
    such error.

    columns, rows : discs. distance_m : between centres of neighbours. diameter_m : of a disc.
    """

    distance_m: Length
    diameter_m: Length

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.diameter_m < self.distance_m:
            raise ValueError(f"expected diameter_m below distance_m, got {self.diameter_m} of {self.distance_m}.")

    @property
    def spacing_m(self) -> float:
        """Metres between neighbouring centres."""
        return self.distance_m

    @property
    def margin(self) -> int:
        """One spacing."""
        return 1

    def seen_points(self, camera: Intrinsics, T_camera_board: ArrayLike) -> Array:
        """(columns * rows, 3) where on the board the rays through the middles of the discs' images meet it.

        The middle of an image is the centroid of its area, that of a polygon of `EDGE_POINTS` on the disc's edge as the
        lens shows it. NaN where a disc is not seen as a whole.
        """
        T = pose(T_camera_board, "T_camera_board")
        angle = np.arange(EDGE_POINTS) * (2 * np.pi / EDGE_POINTS)
        around = np.stack([np.cos(angle), np.sin(angle), np.zeros(EDGE_POINTS)], axis=-1)
        edge = self.points[:, None] + 0.5 * self.diameter_m * around
        image = camera.project(edge @ T[:3, :3].T + T[:3, 3])
        about = image - image.mean(axis=1, keepdims=True)  # small numbers, for the sake of rounding
        following = np.roll(about, -1, axis=1)
        area = about[..., 0] * following[..., 1] - about[..., 1] * following[..., 0]
        middle = ((about + following) * area[..., None]).sum(axis=1) / (3 * area.sum(axis=1))[:, None]
        rays = camera.directions(middle + image.mean(axis=1))
        X = rays * ((T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2]))[:, None]
        return np.asarray((X - T[:3, 3]) @ T[:3, :3])

    def image(self, pixels_per_spacing: int = 64) -> Array:
        """(h, w) float64, 0 ink, 1 board."""
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
    """(n, 2) corners where all gradients around meet (Foerstner 1987), within a fraction of the way to the next one.

    And (n,) bool, whether a window half as wide finds the same place. Where it does not, another edge lies in the wider
    one: a shadow's, that of the projector's light, a finger's. It draws the corner away by pixels.
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
    return wide, moved <= max(MAX_MOVE * float(np.median(moved)), LEAST_MOVE_PX)
