"""Where the program is that converts scans."""

import bpy


class UsdBrdfPreferences(bpy.types.AddonPreferences):
    bl_idname = __package__

    executable: bpy.props.StringProperty(
        name="usdbrdf",
        description="The program usdbrdf, of whatever Python it is installed in",
        subtype="FILE_PATH",
        default="usdbrdf",
    )

    def draw(self, _context):
        self.layout.prop(self, "executable")
        self.layout.label(text="For instance .venv/bin/usdbrdf. Importing assets needs no program.")


def executable():
    """The program's path, or its name to be looked up in PATH."""
    chosen = bpy.context.preferences.addons[__package__].preferences.executable
    return bpy.path.abspath(chosen) if "/" in chosen or "\\" in chosen else chosen


CLASSES = (UsdBrdfPreferences,)
