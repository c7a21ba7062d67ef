"""What Blender's USD importer leaves behind: our attributes, and which prim became what.

The importer keeps only attributes that are marked custom; those of a schema are not.
"""

import math

import bpy

from . import usd_asset

# On objects and materials: the layer and the prim that they came from. On objects besides, where
# there are looks: the prim that has them, their names, and the one that is shown.
FILE, PRIM = "usdbrdf_file", "usdbrdf_prim"
ROOT, LOOKS, SHOWN = "usdbrdf_root", "usdbrdf_looks", "usdbrdf_look"
# Times as strong as USD says are the importer's suns, of whatever kind.
_TOO_STRONG = 4.0


class UsdBrdfImport(bpy.types.USDHook):
    """Runs at the end of every USD import, ours or File > Import."""

    bl_idname = "usdbrdf_import"
    bl_label = "usdbrdf"

    @staticmethod
    def on_import(context):
        stage = context.get_stage()
        file = stage.GetRootLayer().realPath
        dimmed = set()
        for path, imported in context.get_prim_map().items():
            prim = stage.GetPrimAtPath(path)
            # A package of ours has facts, and no looks to choose from.
            root, facts = usd_asset.look_prim(prim), usd_asset.facts_of(prim)
            if prim.GetTypeName() == "Mesh":
                # People pick the mesh; what is known of it stands at its component.
                facts = {**usd_asset.facts_of(prim.GetParent()), **facts}
            if root is None and not facts:
                continue
            for item in imported:
                if isinstance(item, bpy.types.Object | bpy.types.Material):
                    item[FILE], item[PRIM] = file, str(path)
                if isinstance(item, bpy.types.Object):
                    _shine_as_told(item, prim, dimmed)
                    for name, value in facts.items():
                        item[name] = value
                    if root is not None:
                        _keep_looks(item, root)
                    _name_as_object(item, prim)
        return True


def _shine_as_told(item, prim, dimmed):
    """A sun: Blender's importer makes it four times as strong as USD and the user's
    light_intensity_scale say, and twice as wide. ``dimmed`` has those that were put right."""
    if item.type != "LIGHT" or item.data.type != "SUN" or prim.GetTypeName() != "DistantLight":
        return
    if item.data.name not in dimmed:
        dimmed.add(item.data.name)
        item.data.energy /= _TOO_STRONG
        item.data.angle = math.radians(prim.GetAttribute("inputs:angle").Get())


def _name_as_object(item, prim):
    """A mesh has its component's name, which Blender allows but once: the mesh is to have it."""
    name, above = prim.GetName(), item.parent
    if item.type != "MESH" or not above or above.type != "EMPTY":
        return
    if prim.GetParent().GetName() == name:
        above.name = f"{name}_component"
        item.name = name


def _keep_looks(item, root):
    looks = root.GetVariantSet(usd_asset.LOOK)
    item[ROOT], item[SHOWN] = str(root.GetPath()), looks.GetVariantSelection()
    item[LOOKS] = list(looks.GetVariantNames())


CLASSES = (UsdBrdfImport,)
