"""Rooms with truth in one table: base colour, views, lobes with their errors, metals, glass.

    python benchmarks/rooms.py CAPTURE... [-o FOLDER] [--json FILE] [--objects] [-- OPTIONS]

A CAPTURE is a folder with truth/materials.json, views.json, view_NN.exr and albedo_NN.exr, as
`redraw_room.py` writes it. Its asset is FOLDER/<its name>; one that is not there yet is converted,
with OPTIONS of `usdbrdf convert`. --objects: a line per coated object too.

Base colour    at the centres of the held-out views' pixels whose 3 x 3 neighbours show one diffuse
               or coated object that does not emit, of points that three frames see; NRMSE is
               ||x - truth|| / ||truth||. Of coated objects the truth is what reaches a viewer
               without the lobe (``reflects``). A base colour that is missing counts as 0
views          `evaluate` on truth/views.json: mean FLIP, change against the diffuse baseline
phi, psi       as the UsdPreviewSurface has them: roughness^2, F0(ior) / 0.08; stated errors scaled
               alike. Of coated objects whose status is "measured": mean absolute errors, mean
               signed error of psi, slope of found on true psi, shares within 1 and 2 stated errors
diffuse        objects of which three frames show 200 pixels: median psi told to renderers (true 0)
metals         with F0 >= 0.15, seen alike: how many have ``metallic`` > 0.5, their mean F0 error
               (diffuseColor); how many of all other objects are called metallic
glass          and masks, of which it cannot be said: how many are called measured

The last row takes the objects of all captures together.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd, UsdShade
from true_room import of_one_object

import usdbrdf
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import read_fit
from usdbrdf.asset.readers.views import photographs_of_views
from usdbrdf.files.images import read_radiance
from usdbrdf.model.capture import Frames
from usdbrdf.transport.rays import Hits
from usdbrdf.transport.surface_texture import surface_texture

F0_OF_PSI = 0.08
MIN_PIXELS, MIN_FRAMES = 200, 3  # an object that counts has so many pixels in so many frames
LEAST_F0 = 0.15
LEAST_ERROR = 1e-3  # no stated error is taken to be less


def main() -> int:
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    others = sys.argv[split + 1 :]
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("-o", "--output", type=Path, default=Path("benchmark-results/rooms"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--objects", action="store_true")
    options = parser.parse_args(sys.argv[1:split])
    rooms = []
    for capture in options.captures:
        asset = options.output / capture.name
        seconds = None if asset.exists() else converted(capture, asset, others)
        rooms.append(room_figures(capture, asset) | {"cpu_s": seconds})
        print(f"{capture.name}: done", file=sys.stderr)
    rows = [row_of_table(room) for room in rooms]
    every = [one for room in rooms for one in room["objects"]]
    if len(rooms) > 1:
        rows.append(row_of_table({"room": "all", **materials(every)}))
    print(table(rows))
    if options.objects:
        print(lines_of_objects(every))
    if options.json:
        options.json.write_text(json.dumps(rooms, indent=1) + "\n")
    return 0


def converted(capture: Path, asset: Path, options: list[str]) -> float:
    """Seconds of CPU that `usdbrdf convert` took."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    asset.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "usdbrdf", "convert", str(capture), "-o", str(asset), "-q"]
    subprocess.run([*command, *options], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


# ---- one room ----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class RoomObject:
    """Truth of an object, and what its material says; F0 and colour are None where there is none.

    pixels    in the frame that shows the third most
    evidence, samples: of the fit, what an error model may depend on
    """

    room: str
    name: str
    kind: str
    emitter: bool
    true_phi: float
    true_psi: float
    true_f0: list[float] | None
    pixels: int
    status: str
    phi: float
    psi: float
    phi_error: float
    psi_error: float
    metallic: bool
    colour: list[float] | None
    evidence: float
    samples: int

    @property
    def seen(self) -> bool:
        return self.pixels >= MIN_PIXELS

    @property
    def measured(self) -> bool:
        return self.status == "measured"


def room_figures(capture: Path, folder: Path) -> dict[str, Any]:
    asset = Asset.made(folder)
    maps = AssetMaps(open_measured(asset))
    known = json.loads((capture / "truth/materials.json").read_text())["objects"]
    truth = {o["name"]: o for o in known}
    labels = [o.label for o in maps.scene.objects]
    shown = pixels_of_objects(maps)
    objects = [
        room_object(capture.name, maps.stage, o.prim_path, truth[o.label], int(pixels))
        for o, pixels in zip(maps.scene.objects, shown, strict=True)
        if o.label in truth
    ]
    views = photographs_of_views(
        capture / "truth/views.json", asset, maps.stage, maps.scene, Path()
    )
    return {
        "room": capture.name,
        "base_color": base_color(maps, views.frames, capture / "truth", truth, labels),
        "views": views_figures(folder, capture / "truth/views.json"),
        **materials(objects),
        "objects": [asdict(one) for one in objects],
    }


def views_figures(asset: Path, views: Path) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as work:
        found = usdbrdf.evaluate(asset, views, Path(work) / "evaluation")
    flip, count = found["summary"]["flip"], found["summary"]["views"]
    kept = ("full", "change_percent", "worse_views")
    return {"count": count} | {key: flip[key] for key in kept}


def pixels_of_objects(maps: AssetMaps) -> np.ndarray:
    """(O,): pixels in the frame that shows the object's third most."""
    counts = np.array(
        [
            np.bincount(objects[objects >= 0], minlength=len(maps.scene.objects))
            for objects in (objects_seen(maps, maps.frames, i)[1] for i in range(len(maps.frames)))
        ]
    )
    return np.sort(counts, axis=0)[-min(MIN_FRAMES, len(counts))]


def objects_seen(maps: AssetMaps, frames: Frames, i: int) -> tuple[Hits, np.ndarray]:
    """What a frame's pixels show: surfaces, and the numbers of their objects, -1 for none."""
    camera = frames.camera(i)
    hits = maps.surface.rays.closest(*camera.rays(camera.pixels()))
    return hits, np.where(hits.face >= 0, maps.scene.face_object[hits.face], -1)


def room_object(
    room: str, stage: Usd.Stage, path: str, truth: dict[str, Any], pixels: int
) -> RoomObject:
    fit = read_fit(stage, path)
    material = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(path)).ComputeBoundMaterial()[0]
    surface = material.ComputeSurfaceSource()[0] if material else None
    rough, ior, metallic, colour = (
        constant(surface, name) for name in ("roughness", "ior", "metallic", "diffuseColor")
    )
    phi = float(rough[0]) ** 2 if rough is not None else (fit.phi if fit else np.nan)
    f0 = ((ior[0] - 1) / (ior[0] + 1)) ** 2 if ior is not None else np.nan
    psi = float(f0 / F0_OF_PSI) if ior is not None else (fit.psi if fit else np.nan)

    def error(stated: float, found: float, shown: float) -> float:
        return float(np.nan_to_num(stated) * shown / max(found, 1e-3))

    return RoomObject(
        room=room,
        name=truth["name"],
        kind=truth["kind"],
        emitter=truth["emitter"],
        true_phi=truth.get("phi", np.nan),
        true_psi=truth.get("psi", np.nan),
        true_f0=truth.get("f0"),
        pixels=pixels,
        status=fit.status if fit else "unseen",
        phi=phi,
        psi=psi,
        phi_error=error(fit.phi_error, fit.phi, phi) if fit else np.nan,
        psi_error=error(fit.psi_error, fit.psi, psi) if fit else np.nan,
        metallic=metallic is not None and bool(metallic[0] > 0.5),
        colour=None if colour is None or len(colour) != 3 else colour.tolist(),
        evidence=fit.evidence if fit else 0.0,
        samples=fit.num_pixels if fit else 0,
    )


def constant(surface: UsdShade.Shader | None, name: str) -> np.ndarray | None:
    """The numbers of a shader's input; None where it has none or they are a texture."""
    wanted = surface.GetInput(name) if surface else None
    sources = wanted.GetValueProducingAttributes() if wanted else []
    kind = UsdShade.Utils.GetType(sources[0].GetName()) if sources else None
    if kind != UsdShade.AttributeType.Input:
        return None
    return np.array(sources[0].Get(), np.float64).ravel()


def base_color(
    maps: AssetMaps,
    views: Frames,
    folder: Path,
    truth: dict[str, dict[str, Any]],
    labels: Sequence[str],
) -> dict[str, dict[str, float]]:
    """Errors of all, of diffuse and of coated objects' pixels."""
    painted = maps.map_where_present("base_color", 3)
    texture = surface_texture(maps.texels, maps.scene.face_object, painted)
    found, true, kinds, points = [], [], [], []
    for k in range(len(views)):
        hits, objects = objects_seen(maps, views, k)
        pixels = np.array(read_radiance(folder / f"albedo_{k:02d}.exr"), np.float64).reshape(-1, 3)
        height, width = views.resolution[k][::-1]
        counted = of_one_object(objects.reshape(height, width)).ravel()
        counted &= (pixels.max(axis=1) <= 1.001) & (pixels.max(axis=1) > 0.005)
        kind = np.zeros(len(objects), int)
        for number in np.unique(objects[objects >= 0]):
            own, known = objects == number, truth.get(labels[number], {"kind": ""})
            if known["kind"] == "dielectric_coated":
                parameters = np.linspace(0, 1, len(known["reflects"]))
                pixels[own] = np.interp(pixels[own], parameters, known["reflects"])
                kind[own] = 2
            elif known["kind"] == "diffuse":
                kind[own] = 1
            if known.get("emitter"):
                kind[own] = 0
        counted &= kind > 0
        origins, directions = views.camera(k).rays(views.camera(k).pixels())
        found.append(np.nan_to_num(texture.at(hits.face, hits.u, hits.v)[counted], posinf=0))
        true.append(pixels[counted])
        kinds.append(kind[counted])
        points.append((origins + directions * hits.distance[:, None])[counted])
    values, reference, of_kind = map(np.concatenate, (found, true, kinds))
    often = times_seen(maps, np.concatenate(points)) >= MIN_FRAMES
    chosen = {"all": often, "diffuse": often & (of_kind == 1), "coated": often & (of_kind == 2)}
    return {name: errors(values[own], reference[own]) for name, own in chosen.items() if own.any()}


def errors(found: np.ndarray, true: np.ndarray) -> dict[str, float]:
    relative = (found - true) / np.maximum(true, 0.02)
    return {
        "nrmse": float(np.sqrt(((found - true) ** 2).mean() / (true**2).mean())),
        "median_signed": float(np.median(relative)),
        "median_abs": float(np.median(np.abs(relative))),
    }


def times_seen(maps: AssetMaps, points: np.ndarray) -> np.ndarray:
    """(N,): in how many frames the point lies, nothing before it, from either side."""
    seen = np.zeros(len(points), int)
    frames, rays = maps.frames, maps.surface.rays
    for i in range(len(frames)):
        camera = frames.camera(i)
        forward = -camera.world_from_camera[:3, 2]
        before = np.flatnonzero((points - camera.eye) @ forward > 1e-6)
        x, y = camera.project(points[before]).T
        inside = (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)
        own = before[inside]
        directions = np.ascontiguousarray(points[own] - camera.eye, np.float32)
        hits = rays.closest(np.float32(camera.eye)[None], directions)
        seen[own] += (hits.face >= 0) & (np.abs(hits.distance - 1) < 2e-3)
    return seen


# ---- what all objects say ----------------------------------------------------------------------


def materials(objects: Sequence[RoomObject | dict[str, Any]]) -> dict[str, Any]:
    """Figures of lobes, metals and glass; None where no object tells."""
    every = [RoomObject(**o) if isinstance(o, dict) else o for o in objects]
    coated = [o for o in every if o.kind == "dielectric_coated"]
    measured = [o for o in coated if o.measured]
    diffuse = [o for o in every if o.kind == "diffuse" and not o.emitter and o.seen]
    metals = [o for o in every if o.true_f0 is not None and min(o.true_f0) >= LEAST_F0 and o.seen]
    found = [o for o in metals if o.metallic]
    f0_errors = [np.abs(np.subtract(o.colour, o.true_f0)).mean() for o in found if o.colour]
    opaque = [o for o in every if o.kind != "metal"]
    clear = [o for o in every if o.kind in ("glass", "mask")]
    return {
        "coated": len(coated),
        "measured": len(measured),
        "lobes": lobe_figures(measured) if measured else None,
        "diffuse": len(diffuse),
        "diffuse_measured": sum(o.measured for o in diffuse),
        "diffuse_psi": float(np.median([o.psi for o in diffuse])) if diffuse else None,
        "metals": len(metals),
        "metals_found": len(found),
        "f0_error": float(np.mean(f0_errors)) if f0_errors else None,
        "others": len(opaque),
        "others_metallic": sum(o.metallic for o in opaque),
        "clear": len(clear),
        "clear_measured": sum(o.measured for o in clear),
    }


def lobe_figures(measured: Sequence[RoomObject]) -> dict[str, float | None]:
    off = np.array([[o.phi - o.true_phi, o.psi - o.true_psi] for o in measured])
    stated = np.array([[o.phi_error, o.psi_error] for o in measured])
    phi, psi = (np.abs(off) / np.maximum(stated, LEAST_ERROR)).T
    true = np.array([o.true_psi for o in measured])
    tells = len(np.unique(true)) > 2  # a slope
    return {
        "phi_error": float(np.abs(off[:, 0]).mean()),
        "psi_error": float(np.abs(off[:, 1]).mean()),
        "psi_signed": float(off[:, 1].mean()),
        "slope": float(np.polyfit(true, [o.psi for o in measured], 1)[0]) if tells else None,
        "phi_within_1": float((phi < 1).mean()),
        "phi_within_2": float((phi < 2).mean()),
        "psi_within_1": float((psi < 1).mean()),
        "psi_within_2": float((psi < 2).mean()),
    }


# ---- the table ---------------------------------------------------------------------------------


def row_of_table(room: dict[str, Any]) -> dict[str, str]:
    colour, views, lobes = (room.get(key) or {} for key in ("base_color", "views", "lobes"))

    def number(value: float | None, form: str = ".3f") -> str:
        return "-" if value is None else format(value, form)

    def pair(low: str, high: str) -> str:
        return f"{number(lobes.get(low), '.2f')}, {number(lobes.get(high), '.2f')}"

    nrmse = [number(colour.get(k, {}).get("nrmse")) for k in ("diffuse", "coated")]
    return {
        "room": room["room"],
        "base colour: diffuse; coated; signed": "; ".join(
            [*nrmse, number(colour.get("all", {}).get("median_signed"), "+.3f")]
        ),
        "FLIP; change %; worse": "; ".join(
            [
                number(views.get("full")),
                number(views.get("change_percent"), "+.0f"),
                f"{views.get('worse_views', '-')} of {views.get('count', '-')}",
            ]
        ),
        "measured": f"{room['measured']} of {room['coated']}",
        "|phi|; |psi|; psi": "; ".join(
            [
                number(lobes.get("phi_error")),
                number(lobes.get("psi_error")),
                number(lobes.get("psi_signed"), "+.3f"),
            ]
        ),
        "slope": number(lobes.get("slope"), ".2f"),
        "phi within 1, 2": pair("phi_within_1", "phi_within_2"),
        "psi within 1, 2": pair("psi_within_1", "psi_within_2"),
        "diffuse: psi; measured": f"{number(room['diffuse_psi'], '.2f')}; "
        f"{room['diffuse_measured']} of {room['diffuse']}",
        "metals found; F0": f"{room['metals_found']} of {room['metals']}; "
        f"{number(room['f0_error'])}",
        "others metallic": f"{room['others_metallic']} of {room['others']}",
        "clear measured": f"{room['clear_measured']} of {room['clear']}",
        "CPU s": number(room.get("cpu_s"), ".0f"),
    }


def table(rows: Sequence[dict[str, str]]) -> str:
    """One column per room: there are more figures than rooms."""
    names = list(rows[0])
    lines = ["| " + " | ".join(row["room"] for row in [{"room": "figure"}, *rows]) + " |"]
    lines.append("| " + " | ".join("---" for _ in range(len(rows) + 1)) + " |")
    for name in names[1:]:
        lines.append("| " + " | ".join([name, *(row[name] for row in rows)]) + " |")
    return "\n".join(lines)


def lines_of_objects(objects: Sequence[dict[str, Any]]) -> str:
    rows = [RoomObject(**o) for o in objects]
    return "\n".join(
        f"{o.room} {o.name}: true {o.true_phi:.3f} {o.true_psi:.2f} found {o.phi:.3f} +- "
        f"{o.phi_error:.3f}, {o.psi:.2f} +- {o.psi_error:.2f}, {o.status}"
        for o in rows
        if o.kind == "dielectric_coated" and o.seen
    )


if __name__ == "__main__":
    sys.exit(main())
