"""USD files that somebody else made: their asset paths, checked before anything is composed, their
meshes as one soup, and whatever a reader makes of them; all read in child processes.

USD follows absolute paths, ``../`` and links without a question, wherever they lead.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils, Vt

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
from usdbrdf.untrusted.bounds import LIMITS, read_in_child

USD_SUFFIXES = frozenset({".usd", ".usda", ".usdc", ".usdz"})
_MAX_LAYERS = 1000
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
    with _usd_errors(path):
        layers = check_asset_paths(path, allowed)
        if reader == "layers":
            return tuple(layers)
        stage = Usd.Stage.Open(str(path), Usd.Stage.LoadAll)
        problems = stage.GetCompositionErrors()
        if problems:
            raise InputRefused(
                f"{path}: the stage does not compose: {_one_line(problems[0])}. Bring the missing "
                "layers along, or flatten it. [stage.input]"
            )
        if reader in ("meshes", "parts"):
            return _meshes(stage, path, subsets=reader == "parts")
        check_units(stage, path)
        module, _, name = reader.partition(":")
        return getattr(import_module(module), name)(path)


@contextmanager
def _usd_errors(path: Path) -> Iterator[None]:
    """USD's own errors become InputRefused, and text of the file that Python cannot hold."""
    try:
        yield
    except UnicodeDecodeError as error:
        shown = repr(error.object[max(error.start - 20, 0) : error.start + 20])
        raise InputRefused(
            f"{path}: a name or a path in it is not UTF-8 ({shown}), so no program can be told of "
            "it. Rename it, or export the file again. [stage.input]"
        ) from error
    except Tf.ErrorException as error:
        raise InputRefused(
            f"{path}: USD cannot read it ({_one_line(error)}). Export it again. [stage.input]"
        ) from error


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
            values = values if isinstance(values, Vt.TokenArray) else ()
            found += [(words[-1] not in ("class", "category"), str(value)) for value in values]
        elif words[0] == "semantic" and words[-1] == "semanticData":
            kind = prim.GetAttribute(":".join([*words[:-1], "semanticType"]))
            found += [(not kind or kind.Get() != "class", str(attribute.Get()))]
    return [label for _, label in sorted(found, key=lambda entry: entry[0]) if label]


def check_asset_paths(path: Path, allowed: Sequence[str]) -> list[Path]:
    """The layers that ``path`` reaches, itself first; InputRefused unless every path in them stays
    in one of the ``allowed`` folders, which are absolute and without links.

    Layers, references, payloads, of every variant, and asset-valued attributes count, in packages
    too; links are judged by where they lead. What a crafted crate file does to USD's own reader is
    not caught here: call this in a child process.
    """
    waiting, seen, total = [str(path.resolve())], list[str](), 0
    while waiting:
        layer = waiting.pop()
        if layer in seen:
            continue
        seen.append(layer)
        total += 0 if Ar.IsPackageRelativePath(layer) else Path(layer).stat().st_size
        if len(seen) > _MAX_LAYERS or total > LIMITS["stage"].file_bytes:
            raise InputRefused(
                f"{path}: more than {_MAX_LAYERS} layers or {LIMITS['stage'].file_bytes} bytes of "
                "layers. Flatten the stage, or name the part that was captured. [stage.input_size]"
            )
        waiting += _layers_in_package(layer)
        with _usd_errors(Path(layer)):
            opened = Sdf.Layer.FindOrOpen(layer)
            found = UsdUtils.ExtractExternalReferences(layer)
            if opened and opened.HasExpressionVariables():
                # Which value counts depends on the layer that composes this one.
                raise InputRefused(
                    f"{layer}: its asset paths may hold variables (expressionVariables), so that "
                    "nobody can say where they lead. Flatten the stage. [paths.variables]"
                )
        for reference in sorted({reference for kind in found for reference in kind if reference}):
            if Ar.IsPackageRelativePath(layer):
                _refuse_leaving_package(layer, reference)
                continue
            target = _target(Path(layer), reference, allowed)
            if target.suffix.lower() in USD_SUFFIXES and target.is_file():
                waiting.append(str(target))
    return [Path(layer) for layer in seen if not Ar.IsPackageRelativePath(layer)]


def _layers_in_package(layer: str) -> list[str]:
    """The layers in a USDZ, which may itself lie in one; none in other layers."""
    name = Ar.SplitPackageRelativePathInner(layer)[1] or layer
    if not name.lower().endswith(".usdz"):
        return []
    with _usd_errors(Path(layer)):
        package = Sdf.ZipFile.Open(layer)
    names = package.GetFileNames() if package else ()
    for name in names:
        if name.startswith(("/", "\\")) or ".." in Path(name).parts:
            raise _outside(layer, name, "is an entry that leaves the package")
    inside = [name for name in names if Path(name).suffix.lower() in USD_SUFFIXES]
    return [Ar.JoinPackageRelativePath(layer, name) for name in inside]


def _refuse_leaving_package(layer: str, reference: str) -> None:
    """InputRefused where a layer in a package refers to anything but what lies in there with it:
    nothing else is found, but for absolute paths."""
    name = Ar.SplitPackageRelativePathOuter(reference)[0]
    if os.path.isabs(name) or "://" in name or name.startswith("\\"):
        raise _outside(layer, reference, "is no path in the package")


def _target(layer: Path, reference: str, allowed: Sequence[str]) -> Path:
    name = reference
    if Ar.IsPackageRelativePath(name):
        name = Ar.SplitPackageRelativePathOuter(name)[0]
    if "://" in name or name.startswith(("\\\\", "//")):
        raise _outside(layer, reference, "is a URI")
    if os.path.isabs(name):
        raise _outside(layer, reference, "is an absolute path")
    name = name.partition(":SDF_FORMAT_ARGS:")[0]
    target = Path(os.path.realpath(layer.parent / name))
    if not any(target.is_relative_to(folder) for folder in allowed):
        raise _outside(layer, reference, "leads outside the capture")
    return target


def _outside(layer: Path | str, reference: str, reason: str) -> InputRefused:
    return InputRefused(
        f"{layer}: the asset path {reference[:200]!r} {reason}. Keep what belongs to the stage "
        "beside it and name it by relative paths. [paths.outside]"
    )


def _one_line(error: object) -> str:
    return " ".join(words_of(error).split())[:300]


def words_of(error: object) -> str:
    """What an error of USD says, which may quote bytes of a file that are no text."""
    try:
        return str(getattr(error, "commentary", error))
    except UnicodeDecodeError as undecoded:
        return undecoded.object.decode("utf-8", "replace")


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
    """InputRefused where a mesh of a stage, hidden or not, has faces that its points do not fit."""
    stage, time = Usd.Stage.Open(str(path), Usd.Stage.LoadAll), Usd.TimeCode.EarliestTime()
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)):
        if prim.IsA(UsdGeom.Mesh):
            _topology(UsdGeom.Mesh(prim), time, path)


def _meshes_below(root: Any, path: Path) -> tuple[list[Any], list[str]]:
    """Visible meshes in the order of the stage, and sentences about the rest."""
    meshes, other, hidden = [], [], 0
    for prim in Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)):
        if prim.IsA(UsdGeom.PointInstancer):
            raise InputRefused(
                f"{path}: <{prim.GetPath()}> is a point instancer, whose copies cannot carry "
                "materials of their own. Bake it to meshes. [stage.instancer]"
            )
        if not prim.IsA(UsdGeom.Gprim):
            continue
        shape = UsdGeom.Imageable(prim)
        shown = shape.ComputeVisibility(Usd.TimeCode.EarliestTime()) != UsdGeom.Tokens.invisible
        if not shown or shape.ComputePurpose() in (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide):
            hidden += 1
        elif prim.IsA(UsdGeom.Mesh):
            meshes.append(UsdGeom.Mesh(prim))
        else:
            other.append(f"<{prim.GetPath()}> ({prim.GetTypeName()})")
    if not meshes:
        raise InputRefused(
            f"{path}: no visible mesh below <{root.GetPath()}>. Export the surface as meshes "
            "inside the default prim, or name a mesh with --mesh. [mesh.empty]"
        )
    return meshes, _warnings(path.name, root, meshes, other, hidden)


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
    fans = triangulate(counts, indices, left_handed=left_handed != mirrored, holes=holes)
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


def numbers_of(value: Any, kind: Any) -> Any:
    """An attribute's value as an array; an empty one where a file has given it another type."""
    try:
        return np.array([] if value is None else value, kind)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0, kind)


def _vectors(value: Any) -> Double:
    """(N, 3); none where the numbers are no multiple of three."""
    numbers = numbers_of(value, np.float64)
    return np.asarray(numbers.reshape(-1, 3) if numbers.size % 3 == 0 else np.zeros((0, 3)))


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
