"""Import a USD file into Blender and print what its materials became, as JSON.

    BLENDER_PYTHON blender_report.py ASSET.usda

Runs in an interpreter that has the module ``bpy``, in a process of its own: bpy brings another
build of USD. One line of the output is the JSON.
"""

import json
import sys

import bpy


def node_before(socket, kind):
    """The first node of a kind upstream of a socket, or None."""
    waiting = [link.from_node for link in socket.links]
    while waiting:
        node = waiting.pop()
        if node.type == kind:
            return node
        waiting += [link.from_node for entry in node.inputs for link in entry.links]
    return None


def image_of(socket):
    node = node_before(socket, "TEX_IMAGE")
    if node is None or node.image is None:
        return None
    image = node.image
    return {
        "file": bpy.path.basename(image.filepath),
        "size": list(image.size),
        "colorspace": image.colorspace_settings.name,
        "extension": node.extension,
        "uv": getattr(node_before(node.inputs["Vector"], "UVMAP"), "uv_map", None),
        "pixel": list(image.pixels[:4]),
        "factor": factor_of(socket),
    }


def factor_of(socket):
    """What the texture is multiplied by; 1 without a node that does."""
    node = node_before(socket, "VECT_MATH")
    return list(node.inputs[1].default_value) if node else [1.0] * 3


def report_material(material):
    surface = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    return {
        "material": material.name,
        "roughness": surface.inputs["Roughness"].default_value,
        "ior": surface.inputs["IOR"].default_value,
        "metallic": surface.inputs["Metallic"].default_value,
        "tint": list(surface.inputs["Specular Tint"].default_value),
        "base_color": list(surface.inputs["Base Color"].default_value),
        "base_image": image_of(surface.inputs["Base Color"]),
        "emission_strength": surface.inputs["Emission Strength"].default_value,
        "emission_image": image_of(surface.inputs["Emission Color"]),
    }


def report(path):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=path, import_textures_mode="IMPORT_NONE")
    # The component has the name, and the mesh in it the same with a number.
    meshes = {o.name.split(".")[0]: o for o in bpy.data.objects if o.type == "MESH"}
    camera = next(o for o in bpy.data.objects if o.type == "CAMERA")
    return {
        "meshes": {
            name: {
                "slots": [report_material(slot.material) for slot in mesh.material_slots],
                "uv_layers": [layer.name for layer in mesh.data.uv_layers],
                "polygons": len(mesh.data.polygons),
            }
            for name, mesh in meshes.items()
        },
        "camera": {"lens": camera.data.lens, "sensor_width": camera.data.sensor_width},
        "frames": [bpy.context.scene.frame_start, bpy.context.scene.frame_end],
    }


if __name__ == "__main__":
    print(json.dumps(report(sys.argv[1])))
