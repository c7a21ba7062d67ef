"""What trimesh does not keep of a GLB: its materials' extensions, its vertex colours as stored; and
what geometry it passes over or takes for another."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Float
from usdbrdf.model.material import normal_reflectance

_HEAD = 12  # bytes before the first part; each part begins with 8 more
_MAX_ZEROS = 8 << 20  # elements that have no bytes
_IOR = 1.5
_MOST = float(np.finfo(np.float32).max)
# What is read of extensions, and what it is where a material does not say it.
_EXTENSIONS: dict[tuple[str, str], float | tuple[float, ...]] = {
    ("emissive_strength", "emissiveStrength"): 1.0,
    ("ior", "ior"): _IOR,
    ("specular", "specularFactor"): 1.0,
    ("specular", "specularColorFactor"): (1.0, 1.0, 1.0),
    ("transmission", "transmissionFactor"): 0.0,
}
_DRACO, _INSTANCES = "KHR_draco_mesh_compression", "EXT_mesh_gpu_instancing"
_MESHOPT = frozenset(("EXT_meshopt_compression", "KHR_meshopt_compression"))
_FLOAT, _FAN = 5126, 6


def document_of(file: BinaryIO) -> dict[str, Any]:
    """The document of a GLB. ValueError where it announces longer parts than it holds, for which
    room would be made before anybody looks."""
    size = file.seek(0, os.SEEK_END)
    starts = [_HEAD]
    while starts[-1] + 8 <= size:
        file.seek(starts[-1])
        starts.append(starts[-1] + 8 + int.from_bytes(file.read(4), "little"))
    if starts[-1] > size:
        raise ValueError(f"a part ends {starts[-1] - size} bytes after the file")
    file.seek(_HEAD + 8)
    text = file.read(starts[1] - _HEAD - 8) if len(starts) > 1 else b"{}"
    document: dict[str, Any] = json.loads(text)
    file.seek(0)
    return document


def refuse_promises(document: dict[str, Any]) -> None:
    """ValueError where many elements have no bytes: they would be zeros."""
    promised = [int(a["count"]) for a in document.get("accessors", ()) if "bufferView" not in a]
    if sum(map(abs, promised)) > _MAX_ZEROS:
        raise ValueError(f"{sum(promised)} elements without bytes (limit {_MAX_ZEROS})")


def geometry_not_read(document: dict[str, Any]) -> str:
    """What of a document's geometry would be left out, or stand elsewhere; "" where all is read."""
    # Buffers that are there beside compressed ones are those that are read, unless it must be so.
    if _MESHOPT & {*document.get("extensionsRequired", ())}:
        return "its vertices are compressed (meshopt)"
    if any(_INSTANCES in node.get("extensions", {}) for node in document.get("nodes", ())):
        return f"it has copies of meshes ({_INSTANCES})"
    for node in document.get("nodes", ()):
        if "mesh" in node and (bent := _bent(node, document["meshes"][node["mesh"]])):
            return bent
    accessors = document.get("accessors", ())
    for primitive in (p for mesh in document.get("meshes", ()) for p in mesh["primitives"]):
        points = primitive["attributes"].get("POSITION")
        used = [accessors[i] for i in (points, primitive.get("indices")) if i is not None]
        if _DRACO in primitive.get("extensions", {}) and any("bufferView" not in a for a in used):
            return "its meshes are compressed (Draco)"
        if any("sparse" in a for a in used):
            return "it has sparse vertices or faces"
        if any(a.get("normalized") and a["componentType"] != _FLOAT for a in used):
            return "its vertices are quantised and normalised"
        if primitive.get("mode") == _FAN:
            return "it has fans of triangles"
    return ""


def _bent(node: dict[str, Any], mesh: dict[str, Any]) -> str:
    """By what a mesh has another shape than its vertices say; a skin also moves it from its node.
    Morph targets of no weight change nothing."""
    name = _name(mesh, node["mesh"])
    if "skin" in node:
        return f"its mesh {name} is posed by a skeleton (skin)"
    if any(node.get("weights", mesh.get("weights", ()))):
        return f"its mesh {name} is shaped by morph targets"
    return ""


def with_numbered_materials(file: BinaryIO) -> tuple[BinaryIO, list[dict[str, Any]]]:
    """The GLB with its materials' numbers for their names, by which they are known again when
    trimesh has read them; and the materials of its document."""
    content = file.read()
    start = _HEAD + 8
    end = start + int.from_bytes(content[_HEAD : _HEAD + 4], "little")
    document = json.loads(content[start:end])
    materials: list[dict[str, Any]] = document.get("materials", [])
    if materials:
        document["materials"] = [m | {"name": str(i)} for i, m in enumerate(materials)]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    size = start + len(text) + len(content) - end
    head = struct.pack("<4sIII4s", b"glTF", 2, size, len(text), b"JSON")
    return BytesIO(head + text + content[end:]), materials


def refuse_false(materials: Sequence[dict[str, Any]], path: Path) -> None:
    """InputRefused where an extension of a material has a value that is no finite number, or less
    than 0."""
    for i, material in enumerate(materials):
        for (name, key), fallback in _EXTENSIONS.items():
            said = _extension(material, name).get(key, fallback)
            try:
                numbers = np.asarray(said, np.float64)
                # Texts of numbers, true and false are none; whole numbers may be of any length.
                sound = np.asarray(said).dtype.kind in "iufO"
                sound = sound and numbers.shape == np.shape(fallback)
                sound = sound and bool(((numbers >= 0) & (numbers < _MOST)).all())
            except (TypeError, ValueError, OverflowError):
                sound = False
            if not sound:
                wanted = "finite numbers" if np.shape(fallback) else "a finite number"
                raise InputRefused(
                    f"{path}: material {_name(material, i)} has {key} {str(said)[:80]}, where "
                    f"KHR_materials_{name} has {wanted} of at least 0. Correct it, or remove the "
                    "extension. [relight.material]"
                )


def _said(material: dict[str, Any], extension: str, key: str) -> Any:
    """The value, once it is known to be sound, or what it is where the material says none."""
    return _extension(material, extension).get(key, _EXTENSIONS[extension, key])


def emissive_strength(material: dict[str, Any]) -> float:
    """The factor on the emission, 1 where the material says none."""
    return float(_said(material, "emissive_strength", "emissiveStrength"))


def normal_reflectance_of(material: dict[str, Any]) -> Float:
    """(1, 1, 3) float32: F0 of what is not metal of it, as KHR_materials_ior and _specular say; the
    second also dims what is reflected at the edge, which no material here can have.

    An index of 0 is glTF's infinite one: it reflects all; one that no surface has is not believed.
    """
    ior = _said(material, "ior", "ior")
    if _has_texture_of(material, "specular") or 0 < ior < 1:
        # Converters write an index that reflects nearly all, and textures that limit it.
        ior = _IOR
    colour = np.array(_said(material, "specular", "specularColorFactor"))
    strength = min(_said(material, "specular", "specularFactor"), 1)
    f0 = np.minimum(normal_reflectance(ior) * colour, 1) * strength
    return np.asarray(f0, np.float32).reshape(1, 1, 3)


def _has_texture_of(material: dict[str, Any], extension: str) -> bool:
    return any(key.endswith("Texture") for key in _extension(material, extension))


def is_clear(material: dict[str, Any]) -> bool:
    """Whether more light passes than not: what is shown is nothing, or an opaque surface."""
    return _transmission(material) >= 0.5 and not _has_texture_of(material, "transmission")


def _transmission(material: dict[str, Any]) -> float:
    """The share of the light that is not reflected at the surface, and passes; metal holds it."""
    inner = material.get("pbrMetallicRoughness", {})
    # Beside a texture of it, which says where there is metal, the factor is 1.
    metallic = 0.0 if "metallicRoughnessTexture" in inner else float(inner.get("metallicFactor", 1))
    share = _said(material, "transmission", "transmissionFactor") * (1 - metallic)
    return float(np.clip(share, 0, 1))


def unread(materials: Sequence[dict[str, Any]], path: Path) -> list[str]:
    """A sentence each on what the materials say and is not shown."""
    sentences = []
    for i, material in enumerate(materials):
        said, passes = f"{path}: material {_name(material, i)}", _transmission(material)
        if _has_texture_of(material, "specular"):
            sentences.append(
                f"{said}: textures of KHR_materials_specular are not read; it reflects by an index "
                f"of refraction of {_IOR} and the factors beside them."
            )
        if is_clear(material):
            sentences.append(
                f"{said}: glass is not rendered; light passes through as if nothing was there."
            )
        elif passes > 0:
            sentences.append(
                f"{said}: light that passes in part, or by a texture, is not rendered; the surface "
                "is taken as opaque."
            )
    return sentences


def _name(material: dict[str, Any], number: int) -> str:
    return repr(str(material.get("name", number))[:80])


def _extension(material: dict[str, Any], name: str) -> dict[str, Any]:
    found: dict[str, Any] = material.get("extensions", {}).get(f"KHR_materials_{name}", {})
    return found


def taken_colours(mesh: dict[str, Any]) -> Float | None:
    """COLOR_0 of what trimesh makes a mesh of, linear, (V, 3) float32, taken out of it: the mesh
    would have it as bytes. Beside a material trimesh puts it elsewhere."""
    stored = mesh.pop("vertex_colors", None)
    if stored is None and "visual" in mesh:
        stored = mesh["visual"].vertex_attributes.get("color")
    if stored is None:
        return None
    colours = np.asarray(stored)[:, :3]
    whole = 1 if colours.dtype.kind == "f" else np.iinfo(colours.dtype).max
    # The specification has them clamped.
    return np.asarray(np.clip(np.nan_to_num(colours) / whole, 0, 1), np.float32)
