"""What ``import usdbrdf`` offers, and the steps as Python calls them."""

from __future__ import annotations

import ast
import inspect
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import usdbrdf
from tests.scenes import make_capture
from usdbrdf.asset.layout import Asset
from usdbrdf.errors import FolderBusy, OwnershipConflict, UsageError
from usdbrdf.job.ownership import folder_lock


def declared():
    """The names that type checkers and editors are told of."""
    tree = ast.parse(inspect.getsource(usdbrdf))
    block = next(n for n in tree.body if isinstance(n, ast.If) and "TYPE" in ast.unparse(n.test))
    imports = [n for n in block.body if isinstance(n, ast.ImportFrom) and "usdbrdf" in n.module]
    return {(name.name, node.module) for node in imports for name in node.names}


def test_the_names_that_are_declared_are_there():
    assert declared() == set(usdbrdf._HOME_OF.items())
    for name, _ in declared():
        assert callable(getattr(usdbrdf, name))
        assert name in dir(usdbrdf)
    with pytest.raises(AttributeError, match="no attribute 'paint'"):
        _ = usdbrdf.paint


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: usdbrdf.IngestOptions(crease_angle_deg=181), "--crease-angle 181: .* at most 180"),
        (lambda: usdbrdf.IngestOptions(meters_per_unit=1e300), "--meters-per-unit"),
        (lambda: usdbrdf.TextureOptions(texel_size=float("nan")), "--texel-size nan: .* finite"),
        (lambda: usdbrdf.TextureOptions(memory=0), "--memory"),
        (lambda: usdbrdf.Sampling(max_rays=2), "--rays 2: expected a whole number of at least 4"),
        (lambda: usdbrdf.Sampling(estimator="best"), "--sampling best: expected mis, cosine"),
        (lambda: usdbrdf.ShadeOptions(denoise="yes"), "--denoise yes: expected auto, none, oidn"),
        (lambda: usdbrdf.EvaluateOptions(samples_per_pixel=8), "not a square number"),
        (lambda: usdbrdf.Insert(model=Path("a.ply"), at=(1.0, 2.0)), "at .* 3 finite numbers"),
        (lambda: usdbrdf.RelightOptions(exposure=1e300), "--exposure"),
        (lambda: usdbrdf.PackageOptions(profile="best"), "--profile best: expected default, arkit"),
    ],
)
def test_options_out_of_their_limits_are_refused_by_name(make, words):
    with pytest.raises(UsageError, match=rf"{words}.*\[usage\.option\]$"):
        make()


def test_the_papers_estimator_has_the_papers_rays():
    assert usdbrdf.Sampling().max_rays == 2048
    assert usdbrdf.Sampling(estimator="cosine").max_rays == 10_000
    assert usdbrdf.Sampling(estimator="cosine", max_rays=64).max_rays == 64


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("steps") / "scan", subdivisions=1).folder


def test_a_step_that_is_called_alone_has_its_folder_to_itself(capture, tmp_path):
    asset = Asset.at(tmp_path / "room")
    assert usdbrdf.ingest(capture, asset, usdbrdf.IngestOptions()).reran
    with folder_lock(asset.folder / ".usdbrdf"), ThreadPoolExecutor(1) as another:
        ingesting = another.submit(usdbrdf.ingest, capture, asset, usdbrdf.IngestOptions())
        assert isinstance(ingesting.exception(), FolderBusy)
    with (asset.folder / "layers/scan.usdc").open("ab") as layer:
        layer.write(b"by hand")
    with pytest.raises(OwnershipConflict):
        usdbrdf.texture(asset, usdbrdf.TextureOptions())


def test_the_thread_that_works_on_a_folder_goes_on_and_others_wait(capture, tmp_path):
    folder = tmp_path / "room"
    found = []

    def intrude():
        with pytest.raises(FolderBusy) as refused, usdbrdf.working_on(folder):
            pass
        found.append(refused.value)

    with usdbrdf.working_on(folder) as asset:
        assert usdbrdf.ingest(capture, asset, usdbrdf.IngestOptions()).reran
        with usdbrdf.working_on(folder / ".." / "room") as again:
            assert again.folder.samefile(folder)
        thread = threading.Thread(target=intrude)
        thread.start()
        thread.join()
    assert len(found) == 1
    with folder_lock(folder / ".usdbrdf"):
        pass
