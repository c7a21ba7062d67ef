"""What ingest noticed and went on: sentences, numbers, and the frames it had to leave out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from usdbrdf.errors import InputRefused

MIN_FRAMES = 8
_MAX_DROPPED_SHARE = 0.2


@dataclass(frozen=True, kw_only=True)
class DroppedFrame:
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
        self.dropped.append(DroppedFrame(name=name, reason=reason, rule=rule))

    def refuse_too_few_frames(self, source: Path, total: int) -> None:
        """InputRefused if, of ``total`` frames, too many are dropped or too few are left."""
        usable = total - len(self.dropped)
        if usable < MIN_FRAMES or len(self.dropped) > _MAX_DROPPED_SHARE * total:
            raise InputRefused(_why_too_few(source, total, usable, self._by_rule()))

    def _by_rule(self) -> dict[str, list[DroppedFrame]]:
        by_rule: dict[str, list[DroppedFrame]] = {}
        for frame in self.dropped:
            by_rule.setdefault(frame.rule, []).append(frame)
        return by_rule

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


def _why_too_few(
    source: Path, total: int, usable: int, by_rule: dict[str, list[DroppedFrame]]
) -> str:
    limits = f"(needed: {MIN_FRAMES}, and no more than {_MAX_DROPPED_SHARE:.0%} dropped)"
    if not by_rule:
        return f"{source}: {total} frames {limits}. Add photographs. [capture.frames]"
    rule, worst = max(by_rule.items(), key=lambda item: len(item[1]))
    head = f"{source}: only {usable} of {total} frames can be used {limits}."
    if len(worst) == total and rule == "capture.nonfinite":
        head = f"{source}: no usable pixel in {total} frames."
    elif len(worst) == total and rule == "capture.saturated":
        head = f"{source}: all {total} frames are saturated, there is no HDR headroom."
    first = f"{len(worst)} of them, first {worst[0].name!r}: {worst[0].reason}."
    return f"{head} {first} {_CURES.get(rule, _CURE)} [{rule}]"


_CURE = "Correct them, or leave them out of the capture."  # for rules of other adapters
_CURES = {
    "capture.pose": "Give every frame a rigid 4 x 4 transform_matrix.",
    "capture.file": "Copy the missing images, or remove their entries.",
    "capture.image": "Export the images again as R, G, B float EXR.",
    "capture.size": "Use the images that the intrinsics belong to, or scale the intrinsics.",
    "capture.nonfinite": "Export again, or accept masking with --max-nonfinite.",
    "capture.saturated": "Add shorter exposures, or correct saturation_radiance.",
    "capture.black": "Remove the black frames, or correct noise_floor_radiance.",
    "capture.duplicate": "Remove the repeated frames.",
}
