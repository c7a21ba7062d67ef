"""An asset read with Blender's own USD: its looks, what each object wears, and its facts."""

import bpy

bpy.utils.expose_bundled_modules()

from pxr import Gf, Sdf, Tf, Usd, UsdShade  # noqa: E402

LOOK = "look"
PREFIX = "usdBrdf:"


class AssetUnreadable(Exception):
    """The file is gone, or is no USD; the message is one sentence for the user."""


def open_stage(file):
    """The composed stage of a root layer; AssetUnreadable if it cannot be opened."""
    try:
        return Usd.Stage.Open(file)
    except Tf.ErrorException as error:
        raise AssetUnreadable(
            f"{file}: not a USD file that can be opened. Check the path."
        ) from error


def look_prim(prim):
    """The prim itself or the nearest one above it that has looks; None where there is none."""
    while prim and not prim.IsPseudoRoot():
        if prim.GetVariantSets().HasVariantSet(LOOK):
            return prim
        prim = prim.GetParent()
    return None


def looks_of_file(file):
    """Names of the looks of a file's default prim; none if there are none or it cannot be read."""
    try:
        stage = open_stage(file)
    except AssetUnreadable:
        return ()
    prim = stage.GetDefaultPrim()
    return tuple(prim.GetVariantSet(LOOK).GetVariantNames()) if prim else ()


def has_facts(file):
    """Whether anything of ours was authored in a file; not if it cannot be read."""
    try:
        stage = open_stage(file)
    except AssetUnreadable:
        return False
    return any(facts_of(prim) for prim in stage.Traverse())


def materials_in_look(file, root, look):
    """Mesh path -> what it wears while the prim ``root`` shows ``look``: (material path, faces),
    first the mesh's own material with no faces, then those of its GeomSubsets."""
    stage = open_stage(file)
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        stage.GetPrimAtPath(root).GetVariantSet(LOOK).SetVariantSelection(look)
    found = {}
    for prim in Usd.PrimRange(stage.GetPrimAtPath(root)):
        if prim.GetTypeName() == "Mesh":
            found[str(prim.GetPath())] = _worn(prim)
    return found


def write_selection(path, file, root, look):
    """A layer over ``file`` in which the prim ``root`` shows ``look``."""
    layer = Sdf.Layer.CreateNew(path)
    layer.subLayerPaths.append(file)
    Sdf.CreatePrimInLayer(layer, root).variantSelections[LOOK] = look
    layer.Save()


def _worn(mesh):
    subsets = UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets()
    worn = []
    for prim, faces in [(mesh, ()), *((s.GetPrim(), s.GetIndicesAttr().Get()) for s in subsets)]:
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        if material:
            worn.append((str(material.GetPath()), list(faces or ())))
    return worn


def facts_of(prim):
    """Attribute name -> value of what was authored of ours, as values that Blender can store."""
    return {
        attribute.GetName(): _storable(attribute.Get())
        for attribute in prim.GetAuthoredAttributes()
        if attribute.GetName().startswith(PREFIX) and attribute.HasAuthoredValue()
    }


def _storable(value):
    if isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Sdf.AssetPath):
        return value.resolvedPath or value.path
    if isinstance(value, Gf.Vec2i):
        return [int(component) for component in value]
    return [float(component) for component in value]
