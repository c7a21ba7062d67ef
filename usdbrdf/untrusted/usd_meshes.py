"""Meshes of a USD file that somebody else made, as one soup; read in a child process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pxr import Tf, Usd, UsdGeom, UsdSkel

from usdbrdf.errors import InputRefused
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.job.child import run_child
from usdbrdf.model.arrays import Double, Float, Int
from usdbrdf.model.mesh import ScanMesh, Triangulation, triangulate
from usdbrdf.untrusted.usd_paths import check_asset_paths


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


# A stage of tens of millions of triangles opens in seconds; what takes longer hangs.
_TIMEOUT_S = 600.0

_MEMORY_BYTES = 64 << 30  # of addresses; a small crafted file may ask for any number of points


@dataclass(frozen=True, kw_only=True)
class UsdMeshes:
    """The captured surface as a USD file holds it, in the file's own units.

    mesh                       world transforms applied
    labels                     per object, the mesh's display name or its own
    object_prims               per object, its path below the default prim ("." is the prim itself)
    meters_per_unit, up_axis   of the stage
    warnings                   sentences about what was left out or simplified
    """

    mesh: ScanMesh
    labels: tuple[str, ...]
    object_prims: tuple[str, ...]
    meters_per_unit: float
    up_axis: str
    warnings: tuple[str, ...]


def meshes_from_usd(
    path: Path, *, crease_angle_deg: float = 40.0, allow: Sequence[Path] = ()
) -> UsdMeshes:
    """Every visible mesh below the default prim, one object each; instances count one by one.

    crease_angle_deg  for meshes without authored normals
    allow             folders outside the file's own that its asset paths may lead into
    """
    found = run_child(
        "usdbrdf.untrusted.usd_meshes:read_in_child",
        {},
        {"path": str(path.resolve()), "allow": [str(folder.resolve()) for folder in allow]},
        _TIMEOUT_S,
        f"{path}: reading USD",
        memory_limit_bytes=_MEMORY_BYTES,
    )
    points, triangles = found["points"], found["triangles"]
    normals = found["corner_normals"]
    missing = np.isnan(normals[:, 0, 0])
    if missing.any():
        normals[missing] = corner_normals(points, triangles[missing], crease_angle_deg)
    return UsdMeshes(
        mesh=ScanMesh(
            points=points,
            triangles=triangles,
            corner_normals=normals,
            face_object=found["face_object"],
        ),
        labels=tuple(found["labels"].tolist()),
        object_prims=tuple(found["prims"].tolist()),
        meters_per_unit=float(found["meters_per_unit"]),
        up_axis=str(found["up_axis"]),
        warnings=tuple(found["warnings"].tolist()),
    )


def read_in_child(
    arrays: Mapping[str, npt.NDArray[Any]], parameters: Mapping[str, Any]
) -> dict[str, npt.NDArray[Any]]:
    """The child's part: check the asset paths, open the stage, gather its meshes."""
    path = Path(parameters["path"])
    check_asset_paths(path, [Path(folder) for folder in parameters["allow"]])
    stage = _opened(path)
    root = stage.GetDefaultPrim()  # valid only as long as the stage is held
    time = Usd.TimeCode.EarliestTime()
    transforms = UsdGeom.XformCache(time)
    meshes, warnings = _meshes_below(root, path)
    parts = []
    for mesh in meshes:
        matrix = np.array(transforms.GetLocalToWorldTransform(mesh.GetPrim()), np.float64)
        parts.append(_world_part(mesh, matrix, time, path))
    firsts = np.cumsum([0, *[len(points) for points, _, _ in parts]])
    prims = [mesh.GetPrim() for mesh in meshes]
    return {
        "points": np.concatenate([points for points, _, _ in parts]),
        "triangles": np.concatenate(
            [triangles + firsts[i] for i, (_, triangles, _) in enumerate(parts)], dtype=np.int32
        ),
        "corner_normals": np.concatenate([normals for _, _, normals in parts]),
        "face_object": np.repeat(
            np.arange(len(parts), dtype=np.int32), [len(triangles) for _, triangles, _ in parts]
        ),
        "labels": np.array([prim.GetDisplayName() or prim.GetName() for prim in prims]),
        "prims": np.array([str(p.GetPath().MakeRelativePath(root.GetPath())) for p in prims]),
        "meters_per_unit": np.array(UsdGeom.GetStageMetersPerUnit(stage)),
        "up_axis": np.array(str(UsdGeom.GetStageUpAxis(stage))),
        "warnings": np.array(warnings, dtype=np.str_),
    }


def _opened(path: Path) -> Any:
    """The composed stage, which has a default prim."""
    try:
        stage = Usd.Stage.Open(str(path), Usd.Stage.LoadAll)
        problems = [str(problem) for problem in stage.GetCompositionErrors()]
    except Tf.ErrorException as error:
        raise InputRefused(
            f"{path}: USD cannot open it ({' '.join(str(error).split())[:200]}). Export it again. "
            "[stage.input]"
        ) from error
    if problems:
        raise InputRefused(
            f"{path}: the stage does not compose: {' '.join(problems[0].split())[:300]}. Bring "
            "the missing layers along, or flatten it. [stage.input]"
        )
    if not stage.GetDefaultPrim():
        raise InputRefused(
            f"{path}: the stage has no default prim, so nothing can refer to it. Set defaultPrim "
            "in the file. [stage.default_prim]"
        )
    return stage


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
        if not _is_visible(prim):
            hidden += 1
        elif prim.IsA(UsdGeom.Mesh):
            meshes.append(UsdGeom.Mesh(prim))
        else:
            other.append(f"<{prim.GetPath()}> ({prim.GetTypeName()})")
    if not meshes:
        raise InputRefused(
            f"{path}: no visible mesh below <{root.GetPath()}>. Export the surface as meshes "
            "inside the default prim. [mesh.empty]"
        )
    return meshes, _warnings(path.name, root, meshes, other, hidden)


def _warnings(
    name: str, root: Any, meshes: Sequence[Any], other: Sequence[str], hidden: int
) -> list[str]:
    """What a file's meshes lose on the way, and what else it holds: prims of other types, and the
    number of hidden ones."""
    warnings = []
    if other:
        warnings.append(
            f"{name}: {len(other)} prims are not meshes and are ignored, first {other[0]}. "
            "[stage.not_mesh]"
        )
    schemes = [mesh.GetSubdivisionSchemeAttr().Get() for mesh in meshes]
    cages = sum(scheme != UsdGeom.Tokens.none for scheme in schemes)
    if cages:
        warnings.append(
            f"{name}: {cages} meshes are subdivision cages (what USD assumes where no scheme "
            "is set); the cage is taken as the surface. [stage.subdivision]"
        )
    moving = [mesh for mesh in meshes if _is_moving(mesh, root)]
    if moving:
        warnings.append(
            f"{name}: {len(moving)} meshes move or change with time, first "
            f"<{moving[0].GetPath()}>; each is taken, and stays, as its first time sample has it. "
            "The photographs must show that state. [stage.animated]"
        )
    skinned = sum(mesh.GetPrim().HasAPI(UsdSkel.BindingAPI) for mesh in meshes)
    if skinned:
        warnings.append(
            f"{name}: {skinned} meshes may be bound to a skeleton, which is not applied: they "
            "are taken in their rest pose. Bake the pose that the photographs show. "
            "[stage.skinned]"
        )
    if hidden:
        warnings.append(f"{name}: {hidden} invisible or guide prims are left out. [stage.hidden]")
    return warnings


def _is_moving(mesh: Any, root: Any) -> bool:
    prim, chain = mesh.GetPrim(), []
    while prim and prim.GetPath().HasPrefix(root.GetPath()):
        chain.append(prim)
        prim = prim.GetParent()
    return is_deforming(mesh) or any(is_moving(prim) for prim in chain)


def _is_visible(prim: Any) -> bool:
    imageable = UsdGeom.Imageable(prim)
    time = Usd.TimeCode.EarliestTime()
    return bool(
        imageable.ComputeVisibility(time) != UsdGeom.Tokens.invisible
        and imageable.ComputePurpose() not in (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide)
    )


def _world_part(mesh: Any, matrix: Double, time: Any, path: Path) -> tuple[Float, Int, Float]:
    """One mesh in the world: points, triangles, corner normals (NaN where none are authored).

    matrix is USD's, for row vectors: p_world = p @ matrix.
    """
    points, counts, indices = _topology(mesh, time, path)
    mirrored = bool(np.linalg.det(matrix[:3, :3]) < 0)
    left_handed = mesh.GetOrientationAttr().Get(time) == UsdGeom.Tokens.leftHanded
    holes = np.array(mesh.GetHoleIndicesAttr().Get(time) or [], np.int32)
    fans = triangulate(counts, indices, left_handed=left_handed != mirrored, holes=holes)
    world = points @ matrix[:3, :3] + matrix[3, :3]
    normals = np.full((len(fans.triangles), 3, 3), np.nan, np.float32)
    local = _authored_normals(mesh, fans, len(points), len(counts), len(indices), time)
    if local is not None and abs(np.linalg.det(matrix[:3, :3])) > 0:
        turned = local @ np.linalg.inv(matrix[:3, :3]).T
        size = np.linalg.norm(turned, axis=2, keepdims=True)
        if np.isfinite(turned).all() and (size > 0).all():
            normals = (turned / size).astype(np.float32)
    return world.astype(np.float32), fans.triangles, normals


def _topology(mesh: Any, time: Any, path: Path) -> tuple[Double, Int, Int]:
    """Points (V, 3), corners per polygon, point of each corner; InputRefused if they disagree.

    Nothing can be repaired here: the file is referenced, and the asset must mean the same mesh.
    """
    points = np.array(mesh.GetPointsAttr().Get(time) or [], np.float64).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or [], np.int32)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or [], np.int32)
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
    normals = np.array(values if values is not None else [], np.float64).reshape(-1, 3)
    tokens = UsdGeom.Tokens
    triangles_in: dict[str, tuple[int, npt.NDArray[Any]]] = {
        tokens.constant: (1, np.zeros_like(fans.triangles)),
        tokens.uniform: (num_faces, np.repeat(fans.polygon[:, None], 3, axis=1)),
        tokens.vertex: (num_points, fans.triangles),
        tokens.varying: (num_points, fans.triangles),
        tokens.faceVarying: (num_corners, fans.corners),
    }
    expected, where = triangles_in.get(interpolation, (-1, fans.triangles))
    return normals[where] if len(normals) == expected else None
