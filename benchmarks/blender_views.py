"""Render a USD layer with Cycles from given cameras: runs in an interpreter with the module `bpy`.

    BLENDER_PYTHON blender_views.py JOB.json

JOB.json: `layer`, a USD file in metres with z up; `views`, each with `world_from_camera` (4 x 4,
OpenGL axes), `intrinsics` (fx, fy, cx, cy in pixels) and `resolution`; `samples` per pixel;
`denoise`, whether to do that; `bounces`, after the first surface; `out`, a folder that gets one
linear EXR per view. No clamping. Light comes from what the file holds, and from surroundings of the
uniform radiance `surroundings`. With `sun`, a direction towards it (x, y, z) and its irradiance,
that stands for all lights of the file: Blender scales an imported DistantLight in its own way.
"""

import json
import sys
from pathlib import Path

import bpy
from mathutils import Matrix, Vector


def set_up(samples, denoise=False):
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = denoise
    scene.cycles.sample_clamp_indirect = 0
    scene.cycles.blur_glossy = 0
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.filter_width = 1
    scene.cycles.seed = 0
    scene.render.film_transparent = False
    settings = scene.render.image_settings
    settings.file_format, settings.color_depth = "OPEN_EXR", "32"
    # Files hold the scene's linear radiance, whatever the view transform.
    settings.color_mode = "RGB"
    scene.render.resolution_percentage = 100
    return scene


def aim_at_lamps():
    """Rays are sent to the fronts of lamps only: sampling the insides as well costs noise."""
    for material in bpy.data.materials:
        nodes = material.node_tree.nodes if material.node_tree else ()
        surface = next((n for n in nodes if n.type == "BSDF_PRINCIPLED"), None)
        if surface is not None and surface.inputs["Emission Color"].is_linked:
            material.cycles.emission_sampling = "FRONT"


def surround(scene, radiance):
    scene.world = bpy.data.worlds.new("surroundings")
    background = next(n for n in scene.world.node_tree.nodes if n.type == "BACKGROUND")
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    background.inputs["Strength"].default_value = radiance


def replace_lights(scene, sun):
    for light in [item for item in scene.objects if item.type == "LIGHT"]:
        bpy.data.objects.remove(light)
    data = bpy.data.lights.new("sun", "SUN")
    data.energy, data.angle = sun[3], 0.01
    light = bpy.data.objects.new("sun", data)
    light.rotation_mode = "QUATERNION"
    light.rotation_quaternion = Vector(sun[:3]).to_track_quat("Z", "Y")
    scene.collection.objects.link(light)


def add_camera(scene, view):
    fx, _, cx, cy = view["intrinsics"]
    width, height = view["resolution"]
    data = bpy.data.cameras.new("view")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36
    data.lens = fx * 36 / width
    data.shift_x, data.shift_y = (width / 2 - cx) / width, (cy - height / 2) / width
    data.clip_start, data.clip_end = 0.01, 10_000
    camera = bpy.data.objects.new("view", data)
    camera.matrix_world = Matrix(view["world_from_camera"])
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = width, height


def main(job):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=job["layer"], import_textures_mode="IMPORT_NONE")
    aim_at_lamps()
    scene = set_up(job["samples"], job["denoise"])
    surround(scene, job["surroundings"])
    bounces = job.get("bounces", 16)
    for kind in ("max", "diffuse", "glossy"):
        # By default diffuse light ends after four bounces: in a bright room that costs 4 %.
        setattr(scene.cycles, f"{kind}_bounces", bounces)
    if "sun" in job:
        replace_lights(scene, job["sun"])
    for number, view in enumerate(job["views"]):
        add_camera(scene, view)
        scene.render.filepath = str(Path(job["out"]) / f"view_{number:02d}.exr")
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text()))
