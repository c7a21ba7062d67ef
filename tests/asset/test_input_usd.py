"""Geometry that came as USD: referenced, unchanged, and dressed by our looks all the same."""

from dataclasses import replace

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade

from usdbrdf.asset.layers.interface import write_root
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.asset.readers.scene import frames_from_stage, scene_from_stage
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.parts import geometry_from_usd
from usdbrdf.delivery.package import flattened, stage_in_look
from usdbrdf.options import IngestOptions
from usdbrdf.validation.validate import validate

# Every way of binding that could win against ours, and everything stored per polygon.
INPUT = """#usda 1.0
(
    defaultPrim = "haus"
    metersPerUnit = 0.01
    upAxis = "Y"
)

def Xform "haus" (
    prepend apiSchemas = ["MaterialBindingAPI"]
)
{
    double3 xformOp:translate = (100, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    rel material:binding:full = </haus/mtl/own>

    def Scope "render"
    {
    }

    def Scope "mtl"
    {
        def Material "own"
        {
            token outputs:surface.connect = </haus/mtl/own/s.outputs:surface>
            def Shader "s"
            {
                uniform token info:id = "UsdPreviewSurface"
                token outputs:surface
            }
        }
        def Material "box"
        {
            token outputs:surface.connect = </haus/mtl/own/s.outputs:surface>
        }
    }

    def Xform "strong" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {
        rel material:binding = </haus/mtl/own> (
            bindMaterialAs = "strongerThanDescendants"
        )

        def Mesh "box" (
            prepend apiSchemas = ["MaterialBindingAPI", "CollectionAPI:all"]
        )
        {
            uniform token subdivisionScheme = "none"
            point3f[] points = [(0, 0, 0), (100, 0, 0), (100, 100, 0), (0, 100, 0), (200, 0, 0), (200, 100, 0)]
            int[] faceVertexCounts = [4, 4]
            int[] faceVertexIndices = [0, 1, 2, 3, 1, 4, 5, 2]
            normal3f[] normals = [(0, 0, 1), (0, 0, 1), (0, 0, 1), (0, 0, 1), (1, 0, 0), (1, 0, 0), (1, 0, 0), (1, 0, 0)] (
                interpolation = "faceVarying"
            )
            texCoord2f[] primvars:st = [(0, 0), (1, 1), (2, 2), (3, 3), (4, 4), (5, 5), (6, 6), (7, 7)] (
                interpolation = "faceVarying"
            )
            color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] (
                interpolation = "uniform"
            )
            rel material:binding = </haus/mtl/own>
            rel material:binding:preview = </haus/mtl/own>
            uniform token collection:all:expansionRule = "expandPrims"
            rel collection:all:includes = </haus/strong/box>
            rel material:binding:collection:everything = [</haus/strong/box.collection:all>, </haus/mtl/own>]

            uniform token subsetFamily:materialBind:familyType = "nonOverlapping"

            def GeomSubset "right" (
                prepend apiSchemas = ["MaterialBindingAPI"]
            )
            {
                uniform token elementType = "face"
                uniform token familyName = "materialBind"
                int[] indices = [1]
                rel material:binding = </haus/mtl/own>
            }
        }
    }

    def Xform "first" (
        instanceable = true
        references = </chair_model>
    )
    {
        double3 xformOp:translate = (0, 0, 300)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }

    def Xform "second" (
        instanceable = true
        references = </chair_model>
    )
    {
    }
}

class Xform "chair_model"
{
    def Mesh "seat" (
        displayName = "Sitz"
    )
    {
        uniform token subdivisionScheme = "none"
        point3f[] points = [(0, 0, 0), (50, 0, 0), (0, 50, 0)]
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
    }
}
"""  # noqa: E501


def dress(tmp_path, synthetic, text):
    """An asset with all layers over an input file of the given text."""
    file = tmp_path / "capture" / "haus.usda"
    file.parent.mkdir()
    file.write_text(text)
    found = geometry_from_usd(file, IngestOptions(), Findings(), capture_root=file.parent)
    scan = replace(
        synthetic.make_scan(tmp_path / "capture", unit=0.01, up_axis="Y"),
        mesh=found.mesh,
        objects=found.objects,
        usd_geometry=file,
        object_prims=found.object_prims,
    )
    prims = [f"/room/{below}" if below != "." else "/room" for below in found.object_prims]
    built = synthetic.build(tmp_path / "room", scan, prims=tuple(prims))
    assert file.read_text() == text
    return built


@pytest.fixture(scope="module")
def dressed(tmp_path_factory, synthetic):
    return dress(tmp_path_factory.mktemp("input"), synthetic, INPUT)


def test_the_input_has_what_the_test_needs(dressed):
    assert dressed.prims == ("/room/strong/box", "/room/first/seat", "/room/second/seat")


def test_the_asset_refers_to_the_input_by_a_relative_path(dressed):
    layer = Sdf.Layer.FindOrOpen(str(dressed.asset.layer("scan")))
    (reference,) = layer.GetPrimAtPath("/room").referenceList.prependedItems
    assert reference.assetPath == "../../capture/haus.usda"


def test_every_look_reaches_every_mesh_and_subset(dressed):
    stage = Usd.Stage.Open(str(dressed.asset.root_layer))
    stage.SetEditTarget(stage.GetSessionLayer())
    looks = stage.GetDefaultPrim().GetVariantSet("look")
    assert {"shaded", "lit", "albedo"} <= set(looks.GetVariantNames())
    purposes = (UsdShade.Tokens.allPurpose, UsdShade.Tokens.full, UsdShade.Tokens.preview)
    for look in looks.GetVariantNames():
        looks.SetVariantSelection(look)
        for prim_path, label in zip(dressed.prims, dressed.scan.objects, strict=True):
            name = f"mtl/{label.identifier}" if look == "shaded" else f"looks/{look}"
            expected = f"/room/geo/{label.identifier}/{name}"
            prims = [stage.GetPrimAtPath(prim_path)]
            for prim in prims + prims[0].GetChildren():
                api = UsdShade.MaterialBindingAPI(prim)
                for purpose in purposes:
                    assert api.ComputeBoundMaterial(purpose)[0].GetPath() == expected, (look, prim)


def test_our_materials_do_not_merge_with_the_inputs(dressed):
    """Ours for the mesh ``box`` would otherwise meet the input's material of the same path."""
    stage = Usd.Stage.Open(str(dressed.asset.root_layer))
    ours = stage.GetPrimAtPath("/room/geo/box/mtl/box")
    assert ours.GetChild("PreviewSurface")
    assert not stage.GetPrimAtPath("/room/mtl/box/PreviewSurface")


def test_the_root_finds_the_render_settings_also_before_the_scan_is_published(dressed, tmp_path):
    """Root and scan layer are staged together; the asset they are for does not exist yet."""
    (tmp_path / "staged" / "layers").mkdir(parents=True)
    asset = Asset(tmp_path / "room", "room")
    scan = tmp_path / "staged" / "layers" / "scan.usdc"
    scan.write_bytes(dressed.asset.layer("scan").read_bytes())
    write_root(tmp_path / "staged" / "room.usda", asset, dressed.header)
    root = Sdf.Layer.FindOrOpen(str(tmp_path / "staged" / "room.usda"))
    path = root.pseudoRoot.GetInfo("renderSettingsPrimPath")
    assert path == "/room/usdbrdf_render/capture"
    stage = Usd.Stage.Open(str(dressed.asset.root_layer))
    assert stage.GetPrimAtPath(path).GetTypeName() == "RenderSettings"


def test_the_scene_is_the_one_that_was_scanned(dressed):
    scene = scene_from_stage(open_weaker(dressed.asset, "shading"))
    mesh = dressed.scan.mesh
    np.testing.assert_allclose(
        scene.points[scene.triangles], mesh.points[mesh.triangles] * 0.01, atol=1e-6
    )
    np.testing.assert_allclose(scene.corner_normals, mesh.corner_normals, atol=1e-6)
    np.testing.assert_array_equal(scene.face_object, mesh.face_object)
    assert [o.identifier for o in scene.objects] == [o.identifier for o in dressed.scan.objects]
    assert len({o.identifier for o in scene.objects}) == 3
    expected = np.concatenate([item.corner_uv for item in dressed.textured])
    np.testing.assert_array_equal(scene.corner_uv, expected)


def test_texture_coordinates_of_the_input_are_not_taken_for_ours(dressed):
    assert scene_from_stage(open_weaker(dressed.asset, "texturing")).corner_uv is None


def test_what_is_stored_per_polygon_follows_the_triangles(dressed):
    stage = open_weaker(dressed.asset, "texturing")
    mesh = UsdGeom.Mesh.Get(stage, "/room/strong/box")
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == [3, 3, 3, 3]
    primvars = UsdGeom.PrimvarsAPI(mesh)
    red, green = (1, 0, 0), (0, 1, 0)
    assert list(primvars.GetPrimvar("displayColor").Get()) == [red, red, green, green]
    first = [value[0] for value in primvars.GetPrimvar("st").Get()]
    assert first == [0, 1, 2, 0, 2, 3, 4, 5, 6, 4, 6, 7]
    subset = UsdGeom.Subset.Get(stage, "/room/strong/box/right")
    assert list(subset.GetIndicesAttr().Get()) == [2, 3]


def test_poses_are_in_the_world_though_the_default_prim_is_moved(dressed):
    frames = frames_from_stage(open_weaker(dressed.asset, "texturing"))
    expected = dressed.scan.frames.world_from_camera[:, :3, 3] * 0.01
    np.testing.assert_allclose(frames.world_from_camera[:, :3, 3], expected, atol=1e-9)


def test_it_validates(dressed):
    assert "\n".join(validate(dressed.asset.root_layer)) == ""


def test_it_is_flattened_with_its_meshes_and_without_its_materials(dressed):
    stage = stage_in_look(dressed.asset, "shaded")
    flat = flattened(stage, dressed.asset)
    used = set(flat.GetUsedLayers(includeClipLayers=False))
    assert used == {flat.GetRootLayer(), flat.GetSessionLayer()}
    before, after = (UsdGeom.XformCache(Usd.TimeCode.EarliestTime()) for _ in range(2))
    for prim_path in dressed.prims:
        mesh, flat_mesh = stage.GetPrimAtPath(prim_path), flat.GetPrimAtPath(prim_path)
        assert flat_mesh.GetAttribute("points").Get() == mesh.GetAttribute("points").Get()
        pose = before.GetLocalToWorldTransform(mesh)
        assert after.GetLocalToWorldTransform(flat_mesh) == pose
    materials = {str(p.GetPath()) for p in flat.TraverseAll() if p.IsA(UsdShade.Material)}
    assert materials == {
        f"/room/geo/{o.identifier}/mtl/{o.identifier}" for o in dressed.scan.objects
    }


def test_a_default_prim_that_is_the_mesh_itself(tmp_path, synthetic):
    text = (
        INPUT[: INPUT.index("def Xform")]
        + """
def Mesh "haus"
{
    uniform token subdivisionScheme = "none"
    point3f[] points = [(0, 0, 0), (50, 0, 0), (0, 50, 0)]
    float3[] extent = [(0, 0, 0), (50, 50, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
}
"""
    )
    built = dress(tmp_path, synthetic, text)
    scene = scene_from_stage(open_weaker(built.asset, "shading"))
    assert [o.prim_path for o in scene.objects] == ["/room"]
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    material, _ = UsdShade.MaterialBindingAPI(stage.GetDefaultPrim()).ComputeBoundMaterial()
    assert material.GetPath() == "/room/geo/haus/mtl/haus"
    assert len(frames_from_stage(stage)) == 3
    assert validate(built.asset.root_layer) == []
