"""A captured room with truth, rendered anew with other materials: cheap rooms in number.

    python benchmarks/redraw_room.py CAPTURE OUTPUT --seed N [--frames F] [--scale S]
        [--samples SPP] [--denoise] [--coated SHARE] [--metals SHARE]

CAPTURE holds mesh.ply with an ``object_id`` per face, objects.json, transforms.json, and in truth/
materials.json (kind, phi, psi, F0 per object), objects.json (Mitsuba's description of each BSDF)
and views.json with view_NN.exr and albedo_NN.exr. OUTPUT gets the same files. Geometry, poses,
exposures, diffuse albedo, lamps, glass and masks are kept; new are, from the seed,

    coated   phi log-uniform in [0.02, 0.6], psi uniform in [0.1, 1]; the coated objects of CAPTURE,
             and --coated of its diffuse ones
    metals   phi alike, F0 in [0.15, 0.97], oftener bright, channels up to 0.4 apart; the metals of
             CAPTURE, and --metals of its small coated objects

Truth is Mitsuba's own: coated is ``roughplastic``, GGX with Smith's masking and Fresnel's
equations, alpha = phi, the index of refraction that has F0 = 0.08 psi, ``nonlinear``; metal is
``roughconductor``, GGX, alpha = phi, with eta and k that have F0 (Gulbrandsen, Artist Friendly
Metallic Fresnel, JCGT 2014, edge tint one half). Textured albedo is what the held-out views show,
laid on the object from three sides; places that no view shows take the nearest that one does, or
the object's median. Lamps have the radiance that held-out views show; those that none shows what
gives the views' medians.

Without --denoise frames have the noise of their samples. With it Open Image Denoise filters frames,
guided by the true albedo and normals: it blurs small highlights, as it did in captures that were
rendered with few samples. Held-out views are filtered in either case. Needs the extras ``render``
and ``denoise``, and an LLVM library as samples/make_study.py.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from true_room import Room, known_albedo, number_after, pattern_of

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "samples"))
from study_camera import Array, photograph, saturation_radiance, write_exr

from usdbrdf.files.images import read_radiance
from usdbrdf.relighting.render import mitsuba_variant
from usdbrdf.transport.denoise import denoise_picture

F0_OF_PSI = 0.08
SMALL_SHARE = 0.02  # of all surface: a larger thing made a mirror would change the room's light
MAX_DEPTH, ROULETTE_DEPTH = 12, 5
PATHS_PER_PASS = 1 << 20
VIEW_TIMES = 1  # samples of a held-out view, in those of a frame


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=36, help="at most (%(default)s)")
    parser.add_argument("--views", type=int, default=4, help="held out, at most (%(default)s)")
    parser.add_argument("--scale", type=float, default=0.5, help="of pictures (%(default)s)")
    parser.add_argument("--samples", type=int, default=128, help="paths per pixel (%(default)s)")
    parser.add_argument("--denoise", action="store_true", help="filter the frames")
    parser.add_argument("--coated", type=float, default=0.3, help="share of diffuse objects")
    parser.add_argument("--metals", type=float, default=0.1, help="share of small coated objects")
    options = parser.parse_args()
    if options.output.exists():
        parser.error(f"{options.output} exists. Name a folder that does not.")

    start = time.process_time()
    mi = mitsuba_variant()
    room = Room(options.capture)
    materials = redrawn(room, np.random.default_rng(options.seed), options.coated, options.metals)
    radiance = lamp_radiance(mi, room, materials)
    scene = mitsuba_scene(mi, room, materials, radiance)
    for folder in ("frames", "truth"):
        (options.output / folder).mkdir(parents=True)
    for name in ("mesh.ply", "objects.json", "LICENSE.txt"):
        if (options.capture / name).exists():
            shutil.copyfile(options.capture / name, options.output / name)
    write_truth(options.output / "truth", mi, scene, materials)
    write_views(options, mi, scene, room)
    write_frames(options, mi, scene, room)
    print(f"{options.output}: {time.process_time() - start:.0f} s of CPU")
    return 0


# ---- its new materials -------------------------------------------------------------------------


def redrawn(
    room: Room, rng: np.random.Generator, coated: float, metals: float
) -> list[dict[str, Any]]:
    """Truth of each object, with its albedo (3,) where that is one colour.

    Each object takes the same number of draws: what one becomes does not change the others.
    """
    whole = sum(room.area.values())
    new = []
    for old in room.materials:
        name, kind = old["name"], old["kind"]
        draw = rng.random(7)
        if not old["emitter"]:
            if kind == "diffuse" and draw[0] < coated:
                kind = "dielectric_coated"
            elif kind == "dielectric_coated" and draw[1] < metals:
                kind = "metal" if room.area[name] < SMALL_SHARE * whole else kind
        phi = round(0.02 * 30.0 ** draw[2], 4)
        material = {key: old[key] for key in ("name", "emitter", "textured")} | {"kind": kind}
        if kind == "dielectric_coated":
            material |= {"phi": phi, "psi": round(0.1 + 0.9 * draw[3], 4)}
        elif kind == "metal":
            level = 0.15 + 0.82 * max(draw[4], draw[5])
            tint = 0.4 * np.abs(np.random.default_rng(int(draw[6] * 2**32)).random(3))
            f0 = np.clip(level - tint + tint.min(), 0.15, 0.97)
            material |= {"phi": phi, "f0": f0.round(4).tolist(), "textured": False}
        elif kind in ("glass", "mask"):
            material |= {"phi": old.get("phi", 0.0)}
        else:
            material["psi"] = 0.0
        material["albedo"] = known_albedo(room, name)
        new.append(material)
    return new


# ---- Mitsuba -----------------------------------------------------------------------------------


def mitsuba_scene(
    mi: Any, room: Room, materials: list[dict[str, Any]], radiance: dict[str, Array]
) -> Any:
    aovs = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"}
    path = {"type": "path", "max_depth": MAX_DEPTH, "rr_depth": ROULETTE_DEPTH}
    parts: dict[str, Any] = {"type": "scene", "integrator": aovs | {"path": path}}
    for material in materials:
        name = material["name"]
        if len(room.corners[name][0]):
            parts[name] = mitsuba_shape(mi, room, material, radiance.get(name))
    return mi.load_dict(parts, optimize=False)


def mitsuba_shape(mi: Any, room: Room, material: dict[str, Any], radiance: Array | None) -> Any:
    name = material["name"]
    corners, normals = room.corners[name]
    pattern = pattern_of(room, name) if material["textured"] else None
    albedo: dict[str, Any] = {"type": "rgb", "value": material["albedo"]}
    if pattern is not None:
        bitmap = mi.Bitmap(pattern[0][::-1].astype(np.float32).copy())
        albedo = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(mitsuba_bsdf(material, albedo, room.described[name]))
    if radiance is not None:
        light = {"type": "area", "radiance": {"type": "rgb", "value": list(map(float, radiance))}}
        props["emitter"] = mi.load_dict(light)
    count = len(corners)
    shape = mi.Mesh(name, 3 * count, count, props, True, pattern is not None)
    buffers = mi.traverse(shape)
    buffers["vertex_positions"] = corners.astype(np.float32).ravel()
    buffers["vertex_normals"] = normals.astype(np.float32).ravel()
    buffers["faces"] = np.arange(3 * count, dtype=np.uint32)
    if pattern is not None:
        buffers["vertex_texcoords"] = pattern[1].astype(np.float32).ravel()
    buffers.update()
    return shape


def mitsuba_bsdf(
    material: dict[str, Any], albedo: dict[str, Any], description: str
) -> dict[str, Any]:
    kind = material["kind"]
    if kind == "glass":
        clear = number_after(description, "specular_transmittance") or [1.0] * 3
        through = {"type": "rgb", "value": clear}
        return {"type": "dielectric", "int_ior": 1.5, "specular_transmittance": through}
    if kind == "metal":
        eta, k = complex_ior(np.array(material["f0"]))
        surface = rough("roughconductor", material["phi"]) | {
            "eta": {"type": "rgb", "value": eta.tolist()},
            "k": {"type": "rgb", "value": k.tolist()},
        }
    elif kind == "dielectric_coated":
        surface = coated(material["phi"], material["psi"], albedo)
    else:
        surface = {"type": "diffuse", "reflectance": albedo}
    surface = {"type": "twosided", "surface": surface}
    if kind == "mask":
        opacity = np.mean(number_after(description, "opacity") or [0.5])
        return {"type": "mask", "opacity": float(opacity), "surface": surface}
    return surface


def rough(plugin: str, phi: float) -> dict[str, Any]:
    return {"type": plugin, "distribution": "ggx", "alpha": phi}


def coated(phi: float, psi: float, albedo: dict[str, Any]) -> dict[str, Any]:
    root = np.sqrt(F0_OF_PSI * psi)
    ior = float((1 + root) / (1 - root))
    return rough("roughplastic", phi) | {
        "int_ior": ior, "ext_ior": 1.0, "nonlinear": True, "diffuse_reflectance": albedo
    }  # fmt: skip


def complex_ior(f0: Array) -> tuple[Array, Array]:
    """(eta, k) of the reflectance at normal incidence, by Gulbrandsen's g = 1/2."""
    eta = 0.5 * (1 - f0) / (1 + f0) + 0.5 * (1 + np.sqrt(f0)) / (1 - np.sqrt(f0))
    return eta, np.sqrt(np.maximum(f0 * (eta + 1) ** 2 - (eta - 1) ** 2, 0) / (1 - f0))


def reflected(mi: Any, phi: float, psi: float) -> list[float]:
    """What of a coated surface's albedo of 0, 0.1, ... 1 a viewer at 0 to 45 degrees gets under
    uniform light, without the lobe: by quadrature over Mitsuba's BSDF."""
    cosine = np.sqrt((np.arange(64) + 0.5) / 64)
    sine, zero = np.sqrt(1 - cosine**2), np.zeros(64)
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.DiffuseReflection
    shares = []
    for parameter in np.linspace(0, 1, 11):
        bsdf = mi.load_dict(coated(phi, psi, {"type": "rgb", "value": float(parameter)}))
        of_views = []
        for degrees in (5, 15, 25, 35, 45):
            point = mi.SurfaceInteraction3f()
            angle = np.radians(degrees)
            point.wi = mi.Vector3f(float(np.sin(angle)), 0.0, float(np.cos(angle)))
            # The diffuse part does not depend on the azimuth.
            out = np.stack([sine, zero, cosine]).astype(np.float32)
            value = bsdf.eval(context, point, mi.Vector3f(out))
            of_views.append(float((np.array(value)[0] * np.pi / cosine).mean()))
        shares.append(round(float(np.mean(of_views)), 4))
    return shares


def rendered(
    mi: Any, scene: Any, document: dict[str, Any], pose: Array, samples: int, seed: int
) -> tuple[Array, Array, Array]:
    """(radiance, albedo, normal), (H, W, 3) each: means over each pixel's square."""
    width, height = document["w"], document["h"]
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2 * np.arctan(width / 2 / document["fl_x"]))),
            "principal_point_offset_x": document["cx"] / width - 0.5,
            "principal_point_offset_y": document["cy"] / height - 0.5,
            "near_clip": 0.01,
            "far_clip": 1000.0,
            # Mitsuba's cameras look down +z with x to the left.
            "to_world": mi.ScalarTransform4f(pose @ np.diag([-1.0, 1.0, -1.0, 1.0])),
            "sampler": {"type": "independent"},
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        }
    )
    total = np.zeros((height, width, 9))
    passes = -(-samples * width * height // PATHS_PER_PASS)
    each = -(-samples // passes)
    for k in range(passes):
        image = mi.render(scene, sensor=sensor, spp=each, seed=seed * 1000 + k)
        total += np.nan_to_num(np.array(image, dtype=np.float64))
    radiance, albedo, normal = np.split(total / passes, 3, axis=2)
    return radiance, albedo, normal


def lamp_radiance(mi: Any, room: Room, materials: list[dict[str, Any]]) -> dict[str, Array]:
    """Per lamp: what views show of it; those that none shows share what the views lack."""
    lamps = [material["name"] for material in materials if material["emitter"]]
    found = {name: np.median(room.seen[name][3], axis=0) for name in lamps if name in room.seen}
    hidden = [name for name in lamps if name not in found]
    if not hidden:
        return found
    dark = {name: np.zeros(3) for name in lamps}
    by: list[Any] = []
    for lit in (found, {name: np.ones(3) for name in hidden}):
        if not lit:
            by.append(np.zeros((len(room.views["frames"]), room.views["h"], room.views["w"], 3)))
            continue
        scene = mitsuba_scene(mi, room, materials, dark | lit)
        by.append(
            [
                rendered(mi, scene, room.views, np.array(record["transform_matrix"]), 4, k)[0]
                for k, record in enumerate(room.views["frames"])
            ]
        )
    shown, other = (np.reshape(pictures, (-1, 3)) for pictures in by)
    true = np.concatenate(
        [
            read_radiance(room.folder / "truth" / record["file_path"]).reshape(-1, 3)
            for record in room.views["frames"]
        ]
    )
    lit = (other > np.median(other, axis=0) / 4).all(axis=1)
    missing = np.median((true - shown)[lit] / other[lit], axis=0)
    return found | {name: np.maximum(missing, 0) for name in hidden}


# ---- what is written ---------------------------------------------------------------------------


def write_truth(folder: Path, mi: Any, scene: Any, materials: list[dict[str, Any]]) -> None:
    bsdfs = {shape.id(): str(shape.bsdf()) for shape in scene.shapes()}
    for material in materials:
        if material["kind"] == "dielectric_coated":
            material["reflects"] = reflected(mi, material["phi"], material["psi"])
    note = (
        "albedo_NN.exr hold Mitsuba's albedo parameter; of coated objects `reflects` says what a "
        "viewer at 0 to 45 degrees gets of it, for parameters 0, .1, ... 1."
    )
    write_json(folder / "materials.json", {"note": note, "objects": materials})
    described = [
        {"id": k, "name": m["name"], "bsdf": bsdfs.get(m["name"], ""), "emitter": m["emitter"]}
        for k, m in enumerate(materials)
    ]
    write_json(folder / "objects.json", described)


def write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def scaled(document: dict[str, Any], scale: float) -> dict[str, Any]:
    """The camera of smaller pictures."""
    width, height = round(document["w"] * scale), round(document["h"] * scale)
    by_x, by_y = width / document["w"], height / document["h"]
    return document | {
        "w": width,
        "h": height,
        **{key: document[key] * by_x for key in ("fl_x", "cx")},
        **{key: document[key] * by_y for key in ("fl_y", "cy")},
    }


def filtered(pictures: tuple[Array, Array, Array]) -> Array:
    """Radiance, filtered along the edges of albedo and normals."""
    radiance, albedo, normal = (picture.astype(np.float32) for picture in pictures)
    return denoise_picture(radiance, np.clip(albedo, 0, 1), normal).astype(np.float64)


def write_views(options: argparse.Namespace, mi: Any, scene: Any, room: Room) -> None:
    document = room.views
    folder, records = options.output / "truth", document["frames"][: options.views]
    for k, record in enumerate(records):
        pose = np.array(record["transform_matrix"])
        samples = max(1, round(VIEW_TIMES * options.samples * options.scale**2))
        pictures = rendered(mi, scene, document, pose, samples, 900 + k + 1000 * options.seed)
        write_exr(folder / record["file_path"], filtered(pictures))
        write_exr(folder / f"albedo_{k:02d}.exr", pictures[1])
    write_json(folder / "views.json", document | {"frames": records})


def write_frames(options: argparse.Namespace, mi: Any, scene: Any, room: Room) -> None:
    """Some of the capture's frames, evenly, as its sensor sees them."""
    document = scaled(room.transforms, options.scale)
    every = document["frames"]
    count = min(options.frames, len(every))
    records = [every[k] for k in np.linspace(0, len(every) - 1, count).round().astype(int)]
    for k, record in enumerate(records):
        pose = np.array(record["transform_matrix"])
        pictures = rendered(mi, scene, document, pose, options.samples, k + 1000 * options.seed)
        clean = filtered(pictures) if options.denoise else pictures[0]
        exposure = record["exposure_time"]
        # The sensor of the sample, with this capture's sensitivity.
        gain = saturation_radiance(exposure) / record["saturation_radiance"]
        rng = np.random.default_rng([options.seed, k])
        taken = photograph(clean * gain, exposure, rng) / gain
        write_exr(options.output / record["file_path"], taken, exposure)
    write_json(options.output / "transforms.json", document | {"frames": records})


if __name__ == "__main__":
    sys.exit(main())
