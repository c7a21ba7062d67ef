"""What earlier stages said about an object -> the records that they wrote."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pxr import Usd, UsdGeom

from usdbrdf.asset.layout import path_in_asset
from usdbrdf.asset.properties import Aov, FittedObject, ShadedObject, TexturedObject
from usdbrdf.asset.readers.frames import asset_file
from usdbrdf.asset.readers.scene import read_corner_uv, triangulation_of

_TIME = Usd.TimeCode.Default()


def aov_path(stage: Usd.Stage, prim_path: str, aov: str) -> Path | None:
    """Absolute path of an object's map; None where the object has no such map."""
    attribute = stage.GetPrimAtPath(prim_path).GetAttribute(f"usdBrdf:aov:{aov}:file")
    return asset_file(attribute, _TIME) if attribute else None


def read_aovs(stage: Usd.Stage, prim_path: str) -> tuple[Aov, ...]:
    """All maps of an object, by name; from whatever stages the stage is composed of."""
    prim = stage.GetPrimAtPath(prim_path)
    files = {
        p.GetName().split(":")[2]: p
        for p in prim.GetAuthoredPropertiesInNamespace("usdBrdf:aov")
        if p.GetName().endswith(":file")
    }
    return tuple(
        Aov(
            name=name,
            file=path_in_asset(files[name].Get().path),
            scale=_number(prim, f"aov:{name}:scale"),
            unit=str(_value(prim, f"aov:{name}:unit")),
        )
        for name in sorted(files)
    )


def read_texturing(stage: Usd.Stage, prim_path: str) -> TexturedObject | None:
    """None before the texturing stage; ``aovs`` hold the maps of all stages present."""
    prim = stage.GetPrimAtPath(prim_path)
    mesh = UsdGeom.Mesh(prim)
    if _value(prim, "texturing:texelSize") is None:
        return None
    corner_uv = read_corner_uv(mesh, triangulation_of(mesh))
    if corner_uv is None:
        return None
    width, height = _value(prim, "texturing:resolution")
    return TexturedObject(
        prim_path=prim_path,
        identifier=str(_value(prim, "identifier")),
        corner_uv=corner_uv,
        aovs=read_aovs(stage, prim_path),
        texel_size=_number(prim, "texturing:texelSize"),
        seen_fraction=_number(prim, "texturing:seenFraction"),
        clipped_fraction=_number(prim, "texturing:clippedFraction"),
        resolution=(int(width), int(height)),
        seen=bool(_value(prim, "texturing:seen")),
        quantile=_number(prim, "texturing:quantile"),
    )


def read_shading(stage: Usd.Stage, prim_path: str) -> ShadedObject | None:
    """None before the shading stage; ``aovs`` hold the maps of all stages present."""
    prim = stage.GetPrimAtPath(prim_path)
    if _value(prim, "shading:raysPerTexel") is None:
        return None
    emitter = _value(prim, "emitter:radiance") is not None
    # Authored by versions that knew no other statuses than these two.
    earlier = "lowerBound" if _value(prim, "emitter:lowerBound") else "measured"
    return ShadedObject(
        prim_path=prim_path,
        identifier=str(_value(prim, "identifier")),
        aovs=read_aovs(stage, prim_path),
        emitter=emitter,
        radiance=_colour(prim, "emitter:radiance"),
        radiance_status=str(_value(prim, "emitter:radianceStatus") or earlier),
        radiance_error=_number(prim, "emitter:radianceError"),
        area_fraction=_number(prim, "emitter:areaFraction") if emitter else 0.0,
        mean_albedo=_colour(prim, "shading:meanAlbedo"),
        rays_per_texel=_number(prim, "shading:raysPerTexel"),
        standard_error=_number(prim, "shading:standardError"),
        escaped_fraction=_number(prim, "shading:escapedFraction"),
    )


def read_fit(stage: Usd.Stage, prim_path: str) -> FittedObject | None:
    """None before the fitting stage."""
    prim = stage.GetPrimAtPath(prim_path)
    if _value(prim, "fit:status") is None:
        return None
    return FittedObject(
        prim_path=prim_path,
        identifier=str(_value(prim, "identifier")),
        phi=_number(prim, "fit:phi"),
        psi=_number(prim, "fit:psi"),
        cost=_number(prim, "fit:cost"),
        evidence=_number(prim, "fit:evidence"),
        status=str(_value(prim, "fit:status")),
        target_frame=int(_value(prim, "fit:targetFrame")),
        num_pixels=int(_value(prim, "fit:numPixels")),
        method=str(_value(prim, "fit:method")),
        phi_error=_number(prim, "fit:phiError"),
        psi_error=_number(prim, "fit:psiError"),
        phi_confidence=str(_value(prim, "fit:phiConfidence") or "none"),
        psi_confidence=str(_value(prim, "fit:psiConfidence") or "none"),
        mapping=str(_value(prim, "fit:mapping") or "measured"),
    )


def _value(prim: Usd.Prim, name: str) -> Any:
    """Authored value only: a schema's fallback is no measurement."""
    attribute = prim.GetAttribute(f"usdBrdf:{name}")
    return attribute.Get(_TIME) if attribute and attribute.HasAuthoredValue() else None


def _number(prim: Usd.Prim, name: str) -> float:
    value = _value(prim, name)
    return math.nan if value is None else float(value)


def _colour(prim: Usd.Prim, name: str) -> tuple[float, float, float]:
    value = _value(prim, name)
    return (0.0, 0.0, 0.0) if value is None else (float(value[0]), float(value[1]), float(value[2]))
