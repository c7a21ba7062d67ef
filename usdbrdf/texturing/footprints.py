"""What a pixel covers of a surface: surfaces as pixels blur them, and textures with the contrast
that pixels took restored."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from usdbrdf import calibration
from usdbrdf.kernel import parallel_kernel
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.texels import Texels
from usdbrdf.texturing.samples import Projection, project

# Eight points like a normal distribution of deviation 1: quarters of its probability on two rings.
_RING = np.pi / 4 * np.arange(8)
RINGS = np.where(np.arange(8) % 2, 0.829, 1.820)[:, None] * np.stack(
    [np.cos(_RING), np.sin(_RING)], axis=-1
)
# Variance of a texel's own area, in texels; and what a view along the surface counts as.
_OF_TEXEL, _LARGEST = 1 / 12, 1e6


def footprints(texels: Texels, which: Int, camera: Camera) -> Float:
    """A pixel's steps right and down on the surface at some texels, as a covariance in texels:
    (M, 3), xx, xy, yy. Texels that the camera sees from the front."""
    found = np.zeros((len(which), 3), np.float32)
    steps = texels.step_x, texels.step_y
    _footprints(len(which), which, texels.position, *steps, Projection.of(camera), found)
    return found


def widest(footprint: Float) -> Float:
    """(M,): standard deviation along the longer axis of covariances (M, 3)."""
    middle, half = (footprint[:, 0] + footprint[:, 2]) / 2, (footprint[:, 0] - footprint[:, 2]) / 2
    largest: Float = np.sqrt(middle + np.sqrt(half**2 + footprint[:, 1] ** 2))
    return largest


def blurred(texels: Texels, values: Float, covariance: Float) -> Float:
    """Means of ``values`` (T, C) over normal distributions around each texel in its atlas, and over
    the texel's own area. covariance (T, 3): xx, xy, yy, in texels. What lies off a texel's chart
    counts as the texel itself.
    """
    occupied = np.zeros(len(texels.nearest_texel), np.bool_)
    occupied[texels.pixel] = True
    # Number of the chart that each flat pixel lies on, (P,): texels that touch share one.
    chart = np.zeros(len(occupied), np.int32)
    for i, (width, height) in enumerate(texels.resolution):
        own = slice(int(texels.first_pixel[i]), int(texels.first_pixel[i + 1]))
        chart[own] = ndimage.label(occupied[own].reshape(height, width), np.ones((3, 3)))[0].ravel()
    owner, nearest = texels.object_index(), np.maximum(texels.nearest_texel, 0)
    blurry = np.zeros_like(values)
    _blur(
        len(blurry), np.ascontiguousarray(values[nearest]), chart[texels.pixel[nearest]],
        texels.pixel, texels.first_pixel[owner], texels.resolution[owner], covariance, RINGS,
        blurry,
    )  # fmt: skip
    return blurry


@parallel_kernel
def _footprints(
    first: int, last: int, which: Int, position: Float, step_x: Float, step_y: Float,
    camera: Projection, out: Float,
) -> None:  # fmt: skip
    for i in range(first, last):
        t = which[i]
        p, sx, sy = position[t], step_x[t], step_y[t]
        u, v, _ = project(p, sx, sy, 0.0, 0.0, camera)
        ux, vx, right = project(p, sx, sy, 1.0, 0.0, camera)
        uy, vy, below = project(p, sx, sy, 0.0, 1.0, camera)
        # Pixels per texel, and its inverse.
        a, b, c, d = ux - u, uy - u, vx - v, vy - v
        determinant = a * d - b * c
        out[i, 0], out[i, 1], out[i, 2] = _LARGEST, 0.0, _LARGEST
        if right < 0 or below < 0 or a * a + b * b + c * c + d * d >= _LARGEST * determinant**2:
            continue
        a, b, c, d = d / determinant, -b / determinant, -c / determinant, a / determinant
        out[i, 0] = a * a + b * b
        out[i, 1] = a * c + b * d
        out[i, 2] = c * c + d * d


@parallel_kernel
def _blur(
    start: int,
    stop: int,
    picture: Float,
    chart: Int,
    pixel: Long,
    first: Long,
    size: Int,
    covariance: Float,
    offsets: Double,
    out: Float,
) -> None:
    for t in range(start, stop):
        width, height = size[t, 0], size[t, 1]
        at = pixel[t] - first[t]
        row, column = at // width, at % width
        # Cholesky's factor of the covariance.
        across = np.sqrt(covariance[t, 0] + _OF_TEXEL)
        skewed = covariance[t, 1] / across
        down = np.sqrt(max(covariance[t, 2] + _OF_TEXEL - skewed * skewed, 0.0))
        for k in range(len(offsets)):
            x = column + across * offsets[k, 0]
            y = row + skewed * offsets[k, 0] + down * offsets[k, 1]
            x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
            i, j = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
            fx, fy = x - i, y - j
            right, below = (1 if width > 1 else 0), (width if height > 1 else 0)
            p, own = first[t] + j * width + i, chart[pixel[t]]
            if (
                chart[p] != own
                or chart[p + right] != own
                or chart[p + below] != own
                or chart[p + below + right] != own
            ):
                p, right, below = pixel[t], 0, 0
            for c in range(out.shape[1]):
                upper = (1 - fx) * picture[p, c] + fx * picture[p + right, c]
                lower = (1 - fx) * picture[p + below, c] + fx * picture[p + below + right, c]
                out[t, c] += ((1 - fy) * upper + fy * lower) / len(offsets)


_NEIGHBOURHOOD = calibration.number("refine.neighbourhood")


def around(texels: Texels, values: Float, footprint: Float) -> Float:
    """Means of ``values`` (T, C) over so many texels that these tell detail from noise."""
    for _ in range(3):
        values = blurred(texels, values, np.float32(_NEIGHBOURHOOD**2) * footprint)
    return values


SAMPLE_BLUR = calibration.number("refine.sample_blur")
# More of them bring the noise back.
_STEPS = 2


def restored(
    texels: Texels, values: Float, measured: Bool, variance: Float, footprint: Float
) -> Float:
    """The surface's values, (T, 3), from what frames measured of them: without their noise, and
    then in steps that bring what pixels would show of them nearer to what they did, by the share of
    it that is no noise (L. Landweber, "An iteration formula for Fredholm integral equations of the
    first kind", 1951).

    values     (T, 3) float32, with a fill where nobody looked
    measured   (T,) bool
    variance   (T,) float32, of the values' errors
    footprint  (T, 3) float32, what a pixel covers: covariance xx, xy, yy in texels
    """
    kernel = SAMPLE_BLUR**2 * footprint
    smooth = blurred(texels, values, kernel)
    detail = values - smooth
    energy = np.stack([(detail**2).mean(axis=1), variance], axis=-1)
    energy = np.where(measured[:, None], energy, 0).astype(np.float32)
    seen, noise = around(texels, energy, footprint).T
    share = np.clip(1 - noise / np.maximum(seen, 1e-30), 0, 1)
    # At the rim of what was measured the fill would pass for detail, and the last samples before a
    # lamp hold some of its light.
    surrounded = blurred(texels, measured[:, None].astype(np.float32), kernel)[:, 0] > 1 - 1e-3
    found, share = smooth + share[:, None] * detail, share[:, None]
    for _ in range(_STEPS):
        found = np.asarray(found + share * (values - blurred(texels, found, kernel)), np.float32)
    return np.where(surrounded[:, None], found, values)
