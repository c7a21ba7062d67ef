"""The scene as the numeric stages see it: one triangle soup in metres, objects as face ranges."""

from __future__ import annotations

from dataclasses import dataclass

from usdbrdf.model.arrays import Float, Int


@dataclass(frozen=True, kw_only=True)
class SceneObject:
    """One object: its mesh prim, its USD identifier (names its textures), its faces in the soup."""

    prim_path: str
    identifier: str
    label: str
    class_name: str
    first_face: int
    num_faces: int

    @property
    def name(self) -> str:
        """What people call it; of one whose label is blank its identifier."""
        return self.label.strip() or self.identifier

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
