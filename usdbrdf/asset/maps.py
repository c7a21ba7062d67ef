"""The maps of an asset: opened once, each read when it is first asked for; their writer; and
pictures for people: a map on the surface, as one of the capture's cameras would see it."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Ar, Usd, UsdGeom

from usdbrdf import calibration
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.properties import Aov
from usdbrdf.asset.readers.scene import (
    aov_path,
    frames_from_stage,
    hashes_of_photographs,
    light_from_outside,
    lighting_of_stage,
    read_shading,
    scene_from_stage,
)
from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import DATA, WORKING_SPACE, display_exposure, to_display_srgb8
from usdbrdf.files.images import image_size, needs_float, read_exr, write_exr, write_preview_png
from usdbrdf.geometry.texels import texels_from_atlas
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Bool, Double, Float
from usdbrdf.model.capture import Frames
from usdbrdf.model.scene import Scene, SceneObject
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.options import ESTIMATE, Surroundings
from usdbrdf.transport.environment import (
    NO_SUN,
    Environment,
    Sun,
    black_environment,
    environment_from_file,
)
from usdbrdf.transport.lit_scene import LitScene, TexturedScene, lit_scene
from usdbrdf.transport.rays import Hits, RayScene
from usdbrdf.transport.surface_texture import surface_texture

# Pictures decoded or written at a time.
_AT_A_TIME = min(4, os.cpu_count() or 1)
_MAX_WIDTH = 640
# The camera is chosen among this many frames, by about this many rays through each.
_CANDIDATES, _RAYS = 64, 2000
# A texel's views are told to differ by no fewer frames.
_FRAMES_THAT_DIFFER = 3
# Relative errors: of light of which only a bound is known, and of what surfaces send out that no
# frame shows.
_OF_BOUND, _OF_HIDDEN = 1.0, calibration.number("hidden.error")


@dataclass(frozen=True, kw_only=True)
class Overview:
    """What one camera sees first: the surface behind each pixel of a (height, width) picture."""

    scene: Scene
    hits: Hits
    height: int
    width: int

    def write(
        self, path: Path, texels: Texels, values: Float, exposure: float | None = None
    ) -> None:
        """Per-texel values (T, 3) as an 8-bit sRGB PNG; exposure None: chosen by the picture."""
        texture = surface_texture(texels, self.scene.face_object, values)
        shown = texture.at(self.hits.face, self.hits.u, self.hits.v)
        if exposure is None:
            exposure = display_exposure(shown[self.hits.face >= 0].mean(axis=1))
        picture = shown.reshape(self.height, self.width, 3)
        write_preview_png(path, to_display_srgb8(picture, exposure_scale=exposure))


def overview(scene: Scene, rays: RayScene, frames: Frames) -> Overview:
    """The view of the frame that sees the most objects, at most 640 pixels wide."""
    chosen = overview_frame(scene, rays, frames)
    width, height = _reduced(frames, chosen, _MAX_WIDTH / int(frames.resolution[chosen, 0]))
    hits = camera_hits(rays, frames, chosen, width, height)
    return Overview(scene=scene, hits=hits, width=width, height=height)


def overview_frame(scene: Scene, rays: RayScene, frames: Frames) -> int:
    """The frame with the most objects in view, the first of equals."""
    count = min(len(frames), _CANDIDATES)
    candidates = np.linspace(0, len(frames) - 1, count).round().astype(int).tolist()

    def objects_in_view(i: int) -> int:
        scale = float(np.sqrt(_RAYS / math.prod(frames.resolution[i].tolist())))
        hits = camera_hits(rays, frames, i, *_reduced(frames, i, scale))
        return len(np.unique(scene.face_object[hits.face[hits.face >= 0]]))

    return int(max(candidates, key=objects_in_view))


def _reduced(frames: Frames, i: int, scale: float) -> tuple[int, int]:
    """Width and height of a frame times ``scale``, which enlarges nothing."""
    width, height = (max(1, round(min(1.0, scale) * n)) for n in frames.resolution[i].tolist())
    return width, height


def camera_hits(rays: RayScene, frames: Frames, i: int, width: int, height: int) -> Hits:
    """First surfaces behind the frame's pixels, were it ``width`` x ``height`` pixels."""
    camera = frames.camera(i).at_size(width, height)
    return rays.closest(*camera.rays(camera.pixels()))


class AssetMaps:
    """The scene of a composed stage, its photographs, and what tasks measured of its texels. Each
    is read when it is first asked for, and every map is decoded at most once; the arrays are
    shared, so nobody writes to them. What is (T,) or (T, C) is per texel, float32, linear
    Rec.709."""

    def __init__(self, stage: Usd.Stage) -> None:
        self.stage = stage
        self._read: dict[str, Float] = {}

    def layers_elsewhere(self, folder: Path) -> list[Path]:
        """Files of layers that are not in the asset's ``folder``: captured USD geometry."""
        # What lies in a package has the package's path, followed by its own in brackets.
        files = {
            Path(Ar.SplitPackageRelativePathOuter(layer.realPath)[0])
            for layer in self.stage.GetUsedLayers()
            if not layer.anonymous
        }
        ours = (folder / "layers").resolve()
        return sorted(file for file in files if file.resolve().parent != ours)

    @cached_property
    def frames(self) -> Frames:
        """The photographs, poses in metres, of the lighting that the stage is in."""
        return self.all_frames.at(self.own_frames)

    @cached_property
    def all_frames(self) -> Frames:
        """Those of all lightings."""
        return frames_from_stage(self.stage)

    @cached_property
    def hashes_of_frames(self) -> list[str]:
        """What ``hashes_of_photographs`` tells of the photographs of ``frames``."""
        found = hashes_of_photographs(self.stage)
        return [found[i] for i in self.own_frames]

    @property
    def lighting(self) -> str:
        """The lighting that the stage is in; "" where there is but one."""
        return lighting_of_stage(self.stage)

    @property
    def own_frames(self) -> range:
        """The numbers of ``frames`` among those of all lightings."""
        return self.all_frames.of_lighting(self.lighting)

    @cached_property
    def scene(self) -> Scene:
        """The labelled meshes as one triangle soup, in metres."""
        return scene_from_stage(self.stage)

    @cached_property
    def texels(self) -> Texels:
        """Where the texels lie; InputRefused before the texturing task has run."""
        if self.scene.corner_uv is None:
            raise InputRefused(
                "the stage has no texture coordinates of ours. Run `usdbrdf texture` first. "
                "[asset.incomplete]"
            )
        sizes = [image_size(self._file(obj, "coverage"))[:2] for obj in self.scene.objects]
        return texels_from_atlas(self.scene, np.array(sizes, np.int32))

    @cached_property
    def surface(self) -> TexturedScene:
        """Scene and texels as light transport takes them."""
        rays = RayScene(self.scene.points, self.scene.triangles)
        return TexturedScene(self.scene, self.texels, rays, self._panes)

    @property
    def _panes(self) -> tuple[int, ...]:
        """The numbers of the objects that shading found to let light through."""
        found = (read_shading(self.stage, obj.prim_path) for obj in self.scene.objects)
        return tuple(i for i, one in enumerate(found) if one and one.lets_through)

    @cached_property
    def coverage(self) -> CoverageMap:
        """What the frames know of each texel."""
        return CoverageMap.from_stored(self._decoded("coverage"))

    def is_observed(self, index: int) -> bool:
        """Whether a frame shows any texel of an object."""
        return bool(self.coverage.observed[self.texels.of_object(index)].any())

    @property
    def lit(self) -> Float:
        """(T, 3) W/(m^2 sr): L_d as the texturing task has it; where lamps clip, a lower bound."""
        return self.map("lit")

    @property
    def samples(self) -> Float:
        """(T,): how many frames measured each texel."""
        return self.map("samples")[:, 0]

    @cached_property
    def differing(self) -> Double:
        """(num_objects,): how far the radiances differ that frames show of one texel, their
        interquartile range next to L_d, in the middle of an object's texels of which it can be
        told; NaN where there are none."""
        found = np.full(len(self.scene.objects), np.nan)
        for i, obj in enumerate(self.scene.objects):
            own = self.texels.of_object(i)
            spread = self.texels.from_image(i, read_exr(self._file(obj, "spread"))).mean(axis=1)
            lit, often = self.lit[own].mean(axis=1), self.samples[own] >= _FRAMES_THAT_DIFFER
            # Where nothing could be told of it, a spread of 0 is stored.
            told = often & (lit > 0) & (spread > 0)
            if told.any():
                found[i] = np.median(spread[told] / lit[told])
        return found

    @property
    def irradiance(self) -> Float:
        """(T, 3) W/m^2: S as it is used."""
        return self.map("irradiance")

    @property
    def traced_irradiance(self) -> Float:
        """(T, 3) W/m^2: S before the lightmap filter, of assets whose shading used one."""
        return self.map("irradiance_raw")

    @property
    def irradiance_error(self) -> Float:
        """(T,): standard deviation of S as it was traced, relative to it."""
        level = np.maximum(self.irradiance.mean(axis=1), 1e-30)
        error: Float = np.sqrt((self.map("stderr") ** 2).mean(axis=1)) / level
        return error

    @cached_property
    def emission(self) -> Float:
        """(T, 3) W/(m^2 sr): the radiance with which lamps shine, zero on all else."""
        return self.map_where_present("emission", 3)

    @cached_property
    def emissive(self) -> Bool:
        """(T,): the texel shines by itself."""
        return np.asarray((self.emission > 0).any(axis=1), np.bool_)

    @property
    def hidden(self) -> Bool:
        """(T,): no frame measures the texel, and it does not shine."""
        return ~(self.coverage.measured | self.emissive)

    @property
    def light(self) -> Float:
        """(T, 3) W/(m^2 sr): what the surface sends out: L_d, and what shading found of lamps (of
        what clipped in every frame L_d is only a lower bound) and of what no frame measures."""
        light = np.where(self.emissive[:, None], self.emission, self.lit)
        if self.has("hidden"):
            hidden = np.flatnonzero(self.hidden)
            found = self.map_where_present("hidden", 3)[hidden]
            # Older assets have nothing in it of what clips.
            told = found.any(axis=1) | ~self.coverage.clipped[hidden]
            light[hidden[told]] = found[told]
        return light

    def environment(self, asked: Surroundings) -> Environment:
        """The light from outside: a file's, none, or what the shading task found or was given."""
        up_axis = str(UsdGeom.GetStageUpAxis(self.stage))
        if isinstance(asked, Path):
            return environment_from_file(asked, up_axis)
        found = light_from_outside(self.stage) if asked == ESTIMATE else None
        if found is None:
            return black_environment()
        record, picture = found
        if not picture.is_file():
            raise InputRefused(
                f"{picture}: the picture of the surroundings is missing. Run `usdbrdf shade` "
                "again. [asset.incomplete]"
            )
        direction, irradiance = np.array(record.sun_direction), np.array(record.sun_irradiance)
        sun = Sun(direction, irradiance, record.sun_half_angle) if irradiance.any() else NO_SUN
        return Environment(read_exr(picture), up_axis == "Z").under(sun)

    def lit_scene(self, environment: Environment) -> LitScene:
        """All that light transport needs, with ``light`` as the light."""
        return lit_scene(self.surface, self.light, self.emissive, environment)

    @cached_property
    def doubts_of_light(self) -> dict[str, float]:
        """Relative standard errors of the light that was inferred, not seen: of lamps that clip in
        every frame or that none shows, by prim path, and of "sky" and "sun"."""
        found = {}
        for obj in self.scene.objects:
            shading = read_shading(self.stage, obj.prim_path)
            if shading and shading.emitter and shading.radiance_status != "measured":
                known = shading.radiance_status == "estimated"
                found[obj.prim_path] = shading.radiance_error if known else _OF_BOUND
        if (outside := light_from_outside(self.stage)) is not None:
            found |= {"sky": outside[0].sky_error, "sun": outside[0].sun_error}
        return {name: error for name, error in found.items() if error > 0}

    def light_in_doubt(self, asked: Surroundings) -> LitScene | None:
        """The scene in nothing but the standard errors of its light: of lamps and surroundings that
        were inferred, and of what surfaces send out that no frame measures; None where all of that
        was seen. What a file says of the surroundings is not doubted."""
        doubts = self.doubts_of_light
        of_object = [doubts.get(obj.prim_path, 0.0) for obj in self.scene.objects]
        error = np.array(of_object, np.float32)[self.texels.object_index()]
        inferred = self.emissive & ~self.coverage.measured & (error > 0)
        light = np.where(inferred[:, None], error[:, None] * self.emission, np.float32(0))
        # What clips and reflects no more than it shows is as bright as that.
        sent = self.light
        as_shown = self.coverage.clipped & (sent.max(axis=1) <= 1.001 * self.lit.max(axis=1))
        guessed = self.hidden & ~as_shown
        light[guessed] = _OF_HIDDEN * sent[guessed]
        outside = self._doubts_of_outside() if asked == ESTIMATE else black_environment()
        if not (light.any() or outside.image.any() or outside.sun.shines):
            return None
        return lit_scene(self.surface, light, inferred, outside)

    def _doubts_of_outside(self) -> Environment:
        found, doubts = light_from_outside(self.stage), self.doubts_of_light
        if found is None or not doubts.keys() & {"sky", "sun"}:
            return black_environment()
        record, picture = found
        environment = self.environment(ESTIMATE)
        known = read_exr(picture.with_name(Path(record.confidence).name))[..., :1] > 0
        sky = np.where(known, np.float32(0), np.float32(doubts.get("sky", 0)) * environment.image)
        sun = environment.sun._replace(irradiance=doubts.get("sun", 0) * environment.sun.irradiance)
        return Environment(sky, environment.z_up).under(sun)

    def has(self, aov: str) -> bool:
        """Whether any object has the map."""
        return any(aov_path(self.stage, obj.prim_path, aov) for obj in self.scene.objects)

    def first_of(self, *aovs: str) -> str:
        """The name of the first of these maps that any object has, else of the last."""
        return next((aov for aov in aovs if self.has(aov)), aovs[-1])

    def map(self, aov: str) -> Float:
        """(T, C): a map that every object has; InputRefused where one has not."""
        if aov not in self._read:
            self._read[aov] = self._decoded(aov)
        return self._read[aov]

    def map_where_present(self, aov: str, channels: int) -> Float:
        """(T, channels): zeros on objects that do not have the map."""
        if aov in self._read:
            return self._read[aov]
        values = np.zeros((len(self.texels), channels), np.float32)
        for i, obj in enumerate(self.scene.objects):
            if aov_path(self.stage, obj.prim_path, aov) is not None:
                picture = read_exr(self._file(obj, aov))
                values[self.texels.of_object(i)] = self.texels.from_image(i, picture)
        self._read[aov] = values
        return values

    def _decoded(self, aov: str) -> Float:
        files = [self._file(obj, aov) for obj in self.scene.objects]
        with ThreadPoolExecutor(_AT_A_TIME) as pool:
            pictures = enumerate(pool.map(read_exr, files))
            return np.concatenate([self.texels.from_image(i, image) for i, image in pictures])

    def _file(self, obj: SceneObject, aov: str) -> Path:
        path = aov_path(self.stage, obj.prim_path, aov)
        if path is None or not path.is_file():
            raise InputRefused(
                f"<{obj.prim_path}>: its map {aov!r} is missing ({path}). Run the task that makes "
                "it again. [asset.incomplete]"
            )
        return path


class TexelMap(NamedTuple):
    """values (T, ...) of all objects' texels; scale and unit as in ``Aov``. What is no colour must
    not be converted as one: its files say so."""

    values: Float
    scale: float
    unit: str
    colour: bool = True


@dataclass(frozen=True)
class MapWriter:
    """Writes the maps of a task: as half floats, or as floats where those would lose too much."""

    run: TaskRun
    asset: Asset
    scene: Scene
    texels: Texels

    def write(self, index: int, maps: dict[str, TexelMap]) -> tuple[Aov, ...]:
        """One object's pictures."""
        identifier = self.scene.objects[index].identifier
        files = [self.asset.texture(identifier, name) for name in maps]
        places = [self.run.output(file) for file in files]

        def write(place: Path, chosen: TexelMap) -> None:
            picture = self.texels.image(index, chosen.values)
            space = WORKING_SPACE if chosen.colour else DATA
            write_exr(place, picture, half=not needs_float(picture), encoding=space)

        # Compressing takes a core each, and flushing to the disk time.
        with ThreadPoolExecutor(_AT_A_TIME) as pool:
            list(pool.map(write, places, maps.values()))
        return tuple(
            Aov(name=name, file=file, scale=chosen.scale, unit=chosen.unit)
            for file, (name, chosen) in zip(files, maps.items(), strict=True)
        )
