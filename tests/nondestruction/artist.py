"""Everything that an artist does in edits.usda, once each, and how it reads in the stage."""

from __future__ import annotations

from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade

from usdbrdf.asset.layout import Asset
from usdbrdf.files.images import write_exr

MINE = "/room/mtl/mine"
# Of an edited stage, by what was done: the value as it composes.
EXPECTED: dict[str, Any] = {
    "roughness": 0.125,
    "ior": 2.0,
    "constant colour": (0.5, 0.25, 0.125),
    "binding beside the looks, shaded": MINE,
    "binding beside the looks, albedo": MINE,
    "binding in a look, shaded": MINE,
    "binding in a look, albedo": "/room/geo/ceiling/looks/albedo",
    "moved": (0.5, 0.25, 1.0),
    "deactivated": False,
    "hidden": "invisible",
    "texture": "mine/west.exr",
    "display name": "Parkett",
    "added mesh": 3,
    "added light": 8.0,
    "look": "albedo",
    "lights": "usdlux",
    "layer of one's own": "keep",
}


def edit(asset: Asset) -> None:
    """Author all of it, and a shot beside it that references the asset."""
    (asset.folder / "mine").mkdir()
    write_exr(asset.folder / "mine" / "west.exr", np.full((4, 4, 3), 0.25, np.float32))
    _own_layer(asset)
    stage = Usd.Stage.Open(str(asset.root_layer))
    edits = Sdf.Layer.FindOrOpen(str(asset.edits_layer))
    edits.subLayerPaths.append("./mine/more.usda")
    stage.SetEditTarget(edits)
    mine = UsdShade.Material.Define(stage, MINE)
    shader = UsdShade.Shader.Define(stage, f"{MINE}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    mine.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", _TOKEN))

    box = surface_of(stage, "box")
    box.GetInput("roughness").Set(0.125)
    box.GetInput("ior").Set(2.0)
    colour = surface_of(stage, "floor").GetInput("diffuseColor")
    colour.DisconnectSource()
    colour.Set(Gf.Vec3f(0.5, 0.25, 0.125))
    UsdShade.MaterialBindingAPI.Apply(prim_of(stage, "walls")).Bind(mine)
    look = stage.GetDefaultPrim().GetVariantSet("look")
    look.SetVariantSelection("shaded")
    with look.GetVariantEditContext(edits):
        UsdShade.MaterialBindingAPI.Apply(prim_of(stage, "ceiling")).Bind(mine)
    UsdGeom.Xformable(prim_of(stage, "box")).AddTranslateOp().Set(Gf.Vec3d(0.5, 0.25, 1.0))
    prim_of(stage, "north").SetActive(False)
    UsdGeom.Imageable(prim_of(stage, "lamp")).MakeInvisible()
    texture = UsdShade.Shader.Get(stage, "/room/geo/west/mtl/west/BaseColorTexture")
    texture.GetInput("file").Set(Sdf.AssetPath("./mine/west.exr"))
    prim_of(stage, "floor").SetDisplayName("Parkett")
    plant = UsdGeom.Mesh.Define(stage, "/room/geo/plant/plant")
    plant.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    plant.CreateFaceVertexCountsAttr([3])
    plant.CreateFaceVertexIndicesAttr([0, 1, 2])
    UsdLux.SphereLight.Define(stage, "/room/key").CreateIntensityAttr(8.0)
    look.SetVariantSelection("albedo")
    stage.GetDefaultPrim().GetVariantSet("lights").SetVariantSelection("usdlux")
    edits.Save()
    _shot(asset)


def read(stage: Usd.Stage) -> dict[str, Any]:
    """What EXPECTED is about, of any stage of the asset."""
    looks: dict[str, dict[str, str]] = {}
    root = stage.GetDefaultPrim()
    selected = {name: root.GetVariantSet(name).GetVariantSelection() for name in ("look", "lights")}
    stage.SetEditTarget(stage.GetSessionLayer())
    for look in ("albedo", "shaded"):
        root.GetVariantSet("look").SetVariantSelection(look)
        looks[look] = {name: bound(stage, name) for name in ("walls", "ceiling")}
    attributes = UsdShade.Utils.GetValueProducingAttributes(
        surface_of(stage, "floor").GetInput("diffuseColor")
    )
    texture = (
        UsdShade.Shader.Get(stage, "/room/geo/west/mtl/west/BaseColorTexture")
        .GetInput("file")
        .Get()
    )
    plant, key = prim_of(stage, "plant"), stage.GetPrimAtPath("/room/key")
    note = prim_of(stage, "ceiling").GetAttribute("userProperties:note")
    place = UsdGeom.Xformable(prim_of(stage, "box")).GetLocalTransformation()
    return {
        "roughness": surface_of(stage, "box").GetInput("roughness").Get(),
        "ior": surface_of(stage, "box").GetInput("ior").Get(),
        "constant colour": attributes[0].Get(),
        "binding beside the looks, shaded": looks["shaded"]["walls"],
        "binding beside the looks, albedo": looks["albedo"]["walls"],
        "binding in a look, shaded": looks["shaded"]["ceiling"],
        "binding in a look, albedo": looks["albedo"]["ceiling"],
        "moved": tuple(place.ExtractTranslation()),
        "deactivated": prim_of(stage, "north").IsActive(),
        "hidden": UsdGeom.Imageable(prim_of(stage, "lamp")).ComputeVisibility(),
        "texture": "/".join(texture.resolvedPath.split("/")[-2:]),
        "display name": prim_of(stage, "floor").GetDisplayName(),
        "added mesh": len(plant.GetAttribute("points").Get()) if plant else 0,
        "added light": key.GetAttribute("inputs:intensity").Get() if key else 0.0,
        "look": selected["look"],
        "lights": selected["lights"],
        "layer of one's own": note.Get() if note else "",
    }


def in_shot(asset: Asset) -> tuple[Any, ...]:
    """What a shot says about the asset that it references, as it composes there."""
    stage = Usd.Stage.Open(str(asset.folder / "mine" / "shot.usda"))
    assert not stage.GetCompositionErrors()
    shader = UsdShade.Shader.Get(stage, "/shot/set/geo/box/mtl/box/PreviewSurface")
    box = stage.GetPrimAtPath("/shot/set/geo/box/box")
    renamed = stage.GetPrimAtPath("/shot/set/geo/east_wall")
    return (
        shader.GetInput("roughness").Get(),
        box.GetAttribute("visibility").Get(),
        stage.GetPrimAtPath("/shot/set").GetVariantSet("look").GetVariantSelection(),
        bool(stage.GetPrimAtPath("/shot/set/geo/east")),
        renamed.GetTypeName(),
        UsdShade.MaterialBindingAPI(renamed.GetChild("east")).ComputeBoundMaterial()[0].GetPath(),
    )


IN_SHOT = (0.75, "invisible", "lit", False, "Xform", "/shot/set/geo/east_wall/looks/lit")


def prim_of(stage: Usd.Stage, name: str) -> Usd.Prim:
    return stage.GetPrimAtPath(f"/room/geo/{name}/{name}")


def surface_of(stage: Usd.Stage, name: str) -> UsdShade.Shader:
    return UsdShade.Shader.Get(stage, f"/room/geo/{name}/mtl/{name}/PreviewSurface")


def bound(stage: Usd.Stage, name: str) -> str:
    material, _ = UsdShade.MaterialBindingAPI(prim_of(stage, name)).ComputeBoundMaterial()
    return str(material.GetPath()) if material else ""


_TOKEN = Sdf.ValueTypeNames.Token


def _own_layer(asset: Asset) -> None:
    layer = Sdf.Layer.CreateNew(str(asset.folder / "mine" / "more.usda"))
    prim = Sdf.CreatePrimInLayer(layer, "/room/geo/ceiling/ceiling")
    note = Sdf.AttributeSpec(prim, "userProperties:note", Sdf.ValueTypeNames.String)
    note.default = "keep"
    layer.Save()


def _shot(asset: Asset) -> None:
    stage = Usd.Stage.CreateNew(str(asset.folder / "mine" / "shot.usda"))
    shown = stage.DefinePrim("/shot/set", "Xform")
    shown.GetReferences().AddReference(f"../{asset.root_layer.name}")
    shown.GetVariantSet("look").SetVariantSelection("lit")
    UsdShade.Shader.Get(stage, "/shot/set/geo/box/mtl/box/PreviewSurface").GetInput(
        "roughness"
    ).Set(0.75)
    UsdGeom.Imageable(stage.GetPrimAtPath("/shot/set/geo/box/box")).MakeInvisible()
    # Within one stack of layers nothing can be renamed; what is referenced can.
    stage.GetRootLayer().relocates = [("/shot/set/geo/east", "/shot/set/geo/east_wall")]
    stage.Save()
