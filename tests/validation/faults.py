"""One way to break the small asset per rule; each is named after what is wrong then."""

from __future__ import annotations

import contextlib
import shutil

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from usdbrdf.delivery.publish import publish
from usdbrdf.files.images import write_exr
from usdbrdf.job.stamp import stamp_of, stamp_path, write_stamp

Types = Sdf.ValueTypeNames
CHAIR, WALL, LAMP = (f"/room/geo/{name}/{name}" for name in ("Stuhl_No_1", "wall", "lamp"))
CAMERA = "/room/cameras/capture"
COLOUR_TEXTURE = "/room/geo/Stuhl_No_1/mtl/Stuhl_No_1/BaseColorTexture"
SURFACE = "/room/geo/Stuhl_No_1/mtl/Stuhl_No_1/PreviewSurface"


@contextlib.contextmanager
def edited(path):
    """A layer file, saved at the end."""
    layer = Sdf.Layer.FindOrOpen(str(path))
    layer.Reload(force=True)
    yield layer
    layer.Save()


def opinion(built, prim, name, type_name, value):
    """What an artist says about an attribute, in edits.usda."""
    with edited(built.asset.edits_layer) as layer:
        spec = Sdf.CreatePrimInLayer(layer, prim)
        Sdf.AttributeSpec(spec, name, type_name).default = value


def edits_layer_deleted(built):
    built.asset.edits_layer.unlink()


def edits_below_the_measurement(built):
    with edited(built.asset.root_layer) as layer:
        edits, *weaker = layer.subLayerPaths
        layer.subLayerPaths = [*weaker, edits]


def layer_in_centimetres(built):
    with edited(built.asset.layer("texturing")) as layer:
        layer.pseudoRoot.SetInfo("metersPerUnit", 0.01)


def layer_of_a_newer_schema(built):
    with edited(built.asset.layer("material")) as layer:
        record = layer.customLayerData["usdbrdf"]
        layer.customLayerData = {"usdbrdf": {**record, "schemaVersion": 99}}


def layer_edited_by_hand(built):
    relative = "layers/material.usda"
    stamp = stamp_of("fit", {}, {})
    stamp.outputs[relative] = "0" * 64
    path = stamp_path(built.asset.folder, 4, "fit")
    path.parent.mkdir(parents=True)
    write_stamp(path, stamp)


def texture_by_absolute_path(built):
    file = built.asset.folder / "textures" / "Stuhl_No_1.albedo.exr"
    opinion(built, COLOUR_TEXTURE, "inputs:file", Types.Asset, Sdf.AssetPath(str(file)))


def texture_outside_the_asset(built):
    write_exr(built.asset.folder.parent / "wood.exr", np.zeros((2, 2, 3), np.float32))
    opinion(built, COLOUR_TEXTURE, "inputs:file", Types.Asset, Sdf.AssetPath("../wood.exr"))


def texture_deleted(built):
    (built.asset.folder / "textures" / "lamp.lit.exr").unlink()


def texture_cut_off(built):
    file = built.asset.folder / "textures" / "lamp.lit.exr"
    file.write_bytes(file.read_bytes()[:-20])


def photograph_deleted(built):
    built.scan.frames.image_paths[2].unlink()


def texture_that_no_layer_names(built):
    file = built.asset.folder / "textures" / "table.lit.exr"
    write_exr(file, np.zeros((2, 2, 3), np.float32))


def exposure_of_two(built):
    opinion(built, CAMERA, "exposure", Types.Float, 1.0)


def focal_length_doubled(built):
    opinion(built, CAMERA, "focalLength", Types.Float, 2.0)


def texture_coordinates_in_the_next_tile(built):
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    values = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(CHAIR)).GetPrimvar("st").Get()
    moved = Vt.Vec2fArray([value + Gf.Vec2f(1, 0) for value in values])
    opinion(built, CHAIR, "primvars:st", Types.TexCoord2fArray, moved)


def roughness_above_one(built):
    with edited(built.asset.layer("material")) as layer:
        layer.GetAttributeAtPath(f"{CHAIR}.usdBrdf:fit:phi").default = 1.5


def negative_texels(built):
    opinion(built, CHAIR, "usdBrdf:texturing:texelSize", Types.Float, -0.01)


def measured_without_values(built):
    opinion(built, WALL, "usdBrdf:fit:status", Types.Token, "measured")


def status_that_is_none(built):
    opinion(built, CHAIR, "usdBrdf:fit:status", Types.Token, "guessed")


def misspelt_attribute(built):
    opinion(built, CHAIR, "usdBrdf:fit:fi", Types.Float, 0.5)


def schema_lost(built):
    with edited(built.asset.layer("shading")) as layer:
        prim = layer.GetPrimAtPath(CHAIR)
        kept = [n for n in prim.GetInfo("apiSchemas").prependedItems if n != "UsdBrdfShadingAPI"]
        prim.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=kept))


def two_objects_of_one_identifier(built):
    opinion(built, WALL, "usdBrdf:identifier", Types.Token, "lamp")


def albedo_above_one(built):
    opinion(built, CHAIR, "usdBrdf:shading:meanAlbedo", Types.Color3f, Gf.Vec3f(1.25, 0.5, 0.5))


def texture_read_as_srgb(built):
    opinion(built, COLOUR_TEXTURE, "inputs:sourceColorSpace", Types.Token, "auto")


def specular_color_beside_ior(built):
    opinion(built, SURFACE, "inputs:specularColor", Types.Color3f, Gf.Vec3f(0.04))


def record_edited_instead_of_material(built):
    opinion(built, CHAIR, "usdBrdf:fit:phi", Types.Float, 0.75)


def emitter_that_reflects(built):
    surface = "/room/geo/lamp/mtl/lamp/PreviewSurface"
    opinion(built, surface, "inputs:diffuseColor", Types.Color3f, Gf.Vec3f(0.5))


def look_that_reflects(built):
    opinion(built, "/room/geo/lamp/looks/lit/PreviewSurface", "inputs:ior", Types.Float, 1.5)


def binding_beside_the_looks(built):
    with edited(built.asset.edits_layer) as layer:
        binding = Sdf.RelationshipSpec(
            Sdf.CreatePrimInLayer(layer, CHAIR), "material:binding", custom=False
        )
        binding.targetPathList.explicitItems = [Sdf.Path("/room/geo/wall/mtl/wall")]


def look_without_an_object(built):
    with edited(built.asset.layer("texturing")) as layer:
        prim = layer.GetPrimAtPath("/room{look=coverage}geo/wall/wall")
        prim.RemoveProperty(prim.relationships["material:binding"])


def look_that_is_not_there(built):
    with edited(built.asset.edits_layer) as layer:
        layer.GetPrimAtPath("/room").variantSelections["look"] = "shadde"


def lights_that_are_not_there(built):
    with edited(built.asset.edits_layer) as layer:
        layer.GetPrimAtPath("/room").variantSelections["lights"] = "usdlx"


def lamp_that_glows_beside_its_lights(built):
    with edited(built.asset.edits_layer) as layer:
        layer.GetPrimAtPath("/room").variantSelections["lights"] = "usdlux"
    opinion(
        built,
        "/room/geo/lamp/mtl/lamp/EmissionTexture",
        "inputs:scale",
        Types.Float4,
        Gf.Vec4f(0.5),
    )


def said_in_a_review(built, **said):
    """review.usda as a person may have written it by hand."""
    (built.asset.folder / "review.usda").write_text('#usda 1.0\n(defaultPrim = "room")\n')
    with edited(built.asset.folder / "review.usda") as layer:
        Sdf.CreatePrimInLayer(layer, CHAIR).customData = {"usdbrdf": {"review": said}}


def verdict_of_another_word(built):
    said_in_a_review(built, verdict="perhaps", **seen_of_chair(built))


def chair_that_was_rejected(built):
    said_in_a_review(built, verdict="reject", comment="too\ngreen", **seen_of_chair(built))


def chair_that_was_judged_with_other_numbers(built):
    said_in_a_review(built, verdict="accept", **{**seen_of_chair(built), "phi": 0.99})


def chair_that_is_to_be_a_metal(built):
    said_in_a_review(built, directive="metal", **seen_of_chair(built))


def seen_of_chair(built):
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    prim = stage.GetPrimAtPath(CHAIR)
    names = ("status", "phi", "psi")
    return {name: prim.GetAttribute(f"usdBrdf:fit:{name}").Get() for name in names}


def published_picture_changed(built):
    folder = built.asset.folder
    publish(folder, folder.parent / "versions")
    shutil.rmtree(folder)
    (folder.parent / "versions/v001").rename(folder)
    picture = folder / "previews/lit.png"
    picture.chmod(0o644)
    picture.write_bytes(picture.read_bytes() + b"more")


def mesh_lost(built):
    with edited(built.asset.layer("scan")) as layer:
        spec = layer.GetPrimAtPath(WALL)
        del spec.nameParent.nameChildren[spec.name]


FAULTS = {
    "LayerMissing": edits_layer_deleted,
    "LayerOrder": edits_below_the_measurement,
    "LayerHeader": layer_in_centimetres,
    "SchemaVersion": layer_of_a_newer_schema,
    "LayerEdited": layer_edited_by_hand,
    "AnchoredPath": texture_by_absolute_path,
    "PathOutside": texture_outside_the_asset,
    "MissingTexture": texture_deleted,
    "UnreadableTexture": texture_cut_off,
    "MissingPhotograph": photograph_deleted,
    "OrphanTexture": texture_that_no_layer_names,
    "PublishedFile": published_picture_changed,
    "CameraExposure": exposure_of_two,
    "CameraLens": focal_length_doubled,
    "TextureCoordinates": texture_coordinates_in_the_next_tile,
    "ObjectMesh": mesh_lost,
    "FitRange": roughness_above_one,
    "RecordRange": negative_texels,
    "FitStatus": measured_without_values,
    "AllowedTokens": status_that_is_none,
    "UndeclaredAttribute": misspelt_attribute,
    "SchemaNotApplied": schema_lost,
    "ObjectIdentifier": two_objects_of_one_identifier,
    "AlbedoRange": albedo_above_one,
    "TextureColorSpace": texture_read_as_srgb,
    "SpecularColor": specular_color_beside_ior,
    "LobeMatchesFit": record_edited_instead_of_material,
    "EmitterAlbedo": emitter_that_reflects,
    "LookMaterial": look_that_reflects,
    "BindingBesideLooks": binding_beside_the_looks,
    "LookIncomplete": look_without_an_object,
    "LookSelection": look_that_is_not_there,
    "LightsSelection": lights_that_are_not_there,
    "LampTwice": lamp_that_glows_beside_its_lights,
    "ReviewRecord": verdict_of_another_word,
    "ReviewDirectives": chair_that_is_to_be_a_metal,
    "ReviewRejected": chair_that_was_rejected,
    "ReviewOutdated": chair_that_was_judged_with_other_numbers,
}
