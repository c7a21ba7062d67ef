"""Which texels of one asset are which of another, where both textured the same objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Bool, Float, Int
from usdbrdf.model.scene import Scene, SceneObject
from usdbrdf.model.texels import Texels
from usdbrdf.transport.surface_texture import surface_texture

# Points of two assets this close are the same, as a share of the scene's size.
_SAME_POINT = 1e-5

# On meshes that differ, a texel may be this many texels away.
_REACH = 2.0


@dataclass(frozen=True, kw_only=True)
class Correspondence:
    """For each texel (T,) of one asset: the texel of the other there (-1: none); and where the
    triangles agree but the atlases do not, the other's face with barycentric u, v, else -1.

    missing  identifiers of the objects that the other asset does not have
    """

    other: Texels
    other_face_object: Int
    texel: Int
    face: Int
    u: Float
    v: Float
    missing: tuple[str, ...]

    def known(self) -> Bool:
        """(T,) bool: the other asset has something there."""
        return np.asarray(self.texel >= 0, np.bool_)

    def nearest(self, values: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
        """The other asset's values (T', ...) in its nearest texel; the first's where unknown."""
        return values[np.maximum(self.texel, 0)]

    def interpolated(self, values: Float) -> Float:
        """The other asset's values (T', 3), bilinear where its atlas differs; 0 where unknown."""
        found = np.where(self.known()[:, None], values[np.maximum(self.texel, 0)], 0)
        between = self.face >= 0
        if between.any():
            texture = surface_texture(self.other, self.other_face_object, values)
            found[between] = texture.at(self.face[between], self.u[between], self.v[between])
        return np.asarray(found, np.float32)


def correspondence(
    scene: Scene, texels: Texels, other_scene: Scene, other: Texels
) -> Correspondence:
    """Find the texels of ``other`` at those of ``texels``; objects go by identifier, then label.

    Triangle by triangle where an object has the same ones in both, else by the nearest texel of the
    same object within two texels. InputRefused where the assets share no object or no surface.
    """
    count = len(texels)
    texel, face = (np.full(count, -1, np.int32) for _ in range(2))
    missing = []
    for i, obj in enumerate(scene.objects):
        own = texels.of_object(i)
        j = _same_object(obj, other_scene.objects)
        if j is None:
            missing.append(obj.identifier)
        elif not _same_triangles(scene, i, other_scene, j):
            texel[own] = _nearby(texels, i, other, j)
        elif _same_atlas(scene, texels, i, other_scene, other, j):
            texel[own] = np.arange(*other.of_object(j).indices(len(other)), dtype=np.int32)
        else:
            first = scene.objects[i].first_face
            face[own] = texels.face[own] - first + other_scene.objects[j].first_face
            texel[own] = _texel_at(other, j, face[own], texels.barycentric[own])
    if len(missing) == len(scene.objects):
        raise InputRefused(
            f"the assets share no object: one has {_some(scene)}, the other {_some(other_scene)}. "
            "Compare two assets of one scene. [compare.objects]"
        )
    if not (texel >= 0).any():
        raise InputRefused(
            "the assets' objects share names but no surface: nowhere are their texels closer than "
            "two texels. Compare two assets of one scene in one frame. [compare.surface]"
        )
    return Correspondence(
        other=other,
        other_face_object=other_scene.face_object,
        texel=texel,
        face=face,
        u=np.ascontiguousarray(texels.barycentric[:, 1]),
        v=np.ascontiguousarray(texels.barycentric[:, 2]),
        missing=tuple(missing),
    )


def _same_object(obj: SceneObject, others: tuple[SceneObject, ...]) -> int | None:
    for key in ("identifier", "label"):
        names = [getattr(other, key) for other in others]
        if names.count(getattr(obj, key)) == 1:
            return names.index(getattr(obj, key))
    return None


def _same_triangles(scene: Scene, i: int, other: Scene, j: int) -> bool:
    ours = scene.points[scene.triangles[scene.objects[i].faces]]
    theirs = other.points[other.triangles[other.objects[j].faces]]
    limit = _SAME_POINT * float(np.linalg.norm(np.ptp(scene.points, axis=0)))
    return ours.shape == theirs.shape and bool(np.abs(ours - theirs).max() <= limit)


def _same_atlas(
    scene: Scene, texels: Texels, i: int, other_scene: Scene, other: Texels, j: int
) -> bool:
    def table(scene: Scene, texels: Texels, k: int) -> tuple[npt.NDArray[np.int64], Float]:
        own = texels.of_object(k)
        pixel = texels.pixel[own] - texels.first_pixel[k]
        face = texels.face[own] - scene.objects[k].first_face
        return np.stack([pixel, face]), texels.barycentric[own]

    (ours, weights), (theirs, other_weights) = table(scene, texels, i), table(other_scene, other, j)
    return np.array_equal(ours, theirs) and np.allclose(weights, other_weights, atol=1e-3)


def _texel_at(texels: Texels, index: int, face: Int, barycentric: Float) -> Int:
    """The texel nearest to points of object ``index``, given by face and barycentric (R, 3)."""
    width, height = texels.resolution[index]
    place = np.einsum("rc,rcd->rd", barycentric, texels.corner_pixel[face]).astype(np.int64)
    x, y = np.clip(place[:, 0], 0, width - 1), np.clip(place[:, 1], 0, height - 1)
    found: Int = texels.nearest_texel[texels.first_pixel[index] + y * width + x]
    return found


def _nearby(texels: Texels, i: int, other: Texels, j: int) -> Int:
    own, theirs = texels.of_object(i), other.of_object(j)
    if own.stop == own.start or theirs.stop == theirs.start:
        return np.full(own.stop - own.start, -1, np.int32)
    side = np.sqrt(max(float(np.median(t.area[s])) for t, s in ((texels, own), (other, theirs))))
    distance, nearest = cKDTree(other.position[theirs]).query(texels.position[own])
    return np.where(distance <= _REACH * side, theirs.start + nearest, -1).astype(np.int32)


def _some(scene: Scene) -> str:
    names = [obj.identifier for obj in scene.objects]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
