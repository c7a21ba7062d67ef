"""The scene as the numeric stages see it: one triangle soup in metres, objects as face ranges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from usdbrdf.model.arrays import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class SceneObject:
    """One object: its mesh prim, its USD identifier (names its textures), its faces in the soup.

    far  it is no object but what lies around the scan: a dome that only shines
    """

    prim_path: str
    identifier: str
    label: str
    class_name: str
    first_face: int
    num_faces: int
    far: bool = False

    @property
    def faces(self) -> slice:
        return slice(self.first_face, self.first_face + self.num_faces)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """points (V, 3) float32, metres, world frame; triangles (F, 3) int32; corner_normals (F, 3, 3)
    float32, unit; face_object (F,) int32; corner_uv (F, 3, 2) float32 in [0, 1], v up as in USD,
    or None before texturing. Faces of one object are consecutive."""

    objects: tuple[SceneObject, ...]
    points: Float
    triangles: Int
    corner_normals: Float
    face_object: Int
    corner_uv: Float | None = None

    @property
    def is_far(self) -> Bool:
        """(num_objects,): see ``SceneObject.far``."""
        return np.array([obj.far for obj in self.objects], np.bool_)

    @property
    def diagonal_m(self) -> float:
        """Of the box around all that is not far, metres."""
        if not self.is_far.any():
            return float(np.linalg.norm(np.ptp(self.points, axis=0)))
        near = self.points[self.triangles[~self.is_far[self.face_object]]]
        return float(np.linalg.norm(np.ptp(near.reshape(-1, 3), axis=0)))
