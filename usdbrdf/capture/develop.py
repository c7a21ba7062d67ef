"""Photographs through lenses -> the pinhole frames that all later steps use, resampled once, in
linear light, and written as EXR files.

Filter: Lanczos with three lobes, kept between the least and the largest of the four nearest
pixels' values, as it rings beside lamps otherwise. On edges and textures off the grid its error is
.028 of the signal; that of a cubic one is .034, of bilinear reading .047. Where one of its taps is
clipped or unknown the four nearest alone count; what they hold of a clipped pixel makes the result
clipped, of an unknown one unknown. Where the frame is coarser than the photograph, as at the poles
of a panorama, a pixel is the mean of several such values.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, lru_cache, partial
from pathlib import Path

import numpy as np
from scipy import ndimage

from usdbrdf.capture.checks import PHOTOGRAPH_SUFFIXES, Findings, FrameRecord, spread_evenly
from usdbrdf.capture.lens_views import Intrinsics, PinholeView, Size, shows_any, views_of
from usdbrdf.errors import ImageRefused, InputRefused
from usdbrdf.files.colour import kind_of_encoding, linear_space_of
from usdbrdf.files.frames import CLIPPED_SHARE, read_recorded
from usdbrdf.files.images import needs_float, read_radiance, white_of_mask, write_exr
from usdbrdf.files.naming import is_called_undistorted
from usdbrdf.job.progress import progress
from usdbrdf.kernel import kernel, parallel_kernel
from usdbrdf.model.arrays import Bool, Double, Float, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames, View
from usdbrdf.model.lens import Lens

# Where a file of the asset is written: its path there, and what writes it at a place.
Place = Callable[[str, Callable[[Path], None]], None]
_UNSAFE = r"[^A-Za-z0-9_-]"  # in names that other programs are to read
# Of what a frame is called after its photograph, whose name may fill what a file system allows.
_LONGEST = 64
_LOBES = 3
# Of a pixel's width, between which weights are interpolated: to 1e-7, as float32 holds them.
_PHASES = 4096
# Values of which a pixel is the mean, per side, at most.
_MAX_TAPS = 16
# Weights of a tap below this do not bring its fault along.
_TOUCHES = 1e-4
# Rows of a frame whose places in the photograph are computed at a time, and frames whose places
# are kept: the faces of one sphere.
_ROWS, _KEPT_MAPS = 64, 6
# In whose corners a rim is looked for, pixels of a corner's sides, and what is black there in JPEG.
_PROBED_PICTURES, _CORNER, _BLACK_VALUE = 3, 4, 2 / 255
_BESIDE_RIM = 4  # pixels beside a black rim that it reaches: half a block of JPEG


def frames_of_photographs(
    photographs: Frames, records: Sequence[FrameRecord]
) -> tuple[Frames, tuple[View | None, ...], Long]:
    """The pinhole frames of N photographs, the views that they are (see ``Scan``), and for each its
    photograph's number.

    Photographs without lens, mask and rim are frames as they are, but for 8-bit ones beside others:
    a capture has one encoding.
    """
    plain = [not (r.lens.bends or r.mask_path or r.rim) for r in records]
    if all(plain):
        return photographs, (), np.arange(len(records))
    if kind_of_encoding(photographs.encoding) != "linear":
        plain = [False] * len(records)
    numbers, paths, views = [], [], list[View | None]()
    poses, captured, intrinsics, sizes = [], [], [], []
    for k, record in enumerate(records):
        stem = _stem(k, record.image_path)
        for found in _views(record):
            turn = np.eye(4)
            turn[:3, :3] = found.photograph_from_frame
            numbers.append(k)
            poses.append(photographs.world_from_camera[k] @ turn)
            if photographs.captured_pose is not None:
                captured.append(photographs.captured_pose[k] @ turn)
            intrinsics.append(found.intrinsics)
            sizes.append(found.resolution)
            face = f".{found.face}" if found.face else ""
            paths.append(record.image_path if plain[k] else Path(f"frames/{stem}{face}.exr"))
            view = View(
                photograph=record.image_path,
                mask=record.mask_path,
                lens=record.lens,
                intrinsics=record.intrinsics,
                photograph_from_frame=found.photograph_from_frame,
                face=found.face,
                rim=record.rim,
            )
            views.append(None if plain[k] else view)
    which = np.array(numbers)
    frames = replace(
        photographs,
        image_paths=tuple(paths),
        world_from_camera=np.array(poses),
        captured_pose=np.array(captured) if captured else None,
        intrinsics=np.array(intrinsics, np.float64),
        resolution=np.array(sizes, np.int32),
        exposure_time=photographs.exposure_time[which],
        saturation_radiance=photographs.saturation_radiance[which],
        noise_floor_radiance=photographs.noise_floor_radiance[which],
        photographs=tuple(view.photograph if view else None for view in views),
        masks=tuple(view.mask if view else None for view in views),
        lenses=tuple(view.lens.described(view.intrinsics) if view else "" for view in views),
    )
    return frames, tuple(views), which


def _stem(number: int, photograph: Path) -> str:
    return f"{number:05d}_{re.sub(_UNSAFE, '_', photograph.stem)[:_LONGEST]}"


def _views(record: FrameRecord) -> list[PinholeView]:
    """The frames of a photograph, of several those alone that its mask leaves something of."""
    camera = (record.lens, record.intrinsics, record.resolution)
    found = list(views_of(*camera))
    if record.mask_path is None or len(found) == 1:
        return found
    width, height = record.resolution
    white = mask_at_size(record.mask_path, height, width)
    return [view for view in found if shows_any(view, *camera, white)]


def developed(frames: Frames, views: Sequence[View | None], folder: Path, place: Place) -> Frames:
    """The frames with images below ``folder``; those that are ``views`` of photographs (see
    ``Scan``) are handed to ``place``, one after the other.

    Images keep the encoding of the photographs where that is linear; others become so.
    """
    if not any(views):
        return frames
    some, camera = _by_camera(views), None
    for i, view in progress(some, total=len(some), label="lenses", unit="frames"):
        if camera != (camera := (view.lens, view.intrinsics)):
            _places.cache_clear()
        place(str(frames.image_paths[i]), partial(_write_frame, frames, i, view))
    for kept in (_recorded, _places, mask_at_size):
        kept.cache_clear()
    return replace(
        frames,
        image_paths=tuple(folder / path for path in frames.image_paths),
        encoding=linear_space_of(frames.encoding),
        photograph_encoding=frames.encoding,
    )


def _by_camera(views: Sequence[View | None]) -> list[tuple[int, View]]:
    """The views with their numbers, those of one camera together: the places of its pixels are
    computed once, and those of one camera alone fill memory. Faces of a photograph stay so too."""
    cameras: dict[tuple[Lens, Intrinsics], list[tuple[int, View]]] = {}
    for i, view in enumerate(views):
        if view is not None:
            cameras.setdefault((view.lens, view.intrinsics), []).append((i, view))
    return [one for together in cameras.values() for one in together]


def developed_in(frames: Frames, views: Sequence[View | None], folder: Path) -> Frames:
    """``developed`` into a folder that is there."""

    def write_there(name: str, write: Callable[[Path], None]) -> None:
        (folder / name).parent.mkdir(exist_ok=True)
        write(folder / name)

    return developed(frames, views, folder, write_there)


def _write_frame(frames: Frames, i: int, view: View, path: Path) -> None:
    saturation = float(frames.saturation_radiance[i])
    black = float(frames.noise_floor_radiance[i]) if view.rim else None
    source = _recorded(view.photograph, view.mask, frames.encoding, saturation, black)
    image = resampled(source, view, frames.camera(i), saturation)
    write_exr(
        path,
        image,
        half=not needs_float(image),
        holes=True,
        encoding=linear_space_of(frames.encoding),
    )


@lru_cache(maxsize=1)
def _recorded(
    photograph: Path, mask: Path | None, encoding: str, saturation: float, black: float | None
) -> Float:
    """(H, W, 3) of a photograph, not to be written to; NaN where it or its mask tells nothing, and
    in its rim, of what is no brighter than ``black``."""
    recorded = read_recorded(photograph, encoding, saturation).radiance
    if mask is not None:
        recorded[~mask_at_size(mask, *recorded.shape[:2])] = np.nan
    if black is not None:
        recorded[_rim_of(recorded, black)] = np.nan
    return recorded


def with_rims(
    records: Sequence[FrameRecord],
    places: tuple[Path, Path | None],
    findings: Findings,
    source: Path,
) -> list[FrameRecord]:
    """Records of which those that lie in a folder of undistorted pictures, and whose cameras bend
    nothing, have a rim if some of them are black in a corner.

    places  as of ``is_called_undistorted``
    """
    if any(record.rim for record in records):
        return list(records)
    undistorted = [
        record.image_path
        for record in records
        if not record.lens.bends and is_called_undistorted(record.image_path, places)
    ]
    some = spread_evenly(len(undistorted), _PROBED_PICTURES)
    if not any(_is_black_in_a_corner(undistorted[i]) for i in some):
        return list(records)
    findings.warn(
        f"{source.name}: {len(undistorted)} pictures that have been undistorted are black along "
        "their borders, which is left out. [capture.mask]"
    )
    concerned = set(undistorted)
    return [replace(record, rim=record.image_path in concerned) for record in records]


def _is_black_in_a_corner(picture: Path) -> bool:
    try:
        pixels = read_radiance(picture)
    except ImageRefused:  # of which the reader of its pixels will tell
        return False
    black = _BLACK_VALUE if picture.suffix.lower() in PHOTOGRAPH_SUFFIXES else 0.0
    ends = (slice(None, _CORNER), slice(-_CORNER, None))
    return any(bool((pixels[rows, columns] <= black).all()) for rows in ends for columns in ends)


def _rim_of(recorded: Float, black: float) -> Bool:
    """(H, W): what is black and hangs together with the border, and the pixels beside it: they mix
    it with the picture, and JPEG lets it shine through."""
    border = np.ones(recorded.shape[:2], np.bool_)
    border[1:-1, 1:-1] = False
    dark = ~(recorded.max(axis=2) > black)
    rim = ndimage.binary_propagation(border & dark, mask=dark)
    return np.asarray(ndimage.binary_dilation(rim, np.ones((3, 3)), _BESIDE_RIM), np.bool_)


@lru_cache(maxsize=1)
def mask_at_size(path: Path, height: int, width: int) -> Bool:
    """(H, W) where a mask's picture is not black, by its nearest pixel; InputRefused for another
    shape than the photograph's."""
    shown = white_of_mask(path)
    rows, columns = shown.shape
    if abs(columns * height - rows * width) >= max(columns, width):
        raise InputRefused(
            f"{path}: a mask of {columns} x {rows} pixels for a photograph of {width} x {height}. "
            "Export masks in the photographs' size. [capture.mask]"
        )
    down = ((np.arange(height) + 0.5) * rows / height).astype(np.int64)
    across = ((np.arange(width) + 0.5) * columns / width).astype(np.int64)
    return np.asarray(shown[down[:, None], across], np.bool_)


def resampled(source: Float, view: View, camera: Camera, saturation: float) -> Float:
    """(H, W, 3) float32: what a pinhole camera sees of a photograph, NaN where that is nothing.

    source       (h, w, 3) float32, linear, NaN where unknown
    camera       the frame's, of whose pose nothing is taken
    saturation   radiance of which 0.998 is clipped: a pixel that takes anything of a clipped one
                 gets no less in that channel
    """
    if not view.lens.bends:
        return source
    sphere = view.lens.curve == "equirectangular"
    places = _places(
        view.lens, view.intrinsics, view.face, view.photograph_from_frame.tobytes(),
        camera.intrinsics, (camera.width, camera.height),
    )  # fmt: skip
    padded = np.ascontiguousarray(_around_sphere(source) if sphere else source)
    image = np.empty((camera.height, camera.width, 3), np.float32)
    turn = float(source.shape[1]) if sphere else 0.0
    inset = _LOBES if sphere else 0
    limit = np.float32(CLIPPED_SHARE * saturation)
    _resample(
        len(image), padded, places, inset, turn, _weight_table(), limit, np.float32(saturation),
        image,
    )  # fmt: skip
    return image


def _around_sphere(source: Float) -> Float:
    """A panorama with what lies beyond its sides: its other side, and beyond a pole what lies a
    half turn away."""
    beyond = np.roll(source, source.shape[1] // 2, axis=1)
    tall = np.concatenate([beyond[:_LOBES][::-1], source, beyond[-_LOBES:][::-1]])
    return np.pad(tall, ((0, 0), (_LOBES, _LOBES), (0, 0)), mode="wrap")


@lru_cache(maxsize=_KEPT_MAPS)
def _places(
    lens: Lens,
    of_photograph: Intrinsics,
    face: str,
    turn: bytes,
    intrinsics: Intrinsics,
    resolution: Size,
) -> Float:
    """(H, W, 2) float32: where the photograph shows what the frame's pixels look at."""
    width, height = resolution
    fx, fy, cx, cy = intrinsics
    rotation = np.frombuffer(turn).reshape(3, 3)
    places = np.empty((height, width, 2), np.float32)
    x = (np.arange(width) + 0.5 - cx) / fx
    for first in range(0, height, _ROWS):
        y = (cy - np.arange(first, min(first + _ROWS, height)) - 0.5) / fy
        across, up = np.meshgrid(x, y)
        directions = np.stack([across, up, np.full_like(across, -1.0)], axis=-1) @ rotation.T
        places[first : first + len(y)] = lens.project(directions, of_photograph)
    return places


@parallel_kernel
def _resample(
    first: int, last: int, source: Float, places: Float, inset: int, turn: float,
    table: Double, limit: np.float32, saturation: np.float32, image: Float,
) -> None:  # fmt: skip
    """inset: pixels that ``source`` has been padded by; turn: pixels of a whole turn, or 0."""
    width = places.shape[1]
    for j in range(first, last):
        value, total, clipped = np.empty(3), np.empty(3), np.empty(3, np.bool_)
        weights = np.empty((2, 2 * _LOBES))
        for i in range(width):
            ux, vx = _step(places, j, i, 0, 1, turn)
            uy, vy = _step(places, j, i, 1, 0, turn)
            taps_x, taps_y = _taps(ux, vx), _taps(uy, vy)
            taps = taps_x * taps_y
            total[:] = 0.0
            clipped[:] = False
            known = True
            for tap in range(taps):
                dx = (tap // taps_y + 0.5) / taps_x - 0.5
                dy = (tap % taps_y + 0.5) / taps_y - 0.5
                u = places[j, i, 0] + dx * ux + dy * uy
                v = places[j, i, 1] + dx * vx + dy * vy
                if not _value_at(source, u, v, inset, turn, limit, table, weights, value):
                    known = False
                    break
                for c in range(3):
                    total[c] += value[c] / taps
                    clipped[c] = clipped[c] or value[c] >= limit
            for c in range(3):
                if not known:
                    image[j, i, c] = np.nan
                elif clipped[c]:
                    image[j, i, c] = max(total[c], saturation)
                else:
                    image[j, i, c] = total[c]


@kernel
def _step(
    places: Float, j: int, i: int, down: int, across: int, turn: float
) -> tuple[float, float]:
    """How far a pixel of the frame goes in the photograph, along rows or columns; 0 at its end."""
    height, width = places.shape[:2]
    j0, i0 = max(j - down, 0), max(i - across, 0)
    j1, i1 = min(j + down, height - 1), min(i + across, width - 1)
    pixels = max(j1 - j0, i1 - i0)
    if pixels == 0:
        return 0.0, 0.0
    u = np.float64(places[j1, i1, 0]) - places[j0, i0, 0]
    v = np.float64(places[j1, i1, 1]) - places[j0, i0, 1]
    if turn > 0:
        u -= turn * np.round(u / turn)
    if not (np.isfinite(u) and np.isfinite(v)):
        return 0.0, 0.0
    return u / pixels, v / pixels


@kernel
def _taps(u: float, v: float) -> int:
    """How many values a step of this length is to be the mean of; the filter alone takes care of
    a little over a pixel."""
    return min(_MAX_TAPS, max(1, int(np.ceil(np.sqrt(u * u + v * v) - 0.25))))


@kernel
def _value_at(
    source: Float, u: float, v: float, inset: int, turn: float, limit: np.float32,
    table: Double, weights: Double, value: Double,
) -> bool:  # fmt: skip
    """The photograph at a place, into ``value`` (3,); False where it is unknown there."""
    height, width = source.shape[:2]
    if turn > 0:
        u -= turn * np.floor(u / turn)
    if not (0 <= u <= width - 2 * inset and 0 <= v <= height - 2 * inset):
        return False
    x, y = u + inset - 0.5, v + inset - 0.5
    i, j = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - i, y - j
    clean = _lanczos(source, i, j, fx, fy, limit, table, weights, value)
    i0, j0 = min(max(i, 0), width - 1), min(max(j, 0), height - 1)
    i1, j1 = min(max(i + 1, 0), width - 1), min(max(j + 1, 0), height - 1)
    for c in range(3):
        p, q = source[j0, i0, c], source[j0, i1, c]
        r, s = source[j1, i0, c], source[j1, i1, c]
        if clean:
            value[c] = min(max(value[c], min(min(p, q), min(r, s))), max(max(p, q), max(r, s)))
        else:
            mean, bright, most = 0.0, False, 0.0
            for k in range(4):
                weight = (fx if k % 2 else 1 - fx) * (fy if k // 2 else 1 - fy)
                if weight > _TOUCHES:
                    one = p if k == 0 else (q if k == 1 else (r if k == 2 else s))
                    if np.isnan(one):
                        return False
                    mean += weight * one
                    bright = bright or one >= limit
                    most = max(most, one)
            value[c] = most if bright else mean
    return True


@kernel
def _lanczos(
    source: Float, i: int, j: int, fx: float, fy: float, limit: np.float32, table: Double,
    weights: Double, value: Double,
) -> bool:  # fmt: skip
    """The filter's mean into ``value``; False where one of its pixels is clipped or unknown."""
    height, width = source.shape[:2]
    first, top = i + 1 - _LOBES, j + 1 - _LOBES
    inside = first >= 0 and first + 2 * _LOBES <= width
    _set_weights(fx, table, weights[0])
    _set_weights(fy, table, weights[1])
    # Sums in variables of their own stay in registers; in an array each step waits for the last.
    red, green, blue, clean = 0.0, 0.0, 0.0, True
    for b in range(2 * _LOBES):
        row = min(max(top + b, 0), height - 1)
        line_red, line_green, line_blue = 0.0, 0.0, 0.0
        for a in range(2 * _LOBES):
            column = first + a if inside else min(max(first + a, 0), width - 1)
            weight = weights[0, a]
            p, q, s = source[row, column, 0], source[row, column, 1], source[row, column, 2]
            # NaN is no less than the limit, either.
            clean &= (p < limit) & (q < limit) & (s < limit)
            line_red += weight * p
            line_green += weight * q
            line_blue += weight * s
        if not clean:
            return False
        red += weights[1, b] * line_red
        green += weights[1, b] * line_green
        blue += weights[1, b] * line_blue
    value[0], value[1], value[2] = red, green, blue
    return True


@kernel
def _set_weights(f: float, table: Double, weights: Double) -> None:
    """The row of ``_weight_table`` for any fraction f of a pixel."""
    place = f * _PHASES
    n = int(place)
    t = place - n
    for k in range(2 * _LOBES):
        weights[k] = (1 - t) * table[n, k] + t * table[n + 1, k]


@cache
def _weight_table() -> Double:
    """(phases + 2, 2 lobes): sinc(d) sinc(d / lobes) at the distances d = a - f of the pixels
    a = 1 - lobes, ..., lobes, their sum made 1, for f from 0 on to 1 and a step beyond."""
    f = np.arange(_PHASES + 2) / _PHASES
    distance = np.arange(1 - _LOBES, _LOBES + 1) - f[:, None]
    weights = np.sinc(distance) * np.sinc(distance / _LOBES)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
