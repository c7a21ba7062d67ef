"""Lenses that bend light: where a camera images a direction, for every model that common tools
write. A pinhole is a lens that bends nothing; cameras after ingest are pinholes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Double

Curve = Literal[
    "perspective", "fisheye", "fov", "division", "undistorting", "eucm", "equirectangular"
]
# Parameters of each curve, by the names of those who proposed it.
_SHAPE = {"fov": ("omega",), "division": ("k",), "undistorting": ("k",), "eucm": ("alpha", "beta")}
_MOST_RADIAL = 8
# Angles between 0 and a half turn at which a curve is looked at for where it turns back.
_ANGLES = 20_001
_AROUND = 33
_TINY = 1e-12


@dataclass(frozen=True, kw_only=True)
class Lens:
    """From directions to a plane without unit; ``intrinsics`` fx, fy, cx, cy go on to pixels.

    A direction at the angle t off the axis comes to lie at the radius r in the direction's own
    azimuth; then the point (x, y) = r (cos a, sin a), x right and y down, is distorted:

        x' = x R + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4 + b y'
        y' = y R + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4
        R  = (1 + k1 r^2 + k2 r^4 + ... + o1 r + o2 r^3 + ...) / (1 + d1 r^2 + d2 r^4 + ...)
        pixel = (cx + fx x', cy + fy y')

    curve       perspective: r = tan t; fisheye (equidistant): r = t;
                fov (Devernay and Faugeras 2001): r = atan(2 tan t tan(omega/2)) / omega;
                division (Fitzgibbon 2001): r / (1 + k r^2) = tan t;
                undistorting (VisualSFM): r (1 + k r^2) = tan t;
                eucm (Khomutenko et al. 2016): r = sin t / (alpha e + (1 - alpha) cos t) with
                e^2 = beta sin^2 t + cos^2 t;
                equirectangular: x is the longitude, y minus the latitude, in radians: fx is the
                width / 2 pi, fy the height / pi (see ``whole_sphere``)
    shape       what the curve has beside t: (omega,), (k,), (k,), (alpha, beta)
    radial      k1, k2, ... as many as there are
    odd         o1, o2, ...; r R then has even powers of r too: Pix4D's and ContextCapture's
                fisheyes, see ``fisheye_of_turn``
    divisor     d1, d2, ...; OpenCV calls its three k4, k5, k6
    tangential  p1, p2 in OpenCV's order (Metashape's and Aria's are the other way round)
    prism       s1, s2, s3, s4
    skew        b: Metashape's B2 / fx
    radial_first   tangential and prism terms are taken of (x R, y R) instead of (x, y)
    circle      r R beyond which nothing is imaged, as of the picture's circle in a fisheye's
    """

    curve: Curve = "perspective"
    shape: tuple[float, ...] = ()
    radial: tuple[float, ...] = ()
    odd: tuple[float, ...] = ()
    divisor: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    skew: float = 0.0
    radial_first: bool = False
    circle: float = math.inf

    def __post_init__(self) -> None:
        numbers = (*self.shape, *self._bending)
        if (
            self.curve not in get_args(Curve)
            or len(self.shape) != len(_SHAPE.get(self.curve, ()))
            or max(len(self.radial), len(self.odd), len(self.divisor)) > _MOST_RADIAL
            or not np.isfinite(numbers).all()
            or not self.circle > 0
        ):
            raise InputRefused(f"{self}: this is no lens. Correct its numbers. [camera.lens]")

    def described(self, intrinsics: tuple[float, float, float, float]) -> str:
        """All of its numbers that are not 0, in words, such as
        ``fisheye fx 790.2 fy 790.3 cx 876.1 cy 584.9 k1 -0.03 k2 -0.006``."""
        numbered = [
            *zip(("fx", "fy", "cx", "cy"), intrinsics, strict=True),
            *zip(_SHAPE.get(self.curve, ()), self.shape, strict=True),
            *((f"k{i + 1}", k) for i, k in enumerate(self.radial)),
            *((f"o{i + 1}", o) for i, o in enumerate(self.odd)),
            *((f"d{i + 1}", d) for i, d in enumerate(self.divisor)),
            *((f"p{i + 1}", p) for i, p in enumerate(self.tangential)),
            *((f"s{i + 1}", s) for i, s in enumerate(self.prism)),
            ("b", self.skew),
            ("circle", self.circle if math.isfinite(self.circle) else 0.0),
        ]
        words = [f"{name} {float(number)!r}" for name, number in numbered if number]
        return " ".join([self.curve, *words, *(["radial first"] if self.radial_first else [])])

    @property
    def bends(self) -> bool:
        """False for a pinhole."""
        plain = self.curve in ("division", "undistorting") and not any(self.shape)
        return bool(any(self._bending) or not (self.curve == "perspective" or plain))

    @property
    def _bending(self) -> tuple[float, ...]:
        return (
            *self.radial, *self.odd, *self.divisor, *self.tangential, *self.prism, self.skew
        )  # fmt: skip

    def project(self, directions: Double, intrinsics: tuple[float, float, float, float]) -> Double:
        """Pixel coordinates (..., 2) of directions (..., 3) of any length in the camera, whose x
        points right, y up, and which looks down -z; NaN where the lens images nothing, or where its
        polynomial has turned back and would image a second time."""
        x, y, z = directions[..., 0], -directions[..., 1], -directions[..., 2]
        across = np.hypot(x, y)
        angle = np.arctan2(across, z)
        if self.curve == "equirectangular":
            plane = np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=-1)
        else:
            # At the axis the azimuth does not matter, nor does 0 / 0.
            azimuth = np.stack([x, y], axis=-1) / np.maximum(across, _TINY)[..., None]
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                plane = self._distorted(azimuth * self._radius(angle)[..., None])
        fx, fy, cx, cy = intrinsics
        pixels = plane * (fx, fy) + (cx, cy)
        pixels[angle > self.widest_angle] = np.nan
        return pixels

    @property
    def widest_angle(self) -> float:
        """Radians off the axis up to which a larger angle means a larger radius, in the circle."""
        return _widest_angle(self)

    @property
    def undistorted(self) -> Lens:
        """The curve alone."""
        return Lens(curve=self.curve, shape=self.shape)

    def distance(self, angle: Double) -> Double:
        """r R of t: how far off the middle of the plane the radial terms image a direction."""
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            radius = self._radius(angle)
            return np.asarray(radius * self._stretch(radius**2))

    def aside(self, angle: float) -> float:
        """How far the other terms move what is imaged at the angle, in parts of its distance."""
        around = np.linspace(0, 2 * np.pi, _AROUND)
        azimuth = np.stack([np.cos(around), np.sin(around)], axis=-1)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            moved = self._distorted(azimuth * self._radius(np.array(angle)))
            off = moved - azimuth * self.distance(np.array(angle))
            return float(np.linalg.norm(off, axis=-1).max() / self.distance(np.array(angle)))

    def _radius(self, angle: Double) -> Double:
        """r of t; NaN where the curve ends."""
        sine, cosine = np.sin(angle), np.cos(angle)
        if self.curve == "fisheye":
            return angle
        if self.curve == "eucm":
            alpha, beta = self.shape
            depth = alpha * np.sqrt(beta * sine**2 + cosine**2) + (1 - alpha) * cosine
            return np.asarray(np.where(depth > 0, sine / depth, np.nan))
        tangent = np.where(cosine > 0, sine / np.maximum(cosine, _TINY), np.nan)
        if self.curve == "fov":
            (omega,) = self.shape
            if abs(omega) < 1e-6:  # its limit is a pinhole
                return tangent
            return np.asarray(np.arctan(2 * tangent * np.tan(omega / 2)) / omega)
        if self.curve == "division":
            (k,) = self.shape
            # The root of k tan(t) r^2 - r + tan(t) = 0 that is tan(t) for k = 0.
            root = np.sqrt(1 - 4 * k * tangent**2)
            return np.asarray(2 * tangent / (1 + root))
        if self.curve == "undistorting" and any(self.shape):
            (k,) = self.shape
            # The root of k r^3 + r - tan(t) = 0 that is tan(t) for k = 0; none where it turns back.
            size = 2 / np.sqrt(3 * abs(k))
            third = 3 * tangent / size
            root = np.sinh(np.arcsinh(third) / 3) if k > 0 else np.sin(np.arcsin(third) / 3)
            return np.asarray(size * root)
        return tangent

    def _stretch(self, squared: Double) -> Double:
        """R of r^2."""
        above = np.polyval((*self.radial[::-1], 1.0), squared)
        if self.odd:
            above = above + np.sqrt(squared) * np.polyval(self.odd[::-1], squared)
        return np.asarray(above / np.polyval((*self.divisor[::-1], 1.0), squared))

    def _distorted(self, plane: Double) -> Double:
        """(x', y') of (x, y)."""
        stretched = plane * self._stretch((plane**2).sum(axis=-1))[..., None]
        base = stretched if self.radial_first else plane
        x, y = base[..., 0], base[..., 1]
        squared = x**2 + y**2
        p1, p2 = self.tangential
        s1, s2, s3, s4 = self.prism
        across = 2 * p1 * x * y + p2 * (squared + 2 * x**2) + (s1 + s2 * squared) * squared
        down = p1 * (squared + 2 * y**2) + 2 * p2 * x * y + (s3 + s4 * squared) * squared
        down = stretched[..., 1] + down
        return np.stack([stretched[..., 0] + across + self.skew * down, down], axis=-1)


PINHOLE = Lens()


@lru_cache(maxsize=256)
def _widest_angle(lens: Lens) -> float:
    if lens.curve == "equirectangular":
        return float(np.pi)
    angles = np.linspace(0, np.pi, _ANGLES)
    # NaN is no step outwards either.
    with np.errstate(invalid="ignore"):
        distance = lens.distance(angles)
        ended = np.flatnonzero(~(np.diff(distance) > 0) | (distance[1:] > lens.circle))
    return float(angles[ended[0] if len(ended) else -1])


def is_fisheye_of_turn(matrix: Double, terms: tuple[float, ...]) -> bool:
    """Whether these numbers are such a fisheye's: none mirrors, or turns the picture inside out."""
    finite = np.isfinite(matrix).all() and np.isfinite(terms).all()
    return bool(finite and terms[0] > 0 and np.linalg.det(matrix) > 0)


def fisheye_of_turn(
    matrix: Double, terms: tuple[float, ...]
) -> tuple[Lens, tuple[float, float], Double]:
    """The lens, fx, fy and the turn (3, 3) of Pix4D's fisheyes, which ContextCapture has too.

    A direction at the angle t off the axis comes to lie at p1 s + p2 s^2 + ... of s = 2 t / pi in
    its own azimuth, which ``matrix`` (2, 2) takes to pixels from the principal point. What in that
    turns the picture becomes a turn of the camera around its axis, x right and y down: directions
    are turned by it before the lens.

    terms  p1, p2, ...
    """
    first, *more = terms
    fy = float(np.hypot(*matrix[1]))
    cosine, sine = matrix[1, 1] / fy, matrix[1, 0] / fy
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    fx, skewed = float(np.linalg.det(matrix)) / fy, float(matrix[0] @ (sine, cosine))
    scales = [term / first * (2 / np.pi) ** (i + 1) for i, term in enumerate(more)]
    lens = Lens(
        curve="fisheye", odd=tuple(scales[::2]), radial=tuple(scales[1::2]), skew=skewed / fx
    )
    scale = 2 / np.pi * first
    return lens, (fx * scale, fy * scale), turn


def whole_sphere(width: float, height: float) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of an equirectangular picture: straight ahead lies in its middle."""
    return width / (2 * np.pi), height / np.pi, width / 2, height / 2
