"""BlocksExchange XML of ContextCapture (iTwin Capture Modeler), which Metashape, DJI Terra and
others write too: groups of photographs with one camera each; a model that was made in their frame.

A pose is the rotation from the world to the camera, whose axes CameraOrientation names (without it
OpenCV's), and the camera's centre. Pixels are counted from the middle of the first one. Models have
the origin that ``metadata.xml`` of their production states.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.reconstructions.shots import Shot, ShotCamera, scan_of_shots
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.errors import InputRefused, MeshMissing
from usdbrdf.files.paths import seen_of
from usdbrdf.files.tables import (
    Element,
    beginning_of_text,
    files_of,
    numbers_of,
    only_one,
    read_xml,
)
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import Lens, fisheye_of_turn, is_fisheye_of_turn, whole_sphere
from usdbrdf.options import CaptureOptions

NAME = "blocks-exchange"
DESCRIPTION = DESCRIPTIONS[NAME]
_METADATA = "metadata.xml"
# How deep a tile of a production lies below what tells of all.
_ABOVE = 3
_UNEVEN = 1e-6  # of an AspectRatio, which is told
_AXES = {"Right": (1, 0, 0), "Left": (-1, 0, 0), "Down": (0, 1, 0), "Up": (0, -1, 0)}
# Coordinate systems in degrees, or from the Earth's centre: by name, by what a text of WKT names
# first (those of projected systems lie within), and by EPSG's code of the horizontal part.
_DEGREES = re.compile(r"\+proj=(longlat|latlong|lonlat|latlon)\b|^\s*WGS ?84\s*$", re.IGNORECASE)
_WKT = re.compile(
    r"\b(?:PROJ(?:CS|CRS|ECTEDCRS)|(GEO(?:G?CS|CCS|GCRS|GRAPHICCRS|DCRS|DETICCRS)))\s*[\[(]",
    re.IGNORECASE,
)
_EPSG = re.compile(r"\bEPSG[:/](?:[\d.]*[:/])? *(\d+)", re.IGNORECASE)
# EPSG's codes of these, from the first to the last; from 5000 on those of whole countries.
_GLOBAL = (
    (3819, 3824), (3887, 3889), (3906, 3906), (4000, 4025), (4027, 4036), (4039, 4047),
    (4052, 4055), (4073, 4081), (4120, 4216), (4218, 4389), (4463, 4466), (4468, 4470),
    (4472, 4473), (4475, 4483), (4490, 4490), (4555, 4558), (4600, 4646), (4657, 4765),
    (4801, 4811), (4813, 4821), (4823, 4824), (4882, 4999), (5228, 5233), (5244, 5246),
    (5340, 5342), (5363, 5365), (5368, 5381), (5487, 5489), (5524, 5527), (5560, 5561),
    (6133, 6135), (6309, 6311), (6317, 6325), (6363, 6365), (6666, 6668), (6704, 6706),
    (6978, 6983), (6985, 6990), (7656, 7686), (7796, 7798), (7842, 7844), (7879, 7881),
    (7884, 7886), (7900, 7931), (8084, 8086), (8227, 8255), (8397, 8431), (8541, 8545),
    (8683, 8685), (8694, 8699), (8816, 8818), (8860, 8902), (8905, 8907), (8915, 8949),
    (8972, 9019), (9053, 9140), (9753, 9758), (9775, 9784), (9988, 9990), (10604, 10606),
)  # fmt: skip


def matches(path: Path) -> bool:
    """Such a document, or a folder with one."""
    return bool(_documents(path))


def _documents(path: Path) -> list[Path]:
    return [f for f in files_of(path, [".xml"]) if "<BlocksExchange" in beginning_of_text(f)]


def read(path: Path, options: CaptureOptions) -> Scan:
    documents, findings = _documents(path.resolve()), Findings()
    how = "Name the file that was exported of the aerotriangulation"
    source = only_one(documents, path, "documents of BlocksExchange XML", how)
    root = read_xml(source)
    block = _block(root, source, findings)
    system = _system(root, block, source)
    if any(abs(_aspect(group) - 1) > _UNEVEN for group in block.iter("Photogroup")):
        findings.warn(
            f"{source.name}: pixels that are not square; AspectRatio is taken for the focal length "
            "down its pictures in parts of that across. [capture.camera]"
        )
    tiles = seen_of(source.parent.glob("Data/*/*.obj"))
    return scan_of_shots(
        shots_of(block, _origin(source, system, options, findings), source),
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=source.parent,
        meshes=("mesh.*", "model.*", *(["Data/*/*.obj"] if len(tiles) == 1 else [])),
        tiles=partial(_refined_once, tiles, source),
        how="Put the model that was made in this block's coordinate system into this folder, with "
        f"{_METADATA} of its production",
        in_metres=bool(system),
    )


def _refined_once(tiles: list[Path], source: Path) -> list[Path]:
    """The files of a model, one of each tile; InputRefused where these have levels of detail."""
    if len({tile.parent for tile in tiles}) < len(tiles):
        raise MeshMissing(
            f"{source}: the tiles of its model in Data/ have levels of detail. Produce it without "
            "these, or name one mesh of the whole with --mesh. [mesh.missing]"
        )
    return tiles


def beside_mesh(mesh: Path) -> list[Path]:
    """The file that says the origin of a model."""
    above = mesh.resolve().parents[:_ABOVE]
    return [folder / _METADATA for folder in above if (folder / _METADATA).is_file()][:1]


def _block(root: Element, source: Path, findings: Findings) -> Element:
    """The one with most poses, of which there must be some."""
    blocks = list(root.iter("Block"))
    posed = [sum(_pose(photo, "") is not None for photo in block.iter("Photo")) for block in blocks]
    if not any(posed):
        others = (root.find(f".//Pose/Rotation/{name}") for name in ("Yaw", "Heading"))
        raise InputRefused(
            f"{source}: no photograph with rotation and centre. Export the block of the "
            "aerotriangulation. [capture.alignment]"
            if all(other is None for other in others)
            else f"{source}: its rotations are headings, pitches and rolls, which are not read. "
            "Export them as matrices, or as omega, phi and kappa. [capture.pose]"
        )
    chosen = blocks[int(np.argmax(posed))]
    if len(blocks) > 1:
        findings.warn(
            f"{source.name}: {len(blocks)} blocks; taken is {_text(chosen, 'Name')[:80]!r}, which "
            f"has most poses, {max(posed)}. [capture.format]"
        )
    return chosen


def _system(root: Element, block: Element, source: Path) -> str:
    """The definition of the block's coordinate system, which some state with each group instead;
    "" where it is stated nowhere. InputRefused where groups have several."""
    known = {_text(row, "Id"): _text(row, "Definition") for row in root.iter("SRS")}
    stated = {_text(each, "SRSId") for each in (block, *block.iter("Photogroup"))} - {""}
    # One may be listed twice, under an Id of its own of each program that added groups.
    if len({_parts(known[each]) if known.get(each) else each for each in stated}) > 1:
        raise InputRefused(
            f"{source}: its photographs are in several coordinate systems (SRSId "
            f"{', '.join(sorted(stated))[:40]}). Export the block in one. [capture.unit]"
        )
    return known.get(min(stated, default=""), "")


def _is_global(system: str) -> bool:
    """Whether coordinates of a system are degrees, or have the Earth's centre for their origin."""
    if named := _WKT.search(system):
        return named[1] is not None
    code = int(epsg[1][:9]) if (epsg := _EPSG.search(system)) else 0
    return any(low <= code <= high for low, high in _GLOBAL) or bool(_DEGREES.search(system))


def _parts(system: str) -> tuple[str, str]:
    """The horizontal and the vertical one of a coordinate system, "" where none is stated."""
    system = re.sub(r"\s", "", system).upper()
    both = re.fullmatch(r"(EPSG:\d+)\+(?:EPSG:)?(\d+)", system)
    return (both[1], both[2]) if both else (system, "")


def _origin(source: Path, system: str, options: CaptureOptions, findings: Findings) -> Double:
    """Of the model, in the block's coordinates; InputRefused where these are two systems."""
    if _is_global(system):
        raise InputRefused(
            f"{source}: its coordinates are longitudes and latitudes, or from the Earth's centre "
            f"({system[:40]}). Export the block in a local or projected coordinate system. "
            "[capture.unit]"
        )
    stated = [source.parent / _METADATA] if (source.parent / _METADATA).is_file() else []
    stated += beside_mesh(options.mesh) if options.mesh is not None else []
    if not stated:
        return np.zeros(3)
    root = read_xml(stated[-1])
    model = _text(root, "SRS")
    (theirs, their_height), (ours, our_height) = _parts(model), _parts(system)
    one_height = their_height == our_height or not (their_height and our_height)
    if theirs and ours and not (theirs == ours and one_height):
        raise InputRefused(
            f"{stated[-1]}: the model is in the coordinate system {model[:60]}, the cameras of "
            f"{source.name} are in {system[:60]}. Export both in one. [capture.unit]"
        )
    if theirs and ours and their_height != our_height:
        findings.warn(
            f"{stated[-1].name}: the model is in the coordinate system {model[:60]}, the cameras "
            f"are in {system[:60]}, of which one says nothing of heights; taken are the same. "
            "Export both in one where the model lies too high or too low. [capture.unit]"
        )
    words = _text(root, "SRSOrigin").replace(",", " ").split()
    try:
        origin = np.array(words or (0, 0, 0), np.float64)
    except ValueError:
        origin = np.zeros(0)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        raise InputRefused(
            f"{stated[-1]}: SRSOrigin is {' '.join(words)[:60]!r}, not three numbers. Bring the "
            "file of the model's production again. [document.xml]"
        )
    return origin


def _text(element: Element, name: str) -> str:
    return (element.findtext(name) or "").strip()


def _number(element: Element, name: str) -> float | None:
    numbers = numbers_of(element.find(name), 1)
    return None if numbers is None else float(numbers[0])


def shots_of(block: Element, origin: Double, source: Path) -> Iterator[Shot]:
    """The photographs of a block, in the frame whose origin that is."""
    for group in block.iter("Photogroup"):
        unset = _text(group, "ManualPose").lower() == "false"
        (camera, turn), axes = _camera(group, source), _text(group, "CameraOrientation")
        for photo in group.iter("Photo"):
            pose = None if unset else _pose(photo, axes)
            if pose is not None:
                pose[:3, :3] = pose[:3, :3] @ turn.T
                pose[:3, 3] -= origin
            apart = _text(photo, "Component") == "0"
            yield Shot(
                name=_text(photo, "ImagePath"),
                mask=_text(photo, "MaskPath"),
                camera=camera,
                world_from_camera=pose,
                problem="it is of no component of the block" if apart and pose is not None else "",
            )


def _camera_from_opencv(axes: str) -> Double:
    """(3, 3): the axes of a group's cameras, whose z is what their x and y make of it; NaN for
    words that name none."""
    words = re.fullmatch(r"X(Right|Left|Down|Up)Y(Right|Left|Down|Up)", axes or "XRightYDown")
    x, y = (np.array(_AXES[word], np.float64) for word in words.groups()) if words else (0, 0)
    rows = np.stack([x, y, np.cross(x, y)]) if words else np.zeros((3, 3))
    return rows if abs(np.linalg.det(rows)) > 0 else np.full((3, 3), np.nan)


def _pose(photo: Element, axes: str) -> Double | None:
    """(4, 4) world from camera, OpenCV's axes."""
    centre = [_number(photo, f"Pose/Center/{axis}") for axis in "xyz"]
    entries = [_number(photo, f"Pose/Rotation/M_{i}{k}") for i in range(3) for k in range(3)]
    angles = [_number(photo, f"Pose/Rotation/{name}") for name in ("Omega", "Phi", "Kappa")]
    if None not in entries:
        camera_from_world = np.array(entries, np.float64).reshape(3, 3)
    elif None not in angles:
        stated = np.radians(np.array(angles, np.float64))
        camera_from_world = Rotation.from_euler("XYZ", stated).as_matrix().T
    else:
        return None
    opencv_from_world = _camera_from_opencv(axes).T @ camera_from_world
    if None in centre or not np.isfinite(opencv_from_world).all():
        return None
    return rigid_pose(opencv_from_world.T, np.array(centre, np.float64))


def _camera(group: Element, source: Path) -> tuple[ShotCamera | None, Double]:
    """A group's, and how it is turned (3, 3) around its axis where that is of the lens."""
    width, height = (_number(group, f"ImageDimensions/{side}") for side in ("Width", "Height"))
    straight = np.eye(3)
    if width is None or height is None or not min(width, height) >= 1:
        return None, straight
    size = int(width), int(height)
    kind = _text(group, "CameraModelType") or "Perspective"
    if kind == "Spherical":
        whole = Lens(curve="equirectangular")
        return ShotCamera(resolution=size, intrinsics=whole_sphere(*size), lens=whole), straight
    skewed = _number(group, "Skew")
    if kind not in ("Perspective", "Fisheye") or skewed:
        said = "with Skew" if skewed else f"of the type {kind[:40]!r}"
        raise InputRefused(
            f"{source}: cameras {said} are not read (known: Perspective, Fisheye, Spherical). "
            "Export undistorted photographs with their own block. [capture.camera]"
        )
    focal, centre = _in_pixels(group, size)
    if kind == "Fisheye":
        matrix = _focal_matrix(group, focal)
        terms = _fisheye_terms(group, source)
        if matrix is None or not is_fisheye_of_turn(matrix, terms):
            return None, straight
        lens, focals, turn = fisheye_of_turn(matrix, terms)
        return ShotCamera(resolution=size, intrinsics=(*focals, *centre), lens=lens), turn
    radial = [_number(group, f"Distortion/{name}") or 0.0 for name in ("K1", "K2", "K3")]
    p1, p2 = (_number(group, f"Distortion/{name}") or 0.0 for name in ("P1", "P2"))
    if focal is None or not focal > 0:
        return None, straight
    camera = ShotCamera(
        resolution=size,
        intrinsics=(focal, focal * _aspect(group), *centre),
        # P1 goes with r^2 + 2 x^2, which OpenCV's p2 does.
        lens=Lens(radial=tuple(radial), tangential=(p2, p1)),
    )
    return camera, straight


def _aspect(group: Element) -> float:
    """By which the focal length is longer down a picture than across it."""
    return _number(group, "AspectRatio") or 1.0


def _focal_matrix(group: Element, focal: float | None) -> Double | None:
    """(2, 2): pixels of a fisheye per quarter of a turn, of which many state the focal length."""
    entries = [_number(group, f"FisheyeFocalMatrix/M_{i}{k}") for i in (0, 1) for k in (0, 1)]
    if None not in entries:
        return np.array(entries, np.float64).reshape(2, 2)
    if focal is None or not focal > 0:  # it would turn the picture round
        return None
    return np.diag([focal, focal * _aspect(group)]) * (np.pi / 2)


def _fisheye_terms(group: Element, source: Path) -> tuple[float, ...]:
    """P1 to P4 of a quarter of a turn."""
    first, *terms = (_number(group, f"FisheyeDistortion/P{i}") for i in range(5))
    if first:
        raise InputRefused(
            f"{source}: P0 of FisheyeDistortion is {first:g}, which leaves a hole in the middle "
            "of the picture. Calibrate the camera with P0 fixed at 0. [capture.camera]"
        )
    p1, *more = terms
    return (1.0 if p1 is None else p1, *(term or 0.0 for term in more))


def _in_pixels(group: Element, size: tuple[int, int]) -> tuple[float | None, tuple[float, float]]:
    """Focal length and principal point, the latter from the picture's corner."""
    focal, sensor = _number(group, "FocalLength"), _number(group, "SensorSize")
    pixel = _number(group, "PixelSize") or (sensor / max(size) if sensor else None)
    if focal is not None and pixel:
        focal /= pixel
    focal = _number(group, "FocalLengthPixels") or (focal if pixel else None)
    x, y = (_number(group, f"PrincipalPoint/{axis}") for axis in "xy")
    if x is not None and y is not None:
        return focal, (x + 0.5, y + 0.5)
    offsets = [_number(group, f"PrincipalPoint/{axis}mm") for axis in "xy"]
    right, down = 0.0, 0.0
    if pixel and None not in offsets:
        of_opencv = _camera_from_opencv(_text(group, "CameraOrientation")).T
        right, down, _ = (of_opencv @ [*offsets, 0.0] / pixel).tolist()
    return focal, (size[0] / 2 + right, size[1] / 2 + down)
