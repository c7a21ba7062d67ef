"""The operator that imports an asset with a look."""

from typing import ClassVar

import bpy
from bpy_extras.io_utils import ImportHelper

from . import usd_asset
from .import_hook import FILE, ROOT
from .looks import show_look


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
        if not looks and not usd_asset.has_facts(self.filepath):
            self.report(
                {"ERROR"},
                f"{self.filepath}: not an asset of usdbrdf. Choose NAME.usda, or a package of it.",
            )
            return {"CANCELLED"}
        if self.look and not looks:
            self.report(
                {"ERROR"}, f"{self.filepath}: a package shows one look alone. Leave Look empty."
            )
            return {"CANCELLED"}
        if self.look and self.look not in looks:
            self.report({"ERROR"}, f"{self.look!r} is not a look. Use one of {', '.join(looks)}.")
            return {"CANCELLED"}
        import_asset(self.filepath, self.look)
        return {"FINISHED"}


def import_asset(file, look=""):
    """Import a root layer or a package; ``look`` is one of the root layer's looks, or empty for
    the one that is selected."""
    before = set(bpy.data.objects)
    bpy.ops.wm.usd_import(filepath=file)
    new = [item for item in bpy.data.objects if item not in before]
    shown = next(((item[FILE], item[ROOT]) for item in new if ROOT in item), None)
    _remove_empty_scopes(new)
    if look and shown:
        show_look(*shown, look)


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
    menu.layout.operator(USDBRDF_OT_import.bl_idname, text="usdbrdf Asset (.usda, .usdz)")


CLASSES = (USDBRDF_OT_import,)
