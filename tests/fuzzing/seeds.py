"""Small sound files of every format that is read, by the writers of the other tests."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import OpenImageIO as oiio
import trimesh
from PIL import Image
from pxr import Sdf, Usd, UsdGeom, UsdLux

from tests.capture import (
    test_scan_from_arkitscenes,
    test_scan_from_blocks_exchange,
    test_scan_from_bundler,
    test_scan_from_e57,
    test_scan_from_eyeful_tower,
    test_scan_from_fipt,
    test_scan_from_llff,
    test_scan_from_metashape,
    test_scan_from_opf,
    test_scan_from_pix4d,
    test_scan_from_realityscan,
    test_scan_from_replica,
    test_scan_from_rgbd_scans,
    test_scan_from_scanner_app,
    test_scan_from_scannet,
    test_scan_from_scannetpp,
    test_scan_from_usd_stage,
    test_scan_from_visualsfm,
)
from tests.capture.test_raw_frames import write_dng
from tests.format_truth import Truth, truth, write_image
from tests.relighting.test_model import STAGE_OF_MATERIALS
from tests.scenes import make_capture, write_ply
from usdbrdf.asset.manifest import Manifest, write_manifest
from usdbrdf.files.documents import save_arrays
from usdbrdf.files.images import read_exr, write_preview_png
from usdbrdf.job.stamp import Stamp, write_stamp


@dataclass(frozen=True, kw_only=True)
class Seed:
    """What a reader is given, and which of the files are damaged."""

    entry: Path
    targets: tuple[Path, ...]


@cache
def _room() -> Truth:
    return truth()


def _alone(*paths: Path) -> list[Seed]:
    return [Seed(entry=path, targets=(path,)) for path in paths]


# --- Pictures ------------------------------------------------------------------------------------


def _picture(path: Path, kind: str, channels: int = 3, **attributes: str | int) -> Path:
    """A gradient of 24 x 16 pixels."""
    ramp = np.linspace(0, 1, 24 * 16 * channels, dtype=np.float32).reshape(16, 24, channels)
    pixels = np.round(ramp * 255).astype(np.uint8) if kind == "uint8" else ramp
    spec = oiio.ImageSpec(24, 16, channels, kind)
    for name, value in attributes.items():
        if name in ("x", "y", "full_width", "full_height", "tile_width", "tile_height"):
            setattr(spec, name, value)
        else:
            spec.attribute(name, value)
    path.parent.mkdir(parents=True, exist_ok=True)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(pixels)
    assert output.close()
    return path


def exr(folder: Path) -> list[Seed]:
    made = [
        _picture(folder / f"{name}.exr", "half", compression=name)
        for name in ("none", "rle", "zip", "zips", "piz", "pxr24", "b44", "dwaa")
    ]
    made.append(_picture(folder / "float.exr", "float", 4, compression="zip"))
    made.append(_picture(folder / "tiled.exr", "half", tile_width=8, tile_height=8))
    made.append(_picture(folder / "window.exr", "half", x=5, y=-3, full_width=40, full_height=20))
    parts = folder / "parts.exr"
    specs = [oiio.ImageSpec(8, 8, 1, "half"), oiio.ImageSpec(8, 8, 3, "half")]
    specs[0].channelnames = ("Z",)
    output = oiio.ImageOutput.create(str(parts))
    assert output.open(str(parts), specs)
    for number, spec in enumerate(specs):
        if number:
            assert output.open(str(parts), spec, "AppendSubimage")
        assert output.write_image(np.ones((8, 8, spec.nchannels), np.float32))
    assert output.close()
    return _alone(*made, parts)


def hdr(folder: Path) -> list[Seed]:
    return _alone(_picture(folder / "a.hdr", "float"), _picture(folder / "b.hdr", "float", rgbe=1))


def png(folder: Path) -> list[Seed]:
    grey = _picture(folder / "grey.png", "uint8", 1)
    return _alone(
        _picture(folder / "a.png", "uint8"), _picture(folder / "rgba.png", "uint16", 4), grey
    )


def jpeg(folder: Path) -> list[Seed]:
    plain = _picture(folder / "a.jpg", "uint8", ExposureTime=1, Copyright="me")
    buffer = io.BytesIO()
    with Image.open(plain) as image:
        image.save(buffer, "jpeg", progressive=True, quality=90)
    (folder / "progressive.jpg").write_bytes(buffer.getvalue())
    return _alone(plain, folder / "progressive.jpg")


def tiff(folder: Path) -> list[Seed]:
    made = [
        _picture(folder / f"{name}.tif", kind, compression=name)
        for name, kind in (("none", "uint8"), ("lzw", "uint16"), ("zip", "float"))
    ]
    tiled = _picture(folder / "tiled.tif", "half", tile_width=16, tile_height=16)
    return _alone(*made, tiled, _picture(folder / "jpeg.tif", "uint8", compression="jpeg"))


def dng(folder: Path) -> list[Seed]:
    folder.mkdir(parents=True)
    write_dng(folder / "a.dng", 0.02)
    return _alone(folder / "a.dng")


def video(folder: Path) -> list[Seed]:
    """Three frames, in two containers."""
    import av

    folder.mkdir(parents=True)
    made = [folder / "a.mp4", folder / "a.mkv"]
    codes = np.random.default_rng(0).integers(0, 255, (3, 48, 64, 3), np.uint8)
    for path, codec in zip(made, ("mpeg4", "ffv1"), strict=True):
        with av.open(str(path), "w") as container:
            stream = container.add_stream(codec, rate=30)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            for picture in codes:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())
    return _alone(*made)


def pictures(folder: Path) -> list[Seed]:
    """Of every format, with metadata."""
    made = [*exr(folder)[2:4], *hdr(folder), *png(folder), *jpeg(folder), *tiff(folder)]
    return [*made, *_alone(_picture(folder / "told.png", "uint8", Artist="me", Software="it"))]


def lights(folder: Path) -> list[Seed]:
    """Pictures that hold radiance."""
    return [seed for seed in (*exr(folder), *hdr(folder)) if "window" not in seed.entry.name]


# --- Meshes --------------------------------------------------------------------------------------


def ply(folder: Path) -> list[Seed]:
    folder.mkdir(parents=True)
    box = trimesh.creation.box((0.2, 0.4, 0.6))
    write_ply(folder / "ours.ply", box.vertices, box.faces, np.zeros(len(box.faces)))
    box.visual.vertex_colors = np.tile(np.array([[255, 128, 64, 255]], np.uint8), (8, 1))
    box.export(folder / "binary.ply")
    box.export(folder / "ascii.ply", encoding="ascii")
    return _alone(*sorted(folder.iterdir()))


def obj(folder: Path) -> list[Seed]:
    _picture(folder / "red.png", "uint8")
    box = trimesh.creation.box((0.2, 0.4, 0.6))
    (folder / "box.mtl").write_text("newmtl red\nKd 0.8 0.2 0.1\nNs 20\nmap_Kd red.png\n")
    rows = [f"v {x} {y} {z}" for x, y, z in box.vertices]
    rows += ["vt 0 0", "vt 1 0", "vt 1 1", "vn 0 0 1", "o box", "usemtl red"]
    rows += [f"f {a + 1}/1/1 {b + 1}/2/1 {c + 1}/3/1" for a, b, c in box.faces[:6]]
    rows += ["g other", *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in box.faces[6:])]
    (folder / "box.obj").write_text("\n".join(["mtllib box.mtl", *rows]) + "\n")
    targets = (folder / "box.obj", folder / "box.obj", folder / "box.mtl")
    return [Seed(entry=folder / "box.obj", targets=targets)]


def glb(folder: Path) -> list[Seed]:
    folder.mkdir(parents=True)
    box = trimesh.creation.box((0.2, 0.4, 0.6))
    box.export(folder / "plain.glb")
    picture = Image.fromarray(np.full((4, 4, 3), 99, np.uint8))
    box.visual = trimesh.visual.TextureVisuals(
        uv=np.random.default_rng(0).random((8, 2)),
        material=trimesh.visual.material.PBRMaterial(
            baseColorTexture=picture, metallicRoughnessTexture=picture, roughnessFactor=0.4
        ),
    )
    scene = trimesh.Scene()
    scene.add_geometry(box, transform=np.diag([1.0, -1, 2, 1]))
    scene.export(folder / "textured.glb")
    return _alone(*sorted(folder.glob("*.glb")))


def labelled_ply(folder: Path) -> list[Seed]:
    room = _room()
    scene = test_scan_from_replica.write_scene(folder / "data" / "room0", room)
    test_scan_from_replica.write_semantics(scene, room)
    return _alone(scene / "habitat" / "mesh_semantic.ply")


# --- Captures ------------------------------------------------------------------------------------


def _capture(entry: Path, *names: str) -> list[Seed]:
    root = entry if entry.is_dir() else entry.parent
    targets = [path for name in names for path in sorted(root.glob(name))]
    assert targets
    return [Seed(entry=entry, targets=tuple(targets))]


def transforms(folder: Path) -> list[Seed]:
    """Our own document, one with a lens, one as nerfstudio writes them, and of other lenses."""
    made = [
        make_capture(folder / name, frames=8, size=(12, 10), subdivisions=1)
        for name in ("own", "lens", "nerfstudio")
    ]
    document = json.loads(made[1].manifest.read_text("utf-8"))
    document |= {"camera_model": "OPENCV", "k1": 0.01, "k2": 0.001, "p1": 1e-4, "p2": 0.0}
    made[1].manifest.write_text(json.dumps(document))
    document = json.loads(made[2].manifest.read_text("utf-8"))
    document |= {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 1.0, "k1": 0.0}
    document["frames"][0] |= {"mask_path": "mask.png", "distortion_params": [0.0] * 6}
    write_preview_png(made[2].folder / "mask.png", np.full((10, 12, 3), 255, np.uint8))
    made[2].manifest.write_text(json.dumps(document))
    folders = [each.folder for each in made]
    folders += [_other_lens(folder / name, changes) for name, changes in OTHER_LENSES.items()]
    return [s for each in folders for s in _capture(each, "transforms.json")]


# What documents say of other cameras; what is None they leave out.
OTHER_LENSES: dict[str, dict[str, object]] = {
    "fisheye": {
        "camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k4": 1e-4, "encoding": "lin_rec709_scene",
    },
    "listed": {"camera_model": "FISHEYE624", "distortion_params": [1e-3] * 12},
    "rational": {"camera_model": "FULL_OPENCV", "k4": 0.01, "k5": 0.0, "k6": 0.001},
    "sphere": {"camera_model": "EQUIRECTANGULAR", "up_axis": "Z", "meters_per_unit": 1.0},
    "angles": {
        "w": None, "h": None, "fl_x": None, "camera_angle_x": 1.39, "camera_angle_y": 1.2,
        "objects": "objects.json", "mesh": "mesh.ply",
    },
    "unsized": {"w": None, "h": None, "camera_angle_x": 1.39},
}  # fmt: skip


def _other_lens(folder: Path, changes: Mapping[str, object]) -> Path:
    size = (32, 16) if changes.get("camera_model") == "EQUIRECTANGULAR" else (12, 10)
    made = make_capture(folder, frames=8, size=size, subdivisions=1)
    document = json.loads(made.manifest.read_text("utf-8")) | changes
    told = {key: value for key, value in document.items() if value is not None}
    told["frames"][0] |= {"captured_transform_matrix": told["frames"][0]["transform_matrix"]}
    made.manifest.write_text(json.dumps(told))
    if "fl_x" in told:
        return folder
    # As of nerfstudio before it said what it did to COLMAP's axes.
    (folder / "colmap" / "sparse" / "0").mkdir(parents=True)
    return folder


def photographs(folder: Path) -> list[Seed]:
    """8-bit frames, which say so, found without their suffix, with what they leave out."""
    made = make_capture(folder / "a", frames=8, size=(12, 10), subdivisions=1)
    document = json.loads(made.manifest.read_text("utf-8")) | {"encoding": "srgb_rec709_scene"}
    for frame in document["frames"]:
        picture = folder / "a" / frame["file_path"]
        shown = read_exr(picture)[..., :3]
        shown = np.round(255 * shown / shown.max()).astype(np.uint8)
        write_preview_png(picture.with_suffix(".png"), shown)
        picture.unlink()
        for key in ("exposure_time", "saturation_radiance", "noise_floor_radiance"):
            frame.pop(key)
        frame["file_path"] = frame["file_path"].removesuffix(".exr")
    made.manifest.write_text(json.dumps(document))
    return _capture(made.folder, "transforms.json")


def objects(folder: Path) -> list[Seed]:
    """objects.json beside a mesh with labels, with directives and with a label for each face."""
    made = make_capture(folder / "a", frames=8, size=(12, 10), subdivisions=1)
    document = json.loads((made.folder / "objects.json").read_text("utf-8"))
    document["objects"][0]["directive"] = "metal"
    document["face_object_id"] = made.face_object.tolist()
    (made.folder / "objects.json").write_text(json.dumps(document))
    return _capture(made.folder, "objects.json")


def colmap_text(folder: Path) -> list[Seed]:
    scene = test_scan_from_scannetpp.write_scene(folder / "0a", _room())
    model = folder / "capture"
    shutil.copytree(scene / "dslr" / "resized_images", model / "images")
    shutil.copytree(scene / "dslr" / "colmap", model / "sparse" / "0")
    shutil.copy(scene / "scans" / "mesh_aligned_0.05.ply", model / "mesh.ply")
    cameras = model / "sparse" / "0" / "cameras.txt"
    cameras.write_text(cameras.read_text() + "2 OPENCV 32 24 20 20 16 12 0.1 0 0 0\n")
    return _capture(model, "sparse/0/cameras.txt", "sparse/0/images.txt")


def colmap_binary(folder: Path) -> list[Seed]:
    import pycolmap

    (seed,) = colmap_text(folder)
    sparse = seed.entry / "sparse" / "0"
    pycolmap.Reconstruction(str(sparse)).write_binary(str(sparse))
    for text in sparse.glob("*.txt"):
        text.unlink()
    return _capture(seed.entry, "sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/rigs.bin",
                    "sparse/0/frames.bin")  # fmt: skip


def colmap(folder: Path) -> list[Seed]:
    """As text and as binary files, and with every lens that COLMAP knows."""
    return [
        *colmap_text(folder / "text"),
        *colmap_binary(folder / "binary"),
        *_colmap_lenses(folder / "lenses"),
        *_colmap_beside(folder / "beside"),
    ]


def _colmap_lenses(folder: Path) -> list[Seed]:
    """An image through each lens, whose distortion is none, with a mask, and a second model."""
    import pycolmap

    from tests.capture import test_scan_from_colmap

    names = sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"})
    made = make_capture(folder, frames=len(names) + 8, size=(12, 10), subdivisions=1)
    cameras = []
    for name in (*names, *["PINHOLE"] * 8):
        model = pycolmap.CameraModelId.__members__[name]
        cameras.append(pycolmap.Camera.create_from_model_id(1, model, 9.0, 12, 10))
    (folder / "images").mkdir()
    pictures = [f"{i:04d}.exr" for i in range(len(cameras))]
    for i, name in enumerate(pictures):
        made.image(i).rename(folder / "images" / name)
    made.manifest.unlink()
    whole = test_scan_from_colmap.reconstruction(made, cameras, pictures)
    test_scan_from_colmap.write_model(folder / "sparse" / "0", whole, text=True)
    part = test_scan_from_colmap.reconstruction(made, cameras[:3], pictures[:3])
    test_scan_from_colmap.write_model(folder / "sparse" / "1", part, text=True)
    (folder / "masks").mkdir()
    write_preview_png(folder / "masks" / "0003.exr.png", np.full((10, 12, 3), 255, np.uint8))
    return _capture(folder, "sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/1/cameras.txt")


def _colmap_beside(folder: Path) -> list[Seed]:
    """A model with a lens, and that of its images undistorted in dense/."""
    from tests.capture import test_scan_from_colmap

    made = test_scan_from_colmap.colmap_capture(folder, text=True)
    dense = test_scan_from_colmap.undistorted_beside(made)
    targets = [folder / "sparse" / "0" / name for name in ("cameras.txt", "images.txt")]
    targets += sorted((dense / "sparse").glob("*.bin"))[:2]
    return [Seed(entry=folder, targets=tuple(targets))]


def scanner_app(folder: Path) -> list[Seed]:
    export, _ = test_scan_from_scanner_app.make_export(folder)
    return _capture(export, "frame_*.json")


def eyeful_tower(folder: Path) -> list[Seed]:
    rig = test_scan_from_eyeful_tower.write_rig(folder / "office", _room())
    return _capture(rig, "cameras.json")


def fipt(folder: Path) -> list[Seed]:
    first = test_scan_from_fipt.write_photographed(folder / "classroom", _room())
    second = test_scan_from_fipt.write_rendered(folder / "kitchen", _room())
    return [
        *_capture(first, "cam.txt", "K_list.txt"),
        *_capture(second, "train/transforms.json", "val/transforms.json"),
    ]


def llff(folder: Path) -> list[Seed]:
    return _capture(
        test_scan_from_llff.write_llff(folder / "head", _room().centred()), "poses_bounds.npy"
    )


def nice_slam(folder: Path) -> list[Seed]:
    scene = test_scan_from_replica.write_scene(folder / "data" / "room0", _room())
    return [Seed(entry=scene, targets=(scene / "traj.txt", scene.parent / "cam_params.json"))]


def replica(folder: Path) -> list[Seed]:
    room = _room()
    scene = test_scan_from_replica.write_scene(folder / "data" / "room0", room)
    test_scan_from_replica.write_semantics(scene, room)
    (scene.parent / "room0_mesh.ply").rename(scene / "mesh.ply")
    border = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    (scene / "glass.sur").write_text(json.dumps([{"plane_w": [0, 0, 1, 0], "boundary_w": border}]))
    return _capture(scene, "habitat/info_semantic.json", "glass.sur")


def scannetpp(folder: Path) -> list[Seed]:
    scene = test_scan_from_scannetpp.write_scene(folder / "0a5c", _room())
    return _capture(scene, "scans/segments.json", "scans/segments_anno.json")


def scannet(folder: Path) -> list[Seed]:
    scene = test_scan_from_scannet.write_scene(folder / "scene0000_00", _room())
    lens = "intrinsic/intrinsic_color.txt"
    return _capture(scene, "pose/3.txt", lens, "scene0000_00.txt", "*.aggregation.json")


def metashape(folder: Path) -> list[Seed]:
    return _capture(test_scan_from_metashape.write_project(folder / "p", _room()), "cameras.xml")


def realityscan(folder: Path) -> list[Seed]:
    room = _room().square()
    pictures = test_scan_from_realityscan.write_pictures(folder / "table", room)
    table = test_scan_from_realityscan.write_table(pictures, room)
    beside = test_scan_from_realityscan.write_sidecars(folder / "xmp", room, as_attributes=True)
    return [*_capture(table, "registration.csv"), *_capture(beside, "images/*.xmp")]


def _document(folder: Path, module: ModuleType, name: str, **more: Any) -> list[Seed]:
    """Of a program that reconstructs photographs, by the writer of its test."""
    room = _room().centred()
    module._write(folder, room, module._document(room, **more))
    return _capture(folder, name)


def blocks_exchange(folder: Path) -> list[Seed]:
    lens = "<Distortion><K1>-0.01</K1><P1>0.001</P1></Distortion>"
    seeds = _document(folder, test_scan_from_blocks_exchange, "block.xml", extra=lens)
    text = "<SRS/><SRSOrigin>0,0,0</SRSOrigin>"
    (folder / "metadata.xml").write_text(f"<ModelMetadata version='1'>{text}</ModelMetadata>")
    return [*seeds, *_capture(folder, "metadata.xml")]


def bundler(folder: Path) -> list[Seed]:
    seeds = _document(folder, test_scan_from_bundler, "bundle.out", k1=-0.01)
    return [*seeds, *_capture(folder, "list.txt")]


def pix4d(folder: Path) -> list[Seed]:
    return _document(folder, test_scan_from_pix4d, test_scan_from_pix4d.PARAMETERS)


def arkitscenes(folder: Path) -> list[Seed]:
    test_scan_from_arkitscenes._write(folder, _room(), frames=".")
    return _capture(folder, "lowres_wide.traj", "lowres_wide_intrinsics/*.pincam")


def opf(folder: Path) -> list[Seed]:
    room = _room().square()
    test_scan_from_opf._write(folder, room, test_scan_from_opf._documents(room))
    return _capture(folder, "room.opf", "parts/*.json")


def rgbd_scan(folder: Path) -> list[Seed]:
    """One of each program, with its documents."""
    written = test_scan_from_rgbd_scans
    room, seeds = _room(), []
    documents = {
        "record3d": ("metadata",),
        "stray": ("odometry.csv", "camera_matrix.csv"),
        "matterport": ("matterport_camera_poses/*", "matterport_camera_intrinsics/*"),
        "log": ("trajectory.log", "intrinsic.json"),
    }
    for name in documents:
        getattr(written, f"_write_{name}")(folder / name, room)
        seeds += _capture(folder / name, *documents[name])
    return seeds


def visualsfm(folder: Path) -> list[Seed]:
    return _document(folder, test_scan_from_visualsfm, "room.nvm", k=-0.01)


def e57(folder: Path) -> list[Seed]:
    survey = test_scan_from_e57.write_survey(folder / "survey", _room())
    more = test_scan_from_e57.write_survey(folder / "more", _room())
    pinholes = test_scan_from_e57._pinholes(_room())
    sphere = {"imageWidth": 32, "imageHeight": 16, "pixelWidth": np.pi / 16,
              "pixelHeight": np.pi / 16}  # fmt: skip
    around = {"name": "around", "pose": pinholes[0]["pose"], "sphericalRepresentation": sphere}
    absent = {**pinholes[0], "name": "not there"}
    test_scan_from_e57._write(more / "scan.e57", [*pinholes, around, absent])
    pixels = np.random.default_rng(0).random((16, 32, 3), np.float32)
    write_image(more / "images" / "around.jpg", pixels)
    return [*_capture(survey / "scan.e57", "scan.e57"), *_capture(more, "scan.e57")]


# --- USD -----------------------------------------------------------------------------------------


def stages(folder: Path) -> list[Seed]:
    """A room with cameras, as text, as crate and in a package."""
    room = _room()
    room = replace(room, world_from_camera=room.world_from_camera[:3])
    paths = [folder / name for name in ("room.usda", "crate.usdc")]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        stage = test_scan_from_usd_stage.make_stage(path, room, parts=path.suffix == ".usda")
        test_scan_from_usd_stage.many_cameras(stage, room)
        mesh = UsdGeom.Mesh(next(prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)))
        UsdGeom.Subset.CreateGeomSubset(mesh, "part", "face", [0, 1], "objects")
        mesh.GetPrim().CreateAttribute("semantics:labels:class", Sdf.ValueTypeNames.TokenArray).Set(
            ["wall"]
        )
        stage.Save()
    packed = package(folder / "package.usdz", {"room.usda": paths[0].read_bytes()})
    several = folder / "several"
    several.mkdir()
    for name, text in LAYERS.items():
        (several / name).write_text(text)
    together = package(
        folder / "layers.usdz", {name: text.encode() for name, text in LAYERS.items()}
    )
    targets = tuple(several / name for name in LAYERS)
    return [*_alone(*paths, packed, together), Seed(entry=targets[0], targets=targets)]


# What stages are made of: layers that name each other in all ways, meshes with all that they may
# say, what is not one, labels of both kinds, cameras with plates.
LAYERS = {
    "root.usda": """#usda 1.0
(
    defaultPrim = "scan"
    metersPerUnit = 0.01
    upAxis = "Y"
    subLayers = [@./below.usda@]
)
def Xform "scan" (
    prepend apiSchemas = ["SemanticsAPI:kind"]
)
{
    string semantic:kind:params:semanticType = "class"
    string semantic:kind:params:semanticData = "room"
    def Xform "first" (instanceable = true
        prepend references = @./part.usda@</part>) {}
    def Xform "second" (instanceable = true
        prepend payload = @part.usda@) {
        float3 xformOp:scale = (1, -1, 2)
        uniform token[] xformOpOrder = ["xformOp:scale"]
    }
    def PointInstancer "copies" (active = false) {}
    def Mesh "hidden"
    {
        token visibility = "invisible"
    }
    def Mesh "guide"
    {
        uniform token purpose = "guide"
    }
    def Sphere "ball" {}
    def Camera "eye" (prepend apiSchemas = ["BackPlateAPI:still"])
    {
        float focalLength = 35
        float verticalAperture = 24
        asset backPlate:still:image = @./plates/one.exr@
        asset houdini:backgroundimage = @plates/two.exr@
        float exposure = 1
    }
    def Camera "moving"
    {
        asset usdBrdf:capture:image.timeSamples = { 1: @./a.exr@, 2: @./b.exr@ }
        double3 xformOp:translate.timeSamples = { 1: (0, 0, 0), 2: (1, 0, 0) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Camera "flat"
    {
        token projection = "orthographic"
    }
}
""",
    "below.usda": """#usda 1.0
(
    expressionVariables = { string WHICH = "part" }
)
over "scan"
{
    over "first" (variants = { string look = "a" }
        prepend variantSets = "look")
    {
        variantSet "look" = {
            "a" {
                float a = 1
            }
            "b" (prepend references = @./part.usda@) {
                float a = 2
            }
        }
    }
}
""",
    "part.usda": """#usda 1.0
(
    defaultPrim = "part"
)
def Xform "part"
{
    def Mesh "cage" (prepend apiSchemas = ["SkelBindingAPI"])
    {
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1)]
        int[] faceVertexCounts = [4, 3, 4]
        int[] faceVertexIndices = [0, 1, 2, 3, 0, 4, 5, 0, 1, 5, 4]
        int[] holeIndices = [1]
        uniform token orientation = "leftHanded"
        normal3f[] normals = [(0, 0, 1)] (interpolation = "constant")
        uniform token[] semantics:labels:category = ["wall", "plaster"]
        def GeomSubset "some"
        {
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            int[] indices = [0]
        }
        def GeomSubset "others"
        {
            uniform token elementType = "face"
            uniform token familyName = "objects"
            int[] indices = [0, 2]
            token[] semantics:labels:class = ["floor"]
        }
    }
    def Mesh "plain"
    {
        point3f[] points.timeSamples = {
            1: [(0, 0, 0), (1, 0, 0), (0, 1, 0)], 2: [(0, 0, 0), (2, 0, 0), (0, 1, 0)],
        }
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        uniform token subdivisionScheme = "none"
        normal3f[] primvars:normals = [(0, 0, 1), (0, 1, 1), (1, 0, 1)] (interpolation = "vertex")
        int[] primvars:normals:indices = [0, 1, 2]
    }
}
""",
}


def package(path: Path, entries: Mapping[str, bytes]) -> Path:
    """A USDZ: entries stored, their contents at multiples of 64 bytes."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_STORED) as archive:
        for name, content in entries.items():
            item = zipfile.ZipInfo(name)
            padding = -(made.tell() + 30 + len(name) + 4) % 64
            item.extra = b"\x86\x19" + padding.to_bytes(2, "little") + bytes(padding)
            archive.writestr(item, content)
    path.write_bytes(made.getvalue())
    return path


def stage_with_pictures(folder: Path) -> list[Seed]:
    """A stage as a capture: cameras by the names of their pictures, one with back plates, one by
    the numbers of its pictures."""
    room, found = _room(), []
    for name in ("still", "moving", "numbered"):
        stage = test_scan_from_usd_stage.make_stage(folder / name / "room.usda", room)
        if name == "still":
            test_scan_from_usd_stage.many_cameras(stage, room)
        else:
            plates = [f"./images/IMG-{i:03d}.exr" for i in range(101, 101 + len(room.images))]
            named = plates if name == "moving" else None
            test_scan_from_usd_stage.moving_camera(stage, room, named)
        stage.Save()
        first = 0 if name == "still" else 101
        for i, image in enumerate(room.images, first):
            write_image(folder / name / "images" / f"IMG-{i:03d}.exr", image)
        alone = name == "numbered"  # the only stage in its folder
        entry = folder / name if alone else folder / name / "room.usda"
        found.append(Seed(entry=entry, targets=(folder / name / "room.usda",)))
    return found


def materials(folder: Path) -> list[Seed]:
    """A model with materials, and lights of all kinds."""
    _picture(folder / "glow.exr", "half")
    (folder / "thing.usda").write_text(STAGE_OF_MATERIALS)
    stage = Usd.Stage.CreateNew(str(folder / "lights.usdc"))
    for kind in ("RectLight", "DiskLight", "SphereLight", "CylinderLight", "DistantLight"):
        light = UsdLux.LightAPI(stage.DefinePrim(f"/{kind}", kind))
        light.CreateIntensityAttr(3.0)
        light.CreateColorTemperatureAttr(4000.0)
    dome = UsdLux.DomeLight.Define(stage, "/dome")
    dome.CreateTextureFileAttr("glow.exr")
    stage.GetRootLayer().Save()
    stage.GetRootLayer().Export(str(folder / "lights.usda"))
    return _alone(folder / "thing.usda", folder / "lights.usda", folder / "lights.usdc")


REVIEW = """#usda 1.0
(
    customLayerData = {string tool = "usdbrdf"}
)
over "room" (
    customData = {dictionary usdbrdf = {dictionary review = {
        string verdict = "wrong"
        string comment = "a mirror, \\"seen\\" once"
        string directive = "mirror"
        string status = "measured"
        double phi = 0.2
        double psi = 0.04
    }}}
)
{
    over "box"
    {
    }
}
"""


def review(folder: Path) -> list[Seed]:
    folder.mkdir(parents=True)
    (folder / "review.usda").write_text(REVIEW)
    return [Seed(entry=folder, targets=(folder / "review.usda",))]


# --- Records -------------------------------------------------------------------------------------


def stamps(folder: Path) -> list[Seed]:
    folder.mkdir(parents=True)
    stamp = Stamp(
        stage="shade", version="1", parameters={"a": [1, 2.5]}, inputs={"capture": "0" * 64},
        outputs={"layers/shading.usda": "1" * 64},
    )  # fmt: skip
    write_stamp(folder / "30-shade.json", stamp)
    return _alone(folder / "30-shade.json")


def manifests(folder: Path) -> list[Seed]:
    folder.mkdir(parents=True)
    manifest = Manifest(
        name="room", version="3", identifier="room", texture_space="lin_rec709_scene",
        photographs=False, content="0" * 64, files={"room.usda": "1" * 64},
    )  # fmt: skip
    write_manifest(folder, manifest)
    return [Seed(entry=folder, targets=tuple(folder.iterdir()))]


def arrays(folder: Path) -> list[Seed]:
    folder.mkdir(parents=True)
    save_arrays(folder / "a.npz", {"albedo": np.ones((5, 3), np.float32), "n": np.arange(9)})
    return _alone(folder / "a.npz")


def known_objects(folder: Path) -> list[Seed]:
    folder.mkdir(parents=True)
    row = {"name": "box", "id": 1, "phi": 0.2, "psi": 0.04, "emission": [0.0, 0.0, 0.0]}
    (folder / "objects.json").write_text(json.dumps([row, {**row, "name": "lamp", "id": 2}]))
    return [Seed(entry=folder, targets=(folder / "objects.json",))]


def matrices(folder: Path) -> list[Seed]:
    folder.mkdir(parents=True)
    (folder / "matrix.txt").write_text("1 0 0 0.5\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    return _alone(folder / "matrix.txt")


NEEDS = {
    **dict.fromkeys(("colmap", "colmap_text", "colmap_binary", "scannetpp"), "pycolmap"),
    **{"e57": "pye57", "dng": "rawpy", "video": "av"},
}


def missing(seeds: str) -> str:
    """The package that this kind of file cannot be read without here, "" if none is missing."""
    needed = NEEDS.get(seeds, "")
    return needed if needed and find_spec(needed) is None else ""
