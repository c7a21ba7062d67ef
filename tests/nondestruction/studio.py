"""A USD input as studios make them: many files, a payload, variants, instances, subsets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdRender, UsdShade, Vt

from tests.scenes import MadeCapture, edited
from usdbrdf.files.images import write_exr

# From the capture's frame in metres, z up, to the stage's in centimetres, y up.
TURN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
SQUARE = np.array([(0, 0), (1, 0), (1, 1), (0, 0), (1, 1), (0, 1)], float)


def build(made: MadeCapture, folder: Path) -> Path:
    """Write the capture's room as a folder of USD files, and its poses to match; the root layer.

    The box is an instance behind a payload, with a second one beside it; the lamp is animated, of
    a variant that has another shape, and stands on its own file.
    """
    for part in ("parts", "sub"):
        (folder / part).mkdir(parents=True)
    for name in ("box", "lamp"):
        stage = _stage(folder / "parts" / f"{name}.usdc", "part")
        _mesh(stage, f"/part/{name}", made, name)
        stage.Save()
    _variants_of_the_lamp(folder / "parts" / "lamp.usdc")
    _shell(made, folder / "sub" / "shell.usda")
    _root(folder)
    with edited(made.manifest) as document:
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3] = TURN @ pose[:3]
            pose[:3, 3] *= 100
            frame["transform_matrix"] = pose.tolist()
    return folder / "haus.usda"


def _root(folder: Path) -> None:
    stage = _stage(folder / "haus.usda", "haus")
    stage.GetRootLayer().subLayerPaths.append("./sub/shell.usda")
    for i, name in enumerate(("first", "second")):
        prim = UsdGeom.Xform.Define(stage, f"/haus/{name}")
        prim.AddTranslateOp().Set(Gf.Vec3d(-110 * i, 0, 0))
        prim.GetPrim().GetPayloads().AddPayload("./parts/box.usdc")
        prim.GetPrim().SetInstanceable(True)
    lamp = UsdGeom.Xform.Define(stage, "/haus/bulb")
    lamp.GetPrim().GetReferences().AddReference("./parts/lamp.usdc")
    moves = lamp.AddTranslateOp()
    for time, height in ((1, 0), (5, -100)):
        moves.Set(Gf.Vec3d(0, height, 0), time)
    UsdRender.Settings.Define(stage, "/Render/own")
    stage.SetMetadata("renderSettingsPrimPath", "/Render/own")
    UsdGeom.Scope.Define(stage, "/haus/render")
    stage.Save()


def _shell(made: MadeCapture, path: Path) -> None:
    """Floor, ceiling and walls, with texture coordinates and materials in all kinds of states."""
    stage = _stage(path, "haus")
    for name in ("own", "tiles"):
        material = UsdShade.Material.Define(stage, f"/haus/mtl/{name}")
        shader = UsdShade.Shader.Define(stage, f"/haus/mtl/{name}/surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.25)
        surface = shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput().ConnectToSource(surface)
    write_exr(path.with_name("tile.exr"), np.full((2, 2, 3), 0.5, np.float32))
    texture = UsdShade.Shader.Define(stage, "/haus/mtl/tiles/texture")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./tile.exr")
    own, tiles = (UsdShade.Material.Get(stage, f"/haus/mtl/{name}") for name in ("own", "tiles"))
    meshes = {name: _mesh(stage, f"/haus/{name}", made, name) for name in ROOM}
    _coordinates(meshes["floor"], SQUARE + 2)  # out of the unit square
    _coordinates(meshes["ceiling"], 0.05 + 0.9 * SQUARE)  # as they should be
    _coordinates(meshes["walls"], np.tile(SQUARE, (4, 1)))  # four walls in one place
    for name, kind in (
        ("floor", UsdGeom.Tokens.partition),
        ("walls", UsdGeom.Tokens.nonOverlapping),
    ):
        api = UsdShade.MaterialBindingAPI.Apply(meshes[name].GetPrim())
        api.CreateMaterialBindSubset("a", Vt.IntArray([0]))
        if kind == UsdGeom.Tokens.partition:
            api.CreateMaterialBindSubset("b", Vt.IntArray([1]))
        api.SetMaterialBindSubsetsFamilyType(kind)
        for subset in api.GetMaterialBindSubsets():
            UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(tiles)
    root = stage.GetDefaultPrim()
    everything = Usd.CollectionAPI.Apply(root, "everything")
    everything.CreateIncludesRel().AddTarget("/haus")
    UsdShade.MaterialBindingAPI.Apply(root).Bind(everything, own, "everything")
    stage.Save()


ROOM = ("floor", "ceiling", "walls")


def _stage(path: Path, name: str) -> Usd.Stage:
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, f"/{name}").GetPrim())
    return stage


def _mesh(stage: Usd.Stage, path: str, made: MadeCapture, name: str) -> UsdGeom.Mesh:
    faces = made.triangles[made.face_object == made.names.index(name)]
    used, corners = np.unique(faces, return_inverse=True)
    points = 100 * made.points[used].astype(np.float64) @ TURN.T
    mesh = UsdGeom.Mesh.Define(stage, path)
    array = Vt.Vec3fArray.FromNumpy(points.astype(np.float32))
    mesh.CreatePointsAttr(array)
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(array))
    mesh.CreateFaceVertexCountsAttr([3] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(corners.ravel().tolist())
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    return mesh


def _coordinates(mesh: UsdGeom.Mesh, corners: np.ndarray) -> None:
    kind = Sdf.ValueTypeNames.Float2Array  # as many exporters say it; ours must say the same
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying)
    primvar.Set(Vt.Vec2fArray.FromNumpy(corners.astype(np.float32)))


def _variants_of_the_lamp(path: Path) -> None:
    """As photographed, and a pyramid of other points and faces."""
    stage = Usd.Stage.Open(str(path))
    shape = stage.GetDefaultPrim().GetVariantSets().AddVariantSet("shape")
    mesh = UsdGeom.Mesh.Get(stage, "/part/lamp")
    names = ("points", "faceVertexCounts", "faceVertexIndices")
    square = [mesh.GetPrim().GetAttribute(name).Get() for name in names]
    pyramid = [
        Vt.Vec3fArray([(0, 0, 0), (9, 0, 0), (0, 9, 0), (0, 0, 9)]), Vt.IntArray([3] * 4),
        Vt.IntArray([0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2]),
    ]  # fmt: skip
    for name in names:
        mesh.GetPrim().GetAttribute(name).Clear()
    for variant, values in (("pyramid", pyramid), ("square", square)):
        shape.AddVariant(variant)
        shape.SetVariantSelection(variant)
        with shape.GetVariantEditContext():
            for name, value in zip(names, values, strict=True):
                mesh.GetPrim().GetAttribute(name).Set(value)
    stage.Save()
