"""Embree by its C interface: a scene of triangles, its closest hits, and loops that trace rays
through it.

Rays are laid out in memory as Embree's headers say; no function tells these offsets."""

from __future__ import annotations

import ctypes
import weakref
from concurrent.futures import ThreadPoolExecutor
from functools import cache, cached_property
from typing import NamedTuple

import embreex.rtcore_scene
import llvmlite.binding
import numpy as np
from numba import types

from usdbrdf.errors import EnvironmentFailure, UsdBrdfError
from usdbrdf.kernel import loop, num_threads
from usdbrdf.model.arrays import Bool, Float, Int, Long

_TRIANGLES = 0  # RTC_GEOMETRY_TYPE_TRIANGLE
_INDICES, _VERTICES = 0, 1  # RTC_BUFFER_TYPE_INDEX, _VERTEX
_UINT3, _FLOAT3 = 0x5003, 0x9003  # RTC_FORMAT_UINT3, _FLOAT3
_HIGH = 2  # RTC_BUILD_QUALITY_HIGH
# Rays near an edge hit one of its triangles: without it one in 10,000 leaves a closed room that
# lies 100 m from the origin of its coordinates.
_ROBUST = 1 << 2  # RTC_SCENE_FLAG_ROBUST
# Embree may read 16 bytes from any vertex, also the last.
_FLOATS_BEHIND_VERTICES = 4
# A ray and its hit, RTCRayHit: 21 words of 4 bytes, filled up to 24, aligned to 16 bytes; and eight
# of them, RTCRayHit8: each word of a ray for all of them, aligned to 32 bytes.
_WORDS, _ALIGNED, _LANES, _ALIGNED_PACKET = 24, 16, 8, 32
_ORIGIN, _NEAR, _DIRECTION, _TIME, _FAR, _MASK, _ID, _FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
_U, _V, _FACE, _GEOMETRY, _INSTANCE = 15, 16, 17, 18, 19
_COHERENT = 1 << 16  # RTC_RAY_QUERY_FLAG_COHERENT
# The version in which they lie so, and RTC_DEVICE_PROPERTY_VERSION_MAJOR.
_MAJOR_VERSION, _VERSION_MAJOR = 4, 1
# Finite, so that what is computed with the distance of a ray that met nothing stays a number.
_FARTHEST = np.float32(1e37)
_pointer, _number, _size = ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t
_FUNCTIONS: dict[str, tuple[object, list[object]]] = {
    "rtcNewDevice": (_pointer, [ctypes.c_char_p]),
    "rtcGetDeviceError": (_number, [_pointer]),
    "rtcGetDeviceProperty": (ctypes.c_ssize_t, [_pointer, _number]),
    "rtcNewScene": (_pointer, [_pointer]),
    "rtcSetSceneFlags": (None, [_pointer, _number]),
    "rtcSetSceneBuildQuality": (None, [_pointer, _number]),
    "rtcCommitScene": (None, [_pointer]),
    "rtcReleaseScene": (None, [_pointer]),
    "rtcNewGeometry": (_pointer, [_pointer, _number]),
    "rtcSetSharedGeometryBuffer": (None, [_pointer, *[_number] * 3, _pointer, *[_size] * 3]),
    "rtcCommitGeometry": (None, [_pointer]),
    "rtcAttachGeometry": (_number, [_pointer, _pointer]),
    "rtcReleaseGeometry": (None, [_pointer]),
}


@cache
def _embree() -> ctypes.CDLL:
    """Embree's functions, found through the module of embreex that was linked to them."""
    library = ctypes.CDLL(embreex.rtcore_scene.__file__)
    try:
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
        for name in ("rtcIntersect1", "rtcIntersect8", "rtcOccluded1"):
            address = ctypes.cast(getattr(library, name), _pointer).value
            llvmlite.binding.add_symbol(name, address)
    except AttributeError as error:
        raise EnvironmentFailure(
            f"{embreex.rtcore_scene.__file__} does not reach Embree 4 ({error}): install the wheel "
            "of embreex 4.4 or newer from PyPI"
        ) from error
    return library


@cache
def _device() -> int:
    device: int | None = _embree().rtcNewDevice(None)
    if device is None:
        raise EnvironmentFailure(
            f"Embree does not start (its error {_embree().rtcGetDeviceError(None)}): it needs a "
            "64-bit processor with SSE2 and free memory"
        )
    version = _embree().rtcGetDeviceProperty(device, _VERSION_MAJOR)
    if version != _MAJOR_VERSION:
        raise EnvironmentFailure(
            f"{embreex.rtcore_scene.__file__} reaches Embree {version}, whose rays lie in memory "
            f"as those of Embree {_MAJOR_VERSION} need not: install the wheel of embreex 4.4 from "
            "PyPI"
        )
    return device


_intersect = types.ExternalFunction("rtcIntersect1", types.void(types.intp, types.intp, types.intp))
_intersect_packet = types.ExternalFunction(
    "rtcIntersect8", types.void(types.intp, types.intp, types.intp, types.intp)
)
_occluded = types.ExternalFunction("rtcOccluded1", types.void(types.intp, types.intp, types.intp))


class Hits(NamedTuple):
    """First surfaces along R rays.

    face      (R,) int32, index of the triangle, -1 where the ray left the scene
    u, v      (R,) float32, hit = (1-u-v) p0 + u p1 + v p2
    distance  (R,) float32, in units of the direction's length; meaningless where face is -1
    """

    face: Int
    u: Float
    v: Float
    distance: Float


class _Ray(NamedTuple):
    """Memory of a ray and its hit, as float32 and int32 words and as an address."""

    floats: Float
    words: Int
    address: int


@loop
def empty_hits(count: int) -> Hits:
    """Memory for the hits of so many rays."""
    u, v, distance = np.empty((3, count), np.float32)
    return Hits(np.empty(count, np.int32), u, v, distance)


@loop
def closest_hits(scene: int, origins: Float, directions: Float, hits: Hits) -> None:
    """First surface along each of R rays with directions (R, 3), into ``hits``: none where that is
    zero; origins (P, 3): ray r starts at origins[r % P]."""
    ray, point, count = _empty_ray(), 0, len(origins)
    for r in range(len(directions)):
        if directions[r, 0] == 0 and directions[r, 1] == 0 and directions[r, 2] == 0:
            hits.face[r], hits.distance[r] = -1, _FARTHEST
            hits.u[r], hits.v[r] = 0, 0
        else:
            _aim(ray, origins, point, directions, r)
            _find(scene, ray, hits, r)
        point = point + 1 if point + 1 < count else 0


@loop
def closest_hits_of_groups(
    scene: int, origins: Float, directions: Float, group: Long, hits: Hits
) -> None:
    """``closest_hits`` of rays with origins and directions (R, 3), of which those with the same
    number in ``group`` (R,) follow each other, start close together and are nearly parallel: they
    go through the scene together, eight at a time."""
    ray = _empty_ray()
    # In one piece: the packet, which of its rays count, RTCIntersectArguments.
    memory = _aligned((_WORDS + 2) * _LANES, _ALIGNED_PACKET)
    floats, words = memory.reshape(-1, _LANES), memory.view(np.int32).reshape(-1, _LANES)
    counts, arguments = words[_WORDS], words[_WORDS + 1]
    words[_MASK], arguments[0], arguments[1] = -1, _COHERENT, -1
    start, end = 0, len(directions)
    while start < end:
        lanes = 1
        while lanes < _LANES and start + lanes < end and group[start + lanes] == group[start]:
            lanes += 1
        if lanes == 1:  # alone it is nearly twice as fast
            _aim(ray, origins, start, directions, start)
            _find(scene, ray, hits, start)
            start += 1
            continue
        for j in range(lanes):
            r = start + j
            for c in range(3):
                floats[_ORIGIN + c, j], floats[_DIRECTION + c, j] = origins[r, c], directions[r, c]
        for j in range(_LANES):
            counts[j] = -1 if j < lanes else 0
            floats[_FAR, j] = _FARTHEST
            words[_GEOMETRY, j], words[_INSTANCE, j] = -1, -1
        _intersect_packet(counts.ctypes.data, scene, memory.ctypes.data, arguments.ctypes.data)
        for j in range(lanes):
            r = start + j
            hits.face[r] = words[_FACE, j] if words[_GEOMETRY, j] >= 0 else -1
            hits.u[r], hits.v[r], hits.distance[r] = floats[_U, j], floats[_V, j], floats[_FAR, j]
        start += lanes


@loop
def occlusion(
    scene: int,
    origins: Float,
    start: Int,
    directions: Float,
    distance: float | np.float32,
    blocked: Bool,
) -> None:
    """True in ``blocked`` (R,) where anything is nearer than ``distance``, in lengths of the
    direction; origins (P, 3), directions (R, 3): ray r starts at origins[start[r]], for the R of
    ``start``."""
    ray = _empty_ray()
    for r in range(len(start)):
        _aim(ray, origins, start[r], directions, r)
        ray.floats[_FAR] = distance
        _occluded(scene, ray.address, 0)
        blocked[r] = ray.floats[_FAR] < 0


@loop
def _aligned(words: int, size: int) -> Float:
    """Zeros, (words,), aligned to ``size`` bytes."""
    memory = np.zeros(words + size // 4, np.float32)
    first = (-memory.ctypes.data % size) // 4
    return memory[first : first + words]


@loop
def _empty_ray() -> _Ray:
    floats = _aligned(_WORDS, _ALIGNED)
    return _Ray(floats, floats.view(np.int32), floats.ctypes.data)


@loop
def _find(scene: int, ray: _Ray, hits: Hits, r: int) -> None:
    """What the aimed ``ray`` meets, into ``hits`` at ``r``."""
    floats, words = ray.floats, ray.words
    floats[_FAR] = _FARTHEST
    words[_GEOMETRY], words[_INSTANCE] = -1, -1
    _intersect(scene, ray.address, 0)
    hits.face[r] = words[_FACE] if words[_GEOMETRY] >= 0 else -1
    hits.u[r], hits.v[r], hits.distance[r] = floats[_U], floats[_V], floats[_FAR]


@loop
def _aim(ray: _Ray, origins: Float, o: int, directions: Float, d: int) -> None:
    floats, words = ray.floats, ray.words
    for c in range(3):
        floats[_ORIGIN + c], floats[_DIRECTION + c] = origins[o, c], directions[d, c]
    floats[_NEAR], floats[_TIME] = 0, 0
    words[_MASK], words[_ID], words[_FLAGS] = -1, 0, 0


# Rays are traced one at a time without Python's lock: chunks this long keep every core busy.
_CHUNK = 1 << 16
BOX_FACES = 64


class RayScene:
    """A committed Embree scene of one mesh. Results do not depend on the number of threads.

    ``points``, ``triangles``  as Embree reads them, for as long as this object lives; triangles
                               are the caller's own, points a copy
    ``address``                what the compiled loops know it by, as long as this object lives
    """

    def __init__(self, points: Float, triangles: Int) -> None:
        """points (V, 3) float32 finite; triangles (F, 3) int32 inside [0, V).

        Embree reports neither bad indices nor NaN triangles, so both are refused here. Raises
        EnvironmentFailure where memory does not suffice.
        """
        if triangles.size == 0:
            raise UsdBrdfError("a ray scene needs at least one triangle")
        if triangles.min() < 0 or triangles.max() >= len(points) or not np.isfinite(points).all():
            raise UsdBrdfError("a ray scene got a face index out of range or a non-finite vertex")
        padded = np.zeros(3 * len(points) + _FLOATS_BEHIND_VERTICES, np.float32)
        self.points: Float = padded[: 3 * len(points)].reshape(-1, 3)
        self.points[:] = points
        self.triangles: Int = np.ascontiguousarray(triangles, np.int32)
        self._pool = ThreadPoolExecutor(max_workers=num_threads())
        self._without: dict[tuple[int, ...], RayScene] = {}
        embree, device = _embree(), _device()
        mesh = embree.rtcNewGeometry(device, _TRIANGLES)
        for kind, form, values in (
            (_INDICES, _UINT3, self.triangles),
            (_VERTICES, _FLOAT3, self.points),
        ):
            embree.rtcSetSharedGeometryBuffer(
                mesh, kind, 0, form, values.ctypes.data, 0, values.strides[0], len(values)
            )
        embree.rtcCommitGeometry(mesh)
        self.address: int = embree.rtcNewScene(device)
        weakref.finalize(self, embree.rtcReleaseScene, self.address)
        embree.rtcSetSceneFlags(self.address, _ROBUST)
        embree.rtcSetSceneBuildQuality(self.address, _HIGH)
        embree.rtcAttachGeometry(self.address, mesh)
        embree.rtcReleaseGeometry(mesh)
        embree.rtcCommitScene(self.address)
        error = embree.rtcGetDeviceError(device)
        if error:
            raise EnvironmentFailure(
                f"Embree cannot take a mesh of {len(triangles):,} triangles (its error {error}): "
                "free some memory or use a smaller mesh"
            )

    def without(self, passed: tuple[int, ...], owner: Int) -> RayScene:
        """The same for rays that pass the triangles of some objects, by ``owner`` (F,), which is
        the same for each call; all keep their numbers. Made once for each ``passed``."""
        if passed not in self._without:
            triangles, gone = self.triangles.copy(), np.isin(owner, passed)
            # Rays meet no triangle without an area.
            triangles[gone] = triangles[gone, :1]
            self._without[passed] = RayScene(self.points, triangles)
        return self._without[passed]

    @cached_property
    def boxes(self) -> Float:
        """Low and high corner of the box around every BOX_FACES triangles in turn, (B, 2, 3)."""
        first = np.arange(0, len(self.triangles), BOX_FACES)
        low = np.full((len(first), 3), np.inf, np.float32)
        high = -low
        for corner in range(3):
            at = self.points[self.triangles[:, corner]]
            low = np.minimum(low, np.minimum.reduceat(at, first))
            high = np.maximum(high, np.maximum.reduceat(at, first))
        return np.stack([low, high], axis=1)

    def closest(self, origins: Float, directions: Float) -> Hits:
        """First hit of R rays: directions (R, 3), origins (P, 3), 1 <= P <= R, ray r from r % P,
        all float32 in the world frame; a direction of zeros meets nothing."""
        count = len(directions)
        hits: Hits = empty_hits(count)
        in_turn = len(origins) < count
        # Of origins that are used in turn each chunk takes all, so often as fits.
        whole = len(origins) if in_turn else 1
        step = max(1, _CHUNK // whole) * whole

        def trace(start: int) -> None:
            part = slice(start, min(start + step, count))
            closest_hits(
                self.address, origins if in_turn else origins[part], directions[part],
                Hits._make(values[part] for values in hits),
            )  # fmt: skip

        if 0 < count <= step:
            trace(0)
        else:
            list(self._pool.map(trace, range(0, count, step)))
        return hits


def lift_from_surface(positions: Float, normals: Float, diagonal_m: float) -> Float:
    """Origins just above the surface, so that a ray does not hit the triangle it starts on.

    The lift is 1e-5 of the scene's diagonal plus the float32 spacing of the coordinates themselves
    (positions, normals (R, 3) float32, metres).
    """
    spacing = 4 * np.float32(1.2e-7) * np.abs(positions).max(axis=-1, keepdims=True)
    lifted = positions + normals * (np.float32(1e-5 * diagonal_m) + spacing)
    return np.ascontiguousarray(lifted, np.float32)
