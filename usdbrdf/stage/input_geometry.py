"""A scan whose geometry is a USD file: referenced, never copied, never changed.

The file comes in by a reference on the default prim, which is weaker than the looks' variants. Only
what would defeat the looks or the textures is overridden in our own layer: bindings that claim to
be stronger, instancing, and polygons (texture seams run between triangles).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

from usdbrdf.errors import InputRefused
from usdbrdf.stage.author import attribute, over
from usdbrdf.stage.capture_camera import relative_path
from usdbrdf.stage.triangulate import Triangulation, triangulate
from usdbrdf.stage.usd_errors import in_one_line

Types = Sdf.ValueTypeNames


def open_input(file: Path) -> Usd.Stage:
    """The input file as a stage with a default prim. Hold it: a prim does not keep it alive."""
    try:
        stage = Usd.Stage.Open(str(file))
    except Tf.ErrorException as error:
        raise InputRefused(
            f"{file}: USD cannot open it: {in_one_line(error)}. [stage.input]"
        ) from error
    if not stage.GetDefaultPrim():
        raise InputRefused(
            f"{file}: the stage has no default prim, so nothing can refer to it. "
            "Set defaultPrim in the file. [stage.default_prim]"
        )
    return stage


def author_reference(layer: Sdf.Layer, root: str, file: Path, folder: Path) -> None:
    """Reference the input's default prim on ours, by a path relative to the layer's folder."""
    reference = Sdf.Reference(relative_path(file, folder))
    over(layer, root).referenceList.prependedItems = [reference]


def input_mesh(source: Usd.Prim, below: str) -> Usd.Prim:
    """The mesh ``below`` the input's default prim ``source``; "." is the default prim itself."""
    path = source.GetPath() if below == "." else source.GetPath().AppendPath(below)
    prim = source.GetStage().GetPrimAtPath(path)
    if not prim or not prim.IsA(UsdGeom.Mesh):
        raise InputRefused(f"<{path}>: the input stage has no mesh there. [stage.input_mesh]")
    return prim


def author_overrides(layer: Sdf.Layer, path: str, mesh: Usd.Prim) -> None:
    """What our layer must say about one mesh of the input, which is at ``path`` in our stage."""
    target, prim = Sdf.Path(path), mesh
    while target != Sdf.Path.absoluteRootPath:
        # Opinions inside an instance are ignored, so the instance must become a plain prim.
        if prim.IsInstanceable():
            over(layer, str(target)).SetInfo("instanceable", False)
        target, prim = target.GetParentPath(), prim.GetParent()
    # The photographs show the surface as it is: the cage is taken as the surface everywhere.
    none = UsdGeom.Tokens.none
    attribute(over(layer, path), "subdivisionScheme", Types.Token, none, uniform=True)
    _author_triangles(layer, path, UsdGeom.Mesh(mesh))


def _author_triangles(layer: Sdf.Layer, path: str, mesh: UsdGeom.Mesh) -> None:
    """Replace polygons by triangles, and everything that is stored per polygon or corner."""
    time = Usd.TimeCode.EarliestTime()
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(time), np.int32)
    holes = np.asarray(mesh.GetHoleIndicesAttr().Get(time) or [], np.int32)
    if (counts == 3).all() and not len(holes):
        return
    indices = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(time), np.int32)
    # The winding stays as the file says: its orientation still applies.
    fans = triangulate(counts, indices, holes=holes)
    prim = over(layer, path)
    threes = np.full(len(fans.triangles), 3, np.int32)
    attribute(prim, "faceVertexCounts", Types.IntArray, Vt.IntArray.FromNumpy(threes))
    points = Vt.IntArray.FromNumpy(fans.triangles.reshape(-1))
    attribute(prim, "faceVertexIndices", Types.IntArray, points)
    if len(holes):
        attribute(prim, "holeIndices", Types.IntArray, Vt.IntArray())
    for primvar in UsdGeom.PrimvarsAPI(mesh).GetPrimvarsWithAuthoredValues():
        source = primvar.GetIndicesAttr() if primvar.IsIndexed() else primvar.GetAttr()
        _author_gathered(prim, source, primvar.GetInterpolation(), fans)
    _author_gathered(prim, mesh.GetNormalsAttr(), mesh.GetNormalsInterpolation(), fans)
    for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
        if subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.face:
            chosen = np.isin(fans.polygon, np.asarray(subset.GetIndicesAttr().Get(time) or []))
            faces = Vt.IntArray.FromNumpy(np.flatnonzero(chosen).astype(np.int32))
            child = over(layer, f"{path}/{subset.GetPrim().GetName()}")
            attribute(child, "indices", Types.IntArray, faces)


def _author_gathered(
    prim: Sdf.PrimSpec, source: Usd.Attribute, interpolation: str, fans: Triangulation
) -> None:
    gather: dict[str, npt.NDArray[np.int32]] = {
        UsdGeom.Tokens.faceVarying: fans.corners.reshape(-1),
        UsdGeom.Tokens.uniform: fans.polygon,
    }
    values = source.Get(Usd.TimeCode.EarliestTime()) if source else None
    if values is None or interpolation not in gather:
        return
    chosen = [values[int(i)] for i in gather[interpolation]]
    attribute(prim, source.GetName(), source.GetTypeName(), type(values)(chosen))


def has_transform(prim: Usd.Prim) -> bool:
    """True where the input's default prim moves what lies below it."""
    if not prim.IsA(UsdGeom.Xformable):
        return False
    matrix = UsdGeom.Xformable(prim).GetLocalTransformation(Usd.TimeCode.EarliestTime())
    return not Gf.IsClose(matrix, Gf.Matrix4d(1.0), 1e-12)
