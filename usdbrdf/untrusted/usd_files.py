"""USD files that somebody else made: their meshes as one soup, and whatever a reader makes of them,
once their asset paths are checked (``usd_paths``); all read in child processes.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pxr import Usd, UsdGeom, UsdShade, UsdSkel, Vt

from usdbrdf.errors import InputRefused
from usdbrdf.files.naming import unique_identifiers
from usdbrdf.files.paths import refuse_nameless
from usdbrdf.model.arrays import Double, Float, Int
from usdbrdf.model.mesh import (
    ObjectLabel,
    ScanGeometry,
    ScanMesh,
    Triangulation,
    joined,
    triangulate,
)
from usdbrdf.untrusted.bounds import read_in_child, refuse_far
from usdbrdf.untrusted.usd_paths import check_asset_paths, one_line, refuse_unchecked, usd_errors

# What fills the sky or lies below an atom is no scan's unit.
_MIN_UNIT, _MAX_UNIT = 1e-9, 1e9
T = TypeVar("T")


def layers_of_usd(path: Path, allow: Sequence[Path]) -> tuple[Path, ...]:
    """A USD file and every layer that it reaches; InputRefused if one lies elsewhere than beside
    it or in ``allow``."""
    layers: tuple[str, ...] = _in_child("layers", path, allow, tuple)
    return tuple(Path(layer) for layer in layers)


def meshes_from_usd(
    path: Path, *, allow: Sequence[Path] = (), subsets: bool = False
) -> ScanGeometry:
    """Every visible mesh below the default prim, one object each, by its display name or its own,
    with the class that semantic labels give it; instances count one by one.

    allow    folders outside the file's own that its asset paths may lead into
    subsets  where meshes have face subsets, each of these is an object, and what is left of its
             mesh another; there are no ``object_prims`` then
    """
    reader = "parts" if subsets else "meshes"
    return _in_child(reader, path, allow, ScanGeometry, parts=(ScanMesh, ObjectLabel))


def render_scene_of_usd(
    path: Path, reader: str, *, allow: Sequence[Path] = (), parts: Sequence[type] = ()
) -> tuple[Any, ...]:
    """What ``reader`` ("package.module:name") makes of the file, as f(path) in the child, once its
    asset paths and its units are known to be sound: a tuple in which may be ``parts``."""
    return _in_child(reader, path, allow, tuple, parts=parts)


def _in_child(
    reader: str, path: Path, allow: Sequence[Path], returns: type[T], *, parts: Sequence[type] = ()
) -> T:
    """``read_here`` in a child."""
    refuse_nameless(path)
    # Absolute and without links.
    own = os.path.dirname(os.path.realpath(path))
    allowed = [own, *(os.path.realpath(folder) for folder in allow)]
    parameters = {"reader": reader, "allowed": allowed}
    return read_in_child(
        "stage", f"{__name__}:read_here", path, returns, parts=parts, parameters=parameters
    )


def read_here(path: Path, reader: str, allowed: Sequence[str]) -> Any:
    """The "layers", the "meshes", these with their "parts", or what another ``reader`` makes of a
    file, in this process, a child; nothing is composed before the asset paths are checked."""
    with usd_errors(path):
        layers = check_asset_paths(path, allowed)
        if reader == "layers":
            return tuple(layers)
        stage = Usd.Stage.Open(str(path), Usd.Stage.LoadAll)
        refuse_unchecked(stage, layers)
        problems = stage.GetCompositionErrors()
        if problems:
            raise InputRefused(
                f"{path}: the stage does not compose: {one_line(problems[0])}. Bring the missing "
                "layers along, or flatten it. [stage.input]"
            )
        if reader in ("meshes", "parts"):
            return _meshes(stage, path, subsets=reader == "parts")
        check_units(stage, path)
        module, _, name = reader.partition(":")
        return getattr(import_module(module), name)(path)


def _meshes(stage: Usd.Stage, path: Path, *, subsets: bool) -> ScanGeometry:
    root = stage.GetDefaultPrim()
    if not root:
        raise InputRefused(
            f"{path}: the stage has no default prim, so nothing can refer to it. Set defaultPrim "
            "in the file. [stage.default_prim]"
        )
    meters_per_unit, up_axis = check_units(stage, path)
    time = Usd.TimeCode.EarliestTime()
    transforms = UsdGeom.XformCache(time)
    meshes, warnings = _meshes_below(root, path)
    parts = [
        _world_part(mesh, transforms.GetLocalToWorldTransform(mesh.GetPrim()), time, path)
        for mesh in meshes
    ]
    points, triangles, face_object = joined([part[:2] for part in parts])
    refuse_far(path, points)
    owner_of_face = []
    prims = [mesh.GetPrim() for mesh in meshes]
    split = [face_subsets(mesh) if subsets else [] for mesh in meshes]
    owners: list[Usd.Prim] = []
    for i, (mesh, own) in enumerate(zip(meshes, split, strict=True)):
        which = _subset_of_triangles(mesh, own, parts[i][3], time)
        owner_of_face.append(len(owners) + np.where(which < 0, len(own), which))
        owners += [*(subset.GetPrim() for subset in own), prims[i]]
    if any(split):  # a whole mesh is an object even without an area: the asset refers to it
        used, numbered = np.unique(np.concatenate(owner_of_face), return_inverse=True)
        owners, face_object = [owners[i] for i in used.tolist()], numbered.astype(np.int32)
    labels = [prim.GetDisplayName() or prim.GetName() for prim in owners]
    identifiers = unique_identifiers(labels)
    return ScanGeometry(
        mesh=ScanMesh(
            points=points,
            triangles=triangles,
            corner_normals=np.concatenate([part[2] for part in parts]),
            face_object=face_object,
        ),
        objects=tuple(
            ObjectLabel(identifier=identifier, label=label, class_name=_class_of(prim))
            for identifier, label, prim in zip(identifiers, labels, owners, strict=True)
        ),
        object_prims=()
        if any(split)
        else tuple(str(p.GetPath().MakeRelativePath(root.GetPath())) for p in prims),
        meters_per_unit=meters_per_unit,
        up_axis=up_axis,
        warnings=tuple(warnings),
    )


def face_subsets(mesh: UsdGeom.Mesh) -> list[UsdGeom.Subset]:
    """The subsets of faces that tell objects apart: of the family with semantic labels, else of one
    that is not there for materials, else of that one."""
    families: dict[str, list[UsdGeom.Subset]] = {}
    for subset in UsdGeom.Subset.GetGeomSubsets(mesh, UsdGeom.Tokens.face):
        families.setdefault(str(subset.GetFamilyNameAttr().Get() or ""), []).append(subset)

    def rank(family: str) -> tuple[bool, bool, str]:
        labelled = any(_labels_at(subset.GetPrim()) for subset in families[family])
        return not labelled, family == UsdShade.Tokens.materialBind, family

    return families[min(families, key=rank)] if families else []


def _subset_of_triangles(
    mesh: UsdGeom.Mesh, subsets: Sequence[UsdGeom.Subset], polygon: Int, time: Any
) -> Int:
    """(T,) the subset that each triangle's polygon is in, the first of several; -1 for none."""
    subset_of = np.full(len(mesh.GetFaceVertexCountsAttr().Get(time)), -1, np.int32)
    for i, subset in reversed(list(enumerate(subsets))):
        indices = numbers_of(subset.GetIndicesAttr().Get(time), np.int64)
        subset_of[indices[(indices >= 0) & (indices < len(subset_of))]] = i
    return np.asarray(subset_of[polygon], np.int32)


def _class_of(prim: Usd.Prim) -> str:
    """The semantic label of a prim, or of the nearest prim above that has one; "" without any."""
    while prim and not prim.IsPseudoRoot():
        if labels := _labels_at(prim):
            return labels[0]
        prim = prim.GetParent()
    return ""


def _labels_at(prim: Usd.Prim) -> list[str]:
    """Labels of UsdSemantics, or of the schema that was used before it, those of a taxonomy
    "class" or "category" first."""
    found = []
    for attribute in prim.GetAuthoredAttributes():
        words = attribute.GetName().split(":")
        if words[:2] == ["semantics", "labels"]:
            values = attribute.Get(Usd.TimeCode.EarliestTime())
            values = (values,) if isinstance(values, str) else values
            values = values if isinstance(values, Vt.TokenArray | Vt.StringArray | tuple) else ()
            found += [(words[-1] not in ("class", "category"), str(value)) for value in values]
        elif words[0] == "semantic" and words[-1] == "semanticData":
            kind = prim.GetAttribute(":".join([*words[:-1], "semanticType"]))
            found += [(not kind or kind.Get() != "class", str(attribute.Get()))]
    return [label for _, label in sorted(found, key=lambda entry: entry[0]) if label]


def check_units(stage: Usd.Stage, path: Path) -> tuple[float, str]:
    """Metres per unit and the up axis; InputRefused where no scene can have them."""
    meters, axis = UsdGeom.GetStageMetersPerUnit(stage), str(UsdGeom.GetStageUpAxis(stage))
    if not (math.isfinite(meters) and _MIN_UNIT <= meters <= _MAX_UNIT):
        raise InputRefused(
            f"{path}: metersPerUnit is {meters:g} (limits {_MIN_UNIT:g} to {_MAX_UNIT:g}). Correct "
            "it in the file. [stage.units]"
        )
    if axis not in ("Y", "Z"):
        raise InputRefused(
            f"{path}: upAxis is {axis[:40]!r}, not Y or Z. Correct it in the file. [stage.units]"
        )
    return float(meters), axis


def is_moving(prim: Usd.Prim) -> bool:
    """True where the prim's own transform changes with time."""
    transform = UsdGeom.Xformable(prim)
    return bool(transform and transform.TransformMightBeTimeVarying())


def is_deforming(mesh: UsdGeom.Mesh) -> bool:
    """True where the mesh's points or faces change with time."""
    attributes = (
        mesh.GetPointsAttr(), mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr(),
    )  # fmt: skip
    return any(attribute.ValueMightBeTimeVarying() for attribute in attributes)


def refuse_broken_meshes(path: Path) -> None:
    """InputRefused where a mesh that a stage shows has faces that its points do not fit; one that
    is empty is nothing."""
    stage, time = Usd.Stage.Open(str(path), Usd.Stage.LoadAll), Usd.TimeCode.EarliestTime()
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)):
        if prim.IsA(UsdGeom.Mesh) and _is_shown(UsdGeom.Imageable(prim)):
            mesh = UsdGeom.Mesh(prim)
            if mesh.GetFaceVertexCountsAttr().Get(time):
                _topology(mesh, time, path)


def _is_shown(shape: UsdGeom.Imageable) -> bool:
    """Whether it is visible, and there to be rendered."""
    visible = shape.ComputeVisibility(Usd.TimeCode.EarliestTime()) != UsdGeom.Tokens.invisible
    other = UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide
    return bool(visible and shape.ComputePurpose() not in other)


def _meshes_below(root: Any, path: Path) -> tuple[list[Any], list[str]]:
    """Visible meshes in the order of the stage, and sentences about the rest."""
    meshes, empty = list[UsdGeom.Mesh](), list[UsdGeom.Mesh]()
    other, hidden = [], 0
    for prim in Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)):
        if prim.IsA(UsdGeom.PointInstancer):
            raise InputRefused(
                f"{path}: <{prim.GetPath()}> is a point instancer, whose copies cannot carry "
                "materials of their own. Bake it to meshes. [stage.instancer]"
            )
        if not prim.IsA(UsdGeom.Gprim):
            continue
        if not _is_shown(UsdGeom.Imageable(prim)):
            hidden += 1
        elif prim.IsA(UsdGeom.Mesh):
            mesh = UsdGeom.Mesh(prim)
            (empty if _is_empty(mesh) else meshes).append(mesh)
        else:
            other.append(f"<{prim.GetPath()}> ({prim.GetTypeName()})")
    if not meshes:
        held = "no visible mesh with faces" if empty else "no visible mesh"
        raise InputRefused(
            f"{path}: {held} below <{root.GetPath()}>. Export the surface as meshes "
            "inside the default prim, or name a mesh with --mesh. [mesh.empty]"
        )
    sentences = _warnings(path.name, root, meshes, other, hidden)
    if empty:
        sentences.append(
            f"{path.name}: {len(empty)} meshes have no faces and are left out, first "
            f"<{empty[0].GetPath()}>. [stage.empty]"
        )
    return meshes, sentences


def _is_empty(mesh: UsdGeom.Mesh) -> bool:
    """Whether nothing is said of faces at all, as exporters leave what has been deleted."""
    time = Usd.TimeCode.EarliestTime()
    said = (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
    return not any(attribute.Get(time) for attribute in said)


def _warnings(
    name: str, root: Any, meshes: Sequence[Any], other: Sequence[str], hidden: int
) -> list[str]:
    """What a file's meshes lose on the way, and what else it holds: prims of other types, and the
    number of hidden ones."""
    schemes = [mesh.GetSubdivisionSchemeAttr().Get() for mesh in meshes]
    moving = []
    for mesh in meshes:
        prim, moves = mesh.GetPrim(), is_deforming(mesh)
        while prim and prim.GetPath().HasPrefix(root.GetPath()):
            moves, prim = moves or is_moving(prim), prim.GetParent()
        moving += [f"<{mesh.GetPath()}>"] if moves else []
    sentences = {
        f"prims are not meshes and are ignored, first {other[0] if other else ''}. "
        "[stage.not_mesh]": len(other),
        "meshes are subdivision cages (what USD assumes where no scheme is set); the cage is taken "
        "as the surface. [stage.subdivision]": sum(s != UsdGeom.Tokens.none for s in schemes),
        f"meshes move or change with time, first {moving[0] if moving else ''}; each is taken, and "
        "stays, as its first time sample has it. The photographs must show that state. "
        "[stage.animated]": len(moving),
        "meshes may be bound to a skeleton, which is not applied: they are taken in their rest "
        "pose. Bake the pose that the photographs show. [stage.skinned]": sum(
            mesh.GetPrim().HasAPI(UsdSkel.BindingAPI) for mesh in meshes
        ),
        "invisible or guide prims are left out. [stage.hidden]": hidden,
    }
    return [f"{name}: {number} {said}" for said, number in sentences.items() if number]


def _world_part(mesh: Any, transform: Any, time: Any, path: Path) -> tuple[Float, Int, Float, Int]:
    """One mesh in the world: points, triangles, corner normals (NaN where none are authored), and
    the polygon of each triangle.

    transform is USD's, for row vectors: p_world = p @ matrix.
    """
    matrix = np.array(transform, np.float64)
    points, counts, indices = _topology(mesh, time, path)
    mirrored = bool(np.linalg.det(matrix[:3, :3]) < 0)
    left_handed = mesh.GetOrientationAttr().Get(time) == UsdGeom.Tokens.leftHanded
    holes = numbers_of(mesh.GetHoleIndicesAttr().Get(time), np.int32)
    fans = triangulate(
        counts, indices, left_handed=left_handed != mirrored, holes=holes, points=points
    )
    world = points @ matrix[:3, :3] + matrix[3, :3]
    normals = np.full((len(fans.triangles), 3, 3), np.nan, np.float32)
    local = _authored_normals(mesh, fans, len(points), len(counts), len(indices), time)
    if local is not None and abs(np.linalg.det(matrix[:3, :3])) > 0:
        turned = local @ np.linalg.inv(matrix[:3, :3]).T
        size = np.linalg.norm(turned, axis=2, keepdims=True)
        if np.isfinite(turned).all() and (size > 0).all():
            normals = (turned / size).astype(np.float32)
    return world.astype(np.float32), fans.triangles, normals, fans.polygon


def _topology(mesh: Any, time: Any, path: Path) -> tuple[Double, Int, Int]:
    """Points (V, 3), corners per polygon, point of each corner; InputRefused if they disagree.

    Nothing can be repaired here: the file is referenced, and the asset must mean the same mesh.
    """
    points = _vectors(mesh.GetPointsAttr().Get(time))
    counts = numbers_of(mesh.GetFaceVertexCountsAttr().Get(time), np.int32)
    indices = numbers_of(mesh.GetFaceVertexIndicesAttr().Get(time), np.int32)
    problem = ""
    if len(points) == 0 or len(counts) == 0:
        problem = f"is empty ({len(points)} points, {len(counts)} faces)"
    elif not np.isfinite(points).all():
        problem = f"has {int((~np.isfinite(points)).any(axis=1).sum())} NaN or infinite points"
    elif (counts < 3).any():
        problem = f"has a face of {int(counts.min())} corners"
    elif counts.sum() != len(indices):
        problem = f"has {len(indices)} corners where its faces need {counts.sum()}"
    elif indices.min() < 0 or indices.max() >= len(points):
        problem = f"has corners that point outside its {len(points)} points"
    if problem:
        raise InputRefused(
            f"{path}: <{mesh.GetPath()}> {problem}. Repair or remove it, and export again. "
            "[mesh.topology]"
        )
    return points, counts, indices


def numbers_of(value: Any, kind: Any, width: int = 1) -> Any:
    """An attribute's value as an array, (N,) or (N, width); an empty one where a file has given it
    another type, or numbers that ``kind`` cannot hold."""
    shape = (-1,) if width == 1 else (-1, width)
    none = np.zeros(0, kind).reshape(shape)
    try:
        stored = np.array(none if value is None else value)
        fits = stored.ndim == 1 and stored.size % width == 0
        fits |= stored.ndim == 2 and stored.shape[1] == width > 1
        if not fits or stored.dtype.kind not in "buif":
            return none
        whole = np.dtype(kind).kind == "i" and stored.size > 0
        limits = np.iinfo(kind) if whole else None
        if limits and not (limits.min <= stored.min() and stored.max() <= limits.max):
            return none
        return stored.astype(kind).reshape(shape)
    except (TypeError, ValueError, OverflowError):
        return none


def _vectors(value: Any) -> Double:
    """(N, 3) of an attribute's value."""
    return np.asarray(numbers_of(value, np.float64, 3))


def _authored_normals(
    mesh: Any, fans: Triangulation, num_points: int, num_faces: int, num_corners: int, time: Any
) -> Double | None:
    """(T, 3, 3) normals of the triangles' corners in the mesh's frame, or None.

    ``primvars:normals`` comes before ``normals``. A value of the wrong length counts as none.
    """
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasAuthoredValue():
        values, interpolation = primvar.ComputeFlattened(time), primvar.GetInterpolation()
    else:
        values, interpolation = mesh.GetNormalsAttr().Get(time), mesh.GetNormalsInterpolation()
    normals = _vectors(values)
    expected = {"constant": 1, "uniform": num_faces, "vertex": num_points, "varying": num_points}
    expected["faceVarying"] = num_corners
    if len(normals) != expected.get(interpolation, -1):
        return None
    return np.asarray(normals[fans.element_of_corner(interpolation)], np.float64)
