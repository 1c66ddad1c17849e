# SPDX-License-Identifier: Apache-2.0
"""A beam: the emitter of a scanner, which lights the spot of one ray at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from rangesim.rig.cameras import Acceptance, Optics, PixelRays, tangents, unit_directions
from rangesim.rig.poses import Array
from rangesim.settings.bounds import Bounds, check_fields

Divergence = Annotated[float, Bounds("an angle in radians", 1e-6, 1.0)]
"""Full divergence of a beam along one axis, radians. Wider light is that of a projector, not of a beam."""
Offset = Annotated[float, Bounds("metres", -1e3, 1e3)]
"""Offset of a beam's emitter from the origin of the ray, metres; the bounds only exclude nonsense."""


class BeamFrames(NamedTuple):
    """The beams of a camera's pixels; (h, w, 3) float64 each, camera coordinates.

    axes, right, down : unit vectors: the axis of each beam, and its x and y axes across it.
    offsets : metres, from the origin of each ray to the emitter of its beam.
    """

    axes: Array
    right: Array
    down: Array
    offsets: Array


@dataclass(frozen=True, eq=False)
class Beam(Optics):
    """A narrow beam along the ray of each pixel, which is lit alone while that pixel measures.

    All the power of the emitter goes into the beam. Because only one spot is lit at a time, a pixel sees little light
    that comes over other surfaces: the multipath of a scanner is far below that of a camera with a flash.

    Parameters
    ----------
    divergence_rad : (along x, along y) float, radians, full widths of the beam: of its box, or the 1/e^2 widths of its
        Gaussian.
    profile : "gaussian" or "box", how the radiant intensity depends on the angle.
    offset_m : (along x, along y) float, metres, where the emitter stands beside the origin of its ray, across the
        ray: to the right and downwards. 0, 0 is a coaxial scanner.
    directions : (h, w, 3) float64, camera coordinates, axes of the beams; None: each beam runs along the ray of its
        pixel. Other axes describe a scanned beam in front of a receiver that sees more than the spot.

    Raises
    ------
    ValueError
        A value out of its bounds, or directions that are no array (h, w, 3) of finite vectors longer than 0.

    Examples
    --------
    >>> Beam(divergence_rad=(3e-3, 1.5e-3)).profile
    'gaussian'
    """

    divergence_rad: tuple[Divergence, Divergence] = (3e-3, 3e-3)
    profile: Acceptance = "gaussian"
    offset_m: tuple[Offset, Offset] = (0.0, 0.0)
    directions: np.ndarray | None = None

    type_name: ClassVar[str] = "beam"
    width: ClassVar[int] = 1  # type: ignore[misc]
    height: ClassVar[int] = 1  # type: ignore[misc]

    def __post_init__(self) -> None:
        check_fields(self)
        if self.directions is not None:
            object.__setattr__(self, "directions", unit_directions(self.directions))

    def frames(self, rays: PixelRays) -> BeamFrames:
        """Axes and emitters of the beams of a camera with these rays.

        Examples
        --------
        >>> from rangesim.rig import Intrinsics
        >>> rays = Intrinsics.from_fov(3, 1, fov_x_deg=60.0).rays
        >>> Beam(offset_m=(0.01, 0.0)).frames(rays).offsets[0, 1]
        array([0.01, 0.  , 0.  ])
        """
        axes = rays.directions if self.directions is None else self.directions
        right, down = tangents(axes)
        return BeamFrames(axes, right, down, right * self.offset_m[0] + down * self.offset_m[1])
