"""The texturing step on captures that show little or are in another unit."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import OpenImageIO as oiio
import pytest

import usdbrdf
from tests.scenes import make_capture, ring_of_poses, write_ply
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import MapWriter, TexelMap
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.job.task import TaskRun
from usdbrdf.model.scene import SceneObject
from usdbrdf.model.texels import CoverageMap
from usdbrdf.texturing import lit_texture as module
from usdbrdf.texturing.lit_texture import LitTexture

OPTIONS = usdbrdf.TextureOptions(texel_size=0.2)


def _textured(base, made):
    with usdbrdf.working_on(base / "asset") as asset:
        usdbrdf.ingest(made.folder, asset, usdbrdf.IngestOptions())
        return usdbrdf.texture(asset, OPTIONS)


def test_faces_wound_away_from_all_cameras_are_turned(tmp_path):
    made = make_capture(tmp_path / "scan", frames=8, subdivisions=1)
    expected = _textured(tmp_path / "right", made).summary["measured_fraction"]
    inside_out = made.triangles[:, ::-1]
    write_ply(made.folder / "mesh.ply", made.points, inside_out, made.face_object)
    assert _textured(tmp_path / "turned", made).summary["measured_fraction"] == expected


def test_frames_too_small_to_show_any_texel_are_refused(tmp_path):
    made = make_capture(tmp_path / "scan", frames=8, subdivisions=1, size=(2, 2), noise=0.1)
    with pytest.raises(InputRefused, match=r"no frame sees.*\[texturing.unseen\]") as caught:
        _textured(tmp_path, made)
    assert caught.value.exit_code == 3
    assert not (tmp_path / "asset" / "textures").exists()


def _texture_of(coverage: CoverageMap) -> LitTexture:
    nothing = np.zeros((len(coverage.kind), 3), np.float32)
    return LitTexture(
        lit=nothing, mean=nothing, spread=nothing, samples=nothing[:, 0], coverage=coverage
    )


def test_a_capture_that_shows_little_of_the_mesh_is_warned_about():
    some = np.arange(100) < 9
    (doubt,) = _texture_of(CoverageMap.of(some, ~some)).doubts()
    assert "91.0 % of the texels" in doubt
    assert not [*_texture_of(CoverageMap.of(~some, some)).doubts()]


@pytest.mark.fault("R13")
def test_passes_for_lack_of_memory_change_no_byte(tmp_path, monkeypatch, capsys):
    made = make_capture(tmp_path / "scan", frames=9, subdivisions=1)
    once, thrice = tmp_path / "once", tmp_path / "thrice"
    _textured(once, made)

    def three(texels, *_):
        ends = [0, len(texels) // 3, len(texels) // 2, len(texels)]
        return [slice(a, b) for a, b in pairwise(ends)]

    monkeypatch.setattr(module, "groups_of_texels", three)
    capsys.readouterr()
    _textured(thrice, made)
    assert "3 passes over the frames" in capsys.readouterr().err
    files = sorted((once / "asset" / "textures").iterdir())
    assert len(files) == 25
    for file in files:
        assert (thrice / "asset" / "textures" / file.name).read_bytes() == file.read_bytes()


def test_the_memory_is_no_parameter_of_the_result(tmp_path):
    made = make_capture(tmp_path / "scan", frames=9, subdivisions=1)
    _textured(tmp_path, made)
    with usdbrdf.working_on(tmp_path / "asset") as asset:
        again = usdbrdf.texture(asset, replace(OPTIONS, memory=2.0))
    assert not again.reran
    with pytest.raises(UsageError, match="memory"):
        replace(OPTIONS, memory=0.0)


class _Picture:
    """Texels of one object that are its whole picture."""

    def image(self, index: int, values: np.ndarray) -> np.ndarray:
        return values.reshape(2, 4, 3)


@pytest.mark.fault("I14")
@pytest.mark.parametrize(("unit", "stored"), [(1.0, "half"), (1e5, "float"), (1e-7, "float")])
def test_maps_keep_their_digits_whatever_the_unit(tmp_path, unit, stored):
    values = np.float32(unit) * np.random.default_rng(3).lognormal(-2, 1, (8, 3)).astype(np.float32)
    values[5] = 0
    obj = SceneObject(
        prim_path="/a/box", identifier="box", label="", class_name="", first_face=0, num_faces=1
    )
    run = TaskRun(tmp_path, "texture", tmp_path / "work")
    writer = MapWriter(run, Asset(tmp_path, "a"), SimpleNamespace(objects=[obj]), _Picture())
    (lit,) = writer.write(0, {"lit": TexelMap(values, 1.0, "W/(m^2 sr)")})
    file = writer.run.output(lit.file)
    np.testing.assert_allclose(read_exr(file).reshape(8, 3), values, rtol=5e-4)
    assert str(oiio.ImageInput.open(str(file)).spec().format) == stored


def test_a_capture_near_the_end_of_half_floats_keeps_its_lit_map(tmp_path, capsys):
    made = make_capture(
        tmp_path / "scan", subdivisions=1, room=False, poses=ring_of_poses(8),
        radiance={"box": (64_000, 61_000, 62_000)}, saturation_radiance=65_500,
    )  # fmt: skip
    _textured(tmp_path, made)
    lit = read_exr(tmp_path / "asset" / "textures" / "box.lit.exr")
    assert lit.max() == pytest.approx(64_000)
    assert "[image.clamped]" not in capsys.readouterr().err


@pytest.mark.fault("C8")
@pytest.mark.parametrize("wrong", [[7], range(1, 12, 2)], ids=["one frame", "every second frame"])
def test_exposures_that_contradict_each_other_are_noticed(tmp_path, capsys, wrong):
    made = make_capture(tmp_path / "scan", noise=0.02, noise_floor_radiance=0)
    for i in wrong:
        write_exr(made.image(i), 4 * read_exr(made.image(i)))
    if len(wrong) > 1:
        with pytest.raises(
            InputRefused, match=r"of 12 frames .*0001\.exr \(.*exposure\]$"
        ) as caught:
            _textured(tmp_path, made)
        assert caught.value.exit_code == 3
        return
    found = _textured(tmp_path, made).summary["contradicting_frames"]
    assert found == {"0007.exr": pytest.approx(4, rel=0.05)}
    assert "0007.exr (" in capsys.readouterr().err
