"""The operator that imports an asset with a look."""

from typing import ClassVar

import bpy
from bpy_extras.io_utils import ImportHelper

from . import usd_asset
from .import_hook import FILE, ROOT
from .looks import objects_of, show_look


class USDBRDF_OT_import(bpy.types.Operator, ImportHelper):
    """Import an asset made by usdbrdf: objects, materials, and the capture camera"""

    bl_idname = "usdbrdf.import_asset"
    bl_label = "Import usdbrdf Asset"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    filename_ext = ".usda"
    filter_glob: bpy.props.StringProperty(default="*.usda;*.usd;*.usdc;*.usdz", options={"HIDDEN"})
    look: bpy.props.StringProperty(
        name="Look",
        description="What is shown of the objects; empty: the look that the asset selects",
        search=lambda self, _context, _text: usd_asset.looks_of_file(self.filepath),
    )

    def execute(self, _context):
        looks = usd_asset.looks_of_file(self.filepath)
        if not looks:
            self.report({"ERROR"}, f"{self.filepath}: not an asset of usdbrdf. Choose NAME.usda.")
            return {"CANCELLED"}
        if self.look and self.look not in looks:
            self.report({"ERROR"}, f"{self.look!r} is not a look. Use one of {', '.join(looks)}.")
            return {"CANCELLED"}
        import_asset(self.filepath, self.look)
        return {"FINISHED"}


def import_asset(file, look=""):
    """Import a root layer; ``look`` is one of its looks, or empty for the one that it selects."""
    before = set(bpy.data.objects)
    bpy.ops.wm.usd_import(filepath=file)
    mine = [item for item in bpy.data.objects if item not in before and ROOT in item]
    if not mine:
        return
    layer, root = mine[0][FILE], mine[0][ROOT]
    _remove_empty_scopes([item for item in objects_of(layer, root) if item not in before])
    if look:
        show_look(layer, root, look)


def _remove_empty_scopes(items):
    """USD's folders of materials and render settings become empties with nothing below."""
    bare = [item for item in items if item.type == "EMPTY" and not item.children]
    while bare:
        above = {item.parent for item in bare if item.parent in items}
        for item in bare:
            items.remove(item)
            bpy.data.objects.remove(item)
        bare = [item for item in above if not item.children]


def menu_entry(menu, _context):
    menu.layout.operator(USDBRDF_OT_import.bl_idname, text="usdbrdf Asset (.usda)")


CLASSES = (USDBRDF_OT_import,)
