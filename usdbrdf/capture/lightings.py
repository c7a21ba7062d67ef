"""Captures of one scene in several lightings, lamps switched between them, as one Scan.

They share mesh and objects; each has its own frames, exposures and, of 8-bit photographs, its own
unit of radiance, for nothing compares the brightness of one with another's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.native import captured_faces, captured_points
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.files.naming import identifier_from
from usdbrdf.geometry.sides import sides_from_cameras, turned_towards_cameras, with_backs
from usdbrdf.model.capture import Frames, Scan, recorded_together
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.options import IngestOptions
from usdbrdf.transport.rays import RayScene

# Points of two files that hold one mesh differ by no more than this, of its size.
_ROUNDING = 1e-6


def names_of_lightings(captures: Sequence[Path]) -> tuple[str, ...]:
    """A name for each of several captures, that of its folder; () for one alone. UsageError where
    two have the same."""
    if len(captures) == 1:
        return ()
    folders = [path if path.is_dir() else path.parent for path in captures]
    names = [identifier_from(folder.resolve().name, fallback="lighting") for folder in folders]
    count = Counter(name.lower() for name in names)
    for name, path in zip(names, captures, strict=True):
        if count[name.lower()] > 1:
            raise UsageError(
                f"{path}: two lightings would be called {name}, as their captures' folders are. "
                "Rename one of the folders. [lighting.name]"
            )
    return tuple(names)


def options_of_lightings(options: IngestOptions, names: Sequence[str]) -> dict[str, IngestOptions]:
    """What holds for the capture of each lighting: of ``options.encoding``, which may say several,
    LIGHTING=NAME with commas between, that one's; a NAME alone is that of all the others. ``names``
    is () for a single capture. UsageError for lightings that there are not, or said twice."""
    said: dict[str, str] = {}
    for text in options.encoding.split(",") if options.encoding else ():
        name, equals, encoding = (part.strip() for part in text.rpartition("="))
        if equals and name not in names:
            there = f"they are {', '.join(names)}" if names else "of one alone, say NAME"
            raise UsageError(
                f"--input-space {text}: no lighting is called {name!r}; they have the names of "
                f"their captures' folders, {there}. Correct it. [usage.option]"
            )
        if name in said or not encoding:
            problem = "it names no colour space" if not encoding else "it says one lighting twice"
            raise UsageError(
                f"--input-space {options.encoding}: {problem}. Say LIGHTING=NAME once for each. "
                "[usage.option]"
            )
        said[name] = encoding
    return {
        name: replace(options, encoding=said.get(name, said.get("")))
        for name in (tuple(names) or ("",))
    }


def scan_of_lightings(scans: Mapping[str, Scan], crease_angle_deg: float) -> Scan:
    """One scan of captures that show one scene, by the names of their lightings; of a single one
    it is that. Which side of a face is the surface all cameras tell together."""
    first = next(iter(scans.values()))
    if len(scans) == 1:
        return first
    frames = _joined(scans)
    triangles, face_object = captured_faces(first)
    # As it was turned for the first lighting's cameras, without second skins.
    mesh = ScanMesh(
        points=first.mesh.points[: captured_points(first)],
        triangles=first.mesh.triangles[: len(triangles)],
        corner_normals=first.mesh.corner_normals[: len(triangles)],
        face_object=face_object,
    )
    rays = RayScene(mesh.points, mesh.triangles)
    sides = sides_from_cameras(mesh, rays, (frames.camera(i) for i in range(len(frames))))
    referenced = first.usd_geometry is not None
    sides = with_backs(sides, mesh, rays, referenced=referenced)
    turned = np.zeros(len(triangles), np.bool_)
    turned = turned if first.turned_faces is None else first.turned_faces
    counts = Counter[str]()
    for scan in scans.values():
        counts.update(scan.counts)
    # Shares do not add up: of these the one that is to be looked at.
    for name in (name for name in counts if name.endswith("_percent")):
        counts[name] = min(s.counts[name] for s in scans.values() if name in s.counts)
    return replace(
        first,
        mesh=turned_towards_cameras(mesh, sides, first.has_normals, crease_angle_deg),
        frames=frames,
        views=(),
        turned_faces=turned ^ sides.turned,
        warnings=tuple(w for scan in scans.values() for w in scan.warnings),
        counts=dict(counts),
    )


def in_own_folder(scan: Scan, lighting: str) -> Scan:
    """The scan, whose frames that are yet to be made of photographs get a folder of the lighting's
    name: those of another may have the same names. "" for the only one."""
    if not lighting or not any(scan.views):
        return scan
    paths = zip(scan.frames.image_paths, scan.views, strict=True)
    own = tuple(p if view is None else p.parent / lighting / p.name for p, view in paths)
    return replace(scan, frames=replace(scan.frames, image_paths=own))


def refuse_other_scenes(scans: Mapping[str, Scan]) -> None:
    """InputRefused where meshes, objects or units of length differ."""
    first, *others = scans.values()
    for other in others:
        _refuse_another_scene(first, other)


def _refuse_another_scene(first: Scan, other: Scan) -> None:

    def refused(what: str, cure: str) -> InputRefused:
        return InputRefused(
            f"{other.source}: its {what} than those of {first.source}. Lightings of one scene "
            f"share their {cure}"
        )

    points, theirs = (scan.mesh.points[: captured_points(scan)] for scan in (first, other))
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    alike = points.shape == theirs.shape and np.abs(points - theirs).max() <= _ROUNDING * size
    one, another = captured_faces(first), captured_faces(other)
    if not alike or not np.array_equal(one[0], another[0]):
        counts = f"{len(another[0])} triangles are others"
        raise refused(
            counts,
            "mesh: bring both into one frame, and name one mesh for both with --mesh. "
            "[lighting.mesh]",
        )
    if first.objects != other.objects or not np.array_equal(one[1], another[1]):
        raise refused(
            "objects are others",
            "objects: name one objects.json for both with --objects. [lighting.objects]",
        )
    units = [(s.meters_per_unit, s.capture_up or s.up_axis) for s in (first, other)]
    if units[0] != units[1]:
        raise refused(
            "units are others",
            "length of a unit and up axis. State the same in options, or convert one of the "
            "captures. [lighting.units]",
        )


def _joined(scans: Mapping[str, Scan]) -> Frames:
    """The frames of all lightings, those of one after each other."""
    several = [scan.frames for scan in scans.values()]
    columns: dict[str, Any] = {}
    for field in ("world_from_camera", "intrinsics", "resolution", "exposure_time",
                  "saturation_radiance", "noise_floor_radiance"):  # fmt: skip
        columns[field] = np.concatenate([getattr(frames, field) for frames in several])
    for field, nothing in (("photographs", None), ("masks", None), ("lenses", "")):
        if any(getattr(frames, field) for frames in several):
            columns[field] = tuple(
                value for f in several for value in (getattr(f, field) or (nothing,) * len(f))
            )
    if any(frames.gain is not None for frames in several):
        gains = [np.ones(len(f)) if f.gain is None else f.gain for f in several]
        columns["gain"] = np.concatenate(gains)
    if any(frames.captured_pose is not None for frames in several):
        poses = [
            f.world_from_camera if f.captured_pose is None else f.captured_pose for f in several
        ]
        columns["captured_pose"] = np.concatenate(poses)
    columns |= recorded_together([image for f in several for image in f.recorded_each()])
    # One lens took them all, and not all tell clearly what it does.
    told = [frames.vignetting for frames in several if any(frames.vignetting)]
    columns["vignetting"] = tuple(np.mean(told or [(0.0, 0.0)], axis=0).tolist())
    return replace(
        several[0],
        image_paths=tuple(path for frames in several for path in frames.image_paths),
        lightings=tuple(name for name, scan in scans.items() for _ in scan.frames.image_paths),
        **columns,
    )
