"""Which side of each face is the surface: the one that the cameras see.

Meshes from modelling programs and thin scanned sheets are wound as it happened. What counts is, in
this order: from which side the frames see a face itself; which side they see of the faces that hang
together with it; and, where no frame looked, on which side the surfaces lie that were seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from usdbrdf.ahead import ahead
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.kernel import kernel
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.mesh import (
    ScanMesh,
    doubled_areas,
    edges_of_two,
    face_normals_and_angles,
    welded_ids,
)
from usdbrdf.transport.rays import RayScene, lift_from_surface

# Rays that graze a face may belong to its neighbour behind the edge: their side tells nothing.
_GRAZING = 0.1
# A side was seen if so many pixels show it; a face has two if so many frames show each of them.
_PIXELS, _FRAMES_OF_EACH = 2, 2
# Pixels of a frame's width that are looked at: more tell nothing new about a side.
_MOST_ACROSS = 1024
# Faces of an unseen part that look around, and in how many directions from either side.
_LOOKING, _DIRECTIONS = 16, 16
# The second skin lies so far behind the first, as a share of the scene's diagonal: further than
# rays start above a surface.
_BEHIND = 4e-5
# Odd numbers of 64 bits: the sum of three corners times these is hardly ever that of three others.
_HASH = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


@dataclass(frozen=True)
class Sightings:
    """How often frames show either side of F faces: pixels (F, 2) and frames (F, 2) int32, the
    front, which the winding tells, first."""

    pixels: Int
    frames: Int

    @property
    def votes(self) -> Long:
        """(F,): pixels that show the front less those that show the back."""
        return self.pixels[:, 0].astype(np.int64) - self.pixels[:, 1]

    @property
    def both(self) -> Bool:
        """(F,): either side is part of the capture."""
        enough = (self.pixels >= _PIXELS) & (self.frames >= _FRAMES_OF_EACH)
        return np.asarray(enough.all(axis=1), np.bool_)


@dataclass(frozen=True)
class Sides:
    """turned, both (F,) bool: the winding shows the wrong side; frames see either side.

    frames  (F, 2) int32: how many of them see the front, which the winding tells, and the back
    part  (F,): the number of what hangs together with it, see ``connected_windings``
    faces_room  (F,) bool: the back, which no frame sees, faces what they see all the same
    """

    turned: Bool
    both: Bool
    frames: Int
    part: Long
    faces_room: Bool

    @property
    def skins(self) -> Bool:
        """(F,): the back is a surface of its own, with light of its own."""
        return self.both | self.faces_room


def sides_from_cameras(mesh: ScanMesh, rays: RayScene, cameras: Iterable[Camera]) -> Sides:
    """The side of every face of a mesh that cameras, in its own frame and unit, looked at; rays:
    the scene of the mesh."""
    normals = mesh.face_normals
    seen = sightings(rays, normals, cameras)
    votes = seen.votes
    decided = np.abs(votes) >= _PIXELS
    part, agrees = connected_windings(mesh)
    of_part = np.bincount(part, np.where(agrees, votes, -votes), minlength=part.max() + 1)
    facing = np.where(decided, votes, np.where(agrees, 1, -1) * of_part[part])
    lost = facing == 0
    if lost.any():
        shown = np.where(decided, np.sign(votes), 0)
        facing = np.where(
            lost, _looking_around(mesh, rays, normals, lost, shown, part, agrees), facing
        )
    nothing = np.zeros(len(facing), np.bool_)
    return Sides(
        turned=facing < 0, both=seen.both, frames=seen.frames, part=part, faces_room=nothing
    )


def with_backs(sides: Sides, mesh: ScanMesh, rays: RayScene, *, referenced: bool) -> Sides:
    """The sides, and the backs of thin things that stand in the room: most of what lies behind the
    faces of such a part, as they hang together, shows its front, or has two. Behind what is closed,
    and around a room, it is insides and nothing; and a back that the file has lies closer than a
    second skin. Behind a mesh that is ``referenced`` nothing is put, whose faces have one side.

    Parts are judged whole: half of a thing's back would let light through the other half.
    """
    if referenced:
        nothing = np.zeros_like(sides.both)
        return replace(sides, both=nothing, faces_room=nothing)
    part = sides.part
    seen = np.bincount(part, sides.frames.any(axis=1)) > 0
    some = _some_of_each_part(part, doubled_areas(mesh.points, mesh.triangles))
    some = some[seen[part[some]]]
    front = np.where(sides.turned, -1.0, 1.0)[:, None] * mesh.face_normals
    behind = _share_behind(mesh, rays, some, front, sides.both)
    alone = ~_has_back(mesh, rays, some, front)
    count = int(part.max()) + 1
    share = np.bincount(part[some], behind * alone, count)
    in_room = share > np.bincount(part[some], minlength=count) / 2
    return replace(sides, faces_room=in_room[part] & ~sides.both)


def sightings(rays: RayScene, normals: Double, cameras: Iterable[Camera]) -> Sightings:
    """Of each face with its unit normal (F, 3)."""
    pixels, frames = np.zeros((2, len(normals), 2), np.int32)
    last = np.full_like(frames, -1)

    def look(camera: Camera) -> tuple[Int, Float, Double]:
        """Faces that a frame shows, the points on them, and where it was taken from."""
        small = camera.at_width(min(camera.width, _MOST_ACROSS))
        face, point = visible_faces(rays, small)
        return face.reshape(-1), point.reshape(-1, 3), small.eye

    for number, (face, point, eye) in enumerate(ahead(look, cameras)):
        _count_sides(number, face, point, normals, eye, pixels, frames, last)
    return Sightings(pixels, frames)


@kernel
def _count_sides(
    number: int,
    face: Int,
    point: Float,
    normals: Double,
    eye: Double,
    pixels: Int,
    frames: Int,
    last: Int,
) -> None:
    """Add to ``pixels`` (F, 2) those (P,) of which each shows the front or the back of a face, at a
    point of it, clearly; and to ``frames`` (F, 2) one where that is the first of the frame of this
    ``number``: ``last`` (F, 2) is the frame before."""
    for p in range(len(face)):
        f = face[p]
        if f < 0:
            continue
        towards, square = 0.0, 0.0
        for c in range(3):
            way = eye[c] - point[p, c]
            towards += way * normals[f, c]
            square += way * way
        if towards * towards > _GRAZING * _GRAZING * square:
            side = 0 if towards > 0 else 1
            pixels[f, side] += 1
            if last[f, side] != number:
                last[f, side] = number
                frames[f, side] += 1


def connected_windings(mesh: ScanMesh) -> tuple[Long, Bool]:
    """Parts of faces that hang together by edges which two faces of one object share.

    Gives the part of each face, (F,) numbered from 0, and whether the face is wound as the part's
    first one is, (F,): a part is wound alike once those that do not agree are turned.
    """
    corners = welded_ids(mesh.points)[mesh.triangles]
    start = corners.reshape(-1)
    one, other = edges_of_two(corners, mesh.face_object)
    root, agrees = _united(one // 3, other // 3, start[one] != start[other], len(corners))
    return np.unique(root, return_inverse=True)[1].reshape(-1), agrees


@kernel
def _united(one: Long, other: Long, alike: Bool, count: int) -> tuple[Long, Bool]:
    """Union-find that knows of each face whether it is wound as its root is."""
    root, as_root = np.arange(count), np.ones(count, np.bool_)
    for k in range(len(one)):
        a, of_a = _root_of(root, as_root, one[k])
        b, of_b = _root_of(root, as_root, other[k])
        if a != b:
            root[b], as_root[b] = a, (of_a == of_b) == alike[k]
    for f in range(count):
        a, agrees = _root_of(root, as_root, f)
        root[f], as_root[f] = a, agrees
    return root, as_root


@kernel
def _root_of(root: Long, as_root: Bool, face: int) -> tuple[int, bool]:
    """A face's root, and whether it is wound alike; the way there is halved for the next."""
    agrees = True
    while root[face] != face:
        up = root[face]
        as_root[face], root[face] = as_root[face] == as_root[up], root[up]
        agrees = agrees == as_root[face]
        face = root[face]
    return face, agrees


def _looking_around(
    mesh: ScanMesh,
    rays: RayScene,
    normals: Double,
    lost: Bool,
    shown: Long,
    part: Long,
    agrees: Bool,
) -> Long:
    """(F,) of the parts that no frame shows (lost, (F,)): which side sees more of what frames show,
    which is of each face its front (shown 1), its back (-1) or neither (0)."""
    unseen = np.flatnonzero(lost)
    area = doubled_areas(mesh.points, mesh.triangles[unseen])
    order = np.lexsort((-area, part[unseen]))
    place = np.arange(len(order)) - np.searchsorted(part[unseen][order], part[unseen][order])
    face = unseen[order[place < _LOOKING]]
    side = np.where(agrees[face], 1.0, -1.0)[:, None] * normals[face]
    balance = np.zeros(len(face))
    for sign in (1.0, -1.0):
        # From the front of a face, then from its back.
        for way, hit in _around(mesh, rays, face, sign * side):
            sees = (hit >= 0) & ((way * normals[hit]).sum(axis=1) * shown[hit] < 0)
            balance += sign * sees
    of_part = np.bincount(part[face], balance, minlength=part.max() + 1)
    # Where that tells nothing either, the winding stays.
    return np.where(of_part[part] == 0, 1, np.where(agrees, 1, -1) * of_part[part]).astype(np.int64)


def _around(
    mesh: ScanMesh, rays: RayScene, faces: Long, side: Double
) -> Iterator[tuple[Double, Int]]:
    """From the middles of ``faces`` (N,) on a ``side`` (N, 3), of unit length, one direction of
    each after the other, (N, 3), and which face lies there, (N,), -1 for none."""
    centre = mesh.points.astype(np.float64)[mesh.triangles[faces]].mean(axis=1).astype(np.float32)
    origin = lift_from_surface(centre, side.astype(np.float32), mesh.diagonal)
    for direction in _even_directions(_DIRECTIONS):
        way = direction * np.where((side @ direction)[:, None] < 0, -1.0, 1.0)
        yield way, rays.closest(origin, np.ascontiguousarray(way, np.float32)).face


def _some_of_each_part(part: Long, area: Double) -> Long:
    """Of each part (F,) at most ``_LOOKING`` faces, evenly by their area."""
    order = np.argsort(part, kind="stable")
    own = part[order]
    size = np.maximum(area[order], 1e-30 * max(float(area.max()), 1e-300))
    total = np.bincount(own, size)
    upto = np.cumsum(size) - np.concatenate([[0.0], np.cumsum(total)])[own]
    step = np.floor(_LOOKING * np.clip(upto / total[own], 0, 1 - 1e-9))
    last = np.flatnonzero(np.diff(own * _LOOKING + step, append=np.inf) > 0)
    return np.asarray(order[last])


def _share_behind(mesh: ScanMesh, rays: RayScene, faces: Long, front: Double, both: Bool) -> Double:
    """(N,) of ``faces``: of what lies around the back of each, what shows its ``front`` (F, 3) or
    has ``both`` (F,)."""
    share = np.zeros(len(faces))
    for way, hit in _around(mesh, rays, faces, -front[faces]):
        shows = ((way * front[hit]).sum(axis=1) < 0) | both[hit]
        share += (hit >= 0) & shows
    return share / _DIRECTIONS


def _has_back(mesh: ScanMesh, rays: RayScene, faces: Long, front: Double) -> Bool:
    """(N,) of ``faces``: where its second skin would lie, or before that, each has another face
    behind it whose ``front`` (F, 3) looks the other way."""
    corner = np.sort(welded_ids(mesh.points)[mesh.triangles], axis=1).astype(np.uint64)
    same = np.unique((corner * _HASH).sum(axis=1), return_inverse=True)[1].reshape(-1)
    together = np.stack([np.bincount(same, way) for way in front.T], axis=-1)
    own = front[faces]
    twin = (together[same[faces]] * own).sum(axis=1) < np.bincount(same)[same[faces]] - 0.5
    centre = mesh.points.astype(np.float64)[mesh.triangles[faces]].mean(axis=1)
    origin = (centre - 2 * _BEHIND * mesh.diagonal * own).astype(np.float32)
    hits = rays.closest(origin, np.ascontiguousarray(own, np.float32))
    other = (hits.face >= 0) & (hits.distance < 2 * _BEHIND * mesh.diagonal)
    return np.asarray(twin | (other & ((front[hits.face] * own).sum(axis=1) < 0)), np.bool_)


def _even_directions(count: int) -> Double:
    """(count, 3) unit vectors spread over the sphere, on a spiral."""
    z = (2 * np.arange(count) + 1) / count - 1
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def turned_towards_cameras(
    mesh: ScanMesh, sides: Sides, has_normals: Bool | None, crease_angle_deg: float
) -> ScanMesh:
    """The mesh with its faces turned and, where the back is a surface of its own, a second skin.

    Shading normals that the file gave (has_normals (F,); None: it gave none) turn along, unless
    they were right before; all others are made anew by the crease angle.
    """
    turned = mesh
    if sides.turned.any():
        triangles, normals = mesh.triangles.copy(), mesh.corner_normals.copy()
        for corners in (triangles, normals):
            corners[sides.turned] = corners[sides.turned][:, [0, 2, 1]]
        made = slice(None) if has_normals is None else ~has_normals
        normals[made] = corner_normals(mesh.points, triangles[made], crease_angle_deg)
        front = face_normals_and_angles(mesh.points, triangles)[0]
        normals[sides.turned & ((normals.sum(axis=1) * front).sum(axis=1) < 0)] *= -1
        turned = replace(mesh, triangles=triangles, corner_normals=normals)
    return _with_second_skin(turned, sides.skins) if sides.skins.any() else turned


def _with_second_skin(mesh: ScanMesh, skins: Bool) -> ScanMesh:
    """The faces ``skins`` (F,) once more, seen from behind and a little behind themselves."""
    corner = mesh.points[mesh.triangles[skins]]
    normal = face_normals_and_angles(mesh.points, mesh.triangles[skins])[0]
    behind = corner - (_BEHIND * mesh.diagonal) * normal[:, None].astype(np.float32)
    number = len(mesh.points) + np.arange(3 * len(corner), dtype=np.int32).reshape(-1, 3)
    return replace(
        mesh,
        points=np.concatenate([mesh.points, behind.reshape(-1, 3).astype(np.float32)]),
        triangles=np.concatenate([mesh.triangles, number[:, [0, 2, 1]]]),
        corner_normals=np.concatenate(
            [mesh.corner_normals, -mesh.corner_normals[skins][:, [0, 2, 1]]]
        ),
        face_object=np.concatenate([mesh.face_object, mesh.face_object[skins]]),
    )
