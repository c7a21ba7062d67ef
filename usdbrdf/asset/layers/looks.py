"""The variant set ``look``: the same objects lit, as measured maps, or with their materials.

Bindings live inside the variants and nowhere else. A binding beside them would be a local opinion,
and local opinions beat variants: every look would show the same material.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TypeVar

from pxr import Sdf

from usdbrdf.asset.header import Draft, Scopes
from usdbrdf.asset.layers.author import apply_schema, define, over, relationship
from usdbrdf.asset.layers.input_usd import BINDING, recorded_bindings
from usdbrdf.asset.layers.preview_surface import Colour, unlit_colour, unlit_texture
from usdbrdf.asset.properties import Aov, MeasuredObject

VARIANT_SET = "look"
SHADED, LIT = "shaded", "lit"
# What has no value in a look is shown in a colour that no measurement has: unknown is not black.
NO_DATA = "no_data"
NO_DATA_COLOUR = (0.5, 0.0, 0.5)
# A look: the material's path per object's prim path.
Bindings = Mapping[str, str]
# What a look shows of an object: a map, one linear colour, or nothing because nothing is known.
Shown = Aov | Colour | None
Measured = TypeVar("Measured", bound=MeasuredObject)


def author_looks(
    layer: Sdf.Layer, draft: Draft, looks: Mapping[str, Bindings], *, selected: str
) -> None:
    """Add variants to the default prim and select one; weaker layers' variants remain.

    What an input file binds otherwise than by the mesh is bound in every look too.
    """
    root, competing = Sdf.Path(draft.scopes.root), recorded_bindings(draft.asset)
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
    layer: Sdf.Layer,
    scopes: Scopes,
    look: str,
    objects: Sequence[Measured],
    shown_of: Callable[[Measured], Shown],
) -> dict[str, str]:
    """Unlit materials for one look, one per object, and how they are bound.

    Objects of which there is nothing to show share one material that says so.
    """
    define(layer, scopes.path("looks"), "Scope")
    define(layer, scopes.path("looks", look), "Scope")
    bindings = {}
    for item in objects:
        material, shown = scopes.path("looks", look, item.identifier), shown_of(item)
        if isinstance(shown, Aov):
            unlit_texture(layer, material, shown.file, shown.scale)
        elif shown is not None:
            unlit_colour(layer, material, shown)
        else:
            material = scopes.path("looks", NO_DATA)
            unlit_colour(layer, material, NO_DATA_COLOUR)
        bindings[item.prim_path] = material
    return bindings


def aov_looks(
    layer: Sdf.Layer,
    scopes: Scopes,
    objects: Sequence[MeasuredObject],
    hidden: frozenset[str] = frozenset(),
) -> dict[str, dict[str, str]]:
    """One look per map that any object has, with a binding for every object."""
    names = {aov.name: None for item in objects for aov in item.aovs if aov.name not in hidden}
    return {
        name: author_look_materials(layer, scopes, name, objects, partial(_map_of, name=name))
        for name in names
    }


def _map_of(item: MeasuredObject, name: str) -> Aov | None:
    return next((aov for aov in item.aovs if aov.name == name), None)
