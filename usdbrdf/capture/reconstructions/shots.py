"""What the documents of programs that reconstruct photographs have in common: each photograph has a
camera and a pose by numbers, pictures lie in some folder, and a mesh that was exported beside."""

from __future__ import annotations

import os
from collections.abc import Callable, Container, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from usdbrdf.capture.checks import Findings, FrameRecord, clause_of
from usdbrdf.capture.conventions import opengl_from_opencv
from usdbrdf.capture.formats.named_pictures import (
    drop_without_picture,
    pictures_of,
    refuse_without_pictures,
    scan_of,
    warn_of_radiance,
    warn_of_unused,
)
from usdbrdf.capture.mesh_frames import mesh_beside, path_in_capture
from usdbrdf.capture.parts import geometry_from_file
from usdbrdf.capture.up_axis import up_axis_assumed
from usdbrdf.errors import ImageRefused, InputRefused, MeshMissing
from usdbrdf.files.images import image_size
from usdbrdf.files.tables import numbers_among
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import PINHOLE, Lens
from usdbrdf.model.mesh import ScanGeometry
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.mesh_files import mesh_of_tiles


@dataclass(frozen=True, kw_only=True)
class ShotCamera:
    """Of what size its photographs are, fx, fy, cx, cy in their pixels, and how it bends light."""

    resolution: tuple[int, int]
    intrinsics: tuple[float, float, float, float]
    lens: Lens = PINHOLE


@dataclass(frozen=True, kw_only=True)
class CentredCamera:
    """A camera whose document says no size of its photographs, as its focal length is in their
    pixels and its principal point in their middle."""

    focal: float
    lens: Lens = PINHOLE

    def of_size(self, width: int, height: int) -> ShotCamera:
        return ShotCamera(
            resolution=(width, height),
            intrinsics=(self.focal, self.focal, width / 2, height / 2),
            lens=self.lens,
        )


# A principal point this far from the middle, in parts of a side, is that of another picture, or of
# one that was turned: those of telephones and of sensors lie within some hundredths.
_OFF_CENTRE = 0.1


@dataclass(frozen=True, kw_only=True)
class UnsizedCamera:
    """A camera whose document says no size of its pictures: they are those that it was made for.

    intrinsics   as in ``ShotCamera``
    from_bottom  whether the principal point is counted from the lower edge, y up
    """

    intrinsics: tuple[float, float, float, float]
    from_bottom: bool = False
    lens: Lens = PINHOLE

    def of_size(self, width: int, height: int) -> ShotCamera:
        """ImageRefused for a picture that is plainly none of these."""
        fx, fy, cx, cy = self.intrinsics
        cy = height - cy if self.from_bottom else cy
        if max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > _OFF_CENTRE:
            raise ImageRefused(
                f"it is {width} x {height} pixels, but its lens has its axis at {cx:.0f}, "
                f"{cy:.0f}, as of another size, or of pictures that were cut or turned. "
                "[capture.size]"
            )
        return ShotCamera(resolution=(width, height), intrinsics=(fx, fy, cx, cy), lens=self.lens)


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One photograph of a document.

    name               by which its picture is found, a path or its end
    mask               the path, or its end, of a picture that hides what is black in it; "" where
                       the document names none
    camera             None where it has none
    world_from_camera  (4, 4), OpenCV's axes, in the frame of the mesh; None where it has none
    problem            a clause that says why it cannot be used although it has both
    """

    name: str
    camera: ShotCamera | CentredCamera | UnsizedCamera | None
    world_from_camera: Double | None
    problem: str = ""
    mask: str = ""


def rows_of(document: object, key: str) -> list[dict[str, Any]]:
    """The objects of a list in a document, () where there is no such list."""
    rows = document.get(key) if isinstance(document, dict) else None
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []


def size_in(row: dict[str, Any], first: str = "width", second: str = "height") -> tuple[int, int]:
    """A picture's size; (0, 0), which no camera has, where an object states none."""
    size = numbers_among([row.get(first), row.get(second)], 2)
    return (0, 0) if size is None or not (size >= 1).all() else (int(size[0]), int(size[1]))


def capture_folder_of(path: Path) -> Path:
    """A folder, or that of a file, absolute."""
    path = path.resolve()
    return path if path.is_dir() else path.parent


def _mask_called(
    name: str, picture: Path, folder: Path, options: CaptureOptions, photographs: Container[Path]
) -> Path | None:
    """The mask of this path: below the capture's folder by the end of the path, else beside its
    picture, else in masks/; None where it lies nowhere there.

    photographs  those whose radiance is taken, which may be called as their masks are"""
    parts = [
        part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", "..")
    ]
    inside = ["/".join(parts[i:]) for i in range(len(parts))]
    places = [folder / place for place in inside]
    places += [picture.parent / parts[-1], folder / "masks" / parts[-1]] if parts else []
    places = [place for place in places if place != picture and place not in photographs]
    found = next(filter(os.path.isfile, places), None)
    if found is None:
        return None
    # Of --frames elsewhere, no links lead out of the picture's own folder.
    home = folder if found.is_relative_to(folder) else picture.parent
    return path_in_capture(home, found.relative_to(home).as_posix(), options)


def files_of_capture(folder: Path, *, meshes: tuple[str, ...]) -> list[Path]:
    """What ``scan_of_shots`` may read of a capture's folder, where a folder in it was named."""
    files = [*pictures_of(folder, CaptureOptions()).paths]
    files += (file for file in (folder / "masks").rglob("*") if file.is_file())
    with suppress(InputRefused):  # of which the reader will tell, unless --mesh is given
        files.append(mesh_beside(folder, CaptureOptions(), *meshes, how=""))
    return files


def scan_of_shots(
    shots: Iterable[Shot],
    options: CaptureOptions,
    findings: Findings,
    *,
    adapter: str,
    source: Path,
    folder: Path,
    pictures_in: tuple[str, ...] = (),
    meshes: tuple[str, ...],
    how: str,
    tiles: Callable[[], Sequence[Path]] = tuple,
    up_axis: str | None = None,
    in_metres: bool = False,
    rim: bool = False,
) -> Scan:
    """The capture of a document's photographs with the mesh beside them.

    source, folder  the document that messages name, and the capture's own folder, absolute
    pictures_in     where the pictures lie below it, "" for there; empty: where most programs have
                    them
    meshes, how     patterns of the program's own names, and what to do where there is no mesh
    tiles           asked for the files of one mesh where no other is there
    up_axis         None where the format does not say
    rim             what is black along the pictures' borders is no part of them
    in_metres       False where the unit is that of the reconstruction, which nobody knows
    """
    if not in_metres and options.meters_per_unit is None:
        findings.warn(
            f"{source.name}: what is reconstructed of photographs alone has no scale; taken are "
            "metres. State --meters-per-unit. [capture.unit]"
        )
    pictures = pictures_of(folder, options, *pictures_in)
    refuse_without_pictures(pictures, source)
    records, lacking = [], list[str]()
    for shot in shots:
        if shot.world_from_camera is None or shot.camera is None or shot.problem:
            missing = "it has no pose" if shot.world_from_camera is None else "it has no camera"
            findings.drop(shot.name, shot.problem or missing, "capture.alignment")
            continue
        image = pictures.named(shot.name)
        if image is None:
            drop_without_picture(shot.name, findings)
            continue
        camera = shot.camera
        if not isinstance(camera, ShotCamera):
            try:
                camera = camera.of_size(*image_size(image)[:2])
            except ImageRefused as error:
                is_other = str(error).endswith("[capture.size]")
                rule = "capture.size" if is_other else "capture.image"
                findings.drop(shot.name, clause_of(error, image), rule)
                continue
        mask = None
        if shot.mask:
            mask = _mask_called(shot.mask, image, folder, options, pictures.instead)
        if shot.mask and mask is None:
            lacking.append(shot.mask)
        records.append(
            FrameRecord(
                name=shot.name,
                image_path=image,
                world_from_camera=opengl_from_opencv(shot.world_from_camera),
                intrinsics=camera.intrinsics,
                resolution=camera.resolution,
                size_of_image=camera is not shot.camera,
                lens=camera.lens if camera.lens.bends else PINHOLE,
                mask_path=mask or pictures.mask_of(image, folder, options),
                rim=rim,
            )
        )
    records.sort(key=lambda record: record.image_path)
    warn_of_radiance(pictures.instead, findings, source)
    used = (path for r in records for path in (r.image_path, r.mask_path) if path)
    warn_of_unused(pictures, used, findings, source)
    if lacking:
        findings.warn(
            f"{source.name}: {len(lacking)} of the masks that it names are not there, first "
            f"{lacking[0]!r}, so those pictures are looked at whole. Put them into a folder masks. "
            "[capture.mask]"
        )

    def geometry() -> Path | ScanGeometry:
        try:
            return mesh_beside(folder, options, *meshes, how=how)
        except MeshMissing:
            if not (some := tiles()):
                raise
        names = [tile.relative_to(folder).as_posix() for tile in some]
        findings.warn(
            f"{source.name}: the mesh is that of {len(names)} tiles, first {names[0]}. [mesh.tiles]"
        )
        inside = [path_in_capture(folder, name, options) for name in names]
        return geometry_from_file(
            inside[0],
            options.objects,
            options,
            findings,
            capture_root=folder,
            read=lambda _: mesh_of_tiles(inside),
        )

    return scan_of(
        records,
        geometry,
        options,
        findings,
        adapter=adapter,
        source=source,
        folder=folder,
        up_axis=up_axis or up_axis_assumed(records, options, findings, source.name),
    )
