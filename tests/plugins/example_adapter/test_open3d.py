"""The example adapter, installed as a stranger would, on an Open3D capture with known cameras."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from pxr import Sdf, Usd

from tests.scenes import make_capture
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.asset.readers.scene import frames_from_stage
from usdbrdf.capture.adapters import read_scan
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions


@pytest.fixture(scope="module")
def installed(plugins, tmp_path_factory):
    """A folder for PYTHONPATH with the package and the metadata that pip would write."""
    tomllib = pytest.importorskip("tomllib", reason="part of Python from 3.11 on")
    source = plugins / "example_adapter"
    project = tomllib.loads((source / "pyproject.toml").read_text("utf-8"))
    name, version = project["project"]["name"].replace("-", "_"), project["project"]["version"]
    site = tmp_path_factory.mktemp("site é")
    for package in project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        shutil.copytree(source / package, site / package)
    metadata = site / f"{name}-{version}.dist-info"
    metadata.mkdir()
    head = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    (metadata / "METADATA").write_text(head, "utf-8")
    points = "".join(
        f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in entries.items())
        for group, entries in project["project"]["entry-points"].items()
    )
    (metadata / "entry_points.txt").write_text(points, "utf-8")
    return site


@pytest.fixture
def usdbrdf(installed, tmp_path):
    """The command line with the package installed."""

    def run(*arguments):
        return subprocess.run(
            [sys.executable, "-m", "usdbrdf", *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": str(installed)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=900,
        )

    return run


@pytest.fixture
def capture(tmp_path):
    """The box room as Open3D writes it."""
    made = make_capture(tmp_path / "Zimmer é (1)")
    made.manifest.unlink()
    (made.folder / "frames").rename(made.folder / "images")
    fx, fy, cx, cy = made.intrinsics.tolist()
    # Lists in column order; pixel centres are whole numbers.
    matrix = [fx, 0.0, 0.0, 0.0, fy, 0.0, cx - 0.5, cy - 0.5, 1.0]
    cameras = []
    for pose in made.world_from_camera:
        # Open3D's camera sees y down and looks along +z.
        camera_from_world = np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0]))
        cameras.append(
            {
                "class_name": "PinholeCameraParameters",
                "extrinsic": camera_from_world.T.reshape(-1).tolist(),
                "intrinsic": {"width": 32, "height": 24, "intrinsic_matrix": matrix},
            }
        )
    document = {"class_name": "PinholeCameraTrajectory", "parameters": cameras}
    (made.folder / "trajectory.json").write_text(json.dumps(document))
    return made


def test_it_is_listed(usdbrdf):
    done = usdbrdf("adapters")
    assert done.returncode == 0
    [line] = [x for x in done.stdout.splitlines() if x.startswith("open3d ")]
    assert "Open3D camera trajectory" in line
    assert "(usdbrdf_open3d)" in line


def test_the_cameras_are_the_true_ones(usdbrdf, capture, tmp_path):
    asset = tmp_path / "asset é"
    done = usdbrdf("ingest", capture.folder, "-o", asset)
    assert done.returncode == 0, done.stderr
    assert "[open3d.saturation]" in done.stderr
    [root] = [p for p in asset.glob("*.usda") if p.name != "edits.usda"]
    stage = Usd.Stage.Open(str(root))
    frames = frames_from_stage(open_weaker(Asset.at(asset), "texturing"))
    assert [p.name for p in frames.image_paths] == [f"{i:04d}.exr" for i in range(12)]
    np.testing.assert_allclose(frames.world_from_camera, capture.world_from_camera, atol=1e-5)
    np.testing.assert_allclose(frames.intrinsics, np.tile(capture.intrinsics, (12, 1)), atol=1e-5)
    meshes = [prim.GetName() for prim in stage.Traverse() if prim.IsA("Mesh")]
    assert sorted(meshes) == sorted(capture.names)


def test_an_upgraded_adapter_reads_again(installed, capture, tmp_path, monkeypatch, capsys):
    site = tmp_path / "site"
    shutil.copytree(installed, site)
    monkeypatch.syspath_prepend(site)

    def said():
        assert main(["ingest", str(capture.folder), "-o", str(tmp_path / "asset")]) == 0
        return capsys.readouterr().err.splitlines()[-1]

    assert said().endswith(": written")
    assert said().endswith(": up to date")
    (metadata,) = site.glob("*.dist-info/METADATA")
    metadata.write_text(re.sub(r"(?m)^Version: .*$", "Version: 9.1", metadata.read_text()))
    assert said().endswith(": written")
    assert said().endswith(": up to date")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "asset/layers/scan.usdc"))
    parameters = layer.customLayerData["usdbrdf"]["parameters"]
    assert parameters["adapter_package"] == "usdbrdf_open3d 9.1"


def test_scale_and_axis_are_the_users(installed, capture, monkeypatch):
    monkeypatch.syspath_prepend(installed)
    scan = read_scan(capture.folder, IngestOptions(meters_per_unit=0.01, up_axis="Y"))
    assert (scan.adapter, scan.meters_per_unit, scan.up_axis) == ("open3d", 0.01, "Y")


def _document(change):
    def edit(made):
        path = made.folder / "trajectory.json"
        path.write_text(change(path.read_text()))

    return edit


def _without_inverse(text):
    document = json.loads(text)
    document["parameters"][2]["extrinsic"] = [0.0] * 16
    return json.dumps(document)


@pytest.mark.fault("C14")
@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (_document(lambda t: t[:60]), ["not a camera trajectory", "[open3d.trajectory]"]),
        (_document(lambda t: "[]"), ["not a camera trajectory", "[open3d.trajectory]"]),
        (_document(_without_inverse), ["camera 2", "[open3d.trajectory]"]),
        (lambda made: made.folder.joinpath("images/0003.exr").unlink(), ["11 images", "12 cam"]),
        (lambda made: (made.folder / "mesh.ply").unlink(), ["--mesh", "[open3d.mesh]"]),
    ],
    ids=["cut off", "list", "singular", "images", "no mesh"],
)
def test_what_is_refused(installed, capture, monkeypatch, edit, words):
    monkeypatch.syspath_prepend(installed)
    edit(capture)
    with pytest.raises(InputRefused) as refusal:
        read_scan(capture.folder, IngestOptions())
    for word in words:
        assert word in str(refusal.value)
    # That would be a fault of the adapter.
    assert "[adapter.read]" not in str(refusal.value)
