"""Models of all formats come in with their shape, axes and materials."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.visual.material import PBRMaterial

from tests.relighting.conftest import BASE
from tests.relighting.scenes import MATTE, looking, material, photograph, plate
from usdbrdf.asset.readers.render_scene import RenderScene, render_scene_from_file
from usdbrdf.cli import main
from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.images import read_radiance, write_exr
from usdbrdf.model.light import SkyLight
from usdbrdf.model.material import Surface
from usdbrdf.options import Insert, RelightOptions
from usdbrdf.relighting.relit_scene import relit_scene, surfaces_from_model, with_material
from usdbrdf.relighting.render import mitsuba_variant
from usdbrdf.untrusted import bounds


def _box() -> Any:
    return trimesh.creation.box((0.2, 0.4, 0.6))


def _linear(srgb: float) -> float:
    return float(((srgb + 0.055) / 1.055) ** 2.4)


def test_ply_with_vertex_colours(tmp_path: Path) -> None:
    box = _box()
    box.visual.vertex_colors = np.tile(np.array([[255, 128, 64, 255]], np.uint8), (8, 1))
    box.export(tmp_path / "box.ply")
    (found,) = surfaces_from_model(tmp_path / "box.ply")
    assert found.bounds == pytest.approx(np.array([[-0.1, -0.2, -0.3], [0.1, 0.2, 0.3]]))
    assert found.corner_colour is not None
    expected = [1.0, _linear(128 / 255), _linear(64 / 255)]
    assert found.corner_colour.reshape(-1, 3) == pytest.approx(
        np.tile(expected, (len(found.triangles) * 3, 1)), abs=1e-4
    )
    assert found.material.diffuse.ravel() == pytest.approx([1, 1, 1])


def test_obj_with_its_mtl(tmp_path: Path) -> None:
    (tmp_path / "box.mtl").write_text("newmtl red\nKd 0.8 0.2 0.1\n")
    rows = [f"v {x} {y} {z}" for x, y, z in _box().vertices]
    rows += ["usemtl red"] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in _box().faces]
    (tmp_path / "box.obj").write_text("\n".join(["mtllib box.mtl", *rows]) + "\n")
    (found,) = surfaces_from_model(tmp_path / "box.obj")
    assert len(found.triangles) == 12
    assert found.material.diffuse.ravel() == pytest.approx([0.8, 0.2, 0.1], abs=0.003)
    assert not found.material.emits


def test_glb_with_its_pbr_material(tmp_path: Path) -> None:
    box = _box()
    picture = np.zeros((2, 2, 3), np.uint8)
    picture[0] = 255  # the upper row white
    image = pytest.importorskip("PIL.Image", reason="textures of GLB need pillow")
    uv = np.tile([[0.25, 0.75]], (8, 1))  # upper left in the v-up sense
    stuff = PBRMaterial(
        baseColorTexture=image.fromarray(picture),
        baseColorFactor=[0.5, 1.0, 1.0, 1.0],
        metallicFactor=1.0,
        roughnessFactor=0.3,
        emissiveFactor=[0.0, 0.5, 0.0],
    )
    box.visual = trimesh.visual.TextureVisuals(uv=uv, material=stuff)
    box.export(tmp_path / "box.glb")
    (found,) = surfaces_from_model(tmp_path / "box.glb")
    assert found.material.roughness.ravel() == pytest.approx([0.3])
    assert found.material.f0[0, 0] == pytest.approx([0.5, 1, 1], abs=0.01)  # metal: its base colour
    assert not found.material.diffuse.any()
    assert found.material.emission.ravel() == pytest.approx([0, 0.5, 0])
    assert found.corner_uv is not None
    assert found.corner_uv.reshape(-1, 2) == pytest.approx(np.tile([0.25, 0.75], (36, 1)))


def test_a_damaged_model_is_refused_in_a_sentence(tmp_path: Path) -> None:
    for name in ("a.ply", "a.obj", "a.glb", "a.stl"):
        (tmp_path / name).write_text("nonsense")
        with pytest.raises(InputRefused, match=rf"{name}.*\[.*\]$"):
            surfaces_from_model(tmp_path / name)


def test_normals_of_the_file_are_taken_and_others_made(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 3 4\nf 1//1 2//1 3//1\n")
    (given,) = surfaces_from_model(tmp_path / "a.obj")
    assert given.corner_normals == pytest.approx(np.tile([0, 0.6, 0.8], (1, 3, 1)))
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (made,) = surfaces_from_model(tmp_path / "a.obj")
    assert made.corner_normals == pytest.approx(np.tile([0, 0, 1], (1, 3, 1)))


@pytest.mark.fault("S1")
def test_what_a_model_names_stays_beside_it(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    folder.mkdir()
    secret = tmp_path / "red.mtl"
    secret.write_text("newmtl red\nKd 0.8 0.2 0.1\n")
    rows = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n"
    model = folder / "a.obj"
    (folder / "link.mtl").symlink_to(secret)
    for name in ("../red.mtl", str(secret), "link.mtl", "file:///etc/passwd"):
        model.write_text(f"mtllib {name}\n{rows}")
        with pytest.raises(InputRefused, match=r"\[paths\.outside\]$"):
            surfaces_from_model(model)
    # Where a picture was when it was exported says nothing, if it came along.
    (folder / "red.mtl").write_text(secret.read_text())
    model.write_text(f"mtllib C:\\work\\red.mtl\n{rows}")
    (found,) = surfaces_from_model(model)
    assert found.material.diffuse.ravel() == pytest.approx([0.8, 0.2, 0.1], abs=0.003)
    model.write_text(f"mtllib missing.mtl\n{rows}")
    (found,) = surfaces_from_model(model)
    assert len(found.triangles) == 1


def test_models_are_read_within_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _box().export(tmp_path / "box.ply")
    for limits, kind, rule in (
        (bounds.Limits(100, 60, 64 << 30), InputRefused, "mesh.size"),
        (bounds.Limits(1 << 20, 0.01, 64 << 30), EnvironmentFailure, "child.timeout"),
        (
            bounds.Limits(1 << 20, 60, 1 << 20),
            EnvironmentFailure,
            "(environment.memory|child.start)",
        ),
    ):
        monkeypatch.setitem(bounds.LIMITS, "mesh", limits)
        with pytest.raises(kind, match=rf"box\.ply: .*\[{rule}\]$"):
            surfaces_from_model(tmp_path / "box.ply")


def test_usd_of_others_is_read_behind_the_boundary(tmp_path: Path, stage: RenderScene) -> None:
    """Asset paths and units are looked at first; a folder can be allowed."""
    (tmp_path / "lib").mkdir()
    write_exr(tmp_path / "lib" / "glow.exr", np.full((2, 3, 3), 1.5, np.float32))
    (tmp_path / "in").mkdir()
    thing = tmp_path / "in" / "thing.usda"
    thing.write_text(STAGE_OF_MATERIALS.replace("@glow.exr@", "@../lib/glow.exr@"))
    with pytest.raises(InputRefused, match=r"'\.\./lib/glow\.exr' leads out.*\[paths\.outside\]$"):
        _inserted(thing, stage)
    options = RelightOptions(
        lights=thing, inserts=(Insert(model=thing),), allow_outside=(tmp_path / "lib",)
    )
    found = relit_scene(stage, options, 2.0).surfaces[len(stage.surfaces) :]
    assert [surface.material.emits for surface in found].count(True) == 2
    for good, bad in (("= 0.1", "= nan"), ("= 0.1", "= -1"), ('"Y"', '"X"')):
        thing.write_text(STAGE_OF_MATERIALS.replace(good, bad, 1))
        with pytest.raises(InputRefused, match=r"thing\.usda: .*\[stage\.units\]$"):
            _inserted(thing, stage)


def _inserted(model: Path, stage: RenderScene, **how: Any) -> tuple[Surface, ...]:
    insert = Insert(model=model, **how)
    scene = relit_scene(stage, RelightOptions(inserts=(insert,)), 2.0)
    return scene.surfaces[len(stage.surfaces) :]


@pytest.fixture
def stage(tmp_path: Path) -> RenderScene:
    """The small stage, in centimetres with z up: its floor is 1 m wide."""
    file = tmp_path / "base.usda"
    file.write_text(BASE.replace("metersPerUnit = 1", "metersPerUnit = 0.01"))
    return render_scene_from_file(file, pytest.fail)


def test_axes_and_units_of_models(tmp_path: Path, stage: RenderScene) -> None:
    box = _box()
    box.export(tmp_path / "box.glb")
    (glb,) = _inserted(tmp_path / "box.glb", stage)
    assert np.ptp(glb.bounds, axis=0) == pytest.approx([0.2, 0.6, 0.4])  # y up, metres
    box.export(tmp_path / "box.ply")
    (ply,) = _inserted(tmp_path / "box.ply", stage)
    assert np.ptp(ply.bounds, axis=0) == pytest.approx([0.002, 0.004, 0.006])  # as the stage
    (turned,) = _inserted(tmp_path / "box.ply", stage, up="Y", scale=100.0)
    assert np.ptp(turned.bounds, axis=0) == pytest.approx([0.2, 0.6, 0.4])


STAGE_OF_MATERIALS = """#usda 1.0
(
    defaultPrim = "thing"
    metersPerUnit = 0.1
    upAxis = "Y"
)
def Mesh "thing" (prepend apiSchemas = ["MaterialBindingAPI"])
{
    int[] faceVertexCounts = [4, 4]
    int[] faceVertexIndices = [0, 1, 2, 3, 4, 5, 6, 7]
    point3f[] points = [(0, 0, 0), (0, 0, 1), (1, 0, 1), (1, 0, 0),
                        (0, 2, 0), (0, 2, 1), (1, 2, 1), (1, 2, 0)]
    texCoord2f[] primvars:st = [(0, 0), (0, 1), (1, 1), (1, 0)] (interpolation = "faceVarying")
    int[] primvars:st:indices = [0, 1, 2, 3, 0, 1, 2, 3]
    rel material:binding = </mtl/plain>
    def GeomSubset "upper" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [1]
        rel material:binding = </mtl/glow>
    }
}
def Scope "mtl"
{
    def Material "plain"
    {
        token outputs:surface.connect = </mtl/plain/s.outputs:surface>
        color3f inputs:tint = (0.1, 0.3, 0.5)
        def Shader "s"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </mtl/plain.inputs:tint>
            int inputs:useSpecularWorkflow = 1
            color3f inputs:specularColor = (0.04, 0.05, 0.06)
            float inputs:roughness = 0.7
            token outputs:surface
        }
    }
    def Material "glow"
    {
        token outputs:surface.connect = </mtl/glow/s.outputs:surface>
        def Shader "s"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:emissiveColor.connect = </mtl/glow/t.outputs:rgb>
            token outputs:surface
        }
        def Shader "t"
        {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @glow.exr@
            float4 inputs:scale = (2, 2, 2, 1)
            float2 inputs:st.connect = </mtl/glow/r.outputs:result>
            float3 outputs:rgb
        }
        def Shader "r"
        {
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }
    }
}
"""


def test_usd_with_subsets_interfaces_and_maps(tmp_path: Path, stage: RenderScene) -> None:
    write_exr(tmp_path / "glow.exr", np.full((2, 3, 3), 1.5, np.float32))
    (tmp_path / "thing.usda").write_text(STAGE_OF_MATERIALS)
    found = _inserted(tmp_path / "thing.usda", stage)
    glow, plain = sorted(found, key=lambda surface: not surface.material.emits)
    assert plain.material.diffuse.ravel() == pytest.approx([0.1, 0.3, 0.5])
    assert plain.material.f0.ravel() == pytest.approx([0.04, 0.05, 0.06])
    assert plain.material.roughness.ravel() == pytest.approx([0.7])
    assert glow.material.emission == pytest.approx(np.full((2, 3, 3), 3.0))
    assert glow.corner_uv is not None
    # Decimetres with y up: the upper face is 0.2 m above, facing up.
    assert glow.bounds[:, 2] == pytest.approx([0.2, 0.2])
    assert glow.corner_normals[..., 2] == pytest.approx(np.ones((2, 3)))


def test_an_input_of_another_type_is_told_and_left(tmp_path: Path) -> None:
    text = STAGE_OF_MATERIALS.replace(
        "float inputs:roughness = 0.7", "color3f inputs:roughness = (1, 1, 1)"
    )
    text = text.replace("float4 inputs:scale = (2, 2, 2, 1)", "string inputs:scale = 'wide'")
    (tmp_path / "thing.usda").write_text(text)
    write_exr(tmp_path / "glow.exr", np.full((2, 3, 3), 1.5, np.float32))
    said: list[str] = []
    found = render_scene_from_file(tmp_path / "thing.usda", said.append).surfaces
    glow, plain = sorted(found, key=lambda surface: not surface.material.emits)
    assert plain.material.roughness.ravel() == pytest.approx([0.5])
    assert glow.material.emission == pytest.approx(np.full((2, 3, 3), 1.5))
    assert ["inputs:roughness" in s or "inputs:scale" in s for s in said] == [True, True]


@pytest.mark.parametrize("mode", ["repeat", "clamp", "mirror"])
def test_textures_are_wrapped_as_the_stage_says(tmp_path: Path, mode: str) -> None:
    wraps = f'token inputs:wrapS = "{mode}"\ntoken inputs:wrapT = "{mode}"\nasset inputs:file'
    (tmp_path / "thing.usda").write_text(STAGE_OF_MATERIALS.replace("asset inputs:file", wraps))
    write_exr(tmp_path / "glow.exr", np.ones((2, 3, 3), np.float32))
    found = render_scene_from_file(tmp_path / "thing.usda", pytest.fail).surfaces
    assert sorted(surface.material.wrap for surface in found) == sorted([mode, "clamp"])


@pytest.mark.parametrize("wrap", ["repeat", "clamp"])
def test_beyond_its_edge_a_texture_goes_on_as_its_mode_says(wrap: str) -> None:
    image = np.zeros((1, 4, 3), np.float32)
    image[:, :2] = 0.8  # the left half
    stuff = replace(material(), diffuse=image, wrap=wrap, **MATTE)
    floor = plate(stuff)
    assert floor.corner_uv is not None
    # Where the camera looks, u is 1.25: a quarter into the next copy.
    floor = replace(floor, corner_uv=floor.corner_uv + np.array([0.75, 0], np.float32))
    sky = SkyLight(image=np.ones((2, 4, 3), np.float32), world_from_here=np.eye(3))
    eye = looking((0, 0, 2), (0, 0, 0))
    seen = photograph(mitsuba_variant("scalar_rgb"), [floor], eye, lights=[sky]).mean()
    assert seen == pytest.approx(0.8 if wrap == "repeat" else 0.0, abs=0.05)


def test_a_model_that_fell_is_in_the_picture(room: Path, tmp_path: Path) -> None:
    _box().export(tmp_path / "box.ply")
    target = tmp_path / "picture.exr"
    insert = ["--insert", str(tmp_path / "box.ply"), "drop=0,0,1", "color=0,0.5,0", "ior=1"]
    arguments = ["relight", str(room), "-o", str(target), "--camera", "/room/eye"]
    common = ["--width", "9", "--samples", "64", "-q"]
    assert main([*arguments, *common, *insert]) == 0
    middle = read_radiance(target)[4, 4]
    assert middle[0] < 0.05 * middle[1]  # green, where the floor is bluish
    assert middle[2] < 0.05 * middle[1]


def _changed_glb(path: Path, change: Callable[[dict[str, Any]], None], box: Any = None) -> Path:
    """A box as GLB whose document was changed."""
    content = (box or _box()).export(file_type="glb")
    length = int.from_bytes(content[12:16], "little")
    document = json.loads(content[20 : 20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON")
    path.write_bytes(head + text + content[20 + length :])
    return path


def test_a_flattened_node_is_a_flat_surface(tmp_path: Path) -> None:
    flat = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1]
    path = _changed_glb(
        tmp_path / "a.glb", lambda document: document["nodes"][-1].update(matrix=flat)
    )
    (found,) = surfaces_from_model(path)
    assert np.ptp(found.points, axis=0) == pytest.approx([0.2, 0.4, 0.0])


def test_a_texture_that_the_file_does_not_hold_is_left_out(tmp_path: Path) -> None:
    box = _box()
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=PBRMaterial())
    texture = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 7}}}
    _changed_glb(tmp_path / "a.glb", lambda d: d.update(materials=[texture]), box)
    (found,) = surfaces_from_model(tmp_path / "a.glb")
    assert len(found.triangles) == 12


def test_a_part_that_ends_after_the_file_is_refused(tmp_path: Path) -> None:
    """Room would be made for all of it."""
    content = bytearray(_box().export(file_type="glb"))
    length = int.from_bytes(content[12:16], "little")
    content[20 + length : 24 + length] = (2**32 - 4).to_bytes(4, "little")
    (tmp_path / "a.glb").write_bytes(content)
    with pytest.raises(InputRefused, match=r"ends \d+ bytes after the file.*\[mesh\.read\]$"):
        surfaces_from_model(tmp_path / "a.glb")


def _glb_of(path: Path, stuff: dict[str, Any], colours: Any = None, picture: Any = None) -> Surface:
    """What is read of a box of a material as its GLB says it."""
    box = _box()
    box.visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((8, 2)), material=PBRMaterial(name="a", baseColorTexture=picture)
    )

    def change(document: dict[str, Any]) -> None:
        inner = document["materials"][0].get("pbrMetallicRoughness", {})
        kept = {k: inner[k] for k in ("baseColorTexture",) if k in inner}
        inner = kept | stuff.pop("pbrMetallicRoughness", {})
        document["materials"] = [{"pbrMetallicRoughness": inner, **stuff}]
        attributes = document["meshes"][0]["primitives"][0]["attributes"]
        if colours is not None:
            attributes["COLOR_0"] = attributes.pop("_COLOUR")

    if colours is not None:
        box.vertex_attributes["_COLOUR"] = np.tile(np.array(colours, np.float32), (8, 1))
    (found,) = surfaces_from_model(_changed_glb(path, change, box))
    return found


def test_what_a_glb_does_not_say_of_its_material_is_one(tmp_path: Path) -> None:
    said = {"pbrMetallicRoughness": {"baseColorFactor": [1, 0.2, 0, 1]}}
    found = _glb_of(tmp_path / "a.glb", said).material
    assert found.roughness.ravel() == pytest.approx([1])
    assert found.f0.ravel() == pytest.approx([1, 0.2, 0])
    assert not found.diffuse.any()
    (without,) = surfaces_from_model(_changed_glb(tmp_path / "b.glb", lambda document: None))
    assert without.material.f0.ravel() == pytest.approx([1, 1, 1])
    assert without.material.roughness.ravel() == pytest.approx([1])


def test_extensions_of_a_glb_material(tmp_path: Path) -> None:
    said = {
        "pbrMetallicRoughness": {"metallicFactor": 0},
        "emissiveFactor": [1, 0.5, 0],
        "extensions": {
            "KHR_materials_emissive_strength": {"emissiveStrength": 40.0},
            "KHR_materials_ior": {"ior": 2.0},
        },
    }
    found = _glb_of(tmp_path / "a.glb", said).material
    assert found.emission.ravel() == pytest.approx([40, 20, 0])
    assert found.f0.ravel() == pytest.approx([1 / 9] * 3)


@pytest.mark.parametrize(
    ("specular", "ior", "f0"),
    [
        ({"specularFactor": 0.5}, 1.5, [0.02, 0.02, 0.02]),
        ({"specularColorFactor": [1, 0.5, 0]}, 2.0, [1 / 9, 1 / 18, 0]),
        # As converters write a colour of F0: an index that reflects nearly all, or all.
        (
            {"specularColorFactor": [0.3, 0.2, 0.1], "specularFactor": 1},
            1000,
            [0.2988, 0.1992, 0.1],
        ),
        ({"specularColorFactor": [0.3, 2.0, 0.1], "specularFactor": 0.5}, 0, [0.15, 0.5, 0.05]),
    ],
)
def test_specular_factors_of_a_glb(
    tmp_path: Path, specular: dict[str, Any], ior: float, f0: list[float]
) -> None:
    extensions = {"KHR_materials_specular": specular, "KHR_materials_ior": {"ior": ior}}
    said = {"pbrMetallicRoughness": {"metallicFactor": 0}, "extensions": extensions}
    found = _glb_of(tmp_path / "a.glb", dict(said)).material
    assert found.f0.ravel() == pytest.approx(f0, abs=1e-3)
    # What is metal of it reflects its base colour.
    half = {"metallicFactor": 0.5, "baseColorFactor": [0.8, 0.4, 0.2, 1]}
    mixed = np.add(f0, [0.8, 0.4, 0.2]) / 2
    said = {"pbrMetallicRoughness": half, "extensions": extensions}
    found = _glb_of(tmp_path / "b.glb", dict(said)).material
    assert found.f0.ravel() == pytest.approx(mixed, abs=1e-3)
    coloured = _glb_of(tmp_path / "c.glb", dict(said), [1, 1, 1])
    assert coloured.corner_f0 is not None
    assert coloured.corner_f0[0, 0] == pytest.approx(mixed, abs=1e-3)


def test_specular_textures_of_a_glb_are_told_and_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    specular = {"specularColorTexture": {"index": 0}, "specularFactor": 0.5}
    extensions = {"KHR_materials_specular": specular, "KHR_materials_ior": {"ior": 1000}}
    said = {"pbrMetallicRoughness": {"metallicFactor": 0}, "extensions": extensions}
    found = _glb_of(tmp_path / "a.glb", said | {"name": "tiles"})
    assert found.material.f0.ravel() == pytest.approx([0.02] * 3)
    told = capsys.readouterr().err
    assert "a.glb: material 'tiles': textures of KHR_materials_specular are not read" in told


@pytest.mark.parametrize(
    ("transmission", "metallic", "clear", "told"),
    [
        ({"transmissionFactor": 1.0}, 0, True, "glass is not rendered"),
        ({"transmissionFactor": 0.9}, 0, True, "glass is not rendered"),
        ({"transmissionFactor": 0.2}, 0, False, "taken as opaque"),
        ({"transmissionFactor": 1, "transmissionTexture": {"index": 0}}, 0, False, "as opaque"),
        ({"transmissionFactor": 1.0}, 1, False, ""),  # which metal holds
        ({}, 0, False, ""),
    ],
)
def test_glass_of_a_glb_is_clear(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    transmission: dict[str, Any],
    metallic: int,
    clear: bool,
    told: str,
) -> None:
    extensions = {"KHR_materials_transmission": transmission}
    inner = {"metallicFactor": metallic}
    said = {"name": "glass", "pbrMetallicRoughness": inner, "extensions": extensions}
    found = _glb_of(tmp_path / "a.glb", said)
    assert found.material.clear == clear
    sentences = capsys.readouterr().err
    assert told in sentences
    assert ("material 'glass'" in sentences) == bool(told)
    # Which an index of refraction does not change, but being metal does.
    model = tmp_path / "a.glb"
    assert with_material(found, Insert(model=model, ior=1.6)).material.clear == clear
    assert not with_material(found, Insert(model=model, metallic=1.0)).material.clear


@pytest.mark.parametrize(
    "strength",
    [-1, "bright", "2", True, None, [1], 1e39, float("nan"), pytest.param(10**400, id="huge")],
)
def test_a_false_strength_of_emission_is_not_said_of_the_mesh(
    tmp_path: Path, strength: Any
) -> None:
    said = {"KHR_materials_emissive_strength": {"emissiveStrength": strength}}
    with pytest.raises(InputRefused) as refused:
        _glb_of(tmp_path / "a.glb", {"extensions": said})
    sentence = str(refused.value)
    assert "a.glb: material '0' has emissiveStrength" in sentence
    assert "KHR_materials_emissive_strength has a finite number of at least 0." in sentence
    assert not any(word in sentence for word in ("mesh", "face", "corners"))


def test_vertex_colours_of_a_glb_are_linear_and_multiply_its_base_colour(tmp_path: Path) -> None:
    colour = [0.5, 0.001, 2.0]  # which glTF clamps
    matte = {"baseColorFactor": [0.2, 1, 1, 1], "metallicFactor": 0}
    found = _glb_of(tmp_path / "a.glb", {"pbrMetallicRoughness": matte}, colour)
    assert found.corner_colour is not None
    assert found.corner_colour[0, 0] == pytest.approx([0.1, 0.001, 1])
    assert found.corner_f0 is None
    metal = _glb_of(tmp_path / "b.glb", {}, colour)
    assert metal.corner_f0 is not None
    assert metal.corner_f0[0, 0] == pytest.approx([0.5, 0.001, 1], rel=1e-4)
    # What was metal shows the same colours as a dielectric.
    plain = with_material(metal, Insert(model=tmp_path / "b.glb", ior=1.5))
    assert plain.corner_f0 is None
    assert plain.corner_colour is not None
    assert plain.corner_colour[0, 0] == pytest.approx([0.5, 0.001, 1], rel=1e-4)


def test_beside_a_picture_the_mean_of_vertex_colours_counts(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image", reason="textures of GLB need pillow")
    picture = image.fromarray(np.full((2, 2, 3), 255, np.uint8))
    matte = {"pbrMetallicRoughness": {"metallicFactor": 0}}
    found = _glb_of(tmp_path / "a.glb", matte, [0.5, 0.25, 1], picture)
    assert found.corner_colour is None
    assert found.material.diffuse[1, 1] == pytest.approx([0.5, 0.25, 1])


def test_vertex_colours_without_a_material_are_linear_too(tmp_path: Path) -> None:
    box = _box()
    box.visual.vertex_colors = np.tile(np.array([[255, 128, 51, 255]], np.uint8), (8, 1))
    box.export(tmp_path / "a.glb")
    (found,) = surfaces_from_model(tmp_path / "a.glb")
    assert found.corner_f0 is not None
    assert found.corner_f0[0, 0] == pytest.approx([1, 128 / 255, 0.2], abs=1e-6)
