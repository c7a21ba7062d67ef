"""Colours of faces as frames show them, and surfaces divided where their colour changes.

Light changes over a surface as much as what it is made of: lightness counts for little, hue and
saturation for all.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from usdbrdf import calibration
from usdbrdf.geometry.segments import Links, flooded, parts_of
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.transport.rays import RayScene

_DIFFERENT = calibration.number("segments.different_colour")
_LIGHTNESS = calibration.number("segments.weight_of_lightness")
_LEAST_COLOUR = calibration.number("segments.least_colour")
# Pixels of a frame's width that are looked at, and how often colours spread over the faces around.
_MOST_ACROSS, _SMOOTHED = 1024, 12
# Bins of the colours' two axes, each so many just noticeable differences wide.
_BIN = 4.0
# Linear Rec.709 to XYZ, each divided by that of its white.
_XYZ = np.array([
    [0.4123908, 0.3575843, 0.1804808], [0.2126390, 0.7151687, 0.0721923],
    [0.0193308, 0.1191948, 0.9505322],
])  # fmt: skip


def colours_of_faces(
    rays: RayScene, frames: Iterable[tuple[Camera, Float, Bool]], count: int
) -> Float:
    """(F, 3) float32: the median over the frames of what each shows of a face, channel by channel;
    NaN where none shows it.

    frames  camera, radiance (H, W, 3) and which pixels are valid (H, W); ``count`` of them
    """
    faces = len(rays.triangles)
    found = np.full((count, faces, 3), np.nan, np.float32)
    for i, (camera, radiance, valid) in enumerate(frames):
        small = camera.at_width(min(camera.width, _MOST_ACROSS))
        face = visible_faces(rays, small)[0]
        down = ((np.arange(small.height) + 0.5) * camera.height / small.height).astype(np.int64)
        across = ((np.arange(small.width) + 0.5) * camera.width / small.width).astype(np.int64)
        shown = valid[down[:, None], across] & (face >= 0)
        own, level = face[shown], radiance[down[:, None], across][shown]
        pixels = np.bincount(own, minlength=faces)
        for k in range(3):
            total = np.bincount(own, level[:, k], minlength=faces)
            found[i, :, k] = np.where(pixels > 0, total / np.maximum(pixels, 1), np.nan)
    found.sort(axis=0)  # NaN comes last
    seen = np.count_nonzero(~np.isnan(found[..., 0]), axis=0)
    middle = np.maximum(seen - 1, 0) // 2
    return np.asarray(np.take_along_axis(found, middle[None, :, None], axis=0)[0])


def divided_by_colour(
    face: Int, colours: Float, areas: Double, links: Links, among: Iterable[int]
) -> Int:
    """The segments of ``face`` (F,) with those ``among`` divided where their colour differs; the
    new ones have the next numbers. Parts of one colour are one segment, wherever they lie.

    colours  (F, 3) linear Rec.709, NaN where unknown
    areas    (F,) of the faces
    """
    shade = _smoothed(_shades(colours, areas), face, areas, links)
    result, following = face.copy(), int(face.max()) + 1
    for segment in among:
        own = np.flatnonzero(face == segment)
        group = _groups(shade[own], areas[own])
        group = _without_specks(group, own, areas, links)
        for number in range(1, int(group.max(initial=0)) + 1):
            if (group == number).any():
                result[own[group == number]] = following
                following += 1
    return result


def _shades(colours: Float, areas: Double) -> Double:
    """(F, 3) CIE L*a*b*, lightness weighed down; white is what the brighter faces are."""
    known = ~np.isnan(colours).any(axis=1)
    shade = np.full(colours.shape, np.nan)
    if not known.any():
        return shade
    level = colours[known].astype(np.float64) @ _XYZ[1]
    order = np.argsort(level, kind="stable")
    weight = areas[known][order].cumsum()
    white = level[order][min(int(np.searchsorted(weight, 0.9 * weight[-1])), len(order) - 1)]
    relative = np.maximum(colours[known], 0) / max(float(white), np.finfo(np.float32).tiny)
    t = relative @ (_XYZ / _XYZ.sum(axis=1, keepdims=True)).T
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t * (29 / 6) ** 2 / 3 + 4 / 29)
    lightness = 116 * f[:, 1] - 16
    shade[known] = np.stack(
        [_LIGHTNESS * lightness, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1
    )
    return shade


def _smoothed(shade: Double, face: Int, areas: Double, links: Links) -> Double:
    """Each face with those around it of its own segment that are not another colour; where nothing
    is known, what lies around."""
    inside = face[links.one] == face[links.other]
    one, other = links.one[inside], links.other[inside]
    count = len(face)
    for _ in range(_SMOOTHED):
        known = ~np.isnan(shade[:, 0])
        off = np.linalg.norm(shade[one] - shade[other], axis=1)
        # NaN is no distance: what is unknown takes from anything, and gives nothing.
        mixes = ~(off > _DIFFERENT)
        a = np.concatenate([one[mixes], other[mixes]])
        b = np.concatenate([other[mixes], one[mixes]])
        a, b = a[known[b]], b[known[b]]
        weight = np.bincount(a, areas[b], minlength=count) + np.where(known, areas, 0)
        total = np.where(known[:, None], areas[:, None] * shade, 0)
        for k in range(3):
            total[:, k] += np.bincount(a, areas[b] * shade[b, k], minlength=count)
        shade = np.where(
            weight[:, None] > 0, total / np.where(weight > 0, weight, 1)[:, None], np.nan
        )
    return shade


def _groups(shade: Double, areas: Double) -> Long:
    """(N,) which of a surface's colours each face has, 0 for the commonest and what is unknown.

    The commonest colour takes what does not differ from it, then the commonest of what is left, as
    long as it is a large enough share of the surface.
    """
    group = np.full(len(shade), -1, np.int64)
    known = ~np.isnan(shade[:, 0])
    least = _LEAST_COLOUR * float(areas.sum())
    centres: list[Double] = []
    while True:
        left = known & (group == -1)
        if float(areas[left].sum()) < least or not left.any():
            break
        bins = np.floor(shade[left] / _BIN).astype(np.int64)
        cells, cell = np.unique(bins, axis=0, return_inverse=True)
        weight = np.bincount(cell.reshape(-1), areas[left], minlength=len(cells))
        centre = (cells[int(weight.argmax())] + 0.5) * _BIN
        for _ in range(4):
            near = left & (np.linalg.norm(shade - centre, axis=1) < _DIFFERENT)
            if near.any():
                centre = np.average(shade[near], axis=0, weights=areas[near])
        near = left & (np.linalg.norm(shade - centre, axis=1) < _DIFFERENT)
        if not near.any():  # the mean has moved away from all of them
            near = left & (np.linalg.norm(shade - shade[left][0], axis=1) < _DIFFERENT)
        if float(areas[near].sum()) >= least:
            group[near] = len(centres)
            centres.append(centre)
        else:
            group[near] = -2  # too little: goes where it lies
    if not centres:
        return np.zeros(len(shade), np.int64)
    return np.where(group >= 0, group, np.where(known, -1, 0))


def _without_specks(group: Long, own: Long, areas: Double, links: Links) -> Long:
    """Groups (N,) of the faces ``own`` whose small islands have become what lies around them."""
    count = len(areas)
    place = np.full(count, -1, np.int64)
    place[own] = np.arange(len(own))
    inside = (place[links.one] >= 0) & (place[links.other] >= 0)
    own_links = Links(place[links.one[inside]], place[links.other[inside]], links.length[inside])
    least = _LEAST_COLOUR * float(areas[own].sum())
    same = group[own_links.one] == group[own_links.other]
    alike = Links(*(column[same] for column in own_links))
    island = parts_of(alike, np.ones(len(own), np.bool_))
    size = np.bincount(island, areas[own], minlength=len(own))
    group = np.where((size[island] < least) | (group < 0), -1, group)
    if not (group >= 0).any():
        return np.zeros(len(own), np.int64)
    group = flooded(own_links, group, group >= 0)
    return np.where(group < 0, 0, group)
