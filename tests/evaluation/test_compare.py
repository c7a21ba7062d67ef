"""`usdbrdf compare`: assets with themselves, with finer texels, with other meshes."""

from __future__ import annotations

import numpy as np
import pytest

import usdbrdf
from tests.json_schemas import checked
from tests.scenes import edited, make_capture
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused
from usdbrdf.evaluation.compare_assets import correspondence, matched, relit
from usdbrdf.evaluation.evaluate_views import measured_atlas


@pytest.fixture(scope="module")
def fine(make):
    return make(texel_size=0.1)


@pytest.fixture(scope="module")
def itself(room, tmp_path_factory):
    output = tmp_path_factory.mktemp("itself") / "out"
    return output, usdbrdf.compare(room.asset, room.asset, output)


def test_an_asset_agrees_with_itself_exactly(room, itself):
    output, found = itself
    assert found["texels"] > 500
    assert found["lit"]["albedo"] == {"nrmse": 0, "median_abs_relative": 0, "median_signed": 0}
    assert found["lit"]["relit_a"] == found["lit"]["relit_b"]
    objects = {row["object"] for row in found["objects"]}
    assert {"floor", "walls"} <= objects <= set(room.capture.names) - {"lamp"}
    files = {p.relative_to(output).as_posix() for p in output.rglob("*.*")}
    assert files == set(found["files"])
    assert sum(name.startswith("pictures/") for name in files) == 4


def test_own_albedo_under_own_light_gives_the_radiance_back(room):
    _, atlas = measured_atlas(room.asset)
    same, scored = matched(atlas, atlas)
    maps = ("lit", "irradiance", "albedo")
    back = relit(atlas, atlas, (same, scored), maps)
    # Albedos above 1, of which this room has many, were cut off; the rest is half floats.
    whole = scored & (back.albedo < 0.99).all(axis=1)
    assert whole.sum() > 100
    assert np.abs(back.predicted[whole] / back.measured[whole] - 1).max() < 2e-3


def test_both_sets_of_maps_where_both_assets_have_them(room, separated, tmp_path):
    both = usdbrdf.compare(separated.asset, separated.asset, tmp_path / "both")
    assert both["diffuse"]["albedo"]["nrmse"] == both["lit"]["albedo"]["nrmse"] == 0
    # Half the albedo under all the light is half the radiance, on either side.
    assert both["diffuse"]["relit_a"]["nrmse"] == pytest.approx(
        both["lit"]["relit_a"]["nrmse"], abs=1e-3
    )
    assert {row["maps"] for row in both["objects"]} == {"lit", "diffuse"}
    one = usdbrdf.compare(room.asset, separated.asset, tmp_path / "one")
    assert "diffuse" not in one


def test_a_brighter_picture_of_the_same_room_has_the_same_albedo(room, itself, make, tmp_path):
    twice = {name: tuple(2 * v for v in rgb) for name, rgb in room.capture.radiance.items()}
    brighter = make(radiance=twice, saturation_radiance=128.0)
    found = usdbrdf.compare(room.asset, brighter.asset, tmp_path / "out")
    # All light is doubled, so that S is and albedo is not.
    assert found["lit"]["albedo"]["nrmse"] < 0.01
    assert found["lit"]["relit_a"]["nrmse"] == pytest.approx(
        itself[1]["lit"]["relit_a"]["nrmse"], abs=0.01
    )


def test_texels_of_another_size_are_found_where_they_are(room, fine):
    for one, other in ((room, fine), (fine, room)):
        a, b = (measured_atlas(x.asset)[1] for x in (one, other))
        same = correspondence(a, b)
        assert (same.texel >= 0).all()
        assert (same.face >= 0).any()
        away = np.linalg.norm(same.interpolated(b.texels.position) - a.texels.position, axis=1)
        # Bilinear inside a chart; at its border the gutter holds the nearest texel.
        assert np.median(away) < 1e-3
        assert away.max() < 0.2
        nearest = b.texels.position[same.texel]
        assert np.linalg.norm(nearest - a.texels.position, axis=1).max() < 0.25


def test_the_same_maps_on_finer_texels_differ_little(room, fine, tmp_path):
    found = usdbrdf.compare(room.asset, fine.asset, tmp_path / "out")
    # What is left is the noise of S, from different rays.
    assert found["lit"]["albedo"]["median_abs_relative"] < 0.1


def test_other_triangles_of_the_same_shape_are_found_by_nearness(room, tmp_path):
    other = textured(make_capture(tmp_path / "scan", subdivisions=3), tmp_path / "other")
    a, b = (measured_atlas(folder)[1] for folder in (room.asset, other))
    same = correspondence(a, b)
    assert (same.face < 0).all()
    known = same.texel >= 0
    assert known.mean() > 0.99
    away = np.linalg.norm(same.interpolated(b.texels.position) - a.texels.position, axis=1)
    assert away[known].max() < 0.35
    owner, theirs = a.texels.object_index(), b.texels.object_index()[same.texel]
    labels = [[obj.label for obj in atlas.scene.objects] for atlas in (a, b)]
    assert all(
        labels[0][i] == labels[1][j] for i, j in zip(owner[known], theirs[known], strict=True)
    )


def textured(capture, folder):
    with usdbrdf.working_on(folder) as asset:
        usdbrdf.ingest(capture.folder, asset, usdbrdf.IngestOptions())
        usdbrdf.texture(asset, usdbrdf.TextureOptions(texel_size=0.15))
    return folder


def test_assets_without_a_common_object_are_refused(room, tmp_path):
    capture = make_capture(tmp_path / "scan")
    with edited(capture.folder / "objects.json") as document:
        for obj in document["objects"]:
            obj["name"] += "_b"
    with pytest.raises(InputRefused, match=r"share no object.*\[compare.objects\]"):
        usdbrdf.compare(room.asset, textured(capture, tmp_path / "b"), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_assets_that_are_merely_textured_are_refused(tmp_path):
    asset = textured(make_capture(tmp_path / "scan"), tmp_path / "a")
    with pytest.raises(InputRefused, match=r"a has no irradiance and no albedo.*\[compare.maps\]"):
        usdbrdf.compare(asset, asset, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_assets_in_different_places_are_refused(room):
    _, atlas = measured_atlas(room.asset)
    far = measured_atlas(room.asset)[1]
    far.scene.points[:] += 100
    far.texels.position[:] += 100
    with pytest.raises(InputRefused, match=r"no surface.*\[compare.surface\]"):
        correspondence(atlas, far)


def test_the_command_prints_its_figures(room, tmp_path, capsys):
    output = tmp_path / "out"
    assert main(["compare", str(room.asset), str(room.asset), "-o", str(output), "--json"]) == 0
    out, err = capsys.readouterr()
    assert checked(out, "compare")["lit"]["albedo"]["nrmse"] == 0
    assert "NRMSE of lit: albedo 0.00 %" in err
