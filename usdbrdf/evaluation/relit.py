"""One asset's albedo under another's light: the paper's cross-check (section 4.2, Fig. 5).

predicted L_d,A = S_A rho_B / pi        S_A, L_d,A of asset A; rho_B of asset B, same geometry
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from usdbrdf.evaluation.correspondence import Correspondence, correspondence
from usdbrdf.evaluation.metrics import finite, median_relative, nrmse
from usdbrdf.evaluation.truth import MIN_SAMPLES
from usdbrdf.steps.atlas import Atlas

Float = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class MapNames:
    """Which maps are the diffuse radiance, the irradiance and the albedo."""

    radiance: str
    irradiance: str
    albedo: str


@dataclass(frozen=True, kw_only=True)
class Relit:
    """On the texels of one asset, (T, 3) each: its radiance, the radiance predicted with the other
    asset's albedo, both albedos; the texels that are compared, (T,) bool."""

    atlas: Atlas
    measured: Float
    predicted: Float
    albedo: Float
    other_albedo: Float
    scored: Bool


def matched(atlas: Atlas, other: Atlas) -> tuple[Correspondence, Bool]:
    """The other asset's texels on those of ``atlas``, and which are compared: (T,) bool, seen at
    least three times, inside a triangle and without emission, in both."""
    same = correspondence(atlas.scene, atlas.texels, other.scene, other.texels)
    there = np.asarray(same.nearest(_comparable(other)), np.bool_)
    return same, _comparable(atlas) & there & same.known()


def relit(atlas: Atlas, other: Atlas, same: Correspondence, scored: Bool, maps: MapNames) -> Relit:
    """Predict the radiance of ``atlas`` with the albedo of ``other``."""
    theirs = same.interpolated(other.map_where_present(maps.albedo, 3))
    measured = atlas.map_where_present(maps.radiance, 3)
    reflected = atlas.map(maps.irradiance) * theirs / np.pi
    # Lamps are given: what is predicted is what they light.
    emits = atlas.map_where_present("emission", 3).any(axis=1, keepdims=True)
    return Relit(
        atlas=atlas,
        measured=measured,
        predicted=np.where(emits, measured, reflected).astype(np.float32),
        albedo=atlas.map_where_present(maps.albedo, 3),
        other_albedo=theirs,
        scored=scored,
    )


def errors(reference: Float, values: Float, area: Float, part: Bool) -> dict[str, float | None]:
    """NRMSE and median relative errors over the texels of ``part``."""
    absolute, signed = median_relative(values[part], reference[part])
    return {
        "nrmse": finite(nrmse(values[part], reference[part], area[part])),
        "median_abs_relative": finite(absolute),
        "median_signed": finite(signed),
    }


def _comparable(atlas: Atlas) -> Bool:
    seen = atlas.map("samples")[:, 0] >= MIN_SAMPLES
    emits = (atlas.map_where_present("emission", 3) > 0).any(axis=1)
    return np.asarray(seen & ~emits & atlas.texels.interior, np.bool_)
