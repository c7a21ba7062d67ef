"""Scenes that somebody else made for Mitsuba (0.6 or 3): loading, their mesh, their materials.

What Mitsuba 3 does not know is put right in a copy of the description: integrators go, a plain
one-sided material gets two sides, phong and ward become rough plastics, shapes whose files are
missing go, textures whose files are missing become grey; all but the first two is printed.
"""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from generated_capture import Scene

from usdbrdf.model.arrays import Double

mi.set_variant("llvm_ad_rgb")

# Parameters of 0.6 without a meaning here (conductors lie in air).
ONLY_OLD = {"filterType", "extEta", "samplingWeight", "maxSmoothAngle"}
SOLID = {"diffuse", "plastic", "roughplastic", "conductor", "roughconductor"}


def load(path: Path) -> tuple[mi.Scene, Double]:
    """The scene and its own camera's pose (4, 4), in its units; it looks along +z."""
    root = ET.parse(path).getroot()
    for part in root.iter():
        mend_parameters(part)
    for parent in list(root.iter()):
        for child in list(parent):
            mend(path.parent, parent, child)
    version = root.get("version", "3.0.0")
    mi.file_resolver().append(str(path.parent))
    sensor = root.find("sensor")
    stand = ET.tostring(sensor.find("transform"), encoding="unicode")
    camera = mi.load_string(f'<sensor version="{version}" type="perspective">{stand}</sensor>')
    pose = np.array(camera.world_transform().matrix, np.float64).reshape(4, 4)
    root.remove(sensor)
    text = ET.tostring(root, encoding="unicode")
    for default in root.findall("default"):
        if f"${default.get('name')}" not in text:
            root.remove(default)
    # Not optimised: objects stay apart and in the order of the file.
    return mi.load_string(ET.tostring(root, encoding="unicode"), optimize=False), pose


def mend_parameters(part: ET.Element) -> None:
    """Colours and distributions of 0.6 as version 3 has them."""
    value = part.get("value", "")
    if part.tag == "rgb" and value.startswith("#"):  # linear
        part.set("value", ", ".join(f"{number / 255:.5f}" for number in bytes.fromhex(value[1:])))
    smooth = part.tag == "bsdf" and part.get("type") in ("conductor", "plastic", "dielectric")
    for child in list(part):
        if smooth and child.get("name") in ("distribution", "alpha"):
            part.remove(child)
        elif child.get("name") == "sunRadiusScale":  # of the sun's 0.5358 degrees
            aperture = 0.5358 * float(child.get("value", "1"))
            child.attrib.update(name="sun_aperture", value=f"{aperture:.4g}")
        elif child.get("name") == "distribution" and child.get("value") in ("phong", "as"):
            child.set("value", "beckmann")  # 0.6 makes its alpha one of the same width


def mend(folder: Path, parent: ET.Element, child: ET.Element) -> None:
    """Put right one element of the scene's description, see above."""
    kind = child.get("type")
    file = child.find("string[@name='filename']")
    lost = file is not None and not (folder / file.get("value", "")).is_file()
    if child.tag == "integrator" or child.get("name") in ONLY_OLD:
        parent.remove(child)
    elif child.get("name") == "gamma":  # 1: numbers, not colours
        raw = "true" if float(child.get("value", "1")) == 1 else "false"
        child.tag, child.attrib = "boolean", {"name": "raw", "value": raw}
    elif child.tag == "shape" and lost:
        print(f"left out: {file.get('value')} is not there")
        parent.remove(child)
    elif child.tag == "texture" and lost:
        print(f"grey: {file.get('value')} is not there")
        name = child.get("name", "")
        child.clear()
        child.tag = "rgb"
        child.attrib.update(name=name, value="0.5, 0.5, 0.5")
    elif child.tag == "bsdf" and kind in ("phong", "ward"):
        print(f"rough plastic: {kind} {child.get('id', '')}")
        make_plastic(child)
    elif child.tag == "emitter" and kind in ("sky", "sunsky"):
        # Up was y; now it is z, but where the sun stands is said in the world as before.
        turned = child.find("transform")
        if turned is None:
            turned = ET.SubElement(child, "transform", name="toWorld")
        turned.insert(0, ET.Element("rotate", x="1", angle="-90"))
        for scale in child.findall("float[@name='scale']"):  # of 0.6, for both
            scale.set("name", "sky_scale")
            if kind == "sunsky":
                ET.SubElement(child, "float", name="sun_scale", value=scale.get("value", "1"))
    if child.tag == "bsdf" and child.get("type") in SOLID and parent.tag in ("scene", "shape"):
        inner = ET.Element("bsdf", type=child.get("type", ""))
        inner.extend(list(child))
        for part in list(child):
            child.remove(part)
        child.set("type", "twosided")
        child.append(inner)


def make_plastic(bsdf: ET.Element) -> None:
    """A phong or ward lobe as a rough plastic of the same width and albedo."""
    exponent, alpha = bsdf.find("*[@name='exponent']"), bsdf.find("*[@name='alpha']")
    width = float(alpha.get("value", ".1")) if alpha is not None else 0.1
    if exponent is not None:
        width = (2 / (float(exponent.get("value", "30")) + 2)) ** 0.5
    for part in list(bsdf):
        if part.get("name") != "diffuseReflectance":
            bsdf.remove(part)
    bsdf.set("type", "roughplastic")
    ET.SubElement(bsdf, "float", name="alpha", value=f"{min(max(width, 0.01), 0.8):.4g}")


def world_mesh(things: list[mi.Shape], scale: float) -> Scene:
    """All shapes as triangles, in metres; rectangles, spheres and disks are made of some."""
    points, triangles = [], []
    for thing in things:
        p, f = triangles_of(thing)
        points.append(p * scale)
        triangles.append(f)
    first = np.cumsum([0] + [len(p) for p in points])
    return Scene(
        points=np.concatenate(points).astype(np.float32),
        triangles=np.concatenate(
            [f + start for f, start in zip(triangles, first, strict=False)]
        ).astype(np.int32),
        owner=np.repeat(np.arange(len(things), dtype=np.int32), [len(f) for f in triangles]),
        names=[f"object_{k:03d}" for k in range(len(things))],
    )


def triangles_of(thing: mi.Shape) -> tuple[Double, np.ndarray]:
    """Vertices (V, 3) in the scene's space and triangles (F, 3)."""
    parameters = mi.traverse(thing)
    if "vertex_positions" in parameters:
        points = np.array(parameters["vertex_positions"], np.float64).reshape(-1, 3)
        return points, np.array(parameters["faces"], np.int64).reshape(-1, 3)
    kind = thing.class_name()
    if kind == "Rectangle":
        own = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
        faces = np.array([[0, 1, 2], [0, 2, 3]])
    elif kind == "Sphere":
        ball = trimesh.creation.icosphere(subdivisions=4)
        own, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    elif kind == "Disk":
        turn = np.linspace(0, 2 * np.pi, 65)[:-1]
        rim = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
        own, at = np.concatenate([rim, np.zeros((1, 3))]), np.arange(64)
        faces = np.stack([at, (at + 1) % 64, np.full(64, 64)], axis=1)
    else:
        raise SystemExit(f"a shape is a {kind}. Export it as triangles.")
    matrix = np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4)
    return own @ matrix[:3, :3].T + matrix[:3, 3], faces


def write_materials(folder: Path, things: list[mi.Shape], names: list[str]) -> None:
    materials, told, known = [], [], {}
    for k, (thing, name) in enumerate(zip(things, names, strict=True)):
        words = str(thing.bsdf())
        if words not in known:
            known[words] = material_of(thing.bsdf(), words)
        emits = thing.is_emitter()
        materials.append({"name": name, "emitter": emits, **known[words]})
        told.append({"id": k, "name": name, "bsdf": words, "emitter": emits})
    note = (
        "albedo_NN.exr hold Mitsuba's albedo parameter; of coated objects `reflects` says what a "
        "viewer at 0 to 45 degrees gets of it, for parameters 0, .1, ... 1."
    )
    write_json(folder / "materials.json", {"note": note, "objects": materials})
    write_json(folder / "objects.json", told)


def material_of(bsdf: mi.BSDF, words: str) -> dict[str, Any]:
    """Kind and numbers of a material, as Mitsuba has loaded it."""
    numbers = {}
    for key, value in mi.traverse(bsdf).items():
        numbers.setdefault(key.replace(".value", "").split(".")[-1], value)

    def mean(name: str, otherwise: float) -> Double:
        return np.broadcast_to(np.array(numbers.get(name, otherwise), float).ravel(), (3,))

    found = {"textured": "BitmapTexture[" in words}
    phi = round(float(mean("alpha", 0.0)[0]), 4)
    if "Mask[" in words:
        return {**found, "kind": "mask"}
    if "Conductor[" in words:
        eta, k = mean("eta", 0.0), mean("k", 1.0)
        f0 = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2) * mean("specular_reflectance", 1.0)
        return {**found, "kind": "metal", "phi": phi, "f0": f0.round(3).tolist()}
    if "Dielectric" in words:
        return {**found, "kind": "glass", "phi": phi}
    if "Plastic[" in words:
        eta = float(mean("eta", 1.5)[0])
        psi = ((eta - 1) / (eta + 1)) ** 2 / 0.08 * float(mean("specular_reflectance", 1.0)[0])
        coated = {"kind": "dielectric_coated", "phi": phi, "psi": round(psi, 4)}
        return {**found, **coated, "reflects": reflects(words, phi, eta)}
    if "SmoothDiffuse[" not in words:
        raise SystemExit(f"no truth can be told of the material {words.split('[')[0]}")
    return {**found, "kind": "diffuse", "psi": 0.0}


def reflects(words: str, phi: float, eta: float) -> list[float]:
    """The albedo, seen from 0 to 45 degrees, of a plastic's body for parameters 0, .1, ... 1."""
    rough = {"alpha": phi, "distribution": re.findall(r"distribution = (\w+)", words)[:1]}
    kind = {"type": "plastic"}
    if "RoughPlastic[" in words:
        kind = {"type": "roughplastic", "alpha": phi, "distribution": rough["distribution"][0]}
    kind |= {"int_ior": eta, "ext_ior": 1.0, "nonlinear": "nonlinear = 1" in words}
    side = 64
    u = (np.arange(side) + 0.5) / side
    grid = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    to_light = mi.warp.square_to_cosine_hemisphere(mi.Point2f(grid.T.astype(np.float32)))
    density = np.array(mi.warp.square_to_cosine_hemisphere_pdf(to_light))
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.DiffuseReflection
    found = []
    for parameter in np.linspace(0, 1, 11):
        body = {"type": "rgb", "value": [float(parameter)] * 3}
        bsdf = mi.load_dict({**kind, "diffuse_reflectance": body})
        seen = []
        for angle in np.radians(np.arange(2.5, 45, 5)):
            point = mi.SurfaceInteraction3f()
            point.wi = mi.Vector3f(float(np.sin(angle)), 0.0, float(np.cos(angle)))
            value = np.array(bsdf.eval(context, point, to_light))[0]
            seen.append((value / density).mean())
        found.append(round(float(np.mean(seen)), 4))
    return found


def write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
