"""Do the cameras stand where a mesh can be seen from: apart, outside of things, before surfaces?
And are they what the photographs' own headers say?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median_low

import numpy as np

from usdbrdf.capture.checks import Findings, FrameRecord, spread_evenly
from usdbrdf.capture.conventions import CONVENTIONS, UNITS
from usdbrdf.errors import InputRefused
from usdbrdf.files.exif import Headers, exif_focal_lengths, exif_lights
from usdbrdf.geometry.sides import Sides
from usdbrdf.model.arrays import Double, Float, Int
from usdbrdf.model.capture import Frames, Scan
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.options import CaptureOptions
from usdbrdf.transport.rays import RayScene

_MIN_BASELINE = 1e-3  # of the scene's diagonal
_MIN_HIT_SHARE = 0.2
_MIN_SPREAD = 0.1  # of the scene's diagonal, of cameras whose positions are read in another unit
# Times as many rays that another reading of the poses must let hit: of a mesh of a part of what the
# pictures show, any hits some.
_CLEARLY_MORE = 1.5
_LISTED = 3  # readings that are named
# Of a mesh's vertices within a picture, from which on few hits mean that it is far away.
_MIN_FRAMED_SHARE, _PROBED_POINTS = 0.8, 1000
_MAX_BEHIND = 0.5  # of a frame's rays that hit the backs of faces
# Stops by which stated exposures may differ from those of the headers, and times by which focal
# lengths may: names on dials are rounded, pictures of films cropped.
_EXIF_STOPS, _EXIF_TIMES = 1 / 3, 1.3
# Metres from cameras to what they see, in rooms and before things; and those beyond which they are
# neither, without a doubt. Units in which coordinates are written, the likelier first.
_ROOM, _NEAREST, _FARTHEST = (0.3, 12.0), 0.03, 150.0
_LIKELY_UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254}
# Frames that are probed with rays, and rays along each side of them.
_PROBED_FRAMES, _PROBED_SIDE = 64, 8


def refuse_without_parallax(frames: Frames, scene: RayScene, source: Path) -> None:
    """InputRefused where all cameras stand at one point: nothing but a panorama, or positions in
    a far larger unit than the mesh's, which is named where cameras would stand apart in it."""
    spread, diagonal = _spread(frames.world_from_camera), _diagonal(scene)
    if spread >= _MIN_BASELINE * diagonal:
        return
    hits = {name: _hit_share(scene, frames, read) for name, read in _units(scene, frames).items()}
    fit = [name for name, share in hits.items() if share >= _MIN_HIT_SHARE]
    unit = f", as they have not if they are {fit[0]}" if fit else ""
    raise InputRefused(
        f"{source}: all {len(frames)} cameras stand within {spread:.3g} of one point in a "
        f"scene {diagonal:.3g} across, there is no parallax. Capture from several places, or "
        f"check the translations of the poses, and that these and the mesh have one unit{unit}. "
        "[capture.parallax]"
    )


def _units(scene: RayScene, frames: Frames) -> dict[str, Callable[[Double], Double]]:
    """Readings of the positions in other units, but for those under which all cameras would stand
    in one place: from there everything may be hit."""
    least, poses = _MIN_SPREAD * _diagonal(scene), frames.world_from_camera
    return {n: read for n, read in UNITS.items() if _spread(np.stack([*map(read, poses)])) > least}


def _spread(poses: Double) -> float:
    """How far apart cameras (N, 4, 4) stand."""
    return float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))


def _diagonal(scene: RayScene) -> float:
    return float(np.linalg.norm(np.ptp(scene.points.astype(np.float64), axis=0)))


def refuse_rays_that_miss(frames: Frames, scene: RayScene, source: Path) -> float:
    """Share of camera rays that hit the mesh; InputRefused below 20 %, unless the mesh is a thing
    that is small in the pictures, but in the midst of them.

    The usual mix-ups of conventions are then tried, and those that would hit are named.
    """
    share = _hit_share(scene, frames, lambda pose: pose)
    if share >= _MIN_HIT_SHARE:
        return share
    tried = {name: _hit_share(scene, frames, read) for name, read in CONVENTIONS.items()}
    least = max(_MIN_HIT_SHARE, _CLEARLY_MORE * share)
    mixed_up = share == 0 or max(tried.values()) >= least
    if not mixed_up and _framed_share(scene, frames) >= _MIN_FRAMED_SHARE:
        return share
    # Of a thing that cameras stand around, any unit by which they come nearer lets more rays hit:
    # units only say what may be wrong where something is.
    units = _units(scene, frames)
    tried |= {name: _hit_share(scene, frames, read) for name, read in units.items()}
    ranked = sorted(tried.items(), key=lambda one: -one[1])
    best = ranked[0][1]
    better = [
        f"{name}: {hit:.0%}" for name, hit in ranked if hit >= max(least, best / _CLEARLY_MORE)
    ]
    if better:
        listed = "; ".join(better[:_LISTED])
        cure = f"Other readings of the poses would hit: {listed}. Convert the poses"
    else:
        cure = (
            f"None of {len(tried)} usual conventions does clearly better (best {best:.0%}). Check "
            "that mesh and poses share frame and unit"
        )
    raise InputRefused(
        f"{source}: only {share:.0%} of the camera rays hit the mesh (limit "
        f"{_MIN_HIT_SHARE:.0%}). {cure}. [capture.convention]"
    )


def with_doubts_about_unit(scan: Scan, options: CaptureOptions, *, stated: bool) -> Scan:
    """A scan, with a sentence where nobody has stated its unit and it is of no room's size and no
    thing's in the one that is taken, but in another; nothing is rescaled."""
    if stated or options.meters_per_unit or any("[capture.unit]" in w for w in scan.warnings):
        return scan
    unit, size = scan.meters_per_unit, np.ptp(scan.mesh.points.astype(np.float64), axis=0)
    if _NEAREST < unit * np.linalg.norm(size) / 2 < _FARTHEST:
        return scan
    distance = _distance(RayScene(scan.mesh.points, scan.mesh.triangles), scan.frames)
    likely = (n for n in _LIKELY_UNITS if _ROOM[0] <= _LIKELY_UNITS[n] * distance <= _ROOM[1])
    name = next(likely, None)
    if name is None or _NEAREST < unit * distance < _FARTHEST:
        return scan
    found = _LIKELY_UNITS[name]
    whole, likely_whole = (
        f"{' x '.join(f'{length:.3g}' for length in size * one)} m" for one in (unit, found)
    )
    said = (
        f"{scan.source.name}: states no unit, and one of {unit:g} m is taken, so that the mesh is "
        f"{whole} large and cameras stand {unit * distance:.3g} m from what they see, as in one of "
        f"{likely_whole} if it is in {name}. State --meters-per-unit {found:g} if it is. "
        "[capture.unit]"
    )
    return replace(scan, warnings=(*scan.warnings, said))


def _distance(scene: RayScene, frames: Frames) -> float:
    """Middle of how far cameras are from what they see; NaN where they see nothing."""
    found = []
    for i in spread_evenly(len(frames), _PROBED_FRAMES):
        hits = scene.closest(*frames.camera(i).rays(_probes() * frames.resolution[i]))
        found.append(hits.distance[hits.face >= 0])
    seen = np.concatenate(found)
    return float(np.median(seen)) if len(seen) else math.nan


def warn_of_rolling_shutter(source: Path, findings: Findings) -> None:
    """One sentence, the same for all formats that state one."""
    findings.warn(
        f"{source.name}: states a rolling_shutter, which is not undone: what a camera took while "
        "it moved is bent. Take frames with a camera that stands still. [capture.shutter]"
    )


def doubts_about_headers(
    records: Sequence[FrameRecord],
    source: Path,
    headers: Headers | None = None,
    *,
    exposures_are_stated: bool,
) -> Iterator[str]:
    """A sentence where the exposures that a capture states of its photographs, or their focal
    lengths, are not those of their EXIF data. What all exposures have in common does not count."""
    if exposures_are_stated:
        yield from _exposures_told_otherwise(records, source, headers)
    yield from _lenses_told_otherwise(records, source, headers)


def _exposures_told_otherwise(
    records: Sequence[FrameRecord], source: Path, headers: Headers | None
) -> Iterator[str]:
    lights = exif_lights([record.image_path for record in records], headers)
    told = [record for record in records if record.image_path in lights]
    if not told:
        return
    known = np.array([lights[record.image_path] for record in told])
    ratio = np.log2(known) - np.log2([record.exposure_time for record in told])
    # One of them: what lies between two halves is nobody's.
    off = np.abs(ratio - median_low(ratio.tolist()))
    if off.max() > _EXIF_STOPS:
        worst = int(off.argmax())
        yield (
            f"{source.name}: the exposures that are stated of {int((off > _EXIF_STOPS).sum())} of "
            f"{len(told)} photographs are not those of their EXIF data (time, f-number and ISO "
            f"speed), by {off[worst]:.1f} stops beside the others in {told[worst].name}, which "
            f"are {known[worst]:.3g} beside {told[worst].exposure_time:.3g} as stated. The "
            "stated ones are used: correct them, or state none, for the EXIF data to be used. "
            "[capture.exposure]"
        )


def _lenses_told_otherwise(
    records: Sequence[FrameRecord], source: Path, headers: Headers | None
) -> Iterator[str]:
    """By the photographs' middle: of one alone the header may be another's. A whole sphere has no
    focal length, whatever the headers say, which are those of the pictures that it was made of."""
    known = []
    for record in records:
        if record.lens.curve == "equirectangular":
            continue
        stated = math.sqrt(math.prod(record.intrinsics[:2]))
        if told := exif_focal_lengths(record.image_path, *record.resolution, headers):
            off = np.abs(np.log(stated / np.array(told)))
            known.append((stated, told[int(off.argmin())]))
    if not known:
        return
    times = median_low([stated / focal for stated, focal in known])
    if max(times, 1 / times) > _EXIF_TIMES:
        stated, focal = min(known, key=lambda one: abs(one[0] / one[1] - times))
        yield (
            f"{source.name}: the focal length that is stated, {stated:.0f} pixels, is {times:.2f} "
            f"times that of the photographs' EXIF data, {focal:.0f} pixels at that size. Check "
            "that the intrinsics are those of these photographs, at their size, and that these "
            "were not cropped. [capture.lens]"
        )


def drop_cameras_inside(
    frames: Frames,
    mesh: ScanMesh,
    scene: RayScene,
    sides: Sides,
    names: Sequence[str],
    findings: Findings,
) -> list[int]:
    """Indices of the frames that show surfaces from the side from which others show them; those
    that look at their backs from inside are noted in ``findings`` by their ``names``."""
    normals = mesh.face_normals
    # Of each side: few frames see it, compared with the other, and it is no sheet seen from both.
    alone = (2 * sides.frames < sides.frames[:, ::-1]) & ~sides.both[:, None]
    usable: list[int] = []
    for i in range(len(frames)):
        origins, towards = frames.camera(i).rays(_probes() * frames.resolution[i])
        face = scene.closest(origins, towards).face
        back = (towards * normals[face]).sum(axis=1) > 0
        behind = float(((face >= 0) & alone[face, back.astype(np.int64)]).mean())
        if behind > _MAX_BEHIND:
            said = f"{behind:.0%} of its rays hit surfaces from behind, as others see them"
            findings.drop(names[i], f"{said} (limit {_MAX_BEHIND:.0%})", "capture.inside")
        else:
            usable.append(i)
    return usable


def _probes() -> Double:
    """(P, 2) places in an image, in parts of its sides, at which it is probed with rays."""
    steps = (np.arange(_PROBED_SIDE) + 0.5) / _PROBED_SIDE
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def _framed_share(scene: RayScene, frames: Frames) -> float:
    """Share of the vertices that lie within a picture, in the mean over some of the frames."""
    points = scene.points[spread_evenly(len(scene.points), _PROBED_POINTS)].astype(np.float64)
    shares = []
    for i in spread_evenly(len(frames), _PROBED_FRAMES):
        camera = frames.camera(i)
        pose = camera.world_from_camera
        before = points[(points - pose[:3, 3]) @ pose[:3, 2] < 0]
        pixels = camera.project(before)
        inside = ((pixels >= 0) & (pixels <= frames.resolution[i])).all(axis=1)
        shares.append(float(inside.sum()) / len(points))
    return float(np.mean(shares))


def hit_share(points: Float, triangles: Int, frames: Frames) -> float:
    """Of the rays of some frames those that hit a mesh, (V, 3) and (F, 3)."""
    return _hit_share(RayScene(points, triangles), frames, lambda pose: pose)


def _hit_share(scene: RayScene, frames: Frames, read: Callable[[Double], Double]) -> float:
    asked = spread_evenly(len(frames), _PROBED_FRAMES)
    grid = _probes()
    hits = 0
    for i in asked:
        camera = frames.camera(i)
        camera = replace(camera, world_from_camera=read(camera.world_from_camera))
        rays = camera.rays(grid * frames.resolution[i])
        hits += int((scene.closest(*rays).face >= 0).sum())
    return hits / (len(asked) * len(grid))
