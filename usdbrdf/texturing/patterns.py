"""Patterns as fine as pixels, as all frames together tell them.

A pixel shows the mean of what it covers, and a mean of such means is blurred, however many there
are. But pixels of different frames cover a pattern differently: the texture of which all of them
are means is found by least squares (M. Irani and S. Peleg, "Improving Resolution by Image
Registration", CVGIP 1991). Of texels x, by a step d that minimises

    sum w (r - B d)^2 + sum (d / s)^2,    r = pixel - (B x) - what its neighbours have in common,

with B the means over what pixels cover. What pixels have in common with their neighbours, as in a
highlight, says nothing of a pattern. The step is taken by the share of it that is no noise: noise
alone would explain so much of the squares as the pixels leave unexplained, for each number that is
free (B. Efron and C. Morris, "Stein's Estimation Rule and Its Competitors", 1973).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.job.task import TaskRun
from usdbrdf.kernel import kernel, loop, parallel_kernel
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.texturing.footprints import around, blurred
from usdbrdf.texturing.passes import in_passes, with_rows_beside
from usdbrdf.texturing.samples import MIN_COSINE, FirstSurfaces, Picture, glares, shows_surface
from usdbrdf.transport.rays import RayScene
from usdbrdf.transport.warps import shifts_of

# Texels to each side of a pixel's middle that it may cover. A larger pixel tells nothing of them.
_REACH = 2
_ACROSS = 2 * _REACH + 1
# Places of the texels that a pixel covers beside one of them, which come after it: the row below by
# so many, and the columns to the right.
_APART = 2 * _REACH
_BESIDE = np.array(
    [(0, dx) for dx in range(_APART + 1)]
    + [(dy, dx) for dy in range(1, _APART + 1) for dx in range(-_APART, _APART + 1)]
)
# Pixels around one whose mean residual is taken off it, to each side.
_COMMON = 3
# What a pixel covers is read so often per texel; neighbours' steps on the atlas may differ by so
# much, else a seam lies between them.
_TAPS, _BENT = 2.0, 0.25
_CONTRAST = calibration.number("patterns.contrast")
_OUTLYING = calibration.number("patterns.outlying")
# Steps of Chebyshev's iteration, and the smallest eigenvalue that these reach.
_STEPS, _SMALLEST = 16, 1 / 64
# Rows of texels beside a group that what becomes of it depends on.
ROWS_BESIDE = _APART * (_STEPS + 1)


class PatternedSurface(NamedTuple):
    """What patterns are looked for on: ``values`` (T, 3), W/(m^2 sr), of texels, and the ``object``
    of each (T,); ``own`` (P,) int32 the texel of every flat pixel that is asked for, else -1;
    variance (T,) of a pixel's errors."""

    scene: Scene
    rays: RayScene
    texels: Texels
    object: Int
    values: Float
    own: Int
    variance: Float


class Covering(NamedTuple):
    """M pixels of a frame: texel (M,) int32 in the middle of each; where (M, 2) float32, x right
    and y down in its atlas, and step (M, 2, 2), the next pixel right's and the next one's below;
    rest (M, 3), what they show beside what is known; weight (M,), 1 / variance."""

    texel: Int
    where: Float
    step: Float
    rest: Float
    weight: Float

    def take(self, which: Bool) -> Covering:
        return Covering._make(values[which] for values in self)


class Equations(NamedTuple):
    """Least squares for T texels, of all pixels so far.

    coupling  (T, 41) float32, B^T W B of each texel and those of _BESIDE
    pull      (T, 3) float32, B^T W r
    squares   (T,) float32, sum w r^2, mean of the channels; pixels (T,), how many
    """

    coupling: Float
    pull: Float
    squares: Float
    pixels: Float

    @classmethod
    def empty(cls, num_texels: int) -> Equations:
        def zeros(*shape: int) -> Float:
            return np.zeros((num_texels, *shape), np.float32)

        return cls(zeros(len(_BESIDE)), zeros(3), zeros(), zeros())


# Bytes per texel of these, and of the iteration's vectors.
BYTES_OF_EQUATIONS = 4 * (len(_BESIDE) + 5) + 176


def pixels_of_frame(
    surface: PatternedSurface, picture: Picture, camera: Camera, noise: float, error: float
) -> Covering:
    """Those that show texels of ``surface`` and no edge, with the deviation ``noise``, W/(m^2 sr),
    and the share ``error`` of their radiance."""
    scene, texels = surface.scene, surface.texels
    face, point = visible_faces(surface.rays, camera)
    surfaces = FirstSurfaces.of(face, point, scene.face_object)
    size = face.shape
    texel = np.full(size, -1, np.int32)
    where = np.zeros((*size, 2), np.float32)
    _places(
        size[0], scene.points, scene.triangles, scene.face_object, texels.corner_pixel,
        texels.first_pixel, texels.resolution, surface.own, face, point, texel, where,
    )  # fmt: skip
    fits = picture.valid & (texel >= 0) & ~glares(picture)
    step = np.zeros((*size, 2, 2), np.float32)
    rest = np.full((*size, 3), np.nan, np.float32)
    pixel_size = 1 / float(camera.intrinsics[0])
    eye = np.array(camera.eye, np.float64)
    _residuals(
        size[0], surface.own, surface.values, texels.pixel, texels.first_pixel,
        texels.resolution, texels.position, texels.geometric_normal, eye, pixel_size,
        surfaces, picture.radiance, fits, texel, where, step, rest,
    )  # fmt: skip
    weight = np.zeros(size, np.float32)
    beside = np.empty_like(rest)
    _without_common(
        size[0], surfaces.object, texel, rest, surface.values, surface.variance, noise, error,
        beside, weight,
    )  # fmt: skip
    kept = weight > 0
    return Covering(texel[kept], where[kept], step[kept], beside[kept], weight[kept])


@parallel_kernel
def _places(
    start: int, stop: int, points: Float, triangles: Int, face_object: Int, corner_pixel: Float,
    first_pixel: Long, resolution: Int, own: Int, face: Int, point: Float, texel: Int,
    where: Float,
) -> None:  # fmt: skip
    """Of each pixel the place of its point in its object's atlas, and its texel."""
    for j in range(start, stop):
        for i in range(face.shape[1]):
            f = face[j, i]
            if f < 0:
                continue
            a, b, c = triangles[f]
            # Barycentric coordinates by least squares: the point lies in the plane.
            e00, e01, e11, r0, r1 = 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(3):
                along = np.float64(points[b, k]) - points[a, k]
                aside = np.float64(points[c, k]) - points[a, k]
                off = np.float64(point[j, i, k]) - points[a, k]
                e00 += along * along
                e01 += along * aside
                e11 += aside * aside
                r0 += along * off
                r1 += aside * off
            determinant = e00 * e11 - e01 * e01
            if determinant <= 0:
                continue
            u = (e11 * r0 - e01 * r1) / determinant
            v = (e00 * r1 - e01 * r0) / determinant
            for k in range(2):
                q = corner_pixel[f]
                where[j, i, k] = (1 - u - v) * q[0, k] + u * q[1, k] + v * q[2, k]
            o = face_object[f]
            width, height = resolution[o, 0], resolution[o, 1]
            x, y = int(np.floor(where[j, i, 0])), int(np.floor(where[j, i, 1]))
            if 0 <= x < width and 0 <= y < height:
                texel[j, i] = own[first_pixel[o] + y * width + x]


@parallel_kernel
def _residuals(
    start: int, stop: int, own: Int, values: Float, pixel: Long, first_pixel: Long,
    resolution: Int, position: Float, normal: Float, eye: Double, pixel_size: float,
    surfaces: FirstSurfaces, radiance: Float, fits: Bool, texel: Int, where: Float, step: Float,
    rest: Float,
) -> None:  # fmt: skip
    """What pixels show beside the means of ``values`` over what they cover, and the steps from
    each to the next ones; NaN stays where a pixel tells nothing of a pattern."""
    height, width = fits.shape
    covered = np.empty(_ACROSS * _ACROSS, np.float32)
    for j in range(max(start, 1), min(stop, height - 1)):
        for i in range(1, width - 1):
            if not fits[j, i]:
                continue
            t, o = texel[j, i], surfaces.object[j, i]
            x, y, z = eye[0] - position[t, 0], eye[1] - position[t, 1], eye[2] - position[t, 2]
            distance = np.sqrt(x * x + y * y + z * z)
            cosine = x * normal[t, 0] + y * normal[t, 1] + z * normal[t, 2]
            if cosine < MIN_COSINE * distance or not shows_surface(
                j, i, 1, position[t], normal[t], o, distance * pixel_size, surfaces
            ):
                continue
            bent = 0.0
            for k in range(2):
                left, right = where[j, i - 1, k], where[j, i + 1, k]
                above, below = where[j - 1, i, k], where[j + 1, i, k]
                step[j, i, 0, k] = (right - left) / 2
                step[j, i, 1, k] = (below - above) / 2
                bent += abs(left + right - 2 * where[j, i, k])
                bent += abs(above + below - 2 * where[j, i, k])
            if bent > _BENT * np.abs(step[j, i]).sum():
                continue
            wide = resolution[o, 0]
            at = pixel[t] - first_pixel[o]
            row, column = at // wide, at % wide
            if not _covers(where[j, i], step[j, i], column, row, wide, resolution[o, 1], covered):
                continue
            red, green, blue, known = 0.0, 0.0, 0.0, True
            for n in range(len(covered)):
                if covered[n] > 0:
                    down, along = n // _ACROSS - _REACH, n % _ACROSS - _REACH
                    s = own[pixel[t] + down * wide + along]
                    known = known and s >= 0
                    if s >= 0:
                        red += covered[n] * values[s, 0]
                        green += covered[n] * values[s, 1]
                        blue += covered[n] * values[s, 2]
            if known:
                rest[j, i, 0] = radiance[j, i, 0] - red
                rest[j, i, 1] = radiance[j, i, 1] - green
                rest[j, i, 2] = radiance[j, i, 2] - blue


@kernel
def _covers(
    where: Float, step: Float, column: int, row: int, width: int, height: int, covered: Float
) -> bool:
    """By what shares a pixel, its middle at ``where``, covers the texels around (column, row):
    covered (25,), in rows. False where it covers others too."""
    covered[:] = 0
    long_x, long_y = np.abs(step[0]).max(), np.abs(step[1]).max()
    if max(long_x, long_y) > _ACROSS:
        return False
    taps_x, taps_y = int(np.ceil(_TAPS * long_x)) + 1, int(np.ceil(_TAPS * long_y)) + 1
    share = np.float32(1 / (taps_x * taps_y))
    for b in range(taps_y):
        for a in range(taps_x):
            right, down = (a + 0.5) / taps_x - 0.5, (b + 0.5) / taps_y - 0.5
            # A texel's middle lies half a pixel of the atlas off its corner.
            x = where[0] + right * step[0, 0] + down * step[1, 0] - 0.5
            y = where[1] + right * step[0, 1] + down * step[1, 1] - 0.5
            x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
            i, j = int(x), int(y)
            fx, fy = x - i, y - j
            for corner in range(4):
                e, d = corner % 2, corner // 2
                part = (fx if e else 1 - fx) * (fy if d else 1 - fy)
                if part <= 0:
                    continue
                along, down_by = i + e - column, j + d - row
                if abs(along) > _REACH or abs(down_by) > _REACH:
                    return False
                covered[(down_by + _REACH) * _ACROSS + along + _REACH] += share * part
    return True


@parallel_kernel
def _without_common(
    start: int, stop: int, shown: Int, texel: Int, rest: Float, values: Float, variance: Float,
    noise: float, error: float, beside: Float, weight: Float,
) -> None:  # fmt: skip
    """What is left of each pixel's rest without the mean of those around it on its object, and its
    weight: that of its error, less the further it lies off (A. Beaton and J. Tukey, 1974)."""
    height, width = shown.shape
    for j in range(start, stop):
        for i in range(width):
            if not np.isfinite(rest[j, i, 0]):
                continue
            count, red, green, blue = 0, 0.0, 0.0, 0.0
            for n in range(max(j - _COMMON, 0), min(j + _COMMON + 1, height)):
                for m in range(max(i - _COMMON, 0), min(i + _COMMON + 1, width)):
                    if shown[n, m] == shown[j, i] and np.isfinite(rest[n, m, 0]):
                        count += 1
                        red += rest[n, m, 0]
                        green += rest[n, m, 1]
                        blue += rest[n, m, 2]
            if count <= _COMMON * _COMMON:
                continue
            beside[j, i, 0] = rest[j, i, 0] - red / count
            beside[j, i, 1] = rest[j, i, 1] - green / count
            beside[j, i, 2] = rest[j, i, 2] - blue / count
            t = texel[j, i]
            level = (values[t, 0] + values[t, 1] + values[t, 2]) / 3
            own = (error * level) ** 2 + noise * noise
            off = 0.0
            for c in range(3):
                off += beside[j, i, c] ** 2 / 3
            off /= _OUTLYING**2 * (own + variance[t])
            if off < 1:
                weight[j, i] = (1 - off) ** 2 / max(own, 1e-30)


def add(equations: Equations, first: int, surface: PatternedSurface, pixels: Covering) -> None:
    """Pixels more, in place, into the equations of the texels from number ``first`` on."""
    texels = surface.texels
    owner = surface.object[pixels.texel]
    _add(
        0, len(pixels.texel), pixels, owner, first, surface.own, texels.pixel, texels.first_pixel,
        texels.resolution, equations,
    )  # fmt: skip


@loop
def _add(
    start: int, stop: int, pixels: Covering, owner: Int, first: int, own: Int, pixel: Long,
    first_pixel: Long, resolution: Int, equations: Equations,
) -> None:  # fmt: skip
    coupling, pull, squares, count = equations
    covered = np.empty(_ACROSS * _ACROSS, np.float32)
    which = np.empty(_ACROSS * _ACROSS, np.int64)
    for m in range(start, stop):
        t, o = pixels.texel[m], owner[m]
        wide = resolution[o, 0]
        at = pixel[t] - first_pixel[o]
        _covers(
            pixels.where[m], pixels.step[m], at % wide, at // wide, wide, resolution[o, 1], covered
        )
        used = 0
        for n in range(len(covered)):
            if covered[n] > 0:
                which[used] = n
                used += 1
        w = pixels.weight[m]
        rest = pixels.rest[m]
        square = w * (rest[0] ** 2 + rest[1] ** 2 + rest[2] ** 2) / 3
        for a in range(used):
            n = which[a]
            down, along = n // _ACROSS, n % _ACROSS
            s = own[pixel[t] + (down - _REACH) * wide + along - _REACH] - first
            if s < 0 or s >= len(count):
                continue
            share = covered[n]
            count[s] += share
            squares[s] += share * square
            for c in range(3):
                pull[s, c] += w * share * rest[c]
            for b in range(a, used):
                dy = which[b] // _ACROSS - down
                dx = which[b] % _ACROSS - along
                k = dx if dy == 0 else _APART + 1 + (dy - 1) * (2 * _APART + 1) + dx + _APART
                coupling[s, k] += w * share * covered[which[b]]


def steps(
    equations: Equations, part: slice, surface: PatternedSurface, level: Float, seed: int
) -> dict[str, Array]:
    """The step d (n, 3) of the texels of ``part``, of which the equations are; and of each, (n, 4)
    "told": what it explains of the squares, how many numbers were free for that, which squares are
    left, and how many pixels. level (n,): the radiance of which contrasts are a share."""
    texels = surface.texels
    owner, low = surface.object[part], int(texels.pixel[part.start])
    pixel, width = texels.pixel[part] - low, texels.resolution[owner, 0].astype(np.int64)
    first = texels.first_pixel[owner] - low
    number = np.full(int(pixel[-1]) + 1, -1, np.int32)
    number[pixel] = np.arange(len(pixel), dtype=np.int32)
    ridge = 1 / np.maximum(_CONTRAST * level, 1e-15) ** 2

    def coupled(values: Float) -> Float:
        found = np.empty_like(values)
        _couple(len(pixel), equations.coupling, pixel, first, width, number, values, found)
        return found

    # Ones and minus ones: what is left of them on the mean is how many numbers are free
    # (M. Hutchinson, "A stochastic estimator of the trace of the influence matrix", 1990).
    own = np.arange(part.start, part.stop, dtype=np.int64)
    sign = np.where(shifts_of(own, 1, seed)[:, :1] < 0.5, -1, 1).astype(np.float32)
    sums = coupled(np.concatenate([np.ones_like(sign), sign], axis=1))
    # All couplings are positive, so these bound the eigenvalues by 1.
    bound = (sums[:, :1] + ridge[:, None]).astype(np.float32)
    left = np.concatenate([equations.pull, sums[:, 1:]], axis=1) / bound
    middle, half = (1 + _SMALLEST) / 2, (1 - _SMALLEST) / 2
    rate = half / middle
    change = left / np.float32(middle)
    found = change.copy()
    for _ in range(_STEPS - 1):
        left -= (coupled(change) + ridge[:, None] * change) / bound
        faster = 1 / (2 * middle / half - rate)
        change = np.float32(faster * rate) * change + np.float32(2 * faster / half) * left
        rate = faster
        found += change
    step = np.ascontiguousarray(found[:, :3])
    explained = (step * equations.pull).mean(axis=1)
    again = (step * coupled(step)).mean(axis=1)
    told = [
        explained,
        sign[:, 0] * found[:, 3],
        equations.squares - 2 * explained + again,
        equations.pixels,
    ]
    return {"step": step, "told": np.stack(told, axis=-1)}


@parallel_kernel
def _couple(
    start: int, stop: int, coupling: Float, pixel: Long, first: Long, width: Long, number: Int,
    values: Float, out: Float,
) -> None:  # fmt: skip
    """B^T W B times ``values`` (T, C); first (T,): the first pixel of each one's atlas."""
    channels = values.shape[1]
    for t in range(start, stop):
        for c in range(channels):
            out[t, c] = coupling[t, 0] * values[t, c]
        for k in range(1, coupling.shape[1]):
            if k <= _APART:
                apart = np.int64(k)
            else:
                rows, columns = divmod(k - _APART - 1, 2 * _APART + 1)
                apart = (rows + 1) * width[t] + columns - _APART
            strength = coupling[t, k]
            if strength > 0:
                after = pixel[t] + apart
                s = number[after] if after < len(number) else np.int32(-1)
                if s >= 0:
                    for c in range(channels):
                        out[t, c] += strength * values[s, c]
            before = pixel[t] - apart
            if before >= max(first[t], 0):
                s = number[before]
                if s >= 0 and coupling[s, k] > 0:
                    for c in range(channels):
                        out[t, c] += coupling[s, k] * values[s, c]


def share_that_is_no_noise(texels: Texels, told: Float, footprint: Float) -> Float:
    """(T,): of the steps, from what is ``told`` (T, 4) of them and their neighbours; footprint
    (T, 3): what pixels cover, see ``blurred``."""
    explained, free, left, count = around(texels, told, footprint).T
    noise = np.maximum(left, 0) / np.maximum(count - free, 0.1 * count + 1e-9)
    share: Float = np.clip(1 - noise * free / np.maximum(explained, 1e-12), 0, 1)
    return np.where((explained > 0) & (free > 0), share, 0).astype(np.float32)


def with_patterns(
    run: TaskRun,
    surface: PatternedSurface,
    pixels: Callable[[], Iterator[Covering]],
    footprint: Float,
    groups: Sequence[slice],
    seed: int,
) -> Float:
    """The ``values`` (T, 3) of the ``surface`` with what ``pixels`` of all frames tell beside them.

    footprint  (T, 3): what a pixel covers, see ``blurred``
    groups     of texels whose equations fit into memory; each is one pass over the frames
    """
    texels, values = surface.texels, surface.values
    level = blurred(texels, values, footprint).mean(axis=1)

    def observe(part: slice) -> dict[str, Array]:
        whole = with_rows_beside(texels, part, ROWS_BESIDE)
        equations = Equations.empty(whole.stop - whole.start)
        for some in pixels():
            add(equations, whole.start, surface, some)
        found = steps(equations, whole, surface, level[whole], seed)
        inner = slice(part.start - whole.start, part.stop - whole.start)
        return {name: array[inner].copy() for name, array in found.items()}

    found = in_passes(run, "patterns", groups, observe)
    share = share_that_is_no_noise(texels, found["told"], footprint)
    sharper: Float = np.maximum(values + share[:, None] * found["step"], 0)
    return sharper
