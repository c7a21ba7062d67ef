"""The scene for Mitsuba itself: loaded by Mitsuba alone, it shows what ``relight`` shows."""

from __future__ import annotations

import errno
import resource
import signal
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.fault_injection import run_fresh
from tests.json_schemas import checked
from tests.relighting.scenes import material, plate, surface
from usdbrdf.cli import main
from usdbrdf.errors import EnvironmentFailure, OwnershipConflict
from usdbrdf.files.images import read_exr
from usdbrdf.model.camera import Camera
from usdbrdf.model.light import DistantLight, RelitScene, ShapeLight, SkyLight
from usdbrdf.model.material import Surface, constant_map
from usdbrdf.options import RelightOptions
from usdbrdf.relighting import scene_file
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
    assert count == len(list(beside.glob("*_*.*"))) >= 3 + 4
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
    told = {one.get("name"): one.get("value") for one in sensors[0].findall("sampler/integer")}
    assert told.pop("sample_count") == "4"
    assert set(told) == {"seed"}


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
    (tmp_path / f"floor.files/mesh_0000.{'0' * 16}.ply").write_text("old")
    relight(room, file, options)
    assert file.read_bytes() == first
    names = sorted(p.name for p in (tmp_path / "floor.files").iterdir())
    assert [name.split(".")[0] for name in names] == [
        "mesh_0000", "mesh_0001", "picture_0000", "usdbrdf",
    ]  # fmt: skip
    (tmp_path / "mine.files").mkdir()
    (tmp_path / "mine.files/notes.txt").write_text("mine")
    with pytest.raises(OwnershipConflict, match=r"mine\.files"):
        relight(room, tmp_path / "mine.xml", options)
    assert (tmp_path / "mine.files/notes.txt").read_text() == "mine"
    assert not (tmp_path / "mine.xml").exists()


def test_a_text_of_another_is_not_replaced(room, tmp_path):
    (tmp_path / "mine.xml").write_text("<mine/>")
    with pytest.raises(OwnershipConflict, match=r"mine\.xml: not a scene.*\[relight\.output\]$"):
        relight(room, tmp_path / "mine.xml", RelightOptions(camera="/room/eye", width=8))
    assert (tmp_path / "mine.xml").read_text() == "<mine/>"
    assert not (tmp_path / "mine.files").exists()


SMALL = RelitScene(surfaces=(plate(material(0.5)),), lights=())


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_clear_parts_of_a_mesh_are_left_out(tmp_path):
    clear = replace(material(0.5), clear=True)
    parts = replace(SMALL, surfaces=(plate(material(0.5)), plate(clear), plate(material(0.2))))
    file = tmp_path / "room.xml"
    mi = mitsuba_variant("scalar_rgb")
    assert write_scene_file(mi, file, parts, (camera(),), bounces=4, samples=1) == 2
    assert len(mi.load_file(str(file)).shapes()) == 2


@pytest.mark.parametrize("name", ["move", "flush_folder", "publish"])
def test_where_it_cannot_be_put_in_place_the_earlier_scene_stays(tmp_path, monkeypatch, name):
    mi, file = mitsuba_variant("scalar_rgb"), tmp_path / "room.xml"
    write_scene_file(mi, file, SMALL, (camera(),), bounces=4, samples=1)
    earlier = contents(tmp_path)
    other = replace(SMALL, surfaces=(plate(material(0.1)),) * 2)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(scene_file, name, full)
        with pytest.raises(EnvironmentFailure, match=r"room\.xml: No space.*\[environment\.io\]$"):
            write_scene_file(mi, file, other, (camera(),), bounces=4, samples=1)
    assert contents(tmp_path) == earlier
    assert write_scene_file(mi, file, other, (camera(),), bounces=4, samples=1) == 2


KILLED = """
import sys
from dataclasses import replace
from pathlib import Path
from tests.fault_injection import killed_at_each_change
from tests.relighting import test_scene_file as tests
mi, file = tests.mitsuba_variant("scalar_rgb"), Path(sys.argv[1])
plate = tests.plate(tests.material(0.1))
def write(surfaces):
    scene, eyes = replace(tests.SMALL, surfaces=surfaces), (tests.camera(),)
    tests.write_scene_file(mi, file, scene, eyes, bounces=4, samples=1)
def found():  # which raises where the file or one that it names is not there
    return str(mi.load_file(str(file)))
write((plate,))
first, kept = found(), set()
for number in killed_at_each_change(lambda: write((plate, plate))):
    kept.add(found() == first)
    write((plate,))
    assert found() == first, number
    assert len(list(file.parent.iterdir())) == 2, list(file.parent.iterdir())
    assert len(list(file.with_name("room.files").iterdir())) == 2
print(number, *sorted(kept))
"""


@pytest.mark.fault("R2")
def test_killed_at_any_change_the_earlier_scene_or_the_new_one_is_there(tmp_path):
    number, *kept = run_fresh(KILLED, tmp_path / "room.xml").split()
    assert int(number) > 6
    assert kept == ["False", "True"]


# A mesh that Mitsuba's own writer has in its buffer until it closes the file, and a larger one.
@pytest.mark.parametrize("triangles", [60, 6000])
def test_a_full_disk_is_told_and_leaves_nothing(tmp_path, triangles):
    mi, file = mitsuba_variant("scalar_rgb"), tmp_path / "room.xml"
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    large = replace(SMALL, surfaces=(surface(corners, [(0, 1, 2)] * triangles, material(0.5)),))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4000, hard))
        with pytest.raises(EnvironmentFailure, match=r"\[environment\.io\]$"):
            write_scene_file(mi, file, large, (camera(),), bounces=4, samples=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert list(tmp_path.iterdir()) == []


def test_the_seed_is_of_the_noise_alone(tmp_path):
    mi, file, found = mitsuba_variant("scalar_rgb"), tmp_path / "room.xml", []
    scene = scene_of_everything()
    for seed in (0, 0, 1):
        eyes = camera(), camera("other")
        write_scene_file(mi, file, scene, eyes, bounces=4, samples=1, seed=seed)
        loaded = mi.load_file(str(file))
        found += [np.array(mi.render(loaded, sensor=i, spp=4)) for i in range(2)]
    first, other, again, _, seeded, _ = found
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(first, seeded)
