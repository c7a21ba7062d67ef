"""Rules about the variant sets: every look binds every object and nothing beats it; what is
selected is there; and every lamp counts once."""

from __future__ import annotations

from collections.abc import Iterator

from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade

from usdbrdf.asset.layers.input_usd import BINDING
from usdbrdf.asset.layers.lights_layer import EMISSIVE, LIGHTS, USDLUX
from usdbrdf.asset.layers.looks import LIT, SHADED
from usdbrdf.asset.layers.looks import VARIANT_SET as LOOKS
from usdbrdf.asset.readers.scene import authored
from usdbrdf.validation.rule import AssetStage, Fault, Severity, Site, cure, rule


@rule(Severity.WARNING)
def binding_beside_looks(scene: AssetStage) -> Iterator[Fault]:
    """Materials are bound inside the variants of the set look. A binding of an object beside them
    is a local opinion, which beats every variant: switching the look no longer changes that object.

    Author the binding inside the variant shaded of the default prim; leave it where the object is
    to show one material in every look."""
    for item in scene.objects if scene.own_variants(LOOKS) else ():
        subsets = UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Mesh(item))
        for prim in (item, *(subset.GetPrim() for subset in subsets)):
            for layer in scene.layers:
                spec = layer.GetPrimAtPath(prim.GetPath())
                for binding in spec.relationships if spec else ():
                    if _is_binding(binding):
                        said = f"{binding.name} in @{layer.realPath}@"
                        yield Fault(prim, f"{said} is no part of a look and beats all of them.")
        prim = item.GetParent()
        while prim and not prim.IsPseudoRoot():
            for binding in prim.GetAuthoredProperties():
                stronger = binding.GetMetadata("bindMaterialAs") == "strongerThanDescendants"
                if stronger and binding.GetName().startswith(BINDING) and binding.GetTargets():
                    said = f"<{binding.GetPath()}> is bound strongerThanDescendants"
                    yield Fault(item, f"{said} and beats every look.")
            prim = prim.GetParent()


def _is_binding(binding: Sdf.RelationshipSpec) -> bool:
    """Whether it says what is bound, not only how strong a weaker opinion is."""
    name = f"{binding.name}:".startswith(f"{BINDING}:")
    return name and bool(binding.targetPathList.GetAddedOrExplicitItems())


@rule(Severity.ERROR)
def look_incomplete(scene: AssetStage) -> Iterator[Fault]:
    """Every look binds a material to every object. An object without one shows the grey that a
    viewer falls back to, which is easily taken for a measurement.

    Run usdbrdf convert again, or bind a material to the object inside that look."""
    if scene.missing_layers:
        return
    root = scene.root_prim.GetPath() if scene.root_prim else Sdf.Path()
    inside = [item for item in scene.objects if item.GetPath().HasPrefix(root)]
    for look in sorted(scene.own_variants(LOOKS)):
        variant = root.AppendVariantSelection(LOOKS, look)
        for item in inside:
            # The strongest opinion about the object's binding inside the look.
            path = item.GetPath().ReplacePrefix(root, variant).AppendProperty(BINDING)
            specs = [layer.GetRelationshipAtPath(path) for layer in scene.layers]
            bound = next((spec for spec in specs if spec and _is_binding(spec)), None)
            if bound is None:
                yield Fault(item, f"the look {look} binds no material to this object.")
                continue
            stage = scene.looks.get(look, scene.stage)
            for inner in bound.targetPathList.GetAddedOrExplicitItems():
                target = inner.ReplacePrefix(variant, root)
                if target.IsPrimPath() and not UsdShade.Material(stage.GetPrimAtPath(target)):
                    yield Fault(item, f"the look {look} binds <{target}>, which is not a material.")


@cure("select shaded, or lit")
def select_known(site: Site) -> bool:
    looks = site.GetVariantSet(LOOKS)
    known = [name for name in (SHADED, LIT) if name in looks.GetVariantNames()]
    return bool(known and looks.SetVariantSelection(known[0]))


@rule(Severity.ERROR, select_known)
def look_selection(scene: AssetStage) -> Iterator[Fault]:
    """The look that is selected on the default prim exists. USD takes any name and says nothing;
    the objects then have no materials at all.

    Select one of the looks that the variant set has."""
    problem = "the selected look is {!r}, which is none: no object has a material."
    return _unknown_selection(scene, LOOKS, problem)


@cure("select emissive, which is what shows already")
def select_emissive(site: Site) -> bool:
    return bool(site.GetVariantSet(LIGHTS).SetVariantSelection(EMISSIVE))


@rule(Severity.WARNING, select_emissive)
def lights_selection(scene: AssetStage) -> Iterator[Fault]:
    """The variant of the set lights that is selected on the default prim exists. USD takes any name
    and says nothing; there are then no UsdLux lights, and the lamps glow by their materials.

    Select emissive, usdlux, or daylight where the asset has it."""
    problem = "the selected lights are {!r}, which is none of the variants: the lamps glow as in "
    return _unknown_selection(scene, LIGHTS, f"{problem}{EMISSIVE}.")


def _unknown_selection(scene: AssetStage, name: str, problem: str) -> Iterator[Fault]:
    if scene.own_variants(name) and scene.root_prim:
        variants = scene.root_prim.GetVariantSet(name)
        if variants.GetVariantSelection() not in variants.GetVariantNames():
            yield Fault(scene.root_prim, problem.format(variants.GetVariantSelection()))


@rule(Severity.WARNING)
def lamp_twice(scene: AssetStage) -> Iterator[Fault]:
    """Where usdlux is selected in the set lights, the lamps that have lights do not glow by their
    materials. An opinion that makes one glow again, or binds it a glowing material, beats the
    variant: renderers count that lamp twice.

    Select emissive, or give the opinion inside its variant; or deactivate the lights of that lamp.
    """
    root = scene.root_prim
    selected = root.GetVariantSet(LIGHTS).GetVariantSelection() if root else ""
    if not scene.scopes or selected != USDLUX or not scene.own_variants(LIGHTS):
        return
    for item in scene.objects:
        path = scene.scopes.path("lights", str(authored(item, "usdBrdf:identifier")))
        lights = scene.stage.GetPrimAtPath(path)
        shines = _is_visible(item) and any(
            prim.HasAPI(UsdLux.LightAPI)
            and _is_visible(prim)
            and UsdLux.LightAPI(prim).GetIntensityAttr().Get() > 0
            for prim in (Usd.PrimRange(lights) if lights else ())
        )
        for glow in _emission(item) if shines else ():
            if not scene.is_measured(glow):
                yield Fault(glow, f"the lamp glows by this opinion, and shines by <{path}> too.")


def _is_visible(prim: Usd.Prim) -> bool:
    return bool(UsdGeom.Imageable(prim).ComputeVisibility() != UsdGeom.Tokens.invisible)


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
    return [value for value in values if any(x > 0 for x in list(value.Get() or ())[:3])]
