"""Photographs as an adapter found them, and what ingest noticed and went on: sentences, numbers,
and the frames it had to leave out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Frames


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """The row of ``Frames`` that one photograph becomes.

    name                  as the capture calls it, for messages
    image_path            absolute
    world_from_camera     (4, 4) float64, OpenGL axes, not yet known to be rigid
    intrinsics            fx, fy, cx, cy in pixels, first pixel's centre at (0.5, 0.5)
    resolution            width, height that the intrinsics belong to
    exposure_time         seconds; 1 where unknown
    saturation_radiance   infinite where unknown
    noise_floor_radiance  0 where unknown
    """

    name: str
    image_path: Path
    world_from_camera: Double
    intrinsics: tuple[float, float, float, float]
    resolution: tuple[int, int]
    exposure_time: float = 1.0
    saturation_radiance: float = math.inf
    noise_floor_radiance: float = 0.0


def frames_from_records(
    records: Sequence[FrameRecord], *, encoding: str, radiometric: bool
) -> Frames:
    """The records side by side."""
    return Frames(
        image_paths=tuple(r.image_path for r in records),
        world_from_camera=np.array([r.world_from_camera for r in records]).reshape(-1, 4, 4),
        intrinsics=np.array([r.intrinsics for r in records], np.float64).reshape(-1, 4),
        resolution=np.array([r.resolution for r in records], np.int32).reshape(-1, 2),
        exposure_time=np.array([r.exposure_time for r in records], np.float64),
        saturation_radiance=np.array([r.saturation_radiance for r in records], np.float64),
        noise_floor_radiance=np.array([r.noise_floor_radiance for r in records], np.float64),
        encoding=encoding,
        radiometric=radiometric,
    )


MIN_FRAMES, _MAX_DROPPED_SHARE = 8, 0.2
_CURE = "Correct them, or leave them out of the capture."  # for rules of other adapters
_CURES = {
    "capture.pose": "Give every frame a rigid 4 x 4 transform_matrix.",
    "capture.camera": "Correct the focal lengths and principal points.",
    "capture.file": "Copy the missing images, or remove their entries.",
    "capture.image": "Export the images again as R, G, B float EXR.",
    "capture.size": "Use the images that the intrinsics are for, or state the w and h of these.",
    "capture.nonfinite": "Export again, or accept masking with --max-nonfinite.",
    "capture.saturated": "Add shorter exposures, or correct saturation_radiance.",
    "capture.black": "Remove the black frames, or correct noise_floor_radiance.",
    "capture.duplicate": "Remove the repeated frames.",
}


class DroppedFrame(NamedTuple):
    """One frame that cannot be used: its name, a clause that says why, and the rule."""

    name: str
    reason: str
    rule: str


class Findings:
    """Collected along one ingest; ends in ``Scan.warnings`` and ``Scan.counts``."""

    def __init__(self) -> None:
        self.warnings: list[str] = []
        self.counts: dict[str, int] = {}
        self.dropped: list[DroppedFrame] = []

    def warn(self, sentence: str) -> None:
        """Keep a sentence for the user. It is published, so it names files without their folder."""
        self.warnings.append(sentence)

    def count(self, name: str, number: int) -> None:
        """Add to a number that is worth recording; zeros are not."""
        if number:
            self.counts[name] = self.counts.get(name, 0) + number

    def drop(self, name: str, reason: str, rule: str) -> None:
        """Leave a frame out; ``warn_of_dropped_frames`` tells the user."""
        self.dropped.append(DroppedFrame(name, reason, rule))

    def refuse_too_few_frames(self, source: Path, total: int) -> None:
        """InputRefused if, of ``total`` frames, too many are dropped or too few are left."""
        usable = total - len(self.dropped)
        if usable >= MIN_FRAMES and len(self.dropped) <= _MAX_DROPPED_SHARE * total:
            return
        limits = f"(needed: {MIN_FRAMES}, and no more than {_MAX_DROPPED_SHARE:.0%} dropped)"
        if not self.dropped:
            raise InputRefused(
                f"{source}: {total} frames {limits}. Add photographs. [capture.frames]"
            )
        rule, worst = max(self._by_rule().items(), key=lambda item: len(item[1]))
        head = f"{source}: only {usable} of {total} frames can be used {limits}."
        if len(worst) == total and rule == "capture.nonfinite":
            head = f"{source}: no usable pixel in {total} frames."
        elif len(worst) == total and rule == "capture.saturated":
            head = f"{source}: all {total} frames are saturated, there is no HDR headroom."
        first = f"{len(worst)} of them, first {worst[0].name!r}: {worst[0].reason}."
        raise InputRefused(f"{head} {first} {_CURES.get(rule, _CURE)} [{rule}]")

    def warn_of_dropped_frames(self, source: Path, total: int) -> None:
        """One sentence per rule."""
        for rule, frames in self._by_rule().items():
            self.count("frames_dropped", len(frames))
            names = ", ".join(repr(frame.name) for frame in frames[:3])
            more = f" and {len(frames) - 3} more" if len(frames) > 3 else ""
            self.warn(
                f"{source.name}: {len(frames)} of {total} frames dropped, {names}{more}: "
                f"{frames[0].reason}. [{rule}]"
            )

    def _by_rule(self) -> dict[str, list[DroppedFrame]]:
        by_rule: dict[str, list[DroppedFrame]] = {}
        for frame in self.dropped:
            by_rule.setdefault(frame.rule, []).append(frame)
        return by_rule
