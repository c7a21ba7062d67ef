"""The BRDF of the paper (eq. 2-6) as a Mitsuba 3 plugin, and its check against plain NumPy.

A BSDF in Python needs one of Mitsuba's vectorised variants; importing this module selects
``llvm_ad_rgb``, because the base class below only exists once a variant is chosen.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

mi.set_variant("llvm_ad_rgb")
import drjit as dr  # noqa: E402  (drjit follows Mitsuba's variant)

Array = npt.NDArray[np.float64]


def g1(x: Any, y: Any) -> Any:
    """Eq. 4's factor; the product of two already holds the 1 / (4 cos cos)."""
    return 1 / (x + dr.sqrt(x * x + y * y - x * x * y * y))


class PaperBRDF(mi.BSDF):
    """rho / pi + G D F with one roughness phi and one specular psi; black from behind.

    Directions are drawn from a mixture: a half vector from D, or the cosine. The mixture's share
    follows the Fresnel term against the albedo, so it depends on ``wi`` alone and ``pdf`` agrees.
    """

    def __init__(self, props: mi.Properties) -> None:
        mi.BSDF.__init__(self, props)
        # Opaque values keep one compiled kernel for all objects instead of one per parameter pair.
        self.phi = dr.opaque(mi.Float, float(props["phi"]))
        self.psi = dr.opaque(mi.Float, float(props["psi"]))
        self.albedo = props.get_texture("albedo")
        glossy = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        diffuse = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
        self.m_components = [glossy, diffuse]
        self.m_flags = glossy | diffuse

    @property
    def alpha(self) -> Any:
        return dr.maximum(self.phi, 0.001)

    def fresnel(self, cosine: Any) -> Any:
        f0 = 0.08 * self.psi
        return f0 + (1 - f0) * (1 - dr.clip(cosine, 0, 1)) ** 5

    def distribution(self, cosine: Any) -> Any:
        a2 = dr.square(self.alpha)
        return a2 / (dr.pi * dr.square(1 + (a2 - 1) * dr.square(cosine)))

    def glossy_share(self, si: Any, albedo: Any) -> Any:
        glossy = self.fresnel(mi.Frame3f.cos_theta(si.wi))
        return dr.clip(glossy / (glossy + 0.5 * dr.mean(albedo)), 0.1, 0.8)

    def value(self, si: Any, wo: Any, albedo: Any) -> Any:
        """The BRDF times the cosine towards ``wo``."""
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        h = dr.normalize(si.wi + wo)
        y = dr.square(0.5 * self.phi + 0.5)
        specular = g1(cos_i, y) * g1(cos_o, y)
        specular *= self.distribution(mi.Frame3f.cos_theta(h)) * self.fresnel(dr.dot(wo, h))
        front = (cos_i > 0) & (cos_o > 0)
        return dr.select(front, (albedo / dr.pi + specular) * cos_o, 0)

    def density(self, si: Any, wo: Any, albedo: Any) -> Any:
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        h = dr.normalize(si.wi + wo)
        cos_h, wo_h = mi.Frame3f.cos_theta(h), dr.dot(wo, h)
        lobe = self.distribution(cos_h) * cos_h / (4 * dr.maximum(wo_h, 1e-8))
        share = self.glossy_share(si, albedo)
        mixed = share * lobe + (1 - share) * cos_o / dr.pi
        return dr.select((cos_i > 0) & (cos_o > 0), mixed, 0)

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        albedo = self.albedo.eval(si, active)
        glossy = sample1 < self.glossy_share(si, albedo)
        u = sample2.x
        tan2 = dr.square(self.alpha) * u / dr.maximum(1 - u, 1e-7)
        cos_h = dr.rsqrt(1 + tan2)
        sin_h = dr.safe_sqrt(1 - dr.square(cos_h))
        sin_p, cos_p = dr.sincos(2 * dr.pi * sample2.y)
        h = mi.Vector3f(sin_h * cos_p, sin_h * sin_p, cos_h)
        mirrored = 2 * dr.dot(si.wi, h) * h - si.wi
        wo = dr.select(glossy, mirrored, mi.warp.square_to_cosine_hemisphere(sample2))

        bs = mi.BSDFSample3f()
        bs.wo = wo
        bs.pdf = self.density(si, wo, albedo)
        bs.eta = 1.0
        bs.sampled_type = dr.select(
            glossy,
            mi.UInt32(+mi.BSDFFlags.GlossyReflection),
            mi.UInt32(+mi.BSDFFlags.DiffuseReflection),
        )
        bs.sampled_component = dr.select(glossy, mi.UInt32(0), mi.UInt32(1))
        usable = active & (bs.pdf > 0)
        weight = self.value(si, wo, albedo) / dr.maximum(bs.pdf, 1e-20)
        return bs, dr.select(usable, weight, 0)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return dr.select(active, self.value(si, wo, self.albedo.eval(si, active)), 0)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return dr.select(active, self.density(si, wo, self.albedo.eval(si, active)), 0)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        albedo = self.albedo.eval(si, active)
        value, pdf = self.value(si, wo, albedo), self.density(si, wo, albedo)
        return dr.select(active, value, 0), dr.select(active, pdf, 0)

    def traverse(self, callback: Any) -> None:
        callback.put("albedo", self.albedo, mi.ParamFlags.Differentiable)

    def to_string(self) -> str:
        return f"PaperBRDF[phi={self.phi}, psi={self.psi}]"


mi.register_bsdf("paper_brdf", lambda props: PaperBRDF(props))


# ---- check -------------------------------------------------------------------------------------


def reference(wi: Array, wo: Array, rho: float, phi: float, psi: float) -> Array:
    """Eq. 2-6 literally, times the cosine: (..., 3) unit directions above the plane to (...)."""
    h = wi + wo
    h = h / np.linalg.norm(h, axis=-1, keepdims=True)
    y, a, f0 = (phi / 2 + 0.5) ** 2, max(0.001, phi), 0.08 * psi

    def shadow(x: Array) -> Array:
        return np.asarray(1 / (x + np.sqrt(x**2 + y**2 - x**2 * y**2)))

    d = a**2 / (np.pi * (1 + (a**2 - 1) * h[..., 2] ** 2) ** 2)
    f = f0 + (1 - f0) * (1 - np.sum(wo * h, axis=-1)) ** 5
    lobe = shadow(wi[..., 2]) * shadow(wo[..., 2]) * d * f
    return np.asarray((rho / np.pi + lobe) * wo[..., 2])


def check_brdf(rays: int = 1_000_000) -> list[str]:
    """One line per material and direction; raises AssertionError where the plugin is wrong.

    Three things are compared: the value with ``reference``, the sampled directions with the pdf
    (chi-square), and the mean sampling weight with the mean of value / uniform pdf, which share
    nothing but the value.
    """
    rng = np.random.default_rng(1)
    lines = []
    for phi, psi, rho, elevation in [
        (0.04, 0.9, 0.1, 60), (0.12, 0.5, 0.4, 25), (0.3, 0.6, 0.3, 80), (0.9, 0.1, 0.7, 45)
    ]:  # fmt: skip
        wi = np.array([np.cos(np.radians(elevation)), 0, np.sin(np.radians(elevation))])
        plugin = {"type": "paper_brdf", "phi": phi, "psi": psi}
        plugin["albedo"] = {"type": "rgb", "value": [rho] * 3}
        bsdf = mi.load_dict(plugin)
        si = dr.zeros(mi.SurfaceInteraction3f, rays)
        si.wi = mi.Vector3f(wi)

        # Half of the directions are crowded about the mirror direction, where the lobe is.
        wo = rng.normal(size=(rays, 3))
        wo[::2] = np.array([-wi[0], 0, wi[2]]) + 0.1 * wo[::2]
        wo[:, 2] = np.abs(wo[:, 2])
        wo /= np.linalg.norm(wo, axis=1, keepdims=True)
        value = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(wo.T)))[0]
        expected = reference(wi, wo, rho, phi, psi)
        worst = float(np.max(np.abs(value - expected) / (1e-3 + expected)))
        assert worst < 2e-3, f"the value is off by {worst:.1e} at phi {phi}"

        random = mi.PCG32(size=rays)
        two = mi.Vector2f(random.next_float32(), random.next_float32())
        _, weight = bsdf.sample(mi.BSDFContext(), si, random.next_float32(), two)
        drawn = np.array(weight)[0]
        quadrature, sampled = directional_albedo(wi, rho, phi, psi), float(drawn.mean())
        error = 4 * float(drawn.std()) / rays**0.5 + 1e-4
        assert abs(sampled - quadrature) < error, f"{sampled} is not {quadrature} at phi {phi}"

        sample, pdf = mi.chi2.BSDFAdapter("paper_brdf", plugin, wi=wi.tolist())
        chi2 = mi.chi2.ChiSquareTest(
            mi.chi2.SphericalDomain(), sample, pdf, sample_dim=3, res=201, ires=16
        )
        assert chi2.run(significance_level=0.01), f"the pdf disagrees with the samples: {plugin}"
        lines.append(
            f"phi {phi:.2f} psi {psi:.2f} elevation {elevation}: value within {worst:.0e}, "
            f"directional albedo {sampled:.4f} (quadrature {quadrature:.4f}), chi-square passed"
        )
    return lines


def directional_albedo(wi: Array, rho: float, phi: float, psi: float, n: int = 4000) -> float:
    """The integral of ``reference`` over the hemisphere by the midpoint rule, in NumPy.

    The lobe is integrated over half vectors, in tan(theta_h) / alpha, where it is smooth.
    """
    a = max(0.001, phi)
    t = (np.arange(n) + 0.5) / n
    azimuth = (np.arange(720) + 0.5) / 720 * 2 * np.pi
    u, p = np.meshgrid(t, azimuth, indexing="ij")
    cos_h = 1 / np.sqrt(1 + a**2 * u / (1 - u))
    sin_h = np.sqrt(1 - cos_h**2)
    h = np.stack([sin_h * np.cos(p), sin_h * np.sin(p), cos_h], axis=-1)
    wi_h = h @ wi
    wo = 2 * wi_h[..., None] * h - wi
    front = (wi_h > 0) & (wo[..., 2] > 0)
    density = a**2 / (np.pi * (1 + (a**2 - 1) * cos_h**2) ** 2) * cos_h / (4 * wi_h)
    lobe = reference(wi, np.where(front[..., None], wo, wi), 0.0, phi, psi) / density
    return rho + float(np.where(front, lobe, 0).mean())
