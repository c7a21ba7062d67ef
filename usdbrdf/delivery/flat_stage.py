"""The composed asset in one look -> one layer that needs no other.

What is kept: geometry, the materials bound in that look with their UsdPreviewSurface networks,
lights, cameras, and the numbers measured. What goes: the other looks, the maps behind them, render
settings, the photographs, and every path of this machine.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade

from usdbrdf.asset.header import Scopes
from usdbrdf.asset.layers.looks import SHADED, VARIANT_SET
from usdbrdf.asset.layers.task_layers import EMISSIVE, LIGHTS
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_edited, open_weaker
from usdbrdf.asset.readers.surfaces import paths_of
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.job.stamp import code_version

_PURPOSES = (UsdShade.Tokens.allPurpose, UsdShade.Tokens.full, UsdShade.Tokens.preview)
# Properties and schemas that name files of the capture or of other looks.
_LEFT_OUT = ("usdBrdf:aov:", "usdBrdf:capture:image", "backPlate:")
_MAPPING = "usdBrdf:fit:mapping"
_LEFT_OUT_SCHEMAS = ("UsdBrdfAovAPI:", "BackPlateAPI:")


def stage_in_look(asset: Asset, look: str | None = None) -> Usd.Stage:
    """The asset as everybody opens it, edits included, with a look selected; nothing is written.

    look  None: the one that it opens in, or ``shaded`` where that is no look of the asset

    Raises UsageError for a look that it has not, and InputRefused for layers that lie elsewhere
    than in the asset's folder, but for the captured geometry that the scan layer refers to.
    """
    stage = open_edited(asset)
    _refuse_foreign_layers(stage, asset)
    looks = stage.GetDefaultPrim().GetVariantSet(VARIANT_SET)
    names = looks.GetVariantNames()
    if not names:
        raise InputRefused(
            f"{asset.folder}: the asset has no look yet. Run usdbrdf convert, which measures its "
            "textures and materials, first. [package.look]"
        )
    if look is not None and look not in names:
        raise UsageError(f"--look {look}: the asset has {', '.join(names)}. [package.look]")
    chosen = (look, looks.GetVariantSelection(), SHADED, *names)
    stage.SetEditTarget(stage.GetSessionLayer())
    looks.SetVariantSelection(next(name for name in chosen if name in names))
    return stage


def look_of(stage: Usd.Stage) -> str:
    """The look that is selected in a stage of ``stage_in_look``."""
    return str(stage.GetDefaultPrim().GetVariantSet(VARIANT_SET).GetVariantSelection())


def flattened(stage: Usd.Stage, asset: Asset, *, with_lights: bool = True) -> Usd.Stage:
    """All that the stage composes to, as a new stage of one anonymous layer; its asset paths are
    absolute and have still to be replaced.

    with_lights  False where the package can hold none: then lamps glow by their material, also
                 where the artist selected lights in their place
    """
    _spread_instances(stage)
    if not with_lights:
        _let_lamps_glow(stage)
    layer = stage.Flatten(addSourceFileComment=False)
    flat = Usd.Stage.Open(layer)
    root = flat.GetDefaultPrim()
    layer.documentation = ""
    layer.customLayerData = {
        "usdbrdf": {"role": "package", "version": code_version(), "look": look_of(stage)}
    }
    if layer.pseudoRoot.HasInfo("renderSettingsPrimPath"):
        layer.pseudoRoot.ClearInfo("renderSettingsPrimPath")
    flat.RemovePrim(Scopes.of(asset).path("render"))
    info = dict(root.GetAssetInfo())
    info.pop("identifier", None)  # of the asset in its folder
    root.SetMetadata("assetInfo", info)
    _keep_bound_materials(flat)
    for prim in flat.TraverseAll():
        _leave_out(prim)
    return flat


def take_materials_literally(flat: Usd.Stage) -> None:
    """Make our own reader return what renderers are told instead of the lobe that is meant by it:
    the package is for renderers."""
    for prim in flat.TraverseAll():
        if prim.HasAttribute(_MAPPING):
            prim.RemoveProperty(_MAPPING)


def lights_of(flat: Usd.Stage) -> list[Usd.Prim]:
    """All UsdLux lights."""
    return [prim for prim in flat.TraverseAll() if prim.HasAPI(UsdLux.LightAPI)]


def fit_for_arkit(flat: Usd.Stage, warn: Callable[[str], None]) -> None:
    """Y up, and only what AR Quick Look takes: no cameras, no lights."""
    root = flat.GetDefaultPrim()
    lights = lights_of(flat)
    if lights:
        warn(f"the ARKit profile holds no lights; left out: {paths_of(lights)}.")
    cameras = [prim for prim in flat.TraverseAll() if prim.IsA(UsdGeom.Camera)]
    for path in sorted((prim.GetPath() for prim in [*cameras, *lights]), reverse=True):
        flat.RemovePrim(path)
    _remove_empty_scopes(flat)
    if UsdGeom.GetStageUpAxis(flat) != UsdGeom.Tokens.y:
        UsdGeom.SetStageUpAxis(flat, UsdGeom.Tokens.y)
        _turn(root)


def _turn(root: Usd.Prim) -> None:
    """The default prim by -90 degrees about x, before all that it does itself: z up to y up."""
    xform = UsdGeom.Xformable(root)
    if not xform:
        raise InputRefused(
            f"<{root.GetPath()}>: the default prim is no Xform, so the scene cannot be turned to y "
            "up. Wrap it in one. [package.up_axis]"
        )
    order, reset = xform.GetOrderedXformOps(), xform.GetResetXformStack()
    turn = xform.AddTransformOp(opSuffix="yUp")
    turn.Set(Gf.Matrix4d(1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1))
    xform.SetXformOpOrder([turn, *order], reset)


def _refuse_foreign_layers(stage: Usd.Stage, asset: Asset) -> None:
    captured = open_weaker(asset, "texturing")  # its layers are valid only as long as it is held
    known = {os.path.realpath(layer.realPath) for layer in captured.GetUsedLayers()}
    folder = Path(os.path.realpath(asset.folder))
    for layer in stage.GetUsedLayers():
        if layer.anonymous:
            continue
        place = os.path.realpath(layer.realPath)
        if place not in known and not Path(place).is_relative_to(folder):
            raise InputRefused(
                f"{asset.folder}: the layer {place} lies outside of the asset. Copy it into the "
                "folder, or take it out of edits.usda. [package.outside]"
            )


def _spread_instances(stage: Usd.Stage) -> None:
    """Every instance becomes prims of its own, in the session layer: flattened, prototypes would
    lie beside the default prim, and what is bound to an instance would be seen by nobody."""
    while instances := [prim for prim in stage.TraverseAll() if prim.IsInstance()]:
        for prim in instances:
            prim.SetInstanceable(False)


def _let_lamps_glow(stage: Usd.Stage) -> None:
    """Select the variant without lights wherever there is the choice, in the session layer."""
    paths = [
        prim.GetPath()
        for prim in stage.TraverseAll()
        if EMISSIVE in prim.GetVariantSet(LIGHTS).GetVariantNames()
    ]
    for path in paths:
        if prim := stage.GetPrimAtPath(path):  # the choice above it may have taken it away
            prim.GetVariantSet(LIGHTS).SetVariantSelection(EMISSIVE)


def _keep_bound_materials(flat: Usd.Stage) -> None:
    """Delete materials that nothing is bound to, and nodes that no UsdPreviewSurface needs."""
    bound = set()
    for prim in flat.TraverseAll():
        if prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.Subset):
            for purpose in _PURPOSES:
                material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)
                if material:
                    bound.add(material.GetPath())
    for prim in list(flat.TraverseAll()):
        if prim and prim.IsA(UsdShade.Material):
            if prim.GetPath() in bound:
                _keep_surface(flat, UsdShade.Material(prim))
            else:
                flat.RemovePrim(prim.GetPath())
    _remove_empty_scopes(flat)


def _keep_surface(flat: Usd.Stage, material: UsdShade.Material) -> None:
    for output in material.GetOutputs():
        if output.GetBaseName() != "surface" or output.GetFullName() != "outputs:surface":
            material.GetPrim().RemoveProperty(output.GetFullName())
    needed: set[Sdf.Path] = set()
    surface = material.ComputeSurfaceSource()[0]
    waiting = [surface.GetPrim()] if surface else []
    while waiting:
        prim = waiting.pop()
        needed.update(prim.GetPath().GetPrefixes())
        for wanted in UsdShade.ConnectableAPI(prim).GetInputs():
            for source in wanted.GetValueProducingAttributes():
                if source.GetPrim().GetPath() not in needed:
                    waiting.append(source.GetPrim())
    for prim in list(Usd.PrimRange(material.GetPrim(), Usd.PrimAllPrimsPredicate)):
        if prim and prim.GetPath() not in needed and prim != material.GetPrim():
            flat.RemovePrim(prim.GetPath())


def _leave_out(prim: Usd.Prim) -> None:
    for name in [*prim.GetAuthoredPropertyNames()]:
        if name.startswith(_LEFT_OUT):
            prim.RemoveProperty(name)
    schemas = prim.GetMetadata("apiSchemas")
    if schemas is not None:
        # A flattened layer has one explicit list.
        kept = [name for name in _items(schemas) if not name.startswith(_LEFT_OUT_SCHEMAS)]
        prim.SetMetadata("apiSchemas", Sdf.TokenListOp.Create(prependedItems=kept))


def _items(schemas: Any) -> list[str]:
    return [*schemas.explicitItems, *schemas.prependedItems, *schemas.appendedItems]


def _remove_empty_scopes(flat: Usd.Stage) -> None:
    root = flat.GetDefaultPrim()
    paths = [p.GetPath() for p in flat.TraverseAll() if p.GetTypeName() == "Scope" and p != root]
    for path in sorted(paths, reverse=True):  # children before their parents
        if not flat.GetPrimAtPath(path).GetAllChildren():
            flat.RemovePrim(path)
