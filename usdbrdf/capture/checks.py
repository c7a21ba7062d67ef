"""Photographs as an adapter found them: which frames and poses can be used, checked before hours
are spent on them, and what was noticed: sentences, numbers, frames left out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.errors import ImageRefused, InputRefused, first_of
from usdbrdf.files.atomic import sha256_of
from usdbrdf.files.colour import DISPLAY_SPACE, encoding_of_tag, kind_of_encoding, says_light
from usdbrdf.files.frames import FramePixels, read_frame, read_frames
from usdbrdf.files.images import (
    colour_tag,
    holds_whole_numbers,
    image_size,
    is_eight_bit,
    name_of_format,
    orientation_of,
    white_of_mask,
)
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Bool, Double
from usdbrdf.model.camera import is_of_turned
from usdbrdf.model.capture import Frames
from usdbrdf.model.lens import PINHOLE, Lens
from usdbrdf.model.mesh import ScanGeometry


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """The row of ``Frames`` that one photograph becomes.

    name               as the capture calls it, for messages
    image_path         absolute
    world_from_camera  (4, 4) float64, OpenGL axes, not yet known to be rigid
    intrinsics         fx, fy, cx, cy in pixels; the first pixel's centre is (0.5, 0.5)
    resolution         width, height that the intrinsics belong to
    lens               how the camera bends light before its intrinsics; a photograph through a lens
                       that bends becomes one pinhole frame or several
    mask_path          absolute: a picture of the photograph's size or shape, whose black pixels are
                       not used; or None
    rim                what is black along its border is no part of the photograph, as where its
                       lens has been undone
    captured_pose      world_from_camera before somebody refined it; None where it is as captured
    size_of_image      resolution is the image's own, for lack of a statement
    """

    name: str
    image_path: Path
    world_from_camera: Double
    intrinsics: tuple[float, float, float, float]
    resolution: tuple[int, int]
    exposure_time: float = 1.0
    saturation_radiance: float = math.inf
    noise_floor_radiance: float = 0.0
    lens: Lens = PINHOLE
    mask_path: Path | None = None
    rim: bool = False
    captured_pose: Double | None = None
    size_of_image: bool = False


def frames_from_records(
    records: Sequence[FrameRecord], *, encoding: str, radiometric: bool
) -> Frames:
    """The rows together. Poses count as refined where all are."""
    captured = [r.captured_pose for r in records if r.captured_pose is not None]
    return Frames(
        captured_pose=np.array(captured) if 0 < len(captured) == len(records) else None,
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
    "capture.pose": "Give every frame a rigid pose (in transforms.json a 4 x 4 transform_matrix).",
    "capture.alignment": "Align and calibrate these cameras, or take them out of the project.",
    "capture.camera": "Correct the focal lengths, principal points and distortion.",
    "capture.file": "Copy the missing images, name their folder with --frames, or remove their "
    "entries.",
    "capture.label": "Give each a label of its own, or put them into camera groups that are called "
    "as the folders of their pictures, and export the cameras again.",
    "capture.image": "Export the images again, as R, G, B float EXR where they are radiance.",
    "capture.alpha": "Leave them out, or export them with what they show opaque.",
    "capture.mask": "Export a mask of the photograph's size for it, or remove its entry.",
    "capture.size": "Use the images that the intrinsics are for, or state the w and h of these.",
    "capture.nonfinite": "Export again, or accept masking with --max-nonfinite.",
    "capture.saturated": "Add shorter exposures, or correct saturation_radiance.",
    "capture.black": "Remove the black frames, or correct noise_floor_radiance.",
    "capture.duplicate": "Remove the repeated frames.",
    "capture.inside": "Check that mesh and poses share frame and unit, and the axes of the poses.",
}


class DroppedFrame(NamedTuple):
    """One frame that cannot be used; reason is a clause."""

    name: str
    reason: str
    rule: str


class Findings:
    """Collected along one ingest; ends in ``Scan.warnings`` and ``Scan.counts``.

    frames, geometry  as far as they were read, for who is told why a capture was refused
    looked_at         the frames whose pixels were checked, by number
    turned            images that EXIF data turn, of which sizes do not tell whether their poses are
                      those of the pixels as stored: 2 to 8, see ``files.images.orientation_of``
    """

    def __init__(self) -> None:
        self.warnings: list[str] = []
        self.counts: dict[str, int] = {}
        self.dropped: list[DroppedFrame] = []
        self.frames: Frames | None = None
        self.geometry: ScanGeometry | None = None
        self.looked_at: list[int] = []
        self.turned: dict[Path, int] = {}

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

    def refuse_too_few_frames(self, source: Path, total: int, *, views: int = 0) -> None:
        """InputRefused if, of ``total`` frames, too many are dropped or too few are left; ``views``
        of them, where photographs through a lens become several."""
        usable = total - len(self.dropped)
        if max(usable, views) >= MIN_FRAMES and len(self.dropped) <= _MAX_DROPPED_SHARE * total:
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

    def warn_of_transparent(self, frames: Frames, usable: Sequence[int], source: Path) -> None:
        """Say how much of the usable frames, of those that were looked at, their alpha hides."""
        hidden = self.counts.get("pixels_transparent", 0)
        if hidden:
            seen = np.intersect1d(usable, self.looked_at)
            pixels = frames.resolution[seen].prod(axis=1, dtype=np.int64).sum()
            self.warn(
                f"{source.name}: {hidden / pixels:.0%} of the pixels are transparent by their "
                "alpha; what is there is not looked at. Export opaque images if it is part of the "
                "scene. [capture.alpha]"
            )

    def warn_of_dropped_frames(self, source: Path, total: int) -> None:
        """One sentence per rule."""
        for rule, frames in self._by_rule().items():
            self.count("frames_dropped", len(frames))
            names = first_of([repr(frame.name) for frame in frames])
            whose = "" if len({frame.reason for frame in frames}) == 1 else "the first, as "
            self.warn(
                f"{source.name}: {len(frames)} of {total} frames dropped, {names}: "
                f"{whose}{frames[0].reason}. [{rule}]"
            )

    def _by_rule(self) -> dict[str, list[DroppedFrame]]:
        by_rule: dict[str, list[DroppedFrame]] = {}
        for frame in self.dropped:
            by_rule.setdefault(frame.rule, []).append(frame)
        return by_rule


PHOTOGRAPH_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
# A frame with less than this share of pixels that are not clipped, or not black, says nothing.
_MIN_USEFUL_SHARE = 0.001


def refuse_photographs(
    paths: Sequence[Path], *, assume_srgb: bool, encoding: str | None = None
) -> bool:
    """True where all images are low dynamic range, False where none is; InputRefused otherwise.

    Photographs hold display values, not radiance: they are used only if the user says so. So do
    TIFF of whole numbers and PNG of 16 bits, unless their ``encoding`` is stated to be another.
    """
    said = encoding is not None and kind_of_encoding(encoding) != "display"
    photographs = [p for p in paths if _is_photograph(p) and not (said and _may_be_radiance(p))]
    if not photographs:
        return False
    if len(photographs) < len(paths):
        other = next(p for p in paths if p not in photographs)
        raise InputRefused(
            f"{photographs[0]}: a low dynamic range image in one capture with {other.name}. "
            "Use images of one kind; radiance beside a JPEG is taken for it. [capture.ldr]"
        )
    if not assume_srgb:
        unless = " as whole numbers, unless --input-space says that they are linear or logarithms"
        raise InputRefused(
            f"{photographs[0]}: {len(photographs)} frames are {name_of_format(photographs[0])}, "
            f"which does not hold radiance{unless * _may_be_radiance(photographs[0])}. Export "
            "scene-linear EXR, or accept a result that is not radiometric with --assume-srgb. "
            "[capture.ldr]"
        )
    return True


def _is_photograph(path: Path) -> bool:
    """By its name or, as telephones call JPEGs .HEIC and people anything .exr, by what it is."""
    named = path.suffix.lower() in PHOTOGRAPH_SUFFIXES
    return named or name_of_format(path) in ("JPEG", "PNG") or _may_be_radiance(path)


def _may_be_radiance(path: Path) -> bool:
    """Whether it is TIFF of whole numbers or PNG of 16 bits, which raw developers write linear."""
    with suppress(ImageRefused):
        if path.suffix.lower() in (".tif", ".tiff"):
            return holds_whole_numbers(path)
        return path.suffix.lower() == ".png" and not is_eight_bit(path)
    return False


def tagged_encoding(
    records: Sequence[FrameRecord], usual: str, findings: Findings, source: Path
) -> str:
    """The colour space that the images say they have, of which the user is told; ``usual`` where
    they say none of the same kind. InputRefused where they say several."""
    display = kind_of_encoding(usual) == "display"
    first_of: dict[str, Path] = {}
    unknown: dict[Path, str] = {}
    for record in records:
        with suppress(ImageRefused):  # of which the reader of its pixels will tell
            name, places = colour_tag(record.image_path)
            tag = encoding_of_tag(name, places)
            if tag is None and name and (display or not says_light(name)):
                unknown.setdefault(record.image_path, f"colour space is {name!r}")
            elif tag is None and places:
                said = ", ".join(f"{place:.4g}" for place in places)
                unknown.setdefault(record.image_path, f"primaries and white are {said}")
            elif tag is not None and display != ((kind := kind_of_encoding(tag)) == "display"):
                said = {"linear": "linear", "log": "logarithms"}.get(kind or "", "for a display")
                unknown.setdefault(record.image_path, f"values are {said} ({tag})")
            alike = tag is not None and (kind_of_encoding(tag) == "display") == display
            first_of.setdefault(tag if tag and alike else usual, record.image_path)
    if first_of.keys() == {DISPLAY_SPACE, "g22_rec709_scene"}:  # as many programs tag sRGB in PNG
        del first_of["g22_rec709_scene"]
    if len(first_of) > 1:
        (one, first), (other, second), *_ = first_of.items()
        raise InputRefused(
            f"{source}: the images have several colour spaces: {first.name!r} is {one}, "
            f"{second.name!r} {other}. Convert them to one, or state --input-space to have all "
            "read as one. [capture.encoding]"
        )
    if unknown:
        image, said = next(iter(unknown.items()))
        findings.warn(
            f"{source.name}: of {len(unknown)} images, first {image.name!r}, the header says that "
            f"their {said}, which is not read here: they pass for {usual}. Convert them, or state "
            "--input-space. [capture.encoding]"
        )
    tag = next(iter(first_of), usual)
    if tag != usual:
        findings.warn(
            f"{source.name}: the images say that their colour space is {tag}, and are read so. "
            "State --input-space if they are not. [capture.encoding]"
        )
    return tag


def with_masks(records: Sequence[FrameRecord], findings: Findings) -> list[FrameRecord]:
    """Records whose mask, if they name one, can be used; the others are dropped. The records have
    the sizes of their images."""
    kept: list[FrameRecord] = []
    for record in records:
        path = record.mask_path
        try:
            across, down = image_size(path)[:2] if path else record.resolution
        except ImageRefused as error:
            why = f"its mask cannot be used: {clause_of(error, path or record.image_path)}"
            findings.drop(record.name, why, "capture.mask")
            continue
        width, height = record.resolution
        if abs(width * down - height * across) >= max(across, width):
            said = f"its mask has {across} x {down} pixels, itself {width} x {height}"
            findings.drop(record.name, said, "capture.mask")
            continue
        kept.append(record)
    return kept


def at_image_size(
    records: Sequence[FrameRecord], findings: Findings, source: Path
) -> list[FrameRecord]:
    """Records with the sizes of their images, and intrinsics that belong to these.

    Images that are larger or smaller than their intrinsics say, by one factor in both axes, have
    these scaled; others, and unreadable ones, are dropped. Turned ones go to ``findings.turned``.
    """
    kept: list[FrameRecord] = []
    scaled: list[str] = []
    turned: dict[Path, int] = {}
    as_stored = False  # some image that is to be turned has the shape that its camera is for
    outside: list[str] = []
    for record in records:
        try:
            width, height, _ = image_size(record.image_path)
        except ImageRefused as error:
            findings.drop(record.name, clause_of(error, record.image_path), "capture.image")
            continue
        across, down = record.resolution
        said = f"{width} x {height} pixels, but the intrinsics are for {across} x {down}"
        orientation = orientation_of(record.image_path)
        if orientation > 4 and (width > height) == (down > across) and width != height:
            said += "; its EXIF data turn it, so save the images upright"
        elif orientation > 1:
            turned[record.image_path] = orientation
            told = not (record.size_of_image or is_of_turned(record.intrinsics, across, down))
            as_stored |= orientation > 4 and width != height and told
        # Whoever scales an image rounds its sides to whole pixels.
        if abs(width * down - height * across) >= across:
            findings.drop(record.name, said, "capture.size")
            continue
        if (width, height) != record.resolution:
            scaled.append(f"{record.name!r}: {said}")
            x, y = width / across, height / down
            fx, fy, cx, cy = record.intrinsics
            record = replace(
                record, resolution=(width, height), intrinsics=(fx * x, fy * y, cx * x, cy * y)
            )
        (x, y), (width, height) = record.intrinsics[2:], record.resolution
        if not (0 <= x <= width and 0 <= y <= height):
            outside.append(f"{record.name!r}: {x:.0f}, {y:.0f} of {width} x {height} pixels")
        kept.append(record)
    if not as_stored:  # one program made all poses
        findings.turned |= turned
    if outside:
        findings.warn(
            f"{source.name}: the principal points of {len(outside)} of {len(records)} frames lie "
            f"outside of their images, as of crops alone, first {outside[0]}. Check cx and cy. "
            "[capture.camera]"
        )
    if scaled:
        findings.warn(
            f"{source.name}: the intrinsics of {len(scaled)} of {len(records)} frames have been "
            f"scaled to the size of their images, first {scaled[0]}. Check that the images were "
            "scaled, not cropped. [capture.size]"
        )
    return kept


def check_frames(
    frames: Frames,
    names: Sequence[str],
    findings: Findings,
    *,
    max_nonfinite: float,
    most: int | None = None,
    masks: Sequence[Path | None] = (),
) -> list[int]:
    """Indices of the frames that can be used; the others are noted in ``findings`` by their
    ``names``.

    max_nonfinite  share of unknown pixels above which a frame is dropped
    masks          of the frames, where they have any; one that is black everywhere leaves nothing
    most           look at so many frames alone, evenly spread, as long as all of these can be used
    """
    some = spread_evenly(len(frames), most)
    if len(some) < len(frames) and not _any_twice(frames.image_paths):
        glance = Findings()
        _looked_through(frames, names, some, glance, max_nonfinite, masks)
        if not glance.dropped:
            findings.looked_at = some
            for name, number in glance.counts.items():
                findings.count(name, number)
            return list(range(len(frames)))
    findings.looked_at = list(range(len(frames)))
    return _looked_through(frames, names, findings.looked_at, findings, max_nonfinite, masks)


def _any_twice(paths: Sequence[Path]) -> bool:
    """Whether two files hold the same bytes."""
    of_size: dict[int, list[Path]] = {}
    for path in paths:
        of_size.setdefault(path.stat().st_size, []).append(path)
    alike = [path for same in of_size.values() if len(same) > 1 for path in same]
    return len({sha256_of(path) for path in alike}) < len(alike)


def _looked_through(
    frames: Frames,
    names: Sequence[str],
    which: Sequence[int],
    findings: Findings,
    max_nonfinite: float,
    masks: Sequence[Path | None],
) -> list[int]:
    """Of the frames ``which`` those that can be used, as ``check_frames``."""
    usable: list[int] = []
    name_of: dict[str, str] = {}

    def look(i: int) -> tuple[FramePixels, str] | str:
        path = frames.image_paths[i]
        try:
            return read_frame(frames, i), sha256_of(path)
        except ImageRefused as error:
            return clause_of(error, path)

    looks = progress(read_frames(look, which), total=len(which), label="images", unit="frames")
    for i, found in looks:
        if isinstance(found, str):
            findings.drop(names[i], found, "capture.image")
            continue
        pixels, digest = found
        if digest in name_of:
            findings.drop(names[i], f"the same image as {name_of[digest]!r}", "capture.duplicate")
            continue
        white = _white(masks[i]) if masks else None
        useless = _why_useless(pixels, white, max_nonfinite)
        if not useless and white is not None and not white.any():
            useless = "its mask is black everywhere", "capture.mask"
        if useless:
            findings.drop(names[i], *useless)
            continue
        name_of[digest] = names[i]
        usable.append(i)
        findings.count("pixels_unknown", int(pixels.unknown.sum()))
        findings.count("pixels_negative_clamped", pixels.num_clamped)
        findings.count("pixels_clipped", int(pixels.clipped.sum()))
        findings.count("pixels_transparent", int(pixels.transparent.sum()))
    return usable


def _white(mask: Path | None) -> Bool | None:
    """What a mask leaves of its picture; None without one."""
    with suppress(ImageRefused):  # of which who resamples the photograph will tell
        return None if mask is None else white_of_mask(mask)
    return None


def spread_evenly(count: int, most: int | None) -> list[int]:
    """``most`` of the numbers below ``count`` (None: all), with the first and the last."""
    if most is None or most >= count:
        return list(range(count))
    return [int(i) for i in np.unique(np.linspace(0, count - 1, most).round())]


def _why_useless(
    pixels: FramePixels, white: Bool | None, max_nonfinite: float
) -> tuple[str, str] | None:
    """Why a frame says nothing, and the rule; None if it does say something. What its mask hides
    may be unknown, and what its alpha does."""
    if white is None or white.shape != pixels.unknown.shape:
        white = np.ones_like(pixels.unknown)
    if float((~pixels.transparent).mean()) < _MIN_USEFUL_SHARE:
        return "its alpha says that nothing is there", "capture.alpha"
    unknown = float((pixels.unknown & ~pixels.transparent & white).mean())
    if unknown > max_nonfinite:
        limit = f"(limit {max_nonfinite:.0%})"
        text = f"{unknown:.0%} of the pixels are NaN, infinite or negative {limit}"
        return text, "capture.nonfinite"
    known = ~pixels.unknown
    if float((known & ~pixels.clipped).mean()) < _MIN_USEFUL_SHARE:
        return "all of its pixels are saturated", "capture.saturated"
    # With a noise floor of 0 a black pixel is not dark, but it is no light either.
    red, green, blue = np.moveaxis(pixels.radiance > 0, 2, 0)
    lit = known & (red | green | blue) & ~pixels.dark
    if float((lit | pixels.clipped).mean()) < _MIN_USEFUL_SHARE:
        return "black: no pixel rises above the noise floor", "capture.black"
    return None


def clause_of(error: ImageRefused, path: Path) -> str:
    """The reader's sentence without path and rule, which the summary adds."""
    return str(error).removeprefix(f"{path}: ").rsplit(" [", 1)[0].rstrip(".")
