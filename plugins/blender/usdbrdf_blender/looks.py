"""Showing another look of what was imported: the same objects with other materials."""

import bpy

from . import usd_asset
from .import_hook import FILE, PRIM, ROOT, SHOWN


def show_look(file, root, look):
    """Give all objects of an asset the materials of a look.

    Materials are imported when they are first needed, and used again afterwards. Raises
    AssetUnreadable if the asset is gone.
    """
    wanted = usd_asset.materials_in_look(file, root, look)
    missing = set(wanted.values()) - _materials_of(file).keys()
    if missing:
        _import_materials(file, missing)
    materials = _materials_of(file)
    for item in objects_of(file, root):
        item[SHOWN] = look
        material = materials.get(wanted.get(item[PRIM]))
        if item.type == "MESH" and material is not None:
            _wear(item.data, material)


def objects_of(file, root):
    """All objects that came from the prim ``root`` of a file."""
    return [o for o in bpy.data.objects if o.get(FILE) == file and o.get(ROOT) == root]


def _materials_of(file):
    return {m[PRIM]: m for m in bpy.data.materials if m.get(FILE) == file}


def _wear(mesh, material):
    if not mesh.materials:
        mesh.materials.append(material)
    for i in range(len(mesh.materials)):
        mesh.materials[i] = material


def _import_materials(file, paths):
    """Materials alone; the importer also makes empties for the prims above, which go again."""
    before, active = set(bpy.data.objects), bpy.context.view_layer.objects.active
    selected = list(bpy.context.selected_objects)
    bpy.ops.wm.usd_import(
        filepath=file,
        prim_path_mask=",".join(sorted(paths)),
        import_all_materials=True,
        import_meshes=False,
        import_cameras=False,
        import_lights=False,
        create_world_material=False,
        set_frame_range=False,
    )
    for item in set(bpy.data.objects) - before:
        bpy.data.objects.remove(item)
    for item in selected:
        item.select_set(True)
    bpy.context.view_layer.objects.active = active
