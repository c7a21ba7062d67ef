"""What a capture is: the frozen values that the adapters hand to the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usdbrdf.model.arrays import Bool, Double, Int
from usdbrdf.model.camera import Camera
from usdbrdf.model.lens import Lens
from usdbrdf.model.mesh import ObjectLabel, ScanMesh


class Recorded(NamedTuple):
    """How the image of a frame holds what was seen; as the fields of ``Frames`` by these names."""

    encoding: str
    radiometric: bool
    photograph_encoding: str


@dataclass(frozen=True, kw_only=True)
class Frames:
    """N photographs with pinhole cameras, all of scene-linear radiance once read.

    image_paths           N absolute paths
    world_from_camera     (N, 4, 4) float64, rigid, scene units; OpenGL axes (x right, y up, looks
                          down -z)
    intrinsics            (N, 4) float64: fx, fy, cx, cy in pixels; the first pixel's centre is
                          (0.5, 0.5)
    resolution            (N, 2) int32: width, height; 0 where only the pixels are asked for
    exposure_time         (N,) float64, seconds (1 where unknown)
    saturation_radiance   (N,) float64: a channel >= 0.998 of it is clipped
    noise_floor_radiance  (N,) float64: a channel below it is noise
    encoding              colour space of the stored images, in OpenColorIO's names
    radiometric           False where the images are low dynamic range photographs
    photographs           what the images were resampled from, N absolute paths, None where an image
                          is the photograph itself; () where all are
    masks                 whose black pixels these images do not have, in the same way
    lenses                the lenses of these photographs in words, "" where there is none
    photograph_encoding   colour space of these photographs, "" where there are none
    vignetting            k1, k2: the lens passes exp(k1 rho^2 + k2 rho^4) of the light, rho in half
                          diagonals of the image from the principal point; it is to be divided out
    gain                  (N,) float64 or None: what the pixels of radiometric images are too bright
                          by, to be divided out; the limits above are those of what is left
    captured_pose         (N, 4, 4) float64 or None: world_from_camera before it was refined
    lightings             the lightings of the scene that the frames show, N names, those of one
                          after each other; () where there is but one
    recorded              how each of N images holds what was seen, where lightings differ in that;
                          encoding and photograph_encoding are then those of the first image, and
                          radiometric is False where any is not. () where all are alike
    """

    image_paths: tuple[Path, ...]
    world_from_camera: Double
    intrinsics: Double
    resolution: Int
    exposure_time: Double
    saturation_radiance: Double
    noise_floor_radiance: Double
    encoding: str = "lin_rec709_scene"
    radiometric: bool = True
    photographs: tuple[Path | None, ...] = ()
    masks: tuple[Path | None, ...] = ()
    lenses: tuple[str, ...] = ()
    photograph_encoding: str = ""
    gain: Double | None = None
    captured_pose: Double | None = None
    vignetting: tuple[float, float] = (0.0, 0.0)
    lightings: tuple[str, ...] = ()
    recorded: tuple[Recorded, ...] = ()

    def __len__(self) -> int:
        return len(self.image_paths)

    def recorded_in(self) -> list[Path]:
        """The photographs and masks that all frames come from, each once."""
        of_frames = self.recorded_by()
        masks = (mask for _, *some in of_frames for mask in some)
        return list(dict.fromkeys([*(photograph for photograph, *_ in of_frames), *masks]))

    def recorded_by(self) -> list[tuple[Path, ...]]:
        """The photograph that each frame comes from, and its mask, where it has one."""
        nothing = (None,) * len(self)
        columns = self.image_paths, self.photographs or nothing, self.masks or nothing
        return [
            (photograph or image, *filter(None, [mask]))
            for image, photograph, mask in zip(*columns, strict=True)
        ]

    def as_recorded(self) -> Frames:
        """With the photographs for images, of which the cameras are not: for their pixels alone."""
        given = self.photographs or (None,) * len(self)
        images = tuple(p or image for p, image in zip(given, self.image_paths, strict=True))
        unasked = np.zeros_like(self.resolution) if self.photographs else self.resolution
        return replace(self, image_paths=images, resolution=unasked)

    def images_alone(self) -> Frames:
        """Without what they were resampled from."""
        return replace(self, photographs=(), masks=())

    def at(self, indices: Sequence[int]) -> Frames:
        """The frames with these indices, in this order."""
        rows = np.asarray(indices, np.int64)
        columns: dict[str, Any] = {
            k: v[rows] for k, v in vars(self).items() if isinstance(v, np.ndarray)
        }
        for name in ("image_paths", "photographs", "masks", "lenses", "lightings"):
            found = getattr(self, name)
            columns[name] = tuple(found[i] for i in rows) if found else ()
        if self.recorded:
            columns |= recorded_together([self.recorded[i] for i in rows])
        return replace(self, **columns)

    def encoding_of(self, i: int) -> str:
        """Colour space of the image of frame i."""
        return self.recorded[i].encoding if self.recorded else self.encoding

    def recorded_each(self) -> tuple[Recorded, ...]:
        """How each of the images holds what was seen."""
        alike = Recorded(self.encoding, self.radiometric, self.photograph_encoding)
        return self.recorded or (alike,) * len(self)

    def of_lighting(self, name: str) -> range:
        """The numbers of the frames that show one lighting; of all where there is but one, or
        none is named."""
        if not (self.lightings and name):
            return range(len(self))
        first = self.lightings.index(name)
        return range(first, first + self.lightings.count(name))

    def camera(self, i: int) -> Camera:
        """The camera of frame i, named after its image."""
        width, height = self.resolution[i].tolist()
        return Camera(
            world_from_camera=self.world_from_camera[i],
            intrinsics=tuple(self.intrinsics[i].tolist()),
            width=width,
            height=height,
            name=self.image_paths[i].name,
        )


def recorded_together(images: Sequence[Recorded]) -> dict[str, Any]:
    """What ``Frames`` say of N images that are held as these are."""
    if not images:
        return {"recorded": ()}
    together = images[0]._replace(radiometric=all(image.radiometric for image in images))
    alike = len(set(images)) == 1
    return {**together._asdict(), "recorded": () if alike else tuple(images)}


@dataclass(frozen=True, kw_only=True)
class View:
    """How a frame is to be resampled out of a photograph.

    photograph, mask        absolute; black pixels of the mask, which may be None, are not used
    lens, intrinsics        of the photograph
    photograph_from_frame   (3, 3) rotation of directions between the cameras' axes
    face                    which part of the photograph it shows, "" for all of it
    rim                     what is black along the photograph's border is no part of it
    """

    photograph: Path
    mask: Path | None
    lens: Lens
    intrinsics: tuple[float, float, float, float]
    photograph_from_frame: Double
    face: str = ""
    rim: bool = False


@dataclass(frozen=True, kw_only=True)
class Scan:
    """A capture, checked: what ``ingest`` writes into the stage.

    meters_per_unit, up_axis describe the scene units of mesh and poses; usd_geometry and
    object_prims are ``ScanGeometry``'s.
    up_axis        "Y" or "Z"; as adapters read it, any of ``options.UpAxis``: see ``model.upright``
    capture_up     the axis of the capture that was up, where it was turned for USD's sake; "" where
                   mesh and poses are in the capture's own coordinates
    views          how frames come of photographs, None where the image is the photograph itself; ()
                   where all are. The image paths of views are relative to the folder that they are
                   yet to be written into (``capture.develop``)
    turned_faces   (F,) bool: the mesh's faces that the file has wound away from the cameras; in
                   ``mesh`` they are turned
    label_source   who divided it into objects, see ``ScanGeometry``
    turned_images  images that EXIF data turn (2 to 8: how), as far as sizes do not tell whether the
                   poses are those of the pixels as stored
    has_normals    (F,) bool: faces whose normals are the file's; None: of none
    warnings       sentences that were printed, kept for the record
    counts         numbers of the checks (degenerate faces removed, frames dropped, ...)
    """

    name: str
    adapter: str
    source: Path
    mesh: ScanMesh
    objects: tuple[ObjectLabel, ...]
    frames: Frames
    meters_per_unit: float = 1.0
    up_axis: str = "Z"
    capture_up: str = ""
    usd_geometry: Path | None = None
    object_prims: tuple[str, ...] = ()
    views: tuple[View | None, ...] = ()
    turned_faces: Bool | None = None
    label_source: str = "capture"
    has_normals: Bool | None = None
    turned_images: Mapping[Path, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    counts: dict[str, int] = field(default_factory=dict)
