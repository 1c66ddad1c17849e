# SPDX-License-Identifier: Apache-2.0
"""The strategies that bring light from the projector to the camera, and which of them owns a light path.

A vertex of a light path is a surface point where light scatters into many directions, or a scattering event inside a
medium. Between vertices, light runs along segments and through delta interactions (glass, mirrors, thin panes, coats),
which send it on in single directions. Holes send it on as if nothing were there, so a segment may go through them.

Metal and glass of a small roughness are in between: they scatter light into narrow lobes, which light paths find by
chance only where they come from there. Such lobes count as vertices for a camera path that comes to them from the
camera, by delta interactions and narrow lobes alone. Where a camera path comes to them from a wider vertex, they count
as delta interactions (`PathState.from_wide` in `loop.py`).

Three strategies bring the projector's light to the camera. They partition all light paths: each path belongs to one of
them, so that no light is counted twice and none is left out. `owner` says which strategy a path belongs to.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from rangesim.response import DIRECT, MULTIPATH, SPECULAR


class Owner(NamedTuple):
    """Three masks, of which exactly one is true for each light path.

    next_event, caustics, glint : Bool.
    """

    next_event: mi.Bool
    caustics: mi.Bool
    glint: mi.Bool


def owner(has_vertex: mi.Bool, delta_interactions: mi.UInt32 | int) -> Owner:
    """The strategy that owns a light path.

    | strategy              | paths                                              | kinds of light              |
    | --------------------- | -------------------------------------------------- | --------------------------- |
    | next-event estimation | a straight segment leads from the projector to a   | direct, specular, multipath |
    |                       | vertex                                             |                             |
    | caustics              | delta interactions, or narrow lobes before a wider | caustic                     |
    |                       | vertex, lie between the projector and the vertex   |                             |
    |                       | next to it                                         |                             |
    | glint                 | no vertex at all: the camera sees the projector's  | glint                       |
    |                       | lens, directly or by delta interactions            |                             |

    Next-event estimation is carried out in `loop.py`. Caustics are triangles of light: `specular_tree.py` follows the
    projector's light before the pass, `caustic_sheets.py` spans triangles where it lands, and `loop.py` looks up those
    that cover a vertex (`sheet_scene.py`). Glint is traced in `glint.py`, beside the pass.

    Parameters
    ----------
    has_vertex : Bool, whether the path has any vertex.
    delta_interactions : UInt32, number of delta interactions between the projector and the vertex next to it. It has no
        meaning where there is no vertex.

    Examples
    --------
    >>> import numpy as np
    >>> owner(has_vertex=np.array([True, True, False]), delta_interactions=np.array([0, 2, 2])).caustics
    array([False,  True, False])
    """
    is_straight = delta_interactions == 0
    return Owner(has_vertex & is_straight, has_vertex & (delta_interactions != 0), ~has_vertex)


def beam_connects(is_first: mi.Bool, via_delta: mi.Bool, has_spot: bool) -> mi.Bool:
    """Whether next-event estimation owns the path from the emitter of a beam straight to the last vertex.

    It owns paths of one vertex that the camera sees straight, and longer paths whose last segment between vertices has
    delta interactions. A path of one vertex behind delta interactions belongs to the pencil of rays that came the same
    way, and a longer path whose last two vertices see each other belongs to the spot (`beams.py`). In scenes with media
    there is no spot, and next-event estimation owns all longer paths.

    Parameters
    ----------
    is_first : Bool, whether the last vertex of the path is its only one.
    via_delta : Bool, whether the path came to the last vertex by delta interactions.
    has_spot : whether the spot is a light vertex.

    Examples
    --------
    >>> import numpy as np
    >>> beam_connects(np.array([True, True, False, False]), np.array([False, True, False, True]), has_spot=True)
    array([ True, False, False,  True])
    """
    return is_first ^ via_delta if has_spot else ~is_first | ~via_delta


def next_event_kind(is_first: mi.Bool, via_delta: mi.Bool) -> mi.UInt32:
    """Kind of the light that next-event estimation finds at a vertex, an index into `rangesim.response.KINDS`.

    Parameters
    ----------
    is_first : Bool, whether the vertex is the first one that the camera path meets.
    via_delta : Bool, whether the camera path met a delta interaction before.
    """
    return dr.select(is_first, dr.select(via_delta, mi.UInt32(SPECULAR), mi.UInt32(DIRECT)), mi.UInt32(MULTIPATH))


def can_be_vertex(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Whether a surface scatters light into many directions (diffuse or glossy), perhaps besides delta interactions."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


def is_delta(sample: mi.BSDFSample3f) -> mi.Bool:
    """Whether a sample of a BSDF is a delta interaction."""
    return mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)


def delta_only(mode: mi.TransportMode) -> mi.BSDFContext:
    """A context in which BSDFs sample delta interactions alone, as glint does."""
    context = mi.BSDFContext(mode)
    context.type_mask = mi.BSDFFlags.Delta
    return context
