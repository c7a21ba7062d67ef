"""The lobe that was fitted (docs/equations.md) as a BSDF of Mitsuba's vectorised variants."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from usdbrdf.transport.brdf import (
    BECKMANN,
    DIELECTRIC,
    F0_OF_PSI,
    MIN_ALPHA,
    PAPER,
    beckmann_distribution,
    beckmann_masking,
    distribution,
    fresnel,
    is_dielectric,
    masking,
    masking_width,
    reflectance,
    share_of_base,
)
from usdbrdf.transport.let_through import facet_shares

NAME = "usdbrdf_lobe"
_registered: set[str] = set()


def register(mi: Any) -> None:
    """Make the plugin ``usdbrdf_lobe`` known to the variant that is set.

    It takes the textures ``diffuse`` and ``f0`` (colours) and ``phi``, the roughness parameter of
    the lobe, and the number ``lobe``, its kind: f = diffuse / pi + G1(wi) G1(wo) D(h) F(wo, h),
    with the terms of ``brdf``. The back is black. B. Haefner et al. 2021, eq. 2 to 6. Of DIELECTRIC
    and BECKMANN the diffuse part is what the surface lets through twice, t(wi) t(wo) diffuse / pi
    over t as seen from the front (``let_through``).
    """
    if mi.variant() in _registered:
        return
    # The base class exists only once a variant is set, so the class is made here.
    import drjit as dr

    @cache
    def tables() -> tuple[Any, Any]:
        """What facets take, one for all lobes: each with its own would be code of its own."""
        shares = facet_shares()
        knots = np.stack([shares.base, shares.rise], axis=-1)
        means = np.concatenate(shares[2:], axis=1)
        found = (
            mi.Texture2f(mi.TensorXf(np.ascontiguousarray(knots, np.float32))),
            mi.Texture1f(mi.TensorXf(np.ascontiguousarray(means, np.float32))),
        )
        dr.eval(found)  # what is not computed yet would be code of the first lobe alone
        return found

    class Lobe(mi.BSDF):  # type: ignore[misc]
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.diffuse = props.get_texture("diffuse")
            self.f0 = props.get_texture("f0")
            self.phi = props.get_texture("phi")
            self.kind = int(props.get("lobe", PAPER))
            glossy = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            matte = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            if is_dielectric(self.kind):
                self.facets, self.means = tables()
            self.m_components = [glossy, matte]
            self.m_flags = glossy | matte

        def _parameters(self, si: Any, active: Any) -> tuple[Any, Any, Any]:
            phi = self.phi.eval_1(si, active)
            return self.diffuse.eval(si, active), self.f0.eval(si, active), phi

        def _glossy_share(self, si: Any, diffuse: Any, f0: Any) -> Any:
            # Depends on wi alone, so that pdf agrees with sample.
            glossy = fresnel(dr.mean(f0), dr.clip(mi.Frame3f.cos_theta(si.wi), 0, 1))
            return dr.clip(glossy / (glossy + 0.5 * dr.mean(diffuse)), 0.1, 0.9)

        def _let_through(self, cos_i: Any, cos_o: Any, f0: Any, phi: Any) -> Any:
            """t(wi) t(wo) over t as seen from the front."""
            if not is_dielectric(self.kind):
                return 1.0
            # What reflects more is partly a metal; the rest of it is a dielectric.
            mean = dr.minimum(dr.mean(f0), F0_OF_PSI)
            of_base = share_of_base(mean, DIELECTRIC, dr.minimum)

            def place(x: Any, knots: int) -> Any:  # of knots from 0 to 1, in pixels' middles
                return (dr.clip(x, 0, 1) * (knots - 1) + 0.5) / knots

            def kept(base: Any, rise: Any) -> Any:
                return 1 - of_base * base - mean * rise

            phis, cosines, _ = self.facets.shape
            row = place(dr.sqrt(dr.maximum(phi, 0)), phis)
            passed = (
                kept(*self.facets.eval(mi.Point2f(place(cosine, cosines), row)))
                for cosine in (cos_i, cos_o)
            )
            base, rise, base_seen, rise_seen = self.means.eval(mi.Point1f(row))
            return math.prod(passed) / (kept(base, rise) * kept(base_seen, rise_seen))

        def _value_and_density(self, si: Any, wo: Any, parameters: Any) -> tuple[Any, Any]:
            diffuse, f0, phi = parameters
            cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
            front = (cos_i > 0) & (cos_o > 0)
            h = dr.normalize(si.wi + wo)
            cos_h, wo_h = mi.Frame3f.cos_theta(h), dr.clip(dr.dot(wo, h), 0, 1)
            alpha, sin2_h = dr.maximum(phi, MIN_ALPHA), mi.Frame3f.sin_theta_2(h)
            d = drawn = distribution(sin2_h, alpha)
            y = masking_width(phi) if self.kind == PAPER else alpha
            base, rise = reflectance(wo_h, self.kind, dr.safe_sqrt)
            g = masking(cos_i, y, dr.safe_sqrt) * masking(cos_o, y, dr.safe_sqrt)
            if self.kind == BECKMANN:
                d = beckmann_distribution(sin2_h, alpha, dr.exp)
                of_facets = dr.safe_sqrt, dr.minimum
                g = math.prod(beckmann_masking(x, alpha, *of_facets) for x in (cos_i, cos_o))
            base = base * share_of_base(f0, self.kind, dr.minimum)
            below = diffuse * self._let_through(cos_i, cos_o, f0, phi) / dr.pi
            value = (below + g * d * (base + f0 * rise)) * cos_o
            share = self._glossy_share(si, diffuse, f0)
            lobe = drawn * cos_h / (4 * dr.maximum(wo_h, 1e-8))
            density = share * lobe + (1 - share) * cos_o / dr.pi
            return dr.select(front, value, 0), dr.select(front, density, 0)

        def sample(self, ctx: Any, si: Any, one: Any, two: Any, active: Any = True) -> Any:
            parameters = diffuse, f0, phi = self._parameters(si, active)
            glossy = one < self._glossy_share(si, diffuse, f0)
            tan2 = dr.square(dr.maximum(phi, MIN_ALPHA)) * two.x / dr.maximum(1 - two.x, 1e-7)
            cos_h = dr.rsqrt(1 + tan2)
            sin_h = dr.safe_sqrt(1 - dr.square(cos_h))
            sin_p, cos_p = dr.sincos(2 * dr.pi * two.y)
            h = mi.Vector3f(sin_h * cos_p, sin_h * sin_p, cos_h)
            mirrored = 2 * dr.dot(si.wi, h) * h - si.wi
            bs = mi.BSDFSample3f()
            bs.wo = dr.select(glossy, mirrored, mi.warp.square_to_cosine_hemisphere(two))
            value, bs.pdf = self._value_and_density(si, bs.wo, parameters)
            bs.eta = 1.0
            bs.sampled_type = dr.select(
                glossy,
                mi.UInt32(+mi.BSDFFlags.GlossyReflection),
                mi.UInt32(+mi.BSDFFlags.DiffuseReflection),
            )
            bs.sampled_component = dr.select(glossy, mi.UInt32(0), mi.UInt32(1))
            usable = active & (bs.pdf > 0)
            return bs, dr.select(usable, value / dr.maximum(bs.pdf, 1e-20), 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            value, density = self._value_and_density(si, wo, self._parameters(si, active))
            return dr.select(active, value, 0), dr.select(active, density, 0)

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            return self.diffuse.eval(si, active)

        def traverse(self, callback: Any) -> None:
            for name in ("diffuse", "f0", "phi"):
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return f"{NAME}[]"

    mi.register_bsdf(NAME, lambda props: Lobe(props))
    _registered.add(mi.variant())
