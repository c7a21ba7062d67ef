"""Meshes and models of PLY, OBJ and GLB files: what ingest takes vertex by vertex as it is stored,
and what is put into a scene with its materials."""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.atomic import raise_shortage
from usdbrdf.files.colour import to_working_space
from usdbrdf.files.paths import contained
from usdbrdf.job.progress import warn
from usdbrdf.model.arrays import Bool, Float, Int
from usdbrdf.model.material import (
    Material,
    Surface,
    constant_map,
    preview_material,
    with_corner_colours,
)
from usdbrdf.untrusted.bounds import read_in_child, refuse_far, refuse_large
from usdbrdf.untrusted.mesh_gltf import (
    document_of,
    emissive_strength,
    geometry_not_read,
    is_clear,
    normal_reflectance_of,
    refuse_false,
    refuse_promises,
    taken_colours,
    unread,
    with_numbered_materials,
)
from usdbrdf.untrusted.mesh_ply import holds_splats, ply_of
from usdbrdf.untrusted.mesh_text import missing_vertex, obj_of_convex_faces, parts_of_obj, plain_obj

SUFFIXES = (".ply", ".obj", ".glb")
# The face property by which the objects of a segmented PLY are told apart.
LABEL_PROPERTY = "object_id"
_MAX_TRIANGLES = 50_000_000
_MAX_COORDINATE = 1e6
_MIN_DIAGONAL = 1e-4
# Faces with broken corners below this share are removed; above it the file is not what it says.
_MAX_BROKEN_SHARE = 0.01
# UsdPreviewSurface's own, where a file has no material.
_GREY, _ROUGHNESS = 0.18, 0.5


@dataclass(frozen=True, kw_only=True)
class FileMesh:
    """A mesh as the file tells it, triangulated.

    points       (V, 3) float32, scene units
    triangles    (F, 3) int32 inside [0, V)
    face_label   (F,) int64 the file's own object numbers, or None
    label_names  the file's names of the numbers from 0 on, where it has names
    kept         (triangles of the file,) bool: False where a triangle was left out because of
                 non-finite vertices or indices out of range; None where nothing was
    """

    points: Float
    triangles: Int
    face_label: npt.NDArray[np.int64] | None = None
    label_names: tuple[str, ...] = ()
    kept: Bool | None = None


def mesh_from_file(path: Path) -> FileMesh:
    """Read and check a mesh; vertices are neither merged, reordered nor moved.

    Faces of more corners become triangles, in place, and hand their label to all of them.
    """
    if path.suffix.lower() not in SUFFIXES:
        cure = "Save it as GLB" if path.suffix.lower() == ".gltf" else "Convert it to PLY"
        raise InputRefused(
            f"{path}: meshes are read from {', '.join(SUFFIXES)} and USD. {cure}. [mesh.format]"
        )
    return read_in_child("mesh", f"{__name__}:read_mesh_here", path, FileMesh)


def mesh_of_tiles(paths: Sequence[Path]) -> FileMesh:
    """The meshes of several files as one; what these call their parts says nothing of the whole."""
    tiles = [mesh_from_file(path) for path in paths]
    first = np.cumsum([0, *(len(tile.points) for tile in tiles)])
    triangles = [tile.triangles + start for tile, start in zip(tiles, first, strict=False)]
    all_kept = [np.ones(len(t.triangles), np.bool_) if t.kept is None else t.kept for t in tiles]
    return FileMesh(
        points=np.concatenate([tile.points for tile in tiles]),
        triangles=np.concatenate(triangles).astype(np.int32),
        kept=None if all(tile.kept is None for tile in tiles) else np.concatenate(all_kept),
    )


def model_from_file(path: Path) -> tuple[Surface, ...]:
    """The meshes of a file with their materials, in the file's own axes and units.

    Base colour, its texture, vertex colours, metalness, roughness, emission and a GLB's index of
    refraction, specular factors and transmission are read; warnings say what of these is not shown.
    Images are sRGB, and so are vertex colours but a GLB's, which are linear; beside maps the
    mean of these counts. What an OBJ or GLB names must lie in its folder. Corner normals are NaN
    where the file brings none.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputRefused(
            f"{path}: models are read from USD, {', '.join(SUFFIXES)}. Convert it. [relight.model]"
        )
    reader = f"{__name__}:read_model_here"
    surfaces, sentences = read_in_child("mesh", reader, path, tuple, parts=(Surface, Material))
    for sentence in sentences:
        warn(sentence)
    found: tuple[Surface, ...] = surfaces
    return found


def read_mesh_here(path: Path) -> FileMesh:
    """``mesh_from_file`` in this process, which is to be a child."""
    return checked_mesh(_parsed(path, _READERS[path.suffix.lower()]), path)


def _parsed(path: Path, read: Callable[[BinaryIO], Any]) -> Any:
    """What a reader makes of the open file, or InputRefused in one sentence."""
    try:
        with path.open("rb") as file:
            return read(file)
    except (InputRefused, MemoryError):
        raise
    # The readers raise whatever a damaged file makes them stumble over; EINVAL is a place before
    # the file's beginning that they were sent to, and pictures in it raise OSErrors without number.
    except Exception as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise EnvironmentFailure(f"{path}: cannot be read ({error}). [mesh.read]") from error
        raise_shortage(error)
        raise InputRefused(
            f"{path}: damaged or no {path.suffix[1:].upper()} mesh ({type(error).__name__}: "
            f"{' '.join(str(error).split())[:160]}). Export it again. [mesh.read]"
        ) from error


def checked_mesh(mesh: FileMesh, path: Path) -> FileMesh:
    """The mesh without its few broken faces, or InputRefused; Embree would not complain."""
    if len(mesh.triangles) == 0 or len(mesh.points) == 0:
        raise InputRefused(
            f"{path}: the mesh is empty ({len(mesh.points)} vertices, {len(mesh.triangles)} "
            "faces). Export the surface, not the point cloud. [mesh.empty]"
        )
    if len(mesh.triangles) > _MAX_TRIANGLES:
        raise InputRefused(
            f"{path}: {len(mesh.triangles)} triangles (limit {_MAX_TRIANGLES}). "
            "Reduce the mesh before ingest. [mesh.size]"
        )
    inside = np.asarray(
        ((mesh.triangles >= 0) & (mesh.triangles < len(mesh.points))).all(axis=1), np.bool_
    )
    _refuse_if_many(path, ~inside, "point to vertices that do not exist", "mesh.index")
    finite = np.asarray(np.isfinite(mesh.points).all(axis=1), np.bool_)
    whole = inside.copy()
    whole[inside] = finite[mesh.triangles[inside]].all(axis=1)
    _refuse_if_many(path, inside & ~whole, "have NaN or infinite corners", "mesh.nonfinite")
    triangles = mesh.triangles[whole]
    used = mesh.points[np.unique(triangles)].astype(np.float64)
    refuse_far(path, used)
    if np.abs(used).max() > _MAX_COORDINATE:
        raise InputRefused(
            f"{path}: coordinates reach {np.abs(used).max():.3g} (limit {_MAX_COORDINATE:g}). "
            "Export mesh and cameras near the origin, or check the unit. [mesh.far]"
        )
    diagonal = float(np.linalg.norm(np.ptp(used, axis=0)))
    if diagonal < _MIN_DIAGONAL:
        raise InputRefused(
            f"{path}: the whole mesh is {diagonal:.3g} across (limit {_MIN_DIAGONAL:g}). "
            "Check its unit. [mesh.tiny]"
        )
    return replace(
        mesh,
        # Vertices of no face keep their place, but no NaN may travel on.
        points=np.where(finite[:, None], mesh.points, np.float32(0)),
        triangles=triangles,
        face_label=None if mesh.face_label is None else mesh.face_label[whole],
        kept=None if whole.all() else whole,
    )


def _refuse_if_many(path: Path, broken: Bool, what: str, rule: str) -> None:
    share = float(broken.mean())
    if share >= _MAX_BROKEN_SHARE:
        raise InputRefused(
            f"{path}: {int(broken.sum())} of {len(broken)} faces ({share:.1%}, limit "
            f"{_MAX_BROKEN_SHARE:.0%}) {what}. Export the mesh again. [{rule}]"
        )


def _mesh_from_ply(file: BinaryIO) -> FileMesh:
    content = file.read()
    if holds_splats(content):
        raise InputRefused(
            f"{file.name}: Gaussian splats, which have no surface. Have a mesh made of what they "
            "were trained on, and name it with --mesh. [mesh.empty]"
        )
    ply = ply_of(content)
    cut, label = ply.triangulation, ply.faces.get(LABEL_PROPERTY)
    if label is not None and label.dtype.kind == "f":
        with np.errstate(invalid="ignore", over="ignore"):
            none = ~(np.abs(label) < 2**53) | (np.floor(label) != label)
        if none.any():
            raise ValueError(f"a face has {LABEL_PROPERTY} {label[none][0]:g}, no object's number")
    label = None if label is None else label.astype(np.int64)[cut.polygon]
    return _file_mesh(ply.points, cut.triangles, label)


def _mesh_from_obj(file: BinaryIO) -> FileMesh:
    from trimesh.exchange.obj import load_obj  # takes a tenth of a second that PLY files need not

    content = plain_obj(file.read())
    try:
        whole, names, part = parts_of_obj(obj_of_convex_faces(content))
        loaded: dict[str, Any] = load_obj(BytesIO(whole), skip_materials=True, maintain_order=True)
    except IndexError as error:
        if said := missing_vertex(content):
            raise InputRefused(
                f"{file.name}: {said}. Export it again, or correct this line. [mesh.index]"
            ) from error
        raise
    if not (found := [*loaded.get("geometry", {}).values()]):
        return _no_faces(0)
    faces = _fans(found[0]["faces"])
    if len(found) > 1 or len(faces) != len(part):
        raise ValueError(f"{len(part)} triangles are stated, {len(faces)} found")
    label = part if len(names) > 1 else None
    return _file_mesh(found[0]["vertices"], faces, label, names if len(names) > 1 else ())


def _fans(faces: Any) -> Any:
    """(T, 3) triangles in place of faces (F, N) that all have as many corners."""
    polygons = np.asarray(faces)
    steps = np.arange(polygons.shape[1] - 2)
    fan = np.stack([np.zeros_like(steps), steps + 1, steps + 2], axis=1)
    return polygons[:, fan].reshape(-1, 3)


def _mesh_from_glb(file: BinaryIO) -> FileMesh:
    document = document_of(file)
    if said := geometry_not_read(document):
        raise InputRefused(
            f"{file.name}: {said}, which is not read here. Export it again as plain triangles, "
            "posed and without compression, or convert it to PLY. [mesh.format]"
        )
    import trimesh

    refuse_promises(document)
    scene = trimesh.load_scene(file, file_type="glb", process=False)
    parts = []
    for node in sorted(scene.graph.nodes_geometry):
        world_from_node, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh):
            points = trimesh.transform_points(mesh.vertices, world_from_node)
            # A mirroring transform would turn the surface inside out.
            order = [0, 2, 1] if np.linalg.det(world_from_node[:3, :3]) < 0 else [0, 1, 2]
            parts.append((str(node), points, np.asarray(mesh.faces)[:, order]))
    return _joined(parts)


def _joined(parts: list[tuple[str, Any, Any]]) -> FileMesh:
    """Named parts of one file in one soup; they become labels where there is more than one."""
    if not parts:
        return _no_faces(0)
    firsts = np.cumsum([0, *[len(points) for _, points, _ in parts]])
    faces = [np.asarray(f) + firsts[i] for i, (_, _, f) in enumerate(parts)]
    points = np.concatenate([np.asarray(points) for _, points, _ in parts])
    if len(parts) == 1:
        return _file_mesh(points, faces[0])
    label = np.repeat(np.arange(len(parts), dtype=np.int64), [len(f) for f in faces])
    names = tuple(name for name, _, _ in parts)
    return _file_mesh(points, np.concatenate(faces), label, names)


def _file_mesh(points: Any, faces: Any, label: Any = None, names: tuple[str, ...] = ()) -> FileMesh:
    polygons = np.asarray(faces, np.int64)
    if polygons.ndim != 2 or polygons.shape[1] != 3:
        raise ValueError(f"faces have the shape {polygons.shape}")
    # Unsigned indices beyond int32 must not wrap round to valid ones.
    polygons = np.where(polygons > np.iinfo(np.int32).max, -1, polygons)
    return FileMesh(
        points=np.ascontiguousarray(points, np.float32).reshape(-1, 3),
        triangles=np.ascontiguousarray(polygons, np.int32),
        face_label=label,
        label_names=names,
    )


def _no_faces(vertices: int) -> FileMesh:
    return _file_mesh(np.zeros((vertices, 3)), np.zeros((0, 3)))


_READERS = {".ply": _mesh_from_ply, ".obj": _mesh_from_obj, ".glb": _mesh_from_glb}


def read_model_here(path: Path) -> tuple[list[Surface], list[str]]:
    """``model_from_file`` in this process, which is to be a child, and its warnings."""
    # Its checks first: whatever is damaged is refused there, in one sentence.
    if read_mesh_here(path).kept is not None:
        raise InputRefused(
            f"{path}: faces of it have NaN corners or vertices that do not exist. Export it again. "
            "[relight.model]"
        )
    found: tuple[list[Surface], list[str]] = _parsed(path, lambda file: _surfaces(path, file))
    return found


def _surfaces(path: Path, file: BinaryIO) -> tuple[list[Surface], list[str]]:
    import trimesh

    beside, of = _FilesBeside(path), trimesh.exchange
    loaders = {".ply": of.ply.load_ply, ".obj": of.obj.load_obj, ".glb": of.gltf.load_glb}
    load: Any = loaders[path.suffix.lower()]
    if path.suffix.lower() == ".obj":
        file = BytesIO(obj_of_convex_faces(plain_obj(file.read())))
    if path.suffix.lower() == ".ply":
        file = ply_of(file.read()).as_trimesh_reads_it()
    gltf = None
    if path.suffix.lower() == ".glb":
        file, gltf = with_numbered_materials(file)
        refuse_false(gltf, path)
    stored = load(file, resolver=beside)
    if beside.refused:
        raise beside.refused[0]
    # Normals are kept apart: a mesh of trimesh makes them up where there are none.
    meshes = list(stored["geometry"].values()) if "geometry" in stored else [stored]
    normals = [mesh.pop("vertex_normals", None) for mesh in meshes]
    colours = [None if gltf is None else taken_colours(mesh) for mesh in meshes]
    for mesh in meshes:
        mesh["process"] = False
        if "faces" in mesh:
            mesh["faces"] = _fans(mesh["faces"])
    scene = trimesh.load_scene(stored)
    given = dict(zip(scene.geometry, zip(normals, colours, strict=True), strict=True))
    found = []
    for node in sorted(scene.graph.nodes_geometry):
        world_from_node, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            own_normals, own_colours = given[name]
            surface = _surface(f"{path.name}:{node}", mesh, own_normals, own_colours, gltf)
            found.append(surface.moved(np.asarray(world_from_node)))
    return found, unread(gltf or (), path)


class _FilesBeside:
    """Materials and pictures that a model names, as trimesh asks for them: only those in its folder
    or below. trimesh passes over what fails, so the refusals are kept."""

    def __init__(self, model: Path) -> None:
        self.folder, self.refused = model.parent, list[InputRefused]()

    def get(self, name: str) -> bytes:
        last = name.replace("\\", "/").rsplit("/", 1)[-1].strip()
        # Exporters write down where a picture was; it often travelled with the model.
        if not (last and (path := self.folder / last).is_file() and not path.is_symlink()):
            try:
                path = contained(self.folder, name.strip())
            except InputRefused as error:
                self.refused.append(error)
                raise
        if path.is_file():  # a model without this texture is still a model
            refuse_large("picture", path)
        return path.read_bytes()

    __getitem__ = get


def _surface(
    name: str, mesh: Any, normals: Any, colours: Any, gltf: list[dict[str, Any]] | None
) -> Surface:
    """gltf  the materials of a GLB, whose vertex colours are given; None of other formats"""
    points = np.asarray(mesh.vertices, np.float64)
    triangles = np.ascontiguousarray(mesh.faces, np.int32)
    uv = getattr(mesh.visual, "uv", None)
    corner_uv = None
    if uv is not None and len(uv) == len(points):
        corner_uv = np.asarray(uv, np.float32)[triangles]
    if gltf is None and mesh.visual.kind == "vertex":
        stored = np.asarray(mesh.visual.vertex_colors, np.float32)[:, :3] / np.float32(255)
        colours = to_working_space(stored[None], "srgb_rec709_scene")[0]
    if colours is not None and len(colours) != len(points):
        colours = None
    inputs = _inputs(mesh.visual, gltf, textured=corner_uv is not None)
    if inputs is None:
        inputs = _defaults(gltf is not None, coloured=colours is not None)
    corner_normals = np.full((*triangles.shape, 3), np.nan, np.float32)
    if normals is not None and len(normals) == len(points):
        given = np.asarray(normals, np.float32)[triangles]
        length = np.linalg.norm(given, axis=-1, keepdims=True)
        if np.isfinite(given).all() and (length > 1e-6).all():
            corner_normals = np.asarray(given / length, np.float32)
    surface = Surface(
        name=name,
        points=points,
        triangles=triangles,
        corner_normals=corner_normals,
        corner_uv=corner_uv,
        material=inputs.material,
    )
    return surface if colours is None else _coloured(surface, inputs, colours[triangles])


@dataclass(frozen=True, kw_only=True)
class _Inputs:
    """Those of ``preview_material``, and what is ``clear`` of a Material."""

    diffuse: Float
    metallic: Float
    roughness: Float
    emission: Float
    dielectric: Float = field(default_factory=partial(normal_reflectance_of, {}))
    clear: bool = False

    @property
    def material(self) -> Material:
        # The default of OBJ and of glTF, whose samplers the reader does not keep.
        inputs = {name: value for name, value in vars(self).items() if name != "clear"}
        return replace(preview_material(**inputs), wrap="repeat", clear=self.clear)


def _coloured(surface: Surface, inputs: _Inputs, colours: Float) -> Surface:
    """The surface with its base colour times ``colours`` (F, 3, 3). A renderer has colours of
    corners or a map; beside maps their mean counts."""
    if inputs.diffuse.shape[:2] == inputs.metallic.shape[:2] == (1, 1):
        metallic = float(inputs.metallic[0, 0, 0])
        return with_corner_colours(surface, inputs.diffuse * colours, metallic, inputs.dielectric)
    mean = colours.mean(axis=(0, 1), dtype=np.float32)
    return replace(surface, material=replace(inputs, diffuse=inputs.diffuse * mean).material)


def _defaults(gltf: bool, *, coloured: bool) -> _Inputs:
    """Where a file has no material; glTF says that it is then one of white metal."""
    return _Inputs(
        diffuse=constant_map(1.0 if gltf or coloured else _GREY),
        metallic=constant_map(float(gltf))[..., :1],
        roughness=constant_map(1.0 if gltf else _ROUGHNESS)[..., :1],
        emission=constant_map(0.0),
    )


def _inputs(visual: Any, gltf: list[dict[str, Any]] | None, *, textured: bool) -> _Inputs | None:
    """None where there is no material."""
    stored = getattr(visual, "material", None)
    if visual.kind != "texture" or stored is None:
        return None
    if hasattr(stored, "to_pbr"):  # the OBJ's Phong-like one
        stored = stored.to_pbr()
    base = _factor(stored.baseColorFactor, 3, 1.0)
    # glTF's are 1 where it says nothing.
    metallic = _factor(stored.metallicFactor, 1, 0.0 if gltf is None else 1.0)
    roughness = _factor(stored.roughnessFactor, 1, _ROUGHNESS if gltf is None else 1.0)
    emission = _factor(stored.emissiveFactor, 3, 0.0)
    if textured and (picture := _image(stored.baseColorTexture)) is not None:
        base = base * to_working_space(picture, "srgb_rec709_scene")
    if textured and (picture := _image(stored.emissiveTexture)) is not None:
        emission = emission * to_working_space(picture, "srgb_rec709_scene")
    if textured and (picture := _image(stored.metallicRoughnessTexture)) is not None:
        # glTF: roughness in green, metalness in blue
        roughness = roughness * picture[..., 1:2]
        metallic = metallic * picture[..., 2:3]
    found = _Inputs(diffuse=base, metallic=metallic, roughness=roughness, emission=emission)
    if not gltf:
        return found
    said = gltf[int(stored.name)]
    return replace(
        found,
        emission=emission * np.float32(emissive_strength(said)),
        dielectric=normal_reflectance_of(said),
        clear=is_clear(said),
    )


def _factor(value: Any, channels: int, fallback: float) -> Float:
    """(1, 1, channels): trimesh keeps some factors as bytes, of which colours are linear."""
    if value is None:
        return np.full((1, 1, channels), fallback, np.float32)
    numbers = np.atleast_1d(np.asarray(value))
    if numbers.dtype == np.uint8:
        numbers = numbers / 255.0
    return np.asarray(numbers[:channels], np.float32).reshape(1, 1, channels)


def _image(picture: Any) -> Float | None:
    """(H, W, 3) float32 in [0, 1] of a PIL image; None for a number, which is all that is left of a
    texture that the file does not hold."""
    if not hasattr(picture, "convert"):
        return None
    return np.asarray(picture.convert("RGB"), np.float32) / np.float32(255)
