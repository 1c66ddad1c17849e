# SPDX-License-Identifier: Apache-2.0
"""Finds cameras, points and shapes from tracks of points through many images. See docs/multiview.md.

Names load when first used.

Used by: no other module of rangesim; it is for users alone, see `examples/structure_from_motion.py`.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from rangesim.multiview.bundle_adjustment import BundleAdjustment as BundleAdjustment
    from rangesim.multiview.bundle_adjustment import bundle_adjust as bundle_adjust
    from rangesim.multiview.factorisation import AffineFactorisation as AffineFactorisation
    from rangesim.multiview.factorisation import OrthographicFactorisation as OrthographicFactorisation
    from rangesim.multiview.factorisation import ProjectiveFactorisation as ProjectiveFactorisation
    from rangesim.multiview.factorisation import factorise_affine as factorise_affine
    from rangesim.multiview.factorisation import factorise_orthographic as factorise_orthographic
    from rangesim.multiview.factorisation import factorise_projective as factorise_projective
    from rangesim.multiview.incremental_reconstruction import StructureFromMotion as StructureFromMotion
    from rangesim.multiview.incremental_reconstruction import structure_from_motion as structure_from_motion
    from rangesim.multiview.multi_view_triangulation import ManyViewPoints as ManyViewPoints
    from rangesim.multiview.multi_view_triangulation import triangulate_many as triangulate_many
    from rangesim.multiview.nonrigid import NonRigidShape as NonRigidShape
    from rangesim.multiview.nonrigid import UnknownCount as UnknownCount
    from rangesim.multiview.nonrigid import adjust_nonrigid as adjust_nonrigid
    from rangesim.multiview.nonrigid import count_unknowns as count_unknowns
    from rangesim.multiview.nonrigid import factorise_nonrigid as factorise_nonrigid
    from rangesim.multiview.orthographic import TemporalPrior as TemporalPrior
    from rangesim.multiview.sliding_window import OnlineAdjustment as OnlineAdjustment
    from rangesim.multiview.sliding_window import adjust_online as adjust_online
    from rangesim.multiview.tracks import CommonPoints as CommonPoints
    from rangesim.multiview.tracks import Tracks as Tracks
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submod_attrs={
            "bundle_adjustment": ["BundleAdjustment", "bundle_adjust"],
            "factorisation": [
                "AffineFactorisation",
                "OrthographicFactorisation",
                "ProjectiveFactorisation",
                "factorise_affine",
                "factorise_orthographic",
                "factorise_projective",
            ],
            "incremental_reconstruction": ["StructureFromMotion", "structure_from_motion"],
            "multi_view_triangulation": ["ManyViewPoints", "triangulate_many"],
            "nonrigid": ["NonRigidShape", "UnknownCount", "adjust_nonrigid", "count_unknowns", "factorise_nonrigid"],
            "orthographic": ["TemporalPrior"],
            "sliding_window": ["OnlineAdjustment", "adjust_online"],
            "tracks": ["CommonPoints", "Tracks"],
        },
    )
