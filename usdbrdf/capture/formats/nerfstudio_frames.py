"""The frames of nerfstudio: that of transforms.json, and the one that it trains in, in which the
meshes lie that it exports (``ns-export``); and that of the meshes of instant-ngp.

``dataparser_transforms.json`` of a training says how its frame follows: a ``transform`` from the
world before ``applied_transform``, and a ``scale``. It lies beside the training's config.yml, not
beside the mesh, so it has to be brought there.

instant-ngp scales and moves the world, and turns its axes in a circle (x, y, z are y, z, x of the
document); its meshes have scale and offset undone, but neither the turn nor, in the offset, its
order (nerf_loader.h, marching_cubes.cu).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

import numpy as np

from usdbrdf.capture.checks import Findings
from usdbrdf.capture.conventions import OLD_NERFSTUDIO, are_said_to_be_opencvs, opengl_from_opencv
from usdbrdf.capture.formats.colmap import world_from_camera
from usdbrdf.capture.mesh_frames import Lies, lies_with_points, moved_geometry
from usdbrdf.capture.rigid_poses import LARGEST_OF_POSE, is_camera_matrix, rigid_pose
from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files.documents import read_json
from usdbrdf.files.tables import beginning_of, numbers_among
from usdbrdf.model.arrays import Double
from usdbrdf.model.mesh import ScanGeometry
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.colmap_models import colmap_model, model_files
from usdbrdf.untrusted.mesh_files import SUFFIXES as MESH_SUFFIXES
from usdbrdf.untrusted.usd_paths import USD_SUFFIXES

FILE = "dataparser_transforms.json"
# What MapAnything's data call what was done to poses, whatever it was.
_OF_WAI = ("_applied_transform", "_applied_transformation")
# What its exporters call their meshes, but for mesh.obj, which anybody's may be called.
EXPORTED = ("poisson_mesh.ply", "tsdf_mesh.ply", "sdf_marching_cubes_mesh.ply")
# ScanNet++'s keys for the frames it tests with, and of one that is blurred.
TESTED, BAD = "test_frames", "is_bad"
# Folder of the reconstruction that old documents were made of.
_COLMAP = "colmap/sparse/0"
# What COLMAP calls its meshes, and where its models lie that documents were made of, instant-ngp's
# first.
_COLMAPS = ("meshed-poisson.ply", "meshed-delaunay.ply")
_OF_NGP_MODELS = ("colmap_sparse", "colmap_text")
_MODELS = ("colmap_sparse/0", "colmap_text", "colmap/sparse/0", "sparse/0", "sparse")
# Of the cameras' spread, and of rotations: by how much two poses of one camera may differ; what is
# less than the rounding of who writes few digits is no other frame.
_SAME_CAMERA, _SAME_FRAME = 1e-2, 1e-4
_LARGEST = 1e9  # number that makes sense in a matrix
# By which instant-ngp's meshes are known, PLY and OBJ; what it takes where a document says nothing.
_OF_NGP = (b"output from https://github.com/NVlabs/instant-ngp", b"mtllib nerf.mtl")
_NGP_SCALE, _NGP_OFFSET = 0.33, 0.5
_NGP_AXES = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, kw_only=True)
class Applied:
    """How the world of transforms.json follows from that in which the mesh was made.

    matrix  (4, 4) rigid: applied_transform
    scale   by which it was made larger then: applied_scale
    """

    matrix: Double
    scale: float

    @property
    def similarity(self) -> Double:
        """(4, 4) from the one to the other."""
        enlarged = np.diag([self.scale] * 3 + [1.0])
        return np.asarray(enlarged @ self.matrix, np.float64)

    def undone(self, pose: Double) -> Double:
        """A pose (4, 4) of the document before that."""
        found = pose.copy()
        found[:3, 3] /= self.scale
        return np.asarray(np.linalg.inv(self.matrix) @ found, np.float64)


def is_bad(frame: Mapping[str, Any]) -> bool:
    """Whether ScanNet++ says of a frame that it is blurred."""
    return frame.get(BAD) is True


def warn_of_bad(left: int, total: int, document: str, findings: Findings) -> None:
    """One sentence on the frames of a document that are left out as it says that they are bad."""
    if left:
        findings.count("frames_said_to_be_bad", left)
        findings.warn(
            f"{document}: {left} of {total} frames are left out, of which it says {BAD}. "
            "[capture.image]"
        )


def stated_pose(matrix: object) -> Double | None:
    """(4, 4) of 3 or 4 rows, or of their numbers in one list; None where they are no numbers that a
    pose may have."""
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    if pose.shape in ((12,), (16,)):
        pose = pose.reshape(-1, 4)
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0.0, 0, 0, 1]])
    return pose if pose.shape == (4, 4) and (np.abs(pose) <= LARGEST_OF_POSE).all() else None


def warn_of_moved_by_wai(document: Mapping[str, Any], source: Path, findings: Findings) -> None:
    """One sentence where a document of MapAnything's data (WAI) says that its poses were moved, by
    what may be the cameras' axes, a turn of the pictures, or of the world."""
    for key in _OF_WAI:
        stated = document.get(key, np.eye(4).tolist())
        moved, turned = stated_pose(stated), opengl_from_opencv(np.eye(4))
        plain = moved is not None and any(np.allclose(moved, m) for m in (np.eye(4), turned))
        if not plain and stated != np.eye(3).tolist():
            findings.warn(
                f"{source.name}: {key} says that its poses were moved, and does not say whether in "
                "the world; the mesh is taken to lie in the frame of the poses as they are. If it "
                "was made before, call the matrix applied_transform, which is undone. [mesh.frame]"
            )


def rolling_shutter(holder: Mapping[str, Any]) -> list[Any]:
    """What instant-ngp's rolling_shutter says, times of which each is 0 where there is none."""
    stated = holder.get("rolling_shutter")
    return stated if isinstance(stated, list) else [stated]


def camera_axes(document: Mapping[str, Any]) -> Double:
    """(4, 4) by which the document's cameras become OpenGL's: those that instant-ngp knows as
    Mitsuba's have x to the left and look down +z (nerf_matrix_to_ngp); others may be stated."""
    if _is_mitsubas(document):
        return np.diag([-1.0, 1, -1, 1])
    return opengl_from_opencv(np.eye(4)) if are_said_to_be_opencvs(document) else np.eye(4)


def _is_mitsubas(document: Mapping[str, Any]) -> bool:
    """Whether instant-ngp takes the document's axes for Mitsuba's, and leaves those of the world as
    they are."""
    return document.get("from_mitsuba") is True or "normal_mts_args" in document


def rigid_matrix(stated: object) -> Double | None:
    """(4, 4) of what states 3 or 4 rows of it, None where it is no rotation with a translation."""
    matrix = stated_pose(stated)
    if matrix is None or not is_camera_matrix(matrix):
        return None
    turn = matrix[:3, :3]
    sound = np.abs(turn @ turn.T - np.eye(3)).max() <= 1e-3 and np.linalg.det(turn) > 0
    return matrix if sound else None


def statements_beside(mesh: Path) -> list[Path]:
    """The files that say where a mesh of nerfstudio lies, as far as they are there."""
    statement = mesh.resolve().parent / FILE
    return [statement] if statement.is_file() else []


def geometry_at_home(
    mesh: Path,
    read: Callable[[CaptureOptions], ScanGeometry],
    options: CaptureOptions,
    findings: Findings,
    applied: Applied,
    document: Mapping[str, Any],
    *,
    folder: Path,
    meters_per_unit: float,
) -> ScanGeometry:
    """What is read of a mesh, in the frame of the capture if it lay in that of a training on the
    document's, or of the model of COLMAP that this was made of.

    read             is given options whose unit is the mesh's own
    folder           the document's
    meters_per_unit  of the capture, unless the options say it
    """
    if any(mark in beginning_of(mesh) for mark in _OF_NGP) and not _is_mitsubas(document):
        findings.warn(
            f"{mesh.name}: is one of instant-ngp's, whose axes it turns; they are turned back. "
            "[mesh.frame]"
        )
        home = np.linalg.inv(applied.similarity) @ _document_from_ngp(mesh, document)
        return moved_geometry(read, np.asarray(home, np.float64), options, meters_per_unit)
    statements = statements_beside(mesh)
    if mesh.suffix.lower() in MESH_SUFFIXES and (mesh.name in _COLMAPS or not statements):
        known = _home_of_colmaps(mesh, folder, findings, applied)
        if known is not None:
            return moved_geometry(read, known, options, meters_per_unit)
    if statements and mesh.suffix.lower() in USD_SUFFIXES:
        raise InputRefused(
            f"{mesh}: {FILE} beside it says that it lies in the frame that nerfstudio trained in, "
            "from which USD files are not brought back. Name nerfstudio's own PLY or OBJ with "
            "--mesh, or remove that file if this one has been moved back already. [mesh.frame]"
        )
    if not statements:
        moved_away = any((folder / name).is_dir() for name in _OF_NGP_MODELS)
        if moved_away and mesh.name not in _COLMAPS:
            findings.warn(
                f"{mesh.name}: is taken to lie in the frame of the poses, which instant-ngp's "
                "colmap2nerf.py moves away from COLMAP's. If it was made of COLMAP's model, call "
                f"it {_COLMAPS[0]}, or read that with --adapter colmap. [mesh.frame]"
            )
        if mesh.name in EXPORTED:
            findings.warn(
                f"{mesh.name}: is called as nerfstudio exports its meshes, which lie in the frame "
                f"that it trained in. Put {FILE}, which lies beside the training's config.yml, "
                "beside it, unless this one has been moved back. [mesh.frame]"
            )
        return read(options)
    trained = _trained_from_capture(statements[0], applied)
    matrix = np.asarray(np.linalg.inv(trained), np.float64)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    findings.warn(
        f"{mesh.name}: {FILE} beside it says that it lies in the frame that nerfstudio trained in; "
        f"it is brought back, {scale:.3g} times as large. Remove that file if the mesh has been "
        "moved back already. [mesh.frame]"
    )
    return moved_geometry(read, matrix, options, meters_per_unit)


def _trained_from_capture(statement: Path, applied: Applied) -> Double:
    """(4, 4) similarity."""
    document: Any = read_json(statement)
    row: Mapping[str, Any] = document if isinstance(document, dict) else {}
    matrix, scale = rigid_matrix(row.get("transform")), numbers_among(row.get("scale"), 1)
    if matrix is None or scale is None or not 1 / _LARGEST < scale[0] < _LARGEST:
        raise InputRefused(
            f"{statement}: transform is no rigid matrix of 3 x 4, or scale no positive number, so "
            "nobody knows where the mesh lies. Bring that of the training again, or remove it if "
            "the mesh lies in the frame of the poses. [mesh.frame]"
        )
    # The matrix leads from the capture's frame, but what it was found of, and moved, were the
    # document's poses, larger ones; the scale is that of both steps.
    trained = np.diag([scale[0] / applied.scale] * 3 + [1.0])
    inner = matrix @ np.linalg.inv(applied.matrix)
    return np.asarray(trained @ inner @ applied.similarity, np.float64)


def _home_of_colmaps(
    mesh: Path, folder: Path, findings: Findings, applied: Applied
) -> Double | None:
    """The similarity (4, 4) to the capture's frame of a mesh beside a model of COLMAP: from the
    model's if it lies as the points of that do, none if it lies where the cameras take these. Where
    they do not tell, its name does; None where that does not either. Of a model in the capture's
    frame: from the document's, if it lies where what was applied takes the points."""
    of_colmap = mesh.name in _COLMAPS
    found = _capture_from_colmap(mesh, folder, findings, tells=of_colmap)
    if found is None:
        return None
    model, moved = found
    name = model.relative_to(folder).as_posix()
    if np.array_equal(moved, np.eye(4)):
        stored = applied.similarity
        if np.array_equal(stored, np.eye(4)):
            return None
        lies = lies_with_points(mesh, model, stored)
        if lies.with_points is not False:
            _warn_of_elsewhere(mesh, name, lies, findings)
            return None
        findings.warn(
            f"{mesh.name}: lies in the frame of the document's poses, by the points of the model "
            f"{name}, and applied_transform is undone of it as it is of these. [mesh.frame]"
        )
        return np.asarray(np.linalg.inv(stored), np.float64)
    lies = lies_with_points(mesh, model, moved)
    if lies.with_points is False:
        if of_colmap:
            findings.warn(
                f"{mesh.name}: is called as COLMAP's meshes, but lies in the frame of the poses "
                f"already, by the points of the model {name}; it stays there. [mesh.frame]"
            )
        return np.eye(4)
    if lies.with_points is None and not of_colmap:
        _warn_of_elsewhere(mesh, name, lies, findings)
        return None
    how = "lies" if lies.with_points else "is called as COLMAP's meshes, which lie"
    doubt = "" if lies.with_points else " Rename it if it lies there already."
    findings.warn(
        f"{mesh.name}: {how} in the frame of COLMAP's model {name}; it is brought to that of the "
        f"poses, by the cameras of both.{doubt} [mesh.frame]"
    )
    return moved


def _warn_of_elsewhere(mesh: Path, model: str, lies: Lies, findings: Findings) -> None:
    if lies.elsewhere:
        findings.warn(
            f"{mesh.name}: lies neither on the points of the model {model} nor where the poses "
            "have these, so it is but a part of what the photographs show, or lies in a frame or "
            "unit of its own. Make one of this model if it does. [mesh.frame]"
        )


def _capture_from_colmap(
    mesh: Path, folder: Path, findings: Findings, *, tells: bool
) -> tuple[Path, Double] | None:
    """The model of COLMAP beside a document, and the similarity (4, 4) from its frame to the
    capture's, the identity where they are one but for rounding; None where there is no model, or
    nobody knows as it has not the same cameras, which is told if it ``tells``."""
    models, frames = _models_beside(folder), findings.frames
    if not models or frames is None:
        return None

    def unknown(why: str) -> None:
        if not tells:
            return
        findings.warn(
            f"{mesh.name}: is called as COLMAP's meshes, but whether it lies in another frame than "
            f"the poses is not known, as {why}. [mesh.frame]"
        )

    try:
        model = colmap_model(models[0])
    except UsdBrdfError as error:
        unknown(f"its model was not read ({error})")
        return None
    theirs = _by_ends(model.names)
    pairs = [(i, _longest_end(path, theirs)) for i, path in enumerate(frames.image_paths)]
    known = [(i, k) for i, k in pairs if k is not None]
    others = f"its model {models[0].relative_to(folder).as_posix()} has not the same cameras"
    if len(known) < max(3, len(frames) / 2) or len({k for _, k in known}) < len(known):
        unknown(others)
        return None
    ours, their = (list(numbers) for numbers in zip(*known, strict=True))
    ends = frames.world_from_camera[ours]
    starts = np.stack([world_from_camera(model.camera_from_world[k]) for k in their])
    turns = ends[:, :3, :3] @ np.swapaxes(starts[:, :3, :3], 1, 2)
    left, _, right = np.linalg.svd(turns.mean(axis=0))
    turn = left @ right
    from_places, to_places = starts[:, :3, 3] @ turn.T, ends[:, :3, 3]
    from_centre, centre = from_places.mean(axis=0), to_places.mean(axis=0)
    spread = float(np.linalg.norm(to_places - centre))
    from_spread = float(np.linalg.norm(from_places - from_centre))
    if min(spread, from_spread) < 1 / _LARGEST:
        unknown("its cameras are all in one place")
        return None
    scale = spread / from_spread
    off = np.linalg.norm(scale * (from_places - from_centre) + centre - to_places, axis=1)
    if max(np.abs(turns - turn).max(), off.max() / spread) > _SAME_CAMERA:
        unknown(others)
        return None
    apart = np.linalg.norm(starts[:, :3, 3] - to_places, axis=1).max() / spread
    if max(np.abs(scale * turn - np.eye(3)).max(), apart) < _SAME_FRAME:
        return models[0], np.eye(4)
    return models[0], rigid_pose(scale * turn, centre - scale * from_centre)


def has_old_axes(
    source: Path,
    document: Mapping[str, Any],
    frames: Sequence[Mapping[str, Any]],
    findings: Findings,
    *,
    in_scene: bool,
) -> bool:
    """Whether the poses are in the axes that nerfstudio gave COLMAP's before 2023, and ScanNet++
    those of its scenes, which is told where the document does not say so."""
    beside = (source.parent / _COLMAP).is_dir()
    # Frames that are bad are no sign of ScanNet++: others flag such too.
    tested = TESTED in document
    if "applied_transform" in document or not (beside or tested or in_scene):
        return False
    axes, model = camera_axes(document), source.parent / _COLMAP
    known = _old_axes_by_model(model, frames, axes) if beside else in_scene or None
    if known is False:
        return False
    if beside:
        how = "are" if known else "are taken for"
        said = (
            f"{_COLMAP} lies beside it and it states no applied_transform, so its poses {how} "
            "those of nerfstudio before 2023, whose axes are undone"
        )
        doubt = "if they are not"
    else:
        known_by = "belongs to a scene" if in_scene else f"has {TESTED}, as documents"
        said = (
            f"{known_by} of ScanNet++{'' if in_scene else ' have'}, so its axes, which are not "
            "those of the scene's mesh, are undone"
        )
        doubt = "if the mesh has them"
    doubt = "" if known else f"; state applied_transform {doubt}"
    findings.warn(f"{source.name}: {said}{doubt}. [capture.legacy]")
    return True


def _old_axes_by_model(
    model: Path, frames: Sequence[Mapping[str, Any]], axes: Double
) -> bool | None:
    """Whether a document's poses are those of this model of COLMAP with the axes that nerfstudio
    gave them before 2023; None where the model does not tell, as it cannot be read or has not the
    same cameras."""
    if not model_files(model):
        return None
    try:
        found = colmap_model(model)
    except UsdBrdfError:
        return None
    theirs = _by_ends(found.names)
    off: list[tuple[float, float]] = []
    for frame in frames:
        name, pose = frame.get("file_path"), stated_pose(frame.get("transform_matrix"))
        k = _longest_end(PurePosixPath(name), theirs) if isinstance(name, str) else None
        if pose is not None and k is not None:
            start = world_from_camera(found.camera_from_world[k])
            pose, old, same = pose @ axes, OLD_NERFSTUDIO @ start, start
            off.append((np.abs(old - pose)[:3, :3].max(), np.abs(same - pose)[:3, :3].max()))
    if len(off) < max(3, len(frames) / 2):
        return None
    by_old, by_same = np.median(off, axis=0)
    return bool(by_old < by_same) if min(by_old, by_same) < _SAME_CAMERA else None


def _by_ends(names: Sequence[str]) -> dict[tuple[str, ...], int | None]:
    """The numbers of names by each end of their paths, without suffix; None for several."""
    found: dict[tuple[str, ...], int | None] = {}
    for k, name in enumerate(names):
        parts = PurePosixPath(name.replace("\\", "/")).with_suffix("").parts
        for end in (parts[i:] for i in range(len(parts))):
            found[end] = None if end in found else k
    return found


def _longest_end(path: PurePath, numbers: Mapping[tuple[str, ...], int | None]) -> int | None:
    parts = path.with_suffix("").parts
    return next((numbers[parts[i:]] for i in range(len(parts)) if parts[i:] in numbers), None)


def _models_beside(folder: Path) -> list[Path]:
    return [folder / place for place in _MODELS if model_files(folder / place)]


def _document_from_ngp(mesh: Path, document: Mapping[str, Any]) -> Double:
    """(4, 4) rigid."""
    offset = document.get("offset", _NGP_OFFSET)
    numbers = numbers_among(offset if isinstance(offset, list) else [offset] * 3, 3)
    scale = numbers_among(document.get("scale", _NGP_SCALE), 1)
    stated = numbers is not None and scale is not None and 1 / _LARGEST < scale[0] < _LARGEST
    if numbers is None or scale is None or not stated or "aabb" in document:
        raise InputRefused(
            f"{mesh}: is one of instant-ngp's, and the document's scale and offset, or aabb, do "
            "not say where it lies. Move it into the frame of the poses, and save it again. "
            "[mesh.frame]"
        )
    ngp_from_document = _NGP_AXES.copy()
    ngp_from_document[:3, 3] = (np.roll(numbers, -1) - numbers) / scale[0]
    return np.asarray(np.linalg.inv(ngp_from_document), np.float64)
