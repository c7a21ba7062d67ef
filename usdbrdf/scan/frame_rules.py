"""Which frames can be used: every image is read once, before anything is built on it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from usdbrdf.errors import ImageRefused, InputRefused
from usdbrdf.files.images import image_size
from usdbrdf.job.progress import progress
from usdbrdf.scan.findings import Findings
from usdbrdf.scan.frame_reading import FramePixels, read_frame
from usdbrdf.scan.scan import Frames

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
