"""Where the files are that a capture's documents name, and which pictures are copies. Which mesh is
a capture's, and in which frame it lies: where the points lie on it that its photographs share, and
in which scene of several cameras a document stands whose own mesh is that of the scene."""

from __future__ import annotations

import filecmp
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from usdbrdf.errors import ImageRefused, InputRefused, MeshMissing, first_of
from usdbrdf.files.images import image_size
from usdbrdf.files.paths import contained, seen_of
from usdbrdf.files.tables import beginning_of
from usdbrdf.model.arrays import Double, Float, Int, Long
from usdbrdf.model.mesh import ObjectName, ScanGeometry, ScanMesh
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.colmap_models import colmap_points
from usdbrdf.untrusted.mesh_files import LABEL_PROPERTY, FileMesh, mesh_from_file
from usdbrdf.untrusted.mesh_files import SUFFIXES as MESH_SUFFIXES
from usdbrdf.untrusted.mesh_ply import LONGEST_HEADER, holds_points_alone, whole_number_of_faces
from usdbrdf.untrusted.usd_paths import USD_SUFFIXES

# Places on the mesh, faces that are looked at at a time, or whose corners are compared, and points
# that are; fewer of these say nothing.
_PLACES, _MOST_FACES, _MOST_POINTS, _FEWEST_POINTS = 100_000, 500_000, 20_000, 30
# Half of the points lie nearer to their mesh than this, in parts of their spread, and farther from
# one of another frame by this factor.
_ON_IT, _CLEARLY = 0.1, 3.0
# Of a mesh that its cameras see as it is. Beyond it lies elsewhere, or is but a part of the scene.
_FITS = 0.05
# Folders of a scene of ScanNet++, which hold nerfstudio/ and colmap/.
_OF_SCANNETPP = ("dslr", "iphone")
_MESHES = (*MESH_SUFFIXES, *sorted(USD_SUFFIXES))
_MASK_SUFFIXES = (".png", ".PNG", ".jpg", ".JPG", ".jpeg", ".tif")
_CALLED_MASKS = ("mask", "masks")
_UNREAD_MESHES = frozenset((".gltf", ".stl", ".fbx", ".dae", ".3mf", ".off", ".wrl", ".x3d"))
# What tells a copy's name from that of what it was made of; but not where it says what is shown.
_COPIED = re.compile(r"[ ._-]*\((?:\d+|copy)\)|[ ._-]+(?:copy|kopie)\b.*", re.I)
_OF_ONES_OWN = re.compile(r"rgb|colou?r|im(?:a)?ge?|frame|cam|left|right", re.I)
# Folders of pictures that are no photographs, or not those that were taken.
_OF_OTHERS = re.compile(
    r"(?<![^\W_])(?:depth|normal|label|segm|semantic|thumb|preview|texture|albedo|result|output"
    r"|(?:conf|confidence|old|bak|copy)(?![^\W_]))",
    re.I,
)


def path_in_capture(root: Path, candidate: str, options: CaptureOptions, *, cure: str = "") -> Path:
    """The absolute path of ``candidate``, which may be absolute if it leads to what lies in root;
    InputRefused if it leaves root and --allow-outside, which says what to do by ``cure``, see
    ``contained``."""
    homes = (root,) if PurePosixPath(candidate).is_absolute() else ()
    for folder in (*homes, *options.allow_outside) if candidate else ():
        with suppress(OSError, RuntimeError, ValueError):  # ``contained`` says what is wrong
            candidate.encode()
            path = (root / candidate).resolve()
            if path.is_relative_to(folder.resolve()):
                return path
    return contained(root, candidate, cure=cure)


def mesh_beside(folder: Path, options: CaptureOptions, *usual: str, how: str) -> Path:
    """``--mesh``, else the first of the ``usual`` files (patterns) that is there, else the one mesh
    of the folder; MeshMissing, which says ``how`` to get one, where there is none."""
    if options.mesh is not None:
        return options.mesh
    for pattern in usual:
        found = [p for p in seen_of(folder.glob(pattern)) if p.suffix.lower() in _MESHES]
        if found:
            return contained(folder, found[0].relative_to(folder).as_posix())
    there = [p for p in seen_of(folder.iterdir()) if p.suffix.lower() in _MESHES]
    others = [p for p in there if not holds_points_alone(beginning_of(p, LONGEST_HEADER))]
    if len(others) == 1:
        return contained(folder, others[0].name)
    unread = [p.name for p in seen_of(folder.iterdir()) if p.suffix.lower() in _UNREAD_MESHES]
    said = f"{len(others)} meshes" if others else "no mesh"
    if unread and not others:
        said += f" that is read ({unread[0]} is none of {', '.join(_MESHES)})"
    elif there and not others:
        said += f" ({there[0].name} holds points alone)"
    raise MeshMissing(f"{folder}: {said}. {how}, or name one with --mesh. [mesh.missing]")


def folder_of_masks(folder: Path) -> str:
    """The folder masks, else one that is called nearly so, if it holds anything; "" without one."""
    alike = [p for p in seen_of(folder.iterdir()) if p.name.lower().strip("_") in _CALLED_MASKS]
    alike.sort(key=lambda place: place.name != "masks")
    return next((p.name for p in alike if p.is_dir() and any(seen_of(p.iterdir()))), "")


def mask_beside(folder: Path, name: str, options: CaptureOptions) -> Path | None:
    """The mask of a picture in masks/, of its name there (in subfolders too), with its suffix or
    not; black is what is not to be looked at."""
    stem = str(PurePosixPath(name).with_suffix(""))
    for usual in (name, stem, f"{stem}_mask", f"{name}.mask"):
        for suffix in _MASK_SUFFIXES:
            # Of which nothing can be asked, as of too long a name, is not there.
            if os.path.isfile(folder / "masks" / f"{usual}{suffix}"):
                return path_in_capture(folder, f"masks/{usual}{suffix}", options)
    same = folder / "masks" / name
    return path_in_capture(folder, f"masks/{name}", options) if os.path.isfile(same) else None


def without_copies(paths: Sequence[Path]) -> tuple[Path, ...]:
    """Those of ``paths`` that are not called as others of them and more, being of another size or
    the same to the byte: ``1 (1).jpg`` and ``1_small.jpg`` beside ``1.jpg``, and ``thumbs/1.jpg``
    below it.

    What more than there are others are called alike by are no copies, as the pictures that a
    browser called ``image (1).jpg``, ``image (2).jpg`` and so on.
    """
    there, of_sign = set(paths), dict[str, set[Path]]()
    for path in paths:
        for original, sign in _originals(path):
            if original in there and _is_made_of(path, original):
                of_sign.setdefault(re.sub(r"\d+", "#", sign), set()).add(path)
    copies: set[Path] = set().union(*of_sign.values())
    originals = len(paths) - len(copies)
    copies = set().union(*(some for some in of_sign.values() if len(some) <= originals))
    return tuple(path for path in paths if path not in copies)


def _originals(path: Path) -> Iterator[tuple[Path, str]]:
    """Of what a picture may be a copy, by its name, and by which sign of it."""
    stem = path.stem
    for found in re.finditer(r"[ ._(-]+", stem):
        before, behind = stem[: found.start()], stem[found.start() :]
        ahead, after = stem[: found.end()], stem[found.end() :]
        for base, sign in ((before, behind), (after, ahead)):
            says = re.search("[^\\W\\d_]", sign) and not _OF_ONES_OWN.search(sign)
            if base and (says or (sign is behind and _COPIED.fullmatch(sign))):
                yield path.with_name(base + path.suffix), sign
    above = path.parent
    while above != above.parent and not _OF_ONES_OWN.search(above.name):
        above = above.parent
        yield above / path.name, path.parent.name + "/"


def _is_made_of(path: Path, original: Path) -> bool:
    with suppress(OSError, ImageRefused):
        if image_size(path)[:2] != image_size(original)[:2]:
            return True
        return filecmp.cmp(path, original, shallow=False)
    return False


def folders_but_masks(folder: Path) -> list[Path]:
    """The folders in a folder that are no links and not called as those of masks are, or of other
    pictures than photographs."""
    there = (p for p in seen_of(folder.iterdir()) if p.is_dir() and not p.is_symlink())
    plain = (p for p in there if p.name.lower().strip("_") not in _CALLED_MASKS)
    return [p for p in plain if not _OF_OTHERS.search(p.name)]


def labels_of_others(mesh: Path) -> str:
    """A clause on a number of each face of a PLY that may be its object's, and is not taken for
    that as it is called otherwise; "" without one."""
    name = whole_number_of_faces(beginning_of(mesh, LONGEST_HEADER))
    return (
        f" (its faces have {name!r}: call it {LABEL_PROPERTY} if it tells objects)" if name else ""
    )


class LabelTable(NamedTuple):
    """What objects.json says: name of each id, and optionally an id per face."""

    entries: Mapping[int, ObjectName]
    face_id: Long | None


def doubts_about_ids(mesh: FileMesh, table: LabelTable, name: str) -> Iterator[str]:
    """A sentence where objects.json names ids that no face has, while faces have others, as where
    one of both counts from 1. 0 alone may be what is no object, but where all that follow are used.
    """
    ids = mesh.face_label if table.face_id is None else table.face_id
    if ids is None:
        return
    used = set(np.unique(ids).tolist())
    # Faces may have names in the mesh itself, whose numbers count from 0 on.
    named = len(mesh.label_names) if table.face_id is None else 0
    unnamed = sorted(n for n in used.difference(table.entries) if n >= named)
    idle = sorted(table.entries.keys() - used)
    if unnamed and idle and (unnamed != [0] or max(used) < len(used)):
        yield (
            f"{name}: faces have ids that it does not name ({first_of([*map(str, unnamed)])}), and "
            f"it names ids that no face has ({first_of([*map(str, idle)])}). If one of both counts "
            "from 1, or the ids are those of another mesh, objects have the names of others: "
            "correct them. [objects.ids]"
        )


def scene_above(document: Path) -> Path | None:
    """The folder of the scene of ScanNet++ that a document is a part of, None of any other."""
    scene = document.parents[min(2, len(document.parents) - 1)]
    kind, camera = document.parent.name, document.parent.parent.name
    apart = kind in ("nerfstudio", "colmap") and camera in _OF_SCANNETPP
    return scene if apart and (scene / "scans").is_dir() else None


def moved_geometry(
    read: Callable[[CaptureOptions], ScanGeometry],
    matrix: Double,
    options: CaptureOptions,
    meters_per_unit: float,
) -> ScanGeometry:
    """What ``read`` makes of a mesh with options whose unit is the mesh's own, by a similarity
    (4, 4) to the frame of a capture of ``meters_per_unit``, unless the options say it."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    unit = (options.meters_per_unit or meters_per_unit) * scale
    found = read(replace(options, meters_per_unit=unit))
    points = found.mesh.points @ matrix[:3, :3].T + matrix[:3, 3]
    normals = found.mesh.corner_normals @ (matrix[:3, :3].T / scale)
    moved = replace(
        found.mesh, points=points.astype(np.float32), corner_normals=normals.astype(np.float32)
    )
    return replace(found, mesh=moved)


class Lies(NamedTuple):
    """Where a mesh lies: on the points of a COLMAP model (True), or where these are moved to
    (False), None where they do not tell; and whether it is known to lie on neither."""

    with_points: bool | None
    elsewhere: bool


def lies_with_points(mesh: Path, model: Path, moved: Double) -> Lies:
    """Which it is of a mesh, ``moved`` being a similarity (4, 4)."""
    points = _points(model)
    if points is None:
        return Lies(None, elsewhere=False)
    found = mesh_from_file(mesh)
    surface = cKDTree(_places_on(found.points, found.triangles))
    here = _off(surface, points)
    there = _off(surface, points @ moved[:3, :3].T + moved[:3, 3])
    if min(here, there) > _ON_IT or max(here, there) < _CLEARLY * min(here, there):
        return Lies(None, elsewhere=min(here, there) > _ON_IT)
    return Lies(here < there, elsewhere=False)


def why_elsewhere(mesh: ScanMesh, model: Path) -> str:
    """A sentence where the points of a COLMAP model do not lie on the mesh of its capture; "" where
    they do, are too few, or cannot be read."""
    points = _points(model)
    if points is None:
        return ""
    off = _off(cKDTree(_places_on(mesh.points, mesh.triangles)), points)
    if off < _FITS:
        return ""
    return (
        f"half of the points of COLMAP's model lie farther off this mesh than {off:.2g} of their "
        "spread, so it is but a part of what the photographs show, or lies in another frame or "
        "unit than the cameras. Make one of this model if it does"
    )


def _points(model: Path) -> Double | None:
    """(N, 3) of a model, spread evenly if they are many; None where they say nothing."""
    try:
        points = colmap_points(model)
    except InputRefused:  # they help, but no capture needs them
        return None
    points = points[np.isfinite(points).all(axis=1)]
    return points[:: -(-len(points) // _MOST_POINTS)] if len(points) >= _FEWEST_POINTS else None


def _off(surface: cKDTree, points: Double) -> float:
    """How far half of the points lie off a surface, in parts of their own spread."""
    distance, _ = surface.query(points)
    spread = np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1))
    return float(np.median(distance) / max(float(spread), np.finfo(np.float64).tiny))


def _places_on(points: Float, triangles: Int) -> Double:
    """Places evenly over all faces, large ones have few corners; and corners, which lie close where
    there is detail."""
    parts = np.array_split(triangles, -(-len(triangles) // _MOST_FACES))
    area = np.concatenate([_areas(points, some) for some in parts])
    before = np.concatenate([[0.0], np.cumsum(area)])
    chance = np.random.default_rng(0)
    where = chance.uniform(0, before[-1], _PLACES)
    face = np.clip(np.searchsorted(before, where, side="right") - 1, 0, len(area) - 1)
    a, b, c = np.moveaxis(points[triangles[face]].astype(np.float64), 1, 0)
    u, v = chance.uniform(size=(2, _PLACES, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    some = np.unique(triangles[:: len(parts)])
    return np.concatenate([a + u * (b - a) + v * (c - a), points[some].astype(np.float64)])


def _areas(points: Float, triangles: Int) -> Double:
    """(T,) twice those of some faces."""
    a, b, c = np.moveaxis(points[triangles].astype(np.float64), 1, 0)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1), np.float64)
