"""Instances that an artist brought in: each with its own material, and no prototype left over."""

from __future__ import annotations

import zipfile

import pytest
from pxr import Sdf, Usd, UsdShade

from usdbrdf.delivery.package import package
from usdbrdf.options import PackageOptions

EDITS = """#usda 1.0
(
    defaultPrim = "room"
)
over "room"
{
    def Xform "things"
    {
        def Xform "thing"
        {
            def Mesh "m"
            {
                point3f[] points = [(0, 0, 1), (1, 0, 1), (0, 1, 1)]
                int[] faceVertexCounts = [3]
                int[] faceVertexIndices = [0, 1, 2]
            }
        }
    }
    def Xform "props"
    {
        def Xform "one" (
            instanceable = true
            prepend apiSchemas = ["MaterialBindingAPI"]
            prepend references = </room/things/thing>
        )
        {
            rel material:binding = </room/props/red>
        }
        def Xform "two" (
            instanceable = true
            prepend references = </room/things/thing>
        )
        {
        }
        def Material "red"
        {
            token outputs:surface.connect = </room/props/red/s.outputs:surface>
            def Shader "s"
            {
                uniform token info:id = "UsdPreviewSurface"
                color3f inputs:diffuseColor = (1, 0, 0)
                token outputs:surface
            }
        }
    }
}
"""


def material_of(stage: Usd.Stage, path: str) -> str | None:
    bound = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(path)).ComputeBoundMaterial()[0]
    return str(bound.GetPath()) if bound else None


@pytest.fixture
def opened(room, tmp_path) -> Usd.Stage:
    layer = Sdf.Layer.FindOrOpen(str(room.asset.edits_layer))
    layer.ImportFromString(EDITS)
    layer.Save()
    assert Usd.Stage.Open(str(room.asset.root_layer)).GetPrimAtPath("/room/props/one").IsInstance()
    package(room.asset.folder, tmp_path / "room.usdz", PackageOptions())
    with zipfile.ZipFile(tmp_path / "room.usdz") as archive:
        archive.extractall(tmp_path / "x")
        return Usd.Stage.Open(str(tmp_path / "x" / archive.namelist()[0]))


def test_what_is_bound_to_an_instance_is_packed(opened):
    assert material_of(opened, "/room/props/one/m") == "/room/props/red"
    assert material_of(opened, "/room/props/two/m") is None


def test_all_lies_below_the_default_prim(opened):
    assert [prim.GetName() for prim in opened.GetPseudoRoot().GetAllChildren()] == ["room"]
