"""Meshes of PLY, OBJ and GLB files, vertex by vertex as they are stored."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.exchange.obj import load_obj
from trimesh.exchange.ply import load_ply

from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.model.arrays import Bool, Float, Int

SUFFIXES = (".ply", ".obj", ".glb")

# The face property by which the objects of a segmented PLY are told apart.
LABEL_PROPERTY = "object_id"

_MAX_TRIANGLES = 50_000_000

_MAX_COORDINATE = 1e6

_MIN_DIAGONAL = 1e-4

# Faces with broken corners below this share are removed; above it the file is not what it says.
_MAX_BROKEN_SHARE = 0.01


@dataclass(frozen=True, kw_only=True)
class FileMesh:
    """A mesh as the file tells it, triangulated.

    points       (V, 3) float32, scene units
    triangles    (F, 3) int32 inside [0, V)
    face_label   (F,) int64 the file's own object numbers, or None
    label_names  the file's names of these numbers, where it has names
    kept         (triangles of the file,) bool: False where a triangle was left out because of
                 non-finite vertices or indices out of range; None where nothing was
    """

    points: Float
    triangles: Int
    face_label: npt.NDArray[np.int64] | None = None
    label_names: dict[int, str]
    kept: Bool | None = None


def mesh_from_file(path: Path) -> FileMesh:
    """Read and check a mesh; vertices are neither merged, reordered nor moved.

    Quads become two triangles each, in place, and hand their label to both.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputRefused(
            f"{path}: meshes are read from {', '.join(SUFFIXES)}. Convert it to PLY. [mesh.format]"
        )
    if not path.is_file():
        what = "is not a regular file" if path.exists() else "does not exist"
        raise InputRefused(
            f"{path}: this mesh {what}. Name the mesh with --mesh, or put mesh.ply beside the "
            "poses. [mesh.missing]"
        )
    try:
        with path.open("rb") as file:
            mesh = _READERS[path.suffix.lower()](file)
    except InputRefused:
        raise
    except OSError as error:
        raise EnvironmentFailure(f"{path}: cannot be read ({error}). [mesh.read]") from error
    except MemoryError as error:
        raise EnvironmentFailure(f"{path}: not enough memory to read it. [mesh.memory]") from error
    # The readers raise whatever a damaged file makes them stumble over.
    except Exception as error:
        raise InputRefused(
            f"{path}: damaged or no {path.suffix[1:].upper()} mesh ({_one_line(error)}). "
            "Export it again; a face must have three or four corners. [mesh.read]"
        ) from error
    return checked_mesh(mesh, path)


def checked_mesh(mesh: FileMesh, path: Path) -> FileMesh:
    """The mesh without its few broken faces, or InputRefused; Embree would not complain."""
    if len(mesh.triangles) == 0 or len(mesh.points) == 0:
        raise InputRefused(
            f"{path}: the mesh is empty ({len(mesh.points)} vertices, {len(mesh.triangles)} "
            "faces). Export the surface, not the point cloud. [mesh.empty]"
        )
    if len(mesh.triangles) > _MAX_TRIANGLES:
        raise InputRefused(
            f"{path}: {len(mesh.triangles)} triangles (limit {_MAX_TRIANGLES}). "
            "Reduce the mesh before ingest. [mesh.size]"
        )
    inside = np.asarray(
        ((mesh.triangles >= 0) & (mesh.triangles < len(mesh.points))).all(axis=1), np.bool_
    )
    _refuse_if_many(path, ~inside, "point to vertices that do not exist", "mesh.index")
    finite = np.asarray(np.isfinite(mesh.points).all(axis=1), np.bool_)
    whole = inside.copy()
    whole[inside] = finite[mesh.triangles[inside]].all(axis=1)
    _refuse_if_many(path, inside & ~whole, "have NaN or infinite corners", "mesh.nonfinite")
    triangles = mesh.triangles[whole]
    used = mesh.points[np.unique(triangles)].astype(np.float64)
    if np.abs(used).max() > _MAX_COORDINATE:
        raise InputRefused(
            f"{path}: coordinates reach {np.abs(used).max():.3g} (limit {_MAX_COORDINATE:g}). "
            "Move the scan to the origin, or check its unit. [mesh.far]"
        )
    diagonal = float(np.linalg.norm(np.ptp(used, axis=0)))
    if diagonal < _MIN_DIAGONAL:
        raise InputRefused(
            f"{path}: the whole mesh is {diagonal:.3g} across (limit {_MIN_DIAGONAL:g}). "
            "Check its unit. [mesh.tiny]"
        )
    return replace(
        mesh,
        # Vertices of no face keep their place, but no NaN may travel on.
        points=np.where(finite[:, None], mesh.points, np.float32(0)),
        triangles=triangles,
        face_label=None if mesh.face_label is None else mesh.face_label[whole],
        kept=None if whole.all() else whole,
    )


def _refuse_if_many(path: Path, broken: Bool, what: str, rule: str) -> None:
    share = float(broken.mean())
    if share >= _MAX_BROKEN_SHARE:
        raise InputRefused(
            f"{path}: {int(broken.sum())} of {len(broken)} faces ({share:.1%}, limit "
            f"{_MAX_BROKEN_SHARE:.0%}) {what}. Export the mesh again. [{rule}]"
        )


def _one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:160]}"


def _mesh_from_ply(file: BinaryIO) -> FileMesh:
    arrays: dict[str, Any] = load_ply(file)
    elements = arrays["metadata"]["_ply_raw"]
    if "vertices" not in arrays or arrays.get("faces") is None:
        return _no_faces(len(arrays.get("vertices", ())))
    data = elements["face"]["data"]
    stored = np.asarray(arrays["faces"])
    names = data.keys() if isinstance(data, dict) else data.dtype.names
    label = None
    if LABEL_PROPERTY in names:
        label = np.asarray(data[LABEL_PROPERTY]).reshape(-1).astype(np.int64)
    expected = {name: int(elements[name]["length"]) for name in ("vertex", "face")}
    # An ASCII file that ends early reads as a shorter one.
    if len(arrays["vertices"]) != expected["vertex"] or len(_rows(data)) != expected["face"]:
        raise ValueError(f"the header announces {expected}, the file holds less")
    if label is not None and len(label) != len(stored):
        raise ValueError("labelled faces must all have the same number of corners")
    return _file_mesh(arrays["vertices"], stored, label, {})


def _rows(data: Any) -> Any:
    """One column of a PLY element, whose length is the number of the element's rows."""
    return next(iter(data.values())) if isinstance(data, dict) else data


def _mesh_from_obj(file: BinaryIO) -> FileMesh:
    loaded: dict[str, Any] = load_obj(
        file, skip_materials=True, maintain_order=True, split_objects=True
    )
    parts = loaded.get("geometry", {})
    return _joined([(name, p["vertices"], p["faces"]) for name, p in parts.items()])


def _mesh_from_glb(file: BinaryIO) -> FileMesh:
    scene = trimesh.load_scene(file, file_type="glb", process=False)
    parts = []
    for node in sorted(scene.graph.nodes_geometry):
        world_from_node, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh):
            points = trimesh.transform_points(mesh.vertices, world_from_node)
            # A mirroring transform would turn the surface inside out.
            order = [0, 2, 1] if np.linalg.det(world_from_node[:3, :3]) < 0 else [0, 1, 2]
            parts.append((str(node), points, np.asarray(mesh.faces)[:, order]))
    return _joined(parts)


def _joined(parts: list[tuple[str, Any, Any]]) -> FileMesh:
    """Named parts of one file in one soup; they become labels where there is more than one."""
    if not parts:
        return _no_faces(0)
    firsts = np.cumsum([0, *[len(points) for _, points, _ in parts]])
    faces = [np.asarray(f) + firsts[i] for i, (_, _, f) in enumerate(parts)]
    label = np.repeat(np.arange(len(parts)), [len(f) for f in faces])
    names = {i: name for i, (name, _, _) in enumerate(parts)}
    points = np.concatenate([np.asarray(points) for _, points, _ in parts])
    if len(parts) == 1:
        return _file_mesh(points, faces[0], None, {})
    return _file_mesh(points, np.concatenate(faces), label.astype(np.int64), names)


def _file_mesh(points: Any, faces: Any, label: Any, names: dict[int, str]) -> FileMesh:
    polygons = np.asarray(faces, np.int64)
    if polygons.ndim != 2 or polygons.shape[1] not in (3, 4):
        raise ValueError(f"faces have the shape {polygons.shape}")
    if polygons.shape[1] == 4:
        polygons = polygons[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
        label = None if label is None else np.repeat(label, 2)
    # Unsigned indices beyond int32 must not wrap round to valid ones.
    polygons = np.where(polygons > np.iinfo(np.int32).max, -1, polygons)
    return FileMesh(
        points=np.ascontiguousarray(points, np.float32).reshape(-1, 3),
        triangles=np.ascontiguousarray(polygons, np.int32),
        face_label=label,
        label_names=names,
    )


def _no_faces(vertices: int) -> FileMesh:
    return FileMesh(
        points=np.zeros((vertices, 3), np.float32),
        triangles=np.zeros((0, 3), np.int32),
        label_names={},
    )


_READERS = {
    ".ply": _mesh_from_ply,
    ".obj": _mesh_from_obj,
    ".glb": _mesh_from_glb,
}
