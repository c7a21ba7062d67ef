"""Asking for memory before it is needed: what a loop then reads is in the cache already."""

from __future__ import annotations

import ctypes
import weakref
from functools import cache
from typing import Any

import embreex.rtcore_scene
import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Bool, Float, Int, Long

_READ, _KEEP, _DATA = 0, 3, 1


@intrinsic  # type: ignore[untyped-decorator]
def prefetch(_: Any, array: Any, row: Any) -> Any:
    """Fetch the line of the cache that holds the start of array[row]; never reads, never waits.
    For use inside kernels; ``row`` is not counted from the end."""

    def instruction(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        of_array = signature.args[0]
        data = context.make_array(of_array)(context, builder, values[0])
        first = context.get_constant(types.intp, 0)
        index = context.cast(builder, values[1], signature.args[1], types.intp)
        place = cgutils.get_item_pointer(
            context, builder, of_array, data, [index] + [first] * (of_array.ndim - 1)
        )
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        call = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        builder.call(
            call, [builder.bitcast(place, byte), number(_READ), number(_KEEP), number(_DATA)]
        )
        return context.get_dummy_value()

    return types.void(array, row), instruction


_TRIANGLES = 0  # RTC_GEOMETRY_TYPE_TRIANGLE

_INDICES, _VERTICES = 0, 1  # RTC_BUFFER_TYPE_INDEX, _VERTEX

_UINT3, _FLOAT3 = 0x5003, 0x9003  # RTC_FORMAT_UINT3, _FLOAT3

# Rays near an edge hit one of its triangles: without it one in 10,000 leaves a closed room that
# lies 100 m from the origin of its coordinates.
_ROBUST = 1 << 2  # RTC_SCENE_FLAG_ROBUST

_HIGH = 2  # RTC_BUILD_QUALITY_HIGH

# Embree may read 16 bytes from any vertex, also the last.
_FLOATS_BEHIND_VERTICES = 4

# A ray and its hit, RTCRayHit: 21 words of 4 bytes, filled up to 24, aligned to 16 bytes.
_WORDS, _ALIGNED = 24, 16

_ORIGIN, _NEAR, _DIRECTION, _TIME, _FAR, _MASK, _ID, _FLAGS = 0, 3, 4, 7, 8, 9, 10, 11

_U, _V, _FACE, _GEOMETRY, _INSTANCE = 15, 16, 17, 18, 19

# Rays of one packet, RTCRayHit8: each word of a ray for all of them, aligned to 32 bytes.
_LANES, _ALIGNED_PACKET = 8, 32

_COHERENT = 1 << 16  # RTC_RAY_QUERY_FLAG_COHERENT

# Finite, so that what is computed with the distance of a ray that met nothing stays a number.
_FARTHEST = np.float32(1e37)

_pointer, _number, _size = ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t

_FUNCTIONS: dict[str, tuple[object, list[object]]] = {
    "rtcNewDevice": (_pointer, [ctypes.c_char_p]),
    "rtcGetDeviceError": (_number, [_pointer]),
    "rtcNewScene": (_pointer, [_pointer]),
    "rtcSetSceneFlags": (None, [_pointer, _number]),
    "rtcSetSceneBuildQuality": (None, [_pointer, _number]),
    "rtcCommitScene": (None, [_pointer]),
    "rtcReleaseScene": (None, [_pointer]),
    "rtcNewGeometry": (_pointer, [_pointer, _number]),
    "rtcSetSharedGeometryBuffer": (
        None,
        [_pointer, _number, _number, _number, _pointer, _size, _size, _size],
    ),
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
    return device


class EmbreeScene:
    """A committed scene of one mesh, for the loops below.

    points (V, 3) float32; triangles (F, 3) int32 inside [0, V)

    ``points``, ``triangles``  as Embree reads them, for as long as this object lives; triangles
                               are the caller's own, points a copy
    ``address``                what the loops know it by
    """

    def __init__(self, points: Float, triangles: Int) -> None:
        """Raises EnvironmentFailure where memory does not suffice."""
        padded = np.zeros(3 * len(points) + _FLOATS_BEHIND_VERTICES, np.float32)
        self.points: Float = padded[: 3 * len(points)].reshape(-1, 3)
        self.points[:] = points
        self.triangles: Int = np.ascontiguousarray(triangles, np.int32)
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


_intersect = types.ExternalFunction("rtcIntersect1", types.void(types.intp, types.intp, types.intp))

_intersect_packet = types.ExternalFunction(
    "rtcIntersect8", types.void(types.intp, types.intp, types.intp, types.intp)
)

_occluded = types.ExternalFunction("rtcOccluded1", types.void(types.intp, types.intp, types.intp))


@loop
def closest_hits(
    scene: int, origins: Float, directions: Float, face: Int, u: Float, v: Float, distance: Float
) -> None:
    """First surface along each of R rays, into the last four (R,): triangle (-1: none),
    barycentric place, distance in lengths of the direction.

    origins (P, 3), directions (R, 3): ray r starts at origins[r % P].
    """
    ray = _aligned(_WORDS, _ALIGNED)
    words, place, count = ray.view(np.int32), ray.ctypes.data, len(origins)
    point = 0
    for r in range(len(directions)):
        _aim(ray, words, origins, point, directions, r)
        _find(scene, ray, words, place, (face, u, v, distance), r)
        point = point + 1 if point + 1 < count else 0


@loop
def closest_hits_of_groups(
    scene: int,
    origins: Float,
    directions: Float,
    group: Long,
    face: Int,
    u: Float,
    v: Float,
    distance: Float,
) -> None:
    """``closest_hits`` of rays with origins and directions (R, 3), of which those with the same
    number in ``group`` (R,) follow each other, start close together and are nearly parallel: they
    go through the scene together, eight at a time."""
    ray = _aligned(_WORDS, _ALIGNED)
    ray_words, ray_place = ray.view(np.int32), ray.ctypes.data
    # In one piece: the packet, which of its rays count, RTCIntersectArguments.
    memory = _aligned((_WORDS + 2) * _LANES, _ALIGNED_PACKET)
    words, place = memory.view(np.int32), memory.ctypes.data
    rays, hits = memory.reshape(-1, _LANES), words.reshape(-1, _LANES)
    counts, arguments = hits[_WORDS], hits[_WORDS + 1]
    hits[_MASK], arguments[0], arguments[1] = -1, _COHERENT, -1
    start, end = 0, len(directions)
    while start < end:
        lanes = 1
        while lanes < _LANES and start + lanes < end and group[start + lanes] == group[start]:
            lanes += 1
        if lanes == 1:  # alone it is nearly twice as fast
            _aim(ray, ray_words, origins, start, directions, start)
            _find(scene, ray, ray_words, ray_place, (face, u, v, distance), start)
            start += 1
            continue
        for j in range(lanes):
            r = start + j
            for c in range(3):
                rays[_ORIGIN + c, j], rays[_DIRECTION + c, j] = origins[r, c], directions[r, c]
        for j in range(_LANES):
            counts[j] = -1 if j < lanes else 0
            rays[_FAR, j] = _FARTHEST
            hits[_GEOMETRY, j], hits[_INSTANCE, j] = -1, -1
        _intersect_packet(counts.ctypes.data, scene, place, arguments.ctypes.data)
        for j in range(lanes):
            r = start + j
            face[r] = hits[_FACE, j] if hits[_GEOMETRY, j] >= 0 else -1
            u[r], v[r], distance[r] = rays[_U, j], rays[_V, j], rays[_FAR, j]
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
    ray = _aligned(_WORDS, _ALIGNED)
    words, place = ray.view(np.int32), ray.ctypes.data
    for r in range(len(start)):
        _aim(ray, words, origins, start[r], directions, r)
        ray[_FAR] = distance
        _occluded(scene, place, 0)
        blocked[r] = ray[_FAR] < 0


@loop
def _aligned(words: int, size: int) -> Float:
    """Zeros, (words,), aligned to ``size`` bytes."""
    memory = np.zeros(words + size // 4, np.float32)
    first = (-memory.ctypes.data % size) // 4
    return memory[first : first + words]


@loop
def _find(
    scene: int,
    ray: Float,
    words: Int,
    place: int,
    found: tuple[Int, Float, Float, Float],
    r: int,
) -> None:
    """What the aimed ``ray`` meets, into face, u, v and distance at ``r``."""
    face, u, v, distance = found
    ray[_FAR] = _FARTHEST
    words[_GEOMETRY], words[_INSTANCE] = -1, -1
    _intersect(scene, place, 0)
    face[r] = words[_FACE] if words[_GEOMETRY] >= 0 else -1
    u[r], v[r], distance[r] = ray[_U], ray[_V], ray[_FAR]


@loop
def _aim(ray: Float, words: Int, origins: Float, o: int, directions: Float, d: int) -> None:
    for c in range(3):
        ray[_ORIGIN + c], ray[_DIRECTION + c] = origins[o, c], directions[d, c]
    ray[_NEAR], ray[_TIME] = 0, 0
    words[_MASK], words[_ID], words[_FLAGS] = -1, 0, 0
