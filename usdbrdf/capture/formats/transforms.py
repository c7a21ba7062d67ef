"""nerfstudio's transforms.json with a mesh: poses are OpenGL camera-to-world, as USD's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.camera_checks import warn_of_rolling_shutter, with_doubts_about_unit
from usdbrdf.capture.checks import Findings, FrameRecord, at_image_size, clause_of
from usdbrdf.capture.conventions import OLD_NERFSTUDIO, warn_of_conventions
from usdbrdf.capture.formats.named_pictures import Pictured, scan_of
from usdbrdf.capture.formats.nerfstudio_frames import (
    EXPORTED,
    TESTED,
    Applied,
    camera_axes,
    geometry_at_home,
    has_old_axes,
    is_bad,
    rigid_matrix,
    rolling_shutter,
    stated_pose,
    statements_beside,
    warn_of_bad,
    warn_of_moved_by_wai,
)
from usdbrdf.capture.mesh_frames import mesh_beside, scene_above
from usdbrdf.capture.nerfstudio_lens import focal_of_angle, lens_of_frame, with_skew
from usdbrdf.capture.parts import geometry_from_file
from usdbrdf.capture.rigid_poses import is_camera_matrix
from usdbrdf.capture.unrecognised import of_record3d, other_program
from usdbrdf.capture.up_axis import up_axis_assumed
from usdbrdf.errors import ImageRefused, InputRefused
from usdbrdf.files.colour import kind_of_encoding, known_encodings
from usdbrdf.files.documents import read_json
from usdbrdf.files.images import MAX_SIDE, image_size
from usdbrdf.files.naming import as_in_addresses
from usdbrdf.files.tables import beginning_of
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import Lens, whole_sphere
from usdbrdf.model.mesh import ScanGeometry
from usdbrdf.options import CaptureOptions, UpAxis

NAME = "transforms"
DESCRIPTION = DESCRIPTIONS[NAME]
# No number in a document means anything beyond this; nor, where it must be positive, below its
# inverse.
_LARGEST = 1e15
# Where no size is stated: a principal point this far from the image's centre, or an image this much
# wider than its angle says, in parts of its size, belongs to an image of another size.
_OFF_CENTRE = 0.2
# What the document is called, the second by MapAnything (WAI); others call so what has no frames.
_DOCUMENT, _OF_WAI = "transforms.json", "scene_meta.json"
# A camera that could not be placed costs its frame, not the capture.
_UNPLACED = ("transform_matrix",)
beside_mesh = statements_beside


def matches(path: Path) -> bool:
    """A folder with transforms.json, or such a document itself."""
    document = _document(path)
    is_json = document.suffix == ".json" and document.is_file()
    others = document.name == "metadata.json" and of_record3d(document)
    return is_json and not others and b'"PinholeCamera' not in beginning_of(document)  # Open3D's


def is_surely(path: Path) -> bool:
    """Whether it is a document with frames, or holds one: what nobody named may be called so."""
    return _has_frames(_document(path))


def _document(path: Path) -> Path:
    if not path.is_dir():
        return path
    usual, of_wai = path / _DOCUMENT, path / _OF_WAI
    return of_wai if not usual.is_file() and _has_frames(of_wai) else usual


def _has_frames(document: Path) -> bool:
    try:
        said = read_json(document, nonfinite_below=_UNPLACED)
    except InputRefused:
        return False
    frames = said.get("frames") if isinstance(said, dict) else None
    return isinstance(frames, list) and len(frames) > 0


def read(path: Path, options: CaptureOptions) -> Scan:
    path = path.resolve()
    source = _document(path)
    findings = Findings()
    capture, records = _captured(source, options, findings)
    up_axis = _stated(capture, "up_axis", get_args(UpAxis))
    if up_axis is None:
        up_axis = up_axis_assumed(records, options, findings, source.name)
        if up_axis == "Y" and options.up_axis is None:
            findings.warn(
                f"{source.name}: states no up_axis, and its cameras are upright along y, not "
                "along z as the format has it. Y is taken; say --up-axis Z if that is wrong. "
                "[capture.up-axis]"
            )
    scan = scan_of(
        records,
        lambda: _geometry(capture, findings),
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=source.parent,
        encoding=_encoding(capture),
        radiometric=_radiometric(capture),
        meters_per_unit=capture.positive({}, "meters_per_unit") or 1.0,
        up_axis=up_axis,
    )
    stated = "meters_per_unit" in capture.document or scan.usd_geometry is not None
    return with_doubts_about_unit(scan, options, stated=stated)


def _geometry(capture: _Capture, findings: Findings) -> ScanGeometry:
    """Of the mesh that the document names, else mesh.ply beside it, else the only one there."""
    options, root = capture.options, capture.source.parent
    warn_of_moved_by_wai(capture.document, capture.source, findings)
    mesh = options.mesh or _beside(capture, "mesh", "mesh.ply")
    if options.mesh is None and capture.document.get("mesh") in capture.pictured.moved:
        findings.warn(
            f"{capture.source.name}: its mesh lies elsewhere, as before the capture was moved; "
            f"{str(mesh)!r} is taken. [capture.moved]"
        )
    if "mesh" not in capture.document and not mesh.is_file():
        how = "Put mesh.ply beside the poses"
        mesh = mesh_beside(root, options, "mesh.*", *EXPORTED, how=how)
    unit = capture.positive({}, "meters_per_unit") or 1.0
    return geometry_at_home(
        mesh,
        lambda own: geometry_from_file(
            mesh, _objects(capture), own, findings, capture_root=root, meters_per_unit=unit
        ),
        options,
        findings,
        capture.applied,
        capture.document,
        folder=root,
        meters_per_unit=unit,
    )


def _radiometric(capture: _Capture) -> bool:
    """What the document says of linear images: false of those that 8-bit photographs became."""
    stated = capture.document.get("radiometric", True)
    if not isinstance(stated, bool):
        raise capture.refuse(
            f"radiometric is {str(stated)[:40]!r}, neither true nor false. Correct it.",
            "capture.format",
        )
    return stated


def _encoding(capture: _Capture) -> str | None:
    """The colour space of the images, where the document says."""
    stated = capture.document.get("encoding")
    if stated is not None and not (isinstance(stated, str) and kind_of_encoding(stated)):
        known = f"{', '.join(known_encodings())} and OpenColorIO's others"
        said = f"encoding is {str(stated)[:40]!r}, none of {known}. Correct it."
        raise capture.refuse(said, "capture.format")
    return stated


def frame_records(
    source: Path, options: CaptureOptions, findings: Findings, *, images: bool = True
) -> list[FrameRecord]:
    """The frames of a document alone, in the capture's frame and unit, where there is no mesh.

    Those without pose or file are in ``findings``; poses are not yet known to be rigid. Without
    ``images`` no file is asked for where the document itself states width and height.
    """
    source = source.resolve()
    _, records = _captured(source, options, findings, images=images)
    return at_image_size(records, findings, source) if images else records


def records_of_scene(
    source: Path, pictures: Path, options: CaptureOptions, findings: Findings
) -> list[FrameRecord]:
    """The frames of a document of a scene of ScanNet++, whose pictures are those in a folder, with
    the axes of the scene's mesh; without masks, which lie in a folder that it does not name."""
    options = replace(options, frames=pictures)
    return _captured(source, options, findings, in_scene=True)[1]


@dataclass(frozen=True, kw_only=True)
class _Capture:
    """The document, its path, and what the user said.

    images     whether images are asked for
    masks      whether masks are
    is_legacy  whether it was made before documents stated what had been done to COLMAP's world
    first_of_camera  of each camera without a stated size the first image, its width and height
    """

    source: Path
    document: Mapping[str, Any]
    options: CaptureOptions
    pictured: Pictured
    images: bool = True
    masks: bool = True
    is_legacy: bool = False
    first_of_camera: dict[tuple[float | None, ...], tuple[str, int, int]] = field(
        default_factory=dict
    )

    def refuse(self, text: str, rule: str) -> InputRefused:
        return InputRefused(f"{self.source}: {text} [{rule}]")

    @cached_property
    def applied(self) -> Applied:
        """What has been done to the world that the mesh was made in."""
        stated = self.document.get("applied_transform")
        usual = OLD_NERFSTUDIO if self.is_legacy else np.eye(4)
        matrix = usual if stated is None else rigid_matrix(stated)
        if matrix is None:
            said = "applied_transform is not a rigid 3 x 4 matrix. Correct or remove it."
            raise self.refuse(said, "capture.pose")
        return Applied(matrix=matrix, scale=self.positive({}, "applied_scale") or 1.0)

    def number(self, frame: Mapping[str, Any], key: str) -> float | None:
        """A number of the frame, else of the document, else None."""
        value = frame.get(key, self.document.get(key))
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.refuse(f"{key} is {value!r}, not a number. Correct it.", "capture.format")
        if abs(value) > _LARGEST:
            raise self.refuse(f"{key} is beyond {_LARGEST:g}. Correct it.", "capture.format")
        return float(value)

    def positive(self, frame: Mapping[str, Any], key: str) -> float | None:
        value = self.number(frame, key)
        if value is not None and not value >= 1 / _LARGEST:
            raise self.refuse(f"{key} is {value:g}, not above 0. Correct it.", "capture.format")
        return value

    def pixels(self, frame: Mapping[str, Any], key: str) -> int | None:
        value = self.positive(frame, key)
        if value is not None and not (value.is_integer() and value <= MAX_SIDE):
            raise self.refuse(
                f"{key} is {value:g}, not a whole number of pixels up to {MAX_SIDE}. Correct it.",
                "capture.format",
            )
        return None if value is None else int(value)


def _captured(
    source: Path,
    options: CaptureOptions,
    findings: Findings,
    *,
    images: bool = True,
    in_scene: bool = False,
) -> tuple[_Capture, list[FrameRecord]]:
    """The document and its frames, but for those without pose or file.

    in_scene  whether it is read as a part of its scene of ScanNet++
    """
    if not in_scene and (scene := scene_above(source)) is not None:
        raise InputRefused(
            f"{source}: belongs to the scene of ScanNet++ in {scene}, whose mesh has other axes "
            "than its poses. Name that folder. [capture.format]"
        )
    document = read_json(source, nonfinite_below=_UNPLACED)
    frames = document.get("frames") if isinstance(document, dict) else None
    # ScanNet++ keeps those that it tests with, and says which are blurred.
    tested = document.get(TESTED, []) if isinstance(frames, list) else None
    frames = [*frames, *tested] if isinstance(frames, list) and isinstance(tested, list) else None
    if frames is None or not all(isinstance(frame, dict) for frame in frames):
        if said := other_program(source):
            raise InputRefused(f"{source}: {said}. [capture.format]")
        raise InputRefused(
            f'{source}: no list "frames" of objects, so this is not a transforms.json. Name the '
            "capture's own document. [capture.format]"
        )
    if not any({"file_path", "brackets", "video_frame"} & set(frame) for frame in frames) and (
        said := other_program(source)
    ):
        raise InputRefused(f"{source}: {said}. [capture.format]")
    capture = _Capture(
        source=source,
        document=document,
        options=options,
        pictured=Pictured(folder=source.parent, options=options),
        images=images,
        masks=images and not in_scene,
        is_legacy=has_old_axes(source, document, frames, findings, in_scene=in_scene),
    )
    warn_of_conventions(document, frames, source, findings)
    if any(any(rolling_shutter(frame)) for frame in (document, *frames)):
        warn_of_rolling_shutter(source, findings)
    sound = [(i, frame) for i, frame in enumerate(frames) if not is_bad(frame)]
    warn_of_bad(len(frames) - len(sound), len(frames), source.name, findings)
    records = [r for i, frame in sound if (r := _record(capture, frame, i, findings))]
    capture.pictured.warn_of_others(findings, source)
    _refuse_pictures_as_masks(capture, records)
    return capture, records


def _refuse_pictures_as_masks(capture: _Capture, records: Sequence[FrameRecord]) -> None:
    """InputRefused where what was found at the end of a mask's path is a picture of a frame."""
    found = set(capture.pictured.moved.values())
    pictures = {*capture.pictured.instead, *(record.image_path for record in records)}
    for record in records:
        if record.mask_path in found & pictures:
            raise capture.refuse(
                f"the mask_path of the frame {record.name!r} leads elsewhere, where nothing is, "
                f"and what is found by its end, {str(record.mask_path)!r}, is a picture of a "
                "frame. Bring the masks too, or remove the key.",
                "capture.mask",
            )


def _record(
    capture: _Capture, frame: Mapping[str, Any], number: int, findings: Findings
) -> FrameRecord | None:
    """One frame, the ``number``-th from 0 on, or None where its pose or its file is missing."""
    if "brackets" in frame:
        raise capture.refuse(
            "its frames are brackets of photographs. Make one frame of radiance of each with "
            "`usdbrdf merge-brackets`, and convert what that writes.",
            "capture.brackets",
        )
    name = frame.get("file_path")
    if name is None and "video_frame" in frame:
        raise capture.refuse(
            "its frames are those of a video. Make them frames of radiance with `usdbrdf "
            "develop-video`, and convert what that writes.",
            "capture.video",
        )
    if not isinstance(name, str) or not name.strip():
        said = "its file_path is empty" if isinstance(name, str) else "it has no file_path"
        findings.drop(f"frames[{number}]", said, "capture.file")
        return None
    width, height = capture.pixels(frame, "w"), capture.pixels(frame, "h")
    stated = width is not None and height is not None
    lens = lens_of_frame(
        {**capture.document, **frame},
        partial(capture.number, frame),
        lambda said: capture.refuse(f"the frame {name!r} {said}", "capture.camera"),
    )
    needed = capture.images or not stated
    found = filter(None, map(capture.pictured.of, as_in_addresses(name)))
    path = next(found, None) if needed else capture.source.parent / name
    if path is None:
        findings.drop(name, "the image file does not exist", "capture.file")
        return None
    pose = stated_pose(frame.get("transform_matrix"))
    if pose is None:
        findings.drop(
            name, "it has no transform_matrix of 4 x 4 finite and sensible numbers", "capture.pose"
        )
        return None
    if width is None or height is None:
        try:
            width, height, _ = image_size(path)
        except ImageRefused as error:
            findings.drop(name, clause_of(error, path), "capture.image")
            return None
        why = _why_of_another_size(capture, frame, width, height) or _why_unlike(
            capture, frame, name, width, height
        )
        if why:
            findings.drop(name, why, "capture.size")
            return None
    intrinsics = _intrinsics(capture, frame, name, lens, width, height)
    return FrameRecord(
        name=name,
        image_path=path,
        world_from_camera=capture.applied.undone(pose @ camera_axes(capture.document)),
        captured_pose=_captured_pose(capture, frame, name),
        intrinsics=intrinsics,
        resolution=(width, height),
        size_of_image=not stated,
        lens=with_skew(lens, partial(capture.number, frame), intrinsics[0]),
        mask_path=_mask(capture, frame, name),
        exposure_time=capture.positive(frame, "exposure_time") or 1.0,
        saturation_radiance=capture.positive(frame, "saturation_radiance") or math.inf,
        noise_floor_radiance=capture.number(frame, "noise_floor_radiance") or 0.0,
    )


def _captured_pose(capture: _Capture, frame: Mapping[str, Any], name: str) -> Double | None:
    """The pose before it was refined, which says that it was."""
    stated = frame.get("captured_transform_matrix")
    pose = stated_pose(stated)
    if stated is not None and (pose is None or not is_camera_matrix(pose)):
        raise capture.refuse(
            f"the captured_transform_matrix of the frame {name!r} is not a matrix of 4 x 4 finite "
            "and sensible numbers. Correct or remove it.",
            "capture.pose",
        )
    return None if pose is None else capture.applied.undone(pose @ camera_axes(capture.document))


def _intrinsics(
    capture: _Capture, frame: Mapping[str, Any], name: str, lens: Lens, width: float, height: float
) -> tuple[float, float, float, float]:
    if lens.curve == "equirectangular":
        return whole_sphere(width, height)
    number = partial(capture.positive, frame)
    refuse = partial(capture.refuse, rule="capture.camera")
    fx = number("fl_x") or focal_of_angle(number, refuse, "x", width)
    fy = number("fl_y") or focal_of_angle(number, refuse, "y", height)
    if fx is None:
        raise capture.refuse(
            f"the frame {name!r} has neither fl_x nor camera_angle_x. State the focal length in "
            "pixels.",
            "capture.camera",
        )
    cx, cy = capture.number(frame, "cx"), capture.number(frame, "cy")
    return fx, fy or fx, width / 2 if cx is None else cx, height / 2 if cy is None else cy


def _why_of_another_size(
    capture: _Capture, frame: Mapping[str, Any], width: int, height: int
) -> str:
    """Why intrinsics without a stated size do not belong to an image of this one, "" if they do."""
    said = ""
    for key, size in (("cx", width), ("cy", height)):
        centre = capture.number(frame, key)
        if not said and centre is not None and abs(centre - size / 2) > _OFF_CENTRE * size:
            said = f"{key} is {centre:g}, as of an image of about {2 * centre:.0f} pixels"
    for key, angle, size in (("fl_x", "camera_angle_x", width), ("fl_y", "camera_angle_y", height)):
        focal, across = capture.positive(frame, key), capture.positive(frame, angle)
        if not said and focal is not None and across is not None:
            stated = 2 * focal * math.tan(across / 2)
            if abs(stated - size) > _OFF_CENTRE * size:
                said = f"{key} and {angle} are those of an image of about {stated:.0f} pixels"
    return said and (
        f"the image is {width} x {height} pixels, but its {said}: either the images were scaled or "
        "the intrinsics"
    )


def _why_unlike(
    capture: _Capture, frame: Mapping[str, Any], name: str, width: int, height: int
) -> str:
    """Why an image has not the camera that it shares with the frames before, "" if it may."""
    camera = tuple(capture.number(frame, key) for key in ("fl_x", "fl_y", "cx", "cy"))
    first, *size = capture.first_of_camera.setdefault(camera, (name, width, height))
    if [width, height] == size or camera == (None,) * 4:
        return ""
    return (
        f"the image is {width} x {height} pixels, but {first!r}, which has the same intrinsics and "
        f"states no w and h either, is {size[0]} x {size[1]}"
    )


def _mask(capture: _Capture, frame: Mapping[str, Any], name: str) -> Path | None:
    mask = frame.get("mask_path")
    if mask is None or not capture.masks:
        return None
    if not isinstance(mask, str) or not mask.strip():
        said = "is empty" if isinstance(mask, str) else "is not a file name"
        raise capture.refuse(
            f"the mask_path of the frame {name!r} {said}. Name its mask, or remove the key where "
            "it has none.",
            "capture.mask",
        )
    # Its name alone is the photograph's as often as not.
    return capture.pictured.file(mask, fewest=2)


def _beside(capture: _Capture, key: str, usual: str) -> Path:
    """The file that the document names under ``key``, else the usual one beside it."""
    name = capture.document.get(key, usual)
    if not isinstance(name, str):
        raise capture.refuse(f"{key} is not a file name. Correct it.", "capture.format")
    return capture.pictured.file(name)


def _stated(capture: _Capture, key: str, known: tuple[str, ...]) -> str | None:
    """A word of the document that is one of the known ones, None where it has none."""
    word = capture.document.get(key)
    if word is not None and word not in known:
        said = f"{key} is {str(word)[:40]!r}, none of {', '.join(known)}. Correct it."
        raise capture.refuse(said, "capture.format")
    return word


def _objects(capture: _Capture) -> Path | Literal["auto"] | None:
    if capture.options.objects is not None:
        return capture.options.objects
    path = _beside(capture, "objects", "objects.json")
    return path if "objects" in capture.document or path.is_file() else None
