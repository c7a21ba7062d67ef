"""Showing another look of what was imported: the same objects with other materials."""

import tempfile
from pathlib import Path

import bpy

from . import usd_asset
from .import_hook import FILE, PRIM, ROOT, SHOWN


def show_look(file, root, look):
    """Give all objects of an asset the materials of a look.

    Materials are imported when they are first needed, and used again afterwards. Raises
    AssetUnreadable if the asset is gone.
    """
    wanted = usd_asset.materials_in_look(file, root, look)
    missing = {path for worn in wanted.values() for path, _ in worn} - _materials_of(file).keys()
    if missing:
        _import_materials(file, root, look, missing)
    materials = _materials_of(file)
    for item in objects_of(file, root):
        item[SHOWN] = look
        worn = [(materials[p], faces) for p, faces in wanted.get(item[PRIM], ()) if p in materials]
        if item.type == "MESH" and worn:
            _wear(item.data, worn)


def objects_of(file, root):
    """All objects that came from the prim ``root`` of a file."""
    return [o for o in bpy.data.objects if o.get(FILE) == file and o.get(ROOT) == root]


def _materials_of(file):
    return {m[PRIM]: m for m in bpy.data.materials if m.get(FILE) == file}


def _wear(mesh, worn):
    """One slot per material, the mesh's own first; faces that the mesh has lost are passed over."""
    slots = list(dict.fromkeys(material for material, _ in worn))
    indices = [0] * len(mesh.polygons)
    for material, faces in worn:
        for face in faces:
            if face < len(indices):
                indices[face] = slots.index(material)
    mesh.materials.clear()
    for material in slots:
        mesh.materials.append(material)
    mesh.polygons.foreach_set("material_index", indices)
    mesh.update()


def _import_materials(file, root, look, paths):
    """Materials of a look alone, which exists while the look is selected; the importer also makes
    empties for the prims above, which go again."""
    before, active = set(bpy.data.objects), bpy.context.view_layer.objects.active
    selected, known = list(bpy.context.selected_objects), set(bpy.data.materials)
    with tempfile.TemporaryDirectory(dir=bpy.app.tempdir) as folder:
        shown = str(Path(folder, "look.usda").resolve())
        usd_asset.write_selection(shown, file, root, look)
        bpy.ops.wm.usd_import(
            filepath=shown,
            prim_path_mask=",".join(sorted(paths)),
            import_all_materials=True,
            import_meshes=False,
            import_cameras=False,
            import_lights=False,
            create_world_material=False,
            set_frame_range=False,
        )
    for material in set(bpy.data.materials) - known:
        if material.get(FILE) == shown:
            material[FILE] = file
    for item in set(bpy.data.objects) - before:
        bpy.data.objects.remove(item)
    for item in selected:
        item.select_set(True)
    bpy.context.view_layer.objects.active = active
