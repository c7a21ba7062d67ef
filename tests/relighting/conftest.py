"""A small stage to be relit: a floor, its camera above it, and an empty layer for the artist."""

from __future__ import annotations

from pathlib import Path

import pytest
from pxr import Sdf

pytest.importorskip("mitsuba", reason="the extra render is not installed")

ROOM = """#usda 1.0
(
    defaultPrim = "room"
    metersPerUnit = 1
    upAxis = "Z"
    subLayers = [@./edits.usda@, @./layers/scan.usdc@]
)
"""

BASE = """#usda 1.0
(
    defaultPrim = "room"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "room"
{
    def Scope "geo"
    {
        def Mesh "floor" (prepend apiSchemas = ["MaterialBindingAPI"])
        {
            int[] faceVertexCounts = [4]
            int[] faceVertexIndices = [0, 1, 2, 3]
            point3f[] points = [(-50, -50, 0), (50, -50, 0), (50, 50, 0), (-50, 50, 0)]
            uniform token subdivisionScheme = "none"
            rel material:binding = </room/mtl/floor>
        }
        def Mesh "lamp" (prepend apiSchemas = ["MaterialBindingAPI"])
        {
            int[] faceVertexCounts = [4]
            int[] faceVertexIndices = [0, 3, 2, 1]
            point3f[] points = [(-1, -1, 3), (1, -1, 3), (1, 1, 3), (-1, 1, 3)]
            uniform token subdivisionScheme = "none"
            rel material:binding = </room/mtl/lamp>
        }
    }
    def Scope "mtl"
    {
        def Material "floor"
        {
            token outputs:surface.connect = </room/mtl/floor/s.outputs:surface>
            def Shader "s"
            {
                uniform token info:id = "UsdPreviewSurface"
                color3f inputs:diffuseColor = (0.2, 0.4, 0.8)
                float inputs:roughness = 0.1
                float inputs:ior = 1
                token outputs:surface
            }
        }
        def Material "lamp"
        {
            token outputs:surface.connect = </room/mtl/lamp/s.outputs:surface>
            def Shader "s"
            {
                uniform token info:id = "UsdPreviewSurface"
                color3f inputs:diffuseColor = (0, 0, 0)
                color3f inputs:emissiveColor = (4, 2, 1)
                float inputs:roughness = 1
                float inputs:ior = 1
                token outputs:surface
            }
        }
    }
    def Camera "eye"
    {
        float focalLength = 36
        float horizontalAperture = 2
        float verticalAperture = 2
        double3 xformOp:translate = (0, 0, 1)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
"""


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """The folder of an asset. Its camera /room/eye looks straight down at the floor, 2 m below a
    square lamp of 2 m with a radiance of (4, 2, 1)."""
    folder = tmp_path / "room"
    (folder / "layers").mkdir(parents=True)
    (folder / "room.usda").write_text(ROOM)
    base = Sdf.Layer.CreateAnonymous(".usda")
    base.ImportFromString(BASE)
    base.Export(str(folder / "layers" / "scan.usdc"))
    (folder / "edits.usda").write_text("#usda 1.0\n")
    return folder
