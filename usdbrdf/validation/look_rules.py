"""Rules about the variant set ``look``: every look binds every object, and nothing beats it."""

from __future__ import annotations

from collections.abc import Iterator

from pxr import Sdf, Usd, UsdGeom, UsdShade

from usdbrdf.asset.layers.input_usd import BINDING
from usdbrdf.asset.layers.looks import LIT, SHADED, VARIANT_SET
from usdbrdf.validation.asset_stage import AssetStage
from usdbrdf.validation.rule import Fault, Severity, Site, cure, rule


@rule(
    Severity.WARNING,
    advice="Author the binding inside the variant shaded of the default prim; leave it where the "
    "object is to show one material in every look.",
)
def binding_beside_looks(scene: AssetStage) -> Iterator[Fault]:
    """Materials are bound inside the variants of the set look. A binding of an object beside them
    is a local opinion, which beats every variant: switching the look no longer changes that object.
    """
    if not _own_looks(scene):
        return
    for item in scene.objects:
        subsets = UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Mesh(item))
        for prim in (item, *(subset.GetPrim() for subset in subsets)):
            for layer in scene.layers:
                spec = layer.GetPrimAtPath(prim.GetPath())
                for binding in spec.relationships if spec else ():
                    if _is_binding(binding):
                        yield Fault(
                            prim,
                            f"{binding.name} in @{layer.realPath}@ is no part of a look "
                            "and beats all of them.",
                        )
        yield from _stronger_ancestors(item)


def _stronger_ancestors(item: Usd.Prim) -> Iterator[Fault]:
    prim = item.GetParent()
    while prim and not prim.IsPseudoRoot():
        for binding in prim.GetAuthoredProperties():
            stronger = binding.GetMetadata("bindMaterialAs") == "strongerThanDescendants"
            if stronger and binding.GetName().startswith(BINDING) and binding.GetTargets():
                yield Fault(
                    item,
                    f"<{binding.GetPath()}> is bound strongerThanDescendants and beats every look.",
                )
        prim = prim.GetParent()


@rule(
    Severity.ERROR,
    advice="Run usdbrdf convert again, or bind a material to the object inside that look.",
)
def look_incomplete(scene: AssetStage) -> Iterator[Fault]:
    """Every look binds a material to every object. An object without one shows the grey that a
    viewer falls back to, which is easily taken for a measurement."""
    root = scene.root_prim.GetPath() if scene.root_prim else Sdf.Path()
    inside = [item for item in scene.objects if item.GetPath().HasPrefix(root)]
    for look in sorted(_own_looks(scene)):
        for item in inside:
            targets = _bound_in(scene, root, look, item)
            if not targets:
                yield Fault(item, f"the look {look} binds no material to this object.")
            for target in targets:
                if target.IsPrimPath() and not UsdShade.Material(scene.stage.GetPrimAtPath(target)):
                    yield Fault(item, f"the look {look} binds <{target}>, which is not a material.")


@cure("select shaded, or lit")
def select_known(site: Site) -> bool:
    looks = site.GetVariantSet(VARIANT_SET)
    for name in (SHADED, LIT):
        if name in looks.GetVariantNames():
            return bool(looks.SetVariantSelection(name))
    return False


@rule(Severity.ERROR, advice="Select one of the looks that the variant set has.", cure=select_known)
def look_selection(scene: AssetStage) -> Iterator[Fault]:
    """The look that is selected on the default prim exists. USD takes any name and says nothing;
    the objects then have no materials at all."""
    if _own_looks(scene) and scene.root_prim:
        looks = scene.root_prim.GetVariantSet(VARIANT_SET)
        if looks.GetVariantSelection() not in looks.GetVariantNames():
            yield Fault(
                scene.root_prim,
                f"the selected look is {looks.GetVariantSelection()!r}, which is none: "
                "no object has a material.",
            )


def _own_looks(scene: AssetStage) -> set[str]:
    """Names of the looks that layers of ours have; the artist's may show some objects only."""
    names: set[str] = set()
    if scene.root_prim:
        for layer in scene.own_layers:
            spec = layer.GetPrimAtPath(scene.root_prim.GetPath())
            looks = spec.variantSets.get(VARIANT_SET) if spec else None
            names.update(looks.variants.keys() if looks else ())
    return names


def _bound_in(scene: AssetStage, root: Sdf.Path, look: str, item: Usd.Prim) -> list[Sdf.Path]:
    """Targets of the strongest opinion about an object's binding inside a look."""
    variant = root.AppendVariantSelection(VARIANT_SET, look)
    path = item.GetPath().ReplacePrefix(root, variant).AppendProperty(BINDING)
    for layer in scene.layers:
        binding = layer.GetRelationshipAtPath(path)
        if binding and _is_binding(binding):
            return [
                target.ReplacePrefix(variant, root)
                for target in binding.targetPathList.GetAddedOrExplicitItems()
            ]
    return []


def _is_binding(binding: Sdf.RelationshipSpec) -> bool:
    """Whether it says what is bound, not only how strong a weaker opinion is."""
    name = f"{binding.name}:".startswith(f"{BINDING}:")
    return name and bool(binding.targetPathList.GetAddedOrExplicitItems())


RULES = (binding_beside_looks, look_incomplete, look_selection)
