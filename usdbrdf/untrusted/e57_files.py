"""The pictures of an E57 file: where they were taken and through what, read in a child process.

Pixels stay where they are: an E57 holds JPEG and PNG files whole, and frames are read from files.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.atomic import raise_shortage
from usdbrdf.model.arrays import Double
from usdbrdf.untrusted.bounds import read_in_child

# Of the pinhole and of the sphere, by the names of ASTM E2807.
_PINHOLE = ("focalLength", "pixelWidth", "pixelHeight", "principalPointX", "principalPointY")
_SPHERE = ("pixelWidth", "pixelHeight")
_KINDS = {"pinholeRepresentation": _PINHOLE, "sphericalRepresentation": _SPHERE}
_UNREAD_KINDS = ("cylindricalRepresentation", "visualReferenceRepresentation")
# The extension of ASTM E2807 by which Leica says that pinholes bend light, in OpenCV's terms.
_EXTENSION = "E57_LEICA_Camera_Distortion"
_TERMS = ("K1", "K2", "K3", "P1", "P2", "K4", "K5", "K6")
_CALIBRATED = ("FX", "FY", "CX", "CY")
# Of the file: signature, version, length, where its XML begins, how long that is, size of a page,
# of which the last bytes are a checksum.
_HEAD, _CHECKSUM = struct.Struct("<8s2I4Q"), 4
_LONGEST_XML = 1 << 26


@dataclass(frozen=True, kw_only=True)
class StationPicture:
    """One image2D of the file.

    name        as the file has it, "" where it has none
    kind        "pinhole" (looks down -z, y up), "spherical" (x straight ahead, z up), or the name
                of another representation
    numbers     of a pinhole: focal length, width and height of a pixel in metres, principal point
                in pixels; of a sphere: width and height of a pixel in radians
    resolution  width, height
    world_from_camera  (4, 4), metres; NaN where the file has no pose
    distortion  of a pinhole that bends light the extension's k1, k2, k3, p1, p2, k4, k5, k6; else
                ()
    calibrated  fx, fy, cx, cy in pixels that these go with, () where not all are stated
    model       what the extension calls its model of the lens
    is_masked   whether the file holds a mask of its valid pixels
    """

    name: str
    kind: str
    numbers: tuple[float, ...]
    resolution: tuple[int, int]
    world_from_camera: Double
    distortion: tuple[float, ...] = ()
    calibrated: tuple[float, ...] = ()
    model: str = ""
    is_masked: bool = False


def holds_no_pictures(path: Path) -> bool:
    """Whether a sound E57 file describes none, by a glance at its text; False where nobody can
    tell."""
    try:
        with path.open("rb") as file:
            signature, *_, begin, length, page = _HEAD.unpack(file.read(_HEAD.size))
            whole = signature == b"ASTM-E57" and page > _CHECKSUM and 0 < length < _LONGEST_XML
            if not whole or page > _LONGEST_XML:
                return False
            file.seek(begin - begin % page)
            stored = file.read(length + (length // (page - _CHECKSUM) + 2) * _CHECKSUM + page)
    except (OSError, OverflowError, struct.error) as error:
        raise_shortage(error)
        return False
    pages = (stored[i : i + page - _CHECKSUM] for i in range(0, len(stored), page))
    text = b"".join(pages)[begin % page :][:length]
    return text.rstrip().endswith(b"</e57Root>") and b"Representation" not in text


def pictures_of_e57(path: Path) -> tuple[StationPicture, ...]:
    """All pictures, in the file's order; EnvironmentFailure without pye57."""
    if find_spec("pye57") is None:
        raise EnvironmentFailure(
            f"{path}: E57 files are read with pye57, which is not installed. Install it with: pip "
            "install 'usdbrdf[e57]'. [environment.pye57]"
        )
    return read_in_child("mesh", f"{__name__}:read_here", path, tuple, parts=(StationPicture,))


def read_here(path: Path) -> tuple[StationPicture, ...]:
    """``pictures_of_e57`` in this process, which is to be a child."""
    from pye57 import libe57

    try:
        file = libe57.ImageFile(str(path), "r")
        root = file.root()
        images = root["images2D"] if root.isDefined("images2D") else []
        # Names with a prefix that the file does not declare may not even be asked for.
        declared = range(file.extensionsCount())
        bent = [file.extensionsPrefix(i) for i in declared if _EXTENSION in file.extensionsUri(i)]
        return tuple(_picture(images[i], bent) for i in range(len(images)))
    except libe57.E57Exception as error:
        raise InputRefused(
            f"{path}: damaged or no E57 file ({' '.join(str(error).split())[:160]}). Export it "
            "again. [e57.read]"
        ) from error


def _picture(image: Any, bent: Sequence[str]) -> StationPicture:
    """One picture; ``bent`` are the prefixes by which the file declares distorted lenses."""
    bent = [prefix for prefix in bent if image.isDefined(f"{prefix}:distortion")]
    kinds = [kind for kind in (*_KINDS, *_UNREAD_KINDS) if image.isDefined(kind)]
    kind = kinds[0] if kinds else _UNREAD_KINDS[-1]
    shown = image[kind] if image.isDefined(kind) else None
    pose = np.full((4, 4), np.nan)
    if image.isDefined("pose"):
        turn = _numbers(image["pose"], "rotation", {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0})
        place = _numbers(image["pose"], "translation", dict.fromkeys("xyz", 0.0))
        pose = _pose(turn, place)
    return StationPicture(
        name=str(image["name"].value()) if image.isDefined("name") else "",
        kind=kind.removesuffix("Representation"),
        numbers=tuple(_number(shown, name) for name in _KINDS.get(kind, ())),
        resolution=(_whole(shown, "imageWidth"), _whole(shown, "imageHeight")),
        world_from_camera=pose,
        is_masked=shown is not None and bool(shown.isDefined("imageMask")),
        **(_distortion(image[f"{bent[0]}:distortion"], bent[0]) if bent else {}),
    )


def _distortion(node: Any, prefix: str) -> dict[str, Any]:
    """The fields of ``StationPicture`` that the extension states."""
    terms, calibrated = (
        tuple(_number(node, f"{prefix}:CV_{name}") for name in names)
        for names in (_TERMS, _CALIBRATED)
    )
    said = f"{prefix}:Type"
    return {
        "distortion": terms if any(terms) else (),
        "calibrated": calibrated if min(calibrated) > 0 else (),
        "model": str(node[said].value()) if node.isDefined(said) else "",
    }


def _number(node: Any, name: str) -> float:
    return float(node[name].value()) if node is not None and node.isDefined(name) else 0.0


def _whole(node: Any, name: str) -> int:
    number = _number(node, name)
    return int(number) if np.isfinite(number) else 0


def _numbers(node: Any, name: str, otherwise: Mapping[str, float]) -> Double:
    if not node.isDefined(name):
        return np.array(list(otherwise.values()))
    return np.array([_number(node[name], part) for part in otherwise])


def _pose(quaternion: Double, place: Double) -> Double:
    """(4, 4) of w, x, y, z and a point; NaN where the quaternion is none."""
    length = np.linalg.norm(quaternion)
    w, x, y, z = quaternion / length if length > 0 else np.full(4, np.nan)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = place
    return pose
