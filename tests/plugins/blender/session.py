"""One session of Blender with the add-on installed; prints what was seen as one line of JSON.

    BLENDER_PYTHON session.py SCENARIO ARGUMENTS    (with BLENDER_USER_RESOURCES set)

Runs in an interpreter that has the module ``bpy``, in a process of its own: bpy brings another
build of USD. The add-on lies where Blender installs extensions, and is enabled as one.
"""

import importlib
import json
import math
import sys
import time
from types import SimpleNamespace

import bpy

MODULE = "bl_ext.user_default.usdbrdf_blender"


class Layout:
    """A layout that writes down what is drawn: ``seen`` has (kind, text, alert)."""

    def __init__(self, seen):
        self.seen, self.alert = seen, False

    def _below(self, **_options):
        return Layout(self.seen)

    split = column = row = box = _below

    def label(self, text):
        self.seen.append(("label", text, self.alert))

    def operator(self, name, text=""):
        self.seen.append(("operator", text or name, self.alert))
        return SimpleNamespace()

    def menu(self, name, text=""):
        self.seen.append(("menu", text, self.alert))

    def prop(self, _owner, name):
        self.seen.append(("prop", name, self.alert))


def drawn(panel):
    """What a panel of the add-on shows now, or None where its poll says no."""
    kind = getattr(bpy.types, panel)
    if hasattr(kind, "poll") and not kind.poll(bpy.context):
        return None
    seen = []
    kind.draw(SimpleNamespace(layout=Layout(seen)), bpy.context)
    return seen


def enable():
    bpy.ops.preferences.addon_enable(module=MODULE)


def addon(name):
    return importlib.import_module(f"{MODULE}.{name}")


def empty_scene():
    for item in list(bpy.data.objects):
        bpy.data.objects.remove(item)
    bpy.data.orphans_purge(do_recursive=True)


def plain(value):
    return value.to_list() if hasattr(value, "to_list") else value


def properties():
    return {o.name: {k: plain(v) for k, v in o.items()} for o in bpy.data.objects}


def surface(item):
    """The material of an object: where its colours come from."""
    material = item.material_slots[0].material
    nodes = material.node_tree.nodes
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    image = next((node.image for node in nodes if node.type == "TEX_IMAGE"), None)
    factor = next((node.inputs[1].default_value for node in nodes if node.type == "VECT_MATH"), [1])
    return {
        "prim": material.get("usdbrdf_prim"),
        "emission_strength": shader.inputs["Emission Strength"].default_value,
        "emission_color": list(shader.inputs["Emission Color"].default_value)[:3],
        "emission_linked": shader.inputs["Emission Color"].is_linked,
        "base_color": list(shader.inputs["Base Color"].default_value)[:3],
        "ior": shader.inputs["IOR"].default_value,
        "image": image and bpy.path.basename(image.filepath),
        "colorspace": image and image.colorspace_settings.name,
        "factor": factor[0],
    }


def surfaces():
    # Without the add-on the component has the name, and the mesh the same with a number.
    return {o.name.split(".")[0]: surface(o) for o in bpy.data.objects if o.type == "MESH"}


def select(name):
    for other in bpy.context.selected_objects:
        other.select_set(False)
    item = bpy.data.objects[name]
    bpy.context.view_layer.objects.active = item
    item.select_set(True)


def refusal(operator, **options):
    """The sentence with which an operator refuses."""
    try:
        operator(**options)
    except RuntimeError as error:
        return str(error).strip()
    return None


def without_addon(file):
    empty_scene()
    bpy.ops.wm.usd_import(filepath=file)
    return {"properties": properties(), "surfaces": surfaces()}


def plain_import(file):
    """Blender's own File > Import, with the add-on enabled."""
    enable()
    empty_scene()
    bpy.ops.wm.usd_import(filepath=file)
    return {"properties": properties(), "surfaces": surfaces()}


def suns(file, scale):
    """Strength of each sun, its angle in degrees and whether that is irradiance, after Blender's
    own import, with the add-on enabled."""
    enable()
    empty_scene()
    bpy.ops.wm.usd_import(filepath=file, light_intensity_scale=float(scale))
    items = sorted(bpy.data.objects, key=lambda item: item.name)
    lights = [item.data for item in items if item.type == "LIGHT"]
    return [
        (
            light.energy * 2 ** getattr(light, "exposure", 0),
            math.degrees(light.angle),
            getattr(light, "normalize", True),
        )
        for light in lights
    ]


def package(file):
    """A package: by the add-on's operator, and by Blender's own."""
    told = {"plain": plain_import(file)["properties"]}
    empty_scene()
    bpy.ops.usdbrdf.import_asset(filepath=file)
    told["objects"] = {o.name: o.type for o in bpy.data.objects}
    told["properties"] = properties()
    select("Stuhl_No_1")
    told["fit"], told["look"] = drawn("USDBRDF_PT_fit"), drawn("USDBRDF_PT_look")
    told["no_look"] = refusal(bpy.ops.usdbrdf.import_asset, filepath=file, look="lit")
    return told


def looks(file):
    enable()
    empty_scene()
    bpy.ops.usdbrdf.import_asset(filepath=file)
    told = {"shaded": surfaces(), "objects": {o.name: o.type for o in bpy.data.objects}}
    select("Stuhl_No_1")
    for look in ("lit", "samples", "lit"):
        bpy.ops.usdbrdf.switch_look(look=look)
        told[look] = surfaces()
    told["materials"] = len(bpy.data.materials)
    bpy.ops.usdbrdf.switch_look(look="shaded")
    told["back"] = surfaces()
    told["materials_after"] = len(bpy.data.materials)
    told["objects_after"] = {o.name: o.type for o in bpy.data.objects}
    told["active"] = bpy.context.object.name
    told["selected"] = [o.name for o in bpy.context.selected_objects]
    told["unknown"] = refusal(bpy.ops.usdbrdf.switch_look, look="painted")
    empty_scene()
    bpy.ops.usdbrdf.import_asset(filepath=file, look="lit")
    told["imported_lit"] = surfaces()
    told["no_asset"] = refusal(bpy.ops.usdbrdf.import_asset, filepath=file + ".txt")
    told["no_look"] = refusal(bpy.ops.usdbrdf.import_asset, filepath=file, look="painted")
    return told


def slots(file, look):
    """Name of each object -> its materials' prims, and the slot of each face."""
    enable()
    empty_scene()
    bpy.ops.usdbrdf.import_asset(filepath=file, look=look)
    return {
        o.name: [
            [material.get("usdbrdf_prim") for material in o.data.materials],
            [face.material_index for face in o.data.polygons],
        ]
        for o in bpy.data.objects
        if o.type == "MESH"
    }


def render(file, look, picture):
    """The middle pixel of the capture camera's view with Cycles, in the light of a strong sun."""
    enable()
    empty_scene()
    bpy.ops.usdbrdf.import_asset(filepath=file, look=look)
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy = 10
    scene = bpy.context.scene
    scene.collection.objects.link(sun)
    scene.camera = bpy.data.objects["capture"]
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    scene.render.resolution_x, scene.render.resolution_y = 24, 18
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = picture
    bpy.ops.render.render(write_still=True)
    pixels = bpy.data.images.load(picture).pixels[:]
    middle = 4 * (9 * 24 + 12)
    return list(pixels[middle : middle + 3])


def panels(file):
    enable()
    empty_scene()
    told = {"nothing": [drawn("USDBRDF_PT_fit"), drawn("USDBRDF_PT_look")]}
    bpy.ops.usdbrdf.import_asset(filepath=file)
    for name in ("Stuhl_No_1", "wall", "lamp"):
        select(name)
        told[name] = drawn("USDBRDF_PT_fit")
    told["look"] = drawn("USDBRDF_PT_look")
    told["looks"] = drawn("USDBRDF_MT_looks")
    told["convert"] = drawn("USDBRDF_PT_convert")
    bpy.ops.preferences.addon_disable(module=MODULE)
    told["after"] = hasattr(bpy.types, "USDBRDF_PT_fit")
    return told


def convert(program, scan, output, texel_size, *, then_cancel=""):
    """Start the conversion and let the timer look after it, as Blender's event loop would."""
    enable()
    empty_scene()
    bpy.context.preferences.addons[MODULE].preferences.executable = program
    settings = bpy.context.window_manager.usdbrdf_convert
    settings.scan, settings.output, settings.texel_size = scan, output, float(texel_size)
    background = addon("convert_operators")
    refused = refusal(bpy.ops.usdbrdf.convert)
    if refused:
        return {"refused": refused, "panel": drawn("USDBRDF_PT_convert")}
    told = {"timer": bpy.app.timers.is_registered(background.look_after_job)}
    told["busy"] = [bpy.ops.usdbrdf.convert.poll(), bpy.ops.usdbrdf.cancel.poll()]
    told["meanwhile"] = drawn("USDBRDF_PT_convert")
    while background.look_after_job() is not None:
        job = background.current_job()
        if then_cancel and job.line.startswith(then_cancel):
            bpy.ops.usdbrdf.cancel()
            then_cancel = ""
        time.sleep(0.02)
    job = background.current_job()
    told.update(state=job.state, line=job.line, asset=job.asset)
    told["panel"] = drawn("USDBRDF_PT_convert")
    told["idle"] = [bpy.ops.usdbrdf.convert.poll(), bpy.ops.usdbrdf.cancel.poll()]
    told["properties"] = properties()
    return told


def cancel(program, scan, output, texel_size):
    return convert(program, scan, output, texel_size, then_cancel="texture: ")


if __name__ == "__main__":
    print("\nREPORT", json.dumps(globals()[sys.argv[1]](*sys.argv[2:])))
