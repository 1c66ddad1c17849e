# SPDX-License-Identifier: Apache-2.0
"""The first surface that scatters on a pixel's main chain: what the pixel sees in a mirror or through glass.

Where a pixel sees a mirror or glass, its light comes from other surfaces. The main chain leads to the one that brings
most of it: at each delta surface it takes the more likely way, off the surface or through it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.chain_strata import CERTAIN, MAX_BRANCHES
from rangesim.light_transport.delta_surfaces import splits_light
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.specular_chain import MAX_CHAIN
from rangesim.light_transport.strategies import delta_only
from rangesim.light_transport.surfaces import Surfaces, number_of, table_of
from rangesim.scene.materials import is_matte, is_specular, sharing_cosine


@dataclass
class Scatterer:
    """The first surface that scatters. It is a dataclass, because Dr.Jit does not evaluate named tuples.

    si : SurfaceInteraction3f.
    index : Int32, index of its shape; -1 where there is none.
    chain : UInt32, number that stands for the surfaces of the main chain and for the way taken at each; 0 where there
        is no chain.
    branches : UInt32, number of surfaces of the main chain, up to `MAX_BRANCHES`, at which samples leave it: those of
        clear glass where light takes both ways.
    """

    si: mi.SurfaceInteraction3f
    index: mi.Int32
    chain: mi.UInt32
    branches: mi.UInt32


class FirstScatterers:
    """The first surfaces that scatter in a scene, and what decides which of their pixels share indirect light.

    Parameters
    ----------
    scene : mitsuba.Scene
    surfaces : the scene itself or its `Surfaces`, to intersect rays with.
    """

    def __init__(self, scene: mi.Scene, surfaces: mi.Scene | Surfaces) -> None:
        shapes, self.scene, self.surfaces = scene.shapes(), scene, surfaces
        matte, specular = [is_matte(s) for s in shapes], [is_specular(s) for s in shapes]
        splits = list(map(splits_light, shapes))
        self.has_chains, self.has_branches = any(specular), any(splits)
        self.index_of = mi.Int32(table_of(scene, np.arange(len(shapes), dtype=np.int32)))
        tables = (mi.Bool(table_of(scene, of)) for of in (matte, specular, splits))
        self.matte_of, self.specular_of, self.splits_of = tables

    @cached_property
    def cosines(self) -> np.ndarray:
        """(shapes + 1,) float32, `rangesim.scene.materials.sharing_cosine` of each shape; NaN for none (index -1)."""
        return np.array([*map(sharing_cosine, self.scene.shapes()), np.nan], np.float32)

    def index(self, si: mi.SurfaceInteraction3f, hit: mi.Bool) -> mi.Int32:
        """Index of the shape of each surface in the scene; -1 without a `hit`."""
        return dr.select(hit, dr.gather(mi.Int32, self.index_of, number_of(si.shape), hit), -1)

    def reflectance(self, si: mi.SurfaceInteraction3f, hit: mi.Bool) -> mi.Float:
        """Diffuse reflectance of matte surfaces, by which shared light is divided; 1 for glossy ones, 0 for none."""
        is_matte_there = dr.gather(mi.Bool, self.matte_of, number_of(si.shape), hit)
        return dr.select(is_matte_there, mono(si.bsdf().eval_diffuse_reflectance(si, hit)), dr.select(hit, 1, 0))

    @dr.syntax
    def behind(self, si: mi.SurfaceInteraction3f, hit: mi.Bool) -> Scatterer:
        """The first surface that scatters on the main chain that begins at the surface `si`, or `si` itself."""
        chain, left = dr.zeros(mi.UInt32, dr.width(hit)), dr.full(mi.UInt32, MAX_CHAIN, dr.width(hit))
        branches = dr.zeros(mi.UInt32, dr.width(hit))
        if dr.hint(not self.has_chains, mode="scalar"):
            return Scatterer(si, self.index(si, hit), chain, branches)
        goes_on = hit & dr.gather(mi.Bool, self.specular_of, number_of(si.shape), hit)
        while goes_on:
            # With 0.5 for a random number, a BSDF of two ways takes the more likely one
            bs, _ = si.bsdf().sample(delta_only(mi.TransportMode.Radiance), si, 0.5, mi.Point2f(0.5), goes_on)
            is_through = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Transmission | mi.BSDFFlags.Null)
            way = 2 * mi.UInt32(self.index(si, goes_on)) + dr.select(is_through, mi.UInt32(2), mi.UInt32(1))
            chain = mi.sample_tea_32(chain, way)[0]
            splits = dr.gather(mi.Bool, self.splits_of, number_of(si.shape), goes_on)
            splits &= (bs.pdf < CERTAIN) & (branches < MAX_BRANCHES)
            branches = dr.select(splits, branches + 1, branches)
            ray = si.spawn_ray(si.to_world(bs.wo))
            si = self.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=goes_on)
            hit, left = si.is_valid(), left - 1
            goes_on = hit & (left > 0) & dr.gather(mi.Bool, self.specular_of, number_of(si.shape), hit)
        return Scatterer(si, self.index(si, hit), chain, branches)
