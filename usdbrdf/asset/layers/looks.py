"""The variant set ``look``: the same objects lit, as measured maps, or with their materials.

Bindings live inside the variants and nowhere else. A binding beside them would be a local opinion,
and local opinions beat variants: every look would show the same material.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from pxr import Sdf

from usdbrdf.asset.header import Draft, Scopes
from usdbrdf.asset.layers.author import apply_schema, define, over, relationship
from usdbrdf.asset.layers.input_usd import BINDING, recorded_bindings
from usdbrdf.asset.layers.preview_surface import Colour, unlit_colour, unlit_texture
from usdbrdf.asset.properties import Aov, FittedObject, ShadedObject, TexturedObject

VARIANT_SET = "look"

SHADED, LIT = "shaded", "lit"

# What has no value in a look is shown in a colour that no measurement has: unknown is not black.
NO_DATA = "no_data"

NO_DATA_COLOUR = (0.5, 0.0, 0.5)

# A look: the material's path per object's prim path.
Bindings = Mapping[str, str]

# What a look shows of an object: a map, one linear colour, or nothing because nothing is known.
Shown = Aov | Colour | None


def author_looks(
    layer: Sdf.Layer, draft: Draft, looks: Mapping[str, Bindings], *, selected: str
) -> None:
    """Add variants to the default prim and select one; weaker layers' variants remain.

    What an input file binds otherwise than by the mesh is bound in every look too.
    """
    root, competing = Sdf.Path(draft.scopes.root), recorded_bindings(draft.asset)
    over(layer, draft.scopes.root)
    for look, bindings in looks.items():
        variant = root.AppendVariantSelection(VARIANT_SET, look)
        over(layer, str(variant))
        for prim_path, material in bindings.items():
            also = competing.get(prim_path, {})
            for binding, collection in {f"{prim_path}.{BINDING}": "", **also}.items():
                path = Sdf.Path(binding).ReplacePrefix(root, variant)
                prim = over(layer, str(path.GetParentPath()))
                apply_schema(prim, "MaterialBindingAPI")
                targets = [collection, material] if collection else [material]
                relationship(prim, path.name, *targets)
    layer.GetPrimAtPath(root).variantSelections[VARIANT_SET] = selected


def author_look_materials(
    layer: Sdf.Layer, scopes: Scopes, look: str, values: Iterable[tuple[str, str, Shown]]
) -> dict[str, str]:
    """Unlit materials for one look, one per object; ``values`` are (prim path, identifier, what).

    Returns the bindings. Objects without a value share one material that says so.
    """
    define(layer, scopes.path("looks"), "Scope")
    define(layer, scopes.path("looks", look), "Scope")
    bindings = {}
    for prim_path, identifier, shown in values:
        material = scopes.path("looks", look, identifier)
        if isinstance(shown, Aov):
            unlit_texture(layer, material, shown.file, shown.scale)
        elif shown is not None:
            unlit_colour(layer, material, shown)
        else:
            material = _no_data(layer, scopes)
        bindings[prim_path] = material
    return bindings


def aov_looks(
    layer: Sdf.Layer,
    scopes: Scopes,
    objects: Sequence[TexturedObject] | Sequence[ShadedObject] | Sequence[FittedObject],
    *,
    hidden: frozenset[str] = frozenset(),
) -> dict[str, dict[str, str]]:
    """One look per map that any object has, with a binding for every object."""
    names = {aov.name: None for item in objects for aov in item.aovs if aov.name not in hidden}
    looks = {}
    for name in names:
        maps = [
            (item.prim_path, item.identifier, {a.name: a for a in item.aovs}.get(name))
            for item in objects
        ]
        looks[name] = author_look_materials(layer, scopes, name, maps)
    return looks


def _no_data(layer: Sdf.Layer, scopes: Scopes) -> str:
    """Path of the material for objects without a value, defined in this layer."""
    path = scopes.path("looks", NO_DATA)
    if not layer.GetPrimAtPath(path):
        unlit_colour(layer, path, NO_DATA_COLOUR)
    return path
