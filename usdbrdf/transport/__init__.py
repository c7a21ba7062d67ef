"""Light transport: rays through the scene, light that arrives at points, light that lobes send on.

Its face, which is all that the rest of the package calls:

    rays             Embree: RayScene.closest: first surfaces along rays; lift_from_surface
    lit_scene        TexturedScene: the geometry to trace with its charts, which makes textures and
                     lights; LitScene, with its light; visible_points under a camera's pixels
    surface_texture  radiance on the surface, bilinear; environment: radiance from outside
    lights           lights_from_radiance: surface that rays are sent to on purpose
    irradiance       irradiance_at points, in tiles of texels
    lobe_radiance    lobe_radiance of known lobes, lobe_basis for roughnesses that are tried, and
                     specular_irradiance that they bring to other surfaces
    let_through      what comes through a dielectric's surface, either way
    renderer_match   what to write for renderers with another lobe
    sunlight         what the sun brings to texels
    brdf             the lobe's equations
    denoise          the filters of light maps and pictures, and which of them is at hand
    warps            shifts_of: uniform numbers of numbered things

Behind it are random numbers (tile_draws), the estimators' loops (sampling_loops), quadratures
(directional_albedo), and where light comes in from outside (openings).
"""
