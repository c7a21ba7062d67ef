"""The operator and the menu that switch the look of the active object's asset."""

from typing import ClassVar

import bpy

from .import_hook import FILE, LOOKS, ROOT
from .looks import show_look
from .usd_asset import AssetUnreadable


class USDBRDF_OT_switch_look(bpy.types.Operator):
    """Show another look of this asset: its materials, or one of its maps unlit"""

    bl_idname = "usdbrdf.switch_look"
    bl_label = "Switch Look"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    look: bpy.props.StringProperty(name="Look")

    @classmethod
    def poll(cls, context):
        return context.object is not None and ROOT in context.object

    def execute(self, context):
        item = context.object
        if self.look not in item[LOOKS]:
            names = ", ".join(item[LOOKS])
            self.report(
                {"ERROR"}, f"{self.look!r} is not a look of this asset. Use one of {names}."
            )
            return {"CANCELLED"}
        try:
            show_look(item[FILE], item[ROOT], self.look)
        except AssetUnreadable as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class USDBRDF_MT_looks(bpy.types.Menu):
    bl_idname = "USDBRDF_MT_looks"
    bl_label = "Look"

    def draw(self, context):
        for look in context.object[LOOKS]:
            self.layout.operator(USDBRDF_OT_switch_look.bl_idname, text=look).look = look


CLASSES = (USDBRDF_OT_switch_look, USDBRDF_MT_looks)
