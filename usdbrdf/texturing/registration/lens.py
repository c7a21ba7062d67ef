"""Do the frames show the surface where their lens, as it is told, would have it?

A focal length that is not that of the pictures, a principal point from other pictures and
distortion that was never told move all frames' content by one pattern, which what the frames show
of the same points of the mesh tells.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from usdbrdf.kernel import parallel_kernel
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.texturing.agreement import points_of_surface
from usdbrdf.texturing.registration.joint_change import Found, best_change, half_diagonal, places_of
from usdbrdf.transport.rays import RayScene

# Focal lengths from which is started, as told being 1.
_STARTS = (1.0, 0.62, 0.71, 0.8, 0.89, 1.12, 1.25, 1.4, 1.6)
_POINTS = 1 << 14


@dataclass(frozen=True)
class Pattern:
    """Where frames show what they should show at a place in the picture, in half diagonals from
    the principal point, rho away from it: exp(zoom) (1 + bend rho^2) times as far, and moved."""

    zoom: float = 0.0
    bend: float = 0.0
    right: float = 0.0
    down: float = 0.0

    @property
    def numbers(self) -> Double:
        """(4,)"""
        return np.array([self.zoom, self.bend, self.right, self.down])

    def stepped(self, step: Double) -> Pattern:
        """With numbers that are larger by step (4,)."""
        return Pattern(*(self.numbers + step).tolist())

    def moves_cameras(self) -> bool:
        """A lens leaves them where they are."""
        return False

    def camera(self, camera: Camera) -> Camera:
        """The same."""
        return camera

    def places(self, place: Double) -> Double:
        """Of places (S, 2)."""
        factor = math.exp(self.zoom) * (1 + self.bend * (place**2).sum(axis=1))
        return np.asarray(factor[:, None] * place + [self.right, self.down], np.float64)

    def picture(self, picture: Float, camera: Camera) -> Float:
        """The picture as it would be without the pattern."""
        if self == Pattern():
            return picture
        changed = np.empty(picture.shape, np.float32)
        numbers = math.exp(self.zoom), self.bend, self.right, self.down
        _move(len(picture), picture, numbers, half_diagonal(camera), camera.intrinsics[2:], changed)
        return changed

    def by_number(self, camera: Camera, points: Double) -> Double:
        """(S, 2, 4) of small patterns."""
        place = places_of(camera, points)
        bent = place * (place**2).sum(axis=1, keepdims=True)
        right, down = (np.broadcast_to(side, place.shape) for side in np.eye(2))
        return np.stack([place, bent, right, down], axis=2)


@parallel_kernel
def _move(
    first: int, last: int, picture: Float, numbers: tuple[float, float, float, float],
    half: float, middle: tuple[float, float], changed: Float,
) -> None:  # fmt: skip
    """What a picture has, between its pixels' centres, where the ``places`` of a pattern are; NaN
    beyond its border, or beside a pixel that is."""
    (zoom, bend, right, down), (cx, cy) = numbers, middle
    height, width = picture.shape
    for j in range(first, last):
        y = (j + 0.5 - cy) / half
        for i in range(width):
            x = (i + 0.5 - cx) / half
            factor = zoom * (1 + bend * (x * x + y * y))
            u = half * (factor * x + right) + cx - 0.5
            v = half * (factor * y + down) + cy - 0.5
            if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
                changed[j, i] = np.nan
                continue
            column, row = min(int(u), width - 2), min(int(v), height - 2)
            a, b = u - column, v - row
            upper = (1 - a) * picture[row, column] + a * picture[row, column + 1]
            lower = (1 - a) * picture[row + 1, column] + a * picture[row + 1, column + 1]
            changed[j, i] = (1 - b) * upper + b * lower


def lens_of_frames(
    mesh: ScanMesh, rays: RayScene, cameras: Sequence[Camera], pictures: Sequence[Float]
) -> Found[Pattern] | None:
    """The lens under which frames agree best; None where few frames share few points.

    pictures  the frames' ``logarithms``, in any size
    """
    starts = [Pattern(math.log(longer)) for longer in _STARTS]
    surface = points_of_surface(mesh, _POINTS)
    return best_change(surface, rays, cameras, pictures, starts)


def said_of_lens(found: Found[Pattern], source: Path) -> str:
    """A sentence on frames that agree clearly better with another lens."""
    pattern = found.change
    return (
        f"{source.name}: frames show points of the mesh {found.moved:.1%} of a picture's width "
        f"(error {found.error:.1%}) from where their lens has them; {found.better} of "
        f"{found.frames} would agree better with a focal length {math.exp(pattern.zoom):.3f} times "
        f"as long, distortion of {pattern.bend:+.1%} in the corners and a principal point moved by "
        f"({pattern.right / 2:+.1%}, {pattern.down / 2:+.1%}) of the diagonal. Check that the "
        "intrinsics are those of these pictures, at their size, and that distortion is stated or "
        "undone. [capture.lens]"
    )
