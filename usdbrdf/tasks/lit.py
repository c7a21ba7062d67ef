"""The scene with its light, as the steps after shading see it."""

from __future__ import annotations

import numpy as np

from usdbrdf.tasks.atlas import Atlas
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.lights import lights_from_radiance
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.rays import RayScene
from usdbrdf.transport.surface_texture import surface_texture

# Lobes pick among all lights alike, by power: each of the few rays is to meet one that shows.
_BRIGHTER_THAN = 6.0


def lit_scene(atlas: Atlas, environment: Environment) -> LitScene:
    """L_d as texture and as lights; where shading found an emitter, the radiance it found there
    (of lamps that clipped in every frame L_d is only a lower bound)."""
    scene, texels = atlas.scene, atlas.texels
    emission = atlas.map_where_present("emission", 3)
    emissive = (emission > 0).any(axis=1, keepdims=True)
    lit = np.where(emissive, emission, atlas.map("lit"))
    radiance = surface_texture(texels, scene.face_object, lit)
    return LitScene(
        scene=scene,
        rays=RayScene(scene.points, scene.triangles),
        radiance=radiance,
        lights=lights_from_radiance(scene, texels, lit, _BRIGHTER_THAN),
        emission=radiance.showing(
            texels, np.broadcast_to(emissive.astype(np.float32), (len(texels), 3))
        ),
        environment=environment,
        diagonal_m=float(np.linalg.norm(np.ptp(scene.points, axis=0))),
    )
