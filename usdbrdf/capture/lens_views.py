"""Which pinhole frames a photograph through a lens becomes: one, or the faces of a cube around the
camera, whichever takes clearly fewer pixels.

Nothing of the photograph is cut off, but for faces of next to nothing; faces overlap by a degree or
so, as texels at a border are not measured. Resolution: nine tenths of the photograph have at least
as many frame pixels as pixels of their own, in both directions. A panorama's pixels lie closer and
closer towards its poles, by 1 / cos(latitude): there a frame's pixel is as wide, in the middle of a
face, as the panorama's own at the equator.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from usdbrdf.model.arrays import Bool, Double
from usdbrdf.model.lens import Lens, whole_sphere

Intrinsics = tuple[float, float, float, float]
Size = tuple[int, int]


class PinholeView(NamedTuple):
    """One frame: its face ("" where there is one frame only), (3, 3) rotation of its directions
    into the photograph's camera, its intrinsics and size."""

    face: str
    photograph_from_frame: Double
    intrinsics: Intrinsics
    resolution: Size


# Directions of a face's camera (x right, y up, z backwards) in the photograph's.
_FACES = {
    "front": np.eye(3),
    "right": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "left": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "up": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "down": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "back": np.diag([-1.0, 1, -1]),
}
# tan(46 degrees): how far faces reach from their middle.
_REACH = math.tan(math.radians(46))
# Points to a side at which a face is probed; a single frame reaches that far off its axis at most.
_PROBES = 129
_ANGLES = 20_001  # at which a lens is probed
_STEEPEST = math.radians(80)
# One frame is better than faces with less than half of its pixels.
_WORTH_FACES = 2.0
_KEEPS_DETAIL = 0.9
# What no photograph's distortion does: leave so much of the picture without directions, squeeze the
# angle of its border to that share (of lenses that draw straight to the second: pincushions stretch
# a picture by a tenth, not to twice its size), move the border aside by that share of its distance.
_LEAST_IMAGED, _LEAST_ANGLE, _MOST_ASIDE = 0.25, (0.25, 0.6), 0.5
# Of a sphere's width, by which its height may be off half of it.
_OFF_SPHERE = 0.01
# A face narrower than that shows no texel.
_FEWEST_PIXELS = 8


@lru_cache(maxsize=256)
def pinhole_views(lens: Lens, intrinsics: Intrinsics, resolution: Size) -> tuple[PinholeView, ...]:
    """The frames of photographs with this camera; () where it images nothing at all."""
    square = (-_REACH, _REACH, -_REACH, _REACH)
    camera = (lens, intrinsics, resolution)
    faces = {name: _probed(camera, turn, square) for name, turn in _FACES.items()}
    faces = {name: face for name, face in faces.items() if face.inside.any()}
    if not faces:
        return ()
    steepest = max(
        float(np.arccos(-(face.directions[face.inside] @ _FACES[name].T)[:, 2].clip(-1, 1)).max())
        for name, face in faces.items()
    )
    views = _cropped(lens, intrinsics, faces)
    if steepest < _STEEPEST:
        # As wide as the farthest of the probes, and some more.
        reach = math.tan(min(steepest + 2 / _PROBES, _STEEPEST))
        whole = _probed(camera, np.eye(3), (-reach, reach, -reach, reach))
        (one,) = _cropped(lens, intrinsics, {"front": whole})
        if math.prod(one.resolution) <= _WORTH_FACES * sum(math.prod(v.resolution) for v in views):
            return (one._replace(face=""),)
    return tuple(view for view in views if min(view.resolution) >= _FEWEST_PIXELS)


@lru_cache(maxsize=256)
def why_no_lens(lens: Lens, intrinsics: Intrinsics, resolution: Size) -> str:
    """Why no photograph of this size has this lens, a clause; "" where it may have it."""
    fx, fy, cx, cy = intrinsics
    width, height = resolution
    said = f"its lens, {lens.described(intrinsics)}, "
    if lens.curve == "equirectangular":
        whole = np.allclose(intrinsics, whole_sphere(width, height))
        if whole and abs(width - 2 * height) > _OFF_SPHERE * width:
            return f"it has {width} x {height} pixels, which no whole sphere has: it is 2 : 1"
        return ""
    if not lens.bends:
        return ""
    x, y = np.meshgrid(np.linspace(0, width, _PROBES), np.linspace(0, height, _PROBES))
    distance = np.hypot((x - cx) / fx, (y - cy) / fy)
    angles = np.linspace(0, lens.widest_angle, _ANGLES)
    reached = lens.distance(angles)
    imaged = float((distance <= reached[-1]).mean())
    if not imaged >= _LEAST_IMAGED:
        return f"{said}turns back: {1 - imaged:.0%} of its pixels have no direction"
    rim = min(float(distance.max()), float(reached[-1]))
    angle = float(np.interp(rim, reached, angles))
    plain = np.linspace(0, lens.undistorted.widest_angle, _ANGLES)
    straight = float(np.interp(rim, lens.undistorted.distance(plain), plain))
    if not angle >= _LEAST_ANGLE[lens.curve == "perspective"] * straight:
        return (
            f"{said}shows {math.degrees(angle):.2g} degrees off its axis in the corner, "
            f"undistorted it would be {math.degrees(straight):.2g}"
        )
    if not (aside := lens.aside(angle)) <= _MOST_ASIDE:
        return f"{said}moves its corners aside by {aside:.2g} times their distance"
    return ""


def views_of(lens: Lens, intrinsics: Intrinsics, resolution: Size) -> tuple[PinholeView, ...]:
    """``pinhole_views``, or the photograph itself where the lens bends nothing."""
    if lens.bends:
        return pinhole_views(lens, intrinsics, resolution)
    return (PinholeView("", np.eye(3), intrinsics, resolution),)


def shows_any(
    view: PinholeView, lens: Lens, intrinsics: Intrinsics, resolution: Size, white: Bool
) -> bool:
    """Whether a frame shows anything of what a mask (H, W) leaves of the photograph."""
    fx, fy, cx, cy = view.intrinsics
    width, height = view.resolution
    bounds = (-cx / fx, (width - cx) / fx, -cy / fy, (height - cy) / fy)
    face = _probed((lens, intrinsics, resolution), view.photograph_from_frame, bounds)
    column, row = face.pixels[face.inside].astype(np.int64).T
    rows, columns = white.shape
    return bool(white[row.clip(0, rows - 1), column.clip(0, columns - 1)].any())


class _Probes(NamedTuple):
    """A face at a grid of points: their places x, y (P,) in its plane at the distance 1, y down;
    directions (P, P, 3) in the photograph's camera, unit; whether the photograph shows them."""

    x: Double
    y: Double
    directions: Double
    pixels: Double
    inside: Bool


def _probed(
    camera: tuple[Lens, Intrinsics, Size], turn: Double, bounds: tuple[float, ...]
) -> _Probes:
    lens, intrinsics, (width, height) = camera
    left, right, top, bottom = bounds
    x, y = np.linspace(left, right, _PROBES), np.linspace(top, bottom, _PROBES)
    across, down = np.meshgrid(x, y)
    directions = np.stack([across, -down, np.full_like(across, -1.0)], axis=-1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    directions = directions @ turn.T
    pixels = lens.project(directions, intrinsics)
    # Comparisons with NaN are False.
    inside = np.all((pixels >= 0) & (pixels <= (width, height)), axis=-1)
    return _Probes(x, y, directions, pixels, np.asarray(inside, np.bool_))


def _cropped(lens: Lens, intrinsics: Intrinsics, faces: dict[str, _Probes]) -> list[PinholeView]:
    """Each face as large as what it shows, all of one focal length."""
    focal = intrinsics[0]
    if lens.curve != "equirectangular":
        finest = np.concatenate([_pixels_per_unit(face) for face in faces.values()])
        focal = float(np.quantile(finest, _KEEPS_DETAIL)) if len(finest) else focal
    views = []
    for name, face in faces.items():
        left, right = _range(face.x, face.inside, 0)
        top, bottom = _range(face.y, face.inside, 1)
        size = (math.ceil(focal * (right - left)), math.ceil(focal * (bottom - top)))
        views.append(
            PinholeView(name, _FACES[name], (focal, focal, -focal * left, -focal * top), size)
        )
    return views


def _range(places: Double, inside: Bool, axis: int) -> tuple[float, float]:
    """From the last place outside to the first outside again."""
    first, last = np.flatnonzero(inside.any(axis=axis))[[0, -1]]
    return float(places[max(first - 1, 0)]), float(places[min(last + 1, len(places) - 1)])


def _pixels_per_unit(face: _Probes) -> Double:
    """(M,) pixels of the photograph per unit of the face's plane, in the direction that has most,
    at the probes inside."""
    across = np.gradient(face.pixels, face.x, axis=1)
    down = np.gradient(face.pixels, face.y, axis=0)
    # Far outside the picture a polynomial goes to any number.
    with np.errstate(over="ignore", invalid="ignore"):
        a, b = (across**2).sum(axis=-1), (down**2).sum(axis=-1)
        mixed = (across * down).sum(axis=-1)
        largest = np.sqrt((a + b) / 2 + np.sqrt(((a - b) / 2) ** 2 + mixed**2))
    return np.asarray(largest[face.inside & np.isfinite(largest)])
