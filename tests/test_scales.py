"""A room of 12.5 cm and one of 128 m are one room: no rule, no threshold and no offset knows how
large things usually are.

The sizes are powers of two apart, so that every length is exactly as many times another and all
that is made of them is equal to the last bit, unless something compares a length with a constant.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.scenes import edited, make_capture, poses_down_and_up, write_ply
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import capture_camera
from usdbrdf.cli import main

COARSE = ["--standard-error", "0.1", "--rays", "64", "--max-pixels", "60", "--json"]
# Of a room of 4 m.
SMALL, LARGE = 2.0**-5, 2.0**5
# What is not of the scene, times and places of files; and the one length of a summary.
ELSEWHERE = ("seconds", "reason", "asset", "texel_size")
MAPS = ("lit", "coverage", "samples", "irradiance", "albedo")


def _converted(
    folder: Path, capsys: pytest.CaptureFixture[str], scale: float
) -> tuple[dict[str, Any], Asset]:
    """What is said of a room as many times as large, and its asset."""
    made = make_capture(
        folder / "scan", subdivisions=2, poses=poses_down_and_up(6, 6), noise=0.01,
        # The lamp clips in every frame: its radiance follows from the light that it casts.
        saturation_radiance=4.0,
    )  # fmt: skip
    points = (scale * made.points.astype(np.float64)).astype(np.float32)
    write_ply(made.folder / "mesh.ply", points, made.triangles, made.face_object)
    with edited(made.manifest) as document:
        for frame in document["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= scale
    given = [str(made.folder), "-o", str(folder / "out"), "--texel-size", str(0.25 * scale)]
    assert main(["convert", *given, *COARSE]) == 0
    return json.loads(capsys.readouterr().out)["steps"], Asset.at(folder / "out")


def _without(told: Any) -> Any:
    if isinstance(told, list):
        return [_without(one) for one in told]
    if not isinstance(told, dict):
        return told
    return {key: _without(value) for key, value in told.items() if key not in ELSEWHERE}


def test_maps_and_summaries_do_not_know_how_large_the_scene_is(tmp_path, capsys):
    (told, small), (again, large) = (
        _converted(tmp_path / str(scale), capsys, scale) for scale in (SMALL, LARGE)
    )
    assert _without(told) == _without(again)
    one, other = (AssetMaps(open_measured(asset)) for asset in (small, large))
    np.testing.assert_array_equal(LARGE / SMALL * one.texels.position, other.texels.position)
    for name in MAPS:
        np.testing.assert_array_equal(one.map(name), other.map(name), err_msg=name)
    for asset, scale in ((small, SMALL), (large, LARGE)):
        stage = open_measured(asset)
        near, far = capture_camera(stage).GetClippingRangeAttr().Get()
        assert near < 0.1 * scale
        assert far > 10 * scale
