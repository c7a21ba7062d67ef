"""Photographs through lenses become pinhole frames."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from tests.lens_scenes import CAMERAS, camera_of, capture_through, rays_of, surface_of
from tests.scenes import edited, make_capture, ring_of_poses
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import hashes_of_inputs, open_weaker
from usdbrdf.asset.readers.scene import frames_from_stage, scene_from_stage
from usdbrdf.asset.readers.views import photographs_of_views
from usdbrdf.capture import develop
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.develop import resampled
from usdbrdf.capture.formats.transforms import frame_records
from usdbrdf.capture.lens_views import pinhole_views, why_no_lens
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_exr, write_exr, write_preview_png
from usdbrdf.job.ownership import owned_folder
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import View
from usdbrdf.model.lens import PINHOLE, Lens, whole_sphere
from usdbrdf.options import IngestOptions
from usdbrdf.tasks.ingest import ingest

pytest.importorskip("pycolmap")


def lens_of(model):
    width, height, numbers = CAMERAS[model]
    if model == "EQUIRECTANGULAR":
        return Lens(curve="equirectangular"), whole_sphere(width, height)
    k = numbers[4:]
    if model == "OPENCV":
        return Lens(radial=k[:2], tangential=k[2:]), numbers[:4]
    return Lens(curve="fisheye", radial=k), numbers[:4]


def views(model, scale):
    """The camera of a model, and each of its frames: face, view, pinhole camera."""
    camera = camera_of(model, scale)
    lens, _ = lens_of(model)
    intrinsics = tuple(scale * n for n in lens_of(model)[1])
    found = pinhole_views(lens, intrinsics, (camera.width, camera.height))
    for one in found:
        width, height = one.resolution
        pinhole = Camera(
            world_from_camera=np.eye(4), intrinsics=one.intrinsics, width=width, height=height
        )
        view = View(
            photograph=Path("none"), mask=None, lens=lens, intrinsics=intrinsics,
            photograph_from_frame=one.photograph_from_frame, face=one.face,
        )  # fmt: skip
        yield one.face, view, pinhole


def soft(directions):
    """(..., 3) radiance that varies with the direction, a little faster than pixels resolve."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.stack([2 + np.sin(7 * x + 1), 2 + np.cos(6 * y), 2 + np.sin(5 * z + 3 * x)], -1)


@pytest.mark.parametrize(
    ("model", "faces"), [("OPENCV", 1), ("OPENCV_FISHEYE", 5), ("EQUIRECTANGULAR", 6)]
)
def test_frames_show_what_lies_in_their_directions(model, faces):
    source = soft(rays_of(camera_of(model, 4))).astype(np.float32)
    covered = 0.0
    found = list(views(model, 4))
    assert len(found) == faces
    for face, view, pinhole in found:
        image = resampled(source, view, pinhole, np.inf)
        directions = pinhole.rays(pinhole.pixels())[1] @ view.photograph_from_frame.T
        expected = soft(directions).reshape(image.shape)
        known = np.isfinite(image).all(axis=2)
        covered += known.mean() / faces
        assert np.abs(image - expected)[known].max() < 0.03, face
        # What the photograph shows at all is known, wherever it lies on it.
        pixels = view.lens.project(directions.astype(np.float64), view.intrinsics)
        inside = ((pixels > 0.01) & (pixels < np.array(source.shape[1::-1]) - 0.01)).all(axis=1)
        assert known.ravel()[inside].all(), face
    assert covered > {1: 0.7, 5: 0.5, 6: 0.999}[faces]


def test_a_wide_fisheye_becomes_faces_that_show_all_of_it():
    lens, size = Lens(curve="fisheye", radial=(-0.02,)), (600, 600)
    intrinsics = (160.0, 160.0, 300.0, 300.0)  # 100 degrees off its axis in the corners and more
    found = pinhole_views(lens, intrinsics, size)
    assert {view.face for view in found} == {"front", "left", "right", "up", "down", "back"}
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20_000, 3))
    pixels = lens.project(directions, intrinsics)
    shown = ((pixels > 1) & (pixels < 599)).all(axis=1)
    seen = np.zeros(len(directions), bool)
    for view in found:
        x, y, z = (directions @ view.photograph_from_frame).T
        fx, fy, cx, cy = view.intrinsics
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = cx - fx * x / z, cy + fy * y / z
        width, height = view.resolution
        seen |= (z < 0) & (u > 0) & (u < width) & (v > 0) & (v < height)
    assert shown.sum() > 5000
    assert seen[shown].all()


_FISHEYE = (0.0340, -0.0118, 0.0036, -0.0011)
_ARIA = (0.4, -0.38, -0.17, 0.6, -0.42, 0.09)


@pytest.mark.parametrize(
    ("lens", "intrinsics", "size"),
    [
        # A telephone's main, wide and long camera.
        (Lens(radial=(0.09, -0.26, 0.23)), (1480.0, 1480.0, 960.0, 720.0), (1920, 1440)),
        (Lens(radial=(-0.03, 0.02, -0.005)), (760.0, 760.0, 960.0, 720.0), (1920, 1440)),
        (Lens(radial=(1.6, -30.0)), (9000.0, 9000.0, 960.0, 720.0), (1920, 1440)),
        # Action cameras: barrels that turn back beyond the corner, or just before it.
        (Lens(radial=(-0.27, 0.1, -0.02), tangential=(4e-4, -3e-4)), (860.0, 860.0, 960.0, 540.0),
         (1920, 1080)),
        (Lens(radial=(-0.24,)), (900.0, 900.0, 960.0, 540.0), (1920, 1080)),
        # OpenCV's rational model, and fisheyes: to the corner, of a whole circle, Aria's.
        (Lens(radial=(8.2, 3.5, 0.1), divisor=(8.5, 6.1, 0.9)), (600.0, 600.0, 640.0, 360.0),
         (1280, 720)),
        (Lens(curve="fisheye", radial=_FISHEYE), (790.0, 790.0, 876.0, 584.0), (1752, 1168)),
        (Lens(curve="fisheye", radial=(-0.05, 0.004)), (330.0, 330.0, 960.0, 540.0), (1920, 1080)),
        (Lens(curve="fisheye", radial=_ARIA, tangential=(4e-4, 3e-4), prism=(6e-4, 0, -3e-4, 0),
              radial_first=True), (610.0, 610.0, 704.0, 704.0), (1408, 1408)),
        (Lens(curve="eucm", shape=(0.6, 1.1)), (500.0, 500.0, 640.0, 360.0), (1280, 720)),
        # A sphere whose height was rounded, and a part of one.
        (Lens(curve="equirectangular"), whole_sphere(5793, 2896), (5793, 2896)),
        (Lens(curve="equirectangular"), (900.0, 800.0, 500.0, 100.0), (1000, 400)),
    ],
)  # fmt: skip
def test_lenses_that_cameras_have_are_believed(lens, intrinsics, size):
    assert why_no_lens(lens, intrinsics, size) == ""


def test_no_detail_is_lost_and_pixels_are_not_multiplied():
    lens, intrinsics = Lens(radial=(-0.1, 0.01)), (500.0, 500.0, 320.0, 240.0)
    (view,) = pinhole_views(lens, intrinsics, (640, 480))
    assert view.intrinsics[0] == pytest.approx(500, rel=0.02)
    assert np.prod(view.resolution) < 1.3 * 640 * 480
    sphere = pinhole_views(Lens(curve="equirectangular"), whole_sphere(512, 256), (512, 256))
    assert {view.intrinsics[0] for view in sphere} == {512 / (2 * np.pi)}
    assert sum(np.prod(view.resolution) for view in sphere) < 1.35 * 512 * 256


def test_poles_are_the_mean_of_the_pixels_that_crowd_there():
    rng = np.random.default_rng(0)
    noise = rng.normal(1, 0.1, (128, 256, 3)).astype(np.float32)
    lens, intrinsics = Lens(curve="equirectangular"), whole_sphere(256, 128)
    for one in pinhole_views(lens, intrinsics, (256, 128)):
        width, height = one.resolution
        pinhole = Camera(
            world_from_camera=np.eye(4), intrinsics=one.intrinsics, width=width, height=height
        )
        view = View(
            photograph=Path("none"), mask=None, lens=lens, intrinsics=intrinsics,
            photograph_from_frame=one.photograph_from_frame, face=one.face,
        )  # fmt: skip
        image = resampled(noise, view, pinhole, np.inf)
        middle = image[height // 2 - 6 : height // 2 + 6, width // 2 - 6 : width // 2 + 6]
        if one.face in ("up", "down"):
            assert middle.std() < 0.06
        else:
            assert 0.06 < middle.std() < 0.1


def test_clipped_and_unknown_pixels_stay_so_and_do_not_ring():
    _, view, pinhole = next(views("OPENCV", 4))
    source = np.full((144, 192, 3), 0.5, np.float32)
    source[60:70, 80:95] = 8.0  # clipped
    source[20:24, 30:34, 1] = np.nan
    source[20:24, 30:34] = np.nan
    source[100:110, 100:110] = 7.0  # bright, not clipped
    image = resampled(source, view, pinhole, 8.0)
    places = view.lens.project(
        (pinhole.rays(pinhole.pixels())[1] @ view.photograph_from_frame.T).astype(np.float64),
        view.intrinsics,
    ).reshape(pinhole.height, pinhole.width, 2)
    x, y = np.moveaxis(places - 0.5, -1, 0)

    def among(top, bottom, left, right, slack):
        return (
            (y > top - slack) & (y < bottom - 1 + slack)
            & (x > left - slack) & (x < right - 1 + slack)
        )  # fmt: skip

    clipped = (image >= 0.998 * 8).any(axis=2)
    np.testing.assert_array_equal(clipped[among(60, 70, 80, 95, 0.99)], True)
    assert not clipped[~among(60, 70, 80, 95, 1.0)].any()
    unknown = np.isnan(image[..., 0]) & np.isfinite(x)
    np.testing.assert_array_equal(unknown[among(20, 24, 30, 34, 0.99)], True)
    known = np.isfinite(image) & ~clipped[..., None]
    assert image[known].min() >= 0.5
    assert image[known].max() <= 7.0


def test_a_pinhole_with_a_mask_is_the_photograph_where_it_is_white(tmp_path):
    made = make_capture(tmp_path / "room")
    white = np.full((24, 32, 3), 255, np.uint8)
    white[4:9, 5:11] = 0
    write_preview_png(made.folder / "mask.png", white)
    with edited(made.manifest) as document:
        for frame in document["frames"][::2]:
            frame["mask_path"] = "mask.png"
    asset = ingested(made.folder, tmp_path / "asset")
    frames = frames_from_stage(open_weaker(asset, "texturing"))
    assert frames.image_paths[1] == made.image(1)
    assert (frames.photographs[0], frames.photographs[1]) == (made.image(0), None)
    assert frames.masks[:2] == (made.folder / "mask.png", None)
    image, expected = read_exr(frames.image_paths[0]), read_exr(made.image(0))
    hidden = white[..., 0] == 0
    assert np.isnan(image[hidden]).all()
    np.testing.assert_array_equal(image[~hidden], expected[~hidden])


@pytest.mark.parametrize("mask", ["", " ", 3])
def test_a_mask_path_that_is_none_is_told_by_file_and_frame(tmp_path, mask):
    made = make_capture(tmp_path / "room")
    with edited(made.manifest) as document:
        name, document["frames"][2]["mask_path"] = document["frames"][2]["file_path"], mask
    said = "is not a file name" if mask == 3 else "is empty"
    said = rf"transforms\.json: the mask_path of the frame '{name}' {said}\. .*\[capture\.mask\]$"
    with pytest.raises(InputRefused, match=said):
        read_scan(made.folder, IngestOptions())


def test_masks_that_cannot_be_are_dropped_with_words(tmp_path):
    made = make_capture(tmp_path / "room")
    write_preview_png(made.folder / "small.png", np.zeros((5, 32, 3), np.uint8))
    with edited(made.manifest) as document:
        document["frames"][2]["mask_path"] = "none.png"
        document["frames"][3]["mask_path"] = "small.png"
    scan = read_scan(made.folder, IngestOptions())
    assert len(scan.frames) == 10
    assert any("mask cannot be used" in w and "[capture.mask]" in w for w in scan.warnings)


def ingested(capture, folder):
    asset = Asset.at(folder)
    with owned_folder(folder):
        ingest(capture, asset, IngestOptions())
    return asset


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"])
def test_an_asset_has_pinhole_frames_of_the_surfaces(tmp_path, model):
    count = 3 if model == "EQUIRECTANGULAR" else 10
    made = capture_through(tmp_path / "Räume", model, frames=count, scale=2)
    asset = ingested(made.folder, tmp_path / "asset")
    frames = frames_from_stage(open_weaker(asset, "texturing"))
    assert len(frames) == {"OPENCV": 1, "OPENCV_FISHEYE": 5, "EQUIRECTANGULAR": 6}[model] * count
    curve = "equirectangular" if count == 3 else "fisheye" if "FISH" in model else "perspective"
    checked, wrong = 0, 0
    for i in range(len(frames)):
        assert frames.photographs[i] == made.image(i * count // len(frames))
        assert frames.image_paths[i].parent == asset.folder / "frames"
        assert frames.lenses[i].split()[0] == curve
        pixels, shown = read_frame(frames, i), surface_of(made, frames.camera(i))
        for k, name in enumerate(made.names):
            inner = (shown == k) & pixels.valid
            checked += inner.sum()
            right = np.isclose(pixels.radiance[inner], made.radiance[name], rtol=1e-3).all(axis=1)
            wrong += len(right) - right.sum()
    # An edge just beside a frame is not among those that it sees.
    assert wrong < 0.005 * checked
    assert checked > 0.4 * frames.resolution.prod(axis=1).sum()


def test_frames_are_remade_where_they_are_missing_and_the_photographs_count(tmp_path):
    made = capture_through(tmp_path / "room", "OPENCV")
    asset = ingested(made.folder, tmp_path / "asset")
    frames = frames_from_stage(open_weaker(asset, "texturing"))
    assert frames.recorded_in() == [made.image(i) for i in range(10)]
    first = frames.image_paths[3]
    content, scan = first.read_bytes(), asset.layer("scan").read_bytes()
    first.unlink()
    with owned_folder(asset.folder):
        assert "missing" in ingest(made.folder, asset, IngestOptions()).reason
        assert not ingest(made.folder, asset, IngestOptions()).reran
    assert first.read_bytes() == content
    assert asset.layer("scan").read_bytes() == scan
    write_exr(made.image(3), 2 * read_exr(made.image(3)))
    with owned_folder(asset.folder):
        assert ingest(made.folder, asset, IngestOptions()).reran
    assert first.read_bytes() != content


def test_places_of_pixels_are_computed_once_for_each_camera(tmp_path, monkeypatch):
    """And those of other cameras are not kept in memory: a rig's take turns from frame to frame."""
    made = capture_through(tmp_path / "room", "OPENCV", frames=16)
    with edited(made.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            frame["fl_x"] = document["fl_x"] + 0.01 * (i % 8)
    computed, kept = [], []
    places = develop._places.__wrapped__

    def counted(*camera):
        computed.append(camera)
        kept.append(develop._places.cache_info().currsize)
        return places(*camera)

    monkeypatch.setattr(develop, "_places", lru_cache(develop._KEPT_MAPS)(counted))
    scan = read_scan(made.folder, IngestOptions())
    (tmp_path / "frames").mkdir()
    frames = develop.developed_in(scan.frames, scan.views, tmp_path)
    assert all(path.is_file() for path in frames.image_paths)
    assert len(computed) == len(set(computed)) == 8
    assert max(kept) == 0


class _Maps:
    """As much of ``AssetMaps`` as the hashes of inputs need."""

    def __init__(self, frames):
        self.frames = frames
        self.hashes_of_frames = [""] * len(frames)

    def layers_elsewhere(self, folder):
        return []


def test_what_later_steps_depend_on_is_the_photograph(tmp_path):
    made = capture_through(tmp_path / "room", "OPENCV")
    asset = ingested(made.folder, tmp_path / "asset")
    maps = _Maps(frames_from_stage(open_weaker(asset, "texturing")))

    def hashed():
        return hashes_of_inputs(asset, "texturing", maps, photographs=True)["frames"]

    before = hashed()
    write_exr(maps.frames.image_paths[2], np.ones((5, 5, 3), np.float32))
    assert hashed() == before
    write_exr(made.image(2), np.ones((36, 48, 3), np.float32))
    assert hashed() != before


@pytest.mark.fault("S5")
def test_photographs_may_be_called_as_long_as_a_file_may(tmp_path):
    made = capture_through(tmp_path / "room", "OPENCV")
    with edited(made.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            name = f"{'x' * 240}{i:04d}.exr"  # which tell them apart at the end alone
            made.image(i).rename(made.image(i).with_name(name))
            frame["file_path"] = f"frames/{name}"
    asset = Asset.at(tmp_path / "asset")
    with owned_folder(asset.folder):
        ingest(made.folder, asset, IngestOptions())
    found = [file.name for file in (asset.folder / "frames").iterdir()]
    assert len(found) == len(document["frames"])
    assert max(map(len, found)) < 80


def in_eight_bits(made):
    """An eighth of the radiance as sRGB in PNG files."""
    with edited(made.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            linear = read_exr(made.image(i)) / 8
            encoded = np.where(
                linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear
            )
            frame["file_path"] = f"frames/{i:04d}.png"
            shown = (255 * encoded + 0.5).clip(0, 255).astype(np.uint8)
            write_preview_png(made.folder / frame["file_path"], shown)
            frame["exposure_time"] = 0.02


def test_photographs_of_eight_bits_become_linear_frames(tmp_path):
    """And photographs of other views, by a pinhole camera, are in the same unit."""
    made = capture_through(tmp_path / "room", "OPENCV")
    views = make_capture(tmp_path / "views", poses=ring_of_poses(8, height=1.6))
    in_eight_bits(made)
    in_eight_bits(views)
    asset = Asset.at(tmp_path / "asset")
    with owned_folder(asset.folder):
        ingest(made.folder, asset, IngestOptions(assume_srgb=True))
    stage = open_weaker(asset, "texturing")
    frames = frames_from_stage(stage)
    assert (frames.encoding, frames.radiometric) == ("lin_rec709_scene", False)
    others = photographs_of_views(views.manifest, asset, stage, scene_from_stage(stage), tmp_path)
    expected = np.array(made.radiance["walls"]) / 8
    for some in (frames, others.frames):
        pixels, shown = read_frame(some, 0), surface_of(made, some.camera(0))
        inner = (shown == made.names.index("walls")) & pixels.valid
        assert inner.sum() > 20
        assert np.abs(pixels.radiance[inner] / expected - 1).max() < 0.05


@pytest.mark.parametrize("masked", [0, 1])
def test_eight_bits_of_lightings_are_linear_where_one_of_them_is_resampled(tmp_path, masked):
    made = [make_capture(tmp_path / name, frames=12) for name in ("day", "night")]
    for each in made:
        in_eight_bits(each)
    write_preview_png(tmp_path / "mask.png", np.full((24, 32, 3), 255, np.uint8))
    (tmp_path / "mask.png").rename(made[masked].folder / "mask.png")
    with edited(made[masked].manifest) as document:
        document["frames"][3]["mask_path"] = "mask.png"
    asset = Asset.at(tmp_path / "asset")
    with owned_folder(asset.folder):
        ingest([each.folder for each in made], asset, IngestOptions(assume_srgb=True))
    frames = frames_from_stage(open_weaker(asset, "texturing"))
    expected = np.array(made[0].radiance["walls"]) / 8
    assert len(frames) == 24
    for i in range(24):
        pixels, shown = read_frame(frames, i), surface_of(made[0], frames.camera(i))
        inner = (shown == made[0].names.index("walls")) & pixels.valid
        assert inner.sum() > 20
        assert np.abs(pixels.radiance[inner] / expected - 1).max() < 0.05


def test_a_lens_that_shows_nothing_is_dropped_with_words(tmp_path):
    made = capture_through(tmp_path / "room", "OPENCV")
    with edited(made.manifest) as document:
        document |= {"cx": 400.0, "k2": 0.0}
    with pytest.raises(InputRefused, match=r"make no lens.*\[capture\.camera\]"):
        read_scan(made.folder, IngestOptions())


def test_inspect_tells_whether_photographs_through_lenses_agree(tmp_path, capsys):
    made = capture_through(tmp_path / "room", "OPENCV", scale=2)
    assert main(["inspect", str(made.folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["agreement"] < 0.4
    assert [path.name for path in tmp_path.iterdir()] == ["room"]


def test_a_plain_capture_has_no_views(tmp_path):
    scan = read_scan(make_capture(tmp_path / "room").folder, IngestOptions())
    assert (scan.views, scan.frames.photographs, scan.frames.lenses) == ((), (), ())
    assert not PINHOLE.bends


def test_faces_that_the_mask_hides_are_left_out(tmp_path):
    made = capture_through(tmp_path / "room", "EQUIRECTANGULAR", frames=8)
    white = np.zeros((48, 96, 3), np.uint8)
    white[18:30, 40:56] = 255  # straight ahead
    write_preview_png(made.folder / "mask.png", white)
    with edited(made.manifest) as document:
        for frame in document["frames"][1:]:
            frame["mask_path"] = "mask.png"
    scan = read_scan(made.folder, IngestOptions())
    assert [view.face for view in scan.views] == [
        "front", "right", "left", "up", "down", "back", *["front"] * 7
    ]  # fmt: skip


def test_a_whole_sphere_by_the_key_that_instant_ngp_has_for_it(tmp_path):
    made = capture_through(tmp_path / "room", "EQUIRECTANGULAR", frames=8)
    with edited(made.manifest) as document:
        for holder in (document, *document["frames"]):
            holder.pop("camera_model", None)
        document["latlong"] = True
    records = frame_records(made.manifest, IngestOptions(), Findings())
    assert {record.lens.curve for record in records} == {"equirectangular"}


def test_a_fisheye_ends_at_the_circle_that_a_document_states(tmp_path):
    """nerfstudio's fisheye_crop_radius, in pixels: beyond it is the lens's tube."""
    made = capture_through(tmp_path / "room", "OPENCV_FISHEYE")
    with edited(made.manifest) as document:
        document["fisheye_crop_radius"] = 15
    shown = read_scan(made.folder, IngestOptions()).views
    fx, fy, cx, cy = shown[0].intrinsics
    angles = np.linspace(0, 1.2, 200)
    directions = np.stack([np.sin(angles), 0 * angles, -np.cos(angles)], axis=-1)
    reached = shown[0].lens.project(directions, (fx, fy, cx, cy))[:, 0] - cx
    assert 14.8 < np.nanmax(reached) <= 15
    assert np.isnan(reached).any()
    assert "circle 0.75" in shown[0].lens.described((fx, fy, cx, cy))


def test_lenses_of_documents_and_of_single_frames(tmp_path):
    made = make_capture(tmp_path / "room")
    small = (-0.02, 0.01, 0.003, 0.002, -0.001, 0.004, 0.001, -0.002, 0.003, 0.001, 0.002, -0.001)
    names = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")
    with edited(made.manifest) as document:
        document |= {"camera_model": "OPENCV", "k1": -0.05, "p2": 0.001}
        frames = document["frames"]
        frames[1] |= dict(zip(names, small, strict=True))
        frames[2] |= {"camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k4": 0.002, "p2": 0}
        frames[3] |= {"camera_model": "FISHEYE624", "distortion_params": list(small)}
        frames[4] |= {"distortion_params": list(small[:6])}
        frames[5] |= {"k1": 0, "p2": 0}
        # instant-ngp's word for OpenCV's fisheye, which a stated model comes before.
        frames[6] |= {"is_fisheye": True}
    scan = read_scan(made.folder, IngestOptions())
    found = {}
    for i, path in enumerate(scan.frames.image_paths):
        view = scan.views[i]
        number = int(view.photograph.stem) if view else int(path.stem)
        found.setdefault(number, view and view.lens)
    k1, k2, k3, k4, k5, k6, p1, p2, *prism = small
    assert found[0] == Lens(radial=(-0.05, 0.0, 0.0, 0.0), tangential=(0.0, 0.001))
    assert found[1] == Lens(
        radial=(k1, k2, k3), divisor=(k4, k5, k6), tangential=(p1, p2), prism=tuple(prism)
    )
    assert found[2] == Lens(curve="fisheye", radial=(0.01, 0.0, 0.0, 0.002))
    assert found[3] == Lens(
        curve="fisheye", radial=small[:6], tangential=(p2, p1), prism=tuple(prism),
        radial_first=True,
    )  # fmt: skip
    assert found[4] == Lens(radial=small[:4], tangential=small[4:6])
    assert found[5] is None
    assert found[6] == found[0]
    with edited(made.manifest) as document:
        del document["camera_model"]
    views = read_scan(made.folder, IngestOptions()).views
    curves = {int(v.photograph.stem): v.lens.curve for v in views if v is not None}
    assert (curves[6], curves[0]) == ("fisheye", "perspective")
