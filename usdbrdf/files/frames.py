"""Pixels of a frame as radiance, with what is known about each of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import NamedTuple, TypeVar

import numpy as np

from usdbrdf.ahead import ahead
from usdbrdf.errors import ImageRefused
from usdbrdf.files.colour import (
    WORKING_SPACE,
    kind_of_encoding,
    linear_space_of,
    to_linear,
    to_working_space,
)
from usdbrdf.files.images import read_radiance, resized
from usdbrdf.files.radiance_header import factors_of_hdr
from usdbrdf.model.arrays import Bool, Double, Float
from usdbrdf.model.capture import Frames

PHOTOGRAPH_ENCODING = "srgb_rec709_scene"
# A half float stores 3.2 as 3.19922: a clipped channel is one close to the saturation.
CLIPPED_SHARE = 0.998
# Of a frame: three channels of radiance and five masks.
_BYTES_OF_PIXEL = 17
# Resampling rings a little below zero; what is further below was never light.
_RINGING = 1e-3
# Alpha of what is there, as renderers' filters leave it.
_OPAQUE = 0.99
# What a filter leaves of nothing.
_ANY = 1e-4


# An 8-bit photograph near its ends tells that a channel is bright or dark, not how much: JPEG
# compression alone moves values by several codes there. Codes 250 and 3 as linear values (the two
# pieces of the sRGB curve) at one reference exposure.
PHOTOGRAPH_SATURATION = ((250 / 255 + 0.055) / 1.055) ** 2.4
PHOTOGRAPH_NOISE_FLOOR = 3 / 255 / 12.92


@dataclass(frozen=True, kw_only=True)
class FramePixels:
    """One frame, H x W pixels.

    radiance     (H, W, 3) float32, lin_rec709_scene; NaN where ``unknown``
    valid        (H, W) bool: every channel known, not below the noise floor and not clipped
    clipped      (H, W) bool: some channel is saturated, its radiance a lower bound
    dark         (H, W) bool: some channel lies below the noise floor
    unknown      (H, W) bool: some channel is NaN, infinite or clearly negative, or transparent
    transparent  (H, W) bool: the image's alpha says that nothing, or something in part, is there
    num_clamped  pixels with a tiny negative channel, set to 0
    """

    radiance: Float
    valid: Bool
    clipped: Bool
    dark: Bool
    unknown: Bool
    transparent: Bool
    num_clamped: int

    def window(self, left: int, top: int, right: int, bottom: int) -> FramePixels:
        """The pixels of a rectangle; right and bottom are the first beyond it."""
        part = slice(top, bottom), slice(left, right)
        return FramePixels(
            radiance=self.radiance[part],
            valid=self.valid[part],
            clipped=self.clipped[part],
            dark=self.dark[part],
            unknown=self.unknown[part],
            transparent=self.transparent[part],
            num_clamped=self.num_clamped,
        )

    def at_size(self, width: int, height: int) -> FramePixels:
        """Smaller, each pixel the mean of what is known of those that it covers: valid only if all
        of them are, clipped, dark, unknown or transparent if any is."""
        if self.valid.shape == (height, width):
            return self
        flags = ~self.valid, self.clipped, self.dark, self.unknown, self.transparent
        masks = np.stack(flags, axis=-1)
        some = resized(masks.astype(np.float32), width, height) > _ANY
        weight = resized((~self.unknown)[..., None].astype(np.float32), width, height)
        total = resized(np.nan_to_num(self.radiance), width, height)
        radiance = np.where(weight > _ANY, total / np.maximum(weight, _ANY), np.float32(np.nan))
        return FramePixels(
            radiance=radiance.astype(np.float32),
            valid=~some[..., 0],
            clipped=some[..., 1],
            dark=some[..., 2],
            unknown=some[..., 3],
            transparent=some[..., 4],
            num_clamped=self.num_clamped,
        )


def read_frame(frames: Frames, i: int) -> FramePixels:
    """Read frame ``i``; ImageRefused where the file cannot be read whole.

    So is one of another size than the frame's. Limits hold for the channels as they were recorded,
    so images are judged before their primaries change.
    """
    saturation = float(frames.saturation_radiance[i])
    gain = 1.0 if frames.gain is None else float(frames.gain[i])
    encoding = frames.encoding_of(i)
    found = read_recorded(frames.image_paths[i], encoding, saturation, gain)
    recorded, unknown = found.radiance, found.unknown
    # Comparisons with NaN are False: unknown pixels are neither clipped nor dark.
    clipped = _in_any_channel(recorded >= CLIPPED_SHARE * saturation)
    dark = _in_any_channel(recorded < frames.noise_floor_radiance[i])
    space = linear_space_of(encoding)
    radiance = recorded if space == WORKING_SPACE else to_working_space(recorded, space)
    width, height = frames.resolution[i].tolist()
    # Compiled loops would read beyond the pixels that are there.
    if width and radiance.shape[:2] != (height, width):
        now = f"{radiance.shape[1]} x {radiance.shape[0]}"
        raise ImageRefused(
            f"{frames.image_paths[i]}: {now} pixels, and {width} x {height} when the capture was "
            "read. Bring the file back, or run `usdbrdf convert` with the capture again. "
            "[image.changed]"
        )
    if any(frames.vignetting):
        radiance = radiance / transmission(frames, i)[..., None]
    return FramePixels(
        radiance=radiance,
        valid=~(unknown | clipped | dark),
        clipped=clipped,
        dark=dark,
        unknown=unknown,
        transparent=found.transparent,
        num_clamped=found.num_clamped,
    )


def transmission(frames: Frames, i: int) -> Float:
    """(H, W) float32: which share of the light the lens passes to each pixel of frame ``i``."""
    width, height = (int(side) for side in frames.resolution[i])
    _, _, cx, cy = frames.intrinsics[i]
    across, down = np.arange(width) + 0.5 - cx, np.arange(height) + 0.5 - cy
    square = 4 * (across**2 + down[:, None] ** 2) / (width**2 + height**2)
    first, second = frames.vignetting
    return np.asarray(np.exp(square * (first + square * second)), np.float32)


class Recorded(NamedTuple):
    """What an image records: as of ``FramePixels``, but in ``linear_space_of`` its encoding."""

    radiance: Float
    unknown: Bool
    transparent: Bool
    num_clamped: int


def read_recorded(path: Path, encoding: str, saturation: float, gain: float = 1.0) -> Recorded:
    """What an image records; ImageRefused where it cannot be read whole.

    saturation, gain: of the frame, see ``Frames``. Channels down to -1e-3 of the frame's median are
    ringing and become 0.
    """
    stored = read_radiance(path, alpha=True)
    stored[..., :3] /= factors_of_hdr(path).astype(np.float32)
    recorded, transparent = np.ascontiguousarray(stored[..., :3]), transparent_of(stored)
    kind = kind_of_encoding(encoding)
    if kind == "log":
        recorded = to_linear(recorded, encoding)
    if kind == "display":
        # Radiance is value * reference exposure / exposure time. The adapter wrote that factor into
        # the saturation; unlike a median of exposure times it stays when frames are left out.
        scale = np.float32(saturation / PHOTOGRAPH_SATURATION)
        recorded = to_linear(recorded, encoding) * scale
    elif gain != 1:
        recorded = recorded / np.float32(gain)
    unknown = _in_any_channel(~np.isfinite(recorded)) | transparent
    ringing = ~unknown & _in_any_channel(recorded < 0)
    if ringing.any():
        lowest = -_RINGING * max(float(np.median(recorded[~unknown])), 0.0)
        below = ringing & _in_any_channel(recorded < lowest)
        ringing, unknown = ringing & ~below, unknown | below
    recorded[ringing] = np.maximum(recorded[ringing], 0)
    recorded[unknown] = np.nan
    return Recorded(recorded, unknown, transparent, int(ringing.sum()))


def transparent_of(stored: Float) -> Bool:
    """(H, W) of (H, W, 3 or 4): where alpha says that a pixel shows nothing, or something in part;
    what is seen beside it, or through it, is an artist's background and not the capture's."""
    nowhere = np.zeros(stored.shape[:2], np.bool_)
    if stored.shape[2] == 3:
        return nowhere
    alpha = stored[..., 3]
    # Some programs leave alpha empty.
    if not (alpha >= _OPAQUE).any() and (stored[..., :3] > 0).any():
        return nowhere
    # What the file does not hold, whose alpha is NaN too, is missing and not transparent.
    return np.asarray(alpha < _OPAQUE, np.bool_)


Read = Callable[[int], FramePixels]
T = TypeVar("T")


def read_frames(read: Callable[[int], T], order: Sequence[int]) -> Iterator[tuple[int, T]]:
    """Number and pixels of the frames of ``order``, or what else ``read`` makes of them, from any
    thread; that of the next ones while one is used."""
    return zip(order, ahead(read, order), strict=True)


class FrameReader:
    """Frames that are asked for again and again: the first of them, as many as fit into
    ``most_bytes`` decoded, are read once and kept, the others read each time."""

    def __init__(self, frames: Frames, most_bytes: int) -> None:
        self.frames, self.most_bytes = frames, most_bytes
        sizes = _BYTES_OF_PIXEL * frames.resolution.prod(axis=1, dtype=np.int64)
        self._num_kept = int(np.searchsorted(sizes.cumsum(), most_bytes, side="right"))
        self._kept: dict[int, FramePixels] = {}
        self._locks = [Lock() for _ in range(self._num_kept)]

    def among(self, workers: int) -> FrameReader:
        """One for each of so many, who may be on one machine: together they keep as much."""
        return FrameReader(self.frames, self.most_bytes // workers)

    def read(self, i: int) -> FramePixels:
        """Pixels of frame ``i``, not to be written to; from any thread. See ``read_frame``."""
        if i >= self._num_kept:
            return read_frame(self.frames, i)
        with self._locks[i]:
            if i not in self._kept:
                self._kept[i] = read_frame(self.frames, i)
            return self._kept[i]


def _in_any_channel(true: Bool) -> Bool:
    """(H, W) of (H, W, 3). NumPy's own any() over so short an axis takes eight times as long."""
    return true[..., 0] | true[..., 1] | true[..., 2]


def photograph_limits(exposure_time: Double) -> tuple[Double, Double]:
    """Saturation and noise floor (N,), as radiance, of photographs exposed (N,) seconds.

    The unit is the linear pixel value of a frame with the median exposure time.
    """
    scale = np.median(exposure_time) / exposure_time if len(exposure_time) else exposure_time
    return PHOTOGRAPH_SATURATION * scale, PHOTOGRAPH_NOISE_FLOOR * scale
