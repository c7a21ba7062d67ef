"""The scene for Mitsuba itself: loaded by Mitsuba alone, it shows what ``relight`` shows."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from tests.json_schemas import checked
from tests.relighting.scenes import material
from usdbrdf.cli import main
from usdbrdf.errors import OwnershipConflict
from usdbrdf.files.images import read_exr
from usdbrdf.model.camera import Camera
from usdbrdf.model.light import DistantLight, RelitScene, ShapeLight, SkyLight
from usdbrdf.model.material import Surface, constant_map
from usdbrdf.options import RelightOptions
from usdbrdf.relighting.relight import relight
from usdbrdf.relighting.render import mitsuba_scene, mitsuba_variant, render_view
from usdbrdf.relighting.scene_file import write_scene_file

SPP = 256


def rendered(mi, file, sensor=0):
    scene = mi.load_file(str(file), optimize=False)
    image = mi.render(scene, sensor=scene.sensors()[sensor], spp=SPP, seed=3)
    return np.array(image, np.float64)[..., :3]


def plane(height, size, rng, **changes):
    """A square with random maps, corner normals up."""
    points = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float) * size / 2
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)[triangles]
    up = np.tile(np.float32([0, 0, 1]), (2, 3, 1))
    look = material(0.5, phi=0.15, psi=0.8)
    maps = {
        "diffuse": rng.uniform(0.1, 0.9, (6, 5, 3)).astype(np.float32),
        "roughness": rng.uniform(0.3, 0.6, (4, 4, 1)).astype(np.float32),
    }
    made = Surface(
        name="/room/a--plane",
        points=np.c_[points, np.full(4, height)],
        triangles=triangles,
        corner_normals=up,
        corner_uv=uv,
        material=type(look)(**{**vars(look), **maps}),
    )
    return type(made)(**{**vars(made), **changes})


def scene_of_everything():
    """A textured floor, a coloured one, a lamp that is a mesh, one of each light."""
    rng = np.random.default_rng(4)
    floor, table = plane(0, 4, rng), plane(0.5, 1, rng, two_sided=False)
    colours = rng.uniform(0.2, 0.8, (2, 3, 3)).astype(np.float32)
    plain = material(1.0, phi=0.3, psi=0.4)
    table = type(table)(**{**vars(table), "corner_colour": colours, "material": plain})
    lamp = plane(2.5, 0.7, rng, corner_uv=None, material=material(0.0, emission=3.0))
    pose = np.eye(4)
    pose[:3, 3] = (1.2, 0, 1.0)
    pose[:3, :3] *= 0.2
    towards = np.array([0.3, 0.2, -1.0]) / np.linalg.norm([0.3, 0.2, -1.0])
    irradiance = np.float32([0.5, 0.4, 0.3])
    sky = np.tile(np.linspace(0.6, 0.1, 8, dtype=np.float32)[:, None, None], (1, 16, 3))
    sky[:, :4] *= np.float32([3, 1, 1])
    lights = (
        ShapeLight(kind="sphere", world_from_here=pose, emission=constant_map(2.0)),
        ShapeLight(
            kind="rectangle",
            world_from_here=pose @ np.diag([1.0, -1, -1, 1]),
            emission=rng.uniform(0, 3, (4, 4, 3)).astype(np.float32),
        ),
        DistantLight(towards=towards, irradiance=irradiance, half_angle=0.0),
        DistantLight(towards=towards * [-1, 1, 1], irradiance=irradiance, half_angle=0.05),
        SkyLight(image=sky, world_from_here=np.eye(3)[:, [2, 0, 1]]),
    )
    return RelitScene(surfaces=(floor, table, lamp), lights=lights)


def camera(name="eye", pixels=(24.0, 24.0)):
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, -0.8, 0.6], [0, -0.6, -0.8]]
    pose[:3, 3] = (0, -2.2, 2.4)
    return Camera(
        name=name, world_from_camera=pose, intrinsics=(*pixels, 15.0, 13.0), width=32, height=24
    )


def test_loaded_by_mitsuba_alone_it_is_the_same_scene(tmp_path):
    mi = mitsuba_variant("scalar_rgb")
    scene, eye = scene_of_everything(), camera()
    file = tmp_path / "made" / "room.xml"
    count = write_scene_file(
        mi, file, scene, (eye, camera("wide", (24.0, 12.0))), bounces=6, samples=4
    )
    beside = file.with_name("room.files")
    assert count == len(list(beside.iterdir())) >= 3 + 4
    assert [p.name for p in file.parent.iterdir() if p.name.startswith(".")] == []
    ours = render_view(
        mi, mitsuba_scene(mi, scene, bounces=6), eye, samples=SPP, seed=(1,), label="ours"
    )[0]
    theirs = rendered(mi, file)
    assert theirs.shape == ours.shape
    assert theirs.min() > 0
    # The same estimator of the same scene: the mean differs by noise alone, and so do pixels.
    assert theirs.mean(axis=(0, 1)) == pytest.approx(ours.mean(axis=(0, 1)), rel=0.01)
    assert np.median(np.abs(theirs / ours - 1)) < 0.06
    # Rows of square pixels where the camera's are not.
    assert rendered(mi, file, 1).shape[0] == 48
    sensors = ElementTree.parse(file).findall("sensor")
    assert [sensor.get("id") for sensor in sensors] == ["eye", "wide"]
    assert sensors[0].find("sampler/integer").attrib == {"name": "sample_count", "value": "4"}


def test_the_command_writes_what_it_would_render(room, tmp_path, capsys):
    mi = mitsuba_variant()
    file = tmp_path / "floor.xml"
    # Straight above the floor, whose smooth lobe reflects the black above: what is left is Lambert.
    options = ["--camera", "/room/eye", "--width", "16", "--samples", "64", "--bounces", "4"]
    assert main(["relight", str(room), "-o", str(file), "--json", *options]) == 0
    told = checked(capsys.readouterr().out, "relight")
    assert told["cameras"] == 1
    assert told["files"] == 3  # two meshes, and a reflectance above 1, which is no colour there
    picture = tmp_path / "floor.exr"
    assert main(["relight", str(room), "-o", str(picture), "--denoise", "none", *options]) == 0
    ours = read_exr(picture).mean(axis=(0, 1))
    assert rendered(mi, file).mean(axis=(0, 1)) == pytest.approx(ours, rel=0.02)


def test_an_earlier_scene_is_replaced_and_nothing_else(room, tmp_path):
    file, options = tmp_path / "floor.xml", RelightOptions(camera="/room/eye", width=8)
    relight(room, file, options)
    first = file.read_bytes()
    (tmp_path / "floor.files/stale.ply").write_text("old")
    relight(room, file, options)
    assert file.read_bytes() == first
    assert sorted(p.name for p in (tmp_path / "floor.files").iterdir()) == [
        "mesh_0000.ply",
        "mesh_0001.ply",
        "picture_0000.exr",
    ]
    (tmp_path / "mine.files").mkdir()
    (tmp_path / "mine.files/notes.txt").write_text("mine")
    with pytest.raises(OwnershipConflict, match=r"mine\.files"):
        relight(room, tmp_path / "mine.xml", options)
    assert (tmp_path / "mine.files/notes.txt").read_text() == "mine"
    assert not (tmp_path / "mine.xml").exists()
