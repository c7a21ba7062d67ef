"""usdbrdf in Blender: assets with their looks, what was measured of an object, conversion."""

import bpy

from . import convert_operators, import_asset, import_hook, panels, preferences, switch_look

_MODULES = (preferences, import_hook, import_asset, switch_look, convert_operators, panels)
_CLASSES = tuple(entry for module in _MODULES for entry in module.CLASSES)


def register():
    for entry in _CLASSES:
        bpy.utils.register_class(entry)
    bpy.types.WindowManager.usdbrdf_convert = bpy.props.PointerProperty(
        type=convert_operators.ConvertSettings
    )
    bpy.types.TOPBAR_MT_file_import.append(import_asset.menu_entry)


def unregister():
    convert_operators.end_job()
    bpy.types.TOPBAR_MT_file_import.remove(import_asset.menu_entry)
    del bpy.types.WindowManager.usdbrdf_convert
    for entry in reversed(_CLASSES):
        bpy.utils.unregister_class(entry)
