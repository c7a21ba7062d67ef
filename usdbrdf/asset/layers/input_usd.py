"""A scan whose geometry is a USD file: referenced, never copied, never changed.

The file comes in by a reference on the default prim, which is weaker than the looks' variants. Only
what would defeat the looks or the textures is overridden in our own layer: bindings that claim to
be stronger, instancing, polygons (texture seams run between triangles), missing normals, and what
else the file may show at another time or in another of its variants than the photographs do.

The looks bind the mesh for all purposes, inside variants. That beats the input's own binding of the
mesh. It does not beat a binding for one purpose, of a collection, of a face subset, or of an
ancestor that claims to be stronger. The last kind is told to give way, in the scan layer; the
others are listed there, and every look binds them as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layers.author import attribute, over, relationship
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import in_one_line
from usdbrdf.asset.readers.scene import authored_normals, triangulation_of
from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Bool, Float
from usdbrdf.model.mesh import Triangulation, triangulate
from usdbrdf.untrusted.usd_files import is_deforming, is_moving

Types = Sdf.ValueTypeNames
BINDING = "material:binding"
_FIRST = Usd.TimeCode.EarliestTime()


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


def input_meshes(source: Usd.Prim, places: Sequence[str], root: str) -> dict[str, Usd.Prim]:
    """The meshes at ``places`` below the input's default prim ``source``, by their paths in our
    stage, in this order; "." is the default prim itself."""
    meshes = {}
    for below in places:
        path = source.GetPath() if below == "." else source.GetPath().AppendPath(below)
        prim = source.GetStage().GetPrimAtPath(path)
        if not prim or not prim.IsA(UsdGeom.Mesh):
            raise InputRefused(f"<{path}>: the input stage has no mesh there. [stage.input_mesh]")
        meshes[str(path.ReplacePrefix(source.GetPath(), Sdf.Path(root)))] = prim
    return meshes


def author_overrides(
    layer: Sdf.Layer, path: str, mesh: Usd.Prim, normals: Float, turned: Bool
) -> None:
    """What our layer must say about one mesh of the input, which is at ``path`` in our stage.

    normals  (T, 3, 3), of its triangles' corners in the world, as they were read or made
    turned   (T,) bool, triangles that the file has wound away from the cameras
    """
    target, prim, has_variants = Sdf.Path(path), mesh, False
    while target != Sdf.Path.absoluteRootPath:
        has_variants |= prim.HasVariantSets()
        # Opinions inside an instance are ignored, so the instance must become a plain prim.
        if prim.IsInstanceable():
            over(layer, str(target)).SetInfo("instanceable", False)
        # What moves stays where it is first: the capture has one state.
        for op in UsdGeom.Xformable(prim).GetOrderedXformOps() if is_moving(prim) else []:
            first = op.GetAttr().Get(_FIRST)
            attribute(over(layer, str(target)), op.GetName(), op.GetAttr().GetTypeName(), first)
        target, prim = target.GetParentPath(), prim.GetParent()
    # The photographs show the surface as it is: the cage is taken as the surface everywhere.
    none = UsdGeom.Tokens.none
    attribute(over(layer, path), "subdivisionScheme", Types.Token, none, uniform=True)
    geometry = UsdGeom.Mesh(mesh)
    # Texture coordinates of ours fit no other points and faces than those that were photographed.
    fixed = has_variants or is_deforming(geometry)
    if fixed:
        points = geometry.GetPointsAttr().Get(_FIRST)
        attribute(over(layer, path), "points", Types.Point3fArray, points)
        extent = UsdGeom.PointBased.ComputeExtent(points)
        attribute(over(layer, path), "extent", Types.Float3Array, extent)
    _author_triangles(layer, path, geometry, turned, always=fixed)
    if fixed or turned.any() or authored_normals(geometry, triangulation_of(geometry)) is None:
        _author_normals(over(layer, path), geometry, normals)


def _author_normals(prim: Sdf.PrimSpec, mesh: UsdGeom.Mesh, in_world: Float) -> None:
    """Normals per corner, so that everybody shades the surface as it is measured here."""
    world_from_local = np.array(mesh.ComputeLocalToWorldTransform(_FIRST))[:3, :3].T
    # Normals go to the world by the inverse transpose.
    local = in_world.astype(np.float64) @ world_from_local
    size = np.linalg.norm(local, axis=2, keepdims=True)
    if not (np.isfinite(local).all() and (size > 0).all()):
        return
    left_handed = mesh.GetOrientationAttr().Get(_FIRST) == UsdGeom.Tokens.leftHanded
    if left_handed != bool(np.linalg.det(world_from_local) < 0):
        local = local[:, [0, 2, 1]]  # the triangles in the world are wound the other way
    unit = (local / size).reshape(-1, 3).astype(np.float32)
    attribute(prim, "normals", Types.Normal3fArray, unit, interpolation="faceVarying")
    stronger = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if stronger and stronger.HasAuthoredValue():
        blocked = attribute(prim, stronger.GetName(), stronger.GetTypeName())
        blocked.default = Sdf.ValueBlock()


def _author_triangles(
    layer: Sdf.Layer, path: str, mesh: UsdGeom.Mesh, turned: Bool, *, always: bool
) -> None:
    """Replace polygons by triangles, and everything that is stored per polygon or corner; where
    there are triangles only, and none is ``turned``, do so if ``always``."""
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(_FIRST), np.int32)
    holes = np.asarray(mesh.GetHoleIndicesAttr().Get(_FIRST) or [], np.int32)
    if (counts == 3).all() and not len(holes) and not turned.any() and not always:
        return
    indices = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(_FIRST), np.int32)
    # The winding stays as the file says: its orientation still applies.
    points = np.asarray(mesh.GetPointsAttr().Get(_FIRST), np.float64)
    fans = triangulate(counts, indices, holes=holes, points=points)
    for corners in (fans.triangles, fans.corners):
        corners[turned] = corners[turned][:, [0, 2, 1]]
    prim = over(layer, path)
    attribute(prim, "faceVertexCounts", Types.IntArray, np.full(len(fans.triangles), 3, np.int32))
    attribute(prim, "faceVertexIndices", Types.IntArray, fans.triangles.reshape(-1))
    if len(holes):
        attribute(prim, "holeIndices", Types.IntArray, Vt.IntArray())
    for primvar in UsdGeom.PrimvarsAPI(mesh).GetPrimvarsWithAuthoredValues():
        source = primvar.GetIndicesAttr() if primvar.IsIndexed() else primvar.GetAttr()
        _author_gathered(prim, source, primvar.GetInterpolation(), fans)
    _author_gathered(prim, mesh.GetNormalsAttr(), mesh.GetNormalsInterpolation(), fans)
    for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
        if subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.face:
            chosen = np.isin(fans.polygon, np.asarray(subset.GetIndicesAttr().Get(_FIRST) or []))
            child = over(layer, f"{path}/{subset.GetPrim().GetName()}")
            attribute(child, "indices", Types.IntArray, np.flatnonzero(chosen).astype(np.int32))


def _author_gathered(
    prim: Sdf.PrimSpec, source: Usd.Attribute, interpolation: str, fans: Triangulation
) -> None:
    gather: dict[str, npt.NDArray[np.int32]] = {
        UsdGeom.Tokens.faceVarying: fans.corners.reshape(-1),
        UsdGeom.Tokens.uniform: fans.polygon,
    }
    values = source.Get(_FIRST) if source else None
    chosen = gather.get(interpolation)
    # Where there are too few of them the file is wrong about this one.
    if values is None or chosen is None or chosen.max(initial=-1) >= len(values):
        return
    gathered = [values[int(i)] for i in chosen]
    attribute(prim, source.GetName(), source.GetTypeName(), type(values)(gathered))


def has_transform(prim: Usd.Prim | None) -> bool:
    """True where there is an input, whose default prim moves what lies below it."""
    if not prim or not prim.IsA(UsdGeom.Xformable):
        return False
    matrix = UsdGeom.Xformable(prim).GetLocalTransformation(_FIRST)
    return not Gf.IsClose(matrix, Gf.Matrix4d(1.0), 1e-12)


def competing_bindings(mesh: Usd.Prim, source: Usd.Prim, root: str) -> dict[str, str]:
    """Relationships to bind besides the own one of a mesh of the input: path -> the collection it
    is about, or ""; paths below ``source``, the input's default prim, become ours."""
    purposes = set()
    for prim in _with_ancestors(mesh, source):
        for binding in _bindings(prim):
            # Names are BINDING[:purpose] or BINDING:collection[:purpose]:name.
            parts = binding.GetName().split(":")[2:]
            if parts[:1] == ["collection"]:
                parts = parts[1:-1]
            purposes.update(parts[:1])
    found = {f"{mesh.GetPath()}.{BINDING}:{purpose}": "" for purpose in sorted(purposes)}
    subsets = UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Mesh(mesh))
    for prim in (mesh, *(subset.GetPrim() for subset in subsets)):
        for binding in _bindings(prim):
            if binding.GetPath() != mesh.GetPath().AppendProperty(BINDING):
                collections = [t for t in binding.GetTargets() if t.IsPropertyPath()]
                found[str(binding.GetPath())] = str(collections[0]) if collections else ""

    def ours(path: str) -> str:
        return str(Sdf.Path(path).ReplacePrefix(source.GetPath(), Sdf.Path(root))) if path else ""

    return {ours(path): ours(collection) for path, collection in found.items()}


def weaken_bindings(layer: Sdf.Layer, mesh: Usd.Prim, source: Usd.Prim, root: str) -> None:
    """Take back what ancestors of the mesh say about being stronger than it."""
    for prim in _with_ancestors(mesh, source):
        for binding in _bindings(prim) if prim != mesh else []:
            strength = binding.GetMetadata("bindMaterialAs")
            if strength == UsdShade.Tokens.strongerThanDescendants:
                path = prim.GetPath().ReplacePrefix(source.GetPath(), Sdf.Path(root))
                weaker = relationship(over(layer, str(path)), binding.GetName())
                weaker.SetInfo("bindMaterialAs", UsdShade.Tokens.weakerThanDescendants)


def recorded_bindings(asset: Asset) -> dict[str, dict[str, str]]:
    """What the scan layer lists, per object's prim path; empty where the geometry is ours."""
    return dict(read_provenance(asset.layer("scan")).get("competing_bindings", {}))


def _with_ancestors(mesh: Usd.Prim, source: Usd.Prim) -> list[Usd.Prim]:
    stage = mesh.GetStage()
    prefixes = mesh.GetPath().GetPrefixes()
    return [stage.GetPrimAtPath(p) for p in prefixes if p.HasPrefix(source.GetPath())]


def _bindings(prim: Usd.Prim) -> list[Usd.Relationship]:
    return [
        p
        for p in prim.GetAuthoredProperties()
        if isinstance(p, Usd.Relationship) and f"{p.GetName()}:".startswith(f"{BINDING}:")
    ]
