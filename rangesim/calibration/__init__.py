# SPDX-License-Identifier: Apache-2.0
"""Calibrates cameras and rigs from views of a board, rendered or real. Names load when first used.
docs/calibration.md."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from rangesim.calibration.boards import Board as Board
    from rangesim.calibration.boards import BoardView as BoardView
    from rangesim.calibration.boards import CharucoBoard as CharucoBoard
    from rangesim.calibration.boards import Checkerboard as Checkerboard
    from rangesim.calibration.boards import CircleGrid as CircleGrid
    from rangesim.calibration.bundle import Bundle as Bundle
    from rangesim.calibration.bundle import Observation as Observation
    from rangesim.calibration.bundle import adjust as adjust
    from rangesim.calibration.rendered import RenderedSet as RenderedSet
    from rangesim.calibration.rendered import default_rig as default_rig
    from rangesim.calibration.rendered import render_set as render_set
    from rangesim.calibration.rig_calibration import RigCalibration as RigCalibration
    from rangesim.calibration.rig_calibration import calibrate_rig as calibrate_rig
    from rangesim.calibration.rig_calibration import projector_view as projector_view
    from rangesim.calibration.suspects import Suspect as Suspect
    from rangesim.calibration.time_of_flight import ToFCalibration as ToFCalibration
    from rangesim.calibration.time_of_flight import board_range as board_range
    from rangesim.calibration.time_of_flight import calibrate_tof as calibrate_tof
    from rangesim.calibration.time_of_flight import find_board_ranges as find_board_ranges
    from rangesim.calibration.time_of_flight import load_tof_calibration as load_tof_calibration
    from rangesim.calibration.time_of_flight import plane_range as plane_range
    from rangesim.calibration.time_of_flight import triangle_harmonics as triangle_harmonics
    from rangesim.calibration.time_of_flight import wiggling as wiggling
    from rangesim.calibration.zhang import CameraCalibration as CameraCalibration
    from rangesim.calibration.zhang import calibrate_camera as calibrate_camera
    from rangesim.calibration.zhang import intrinsics_from_homographies as intrinsics_from_homographies
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submod_attrs={
            "boards": ["Board", "BoardView", "CharucoBoard", "Checkerboard", "CircleGrid"],
            "bundle": ["Bundle", "Observation", "adjust"],
            "rendered": ["RenderedSet", "default_rig", "render_set"],
            "rig_calibration": ["RigCalibration", "calibrate_rig", "projector_view"],
            "suspects": ["Suspect"],
            "time_of_flight": [
                "ToFCalibration",
                "board_range",
                "calibrate_tof",
                "find_board_ranges",
                "load_tof_calibration",
                "plane_range",
                "triangle_harmonics",
                "wiggling",
            ],
            "zhang": ["CameraCalibration", "calibrate_camera", "intrinsics_from_homographies"],
        },
    )
