# SPDX-License-Identifier: Apache-2.0
"""The BSDF `retroreflector`, which Mitsuba lacks: it sends the lobe of another BSDF back to where light came from.

    <bsdf type="retroreflector">
        <float name="falloff" value="3.5"/>
        <bsdf type="roughconductor"> ... </bsdf>
    </bsdf>

The nested BSDF is evaluated with the incident direction mirrored about the normal ("back vector"). Light that it would
reflect in the mirror direction then returns to where it came from. Reciprocity, energy and sampling are those of the
nested BSDF (Portsmouth, Raab, Belcour, Liu, The Minimal Retroreflective Microfacet Model, JCGT 15(1), 2026). The
roughness `alpha` of the nested BSDF sets the observation angle: most light returns within a few times alpha radians.

Real sheeting returns less of the light that comes in at an angle. The exponent `falloff` p >= 0, default 0, describes
this: the lobe is multiplied by (cos theta_i cos theta_o)^(p / 2). This factor is reciprocal and at most 1. On the axis
of the lobe it is cos^p of the entrance angle.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

TYPE_NAME = "retroreflector"
"""Name of the BSDF in scene files."""
_registered: set[str] = set()
"""Variants in which the BSDF is registered. Mitsuba keeps plugins per variant until the process ends."""


def register() -> None:
    """Register `retroreflector` with the active Mitsuba variant; further calls do nothing."""
    if mi.variant() not in _registered:
        mi.register_bsdf(TYPE_NAME, _retroreflector_class())
        _registered.add(mi.variant())


def _retroreflector_class() -> type:
    """The class of the BSDF for the active variant: it derives from the `mitsuba.BSDF` of that variant."""

    class RetroReflector(mi.BSDF):  # type: ignore[misc, name-defined]
        def __init__(self, props: Any) -> None:
            super().__init__(props)
            nested = [props[name] for name in props.keys() if isinstance(props[name], mi.BSDF)]  # noqa: SIM118
            self.falloff = float(props.get("falloff", 0.0))
            if len(nested) != 1:
                raise RuntimeError(f"expected a {TYPE_NAME} to hold one BSDF, got {len(nested)}.")
            if self.falloff < 0:
                raise RuntimeError(f"expected a falloff of at least 0, got {self.falloff}.")
            self.nested = nested[0]
            if mi.has_flag(self.nested.flags(), mi.BSDFFlags.Transmission):
                raise RuntimeError(f"expected the BSDF in a {TYPE_NAME} to reflect only, got {self.nested}.")
            self.m_components = [self.nested.flags(i) for i in range(self.nested.component_count())]
            self.m_flags = self.nested.flags()

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            bs, weight = self.nested.sample(ctx, _from_behind(si), sample1, sample2, active)
            return bs, weight * self._entrance(si, bs.wo)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.nested.eval(ctx, _from_behind(si), wo, active) * self._entrance(si, wo)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.nested.pdf(ctx, _from_behind(si), wo, active)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            value, pdf = self.nested.eval_pdf(ctx, _from_behind(si), wo, active)
            return value * self._entrance(si, wo), pdf

        def eval_pdf_sample(self, ctx: Any, si: Any, wo: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            mirrored = _from_behind(si)
            value, pdf, bs, weight = self.nested.eval_pdf_sample(ctx, mirrored, wo, sample1, sample2, active)
            return value * self._entrance(si, wo), pdf, bs, weight * self._entrance(si, bs.wo)

        def _entrance(self, si: Any, wo: Any) -> Any:
            if self.falloff == 0:
                return mi.Float(1)
            return dr.power(dr.maximum(si.wi.z * wo.z, 0), 0.5 * self.falloff)

        def traverse(self, callback: Any) -> None:
            callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return f"RetroReflector[falloff={self.falloff}, nested={self.nested}]"

    return RetroReflector


def _from_behind(si: Any) -> Any:
    """The surface interaction with its incident direction mirrored about the normal."""
    mirrored = mi.SurfaceInteraction3f(si)
    mirrored.wi = mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z)
    return mirrored
