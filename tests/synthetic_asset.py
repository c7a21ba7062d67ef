"""A small asset with three objects: a box, a wall that nobody saw, and a lamp."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from usdbrdf.asset.header import Draft, Provenance, StageHeader
from usdbrdf.asset.layers.interface import write_contents, write_interface, write_root
from usdbrdf.asset.layers.lights_layer import Lamp, world_from_root, write_lights_layer
from usdbrdf.asset.layers.scan_layer import (
    ScanFiles,
    write_edits,
    write_pending_layer,
    write_scan_layer,
)
from usdbrdf.asset.layers.task_layers import (
    write_material_layer,
    write_shading_layer,
    write_texturing_layer,
    write_uv_layer,
)
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.properties import (
    Aov,
    FittedObject,
    LightFromOutside,
    ShadedObject,
    TexturedObject,
)
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.files.images import write_exr, write_preview_png
from usdbrdf.model.capture import Frames, Scan
from usdbrdf.model.mesh import ObjectLabel, ScanMesh
from usdbrdf.shading.lamp_shapes import lamp_shapes

LABELS = ("Stuhl Nº 1", "wall", "lamp")
IDENTIFIERS = ("Stuhl_No_1", "wall", "lamp")
CLASSES = ("chair", "wall", "")
COLOUR_AOVS = ("lit", "mean")
GREY_AOVS = ("spread", "coverage", "samples")


def box(centre, size):
    """8 points and 12 triangles, counter-clockwise seen from outside."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = np.array([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)], np.int32)
    return (np.array(centre) + signs * size / 2).astype(np.float32), triangles


def flat_normals(points, triangles):
    corner = points[triangles].astype(float)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.repeat(normal[:, None], 3, axis=1).astype(np.float32)


def make_mesh(unit):
    """Three boxes whose faces are interleaved, with a few points that nobody uses."""
    parts = [box((0, 0, 0.5), 1.0), box((0, 3, 1.0), 2.0), box((0, 0, 2.5), 0.3)]
    points = np.concatenate([np.full((2, 3), 9.0, np.float32), *(p for p, _ in parts)]) / unit
    triangles = np.stack([t + 2 + 8 * i for i, (_, t) in enumerate(parts)], axis=1).reshape(-1, 3)
    return ScanMesh(
        points=points.astype(np.float32),
        triangles=triangles.astype(np.int32),
        corner_normals=flat_normals(points, triangles),
        face_object=np.tile(np.arange(3, dtype=np.int32), 12),
    )


def make_frames(folder, unit, num_frames=3):
    """Cameras on a line that look down; the lens and the size change once."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for i in range(num_frames):
        paths.append(folder / f"frame {i:02d} é.exr")
        write_exr(paths[-1], np.full((6, 8, 3), 0.1 + i, np.float32))
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    poses[:, :3, 3] = np.array([[0.1 * i, 0.2, 5.0] for i in range(num_frames)]) / unit
    angle = 0.3
    turn = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    poses[1, :2, :2] = turn
    intrinsics = np.tile([7.1, 7.1, 4.3, 2.9], (num_frames, 1))
    intrinsics[-1, 0:2] = 7.3
    return Frames(
        image_paths=tuple(paths),
        world_from_camera=poses,
        intrinsics=intrinsics,
        resolution=np.tile(np.array([8, 6], np.int32), (num_frames, 1)),
        exposure_time=1.0 / np.array([30, 250, 7] * num_frames, float)[:num_frames],
        saturation_radiance=np.array([3.2, 0.4, 12.8] * num_frames)[:num_frames],
        noise_floor_radiance=np.full(num_frames, 1e-3),
    )


def make_scan(folder, *, unit=1.0, up_axis="Z", num_frames=3, **changes):
    scan = Scan(
        name="room",
        adapter="transforms",
        source=folder,
        mesh=make_mesh(unit),
        objects=tuple(
            ObjectLabel(identifier=i, label=label, class_name=c)
            for i, label, c in zip(IDENTIFIERS, LABELS, CLASSES, strict=True)
        ),
        frames=make_frames(folder / "frames", unit, num_frames),
        meters_per_unit=unit,
        up_axis=up_axis,
        counts={"degenerate_faces": 2},
    )
    return replace(scan, **changes)


def aovs_of(asset, identifier, names):
    """Maps with the files on disk: colour for some, one channel for the others."""
    (asset.folder / "textures").mkdir(exist_ok=True)
    maps = []
    for name in names:
        file = asset.texture(identifier, name)
        shape = (4, 4) if name in (*GREY_AOVS, "stderr") else (4, 4, 3)
        write_exr(asset.folder / file, np.full(shape, 0.25, np.float32))
        scale = 0.5 if name == "samples" else 1.0
        maps.append(Aov(name=name, file=file, scale=scale, unit="W m-2 sr-1"))
    return tuple(maps)


SUN_DIRECTION = (0.48, 0.6, 0.64)
SUN_IRRADIANCE = (12.0, 9.0, 6.0)


def sky_of(asset):
    """Light from outside: a sky that is brighter above and ahead, and a sun."""
    (asset.folder / "textures").mkdir(exist_ok=True)
    picture = np.ones((8, 16, 3), np.float32)
    picture[:4] *= 2
    picture[:, 6:10] *= 3
    write_exr(asset.folder / asset.sky, picture)
    write_exr(asset.folder / asset.sky_confidence, picture[..., :1] * 0)
    return LightFromOutside(
        sky=asset.sky,
        confidence=asset.sky_confidence,
        source="estimated",
        open_share=0.4,
        sky_error=0.2,
        sun_irradiance=SUN_IRRADIANCE,
        sun_direction=SUN_DIRECTION,
        sun_half_angle=0.00465,
        sun_error=0.1,
    )


@dataclass
class Built:
    """An asset on disk and what went into it."""

    asset: Asset
    header: StageHeader
    scan: Scan
    prims: tuple[str, ...]
    textured: tuple[TexturedObject, ...] = ()
    shaded: tuple[ShadedObject, ...] = ()
    fitted: tuple[FittedObject, ...] = ()
    outside: LightFromOutside | None = None

    def draft(self, role):
        provenance = Provenance(
            role=role, version="0.1.0", parameters={"quantile": 0.5}, inputs={"mesh": "0" * 64}
        )
        return Draft(asset=self.asset, header=self.header, provenance=provenance)

    def write_lights(self):
        """Lights for the sides of the lamp, which shines 8, 4, 2 everywhere."""
        mesh = self.scan.mesh
        metres = (mesh.points * self.header.meters_per_unit).astype(np.float32)
        lamps = [
            Lamp(
                prim_path=item.prim_path,
                identifier=item.identifier,
                shapes=lamp_shapes(
                    metres,
                    mesh.triangles[mesh.face_object == i],
                    np.tile(np.float32([8, 4, 2]), (np.sum(mesh.face_object == i), 1)),
                ),
            )
            for i, item in enumerate(self.shaded)
            if item.emitter
        ]
        world = world_from_root(open_weaker(self.asset, "texturing"))
        write_lights_layer(
            self.asset.lights_layer, self.draft("shading"), lamps, self.outside, world
        )

    def write_layer(self, role, path=None):
        """Write (again) the layer of one stage from the kept values."""
        asset = self.asset
        path = path or asset.layer(role)
        draft = self.draft(role)
        if role == "scan":
            files = ScanFiles(
                scan=path,
                interface=asset.interface("scan"),
                photographs=asset.photographs_layer,
                place=self.place,
            )
            write_scan_layer(files, self.scan, draft)
            return
        if role == "texturing":
            scanned = open_weaker(self.asset, "texturing")
            write_uv_layer(self.asset.uv_layer, draft, self.textured, scanned)
            write_texturing_layer(path, draft, self.textured)
        elif role == "shading":
            write_shading_layer(path, draft, self.shaded, self.outside)
            self.write_lights()
        else:
            write_material_layer(path, draft, self.fitted)
        lights = [asset.lights_layer] if role == "shading" else []
        write_interface(asset.interface(role), path, *lights)

    def place(self, relative):
        path = self.asset.folder / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def build(folder: Path, scan: Scan, *, upto="material", prims=None) -> Built:
    """An asset as the pipeline leaves it after the stage ``upto``."""
    asset = Asset.at(folder)
    (folder / "layers").mkdir(parents=True)
    (folder / "previews").mkdir()
    write_preview_png(folder / "previews" / "lit.png", np.full((3, 4, 3), 128, np.uint8))
    header = StageHeader.of_scan(asset.name, scan)
    prims = prims or tuple(f"/{asset.name}/geo/{o.identifier}/{o.identifier}" for o in scan.objects)
    built = Built(asset, header, scan, prims)
    identifiers = [o.identifier for o in scan.objects]
    faces = [np.flatnonzero(scan.mesh.face_object == i) for i in range(len(identifiers))]
    rng = np.random.default_rng(7)
    built.textured = tuple(
        TexturedObject(
            prim_path=prim,
            identifier=name,
            corner_uv=rng.random((len(faces[i]), 3, 2)).astype(np.float32).round(1),
            aovs=() if name == "wall" else aovs_of(asset, name, (*COLOUR_AOVS, *GREY_AOVS)),
            texel_size=0.01,
            seen_fraction=0.0 if name == "wall" else 0.75,
            clipped_fraction=0.125,
            resolution=(4, 4),
            seen=name != "wall",
        )
        for i, (prim, name) in enumerate(zip(prims, identifiers, strict=True))
    )
    built.shaded = tuple(
        ShadedObject(
            prim_path=prim,
            identifier=name,
            aovs=aovs_of(
                asset, name, ("irradiance", "stderr", "emission" if name == "lamp" else "albedo")
            ),
            emitter=name == "lamp",
            radiance=(8.0, 7.0, 6.0) if name == "lamp" else (0.0, 0.0, 0.0),
            radiance_status="estimated" if name == "lamp" else "measured",
            radiance_error=0.125 if name == "lamp" else float("nan"),
            area_fraction=0.5 if name == "lamp" else 0.0,
            mean_albedo=(0.0, 0.0, 0.0) if name == "lamp" else (0.5, 0.25, 0.125),
            rays_per_texel=64.0,
            standard_error=0.03125,
            escaped_fraction=0.25,
        )
        for prim, name in zip(prims, identifiers, strict=True)
    )
    built.fitted = tuple(
        FittedObject(
            prim_path=prim,
            identifier=name,
            phi=float("nan") if name == "wall" else 0.25,
            psi=float("nan") if name == "wall" else 0.5,
            cost=0.5,
            evidence=0.25,
            status="unseen" if name == "wall" else "measured",
            target_frame=-1 if name == "wall" else 2,
            num_pixels=12,
            method="views",
            phi_error=float("nan") if name == "wall" else 0.03125,
            psi_error=float("nan") if name == "wall" else 0.125,
            psi_upper=float("nan") if name == "wall" else 0.75,
            shown_phi=0.25 if name == "lamp" else float("nan"),
            shown_psi=0.5 if name == "lamp" else float("nan"),
            contradiction=0.5 if name == "lamp" else float("nan"),
            phi_confidence="none" if name == "wall" else "high",
            psi_confidence="none" if name == "wall" else "low",
            aovs=aovs_of(asset, name, ("diffuse", "base_color")),
            mean_color=(0.0, 0.0, 0.0) if name == "lamp" else (0.25, 0.125, 0.0625),
        )
        for prim, name in zip(prims, identifiers, strict=True)
    )
    done = ROLES[: ROLES.index(upto) + 1]
    for role in ROLES:
        if role in done:
            built.write_layer(role)
        else:
            beneath = {"texturing": [asset.uv_layer], "shading": [asset.lights_layer]}
            for layer in (asset.layer(role), asset.interface(role), *beneath.get(role, ())):
                write_pending_layer(layer, role, header)
    write_contents(asset.contents_layer, asset, header)
    write_edits(asset.edits_layer, asset, header)
    write_root(asset.root_layer, asset, header)
    return built
