# SPDX-License-Identifier: Apache-2.0
"""The mathematics of 3D vision around a range sensor: planes, cameras, two views, triangulation, poses, registration.

Functions take and return NumPy arrays. Names load when first used. docs/geometry.md describes the modules.

Used by: rangesim.calibration, decoding, fusion and multiview.

Examples
--------
>>> from rangesim.geometry import project, projection_matrix
>>> project(projection_matrix([[800, 0, 320], [0, 800, 240], [0, 0, 1]]), [[0.1, 0, 2]])
array([[360., 240.]])
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from rangesim.geometry.camera_matrix import CameraParts as CameraParts
    from rangesim.geometry.camera_matrix import back_project as back_project
    from rangesim.geometry.camera_matrix import calibration_matrix as calibration_matrix
    from rangesim.geometry.camera_matrix import centre as centre
    from rangesim.geometry.camera_matrix import decompose as decompose
    from rangesim.geometry.camera_matrix import decompose_zero_skew as decompose_zero_skew
    from rangesim.geometry.camera_matrix import depth as depth
    from rangesim.geometry.camera_matrix import ideal_pixels as ideal_pixels
    from rangesim.geometry.camera_matrix import lens_pixels as lens_pixels
    from rangesim.geometry.camera_matrix import project as project
    from rangesim.geometry.camera_matrix import projection_matrix as projection_matrix
    from rangesim.geometry.camera_matrix import rays as rays
    from rangesim.geometry.camera_pose import CameraPose as CameraPose
    from rangesim.geometry.camera_pose import find_camera_pose as find_camera_pose
    from rangesim.geometry.camera_pose import fit_camera_pose as fit_camera_pose
    from rangesim.geometry.camera_projector import ProjectorTriangulation as ProjectorTriangulation
    from rangesim.geometry.camera_projector import triangulate_coordinates as triangulate_coordinates
    from rangesim.geometry.dense_stereo import DenseMatch as DenseMatch
    from rangesim.geometry.dense_stereo import DenseMatching as DenseMatching
    from rangesim.geometry.dense_stereo import MatchOutcome as MatchOutcome
    from rangesim.geometry.dense_stereo import match_densely as match_densely
    from rangesim.geometry.hand_eye import HandEye as HandEye
    from rangesim.geometry.hand_eye import eye_in_hand as eye_in_hand
    from rangesim.geometry.hand_eye import eye_to_hand as eye_to_hand
    from rangesim.geometry.homography import Homography as Homography
    from rangesim.geometry.homography import find_homography as find_homography
    from rangesim.geometry.homography import fit_homography as fit_homography
    from rangesim.geometry.homography import homography_dlt as homography_dlt
    from rangesim.geometry.homography import transfer_error as transfer_error
    from rangesim.geometry.projective_plane import LINE_AT_INFINITY as LINE_AT_INFINITY
    from rangesim.geometry.projective_plane import Decomposition as Decomposition
    from rangesim.geometry.projective_plane import PlaneTransform as PlaneTransform
    from rangesim.geometry.projective_plane import affine_rectification as affine_rectification
    from rangesim.geometry.projective_plane import classify as classify
    from rangesim.geometry.projective_plane import euclidean as euclidean
    from rangesim.geometry.projective_plane import homogeneous as homogeneous
    from rangesim.geometry.projective_plane import is_at_infinity as is_at_infinity
    from rangesim.geometry.projective_plane import join as join
    from rangesim.geometry.projective_plane import map_lines as map_lines
    from rangesim.geometry.projective_plane import map_points as map_points
    from rangesim.geometry.projective_plane import meet as meet
    from rangesim.geometry.projective_plane import metric_rectification as metric_rectification
    from rangesim.geometry.projective_plane import point_at_infinity as point_at_infinity
    from rangesim.geometry.registration import Registration as Registration
    from rangesim.geometry.registration import icp as icp
    from rangesim.geometry.registration import register as register
    from rangesim.geometry.stereo import ParallelCameras as ParallelCameras
    from rangesim.geometry.stereo import RectifiedPair as RectifiedPair
    from rangesim.geometry.stereo import match_rows as match_rows
    from rangesim.geometry.stereo import rectify as rectify
    from rangesim.geometry.two_view import Epipoles as Epipoles
    from rangesim.geometry.two_view import FundamentalMatrix as FundamentalMatrix
    from rangesim.geometry.two_view import RelativePose as RelativePose
    from rangesim.geometry.two_view import eight_point as eight_point
    from rangesim.geometry.two_view import epipoles as epipoles
    from rangesim.geometry.two_view import essential_from_pose as essential_from_pose
    from rangesim.geometry.two_view import find_fundamental as find_fundamental
    from rangesim.geometry.two_view import find_relative_pose as find_relative_pose
    from rangesim.geometry.two_view import fit_fundamental as fit_fundamental
    from rangesim.geometry.two_view import fit_relative_pose as fit_relative_pose
    from rangesim.geometry.two_view import fundamental_from_cameras as fundamental_from_cameras
    from rangesim.geometry.two_view import fundamental_from_pose as fundamental_from_pose
    from rangesim.geometry.two_view import in_front as in_front
    from rangesim.geometry.two_view import lines_in_first as lines_in_first
    from rangesim.geometry.two_view import lines_in_second as lines_in_second
    from rangesim.geometry.two_view import poses_from_essential as poses_from_essential
    from rangesim.geometry.two_view import sampson_distance as sampson_distance
    from rangesim.geometry.two_view import seven_point as seven_point
    from rangesim.geometry.two_view_triangulation import CorrectedPixels as CorrectedPixels
    from rangesim.geometry.two_view_triangulation import TriangulatedPoints as TriangulatedPoints
    from rangesim.geometry.two_view_triangulation import correct_pixels as correct_pixels
    from rangesim.geometry.two_view_triangulation import point_covariance as point_covariance
    from rangesim.geometry.two_view_triangulation import triangulate_linear as triangulate_linear
    from rangesim.geometry.two_view_triangulation import triangulate_midpoint as triangulate_midpoint
    from rangesim.geometry.two_view_triangulation import triangulate_optimal as triangulate_optimal
    from rangesim.geometry.uncalibrated_rectification import UncalibratedPair as UncalibratedPair
    from rangesim.geometry.uncalibrated_rectification import rectify_uncalibrated as rectify_uncalibrated
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submod_attrs={
            "camera_matrix": [
                "CameraParts",
                "back_project",
                "calibration_matrix",
                "centre",
                "decompose",
                "decompose_zero_skew",
                "depth",
                "ideal_pixels",
                "lens_pixels",
                "project",
                "projection_matrix",
                "rays",
            ],
            "camera_pose": ["CameraPose", "find_camera_pose", "fit_camera_pose"],
            "camera_projector": ["ProjectorTriangulation", "triangulate_coordinates"],
            "dense_stereo": ["DenseMatch", "DenseMatching", "MatchOutcome", "match_densely"],
            "hand_eye": ["HandEye", "eye_in_hand", "eye_to_hand"],
            "homography": ["Homography", "find_homography", "fit_homography", "homography_dlt", "transfer_error"],
            "projective_plane": [
                "LINE_AT_INFINITY",
                "Decomposition",
                "PlaneTransform",
                "affine_rectification",
                "classify",
                "euclidean",
                "homogeneous",
                "is_at_infinity",
                "join",
                "map_lines",
                "map_points",
                "meet",
                "metric_rectification",
                "point_at_infinity",
            ],
            "registration": ["Registration", "icp", "register"],
            "stereo": ["ParallelCameras", "RectifiedPair", "match_rows", "rectify"],
            "two_view": [
                "Epipoles",
                "FundamentalMatrix",
                "RelativePose",
                "eight_point",
                "epipoles",
                "essential_from_pose",
                "find_fundamental",
                "find_relative_pose",
                "fit_fundamental",
                "fit_relative_pose",
                "fundamental_from_cameras",
                "fundamental_from_pose",
                "in_front",
                "lines_in_first",
                "lines_in_second",
                "poses_from_essential",
                "sampson_distance",
                "seven_point",
            ],
            "two_view_triangulation": [
                "CorrectedPixels",
                "TriangulatedPoints",
                "correct_pixels",
                "point_covariance",
                "triangulate_linear",
                "triangulate_midpoint",
                "triangulate_optimal",
            ],
            "uncalibrated_rectification": ["UncalibratedPair", "rectify_uncalibrated"],
        },
    )
