"""Frames and geometry, each found by an adapter, checked against each other: a Scan."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Literal, NamedTuple, ParamSpec

import numpy as np

from usdbrdf import calibration
from usdbrdf.capture.camera_checks import (
    doubts_about_headers,
    drop_cameras_inside,
    refuse_rays_that_miss,
    refuse_without_parallax,
)
from usdbrdf.capture.checks import (
    Findings,
    FrameRecord,
    at_image_size,
    check_frames,
    frames_from_records,
    tagged_encoding,
    with_masks,
)
from usdbrdf.capture.develop import frames_of_photographs
from usdbrdf.capture.mesh_frames import LabelTable, doubts_about_ids, labels_of_others
from usdbrdf.capture.rigid_poses import rigid_records
from usdbrdf.errors import InputRefused, MeshMissing, UsageError, UsdBrdfError
from usdbrdf.files.colour import kind_of_encoding, known_encodings, unknown_encoding
from usdbrdf.files.documents import read_json
from usdbrdf.files.exif import Headers, exif_exposures
from usdbrdf.files.frames import PHOTOGRAPH_ENCODING, photograph_limits
from usdbrdf.files.images import MAX_SIDE
from usdbrdf.files.naming import unique_identifiers
from usdbrdf.geometry.mesh_clean import clean_mesh
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.geometry.sides import Sides, sides_from_cameras, turned_towards_cameras, with_backs
from usdbrdf.geometry.unwrap import connected_triangles
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Int
from usdbrdf.model.capture import Frames, Scan
from usdbrdf.model.mesh import (
    DIRECTIVES,
    ObjectLabel,
    ObjectName,
    ScanGeometry,
    ScanMesh,
    doubled_areas,
    welded_ids,
)
from usdbrdf.model.upright import is_turned
from usdbrdf.options import AUTO, CaptureOptions
from usdbrdf.transport.rays import RayScene
from usdbrdf.untrusted.mesh_files import FileMesh, mesh_from_file
from usdbrdf.untrusted.usd_files import meshes_from_usd
from usdbrdf.untrusted.usd_paths import USD_SUFFIXES

P = ParamSpec("P")
_MAX_OBJECTS = 65_535
_LEAST_PART = calibration.number("objects.least_part")
_ONE_OBJECT = (ObjectLabel(identifier="scan", label="scan"),)


class Segmentation(NamedTuple):
    """face_object (F,) int32, index into ``labels``."""

    face_object: Int
    labels: tuple[ObjectName, ...]


def label_table(path: Path) -> LabelTable:
    """Read ``{"objects": [{"id", "name", "class_name", "directive"}], "face_object_id": [...]}``;
    all but the ids may be left out."""
    document = read_json(path)
    rows = document.get("objects") if isinstance(document, dict) else None
    if not isinstance(rows, list):
        raise InputRefused(f'{path}: no list "objects". See the example capture. [objects.format]')
    entries: dict[int, ObjectName] = {}
    for row in rows:
        number = row.get("id") if isinstance(row, dict) else None
        if not isinstance(number, int) or isinstance(number, bool):
            raise InputRefused(
                f"{path}: the object {str(row)[:80]!r} has no whole number as id. Give every "
                "object an id. [objects.format]"
            )
        if number in entries:
            raise InputRefused(f"{path}: the id {number} occurs twice. Keep one. [objects.format]")
        keys = ("name", "class_name", "directive")
        name, class_name, directive = (row.get(key) or "" for key in keys)
        if not (isinstance(name, str) and isinstance(class_name, str)):
            raise InputRefused(
                f"{path}: name and class_name of object {number} must be strings. [objects.format]"
            )
        if directive not in ("", *DIRECTIVES):
            raise InputRefused(
                f"{path}: the directive {str(directive)[:40]!r} of object {number} is none of "
                f"{', '.join(DIRECTIVES)}. Correct or remove it. [objects.directive]"
            )
        entries[number] = ObjectName(name or f"object_{number}", class_name, directive)
    ids = document.get("face_object_id")
    if ids is not None and not (isinstance(ids, list) and all(type(n) is int for n in ids)):
        raise InputRefused(f"{path}: face_object_id is no list of whole numbers. [objects.format]")
    return LabelTable(entries, None if ids is None else np.array(ids, np.int64))


def segmentation(
    mesh: FileMesh, table: LabelTable | None, *, table_path: Path | None, min_area: float | None
) -> Segmentation:
    """Objects of a mesh: by the table's or the file's labels, else by connected parts.

    Ids without an entry are called ``object_<id>``; negative ids mean unlabelled. Parts smaller
    than ``min_area`` (scene units squared; None: a share of the mesh's) are gathered in one object,
    ``rest``.
    """
    face_id = mesh.face_label
    if table is not None and table.face_id is not None:
        kept = mesh.kept if mesh.kept is not None else np.ones(len(mesh.triangles), np.bool_)
        if len(table.face_id) != len(kept):
            raise InputRefused(
                f"{table_path}: {len(table.face_id)} face labels for a mesh of {len(kept)} "
                "triangles. Write one object id per triangle of this mesh. [objects.count]"
            )
        face_id = table.face_id[kept]
    if face_id is None:
        return _connected_parts(mesh, min_area)
    face_id = np.where(face_id < 0, -1, face_id)
    ids, face_object = np.unique(face_id, return_inverse=True)
    if len(ids) > _MAX_OBJECTS:
        raise InputRefused(
            f"{table_path or 'the mesh'}: {len(ids)} different object ids (limit {_MAX_OBJECTS}). "
            "These do not look like objects. [objects.limit]"
        )
    entries = table.entries if table is not None else {}
    names = dict(enumerate(mesh.label_names))
    labels = [
        ObjectName("unlabelled")
        if number < 0
        else entries.get(number, ObjectName(names.get(number, f"object_{number}")))
        for number in ids.tolist()
    ]
    return Segmentation(face_object.astype(np.int32), tuple(labels))


def _connected_parts(mesh: FileMesh, min_area: float | None) -> Segmentation:
    """Parts joined by position, largest first; one object where no second one is large enough."""
    connected = connected_triangles(welded_ids(mesh.points)[mesh.triangles])
    parts, part_of_face = np.unique(connected, return_inverse=True)
    area = np.bincount(
        part_of_face, weights=doubled_areas(mesh.points, mesh.triangles) / 2, minlength=len(parts)
    )
    if min_area is None:
        min_area = _LEAST_PART * float(area.sum())
    order = np.argsort(-area, kind="stable")
    large = order[area[order] >= min_area][:_MAX_OBJECTS]
    if len(large) < 2:
        return Segmentation(np.zeros(len(mesh.triangles), np.int32), (ObjectName("scan"),))
    object_of_part = np.full(len(parts), len(large), np.int32)
    object_of_part[large] = np.arange(len(large), dtype=np.int32)
    labels = [ObjectName(f"part_{i + 1:03d}") for i in range(len(large))]
    if len(large) < len(parts):
        labels.append(ObjectName("rest"))
    return Segmentation(object_of_part[part_of_face], tuple(labels))


def objects_with_faces(
    face_object: Int, labels: tuple[ObjectName, ...]
) -> tuple[Int, tuple[ObjectLabel, ...]]:
    """Objects that still own a triangle, with unique identifiers, and the renumbered faces."""
    used, renumbered = np.unique(face_object, return_inverse=True)
    kept = [labels[i] for i in used.tolist()]
    identifiers = unique_identifiers([name.label for name in kept])
    objects = tuple(
        ObjectLabel(identifier=identifier, **name._asdict())
        for identifier, name in zip(identifiers, kept, strict=True)
    )
    return renumbered.astype(np.int32), objects


def geometry_from_usd(
    path: Path,
    options: CaptureOptions,
    findings: Findings,
    *,
    capture_root: Path,
    subsets: bool = False,
) -> ScanGeometry:
    """Every mesh below the default prim is one object, by its display name or its own.

    subsets  where meshes have face subsets, these are the objects; the asset then holds the
             geometry itself, because only whole meshes of another file can carry its textures
    """
    if options.decimate is not None:
        raise UsageError(
            f"{path}: --decimate does not reduce geometry that is referenced from USD. Reduce it "
            "in the program it comes from, or give a PLY. [usage.option]"
        )
    if not path.is_file():
        raise MeshMissing(
            f"{path}: this mesh does not exist. Name the mesh with --mesh. [mesh.missing]"
        )
    allow = (capture_root, *options.allow_outside)
    found = meshes_from_usd(path, allow=allow, subsets=subsets)
    findings.warnings += found.warnings
    mesh = found.mesh
    missing = np.isnan(mesh.corner_normals[:, 0, 0])
    if missing.any():
        mesh.corner_normals[missing] = corner_normals(
            mesh.points, mesh.triangles[missing], options.crease_angle_deg
        )
    own = ", so the asset holds the meshes itself instead of referring to them."
    if not found.object_prims:
        made = f"{len(found.objects)} objects have been made from face subsets"
        findings.warn(f"{path.name}: {made}{own} [stage.subsets]")
    elif is_turned(options.up_axis):
        findings.warn(f"{path.name}: is turned, from {options.up_axis} up{own} [stage.turned]")
        found = replace(found, object_prims=())
    if options.objects == AUTO:
        findings.warn(f"{path.name}: objects are segmented anew{own} [objects.auto]")
        whole = replace(mesh, face_object=np.zeros_like(mesh.face_object))
        found = replace(
            found, mesh=whole, objects=_ONE_OBJECT, object_prims=(), label_source="segmented"
        )
    place = path.resolve() if found.object_prims else None
    return replace(found, has_normals=~missing, usd_geometry=place)


def geometry_from_file(
    mesh_path: Path,
    objects: Path | Literal["auto"] | Callable[[FileMesh], LabelTable] | None,
    options: CaptureOptions,
    findings: Findings,
    *,
    capture_root: Path,
    meters_per_unit: float = 1.0,
    read: Callable[[Path], FileMesh] = mesh_from_file,
) -> ScanGeometry:
    """Read (by ``read``, but for USD), check, segment and clean a mesh.

    objects          objects.json; or what knows the objects of the mesh that was read, an id for
                     each of its triangles; or None. Options that ask to segment it come first
    capture_root     folder inside which a USD file may refer to others
    meters_per_unit  of the adapter, for areas in square metres; the options' comes first
    """
    if mesh_path.suffix.lower() in USD_SUFFIXES:
        return geometry_from_usd(mesh_path, options, findings, capture_root=capture_root)
    mesh = read(mesh_path)
    if mesh.kept is not None:
        broken = int((~mesh.kept).sum())
        findings.count("broken_faces", broken)
        findings.warn(
            f"{mesh_path.name}: {broken} of {len(mesh.kept)} faces had NaN corners or pointed to "
            "vertices that do not exist, and have been removed. [mesh.broken]"
        )
    if options.objects == AUTO:
        objects, mesh = None, replace(mesh, face_label=np.zeros(len(mesh.triangles), np.int64))
    objects_path = objects if isinstance(objects, Path) else None
    table = label_table(objects_path) if objects_path is not None else None
    if table is not None and objects_path is not None:
        findings.warnings += doubts_about_ids(mesh, table, objects_path.name)
    if callable(objects):
        table = objects(mesh)
        mesh, table = replace(mesh, face_label=table.face_id), table._replace(face_id=None)
    least = options.min_component_area_m2
    split = segmentation(
        mesh,
        table,
        table_path=objects_path,
        min_area=least and least / (options.meters_per_unit or meters_per_unit) ** 2,
    )
    unlabelled = mesh.face_label is None and (table is None or table.face_id is None)
    if unlabelled:
        findings.warn(
            f"{mesh_path.name}: no object labels{labels_of_others(mesh_path)}; {len(split.labels)} "
            "objects have been made from connected parts. [objects.none]"
        )
    clean = clean_mesh(
        mesh.points,
        mesh.triangles,
        split.face_object,
        decimate=options.decimate,
        label=str(mesh_path),
    )
    for name, number in clean.counts.items():
        findings.count(name, number)
    face_object, labelled = objects_with_faces(clean.face_object, split.labels)
    source = "connected" if unlabelled else "capture"
    return ScanGeometry(
        label_source="segmented" if options.objects == AUTO else source,
        mesh=ScanMesh(
            points=clean.points,
            triangles=clean.triangles,
            corner_normals=corner_normals(clean.points, clean.triangles, options.crease_angle_deg),
            face_object=face_object,
        ),
        objects=labelled,
    )


def _recalling(read: Callable[P, Scan]) -> Callable[P, Scan]:
    """What was found of a capture goes with the sentence that refuses it."""

    @wraps(read)
    def reading(*given: P.args, **named: P.kwargs) -> Scan:
        try:
            return read(*given, **named)
        except UsdBrdfError as error:
            error.found = signature(read).bind(*given, **named).arguments["findings"]
            raise

    return reading


@_recalling
def scan_from_parts(
    records: Sequence[FrameRecord],
    read_geometry: Callable[[], ScanGeometry],
    options: CaptureOptions,
    findings: Findings,
    *,
    name: str,
    adapter: str,
    source: Path,
    encoding: str,
    radiometric: bool,
    meters_per_unit: float = 1.0,
    up_axis: str = "Z",
) -> Scan:
    """Check everything, cheap things first, and put the scan together.

    records         frames with pose and file; those without are in ``findings`` already
    read_geometry   called once the poses are known to be sound
    source          the file or folder that messages about the whole capture name
    encoding        the options', the capture's or the usual one, before which the images' tags come
    meters_per_unit, up_axis   the format's own; the geometry's and the options' come first
    """
    total = len(records) + len(findings.dropped)
    if options.encoding is None and encoding in ("lin_rec709_scene", PHOTOGRAPH_ENCODING):
        encoding = tagged_encoding(records, encoding, findings, source)
    for record in records:
        if max(map(abs, record.resolution)) > MAX_SIDE:
            raise InputRefused(
                f"{source}: the camera of {record.name!r} has {record.resolution[0]} x "
                f"{record.resolution[1]} pixels (limit {MAX_SIDE} a side). Export the cameras "
                "again. [capture.camera]"
            )
    findings.frames = frames_from_records(records, encoding=encoding, radiometric=radiometric)
    known: set[Path] = set()
    for record in records:
        if record.image_path in known:
            raise InputRefused(
                f"{source}: the frame {record.name!r} is listed twice. Keep one entry. "
                "[capture.duplicate]"
            )
        known.add(record.image_path)
    rigid = rigid_records(records, findings, source, pose_scale=options.pose_scale)
    rigid = with_masks(at_image_size(rigid, findings, source), findings)
    photographs = frames_from_records(rigid, encoding=encoding, radiometric=radiometric)
    findings.frames = photographs
    frames, views, photograph_of = frames_of_photographs(photographs, rigid)
    findings.refuse_too_few_frames(source, total, views=len(frames))
    geometry = read_geometry()
    findings.geometry = geometry
    rays = RayScene(geometry.mesh.points, geometry.mesh.triangles)
    if not any(r.lens.curve == "equirectangular" for r in rigid):
        refuse_without_parallax(frames, rays, source)
    hit_share = refuse_rays_that_miss(frames, rays, source)
    usable = check_frames(
        photographs,
        [r.name for r in rigid],
        findings,
        max_nonfinite=options.max_nonfinite,
        most=options.looked_at,
        masks=[r.mask_path for r in rigid] if any(r.mask_path for r in rigid) else (),
    )
    findings.warn_of_transparent(photographs, usable, source)
    kept = np.flatnonzero(np.isin(photograph_of, usable)).tolist()
    findings.refuse_too_few_frames(source, total, views=len(kept))
    findings.count("rays_hit_percent", round(100 * hit_share))
    if options.looked_at is not None:
        findings.count("frames_looked_at", len(findings.looked_at))
    # From here on the faces of a photograph count one by one.
    total += len(kept) - len(usable)
    frames, used = frames.at(kept), [rigid[photograph_of[i]].name for i in kept]
    sides, outside = _sides(geometry, rays, frames, used, findings)
    frames, kept = frames.at(outside), [kept[i] for i in outside]
    findings.refuse_too_few_frames(source, total)
    findings.warn_of_dropped_frames(source, total)
    return Scan(
        name=name,
        adapter=adapter,
        source=source,
        mesh=turned_towards_cameras(
            geometry.mesh, sides, geometry.has_normals, options.crease_angle_deg
        ),
        objects=geometry.objects,
        frames=frames,
        meters_per_unit=options.meters_per_unit or geometry.meters_per_unit or meters_per_unit,
        up_axis=options.up_axis or geometry.up_axis or up_axis,
        usd_geometry=geometry.usd_geometry,
        object_prims=geometry.object_prims,
        views=tuple(views[i] for i in kept) if any(views) else (),
        turned_faces=sides.turned,
        label_source=geometry.label_source,
        has_normals=geometry.has_normals,
        turned_images=dict(findings.turned),
        warnings=tuple(findings.warnings),
        counts=dict(findings.counts),
    )


def _sides(
    geometry: ScanGeometry, rays: RayScene, frames: Frames, names: Sequence[str], findings: Findings
) -> tuple[Sides, list[int]]:
    """Which faces have to be turned towards the cameras, and which show both sides; and the numbers
    of the frames that were not taken inside of something."""

    def seen(frames: Frames) -> Sides:
        numbers = progress(range(len(frames)), total=len(frames), label="sides", unit="frames")
        return sides_from_cameras(geometry.mesh, rays, (frames.camera(i) for i in numbers))

    sides = seen(frames)
    outside = drop_cameras_inside(frames, geometry.mesh, rays, sides, names, findings)
    if 0 < len(outside) < len(frames):
        sides = seen(frames.at(outside))
    # A face of a mesh that is referenced keeps the side that is seen more.
    referenced = geometry.usd_geometry is not None
    sides = with_backs(sides, geometry.mesh, rays, referenced=referenced)
    turned = int(sides.turned.sum())
    findings.count("faces_turned", turned)
    findings.count("faces_of_two_sides", int(sides.skins.sum()))
    if turned:
        findings.warn(
            f"{turned} of {len(sides.turned)} faces are wound away from the cameras and have been "
            "turned in the asset; the mesh stays as it is. [mesh.winding]"
        )
    return sides, outside


def as_photographs(
    records: Sequence[FrameRecord], findings: Findings, source: Path
) -> list[FrameRecord]:
    """8-bit sRGB records with the limits of such images, brought to one exposure: the stated one,
    else that of all images' EXIF data."""
    told, headers = "", Headers()
    stated = any(record.exposure_time != 1 for record in records)
    if not stated:
        known, any_told = exif_exposures([record.image_path for record in records], headers)
        if known:
            records = [
                replace(record, exposure_time=exposure)
                for record, exposure in zip(records, known, strict=True)
            ]
            stops = math.log2(max(known) / min(known))
            told = f" The exposures of their EXIF data are divided out ({stops:.1f} stops)."
        elif any_told:
            told = (
                " Their EXIF data are not compared, as not all tell exposure time, f-number and "
                "ISO speed alike: they pass for equally exposed."
            )
    findings.warn(
        f"{source.name}: the images are photographs, so the result is not radiometric: "
        f"colours and relative brightness only.{told} [capture.ldr]"
    )
    for doubt in doubts_about_headers(records, source, headers, exposures_are_stated=stated):
        findings.warn(doubt)
    saturation, noise_floor = photograph_limits(np.array([r.exposure_time for r in records]))
    return [
        replace(r, saturation_radiance=float(high), noise_floor_radiance=float(low))
        for r, high, low in zip(records, saturation, noise_floor, strict=True)
    ]


def radiance_encoding(
    options: CaptureOptions, *, photographs: bool, stated: str | None = None
) -> str:
    """Colour space of the images: the options', that which the capture states, or the usual one;
    UsageError where the options contradict the images."""
    usual = PHOTOGRAPH_ENCODING if photographs else "lin_rec709_scene"
    encoding = options.encoding or stated or usual
    kind = kind_of_encoding(encoding)
    if kind is None:
        raise UsageError(
            f"--encoding {encoding!r}: {unknown_encoding(encoding)} Use one of "
            f"{', '.join(known_encodings())}, "
            "or another of OpenColorIO's studio configuration. [usage.option]"
        )
    if photographs != (kind == "display"):
        what = "8-bit photographs" if photographs else "scene-linear images"
        raise UsageError(
            f"--encoding {encoding}: the images are {what}. Leave the option out. [usage.option]"
        )
    return encoding
