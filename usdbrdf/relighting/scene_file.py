"""A scene as Mitsuba's own format: NAME.xml, and beside it the folder NAME.files with meshes (PLY)
and pictures (EXR), whose names tell what is in them: so those of two scenes stand side by side
until the one text has replaced the other. It needs no plug-in of ours: materials are what Mitsuba's
BSDFs can say of them, see ``description.two_of_mitsuba``."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from usdbrdf.errors import OwnershipConflict
from usdbrdf.files.atomic import (
    environment_failures,
    flush_folder,
    move,
    publish,
    publish_folder,
    sha256_of,
    temporary_folder,
    write_text_atomic,
)
from usdbrdf.files.images import write_exr
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.light import RelitScene
from usdbrdf.relighting import description
from usdbrdf.relighting.render import mesh_of_surface

SUFFIX = ".xml"
VERSION = "3.0.0"  # of Mitsuba's format
_TAGS = {
    "area": "emitter", "bitmap": "texture", "blendbsdf": "bsdf", "box": "rfilter",
    "constant": "emitter", "diffuse": "bsdf", "directional": "emitter", "disk": "shape",
    "envmap": "emitter", "hdrfilm": "film", "mesh_attribute": "texture", "multijitter": "sampler",
    "path": "integrator", "perspective": "sensor", "ply": "shape", "rectangle": "shape",
    "roughconductor": "bsdf", "sphere": "shape", "twosided": "bsdf", "uniform": "texture",
}  # fmt: skip
_OURS = "A scene of usdbrdf for Mitsuba 3: metres, linear Rec.709, radiance in the asset's unit. "
# In the folder it says whose that is; of the scene it is at its beginning.
_MARK, _BEGINNING = "usdbrdf.txt", 4096
_NAME = re.compile(r"(mesh|picture)_\d{4,}\.[0-9a-f]{16}\.(ply|exr)")


def write_scene_file(
    mi: Any,
    path: Path,
    scene: RelitScene,
    cameras: Sequence[Camera],
    *,
    bounces: int,
    samples: int,
    seed: int = 0,
) -> int:
    """Write the scene with all cameras, of which Mitsuba renders the first; returns how many meshes
    and pictures lie beside it. What stood there of an earlier scene is replaced, or stays if that
    fails or is killed.

    seed  of the noise; each camera has its own

    Pictures have square pixels: a camera whose pixels are not has more or fewer rows. Raises
    OwnershipConflict where something else stands in the place of the scene or of its files.
    """
    folder = path.with_name(f"{path.stem}.files")
    with environment_failures(str(path)), _taking(path, folder) as work:
        made, text = work / "made" / folder.name, work / "made" / path.name
        made.mkdir(parents=True)
        root = _scene_element(mi, _Files(made), scene, cameras, bounces, samples, seed)
        names = {file.name for file in made.iterdir()}
        write_text_atomic(made / _MARK, f"{_OURS}\n")
        ElementTree.indent(root)
        plain = ElementTree.tostring(root, encoding="unicode")
        write_text_atomic(text, f'<?xml version="1.0" encoding="utf-8"?>\n{plain}\n')
        with _added(made, folder):
            publish(text, path)
        for file in folder.iterdir():  # what the scene before named
            if _NAME.fullmatch(file.name) and file.name not in names:
                file.unlink()
    return len(names)


@contextmanager
def _taking(path: Path, folder: Path) -> Iterator[Path]:
    """A folder to make the scene in, unless something else stands in its place."""
    if folder.exists() and not (folder.is_dir() and _is_ours(folder)):
        raise OwnershipConflict(
            f"{folder}: this is in the place of the scene's meshes and pictures. Name another file "
            "with -o. [relight.output]"
        )
    if path.exists() and not _says_so(path):
        raise OwnershipConflict(
            f"{path}: not a scene that usdbrdf wrote. Name another file with -o. [relight.output]"
        )
    with temporary_folder(path) as work:
        yield work


@contextmanager
def _added(made: Path, folder: Path) -> Iterator[None]:
    """The files of a folder in another, which may hold some already; gone again if the block fails,
    but for those that were there before."""
    before = {file.name for file in folder.iterdir()} if folder.exists() else set()
    try:
        if before:
            for file in made.iterdir():
                move(file, folder / file.name)
            flush_folder(folder)
        else:
            publish_folder(made, folder)
        yield
    except BaseException:
        with suppress(OSError):
            for file in [*folder.iterdir()]:
                if file.name not in before:
                    file.unlink()
            if not before:
                folder.rmdir()
        raise


def _is_ours(folder: Path) -> bool:
    """Whether a folder is of a scene of ours, or empty."""
    return _says_so(folder / _MARK) or not any(folder.iterdir())


def _says_so(file: Path) -> bool:
    """Whether the beginning of a file says that usdbrdf wrote it."""
    with suppress(OSError), file.open("rb") as opened:
        return _OURS.encode() in opened.read(_BEGINNING)
    return False


class _Files:
    """The pictures and meshes of a scene, equal pictures once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._known: dict[tuple[Any, ...], str] = {}

    def named(self, name: str) -> str:
        return f"{self.folder.name}/{name}"

    def picture(self, pixels: Float) -> str:
        key = pixels.shape, pixels.tobytes()
        if key not in self._known:
            file = self.folder / "picture.exr"
            write_exr(file, pixels, half=False)
            name = f"picture_{len(self._known):04d}.{sha256_of(file)[:16]}.exr"
            self._known[key] = file.rename(self.folder / name).name
        return self.named(self._known[key])

    def mesh(self, number: int, ply: bytes) -> str:
        name = f"mesh_{number:04d}.{hashlib.sha256(ply).hexdigest()[:16]}.ply"
        (self.folder / name).write_bytes(ply)
        return self.named(name)


def _scene_element(
    mi: Any,
    files: _Files,
    scene: RelitScene,
    cameras: Sequence[Camera],
    bounces: int,
    samples: int,
    seed: int,
) -> ElementTree.Element:
    root = ElementTree.Element("scene", version=VERSION)
    root.append(ElementTree.Comment(f" {_OURS}"))
    _add(root, "", description.integrator(bounces), files)
    for i, camera in enumerate(cameras):
        sensor = description.pinhole(camera, *description.square_pixels(camera))
        noise = int(np.random.SeedSequence((seed, i)).generate_state(1)[0])
        sensor["sampler"] = {**sensor["sampler"], "sample_count": samples, "seed": noise}
        _add(root, "", sensor, files).set("id", camera.name)
    for i, surface in enumerate(s for s in scene.surfaces if not s.material.clear):
        # Into memory: where the disk is full, a mesh's own writer may leave half a file unnoticed.
        written = mi.MemoryStream()
        mesh_of_surface(mi, surface, mi.Properties()).write_ply(written)
        mesh = files.mesh(i, written.raw_buffer())
        bsdf = description.two_of_mitsuba(surface)
        shape: dict[str, Any] = {"type": "ply", "filename": mesh}
        shape["bsdf"] = {"type": "twosided", "bsdf": bsdf} if surface.two_sided else bsdf
        if surface.material.emits:
            shape["emitter"] = description.emitter(surface)
        root.append(ElementTree.Comment(f" {surface.name.replace('--', '- -')} "))
        _add(root, "", shape, files)
    extent = description.extent(scene)
    for light in scene.lights:
        _add(root, "", description.light(light, *extent), files)
    return root


def _add(
    above: ElementTree.Element, name: str, plain: Mapping[str, Any], files: _Files
) -> ElementTree.Element:
    """An element for a description, named as a property of what is above it."""
    kind = plain["type"]
    named = {"name": name} if name else {}
    if kind == "rgb":
        value = np.atleast_1d(np.asarray(plain["value"], np.float64)).tolist()
        return _element(above, "rgb", **named, value=", ".join(map(repr, value)))
    if kind == "uniform" and above.tag == "bsdf":
        return _element(above, "float", **named, value=repr(plain["value"]))
    made = _element(above, _TAGS[kind], type=kind, **named)
    for key, value in plain.items():
        if key != "type":
            _add_value(made, key, value, files)
    return made


def _add_value(above: ElementTree.Element, name: str, value: Any, files: _Files) -> None:
    if isinstance(value, Mapping):
        _add(above, name, value, files)
    elif isinstance(value, np.ndarray) and name == "bitmap":
        _element(above, "string", name="filename", value=files.picture(value))
    elif isinstance(value, np.ndarray):
        _element(_element(above, "transform", name=name), "matrix", value=_matrix(value))
    elif isinstance(value, list):
        _element(above, "vector", name=name, value=", ".join(map(repr, value)))
    else:
        kinds = {bool: "boolean", int: "integer", float: "float", str: "string"}
        text = str(value).lower() if isinstance(value, bool) else str(value)
        _element(above, kinds[type(value)], name=name, value=text)


def _matrix(values: Double) -> str:
    return " ".join(map(repr, np.asarray(values, np.float64).ravel().tolist()))


def _element(above: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(above, tag, attributes)
