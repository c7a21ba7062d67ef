"""A capture with what goes wrong in real ones, to measure what that costs and whether it is told.

    python benchmarks/disturb_capture.py CAPTURE OUTPUT [--pose-degrees D] [--pose-mm M]
        [--exposure-drift S] [--clip RADIANCE] [--seed N] [--focal F] [--principal SHARE]
        [--shift-poses N] [--keep-every N] [--tenth-stops STOPS] [--auto-exposure]
        [--exposure-ramp STOPS] [--balance-drift STOPS] [--vignetting STOPS] [--distortion K1]
        [--encode srgb|linear]
        [--mesh-scale F] [--mesh-mm X Y Z] [--mesh-degrees X Y Z] [--move-object NAME MM]
        [--turn-faces SHARE] [--turn-objects N] [--rename-objects]

CAPTURE is a folder with transforms.json, as `samples/study`. Disturbed are, frame by frame:

    poses     turned about each axis of the camera by Gaussian angles of D degrees, and moved along
              each by Gaussian distances of M mm; each frame at the pose of that N before it
    exposure  radiance times exp(N(0, S)), as a wrong exposure time would have it: the frame's
              saturation and noise floor are wrong by the same factor; or one frame in ten times
              2^STOPS; or brighter by STOPS in all from the first to the last; or each divided by
              the middle of what it shows
    clipping  radiance cut at --clip, which becomes the saturation of frames that went further
    colour    red times 2^(STOPS / 2) and blue as much less in the last frame, from the other way in
              the first; corners 2^-STOPS, by rho^2
    encoding  pixels as sRGB encodes them, though the frames pass for linear; or its inverse
    lens      focal length times F, principal point off by a share of the width as they are told;
              or the picture as a lens of the radial k1 shows it, which is not told
    mesh      larger by F about its middle, turned about it by a rotation vector, or moved; or one
              object of it moved along x; or a share of its faces, and N whole objects, wound
              backwards; or all objects called object_NNN, without a class

The same seed gives the same capture. Files that do not change are hard links where the file system
allows; the truth stays the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from usdbrdf.files.images import read_radiance, write_exr
from usdbrdf.files.ply import write_ply
from usdbrdf.untrusted.mesh_files import mesh_from_file

DOCUMENT = "transforms.json"
# Draws of one kind do not depend on whether another kind was asked for.
POSES, EXPOSURES, FACES = 0, 1, 2

Array = npt.NDArray[np.float64]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--pose-degrees", type=float, default=0.0, metavar="D")
    parser.add_argument("--pose-mm", type=float, default=0.0, metavar="M")
    parser.add_argument("--exposure-drift", type=float, default=0.0, metavar="S")
    parser.add_argument("--clip", type=float, default=float("inf"), metavar="RADIANCE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--focal", type=float, default=1.0, metavar="F")
    parser.add_argument("--principal", type=float, default=0.0, metavar="SHARE")
    parser.add_argument("--shift-poses", type=int, default=0, metavar="N")
    parser.add_argument("--keep-every", type=int, default=1, metavar="N")
    parser.add_argument("--tenth-stops", type=float, default=0.0, metavar="STOPS")
    parser.add_argument("--exposure-ramp", type=float, default=0.0, metavar="STOPS")
    parser.add_argument("--auto-exposure", action="store_true")
    parser.add_argument("--balance-drift", type=float, default=0.0, metavar="STOPS")
    parser.add_argument("--vignetting", type=float, default=0.0, metavar="STOPS")
    parser.add_argument("--distortion", type=float, default=0.0, metavar="K1")
    parser.add_argument("--encode", choices=ENCODINGS)
    parser.add_argument("--mesh-scale", type=float, default=1.0, metavar="F")
    parser.add_argument(
        "--mesh-mm", type=float, nargs=3, default=(0, 0, 0), metavar=("X", "Y", "Z")
    )
    parser.add_argument(
        "--mesh-degrees", type=float, nargs=3, default=(0, 0, 0), metavar=("X", "Y", "Z")
    )
    parser.add_argument("--move-object", nargs=2, metavar=("NAME", "MM"))
    parser.add_argument("--turn-faces", type=float, default=0.0, metavar="SHARE")
    parser.add_argument("--turn-objects", type=int, default=0, metavar="N")
    parser.add_argument("--rename-objects", action="store_true")
    options = parser.parse_args()
    if options.output.exists():
        parser.error(f"{options.output} exists. Name a folder that does not.")

    document = json.loads((options.capture / DOCUMENT).read_text())
    images = {frame["file_path"] for frame in document["frames"]}
    frames = document["frames"] = document["frames"][:: options.keep_every]
    rng = np.random.default_rng([options.seed, EXPOSURES])
    gains = np.exp(options.exposure_drift * rng.standard_normal(len(frames)))
    gains[::10] *= 2**options.tenth_stops
    gains *= 2 ** (options.exposure_ramp * np.linspace(-0.5, 0.5, len(frames)))
    copy_unchanged(options.capture, options.output, images | {mesh_name(document)})
    disturb_mesh(options, document)
    if options.rename_objects:
        rename_objects(options.output / objects_name(document))
    for i, (frame, gain) in enumerate(zip(frames, gains, strict=True)):
        disturb_image(options.capture, options.output, frame, float(gain), options.clip)
        disturb_pixels(options, document, frame, i / (len(frames) - 1))
    for key in ("fl_x", "fl_y"):
        document[key] *= options.focal
    document["cx"] += options.principal * document["w"]
    poses = [frame["transform_matrix"] for frame in frames]
    for frame, pose in zip(frames, np.roll(poses, options.shift_poses, axis=0), strict=True):
        frame["transform_matrix"] = pose.tolist()
    if options.pose_degrees or options.pose_mm:
        rng = np.random.default_rng([options.seed, POSES])
        for frame in frames:
            pose = np.array(frame["transform_matrix"])
            angles = options.pose_degrees * rng.standard_normal(3)
            metres = options.pose_mm / 1000 * rng.standard_normal(3)
            frame["transform_matrix"] = disturbed_pose(pose, angles, metres).tolist()
    (options.output / DOCUMENT).write_text(json.dumps(document, indent=1) + "\n")
    print(f"{len(frames)} frames, gains {gains.min():.3f} to {gains.max():.3f}")
    return 0


def copy_unchanged(source: Path, target: Path, images: set[str]) -> None:
    """All files but the document and the frames."""
    for path in sorted(source.rglob("*")):
        name = path.relative_to(source)
        if path.is_file() and name.as_posix() not in {DOCUMENT, *images}:
            link_or_copy(path, target / name)


def link_or_copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def disturb_image(
    source: Path, target: Path, frame: dict[str, Any], gain: float, clip: float
) -> None:
    """Write one frame, and its limits into its record."""
    name = frame["file_path"]
    full = frame.get("saturation_radiance", float("inf"))
    if gain == 1 and clip >= full:
        link_or_copy(source / name, target / name)
        return
    # The sensor clips; the wrong exposure time is met only afterwards.
    full = min(full, clip)
    (target / name).parent.mkdir(parents=True, exist_ok=True)
    write_exr(target / name, np.minimum(read_radiance(source / name), full) * np.float32(gain))
    if np.isfinite(full):
        frame["saturation_radiance"] = full * gain
    if "noise_floor_radiance" in frame:
        frame["noise_floor_radiance"] *= gain
    if "exposure_time" in frame:
        frame["exposure_time"] /= gain


def disturb_pixels(
    options: argparse.Namespace, document: dict[str, Any], frame: dict[str, Any], time: float
) -> None:
    """What is done to the pixels of one frame, at a time from 0 to 1, and not told."""
    changed = (
        options.auto_exposure, options.balance_drift, options.vignetting, options.distortion,
        options.encode,
    )  # fmt: skip
    if not any(changed):
        return
    path = options.output / frame["file_path"]
    pixels = read_radiance(path).astype(np.float64)
    height, width = pixels.shape[:2]
    lens = [document[key] for key in ("fl_x", "fl_y", "cx", "cy")]
    row, column = np.mgrid[:height, :width] + 0.5
    if options.distortion:
        # What a pixel shows lies where the lens's inverse has it: solved by fixed-point steps.
        x, y = seen_x, seen_y = (column - lens[2]) / lens[0], (row - lens[3]) / lens[1]
        for _ in range(30):
            factor = 1 + options.distortion * (x**2 + y**2)
            x, y = seen_x / factor, seen_y / factor
        place = [y * lens[1] + lens[3] - 0.5, x * lens[0] + lens[2] - 0.5]
        shown = [map_coordinates(pixels[..., k], place, order=1, mode="nearest") for k in range(3)]
        pixels = np.stack(shown, axis=2)
    pixels *= 2 ** (options.balance_drift * (time - 0.5) * np.array([1, 0, -1]))
    radius2 = 4 * ((column - lens[2]) ** 2 + (row - lens[3]) ** 2) / (width**2 + height**2)
    pixels *= 2 ** -(options.vignetting * radius2)[..., None]
    gain = 1 / float(np.median(pixels)) if options.auto_exposure else 1.0
    # Codes are of what the sensor makes of the radiance, exposures are divided out of them.
    full = frame.get("saturation_radiance", 1.0)
    curve = ENCODINGS.get(options.encode, np.asarray)
    for key in ("saturation_radiance", "noise_floor_radiance"):
        if key in frame:
            frame[key] = float(full * gain * curve(np.array(frame[key] / full)))
    path.unlink()  # it may be a link to the capture's own
    write_exr(path, (full * gain * curve(pixels / full)).astype(np.float32))


def encoded(linear: Array) -> Array:
    """By the curve of sRGB, which goes on above 1."""
    above = 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    return np.where(linear < 0.0031308, 12.92 * linear, above)


def decoded(stored: Array) -> Array:
    """The inverse of ``encoded``."""
    above = ((np.maximum(stored, 0) + 0.055) / 1.055) ** 2.4
    return np.where(stored < 0.04045, stored / 12.92, above)


ENCODINGS = {"srgb": encoded, "linear": decoded}


def mesh_name(document: dict[str, Any]) -> str:
    """Of its file, beside the document where that does not say another."""
    return str(document.get("mesh", "mesh.ply"))


def objects_name(document: dict[str, Any]) -> str:
    """Of the file that names the objects, likewise."""
    return str(document.get("objects", "objects.json"))


def disturb_mesh(options: argparse.Namespace, document: dict[str, Any]) -> None:
    """Write the mesh, larger, turned, moved, with one object elsewhere or faces backwards."""
    name_of_mesh = mesh_name(document)
    source = options.capture / name_of_mesh
    mesh = mesh_from_file(source)
    points = mesh.points.astype(np.float64)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    moved = options.mesh_scale * (points - middle)
    if any(options.mesh_degrees):
        moved = Rotation.from_rotvec(np.radians(options.mesh_degrees)).apply(moved)
    moved = middle + moved + np.array(options.mesh_mm) / 1000
    if options.move_object:
        name, millimetres = options.move_object
        labels = json.loads((options.capture / objects_name(document)).read_text())["objects"]
        (number,) = (one["id"] for one in labels if one["name"] == name)
        own = np.unique(mesh.triangles[mesh.face_label == number])
        moved[own, 0] += float(millimetres) / 1000
    rng = np.random.default_rng([options.seed, FACES])
    backwards = rng.random(len(mesh.triangles)) < options.turn_faces
    whole = rng.choice(np.unique(mesh.face_label), options.turn_objects, replace=False)
    backwards |= np.isin(mesh.face_label, whole)
    if (moved == points).all() and not backwards.any():
        link_or_copy(source, options.output / name_of_mesh)
        return
    moved_points = moved.astype(np.float32)
    triangles = np.where(backwards[:, None], mesh.triangles[:, ::-1], mesh.triangles)
    write_ply(options.output / name_of_mesh, moved_points, triangles, mesh.face_label)


def rename_objects(path: Path) -> None:
    """Nothing of what an object is can be told by its name any more."""
    document = json.loads(path.read_text())
    for one in document["objects"]:
        one["name"] = f"object_{one['id']:03d}"
        one.pop("class_name", None)
    path.unlink()  # it may be a link to the capture's own
    path.write_text(json.dumps(document, indent=1) + "\n")


def disturbed_pose(pose: Array, degrees: Array, metres: Array) -> Array:
    """(4, 4) camera to world, turned by a rotation vector and moved in the camera's own axes."""
    result = pose.copy()
    result[:3, 3] += pose[:3, :3] @ metres
    result[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(np.radians(degrees)).as_matrix()
    return result


if __name__ == "__main__":
    sys.exit(main())
