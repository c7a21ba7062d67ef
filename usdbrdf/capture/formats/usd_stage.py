"""Any USD stage as a capture: its cameras are the photographs, its meshes the surface.

A camera that names a picture (a back plate) has that one. Others find theirs by name: one of many
by its prim's name, one that moves by the number of each of its time samples. Blender and others
write the camera's data as a prim below that of the camera, whose name may be the picture's.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.camera_checks import with_doubts_about_unit
from usdbrdf.capture.checks import Findings, FrameRecord, clause_of
from usdbrdf.capture.formats.named_pictures import (
    Pictured,
    Pictures,
    drop_without_picture,
    nearest_to_radiance,
    pictures_of,
    refuse_without_pictures,
    scan_of,
    warn_of_radiance,
    warn_of_unused,
)
from usdbrdf.capture.parts import geometry_from_file, geometry_from_usd
from usdbrdf.errors import ImageRefused, InputRefused
from usdbrdf.files.images import image_size
from usdbrdf.files.naming import identifier_from, number_at_end
from usdbrdf.files.tables import files_of
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.mesh import ScanGeometry
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.usd_cameras import UsdCamera, cameras_from_usd
from usdbrdf.untrusted.usd_paths import USD_SUFFIXES

NAME = "usd"
DESCRIPTION = DESCRIPTIONS[NAME]
# Of pixels whose sides differ; beyond this an aperture was made for another shape of picture.
_MOST_SQUEEZED = 0.05


class _Shot(NamedTuple):
    """A camera at one of its times."""

    camera: UsdCamera
    i: int

    @property
    def time(self) -> float:
        """NaN where nothing changes."""
        return float(self.camera.times[self.i])

    @property
    def sampled(self) -> bool:
        """False at times between the samples of what moves."""
        return bool(self.camera.sampled[self.i])

    @property
    def name(self) -> str:
        path = self.camera.path
        return path if math.isnan(self.time) else f"{path} at {self.time:g}"


def matches(path: Path) -> bool:
    """A USD file, or a folder with one of them."""
    return _stage_of(path) is not None


def _stage_of(path: Path) -> Path | None:
    files = files_of(path, USD_SUFFIXES)
    return files[0] if len(files) == 1 else None


def read(path: Path, options: CaptureOptions) -> Scan:
    stage = _stage_of(path.resolve())
    if stage is None:
        raise InputRefused(f"{path}: no USD file, or several. Name the file. [capture.format]")
    folder, findings = stage.parent, Findings()
    found = cameras_from_usd(stage, allow=options.allow_outside)
    shots = [_Shot(camera, i) for camera in found.cameras for i in range(len(camera.times))]
    records = list(_records(shots, stage, options, findings))

    def geometry() -> ScanGeometry:
        if options.mesh is not None:
            unit = found.meters_per_unit
            return geometry_from_file(
                options.mesh,
                options.objects,
                options,
                findings,
                capture_root=folder,
                meters_per_unit=unit,
            )
        return geometry_from_usd(stage, options, findings, capture_root=folder, subsets=True)

    scan = scan_of(
        records,
        geometry,
        options,
        findings,
        adapter=NAME,
        source=stage,
        folder=folder,
        name=stage.stem,
        meters_per_unit=found.meters_per_unit,
        up_axis=found.up_axis,
    )
    return with_doubts_about_unit(scan, options, stated=found.states_unit)


def _records(
    shots: list[_Shot], stage: Path, options: CaptureOptions, findings: Findings
) -> Iterator[FrameRecord]:
    by_plate = options.frames is None and any(s.camera.images[s.i] for s in shots)
    if by_plate:
        shots = _with_places(shots, findings)
        plates = Pictured(folder=stage.parent, options=options)
        named = [(shot, _plate_file(shot, plates)) for shot in shots]
        plates.warn_of_others(findings, stage)
    else:
        pictures = pictures_of(stage.parent, options)
        refuse_without_pictures(pictures, stage)
        named = _by_name(shots, pictures)
        _warn_of_times(named, findings, stage)
        warn_of_unused(pictures, (p for _, p in named if p), findings, stage)
        warn_of_radiance(pictures.instead, findings, stage)
        if not any(image for _, image in named):
            first = min(pictures.paths).name
            raise InputRefused(
                f"{stage}: none of {len(pictures.paths)} pictures, first {first!r}, belongs to any "
                f"of {len(shots)} cameras, first {shots[0].name}. Name each picture as its camera, "
                "or end its name with the number of the camera's time sample. [capture.frames]"
            )
    others = _others(
        {shot.camera.path for shot, _ in named}, {s.camera.path for s, p in named if p}
    )
    pictured = {shot.camera.path for shot, image in named if image}
    beside = sorted({shot.camera.path for shot, _ in named} - pictured - others)
    if by_plate and beside:
        findings.warn(
            f"{stage.name}: {len(beside)} cameras beside those of the photographs name no picture, "
            f"first {beside[0]}, such as the second of a stereo pair; they are left out. "
            "[capture.file]"
        )
    for shot, image in named:
        if not shot.sampled and (image is None or not image.is_file()):
            continue
        if image is None and (by_plate or shot.camera.path in others or not math.isnan(shot.time)):
            # Other cameras, and animation that runs on between the pictures that were kept.
            findings.count("poses_without_photograph", 1)
        elif image is None:
            drop_without_picture(shot.name, findings)
        elif not image.is_file():
            findings.drop(shot.name, "the image file does not exist", "capture.file")
        else:
            yield from _record(shot, image, findings)


def _with_places(shots: list[_Shot], findings: Findings) -> list[_Shot]:
    """The shots, without those of cameras that name one picture for many times, of which nobody
    knows the one that it was taken at, or one of another camera, which stands still; and without
    those whose picture their camera names again, after another."""
    stills = {s.camera.images[0]: s.camera.path for s in shots if math.isnan(s.time)}
    why: dict[str, str] = {}
    again: set[tuple[str, str]] = set()
    for path, camera in {shot.camera.path: shot.camera for shot in shots}.items():
        files = [image for image in camera.images if image]
        if math.isnan(camera.times[0]) or not files:
            continue
        if len(files) > 1 and len({*files}) == 1:
            why[path] = f"it names one picture for {len(files)} times"
        elif other := next((stills[file] for file in files if file in stills), ""):
            why[path] = f"it moves, and names pictures of {other}, which does not"
        else:
            again |= {(path, file) for file, count in Counter(files).items() if count > 1}
    for path, said in why.items():
        findings.drop(path, said, "capture.duplicate")
    kept = []
    for shot in shots:
        image = shot.camera.images[shot.i]
        if (shot.camera.path, image) in again:
            said = f"its camera names {Path(image).name!r} again, after another"
            findings.drop(shot.name, said, "capture.duplicate")
        elif shot.camera.path not in why:
            kept.append(shot)
    return kept


def _others(cameras: set[str], pictured: set[str]) -> set[str]:
    """The cameras that are none of the photographs': below another prim than all that have a
    picture, as the views that programs keep for themselves are."""
    beside = Counter(path.rpartition("/")[0] for path in cameras)

    def place(path: str) -> str:
        above = path.rpartition("/")[0]
        # Where each camera has a prim of its own, what holds these.
        return above if beside[above] > 1 else above.rpartition("/")[0]

    places = {place(path) for path in pictured}
    return {path for path in cameras - pictured if place(path) not in places}


def _by_name(shots: list[_Shot], pictures: Pictures) -> list[tuple[_Shot, Path | None]]:
    """Each camera's picture, by its own name or by that of the prim above: first by the one that
    more of them have a picture by."""
    by_own = _found(shots, _own_names(shots), pictures)
    by_parent = _found(shots, _names_above(shots), pictures)
    first, second = sorted((by_own, by_parent), key=lambda found: -len({*found} - {None}))
    taken = set(first)
    return [
        (shot, a or (b if b not in taken else None))
        for shot, a, b in zip(shots, first, second, strict=True)
    ]


def _own_names(shots: list[_Shot]) -> list[tuple[str, ...]]:
    return [(shot.camera.path.rpartition("/")[2], shot.camera.label) for shot in shots]


def _names_above(shots: list[_Shot]) -> list[tuple[str, ...]]:
    """The name of each camera's parent, if it has no other camera below it."""
    count = Counter(path.rpartition("/")[0] for path in {shot.camera.path for shot in shots})
    parents = (shot.camera.path.rpartition("/")[0] for shot in shots)
    return [(path.rpartition("/")[2],) if path and count[path] == 1 else () for path in parents]


def _found(
    shots: list[_Shot], names_of_shots: list[tuple[str, ...]], pictures: Pictures
) -> list[Path | None]:
    """The picture of each camera that has these names: by one of them if it stands still, else by
    the number of its time, among those in a folder of its first name, or whose names begin with
    that, if it is not alone."""
    by_identifier: dict[str, list[Path]] = {}
    # Some exporters keep the suffix: A_jpg is A.jpg, also beside A.jpg.exr.
    by_whole_name: dict[str, list[Path]] = {}
    for path in pictures.paths:
        for identifier in _identifiers(path.name):
            by_whole_name.setdefault(identifier, []).append(path)
        for identifier in _identifiers(path.stem):
            by_identifier.setdefault(identifier, []).append(path)
    alone = len({shot.camera.path for shot in shots}) == 1
    numbered: dict[str, dict[float, Path]] = {}

    def found(shot: _Shot, first: str, names: tuple[str, ...]) -> Path | None:
        if math.isnan(shot.time):
            exact = next(filter(None, map(pictures.named, names)), None)
            if exact is None and len(whole := by_whole_name.get(first, [])) == 1:
                exact = pictures.named(whole[0].relative_to(pictures.folder).as_posix())
            return exact or nearest_to_radiance(by_identifier.get(first, []))
        if first not in numbered:
            starts = re.compile(rf"{first}\D?\d+")
            own = (p for p in pictures.paths if p.parent.name == first or starts.fullmatch(p.stem))
            paths = pictures.paths if alone else tuple(own)
            found = Pictures(folder=pictures.folder, paths=paths).numbered()
            numbered[first] = _by_time(found, shot.camera)
        return numbered[first].get(shot.time)

    named = zip(shots, names_of_shots, strict=True)
    return [found(shot, names[0], names) if names else None for shot, names in named]


def _by_time(numbered: dict[int, Path], camera: UsdCamera) -> dict[float, Path]:
    """Pictures by the times that they were taken at: their numbers, unless they are as many as the
    camera's time samples and counted one by one, as these are not, or elsewhere: in order then."""
    times = camera.times[camera.sampled]
    first, count = min(numbered, default=0), len(numbered)
    counted = count == len(times) and [*numbered] == [*range(first, first + count)]
    if counted and (np.any(np.diff(times) != 1) or not numbered.keys() & {*times.tolist()}):
        return dict(zip(times.tolist(), numbered.values(), strict=True))
    return {float(number): path for number, path in numbered.items()}


def _warn_of_times(
    named: list[tuple[_Shot, Path | None]], findings: Findings, source: Path
) -> None:
    """One sentence each on pictures that are taken for time samples of other numbers, and on those
    between time samples."""
    there = [(shot, image) for shot, image in named if image and not math.isnan(shot.time)]
    others = [(shot, image) for shot, image in there if number_at_end(image.stem) != shot.time]
    if others:
        shot, image = others[0]
        findings.warn(
            f"{source.name}: {len(others)} pictures are taken for the time samples of their camera "
            f"in order, as they are as many, but numbered otherwise, first {image.name!r} for "
            f"{shot.name}. Give them the numbers of their time samples if that is wrong. "
            "[capture.times]"
        )
    between = [(shot, image) for shot, image in there if not shot.sampled]
    if between:
        shot, image = between[0]
        findings.warn(
            f"{source.name}: {len(between)} of {len(there)} pictures lie between the time samples "
            f"of their camera, which is interpolated, first {image.name!r} for {shot.name}. Give "
            "them the numbers of their time samples if they were taken at these. [capture.times]"
        )


def _identifiers(stem: str) -> set[str]:
    """What exporters make of a picture's name, as that of a prim: ours, and USD's own way."""
    return {identifier_from(stem), re.sub(r"\W|^\d", "_", stem, flags=re.ASCII)}


def _plate_file(shot: _Shot, plates: Pictured) -> Path | None:
    """The picture that a camera names, existing or not; None where it names none."""
    plate, folder = shot.camera.images[shot.i], plates.folder
    if not plate:
        return None
    inside = Path(plate).is_relative_to(folder)
    relative = Path(plate).relative_to(folder).as_posix() if inside else plate
    return plates.of(relative) or Path(plate)


def _record(shot: _Shot, image: Path, findings: Findings) -> Iterator[FrameRecord]:
    try:
        width, height, _ = image_size(image)
    except ImageRefused as error:
        findings.drop(shot.name, clause_of(error, image), "capture.image")
        return
    pose, exposure = shot.camera.world_from_camera[shot.i], float(shot.camera.exposure[shot.i])
    # What a camera hangs on may scale it, which changes where it stands and not what it sees.
    size = np.cbrt(abs(np.linalg.det(pose[:3, :3]))) if np.isfinite(pose).all() else 0
    if size > 0:
        pose = pose @ np.diag([1 / size, 1 / size, 1 / size, 1])
    yield FrameRecord(
        name=shot.name,
        image_path=image,
        world_from_camera=pose,
        intrinsics=pinhole_from_lens(shot.camera.lens[shot.i], width, height),
        resolution=(width, height),
        size_of_image=True,
        exposure_time=exposure if 0 < exposure < math.inf else 1.0,
    )


def pinhole_from_lens(lens: Double, width: int, height: int) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels of a UsdGeomCamera's lens, see ``UsdCamera``, for a picture.

    A vertical aperture that is not authored (NaN), or far from the picture's shape, says nothing:
    pixels are square then.
    """
    focal, across, up, offset_x, offset_y = lens.tolist()
    if not (focal > 0 and across > 0):
        return 0.0, 0.0, 0.0, 0.0  # no lens: the frame is dropped where lenses are checked
    square = across * height / width
    if not abs(up / square - 1) <= _MOST_SQUEEZED:
        up = square
    fx, fy = focal / across * width, focal / up * height
    return fx, fy, width * (0.5 - offset_x / across), height * (0.5 + offset_y / up)
