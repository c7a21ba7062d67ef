"""UV charts per object at a given texel size: those that a mesh came with, if they are fit to hold
what is measured, or new ones by xatlas in a child process."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from usdbrdf.errors import CrashedChild, EnvironmentFailure, InputRefused
from usdbrdf.job.child import child, in_a_copy, shared_zeros
from usdbrdf.job.progress import say, warn
from usdbrdf.kernel import kernel
from usdbrdf.model.arrays import Array, Double, Float, Int, Long
from usdbrdf.model.mesh import compact, doubled_areas, halved
from usdbrdf.model.scene import Scene, SceneObject

# Texels between charts: of those that came along, so that bilinear lookup stays inside its own; of
# new ones, with two mip levels.
_GAP, PADDING = 2, 4
MAX_SIDE = 16384
# What charts may take of computing: at least, and for each triangle. It lies far beyond what ends,
# or the atlas would tell of the machine's speed: 80,000 triangles of a surface with noise take 10 s
# on a slow one. And how many times that of wall time, where others are at work.
_SECONDS, _SECONDS_OF_FACE, _BUSY = 600.0, 5e-3, 10
# An object with more triangles gets its charts by parts: on surfaces with noise xatlas' time grows
# with the square of their number, and on smooth closed ones it crashes. A part has so many
# triangles, few where these are large: it is to be no smaller than so many texels.
_WHOLE, _FACES_OF_PART, _TEXELS_OF_PART = 20_000, (2000, 8000), 64**2
# Their charts are those of the surface without its noise, which would end them: after so many steps
# of smoothing, more where triangles are smaller than texels.
_STEPS = 2, 32
# Children at work: each holds all the geometry. Of an object in one part xatlas takes one core.
_AT_ONCE = min(4, os.cpu_count() or 1)
# Triangles for which another one starts: it takes most of a second to import what it needs.
_FACES_OF_CHILD = 2000
# Those of this process, which stay (see ``_new_atlas``). Each has a thread for each core, so that
# a copy of the child makes those of a few small objects, or of one large.
_ATLASES: list[Any] = []
_OBJECTS_OF_COPY = max(1, 16 // (os.cpu_count() or 1))
# A texel's sides on the surface may differ from those wanted by this factor, up or down, on all
# but a small share of the area.
_MAX_STRETCH, _MAX_SHARE = 2.0, 0.05


def atlas_side(corner_uv: Float, corners: Float, texel_size: float) -> int | None:
    """Texels along each side of the square atlas that an object's own coordinates ask for; None
    where they are not fit: outside [0, 1], stretched, or with two places of the surface in one
    place of the atlas or too near to each other.

    corner_uv (F, 3, 2); corners (F, 3, 3), metres; texel_size in metres
    """
    if not (np.isfinite(corner_uv).all() and corner_uv.min() >= 0 and corner_uv.max() <= 1):
        return None
    edges = (corners[:, 1:] - corners[:, :1]).astype(np.float64)
    flat = (corner_uv[:, 1:] - corner_uv[:, :1]).astype(np.float64)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    flat_area = np.abs(np.linalg.det(flat)) / 2
    shown = area > 0
    if not shown.any() or (flat_area[shown] < 1e-12).any():
        return None
    side = math.ceil(math.sqrt(area.sum() / flat_area[shown].sum()) / texel_size)
    if side > MAX_SIDE:
        return None
    sides = np.full(len(corners), texel_size, np.float32)
    if stretched_share(corner_uv * np.float32(side), corners, sides) > _MAX_SHARE:
        return None
    # Charts are connected both on the surface and in the atlas. No texel's centre may lie in two
    # triangles, and none of two charts nearer than _GAP texels.
    rows = np.concatenate([corner_uv, corners], axis=2).reshape(-1, 5)
    _, vertex = np.unique(rows, axis=0, return_inverse=True)
    owner = np.full((side, side), -1, np.int32)
    chart = connected_triangles(vertex.reshape(-1, 3))
    if not _paint(corner_uv.astype(np.float64) * side, chart, owner):
        return None
    near = 2 * _GAP + 1
    highest = ndimage.maximum_filter(owner, near, mode="nearest")
    lowest = ndimage.minimum_filter(
        np.where(owner >= 0, owner, np.iinfo(np.int32).max), near, mode="nearest"
    )
    return side if (highest == lowest)[owner >= 0].all() else None


def connected_triangles(vertex: Array) -> Int:
    """(F,) int32: a number for the part of the surface, connected through shared vertices, that
    each triangle (F, 3) belongs to."""
    size = int(vertex.max()) + 1
    ends = np.repeat(vertex[:, 0], 2), vertex[:, 1:].reshape(-1)
    links = coo_array((np.ones(len(ends[0]), np.int8), ends), shape=(size, size))
    _, part = connected_components(links, directed=False)
    return np.asarray(part[vertex[:, 0]], np.int32)


@kernel
def _paint(corners: Double, chart: Int, owner: Int) -> bool:
    """Write each triangle's chart to the texels whose centres it covers; False if two share one."""
    side = len(owner)
    for f in range(len(corners)):
        x, y = corners[f, :, 0], corners[f, :, 1]
        for j in range(max(0, int(y.min() - 0.5)), min(side, int(y.max() + 0.5) + 1)):
            for i in range(max(0, int(x.min() - 0.5)), min(side, int(x.max() + 0.5) + 1)):
                left = 0
                right = 0
                for a in range(3):
                    b = (a + 1) % 3
                    turn = (x[b] - x[a]) * (j + 0.5 - y[a]) - (y[b] - y[a]) * (i + 0.5 - x[a])
                    # On an edge the centre belongs to neither side.
                    left += turn > 1e-6
                    right += turn < -1e-6
                if left == 3 or right == 3:
                    if owner[j, i] >= 0:
                        return False
                    owner[j, i] = chart[f]
    return True


class TexelSizes(NamedTuple):
    """What F triangles ask of their textures: side of a texel in metres (F,), and how many pixels
    of the frames ask for it (F,); where there are none the size is for what nobody sees. A chart
    has one density: the size that its pixels agree on, else that of its area."""

    side: Float
    pixels: Float

    @classmethod
    def even(cls, scene: Scene, side: float) -> TexelSizes:
        """One size everywhere."""
        return cls(*np.full((2, len(scene.triangles)), side, np.float32))

    def of_objects(self, scene: Scene) -> list[float]:
        """Of each object: as its pixels, or else its triangles, agree on the average."""
        if (self.side == self.side[0]).all():
            return [float(self.side[0])] * len(scene.objects)
        area = doubled_areas(scene.points, scene.triangles)
        return [
            float(_agreed(self.side[obj.faces], self.pixels[obj.faces], area[obj.faces]))
            for obj in scene.objects
        ]


def _agreed(side: Float, pixels: Float, area: Double) -> float:
    """The geometric mean over the pixels that show triangles, or over the area that none shows."""
    weight = pixels if pixels.any() else area + 1e-30
    return math.exp(np.average(np.log(side.astype(np.float64)), weights=weight))


def charts_of_scene(
    scene: Scene, given: Sequence[Float | None], sizes: TexelSizes
) -> dict[str, Array]:
    """New charts as ``unwrap`` makes them, but for objects that came with coordinates which are fit
    for it: corner_uv (F, 3, 2), resolution (num_objects, 2).

    given  per object (F_i, 3, 2), or None
    """
    corner_uv, resolution = unwrap(scene, sizes)
    of_objects = sizes.of_objects(scene)
    for i, (obj, uv) in enumerate(zip(scene.objects, given, strict=True)):
        corners = scene.points[scene.triangles[obj.faces]]
        side = None if uv is None else atlas_side(uv, corners, of_objects[i])
        if uv is not None and side is not None:
            corner_uv[obj.faces], resolution[i] = uv, side
            say(f"texture: {obj.identifier} keeps the texture coordinates that it came with")
    return {"corner_uv": corner_uv, "resolution": resolution}


def unwrap(scene: Scene, sizes: TexelSizes) -> tuple[Float, Int]:
    """UVs of every object in its own atlas: corner_uv (F, 3, 2) in [0, 1], v up, and the atlas
    size in texels of each object, (num_objects, 2) int32 width, height. They do not depend on which
    of its corners a triangle begins with.

    An object on which xatlas crashes or computes without end has its triangles packed one by one.
    Raises InputRefused when an atlas would be larger than 16,384 texels on a side, and LateChild
    where the machine is too busy to tell.
    """

    def too_large(obj: SceneObject, said: str) -> InputRefused:
        return InputRefused(
            f"<{obj.prim_path}>: its {said} texels (limit {MAX_SIDE}). Choose a larger "
            f"--texel-size than {sizes.side[obj.faces].min():g} m. [texturing.size]"
        )

    # Packing what cannot fit takes xatlas minutes; the area alone tells it at once.
    area = doubled_areas(scene.points, scene.triangles) / 2
    texels = area / sizes.side.astype(np.float64) ** 2
    for obj in scene.objects:
        side = math.ceil(math.sqrt(texels[obj.faces].sum()))
        if side > MAX_SIDE:
            raise too_large(obj, f"{area[obj.faces].sum():.3g} m^2 would need {side} x {side}")
    # Charts grow from edges in the order in which triangles name them, which is chance where they
    # were turned towards the cameras.
    order = (scene.triangles.argmin(axis=1)[:, None] + np.arange(3)) % 3
    scene = replace(scene, triangles=np.take_along_axis(scene.triangles, order, axis=1))
    try:
        found, resolution = _side_by_side(scene, sizes)
    except (CrashedChild, EnvironmentFailure):  # one alone takes less memory, too
        found, resolution = _one_by_one(scene, sizes)
    corner_uv = np.empty_like(found)
    np.put_along_axis(corner_uv, order[..., None], found, axis=1)
    for obj, (width, height) in zip(scene.objects, resolution, strict=True):
        if max(width, height) > MAX_SIDE:
            raise too_large(obj, f"texture would be {width} x {height}")
    return corner_uv, resolution


def _side_by_side(scene: Scene, sizes: TexelSizes) -> tuple[Float, Int]:
    """As ``unwrap``, the objects dealt out, the largest first, to a few children at once."""
    first = np.array([obj.first_face for obj in scene.objects], np.int64)
    count = np.array([obj.num_faces for obj in scene.objects], np.int64)
    given = {"points": scene.points, "triangles": scene.triangles, **sizes._asdict()}
    wanted = 1 + int(count.sum()) // _FACES_OF_CHILD
    shares: list[list[int]] = [[] for _ in range(min(_AT_ONCE, len(count), wanted))]
    for i in np.argsort(-count, kind="stable"):
        min(shares, key=lambda share: int(count[share].sum())).append(int(i))
    corner_uv = np.zeros((len(scene.triangles), 3, 2), np.float32)
    resolution = np.zeros((len(count), 2), np.int32)
    with ExitStack() as children:
        coming = []
        for share in shares:
            own = {**given, "first": first[share], "count": count[share]}
            coming.append(children.enter_context(_child(own, "unwrapping the objects")))
        for share, result in zip(shares, coming, strict=True):
            found = result()
            resolution[share] = found["resolution"]
            for i in share:
                faces = scene.objects[i].faces
                corner_uv[faces] = found["corner_uv"][faces]
    return corner_uv, resolution


def _child(
    arrays: Mapping[str, Array], label: str
) -> AbstractContextManager[Callable[[], dict[str, Array]]]:
    """``unwrap_objects``, where it may crash or hang as xatlas does on some meshes."""
    faces = int(arrays["count"].sum())
    limit = math.ceil(_SECONDS + _SECONDS_OF_FACE * faces)
    function = f"{__name__}:unwrap_objects"
    return child(function, arrays, {}, _BUSY * limit, label, cpu_limit_s=limit)


def _one_by_one(scene: Scene, sizes: TexelSizes) -> tuple[Float, Int]:
    """The same with a child for each object; one that still crashes or does not end has each of its
    triangles packed by itself, and the user hears of it."""
    corner_uv = np.zeros((len(scene.triangles), 3, 2), np.float32)
    resolution = np.zeros((len(scene.objects), 2), np.int32)
    for i, obj in enumerate(scene.objects):
        points, triangles = compact(scene.points, scene.triangles[obj.faces])[1:]
        own = TexelSizes(sizes.side[obj.faces], sizes.pixels[obj.faces])
        arrays = {"points": points, "triangles": triangles, **own._asdict()}
        arrays |= {"first": np.zeros(1, np.int64), "count": np.array([obj.num_faces])}
        try:
            with _child(arrays, f"unwrapping <{obj.prim_path}>") as result:
                found = result()
            corner_uv[obj.faces], resolution[i] = found["corner_uv"], found["resolution"][0]
        except CrashedChild as error:
            warn(
                f"<{obj.prim_path}>: its {obj.num_faces} triangles are packed one by one, which "
                f"wastes texels: {str(error).rpartition('. ')[0]}. Clean that part of the mesh. "
                "[texturing.unwrap]"
            )
            corner_uv[obj.faces], resolution[i] = pack_triangles_singly(
                scene.points[scene.triangles[obj.faces]], float(own.side.min())
            )
    return corner_uv, resolution


def unwrap_objects(arrays: Mapping[str, Array], parameters: Mapping[str, Any]) -> dict[str, Array]:
    """Child process: unwrap each object by itself (see ``unwrap``), in copies of this process, with
    which the threads and the memory of their atlases go."""
    triangles, points = arrays["triangles"], arrays["points"]
    first, count = arrays["first"], arrays["count"]
    corner_uv = shared_zeros((len(triangles), 3, 2), np.float32)
    resolution = shared_zeros((len(count), 2), np.int32)

    def unwrap_each(of_copy: Long) -> None:
        for i in of_copy:
            faces = slice(int(first[i]), int(first[i] + count[i]))
            _, own, corners = compact(points, triangles[faces])
            sizes = TexelSizes(arrays["side"][faces], arrays["pixels"][faces])
            corner_uv[faces], resolution[i] = _unwrap_one(own, corners, sizes)

    objects = np.arange(len(count))
    copy = objects // _OBJECTS_OF_COPY + np.cumsum(count) // _WHOLE
    for of_copy in np.split(objects, np.flatnonzero(np.diff(copy)) + 1):
        in_a_copy(partial(unwrap_each, of_copy))
    return {"corner_uv": corner_uv, "resolution": resolution}


def _unwrap_one(points: Float, triangles: Int, sizes: TexelSizes) -> tuple[Float, tuple[int, int]]:
    corners, finest = points[triangles], float(sizes.side.min())
    if len(triangles) > _WHOLE:
        texels = doubled_areas(points, triangles) / 2 / sizes.side.astype(np.float64) ** 2
        parts = parts_of(corners.mean(axis=1), float(texels.sum()))
        # Steps reach as far as their root times an edge.
        steps = math.ceil(np.clip(len(triangles) / texels.sum(), *_STEPS))
        found = _by_xatlas(without_noise(points, triangles, steps), triangles, sizes, parts)
        if found:
            corner_uv, resolution = found
            in_texels = corner_uv * np.array(resolution, np.float32)
            if stretched_share(in_texels, corners, sizes.side) <= _MAX_SHARE:
                return found
    else:
        parts = [np.arange(len(triangles))]
    return _by_xatlas(points, triangles, sizes, parts) or pack_triangles_singly(corners, finest)


def _by_xatlas(
    points: Float, triangles: Int, sizes: TexelSizes, parts: Sequence[Long]
) -> tuple[Float, tuple[int, int]] | None:
    """corner_uv (F, 3, 2) and the size of the atlas, no chart of which reaches from one part to
    another; None where what xatlas returns is none."""
    import xatlas

    low, high = points.min(axis=0), points.max(axis=0)
    extent = float((high - low).max())
    unit = ((points - low) / max(extent, 1e-12)).astype(np.float32)
    finest = float(sizes.side.min())
    atlas = _new_atlas()
    for part in parts:
        _, own, corners = compact(unit, triangles[part])
        atlas.add_mesh(own, corners.astype(np.uint32))
    options = xatlas.PackOptions()
    options.padding = PADDING
    options.texels_per_unit = extent / finest
    options.bilinear = True
    options.rotate_charts = True
    atlas.generate(xatlas.ChartOptions(), options)
    laid_out = _laid_out(atlas, parts)
    if laid_out and (sizes.side != finest).any():
        atlas = _at_own_densities(atlas, parts, *laid_out, points, triangles, sizes, options)
        laid_out = _laid_out(atlas, [np.arange(len(triangles))])
    width, height = int(atlas.width), int(atlas.height)
    if laid_out is None or min(width, height) == 0:
        return None
    uv, places = laid_out
    corner_uv = beside_neighbours(uv[places], points, triangles, sizes.side)
    if corner_uv is None:
        return None
    corner_uv[..., 1] = 1 - corner_uv[..., 1]
    return corner_uv, (width, height)


def parts_of(centres: Float, texels: float) -> list[Long]:
    """Triangles at ``centres`` (F, 3), which have so many texels in all, in parts that are near
    each other and about equally many."""
    fewest, most = _FACES_OF_PART
    most = int(np.clip(_TEXELS_OF_PART * len(centres) / max(texels, 1), fewest, most))
    parts = [np.arange(len(centres))]
    while len(parts[-1]) > most:
        parts = [np.sort(half) for part in parts for half in halved(centres, part)]
    return parts


def without_noise(points: Float, triangles: Int, steps: int) -> Float:
    """Points (V, 3) of a surface that bends less within about the root of ``steps`` edges, and is
    as large as before (Taubin, A Signal Processing Approach to Fair Surface Design, 1995)."""
    ends = np.concatenate([triangles[:, [a, b]] for a in range(3) for b in range(3) if a != b]).T
    beside = coo_array((np.ones(len(ends[0]), np.int8), tuple(ends)), shape=(len(points),) * 2)
    links = (beside.tocsr() > 0).astype(np.float64)
    number = np.maximum(links.sum(axis=1), 1)[:, None]
    smooth = points.astype(np.float64)
    for _ in range(steps):
        for share in (0.5, -0.53):
            smooth += share * (links @ smooth / number - smooth)
    return smooth.astype(np.float32)


def stretched_share(texels: Float, corners: Float, side: Float) -> float:
    """The share of the area whose texels' sides on the surface, the longest or the shortest, differ
    from those wanted, ``side`` (F,) in metres, by more than _MAX_STRETCH. texels (F, 3, 2): places
    of the corners (F, 3, 3) in the atlas."""
    edges = (corners[:, 1:] - corners[:, :1]).astype(np.float64)
    flat = (texels[:, 1:] - texels[:, :1]).astype(np.float64)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    laid = (np.abs(np.linalg.det(flat)) > 1e-9) & (area > 0)
    metres = np.linalg.svd(np.linalg.inv(flat[laid]) @ edges[laid], compute_uv=False)
    stretch = metres / side[laid, None]
    odd = ~laid
    odd[laid] = ((stretch > _MAX_STRETCH) | (stretch < 1 / _MAX_STRETCH)).any(axis=1)
    return float(area[odd].sum() / max(area.sum(), 1e-30))


def _new_atlas() -> Any:
    """One that is never destroyed: xatlas would wait for its threads, and may wait for ever (what
    wakes one that is about to sleep is lost)."""
    import xatlas

    _ATLASES.append(xatlas.Atlas())
    return _ATLASES[-1]


def _laid_out(atlas: Any, parts: Sequence[Long]) -> tuple[Float, Long] | None:
    """uv (N, 2) of an atlas with a mesh for each part, and each triangle's corners there, (F, 3);
    None where it lost triangles."""
    corners = np.zeros((sum(map(len, parts)), 3), np.int64)
    every: list[Float] = []
    for i, part in enumerate(parts):
        _, own, uv = atlas[i]
        if own.shape != (len(part), 3):
            return None
        corners[part] = own.astype(np.int64) + sum(map(len, every))
        every.append(uv)
    return np.concatenate(every), corners


def beside_neighbours(corner_uv: Float, points: Float, triangles: Int, side: Float) -> Float | None:
    """The coordinates with those of lost triangles shrunk to a point of one nearby that has its
    own; None if one is lost that is no sliver, thinner than its texels are wide.

    xatlas drops single triangles thinner than its tolerance, and leaves in their place the origin,
    or after it packed charts again what lies outside [0, 1].

    corner_uv (F, 3, 2); points (P, 3) and side (F,) of the texels, metres; triangles (F, 3)
    """
    fits = (np.isfinite(corner_uv) & (corner_uv >= 0) & (corner_uv <= 1)).all(axis=(1, 2))
    corners = points[triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    sliver = doubled_areas(points, triangles) <= longest * side
    kept = fits & corner_uv.any(axis=(1, 2))
    if not (fits | sliver).all() or not kept.any():
        return None
    mended = corner_uv.astype(np.float32)
    if not kept.all():
        _, nearest = cKDTree(corners[kept].reshape(-1, 3)).query(corners[~kept].mean(axis=1))
        mended[~kept] = corner_uv[kept].reshape(-1, 2)[nearest][:, None]
    return mended


def _at_own_densities(
    atlas: Any,
    parts: Sequence[Long],
    uv: Float,
    corners: Long,
    points: Float,
    triangles: Int,
    sizes: TexelSizes,
    options: Any,
) -> Any:
    """An atlas in which the charts of another, laid out as given, are packed again, each at the
    texel size that its triangles agree on."""
    import xatlas

    area = doubled_areas(points, triangles)
    of_vertex = np.zeros(len(uv), np.int64)
    scales: list[float] = []
    for i, part in enumerate(parts):
        for k in range(atlas.get_mesh_chart_count(i)):
            faces = part[np.asarray(atlas.get_mesh_chart(i, k).faces)]
            agreed = _agreed(sizes.side[faces], sizes.pixels[faces], area[faces])
            of_vertex[corners[faces]] = len(scales)
            scales.append(sizes.side.min() / agreed)
    scale, count = np.array(scales), len(scales)
    texels = uv * np.array([atlas.width, atlas.height], np.float64)
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, of_vertex, texels)
    np.maximum.at(high, of_vertex, texels)
    # Side by side: xatlas tells charts apart by where they lie.
    wide = (high - low)[:, 0] * scale + PADDING
    start = np.cumsum(wide) - wide
    placed = (texels - low[of_vertex]) * scale[of_vertex, None]
    placed[:, 0] += start[of_vertex]
    packed = _new_atlas()
    packed.add_uv_mesh(placed.astype(np.float32), corners.astype(np.uint32))
    options.texels_per_unit = 1.0
    packed.generate(xatlas.ChartOptions(), options)
    return packed


def pack_triangles_singly(corners: Float, texel_size: float) -> tuple[Float, tuple[int, int]]:
    """The fallback without charts: every triangle in a square cell of its own.

    corners (F, 3, 3) metres. Cells are as large as the largest triangle needs, so this wastes
    texels, but it has no failure modes. Returns (F, 3, 2) UVs and the atlas size.
    """
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    side = int(np.clip(np.ceil(edges.max() / texel_size), 1, 1024))
    cell = side + 2 * PADDING
    columns = int(np.ceil(np.sqrt(len(corners))))
    rows = -(-len(corners) // columns)
    index = np.arange(len(corners))
    origin = np.stack([index % columns, index // columns], axis=-1) * cell + PADDING
    shape = np.array([[0, 0], [side, 0], [0, side]], np.float64)
    uv = (origin[:, None] + shape[None]) / (columns * cell, rows * cell)
    uv[..., 1] = 1 - uv[..., 1]
    return uv.astype(np.float32), (columns * cell, rows * cell)
