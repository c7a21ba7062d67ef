"""The asset as glTF, read back by three readers: the JSON itself, trimesh, and Blender."""

from __future__ import annotations

import json
import struct
import sys
from dataclasses import replace

import numpy as np
import pytest
from pxr import Sdf, Usd

from tests.blender import in_blender, needs_blender
from usdbrdf.asset.readers.surfaces import surfaces_from_stage
from usdbrdf.delivery.glb import gltf_material, write_glb
from usdbrdf.delivery.package import package, stage_in_look
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.model.material import Surface, constant_map, preview_material
from usdbrdf.options import PackageOptions
from usdbrdf.relighting.relit_scene import surfaces_from_model

pytest.importorskip("PIL", reason="Pillow is not installed")

OPEN_IN_BLENDER = """
import json, sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
found = {}
for o in bpy.data.objects:
    if o.type == "MESH":
        nodes = o.material_slots[0].material.node_tree.nodes
        s = next(n for n in nodes if n.type == "BSDF_PRINCIPLED").inputs
        names = ("Roughness", "IOR", "Metallic", "Emission Strength")
        found[o.name] = {n: s[n].default_value for n in names}
        found[o.name]["textures"] = sorted(i.name for i in s if i.links)
        found[o.name]["low"] = [min((o.matrix_world @ v.co)[k] for v in o.data.vertices)
                                for k in range(3)]
print("FOUND" + json.dumps(found))
"""


def document(output):
    """The JSON chunk of a binary glTF."""
    content = output.read_bytes()
    magic, version, length, chunk = struct.unpack("<4sIII", content[:16])
    assert (magic, version, length) == (b"glTF", 2, len(content))
    return json.loads(content[20 : 20 + chunk])


@pytest.fixture
def exported(room, tmp_path):
    output = tmp_path / "room.glb"
    package(room.asset.folder, output)
    return output


def test_materials_in_the_document(exported):
    tree = document(exported)
    materials = {m["name"]: m for m in tree["materials"]}
    chair, lamp = materials["Stuhl_No_1"], materials["lamp"]
    pbr = chair["pbrMetallicRoughness"]
    assert pbr["roughnessFactor"] == pytest.approx(0.5)
    assert pbr["metallicFactor"] == 0
    assert pbr["baseColorFactor"] == [1, 1, 1, 1]
    assert chair["extensions"]["KHR_materials_ior"]["ior"] == pytest.approx(1.5)
    assert "KHR_materials_emissive_strength" not in chair["extensions"]
    assert lamp["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"] == 8
    assert lamp["emissiveFactor"] == [1, 1, 1]
    assert "emissiveTexture" in lamp
    assert tree["extensionsUsed"] == ["KHR_materials_emissive_strength", "KHR_materials_ior"]
    sampler = tree["samplers"][tree["textures"][pbr["baseColorTexture"]["index"]]["sampler"]]
    assert (sampler["wrapS"], sampler["wrapT"]) == (33071, 33071)


def test_lamps_glow_where_the_artist_selected_lights(room, exported, tmp_path):
    edits = Sdf.Layer.FindOrOpen(str(room.asset.edits_layer))
    Sdf.CreatePrimInLayer(edits, "/room").variantSelections["lights"] = "usdlux"
    edits.Save()
    package(room.asset.folder, tmp_path / "lights.glb")
    assert document(tmp_path / "lights.glb") == document(exported)


def test_without_pillow(room, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(EnvironmentFailure, match=r"usdbrdf\[package\].*package\.pillow"):
        package(room.asset.folder, tmp_path / "new/room.glb")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("mapping", ["measured", "matched"])
def test_a_material_is_what_other_renderers_are_told(room, tmp_path, mapping):
    room.fitted = tuple(replace(item, mapping=mapping) for item in room.fitted)
    room.write_layer("material")
    package(room.asset.folder, tmp_path / "room.glb")
    materials = {m["name"]: m for m in document(tmp_path / "room.glb")["materials"]}
    stage = stage_in_look(room.asset, "shaded")
    told = stage.GetPrimAtPath("/room/geo/Stuhl_No_1/mtl/Stuhl_No_1/PreviewSurface").GetAttribute(
        "inputs:ior"
    )
    found = materials["Stuhl_No_1"]["extensions"]["KHR_materials_ior"]["ior"]
    assert found == pytest.approx(told.Get(), rel=1e-4)
    assert (abs(found - 1.5) < 1e-4) == (mapping == "measured")


def test_trimesh_reads_the_same_surfaces(room, exported):
    stage = stage_in_look(room.asset, "shaded")
    here = {
        s.name.rsplit("/", 1)[1]: s
        for s in surfaces_from_stage(stage, Usd.TimeCode.EarliestTime(), pytest.fail)
    }
    there = {s.name.split(":")[1]: s for s in surfaces_from_model(exported)}
    assert there.keys() == here.keys()
    for name, surface in here.items():
        x, y, z = surface.points[surface.triangles].reshape(-1, 3).T
        found = there[name].points[there[name].triangles].reshape(-1, 3)
        assert found == pytest.approx(np.column_stack([x, z, -y]), abs=1e-6)
        assert there[name].corner_uv == pytest.approx(surface.corner_uv, abs=1e-6)
    chair = there["Stuhl_No_1"].material
    assert chair.diffuse == pytest.approx(here["Stuhl_No_1"].material.diffuse, abs=5e-3)
    assert chair.roughness.max() == pytest.approx(0.5)
    # Its strength is 8, and a texture has 8 bits.
    expected = here["lamp"].material.emission
    assert there["lamp"].material.emission == pytest.approx(expected, abs=8 * 5e-3)


def test_equal_assets_give_equal_bytes(room, exported, tmp_path):
    package(room.asset.folder, tmp_path / "again.glb")
    assert (tmp_path / "again.glb").read_bytes() == exported.read_bytes()


def test_textures_are_reduced(room, tmp_path):
    package(room.asset.folder, tmp_path / "small.glb", PackageOptions(max_size=4))
    (chair,) = (s for s in surfaces_from_model(tmp_path / "small.glb") if "Stuhl" in s.name)
    assert chair.material.diffuse.shape == (4, 3, 3)


def surface(**inputs):
    maps = {
        "diffuse": constant_map(0.5, 0.25, 0.125),
        "metallic": constant_map(0.0)[..., :1],
        "roughness": constant_map(0.3)[..., :1],
        "emission": constant_map(0.0),
        **inputs,
    }
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    return Surface(
        name="/a/plate",
        points=points,
        triangles=np.array([[0, 1, 2]], np.int32),
        corner_normals=np.tile(np.float32([0, 0, 1]), (1, 3, 1)),
        material=preview_material(**maps),
    )


def test_glass_is_there_and_lets_all_light_pass(tmp_path):
    green = np.full((2, 2, 3), (0.1, 0.5, 0.2), np.float32)
    pane = surface(diffuse=green, ior=1.4)
    pane = replace(pane, material=replace(pane.material, clear=True))
    write_glb(tmp_path / "pane.glb", [pane, surface()], None, pytest.fail)
    tree = document(tmp_path / "pane.glb")
    clear, opaque = tree["materials"]
    assert clear["extensions"]["KHR_materials_transmission"] == {"transmissionFactor": 1}
    assert clear["extensions"]["KHR_materials_ior"]["ior"] == pytest.approx(1.4, rel=1e-4)
    assert clear["pbrMetallicRoughness"]["baseColorFactor"][:3] == [1, 1, 1]
    # Viewers without transmission show a faint pane; alpha 0 would be no surface at all.
    assert 0.1 < clear["pbrMetallicRoughness"]["baseColorFactor"][3] < 0.5
    assert clear["alphaMode"] == "BLEND"
    assert "baseColorTexture" not in clear["pbrMetallicRoughness"]
    assert "KHR_materials_transmission" in tree["extensionsUsed"]
    assert opaque["extensions"].keys() == {"KHR_materials_ior"}
    assert "alphaMode" not in opaque
    assert [s.material.clear for s in surfaces_from_model(tmp_path / "pane.glb")] == [True, False]


@pytest.mark.parametrize("ior", [1.0, 1.33, 1.789])
def test_index_of_refraction(ior):
    found = gltf_material(surface(ior=ior), None, pytest.fail)
    assert found.numbers["extensions"]["KHR_materials_ior"]["ior"] == pytest.approx(ior, rel=1e-4)


def test_constants_are_exact_factors(tmp_path):
    # Materials that differ in what trimesh does not see stay apart.
    surfaces = [surface(ior=1.2, emission=constant_map(20.0, 10.0, 5.0)), surface(ior=1.6)]
    write_glb(tmp_path / "two.glb", surfaces, None, pytest.fail)
    first, second = document(tmp_path / "two.glb")["materials"]
    assert first["pbrMetallicRoughness"]["baseColorFactor"] == [0.5, 0.25, 0.125, 1]
    assert first["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"] == 20
    assert first["emissiveFactor"] == pytest.approx([1, 0.5, 0.25])
    assert second["extensions"]["KHR_materials_ior"]["ior"] == pytest.approx(1.6, rel=1e-4)


def test_a_colour_beyond_one_is_cut_off_there_and_nowhere_else():
    colours = np.full((2, 2, 3), 0.5, np.float32)
    colours[0, 0] = 1.25
    found = gltf_material(surface(diffuse=colours), None, pytest.fail)
    assert found.numbers["pbrMetallicRoughness"]["baseColorFactor"] == [1, 1, 1, 1]
    picture = found.pictures["baseColorTexture"]
    assert (picture[0, 0] == 255).all()
    assert picture[1, 1] == pytest.approx([188] * 3, abs=1)  # sRGB of 0.5


def test_roughness_and_metal_share_a_picture():
    rough = np.linspace(0, 1, 16, dtype=np.float32).reshape(4, 4, 1)
    found = gltf_material(surface(roughness=rough, metallic=1 - rough), None, pytest.fail)
    picture = found.pictures["metallicRoughnessTexture"]
    assert picture[..., 1] / 255 == pytest.approx(rough[..., 0], abs=3e-3)
    assert picture[..., 2] / 255 == pytest.approx(1 - rough[..., 0], abs=3e-3)
    assert found.numbers["pbrMetallicRoughness"]["metallicFactor"] == 1


def test_a_specular_colour_is_told(capsys):
    told = []
    material = surface(specular=np.float32([[[0.04, 0.08, 0.3]]]))
    gltf_material(material, None, told.append)
    assert "index of refraction" in told[0]


@needs_blender
def test_blender_reads_it(exported, tmp_path):
    said = in_blender("-c", OPEN_IN_BLENDER, exported, folder=tmp_path)
    line = next(x for x in said.splitlines() if x.startswith("FOUND"))
    found = json.loads(line[5:])
    assert set(found) == {"Stuhl_No_1", "wall", "lamp"}
    chair, lamp = found["Stuhl_No_1"], found["lamp"]
    assert (chair["Roughness"], chair["IOR"]) == pytest.approx((0.5, 1.5))
    assert chair["textures"] == ["Base Color"]
    assert lamp["textures"] == ["Emission Color"]
    assert lamp["Emission Strength"] == 8
    assert chair["low"] == pytest.approx([-0.5, -0.5, 0], abs=1e-5)  # z up again
