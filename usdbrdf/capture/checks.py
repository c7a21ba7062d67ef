"""Which frames and poses can be used: checked before hours are spent on them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from usdbrdf.capture.findings import Findings, FrameRecord
from usdbrdf.errors import ImageRefused, InputRefused
from usdbrdf.files.frames import FramePixels, read_frame
from usdbrdf.files.images import image_size
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Frames
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.transport.rays import RayScene

# A frame with less than this share of pixels that are not clipped, or not black, says nothing.
_MIN_USEFUL_SHARE = 0.001

PHOTOGRAPH_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})


@dataclass(frozen=True)
class _Refusal:
    """Why a frame is left out: a clause, and the rule."""

    reason: str
    rule: str


def refuse_photographs(paths: Sequence[Path], *, assume_srgb: bool) -> bool:
    """True where all images are low dynamic range, False where none is; InputRefused otherwise.

    Photographs hold display values, not radiance: they are used only if the user says so.
    """
    photographs = [p for p in paths if p.suffix.lower() in PHOTOGRAPH_SUFFIXES]
    if not photographs:
        return False
    if len(photographs) < len(paths):
        other = next(p for p in paths if p.suffix.lower() not in PHOTOGRAPH_SUFFIXES)
        raise InputRefused(
            f"{photographs[0]}: a low dynamic range image in one capture with {other.name}. "
            "Use images of one kind. [capture.ldr]"
        )
    if not assume_srgb:
        raise InputRefused(
            f"{photographs[0]}: {len(photographs)} frames are {photographs[0].suffix[1:].upper()}, "
            "which does not hold radiance. Export scene-linear EXR, or accept a result that is not "
            "radiometric with --assume-srgb. [capture.ldr]"
        )
    return True


def check_frames(
    frames: Frames, names: Sequence[str], findings: Findings, *, max_nonfinite: float
) -> list[int]:
    """Indices of the frames that can be used; the others are noted in ``findings``.

    names          N names for messages
    max_nonfinite  share of unknown pixels above which a frame is dropped
    """
    usable: list[int] = []
    seen: dict[str, str] = {}
    numbers = progress(range(len(frames)), total=len(frames), label="images", unit="frames")
    for i in numbers:
        refusal = _refusal(frames, i, seen, names[i], findings, max_nonfinite)
        if refusal is None:
            usable.append(i)
        else:
            findings.drop(names[i], refusal.reason, refusal.rule)
    return usable


def _refusal(
    frames: Frames,
    i: int,
    seen: dict[str, str],
    name: str,
    findings: Findings,
    max_nonfinite: float,
) -> _Refusal | None:
    path = frames.image_paths[i]
    try:
        width, height, _ = image_size(path)
        stated = (int(frames.resolution[i, 0]), int(frames.resolution[i, 1]))
        if (width, height) != stated:
            return _Refusal(_wrong_size((width, height), stated), "capture.size")
        pixels = read_frame(frames, i)
    except ImageRefused as error:
        return _Refusal(_clause(error, path), "capture.image")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest in seen:
        return _Refusal(f"the same image as {seen[digest]!r}", "capture.duplicate")
    refusal = _useless(pixels, max_nonfinite)
    if refusal is None:
        seen[digest] = name
        findings.count("pixels_unknown", int(pixels.unknown.sum()))
        findings.count("pixels_negative_clamped", pixels.num_clamped)
        findings.count("pixels_clipped", int(pixels.clipped.sum()))
    return refusal


def _useless(pixels: FramePixels, max_nonfinite: float) -> _Refusal | None:
    unknown = float(pixels.unknown.mean())
    if unknown > max_nonfinite:
        return _Refusal(
            f"{unknown:.0%} of the pixels are NaN, infinite or negative (limit "
            f"{max_nonfinite:.0%})",
            "capture.nonfinite",
        )
    known = ~pixels.unknown
    if float((known & ~pixels.clipped).mean()) < _MIN_USEFUL_SHARE:
        return _Refusal("all of its pixels are saturated", "capture.saturated")
    # With a noise floor of 0 a black pixel is not dark, but it is no light either.
    lit = known & (np.nan_to_num(pixels.radiance).max(axis=2) > 0) & ~pixels.dark
    if float((lit | pixels.clipped).mean()) < _MIN_USEFUL_SHARE:
        return _Refusal("black: no pixel rises above the noise floor", "capture.black")
    return None


def _wrong_size(found: tuple[int, int], stated: tuple[int, int]) -> str:
    text = f"{found[0]} x {found[1]} pixels, but the intrinsics are for {stated[0]} x {stated[1]}"
    across, down = found[0] / stated[0], found[1] / stated[1]
    if abs(across - down) < 1e-3 * across:
        text += f" (the image is {across:.4g} times that)"
    return text


def _clause(error: ImageRefused, path: Path) -> str:
    """The reader's sentence without path and rule, which the summary adds."""
    text = str(error).removeprefix(f"{path}: ")
    return text.rsplit(" [", 1)[0].rstrip(".")


_MAX_DEVIATION = 1e-3  # of R^T R from the identity

_ROUNDING = 1e-5  # what float32 and printed digits explain

_MIN_BASELINE = 1e-3  # of the scene's diagonal

_MIN_HIT_SHARE = 0.2

_PROBED_FRAMES = 64

_PROBED_SIDE = 8  # rays per side of a probed frame

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])

_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])

_OLD_NERFSTUDIO = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


def _inverse(pose: Double) -> Double:
    return np.asarray(np.linalg.inv(pose), np.float64)


_CONVENTIONS: dict[str, Callable[[Double], Double]] = {
    "OpenCV axes (negate columns 2 and 3)": lambda m: m @ _FLIP,
    "camera-from-world matrices (invert them)": _inverse,
    "camera-from-world with OpenCV axes (invert, then negate columns 2 and 3)": (
        lambda m: _inverse(m) @ _FLIP
    ),
    "y-up poses beside a z-up mesh": lambda m: _Z_UP_FROM_Y_UP @ m,
    "z-up poses beside a y-up mesh": lambda m: _Z_UP_FROM_Y_UP.T @ m,
    "nerfstudio's axes of 2022 (state applied_transform)": lambda m: _OLD_NERFSTUDIO @ m,
}


def rigid_records(
    records: Sequence[FrameRecord],
    findings: Findings,
    source: Path,
    *,
    pose_scale: float | None,
) -> list[FrameRecord]:
    """Records with poses made exactly rigid; frames without a finite pose are dropped.

    Almost rigid ones are snapped; scaled, sheared and mirrored ones are refused, because each of
    them is a convention that holds for the whole capture.
    """
    kept: list[FrameRecord] = []
    worst = 0.0
    for record in records:
        pose = record.world_from_camera
        if not np.isfinite(pose).all() or np.abs(pose[3] - [0, 0, 0, 1]).max() > _MAX_DEVIATION:
            findings.drop(
                record.name, "its pose is not a finite 4 x 4 camera matrix", "capture.pose"
            )
            continue
        axes = pose[:3, :3] / (pose_scale or 1.0)
        deviation = _refuse_not_rigid(axes, record.name, source, pose_scale)
        worst = max(worst, deviation)
        rigid = np.eye(4)
        left, _, right = np.linalg.svd(axes)
        rigid[:3, :3] = left @ right
        rigid[:3, 3] = pose[:3, 3]
        kept.append(replace(record, world_from_camera=rigid))
    if worst > _ROUNDING:
        findings.warn(
            f"{source.name}: camera matrices were up to {worst:.2g} off a rotation and have been "
            "made rigid. [capture.pose]"
        )
    return kept


def _refuse_not_rigid(axes: Double, name: str, source: Path, pose_scale: float | None) -> float:
    """How far the 3 x 3 axes are from a rotation; InputRefused beyond the limit."""
    gram = axes.T @ axes
    deviation = float(np.abs(gram - np.eye(3)).max())
    scale = float(np.sqrt(np.trace(gram) / 3))
    if scale == 0 or np.abs(gram / scale**2 - np.eye(3)).max() > _MAX_DEVIATION:
        raise InputRefused(
            f"{source}: the pose of {name!r} is sheared or scaled unevenly (axes of length "
            f"{', '.join(f'{length:.4g}' for length in np.sqrt(np.diag(gram)))}). Export "
            "camera-to-world matrices that are rotation and translation. [capture.pose]"
        )
    if np.linalg.det(axes) < 0:
        raise InputRefused(
            f"{source}: the pose of {name!r} is mirrored (determinant -1): OpenCV and OpenGL axes "
            "mixed? Turn y and z over together, never one axis alone. [capture.pose]"
        )
    if deviation > _MAX_DEVIATION:
        measured = scale * (pose_scale or 1.0)
        raise InputRefused(
            f"{source}: the axes of the pose of {name!r} are scaled by {measured:.6g} (limit "
            f"{_MAX_DEVIATION:g} from 1). Export rigid matrices, or, if the positions are in the "
            f"unit of the mesh, pass --pose-scale {measured:.6g}. [capture.pose]"
        )
    return deviation


def refuse_without_parallax(frames: Frames, mesh: ScanMesh, source: Path) -> None:
    """InputRefused where all cameras stand at one point: nothing but a panorama."""
    centres = frames.world_from_camera[:, :3, 3]
    spread = float(np.linalg.norm(np.ptp(centres, axis=0)))
    diagonal = float(np.linalg.norm(np.ptp(mesh.points.astype(np.float64), axis=0)))
    if spread < _MIN_BASELINE * diagonal:
        raise InputRefused(
            f"{source}: all {len(frames)} cameras stand within {spread:.3g} of one point in a "
            f"scene {diagonal:.3g} across, there is no parallax. Capture from several places, or "
            "check the translations of the poses. [capture.parallax]"
        )


def refuse_rays_that_miss(frames: Frames, mesh: ScanMesh, source: Path) -> float:
    """Share of camera rays that hit the mesh; InputRefused below 20 %.

    The usual mix-ups of conventions are then tried, and those that would hit are named.
    """
    scene = RayScene(mesh.points, mesh.triangles)
    share = _hit_share(scene, frames, lambda pose: pose)
    if share >= _MIN_HIT_SHARE:
        return share
    tried = {name: _hit_share(scene, frames, read) for name, read in _CONVENTIONS.items()}
    better = [f"{name}: {hit:.0%}" for name, hit in tried.items() if hit >= _MIN_HIT_SHARE]
    if better:
        cure = f"Other readings of the poses would hit: {'; '.join(better)}. Convert the poses"
    else:
        cure = (
            f"No usual convention does better (best {max(tried.values()):.0%}; tried: "
            f"{'; '.join(tried)}). Check that mesh and poses share frame and unit"
        )
    raise InputRefused(
        f"{source}: only {share:.0%} of the camera rays hit the mesh (limit "
        f"{_MIN_HIT_SHARE:.0%}). {cure}. [capture.convention]"
    )


def _hit_share(scene: RayScene, frames: Frames, read: Callable[[Double], Double]) -> float:
    count = min(len(frames), _PROBED_FRAMES)
    hits = rays = 0
    for i in np.linspace(0, len(frames) - 1, count).round().astype(int):
        steps = (np.arange(_PROBED_SIDE) + 0.5) / _PROBED_SIDE
        x, y = np.meshgrid(steps * frames.resolution[i, 0], steps * frames.resolution[i, 1])
        pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
        camera = frames.camera(i)
        camera = replace(camera, world_from_camera=read(camera.world_from_camera))
        hits += int((scene.closest(*camera.rays(pixels)).face >= 0).sum())
        rays += len(pixels)
    return hits / rays
