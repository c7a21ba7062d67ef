"""The texel table: where on the surface each texel of each object's atlas lies, and what the frames
know of its lit radiance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import product
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from usdbrdf.model.arrays import Bool, Float, Int, Long


class Coverage(IntEnum):
    """FILLED: no frame shows the texel, its radiance is taken from around it; GLIMPSED: frames show
    it in pixels that show something else as well, and its object hardly otherwise, as they do thin
    bars: its radiance is about that; CLIPPED: frames show it, every one of them saturated, so that
    its radiance is a lower bound; MEASURED: at least one frame gives its radiance, or that it is
    too dark to be told from darkness."""

    FILLED = 0
    GLIMPSED = 1
    CLIPPED = 2
    MEASURED = 3


# How the map "coverage" has them.
_STORED = np.array([0, 0.25, 0.5, 1], np.float32)


@dataclass(frozen=True)
class CoverageMap:
    """kind (T,) int8: the ``Coverage`` of every texel."""

    kind: npt.NDArray[np.int8]

    @classmethod
    def of(cls, measured: Bool, clipped: Bool, glimpsed: Bool | None = None) -> CoverageMap:
        """measured, clipped, glimpsed (T,): a frame measured the texel; all that show it saturated;
        frames show it, but not it alone (None: no such)."""
        glimpsed = np.zeros_like(measured) if glimpsed is None else glimpsed
        kinds = (Coverage.MEASURED, Coverage.CLIPPED, Coverage.GLIMPSED)
        found = np.select([measured, clipped, glimpsed], kinds, Coverage.FILLED)
        return cls(found.astype(np.int8))

    @classmethod
    def from_stored(cls, values: Float) -> CoverageMap:
        """The inverse of ``stored``."""
        between = (_STORED[1:] + _STORED[:-1]) / 2
        return cls(np.digitize(values[:, 0], between).astype(np.int8))

    def stored(self) -> Float:
        """(T,) float32 as the map "coverage" has it: 0 filled, 0.25 glimpsed, 0.5 clipped, 1
        measured."""
        return np.asarray(_STORED[self.kind], np.float32)

    @property
    def measured(self) -> Bool:
        """(T,): a frame gives the texel's radiance."""
        return np.asarray(self.kind == Coverage.MEASURED, np.bool_)

    @property
    def clipped(self) -> Bool:
        """(T,): what is known of the texel's radiance is a lower bound."""
        return np.asarray(self.kind == Coverage.CLIPPED, np.bool_)

    @property
    def observed(self) -> Bool:
        """(T,): measured or clipped; a frame shows the texel alone."""
        return np.asarray(self.kind >= Coverage.CLIPPED, np.bool_)

    @property
    def shown(self) -> Bool:
        """(T,): a frame shows the texel, alone or with something else."""
        return np.asarray(self.kind != Coverage.FILLED, np.bool_)

    @property
    def glimpsed(self) -> Bool:
        """(T,): frames show the texel in pixels that show something else as well."""
        return np.asarray(self.kind == Coverage.GLIMPSED, np.bool_)

    @property
    def tells_albedo(self) -> Bool:
        """(T,): measured, or else glimpsed: what it reflects is known."""
        return self.measured | self.glimpsed


Number = TypeVar("Number", bound=np.generic)


@dataclass(frozen=True, kw_only=True)
class Texels:
    """T texels of all objects; texels of one object are consecutive, in row order.

    pixel           (T,) int64, index into the flat pixels of all atlases
    face            (T,) int32; barycentric (T, 3) float32: the surface point
    position        (T, 3) float32, metres, world; normal (T, 3) shading normal,
    geometric_normal (T, 3) the triangle's; both unit
    step_x, step_y  (T, 3) float32, metres: the surface spanned by one texel right and one down
    area            (T,) float32, m^2
    interior        (T,) bool: the centre lies inside a triangle (False: chart border)
    resolution      (num_objects, 2) int32, width and height of each atlas
    first_pixel     (num_objects + 1,) int64: flat pixels of object i are first_pixel[i:i+1]
    first_texel     (num_objects + 1,) int64
    nearest_texel   (P,) int32: for every flat pixel the texel that it shows; its own, or (gutter)
                    the nearest one of the same atlas; -1 only in an atlas without texels
    corner_pixel    (F, 3, 2) float32: x right, y down, in pixels of the face's atlas
    """

    pixel: Long
    face: Int
    barycentric: Float
    position: Float
    normal: Float
    geometric_normal: Float
    step_x: Float
    step_y: Float
    area: Float
    interior: Bool
    resolution: Int
    first_pixel: Long
    first_texel: Long
    nearest_texel: Int
    corner_pixel: Float

    def __len__(self) -> int:
        return len(self.face)

    def take(self, index: Long) -> Texels:
        """The surface points of some texels; the atlas stays the whole one."""
        names = (
            "pixel", "face", "barycentric", "position", "normal", "geometric_normal", "step_x",
            "step_y", "area", "interior",
        )  # fmt: skip
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    def of_object(self, index: int) -> slice:
        return slice(int(self.first_texel[index]), int(self.first_texel[index + 1]))

    def beside(self, index: Long, right: int, down: int) -> Int:
        """(N,): the texels that lie so many pixels to the right and down of texels ``index`` in
        their atlas; each itself where none does."""
        owner = self.object_index()[index]
        width, height = self.resolution[owner].T
        row, column = np.divmod(self.pixel[index] - self.first_pixel[owner], width)
        column = np.clip(column + right, 0, width - 1)
        row = np.clip(row + down, 0, height - 1)
        texel = self.nearest_texel[self.first_pixel[owner] + row * width + column]
        return np.where(texel >= 0, texel, index).astype(np.int32)

    def beside_on_surface(self, index: Long, right: int, down: int) -> tuple[Long, Bool]:
        """``beside``, and which of those (N,) lie about as far away on the surface: others are of
        another part of it that has its place there."""
        beside = self.beside(index, right, down).astype(np.int64)
        width = self.resolution[self.object_index()[index], 0]
        there = self.pixel[beside] - self.pixel[index] == right + down * width
        expected = self.position[index] + right * self.step_x[index] + down * self.step_y[index]
        off = np.linalg.norm(self.position[beside] - expected, axis=1)
        # Scanned walls are bumpy.
        reach = (1 + math.hypot(right, down) / 2) * np.sqrt(self.area[index])
        return beside, there & (off < reach)

    def around(self, index: Long, apart: int) -> Iterator[Long]:
        """The texels, (N,) each, that lie ``apart`` pixels of an atlas from texels ``index`` (N,),
        in all eight directions."""
        for right, down in product((-apart, 0, apart), repeat=2):
            if right or down:
                yield self.beside(index, right, down).astype(np.int64)

    def tile(self, index: Long, side: int) -> Long:
        """(N,) int64, equal for texels ``index`` (N,) in one tile of side^2 pixels of an atlas."""
        owner = self.object_index()[index]
        first, width = self.first_pixel[owner], self.resolution[owner, 0]
        row, column = np.divmod(self.pixel[index] - first, width)
        found: Long = first + row // side * side * width + column // side * side
        return found

    def image(self, index: int, values: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """(H, W, ...) picture of per-texel values (T, ...) of one object, gutters dilated."""
        width, height = self.resolution[index]
        texel = self.nearest_texel[self.first_pixel[index] : self.first_pixel[index + 1]]
        if not len(texel) or texel[0] < 0:
            return np.zeros((height, width, *values.shape[1:]), values.dtype)
        shown: npt.NDArray[Number] = values[texel].reshape(height, width, *values.shape[1:])
        return shown

    def from_image(self, index: int, image: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """The inverse of ``image``: (T_i, ...) out of (H, W, ...)."""
        own = self.pixel[self.of_object(index)] - self.first_pixel[index]
        values: npt.NDArray[Number] = image.reshape(-1, *image.shape[2:])[own]
        return values

    def mean_of_object(self, index: int, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(...): the mean over one object's surface of per-texel values (T, ...)."""
        own = self.of_object(index)
        # Single precision has the mean of ones above one.
        weights = np.maximum(self.area[own], 1e-12, dtype=np.float64)
        return np.average(values[own], axis=0, weights=weights)

    def segments(self, index: Long) -> Int:
        """(N,) int32, equal for texels ``index`` (N,) of one object that face alike: their normals
        are longest along the same axis."""
        normal = self.normal[index]
        axis = np.abs(normal).argmax(axis=1)
        facing = 2 * axis + (normal[np.arange(len(normal)), axis] > 0)
        return np.asarray(6 * self.object_index()[index] + facing, np.int32)

    def object_index(self) -> Int:
        """(T,) int32, the object of each texel."""
        return np.repeat(np.arange(len(self.resolution), dtype=np.int32), np.diff(self.first_texel))
