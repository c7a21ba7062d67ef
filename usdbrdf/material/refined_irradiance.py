"""S as it is once the lobes are known, and the light that surfaces scatter below themselves.

The lit texture as a light has three faults: it holds the specular light that most views have in
common, as if it went everywhere; it lacks the light that lobes send elsewhere; and where nobody
looked it is as bright as the nearest surface that was seen, though such places are mostly dark.
What their cure changes is small against S, so few rays do, and where a filter takes
their noise, very few."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Bool, Float, Int, Long
from usdbrdf.options import Sampling
from usdbrdf.shading.shaded import by_tiles, denoised_irradiance
from usdbrdf.transport.brdf import DIELECTRIC
from usdbrdf.transport.denoise import NONE, OIDN
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import ByAngle, irradiance_at
from usdbrdf.transport.let_through import share_let_through, table_let_through
from usdbrdf.transport.lights import Lights
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.lobe_radiance import specular_irradiance
from usdbrdf.transport.sunlight import sunlight
from usdbrdf.transport.surface_texture import SurfaceTexture

# Rays per texel for the change of the diffuse light, half of them to where it changes most; and for
# the specular light, by what filters S afterwards, with so many again from where each of them ends.
_DIFFUSE_RAYS = 64
_SPECULAR_RAYS: Mapping[str, int] = {OIDN: 8, NONE: 64}
_RAYS_OF_LOBE = 4
# Not the seed of the irradiance as traced: their errors must not add up.
_SEED = 0x5EED


@dataclass(frozen=True)
class Lobes:
    """One lobe per object: phi (num_objects,), psi (num_objects, 3) float32; conducts
    (num_objects,): it is a metal's, and there is no diffuse part."""

    phi: Float
    psi: Float
    conducts: Bool

    def take(self, index: Int) -> Lobes:
        return Lobes(self.phi[index], self.psi[index], self.conducts[index])


class _Change(NamedTuple):
    """What of the light is other than traced before: ``radiance`` by its texture, ``lights`` where
    that shows, and the specular light of ``lobes`` by so many rays."""

    lit: LitScene
    radiance: SurfaceTexture
    lights: Lights
    lobes: Lobes
    sampling: Sampling
    specular_rays: int


def _changed_irradiance(given: _Change, index: Long, patch: Int) -> dict[str, Array]:
    """By how much S of some texels is other."""
    lit, lobes, texels = given.lit, given.lobes, given.lit.texels
    position, normal = texels.position[index], texels.normal[index]
    diffuse = irradiance_at(
        lit.light_rays, given.radiance, given.lights, black_environment(), position, normal, patch,
        given.sampling, lit.diagonal_m,
    )  # fmt: skip
    # Of fewer points at a time: what they trace takes no more memory than with few rays.
    parts = np.array_split(np.arange(len(index)), given.specular_rays // _SPECULAR_RAYS[OIDN])
    specular = [
        specular_irradiance(
            lit, position[part], normal[part], index[part], lobes.phi, lobes.psi,
            rays=given.specular_rays, rays_of_lobe=_RAYS_OF_LOBE, seed=given.sampling.seed,
        )
        for part in parts
    ]  # fmt: skip
    return {"change": diffuse.mean + np.concatenate(specular)}


def refined_irradiance(
    run: TaskRun,
    lit: LitScene,
    traced: Float,
    change: Float,
    lobes: Lobes,
    lightmap_filter: str,
    seed: int,
) -> Float:
    """S (T, 3), W/m^2: as ``traced`` (T, 3) from the lit texture, with what changes if the light is
    other by ``change`` (T, 3), W/(m^2 sr), and the lobes are light as well."""
    texels, seed = lit.texels, seed ^ _SEED
    texture = lit.radiance.showing(texels, change)
    lights = lit.lights_of(np.abs(change))
    sampling = Sampling(standard_error=0, max_rays=_DIFFUSE_RAYS, seed=seed)

    given = _Change(lit, texture, lights, lobes, sampling, _SPECULAR_RAYS[lightmap_filter])
    found = by_tiles(run, texels, "refined", "fit: shade", _changed_irradiance, given)["change"]
    refined = np.maximum(traced + np.asarray(found, np.float32), 0)
    return denoised_irradiance(texels, refined) if lightmap_filter == OIDN else refined


class _Scattering(NamedTuple):
    """What light goes in by: ``radiance`` of all surfaces by its texture, ``lights`` where that is
    bright, and by how much it ``differs`` from S at each angle (num_objects, C) of the objects that
    are ``passing`` (num_objects,) some of it; owner (T,): the object of each texel."""

    lit: LitScene
    radiance: SurfaceTexture
    lights: Lights
    lobes: Lobes
    sampling: Sampling
    differs: Float
    passing: Bool
    owner: Int


def _scattered(given: _Scattering, index: Long, patch: Int) -> dict[str, Array]:
    """By how much the light that some texels scatter differs from S."""
    lit, lobes, texels = given.lit, given.lobes, given.lit.texels
    owner = given.owner[index]
    found, own = np.zeros((len(index), 3), np.float32), given.passing[owner]
    inner, surface = index[own], owner[own]
    if len(inner):
        normal, sun = texels.normal[inner], lit.environment.sun
        found[own] = irradiance_at(
            lit.light_rays, given.radiance, given.lights, lit.environment, texels.position[inner],
            normal, patch[own], given.sampling, lit.diagonal_m,
            by_angle=ByAngle(given.differs, surface),
        ).mean  # fmt: skip
        of_sun = share_let_through(lobes.phi[surface], lobes.psi[surface], normal @ sun.direction)
        found[own] += (of_sun - 1)[:, None] * sunlight(lit, inner, sun, given.sampling.seed)
    return {"differs": found}


def let_through_surfaces(
    run: TaskRun, lit: LitScene, light: Float, lobes: Lobes, seed: int
) -> Float:
    """By how much (T, 3), W/m^2, the light that dielectrics scatter below their surface differs
    from S: they let through what comes from the front, and mostly reflect what grazes them; see
    ``let_through``. light (T, 3): what all surfaces send out, W/(m^2 sr)."""
    texels = lit.texels
    passing = ~lobes.conducts & (lobes.psi.mean(axis=1) > 0) & (lit.lobe == DIELECTRIC)
    if not passing.any():
        return np.zeros((len(texels), 3), np.float32)
    given = _Scattering(
        lit,
        lit.radiance.showing(texels, light),
        lit.lights_of(light, lit.environment),
        lobes,
        Sampling(standard_error=0, max_rays=_DIFFUSE_RAYS, seed=seed ^ _SEED),
        table_let_through(lobes.phi, lobes.psi) - 1,
        passing,
        texels.object_index(),
    )
    return by_tiles(run, texels, "let-through", "fit: surfaces", _scattered, given)["differs"]
