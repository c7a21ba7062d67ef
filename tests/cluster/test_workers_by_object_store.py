"""Workers that see neither the asset nor the capture, but an object store: the same bytes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import usdbrdf.shading.shaded
from tests.cluster.object_server import BUCKET, let_us_in, objects, running_server
from tests.scenes import make_capture
from usdbrdf import pipeline
from usdbrdf.cluster.options import ClusterOptions
from usdbrdf.cluster.store import Store
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.atomic import sha256_of
from usdbrdf.options import ConvertOptions, FitOptions, Sampling, ShadeOptions, TextureOptions

pytest.importorskip("distributed", reason="the extra cluster is not installed")

PLACE = f"s3://{BUCKET}/of-workers"
# Its units read photographs.
OPTIONS = ConvertOptions(
    texture=TextureOptions(texel_size=0.15),
    shade=ShadeOptions(sampling=Sampling(max_rays=64), denoise="none"),
    fit=FitOptions(method="scaled", max_pixels=60),
)


@pytest.fixture(autouse=True)
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(usdbrdf.shading.shaded, "_TILE", 128)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running_server() as url:
        yield url


def contents(asset: Path) -> dict[str, str]:
    return {
        path.relative_to(asset).as_posix(): sha256_of(path)
        for path in sorted(asset.rglob("*"))
        if path.is_file() and ".usdbrdf" not in path.parts
    }


def test_the_bytes_are_the_same_and_no_worker_is_told_where_files_are(
    server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    let_us_in(server, monkeypatch)
    capture = make_capture(tmp_path / "capture", frames=8)
    pipeline.convert(capture.folder, tmp_path / "alone" / "room", OPTIONS)
    alone = contents(tmp_path / "alone" / "room")

    from usdbrdf.cluster.engine import DaskWorkers

    documents, sent, results = [], [], set()
    keep, submitted, result = Store.keep_document, DaskWorkers._submitted, Store.result

    def and_note(store: Store, document: Any) -> str:
        documents.append(json.dumps(document))
        return keep(store, document)

    def and_note_sent(workers: DaskWorkers, *given: Any) -> Any:
        sent.append(json.dumps(given))
        return submitted(workers, *given)

    def and_look(store: Store, name: str) -> Any:
        results.update(objects(PLACE))
        return result(store, name)

    monkeypatch.setattr(Store, "keep_document", and_note)
    monkeypatch.setattr(DaskWorkers, "_submitted", and_note_sent)
    monkeypatch.setattr(Store, "result", and_look)
    chosen = ClusterOptions(workers=2, shared_folder=PLACE)
    pipeline.convert(capture.folder, tmp_path / "by-workers" / "room", OPTIONS, cluster=chosen)
    assert contents(tmp_path / "by-workers" / "room") == alone
    assert len(documents) > 1
    assert len(sent) > 4
    assert not [told for told in (*documents, *sent) if str(tmp_path) in told]
    # All went through the store, and nothing is left of it.
    endings = {name.rpartition(".")[2] for name in results}
    assert endings == {"npy", "json", "npz", "file"}
    assert objects(PLACE) == []
    assert not [*(tmp_path / "by-workers").rglob(".usdbrdf/work/*")]


def test_a_run_without_its_bucket_ends_in_a_sentence(
    server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    let_us_in(server, monkeypatch)
    capture = make_capture(tmp_path / "capture", frames=8)
    chosen = ClusterOptions(workers=1, shared_folder="s3://no-such-bucket")
    with pytest.raises(EnvironmentFailure, match=r"no such bucket.*\[cluster.objects\]") as found:
        pipeline.convert(capture.folder, tmp_path / "room", OPTIONS, cluster=chosen)
    assert found.value.exit_code == 4
