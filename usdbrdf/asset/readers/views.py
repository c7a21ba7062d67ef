"""A nerfstudio document (transforms.json, views.json) with views of a capture -> the same views in
metres, in the world of that capture's asset.

Poses are in the capture's frame and unit. The capture's own adapter and checks read them, so that
they are treated as ingest treated those of the capture: applied_transform undone, scaled axes
divided by the same --pose-scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom

from usdbrdf.asset.header import capture_up_of, read_provenance
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.scene import frames_from_stage, lighting_of_stage
from usdbrdf.capture.camera_checks import refuse_rays_that_miss
from usdbrdf.capture.checks import (
    Findings,
    FrameRecord,
    check_frames,
    frames_from_records,
    refuse_photographs,
    with_masks,
)
from usdbrdf.capture.develop import developed_in, frames_of_photographs
from usdbrdf.capture.formats.transforms import frame_records
from usdbrdf.capture.lens_views import views_of
from usdbrdf.capture.rigid_poses import rigid_records
from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import WORKING_SPACE, kind_of_encoding
from usdbrdf.files.frames import PHOTOGRAPH_ENCODING, PHOTOGRAPH_NOISE_FLOOR, PHOTOGRAPH_SATURATION
from usdbrdf.job.progress import warn
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.model.scene import Scene
from usdbrdf.model.upright import upright_pose
from usdbrdf.options import CaptureOptions
from usdbrdf.transport.rays import RayScene

# A reference may leave much of a picture unknown; a view that holds next to nothing is dropped.
_MAX_UNKNOWN = 0.999


@dataclass(frozen=True, kw_only=True)
class Views:
    """Photographs to compare with: their names in the document, followed by the face where one
    through a lens became several, and themselves in metres."""

    names: tuple[str, ...]
    frames: Frames


def cameras_of_views(source: Path, asset: Asset, metres_per_unit: float) -> tuple[Camera, ...]:
    """The cameras of a document, named after their images, to render from: of a lens that bends
    light those of the pinhole frames that its photograph becomes, their faces in the names. Images
    need not exist where the document states width and height. InputRefused where a view cannot be
    used, or two have images of one name."""
    findings = Findings()
    records = _rigid_records(source, asset, CaptureOptions(), findings, images=False)
    if findings.dropped:
        first = findings.dropped[0]
        raise InputRefused(
            f"{source}: the view {first.name!r} cannot be rendered: {first.reason}. Correct the "
            "document. [relight.views]"
        )
    cameras = []
    for record in records:
        place = Path(record.name)
        for view in views_of(record.lens, record.intrinsics, record.resolution):
            pose = record.world_from_camera.copy()
            pose[:3, :3] = pose[:3, :3] @ view.photograph_from_frame
            pose[:3, 3] *= metres_per_unit
            face = f"{place.stem}.{view.face}{place.suffix}" if view.face else place.name
            width, height = view.resolution
            cameras.append(
                Camera(
                    name=str(place.with_name(face)),
                    world_from_camera=pose,
                    intrinsics=view.intrinsics,
                    width=width,
                    height=height,
                )
            )
    if not cameras or len({Path(camera.name).stem for camera in cameras}) < len(cameras):
        raise InputRefused(
            f"{source}: {'two views have images of one name' if cameras else 'no views'}. "
            "Correct the document. [relight.views]"
        )
    return tuple(cameras)


def photographs_of_views(
    source: Path,
    asset: Asset,
    stage: Usd.Stage,
    scene: Scene,
    folder: Path,
    allow_outside: tuple[Path, ...] = (),
) -> Views:
    """The photographs of a document, checked as those of a capture are. Images have the capture's
    encoding. Views that cannot be used are dropped with a warning; InputRefused where none is left
    or where the cameras do not see the asset.

    Photographs through lenses become pinhole frames below ``folder``, as those of a capture do.
    """
    captured = frames_from_stage(stage)
    captured = captured.at(captured.of_lighting(lighting_of_stage(stage)))
    findings = Findings()
    options = CaptureOptions(allow_outside=allow_outside)
    records = _rigid_records(source, asset, options, findings)
    records = with_masks(records, findings)
    total = len(records) + len(findings.dropped)
    encoding = captured.photograph_encoding or captured.encoding
    displayed = kind_of_encoding(encoding) == "display"
    # TIFF files of whole numbers are what the capture's are, if these are such.
    alike = any(p.suffix.lower() in (".tif", ".tiff") for p in captured.recorded_in())
    if refuse_photographs(
        [r.image_path for r in records],
        assume_srgb=not captured.radiometric,
        encoding=encoding if alike else None,
    ):
        encoding = encoding if displayed else PHOTOGRAPH_ENCODING
        records = [_as_the_captures_photographs(r, captured) for r in records]
    elif displayed:  # which no image of radiance is
        encoding = WORKING_SPACE
    _refuse_none(len(records), findings, source)
    taken = frames_from_records(records, encoding=encoding, radiometric=captured.radiometric)
    taken = replace(taken, vignetting=captured.vignetting)
    taken.world_from_camera[:, :3, 3] *= UsdGeom.GetStageMetersPerUnit(stage)
    frames, views, photograph_of = frames_of_photographs(taken, records)
    mesh = ScanMesh(
        points=scene.points,
        triangles=scene.triangles,
        corner_normals=scene.corner_normals,
        face_object=scene.face_object,
    )
    refuse_rays_that_miss(frames, RayScene(mesh.points, mesh.triangles), source)
    names = [record.name for record in records]
    usable = check_frames(taken, names, findings, max_nonfinite=_MAX_UNKNOWN)
    _refuse_none(len(usable), findings, source)
    kept = np.flatnonzero(np.isin(photograph_of, usable)).tolist()
    views = tuple(views[i] for i in kept) if views else ()
    faces = [f" {view.face}" if view and view.face else "" for view in views] or [""] * len(kept)
    findings.warn_of_dropped_frames(source, total)
    for sentence in findings.warnings:
        warn(sentence)
    return Views(
        names=tuple(names[photograph_of[i]] + face for i, face in zip(kept, faces, strict=True)),
        frames=developed_in(frames.at(kept), views, folder),
    )


def _rigid_records(
    source: Path, asset: Asset, options: CaptureOptions, findings: Findings, *, images: bool = True
) -> list[FrameRecord]:
    """The usable frames of a document, which are in the capture's unit and coordinates, turned as
    the capture was; the others are in ``findings``."""
    records = frame_records(source, options, findings, images=images)
    pose_scale = read_provenance(asset.layer("scan")).get("parameters", {}).get("pose_scale")
    rigid = rigid_records(records, findings, source, pose_scale=pose_scale)
    up = capture_up_of(asset)
    return [replace(r, world_from_camera=upright_pose(r.world_from_camera, up)) for r in rigid]


def _as_the_captures_photographs(record: FrameRecord, captured: Frames) -> FrameRecord:
    """8-bit record with its limits in the unit that ingest gave the capture's photographs."""
    encoding = captured.photograph_encoding or captured.encoding
    # What was resampled from photographs is linear; older assets do not say what these were.
    unsaid = captured.photographs and not captured.photograph_encoding
    if kind_of_encoding(encoding) != "display" and not unsaid:
        raise InputRefused(
            f"{record.image_path}: an 8-bit photograph, but the capture's images are "
            f"{encoding}. Use views of the same kind. [evaluate.views]"
        )
    unit = captured.saturation_radiance[0] * captured.exposure_time[0] / PHOTOGRAPH_SATURATION
    scale = float(unit / record.exposure_time)
    return replace(
        record,
        saturation_radiance=PHOTOGRAPH_SATURATION * scale,
        noise_floor_radiance=PHOTOGRAPH_NOISE_FLOOR * scale,
    )


def _refuse_none(left: int, findings: Findings, source: Path) -> None:
    if left:
        return
    first = findings.dropped[0] if findings.dropped else None
    why = f" The first, {first.name!r}: {first.reason}." if first else ""
    raise InputRefused(
        f"{source}: none of its views can be used.{why} Correct the document or its images. "
        "[evaluate.views]"
    )
