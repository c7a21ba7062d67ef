"""A scan whose geometry is a USD file: referenced, never copied, never changed.

The file comes in by a reference on the default prim, which is weaker than the looks' variants. Only
what would defeat the looks or the textures is overridden in our own layer: bindings that variants
on the mesh cannot beat, instancing, and polygons (texture seams run between triangles).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from usdbrdf.errors import InputRefused
from usdbrdf.stage.author import attribute, over, relationship
from usdbrdf.stage.capture_camera import relative_path
from usdbrdf.stage.triangulate import Triangulation, triangulate
from usdbrdf.stage.usd_errors import in_one_line

Types = Sdf.ValueTypeNames
_BINDING = "material:binding"


def open_input(file: Path) -> Usd.Stage:
    """The input file as a stage with a default prim. A prim does not keep its stage alive: hold it."""
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


def author_overrides(layer: Sdf.Layer, root: str, source: Usd.Prim, below: str) -> None:
    """What our layer must say about one mesh, ``below`` the input's default prim ``source``."""
    path = source.GetPath().AppendPath(below) if below not in ("", ".") else source.GetPath()
    prim = source.GetStage().GetPrimAtPath(path)
    if not prim or not prim.IsA(UsdGeom.Mesh):
        raise InputRefused(f"<{path}>: the input stage has no mesh there. [stage.input_mesh]")
    for ancestor in path.GetPrefixes():
        if ancestor.HasPrefix(source.GetPath()):
            name = ancestor.ReplacePrefix(source.GetPath(), Sdf.Path(root))
            found = source.GetStage().GetPrimAtPath(ancestor)
            _open_instance(layer, str(name), found)
            _yield_bindings(layer, str(name), found, is_object=ancestor == path)
    target = str(path.ReplacePrefix(source.GetPath(), Sdf.Path(root)))
    # The photographs show the surface as it is: the cage is taken as the surface everywhere.
    attribute(
        over(layer, target), "subdivisionScheme", Types.Token, UsdGeom.Tokens.none, uniform=True
    )
    _author_triangles(layer, target, UsdGeom.Mesh(prim))


def _open_instance(layer: Sdf.Layer, path: str, prim: Usd.Prim) -> None:
    """Opinions inside an instance are ignored, so the instance must become a plain prim."""
    if prim.IsInstanceable():
        over(layer, path).SetInfo("instanceable", False)


def _yield_bindings(layer: Sdf.Layer, path: str, prim: Usd.Prim, *, is_object: bool) -> None:
    """Make every binding that could win against one on the object give way."""
    for binding in _bindings(prim):
        name = binding.GetName()
        for_all_purposes = name.split(":")[2:3] in ([], ["collection"]) and name.count(":") < 4
        if not for_all_purposes or (is_object and name != _BINDING):
            relationship(over(layer, path), name)
        elif not is_object and _is_stronger(binding):
            weaker = relationship(over(layer, path), name, *map(str, binding.GetTargets()))
            weaker.SetInfo("bindMaterialAs", UsdShade.Tokens.weakerThanDescendants)
    if is_object:
        for child in prim.GetChildren():
            for binding in _bindings(child):
                relationship(over(layer, f"{path}/{child.GetName()}"), binding.GetName())


def _bindings(prim: Usd.Prim) -> list[Usd.Relationship]:
    properties = prim.GetAuthoredPropertiesInNamespace(_BINDING)
    own = prim.GetRelationship(_BINDING)
    found = [p for p in properties if isinstance(p, Usd.Relationship)]
    return [own, *found] if own and own.HasAuthoredTargets() else found


def _is_stronger(binding: Usd.Relationship) -> bool:
    return bool(binding.GetMetadata("bindMaterialAs") == UsdShade.Tokens.strongerThanDescendants)


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
