"""The fit takes the specular light off again that was added to frames of a diffuse room."""

from __future__ import annotations

import shutil
from collections import Counter
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
from pxr import Usd, UsdShade
from scipy import stats

import usdbrdf
from tests.scenes import MadeCapture, make_capture, poses_down_and_up
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import frames_from_stage, read_aovs, read_shading
from usdbrdf.files.atomic import sha256_of
from usdbrdf.files.frames import FramePixels, FrameReader, read_frame
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.job import task as task_module
from usdbrdf.job.progress import set_quiet
from usdbrdf.job.task import TaskRun
from usdbrdf.material import refine, refined_means
from usdbrdf.material.refine import Refined, refined_light
from usdbrdf.material.refined_irradiance import Lobes, refined_irradiance
from usdbrdf.material.refined_means import Lighting
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap
from usdbrdf.options import Sampling
from usdbrdf.shading import shaded
from usdbrdf.shading.asked import Shining, irradiance_of_texels
from usdbrdf.shading.base_color import base_color_of
from usdbrdf.shading.hidden_light import beside_seen
from usdbrdf.texturing.robust_mean import RobustMean
from usdbrdf.transport.brdf import DIELECTRIC, PAPER
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.lit_scene import LitScene, SurfacePoints, visible_points
from usdbrdf.transport.lobe_radiance import lobe_radiance
from usdbrdf.transport.rays import lift_from_surface

Float = npt.NDArray[np.float32]

# Dim enough, in the light of the others, not to be taken for a lamp itself.
CEILING = {"ceiling": (0.125, 0.125, 0.125)}
# phi, psi. The lamp reflects nothing.
LOBE = {"floor": (0.2, 0.8), "ceiling": (0.6, 0.4), "walls": (0.3, 0.6), "box": (0.15, 0.9)}
NUM_FRAMES, INTERRUPTED = 18, 15
# Two glossy things do not tell which lobe a scene has.
OPTIONS = usdbrdf.FitOptions(lobe="paper")


@pytest.fixture(scope="module", autouse=True)
def _quiet():
    set_quiet(True)
    yield
    set_quiet(False)


@dataclass(frozen=True, kw_only=True)
class Room:
    """clean, glossy: the same room with diffuse radiance alone and with lobes, both shaded."""

    folder: Path
    clean: AssetMaps
    glossy: Asset


def _shaded(capture: MadeCapture, folder: Path) -> Asset:
    options = usdbrdf.TextureOptions(texel_size=0.2)
    sampling = usdbrdf.Sampling(standard_error=0.0, max_rays=64)
    with usdbrdf.working_on(folder) as asset:
        usdbrdf.ingest(capture.folder, asset, usdbrdf.IngestOptions())
        usdbrdf.texture(asset, options)
        usdbrdf.shade(asset, usdbrdf.ShadeOptions(sampling=sampling))
        return asset


def _atlas(asset: Asset) -> AssetMaps:
    return AssetMaps(open_measured(asset))


def _lobes(atlas: AssetMaps) -> Lobes:
    rows = [LOBE.get(item.label, (1.0, 0.0)) for item in atlas.scene.objects]
    phi, psi = np.array(rows, np.float32).T
    return _dielectric(phi, psi)


def _dielectric(phi: Float, psi: Float) -> Lobes:
    return Lobes(phi=phi, psi=np.repeat(psi[:, None], 3, axis=1), conducts=np.zeros(len(phi), bool))


def _refined_light(run: TaskRun, atlas: AssetMaps, lit: LitScene, frames: Frames) -> Refined:
    reader, lobes = FrameReader(frames, most_bytes=0), _lobes(atlas)
    lighting = Lighting("", lit, atlas, range(len(frames)))
    (found,) = refined_light(run, [lighting], reader, lobes, "none", None, 0)
    return found


def _irradiance(
    run: TaskRun, atlas: AssetMaps, lit: LitScene, diffuse: Float, lobes: Lobes
) -> Float:
    """S of the asset, with the diffuse radiance and the lobes as the light instead of its L_d."""
    change = np.where(atlas.emissive[:, None], 0, diffuse - atlas.lit).astype(np.float32)
    traced = atlas.irradiance
    return refined_irradiance(run, lit, traced, change, lobes, "none", 0)


def _specular(lit: LitScene, lobes: Lobes, points: SurfacePoints, rays: int, seed: int) -> Float:
    """What the lobes reflect of the diffuse room, (R, 3); nothing from the lamp."""
    own = lit.owner(points.face)
    lamp = [item.label for item in lit.scene.objects].index("lamp")
    reflects = np.flatnonzero((own >= 0) & (own != lamp))
    result = np.zeros((len(own), 3), np.float32)
    result[reflects] = lobe_radiance(
        lit, points.take(reflects), lobes.phi[own[reflects]], lobes.psi[own[reflects]], rays, seed
    )
    return result


def _add_specular(capture: MadeCapture, atlas: AssetMaps, frames: Frames) -> None:
    """To the photographs of the diffuse room."""
    lit, lobes = atlas.lit_scene(black_environment()), _lobes(atlas)
    for i, path in enumerate(sorted((capture.folder / "frames").iterdir())):
        image = read_exr(path)
        height, width = image.shape[:2]
        camera = frames.camera(i).at_size(width, height)
        points = visible_points(lit, camera, camera.pixels())
        image += _specular(lit, lobes, points, 64, 100 + i).reshape(image.shape)
        write_exr(path, image)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Room:
    folder = tmp_path_factory.mktemp("refine")
    made = {
        name: make_capture(
            folder / name,
            size=(40, 30),
            subdivisions=1,
            poses=poses_down_and_up(12, 6),
            radiance=CEILING,
        )
        for name in ("clean", "glossy")
    }
    clean = _shaded(made["clean"], folder / "assets" / "clean")
    atlas = _atlas(clean)
    _add_specular(made["glossy"], atlas, frames_from_stage(open_measured(clean)))
    glossy = _shaded(made["glossy"], folder / "assets" / "glossy")
    return Room(folder=folder, clean=atlas, glossy=glossy)


def _fitted(room: Room, name: str, options: usdbrdf.FitOptions) -> Asset:
    """A copy of the glossy room, as far from its photographs, with a fit."""
    folder = room.folder / "assets" / name
    shutil.copytree(room.glossy.folder, folder)
    with usdbrdf.working_on(folder) as asset:
        usdbrdf.fit(asset, options)
        return asset


@pytest.fixture(scope="module")
def fitted(room: Room) -> Asset:
    return _fitted(room, "fitted", OPTIONS)


def _reflecting(room: Room, atlas: AssetMaps) -> np.ndarray:
    """(T,): measured and no lamp."""
    owner = np.array([item.label for item in atlas.scene.objects])[atlas.texels.object_index()]
    measured = atlas.coverage.measured & room.clean.coverage.measured
    return measured & (owner != "lamp")


def _off(found: np.ndarray, wanted: np.ndarray) -> float:
    """Median relative error."""
    return float(np.median(np.abs(found - wanted).sum(axis=1) / wanted.sum(axis=1)))


def _true_irradiance(clean: AssetMaps, which: np.ndarray) -> np.ndarray:
    """S of some texels in the glossy room: that of the diffuse one, and pi times the mean specular
    radiance that arrives along 64 cosine-distributed rays."""
    lit, texels = clean.lit_scene(black_environment()), clean.texels
    normal = texels.normal[which].astype(np.float64)
    u = stats.qmc.Sobol(2, rng=0).random(64)
    height = np.sqrt(1 - u[:, 0])
    tangent = np.cross(normal, [0.3, 0.5, 0.8])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frame = np.stack([tangent, np.cross(normal, tangent), normal], axis=1)
    angle = 2 * np.pi * u[:, 1]
    local = np.stack([np.sqrt(u[:, 0]) * np.cos(angle), np.sqrt(u[:, 0]) * np.sin(angle), height])
    directions = np.einsum("ck,tcd->tkd", local, frame).reshape(-1, 3).astype(np.float32)
    origin = lift_from_surface(texels.position[which], texels.normal[which], lit.diagonal_m)
    origin = np.repeat(origin, 64, axis=0)
    hits = lit.rays.closest(origin, directions)
    points = SurfacePoints(
        face=hits.face, u=hits.u, v=hits.v, position=origin + hits.distance[:, None] * directions,
        normal=clean.scene.corner_normals[np.maximum(hits.face, 0), 0], to_camera=-directions,
    )  # fmt: skip
    arriving = _specular(lit, _lobes(clean), points, 32, 1)
    return clean.map("irradiance")[which] + np.pi * arriving.reshape(-1, 64, 3).mean(axis=1)


def test_with_the_right_lobes_the_diffuse_radiance_comes_back(room: Room, tmp_path: Path):
    stage = open_measured(room.glossy)
    atlas, frames = AssetMaps(stage), frames_from_stage(stage)
    run = TaskRun(tmp_path, "fit", tmp_path / "work")
    lit = atlas.lit_scene(black_environment())
    found = _refined_light(run, atlas, lit, frames)
    which = _reflecting(room, atlas)
    truth = room.clean.map("lit")[which]
    before = _off(atlas.map("lit")[which], truth)
    assert before > 0.05
    assert _off(found.diffuse[which], truth) < 0.1 * before


def test_base_colour_scatters_the_published_irradiance_of_either_kind_of_lobe(
    room: Room, tmp_path: Path
):
    stage = open_measured(room.glossy)
    atlas, frames = AssetMaps(stage), frames_from_stage(stage)
    which, colours = _reflecting(room, atlas), []
    for kind in (PAPER, DIELECTRIC):
        run = TaskRun(tmp_path, "fit", tmp_path / str(kind))
        lit = replace(atlas.lit_scene(black_environment()), lobe=kind)
        found = _refined_light(run, atlas, lit, frames)
        scattered = found.base_color * found.irradiance / np.pi
        whole = which & (found.base_color < 0.99).all(axis=1)
        # As pixels mix it, of surfaces that are unevenly lit.
        ratio = scattered[whole] / found.diffuse[whole]
        assert abs(np.median(ratio) - 1) < 5e-3
        assert np.percentile(np.abs(ratio - 1), 75) < 0.03
        colours.append(found.base_color[whole].mean())
    assert abs(colours[1] / colours[0] - 1) > 0.003


def test_the_fit_brings_both_maps_nearer_to_the_truth(room: Room, fitted: Asset):
    atlas = _atlas(fitted)
    which, owner = _reflecting(room, atlas), atlas.texels.object_index()
    for i, item in enumerate(atlas.scene.objects):
        own = which & (owner == i)
        if item.label == "lamp":
            continue
        assert own.sum() > 20
        wanted = room.clean.map("lit")[own]
        # Of the box too few samples are left for a fit, and six frames do not tell a lobe as wide
        # and weak as the ceiling's from none.
        most = 0.3 if item.label in ("floor", "walls") else 1.0
        assert _off(atlas.map("diffuse")[own], wanted) < most * _off(atlas.map("lit")[own], wanted)
    wanted = np.pi * room.clean.map("lit")[which] / _true_irradiance(room.clean, which)
    found, before = (
        float(np.median(np.abs(atlas.map(name)[which] / wanted - 1)))
        for name in ("base_color", "albedo")
    )
    assert before > 0.02
    # Not better, because this room glows as it likes where nobody looked.
    assert found < 0.55 * before


def test_with_the_right_light_the_irradiance_comes_out(room: Room, tmp_path: Path):
    """From S of the glossy room's lit texture to that of its diffuse radiance and lobes."""
    atlas = AssetMaps(open_measured(room.glossy))
    some = np.flatnonzero(_reflecting(room, atlas))
    some = np.random.default_rng(1).choice(some, 400, replace=False)
    wanted = _true_irradiance(room.clean, some)
    lit, diffuse = room.clean.lit_scene(black_environment()), room.clean.map("lit")
    run = TaskRun(tmp_path, "fit", tmp_path / "work")
    found = _irradiance(run, atlas, lit, diffuse, _lobes(atlas))[some]
    before = atlas.map("irradiance")[some]
    off = [(some.sum() / wanted.sum() - 1, _off(some, wanted)) for some in (before, found)]
    assert abs(off[0][0]) > 0.008
    assert abs(off[1][0]) < 0.3 * abs(off[0][0])
    assert off[1][1] < 0.02


def _beside(texels, before) -> np.ndarray:
    """(T,): what no frame shows of what is read together with what one shows."""
    return beside_seen(texels, before.coverage.observed | before.emissive)


def test_where_nothing_filters_its_noise_rays_tell_the_lobes_light(room: Room, tmp_path: Path):
    atlas = room.clean
    lit, which = atlas.lit_scene(black_environment()), _reflecting(room, room.clean)
    traced, same = atlas.irradiance, np.zeros_like(atlas.lit)
    one, other = (
        refined_irradiance(
            TaskRun(tmp_path, "fit", tmp_path / f"work{seed}"), lit, traced, same, _lobes(atlas),
            "none", seed,
        )[which]
        for seed in (1, 2)
    )  # fmt: skip
    noise = np.sqrt(np.mean((one - other) ** 2) / 2) / np.mean(one - traced[which])
    assert noise < 0.2, noise


def test_what_nobody_saw_reflects_the_light_that_reaches_it(fitted: Asset):
    atlas = _atlas(fitted)
    unseen = ~atlas.coverage.observed
    unseen &= (atlas.map_where_present("emission", 3) == 0).all(axis=1)
    reflects = atlas.map("base_color") * atlas.map("refined_irradiance") / np.pi
    rim = _beside(atlas.texels, atlas)
    assert rim.sum() > 5
    lit, kept = atlas.map("diffuse")[rim].mean(axis=1), reflects[rim].mean(axis=1)
    filled = np.abs(lit / kept - 1) > 0.05
    assert filled.any()
    assert (lit[filled] < 0.55 * kept[filled]).all()
    unseen &= ~rim
    assert unseen.sum() > 50
    np.testing.assert_allclose(atlas.map("diffuse")[unseen], reflects[unseen], rtol=4e-3, atol=1e-4)


def test_what_no_frame_shows_is_beside_what_one_shows(room: Room):
    texels = AssetMaps(open_measured(room.glossy)).texels
    size = texels.resolution.prod(axis=1)
    own = texels.of_object(int(size.argmax()))
    seen = np.zeros(len(texels), np.bool_)
    seen[(own.start + own.stop) // 2] = True

    class Before:
        coverage = CoverageMap.of(seen, np.zeros_like(seen))
        emissive = np.zeros_like(seen)

    assert 9 <= np.count_nonzero(_beside(texels, Before())) < 49
    Before.emissive = ~seen
    assert not _beside(texels, Before()).any()


def _refined(room: Room, folder: Path) -> np.ndarray:
    """Refined irradiance of the glossy room in its own lit texture."""
    atlas = AssetMaps(open_measured(room.glossy))
    run = TaskRun(folder, "fit", folder / "work")
    lit, diffuse = atlas.lit_scene(black_environment()), 0.8 * atlas.map("lit")
    return _irradiance(run, atlas, lit, diffuse, _lobes(atlas))


def test_the_light_of_unseen_places_is_what_they_reflect(room: Room, tmp_path: Path, monkeypatch):
    atlas = AssetMaps(open_measured(room.glossy))
    frames, lit = frames_from_stage(atlas.stage), atlas.lit_scene(black_environment())
    given = []

    def spied(run, lit, traced, change, *others):
        given.append(atlas.light + change)
        return refined_irradiance(run, lit, traced, change, *others)

    monkeypatch.setattr(refine, "refined_irradiance", spied)
    run = TaskRun(tmp_path, "fit", tmp_path / "work")
    found = _refined_light(run, atlas, lit, frames)
    unseen = ~atlas.coverage.observed
    unseen &= (atlas.map_where_present("emission", 3) == 0).all(axis=1)
    unseen &= ~_beside(atlas.texels, atlas)
    # The base colour is filled in alike, whichever irradiance it is made with.
    share = given[0][unseen] / found.diffuse[unseen]
    change = atlas.map("irradiance")[unseen] / found.irradiance[unseen]
    assert np.median(np.abs(share / change - 1)) < 0.05
    lit_there = atlas.map("lit")[unseen]
    assert np.median(np.abs(given[0][unseen] / lit_there - 1)) > 0.1


def test_irradiance_is_of_the_light_that_the_maps_hold(room: Room):
    """With what hidden surfaces were taken to reflect, and not with what was filled in."""
    atlas = AssetMaps(open_measured(room.glossy))
    hidden = ~(atlas.coverage.observed | atlas.emissive)
    assert (atlas.map_where_present("hidden", 3)[~hidden] == 0).all()
    assert np.median(np.abs(atlas.light / atlas.lit - 1)[hidden]) > 0.1
    seen = ~(hidden | atlas.emissive)
    np.testing.assert_array_equal(atlas.light[seen], atlas.lit[seen])
    some = np.flatnonzero(atlas.coverage.measured)[::9]
    closely = Sampling(standard_error=0.005, max_rays=2048)

    def off(light: np.ndarray) -> float:
        shining, dark = Shining.of(atlas.surface, light), black_environment()
        again = irradiance_of_texels(atlas.surface, shining, dark, some, 5, closely)
        return float(np.abs(again.mean(axis=1) / atlas.irradiance[some].mean(axis=1) - 1).mean())

    filled = np.where(atlas.emissive[:, None], atlas.emission, atlas.lit)
    assert off(atlas.light) < 0.7 * off(filled)


def test_what_is_too_dark_for_a_sample_stays_dark(room: Room):
    """Texels of the floor that no frame measured to more than that; not those around them."""
    atlas = room.clean
    lit = np.array(atlas.lit)
    own = np.flatnonzero(atlas.coverage.measured & (atlas.texels.object_index() == 0))
    dark = own[np.arange(len(own)) % 7 < 3]
    lit[dark] = 1e-5
    before = SimpleNamespace(
        lit=lit, emission=atlas.emission, emissive=atlas.emissive, coverage=atlas.coverage,
        irradiance=atlas.irradiance,
    )  # fmt: skip
    lobes, lighting = _lobes(atlas), Lighting("", atlas.lit_scene(black_environment()), before, ())
    level = refined_means.level_of(lit)[:, None]
    mean = np.where(atlas.coverage.measured[:, None], lit / level, np.nan).astype(np.float32)
    mean[dark] = np.nan
    flat = np.zeros(len(lit), np.float32)
    beside = np.zeros((len(lit), 3), np.float32)
    found = RobustMean(mean, flat, beside, beside + 1)
    diffuse, _, error = refine._diffuse_of_means(lighting, found, lobes)
    np.testing.assert_allclose(diffuse[dark], 1e-5, rtol=1e-3)
    assert np.isinf(error[dark]).all()


def test_what_is_only_glimpsed_keeps_what_it_shows(room: Room):
    """The box, as if no frame had seen it alone: its texels tell no more than that."""
    atlas = room.clean
    box = atlas.texels.object_index() == next(
        i for i, item in enumerate(atlas.scene.objects) if item.label == "box"
    )
    measured = atlas.coverage.measured
    coverage = CoverageMap.of(measured & ~box, atlas.coverage.clipped, measured & box)
    before = SimpleNamespace(
        lit=atlas.lit, emission=atlas.emission, emissive=atlas.emissive, coverage=coverage,
        irradiance=atlas.irradiance,
    )  # fmt: skip
    lobes, lighting = _lobes(atlas), Lighting("", atlas.lit_scene(black_environment()), before, ())
    level = refined_means.level_of(atlas.lit)[:, None]
    mean = np.where(coverage.measured[:, None], atlas.lit / level, np.nan).astype(np.float32)
    flat, beside = np.zeros(len(mean), np.float32), np.zeros((len(mean), 3), np.float32)
    found = RobustMean(mean, flat, beside, beside + 1)
    told = refine._diffuse_of_means(lighting, found, lobes)
    own = coverage.glimpsed
    assert own.sum() > 20
    np.testing.assert_allclose(told.diffuse[own], atlas.lit[own], rtol=1e-4)
    np.testing.assert_allclose(told.in_own_light[own], atlas.lit[own], rtol=1e-4)
    assert (told.error[own] == 1).all()
    shown = refine._reflection(lighting, told, atlas.irradiance)
    base_color = base_color_of(atlas.texels, [shown])[box]
    true = np.pi * atlas.lit[own] / atlas.irradiance[own]
    np.testing.assert_allclose(
        np.median(base_color, axis=0), np.median(np.clip(true, 0, 1), axis=0), rtol=0.2
    )


def test_tiles_do_not_show(room: Room, tmp_path: Path, monkeypatch):
    whole = _refined(room, tmp_path / "whole")
    monkeypatch.setattr(shaded, "_TILE", 300)
    np.testing.assert_array_equal(_refined(room, tmp_path / "tiles"), whole)


def test_lamps_do_not_light_twice(room: Room, tmp_path: Path, monkeypatch):
    """A lamp of which more is known than the lit texture shows has lit S already."""
    by_name = AssetMaps.map_where_present

    def brighter(atlas: AssetMaps, aov: str, channels: int) -> Float:
        return by_name(atlas, aov, channels) * (2 if aov == "emission" else 1)

    monkeypatch.setattr(AssetMaps, "map_where_present", brighter)
    lobes = _dielectric(np.ones(5, np.float32), np.zeros(5, np.float32))
    atlas = AssetMaps(open_measured(room.glossy))
    emission = atlas.map_where_present("emission", 3)
    diffuse = np.where(emission > 0, emission, atlas.map("lit"))
    run, lit = TaskRun(tmp_path, "fit", tmp_path / "work"), atlas.lit_scene(black_environment())
    found = _irradiance(run, atlas, lit, diffuse, lobes)
    traced = atlas.map("irradiance")
    reflects = _reflecting(room, atlas)
    # No lobe but its grazing part, so nothing is added but a few per cent.
    assert np.median(found[reflects] / traced[reflects]) < 1.1


def test_the_base_colour_is_the_refined_radiance_over_the_refined_irradiance(fitted: Asset):
    atlas = _atlas(fitted)
    base_color = atlas.map("base_color")
    assert base_color.min() >= 0
    assert base_color.max() <= 1
    measured = atlas.coverage.measured
    dark = measured & (atlas.map_where_present("emission", 3) == 0).all(axis=1)
    wanted = np.pi * atlas.map("diffuse") / atlas.map("refined_irradiance")
    # But for what pixels mix where the light is uneven.
    off = base_color[dark] - np.clip(wanted, 0, 1)[dark]
    assert abs(np.median(off)) < 2e-3
    assert np.percentile(np.abs(off), 75) < 0.02


def test_the_lamp_keeps_its_radiance(room: Room, fitted: Asset):
    atlas = _atlas(fitted)
    index = [item.label for item in atlas.scene.objects].index("lamp")
    own = atlas.texels.of_object(index)
    assert read_shading(atlas.stage, atlas.scene.objects[index].prim_path).emitter
    emission = atlas.map_where_present("emission", 3)[own]
    shines = (emission > 0).any(axis=1)
    assert shines.sum() > 10
    np.testing.assert_array_equal(atlas.map("diffuse")[own][shines], emission[shines])
    np.testing.assert_array_equal(atlas.map("base_color")[own][shines], 0)


def _diffuse_color(asset: Asset, label: str) -> str:
    """The file that a renderer reads an object's colour from."""
    stage = Usd.Stage.Open(str(asset.root_layer))
    prim = stage.GetPrimAtPath(f"{stage.GetDefaultPrim().GetPath()}/geo/{label}/{label}")
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    shader = material.ComputeSurfaceSource()[0]
    sources, _ = shader.GetInput("diffuseColor").GetConnectedSources()
    texture = UsdShade.Shader(sources[0].source.GetPrim())
    return Path(texture.GetInput("file").Get().path).name


def test_the_material_shows_the_base_colour(fitted: Asset):
    assert _diffuse_color(fitted, "floor") == "floor.base_color.exr"
    assert (fitted.folder / "previews" / "base_color.png").is_file()


def test_other_fits_leave_the_albedo(room: Room):
    paper = _fitted(room, "paper", usdbrdf.FitOptions(method="paper", max_pixels=60))
    stage = open_measured(paper)
    for item in AssetMaps(stage).scene.objects:
        names = {aov.name for aov in read_aovs(stage, item.prim_path)}
        assert "lit" in names
        assert not names & {"diffuse", "refined_irradiance", "base_color"}
    assert _diffuse_color(paper, "floor") == "floor.albedo.exr"


def _contents(folder: Path) -> dict[str, str]:
    """SHA-256 of every texture."""
    files = sorted((folder / "textures").iterdir())
    return {path.name: sha256_of(path) for path in files if path.is_file()}


def test_an_interrupted_refinement_goes_on(room: Room, fitted: Asset, monkeypatch):
    starts = []
    through_all = refined_means.samples_from_frames

    def interrupted(surface, frames, read, order, part):
        starts.append(NUM_FRAMES - len(order))
        for done, samples in enumerate(through_all(surface, frames, read, order, part)):
            yield samples
            if len(starts) == 1 and done == INTERRUPTED:
                raise KeyboardInterrupt

    monkeypatch.setattr(task_module, "_SAVE_AFTER", 0.0)
    monkeypatch.setattr(task_module, "_SAVE_SELDOM", 0.0)
    monkeypatch.setattr(refined_means, "samples_from_frames", interrupted)
    with pytest.raises(KeyboardInterrupt):
        _fitted(room, "again", OPTIONS)
    folder = room.folder / "assets" / "again"
    assert not list((folder / "textures").glob("*.diffuse.exr"))
    with usdbrdf.working_on(folder) as asset:
        usdbrdf.fit(asset, OPTIONS)
    assert starts == [0, INTERRUPTED + 1]
    assert _contents(folder) == _contents(fitted.folder)


@pytest.mark.parametrize("memory", [None, 0.01])
def test_frames_are_decoded_once_where_memory_suffices(
    room: Room, fitted: Asset, monkeypatch, memory: float | None
):
    decoded: Counter[int] = Counter()

    def counting(of: Frames, i: int) -> FramePixels:
        decoded[i] += 1
        return read_frame(of, i)

    monkeypatch.setattr("usdbrdf.files.frames.read_frame", counting)
    found = _fitted(room, f"read with {memory}", replace(OPTIONS, memory=memory))
    # For the survey, for the means and for the patterns, with S and without.
    assert decoded == dict.fromkeys(range(NUM_FRAMES), 1 if memory is None else 4)
    assert _contents(found.folder) == _contents(fitted.folder)


def test_passes_for_lack_of_memory_change_no_byte(room: Room, fitted: Asset, monkeypatch, capsys):
    def three(texels, *_):
        ends = [0, len(texels) // 3, len(texels) // 2, len(texels)]
        return [slice(a, b) for a, b in pairwise(ends)]

    monkeypatch.setattr(refined_means, "groups_of_texels", three)
    set_quiet(False)
    thrice = _fitted(room, "thrice", replace(OPTIONS, memory=1.0))
    set_quiet(True)
    assert "3 passes over the frames" in capsys.readouterr().err
    assert _contents(thrice.folder) == _contents(fitted.folder)


def test_too_little_memory_is_no_reason_to_stop_at_the_end(room: Room, fitted: Asset, capsys):
    set_quiet(False)
    narrow = _fitted(room, "narrow", replace(OPTIONS, memory=0.01))
    set_quiet(True)
    assert "warning: " in (said := capsys.readouterr().err)
    assert "the limit is 0.0" in said
    assert _contents(narrow.folder) == _contents(fitted.folder)


def test_of_texels_that_many_frames_see_some_samples_are_enough():
    texel = np.arange(40_000, dtype=np.int32)
    samples = np.repeat(np.float32([5, 24, 48, 96]), 10_000)
    frames = [refined_means.subsample(texel, samples, frame, 7) for frame in range(48)]
    share = np.mean(frames, axis=0).reshape(4, -1)
    assert (share[:2] == 1).all()
    np.testing.assert_allclose(share[2:].mean(axis=1), [0.5, 0.25], atol=0.005)
    # Independent from frame to frame, and of what else is asked for.
    np.testing.assert_allclose(share[2:].std(axis=1), np.sqrt([0.25 / 48, 0.1875 / 48]), rtol=0.05)
    some = np.arange(25_000, 40_000, 7)
    np.testing.assert_array_equal(
        refined_means.subsample(texel[some], samples[some], 3, 7), frames[3][some]
    )
