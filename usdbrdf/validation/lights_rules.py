"""Rules about the variant set ``lights``: a choice that exists, and every lamp once."""

from __future__ import annotations

from collections.abc import Iterator

from pxr import Usd, UsdGeom, UsdLux, UsdShade

from usdbrdf.asset.layers.task_layers import EMISSIVE, USDLUX
from usdbrdf.asset.layers.task_layers import LIGHTS as VARIANT_SET
from usdbrdf.asset.readers.scene import authored
from usdbrdf.validation.asset_stage import AssetStage
from usdbrdf.validation.rule import Fault, Severity, Site, cure, rule


@cure("select emissive, which is what shows already")
def select_emissive(site: Site) -> bool:
    return bool(site.GetVariantSet(VARIANT_SET).SetVariantSelection(EMISSIVE))


@rule(Severity.WARNING, advice="Select emissive or usdlux.", cure=select_emissive)
def lights_selection(scene: AssetStage) -> Iterator[Fault]:
    """The variant of the set lights that is selected on the default prim exists. USD takes any name
    and says nothing; there are then no UsdLux lights, and the lamps glow by their materials."""
    if _has_lights(scene) and scene.root_prim:
        lights = scene.root_prim.GetVariantSet(VARIANT_SET)
        if lights.GetVariantSelection() not in lights.GetVariantNames():
            yield Fault(
                scene.root_prim,
                f"the selected lights are {lights.GetVariantSelection()!r}, which is none "
                f"of the variants: the lamps glow as in {EMISSIVE}.",
            )


@rule(
    Severity.WARNING,
    advice="Select emissive, or give the opinion inside its variant; or deactivate the lights of "
    "that lamp.",
)
def lamp_twice(scene: AssetStage) -> Iterator[Fault]:
    """Where usdlux is selected in the set lights, the lamps that have lights do not glow by their
    materials. An opinion that makes one glow again, or binds it a glowing material, beats the
    variant: renderers count that lamp twice."""
    root = scene.root_prim
    if not _has_lights(scene) or not root or not scene.scopes:
        return
    if root.GetVariantSet(VARIANT_SET).GetVariantSelection() != USDLUX:
        return
    for item in scene.objects:
        lights = scene.scopes.path("lights", str(authored(item, "usdBrdf:identifier")))
        if _is_visible(item) and _shines(scene.stage.GetPrimAtPath(lights)):
            for glow in _emission(item):
                if not scene.is_measured(glow):
                    yield Fault(
                        glow, f"the lamp glows by this opinion, and shines by <{lights}> too."
                    )


def _has_lights(scene: AssetStage) -> bool:
    """Whether layers of ours have the set; without lamps of a shape for it they do not."""
    root = scene.root_prim
    specs = [layer.GetPrimAtPath(root.GetPath()) for layer in scene.own_layers] if root else []
    return any(spec and VARIANT_SET in spec.variantSets for spec in specs)


def _is_visible(prim: Usd.Prim) -> bool:
    return bool(UsdGeom.Imageable(prim).ComputeVisibility() != UsdGeom.Tokens.invisible)


def _shines(scope: Usd.Prim) -> bool:
    """Whether any light below is left on."""
    return any(
        prim.HasAPI(UsdLux.LightAPI)
        and _is_visible(prim)
        and UsdLux.LightAPI(prim).GetIntensityAttr().Get() > 0
        for prim in (Usd.PrimRange(scope) if scope else ())
    )


def _emission(item: Usd.Prim) -> list[Usd.Attribute]:
    """The attributes by which an object's material glows: a colour, or a texture's factor."""
    material = UsdShade.MaterialBindingAPI(item).ComputeBoundMaterial()[0]
    surface = material.ComputeSurfaceSource()[0] if material else None
    emissive = surface.GetInput("emissiveColor") if surface else None
    values = []
    for producer in emissive.GetValueProducingAttributes() if emissive else ():
        texture = UsdShade.Shader(producer.GetPrim())
        if texture.GetShaderId() == "UsdUVTexture" and UsdShade.Output.IsOutput(producer):
            factors = [texture.GetInput(name) for name in ("scale", "bias")]
            values += [factor.GetAttr() for factor in factors if factor]
        else:
            values.append(producer)
    return [value for value in values if any(component > 0 for component in _rgb(value))]


def _rgb(attribute: Usd.Attribute) -> list[float]:
    return list(attribute.Get() or ())[:3]


RULES = (lights_selection, lamp_twice)
