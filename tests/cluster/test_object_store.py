"""Stores in the place of a folder: what comes out is what went in, whoever takes part sees no
other's files, and nothing is left."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.cluster.object_server import BUCKET, let_us_in, objects, running_server
from usdbrdf.cluster.described import described, restored
from usdbrdf.cluster.object_store import Objects, address_for, files_at, forget
from usdbrdf.cluster.options import ClusterOptions
from usdbrdf.cluster.session import workers_of
from usdbrdf.cluster.store import Folder, Store, Wanted
from usdbrdf.command_parser import parsed
from usdbrdf.commands import COMMANDS
from usdbrdf.errors import EnvironmentFailure, UsageError, UsdBrdfError

fsspec = pytest.importorskip("fsspec", reason="the extra cluster is not installed")


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running_server() as url:
        yield url


@pytest.fixture(params=["s3", "file"])
def place(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The URL of an empty place of a store."""
    if request.param == "file":
        return f"file://{tmp_path}/objects/some"
    let_us_in(request.getfixturevalue("server"), monkeypatch)
    return f"s3://{BUCKET}/{tmp_path.name}"


@pytest.fixture
def ours(place: str, tmp_path: Path) -> Store:
    """As the process that was started has it."""
    folder = tmp_path / "ours"
    return Store(files_at(address_for(place, folder), folder))


@pytest.fixture
def theirs(ours: Store, tmp_path: Path) -> Store:
    """The same as a worker has it."""
    return Store(files_at(ours.files.address, tmp_path / "theirs"))


def through(ours: Store, theirs: Store, value: object) -> object:
    document = json.loads(json.dumps(described(value, ours)))
    ours.files.settle()
    return restored(document, theirs, lambda _, make: make())


def test_arrays_and_documents_come_back(ours: Store, theirs: Store) -> None:
    array = np.random.default_rng(1).random((300, 20))
    for given in (array, np.asfortranarray(array), array[:, ::2]):
        found = through(ours, theirs, given)
        assert isinstance(found, np.ndarray)
        np.testing.assert_array_equal(found, given)
        assert isinstance(found.base, np.memmap)
    name = ours.keep_document({"of": [1, 2]})
    ours.files.settle()
    assert theirs.document(name) == {"of": [1, 2]}


def test_what_is_there_is_not_uploaded_again(
    ours: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    array = np.arange(1000.0)
    name = ours.keep(array)
    ours.files.settle()
    assert objects(ours.files.address) == [name]
    again = Store(files_at(ours.files.address, tmp_path / "again"))
    uploads: list[object] = []
    monkeypatch.setattr(Objects, "_upload", lambda *given: uploads.append(given))
    assert again.keep(array) == name
    again.files.settle()
    assert uploads == []
    again.keep(array + 1)
    again.files.settle()
    assert len(uploads) == 1


def test_an_object_of_another_size_is_uploaded_again(
    ours: Store, theirs: Store, place: str
) -> None:
    name = ours.keep(np.arange(1000.0))
    ours.files.settle()
    write_object(f"{ours.files.address}/{name}", b"cut off")
    assert ours.keep(np.arange(1000.0)) == name
    ours.files.settle()
    np.testing.assert_array_equal(theirs.array(name), np.arange(1000.0))


def test_a_damaged_object_is_refused(ours: Store, theirs: Store) -> None:
    name = ours.keep(np.arange(1000.0))
    ours.files.settle()
    write_object(f"{ours.files.address}/{name}", b"something else")
    with pytest.raises(EnvironmentFailure, match=r"not what its name tells.*\[cluster.objects\]"):
        theirs.array(name)
    assert not [*theirs.files.folder.rglob("*.npy")]


def test_a_copy_serves_again_unless_it_is_damaged(ours: Store, theirs: Store) -> None:
    name = ours.keep(np.arange(1000.0))
    ours.files.settle()
    theirs.array(name)
    write_object(f"{ours.files.address}/{name}", b"something else")
    np.testing.assert_array_equal(theirs.array(name), np.arange(1000.0))
    (theirs.files.folder / name).write_bytes(b"damaged")
    with pytest.raises(EnvironmentFailure, match="not what its name tells"):
        theirs.array(name)


def test_results_are_gone_once_they_are_read(ours: Store, theirs: Store) -> None:
    name = theirs.keep_result({"found": np.arange(5)})
    np.testing.assert_array_equal(ours.result(name)["found"], np.arange(5))
    ours.files.drop(name)
    assert objects(ours.files.address) == []
    assert not [*ours.files.folder.glob("*.npz")]
    assert not [*theirs.files.folder.glob("*.npz")]
    with pytest.raises(EnvironmentFailure, match="no such"):
        ours.result(name)


def test_a_file_comes_as_a_copy_of_its_own_name_when_it_is_opened(
    ours: Store, theirs: Store, tmp_path: Path
) -> None:
    photograph = tmp_path / "Nº 1.exr"
    photograph.write_bytes(b"pixels")
    told = json.dumps(described((photograph, tmp_path / "none.exr"), ours))
    assert str(photograph) not in told
    found, missing = through(ours, theirs, (photograph, tmp_path / "none.exr"))  # type: ignore[misc]
    assert missing == tmp_path / "none.exr"
    assert found.name == photograph.name
    with pytest.raises(Wanted):
        found.stat()
    assert objects(ours.files.address) == []
    ours.files.give_told()
    assert found.read_bytes() == b"pixels"
    assert found.is_relative_to(theirs.files.folder)
    sentence = f"{found}: the file is empty. {found}"
    told = theirs.files.sentence_told(sentence)
    assert str(tmp_path) not in told
    assert ours.files.sentence_found(told) == f"{photograph}: the file is empty. {photograph}"


@pytest.mark.parametrize("own", ["../1.exr", "/etc/passwd", "..", ""])
def test_no_copy_leaves_its_folder(theirs: Store, own: str) -> None:
    with pytest.raises(UsdBrdfError, match=r"\[cluster.value\]"):
        theirs.files.path_found({"file": ["0" * 64, own]})


def test_what_a_task_uploaded_is_deleted_and_nothing_else(
    ours: Store, place: str, tmp_path: Path
) -> None:
    other = Store(files_at(address_for(place, tmp_path / "other"), tmp_path / "other"))
    for store in (ours, other):
        name = store.keep(np.arange(1000.0))
        store.files.settle()
    # A run that goes on with the task finds the same.
    assert address_for(place, tmp_path / "ours") == ours.files.address
    with workers_of(ClusterOptions(workers=1, shared_folder=place)) as workers:
        workers.forget(tmp_path / "ours")
        workers.forget(tmp_path / "nothing was uploaded of this")
    assert objects(place) == [f"{other.files.address.rpartition('/')[2]}/{name}"]
    assert address_for(place, tmp_path / "ours") != ours.files.address


def test_a_worker_keeps_the_copies_of_the_last_steps_alone(theirs: Store, tmp_path: Path) -> None:
    unit = pytest.importorskip("usdbrdf.cluster.unit", reason="the extra cluster is not installed")
    copies = [tmp_path / f"step-{i}" for i in range(3)]
    for folder in copies:
        folder.mkdir()
        (folder / "copy.npy").write_bytes(b"1")
        unit._stores.get(str(folder), lambda at=folder: Store(files_at(theirs.files.address, at)))
    assert [folder.is_dir() for folder in copies] == [False, True, True]


@pytest.mark.parametrize("noted", ["", "..", "some/where", "usdbrdf-0123456789abcdef/../else"])
def test_a_note_of_somebody_else_deletes_nothing(place: str, tmp_path: Path, noted: str) -> None:
    write_object(f"{place}/theirs", b"kept")
    (tmp_path / "task").mkdir()
    (tmp_path / "task/prefix.txt").write_text(noted)
    forget(place, tmp_path / "task")
    assert objects(place) == ["theirs"]


def test_a_bucket_that_is_not_there_is_a_sentence(
    server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    let_us_in(server, monkeypatch)
    store = Store(files_at("s3://no-such-bucket/some", tmp_path))
    store.keep(np.arange(1000.0))
    with pytest.raises(EnvironmentFailure, match=r"no such bucket.*\[cluster.objects\]"):
        store.files.settle()


def test_a_store_without_credentials_is_a_sentence(server: str, tmp_path: Path) -> None:
    """In a process of its own: the library remembers those it has seen."""
    told = (
        "import sys, numpy as np; from pathlib import Path\n"
        "from usdbrdf.cluster.object_store import files_at\n"
        "from usdbrdf.cluster.store import Store\n"
        f"store = Store(files_at('s3://{BUCKET}/some', Path(sys.argv[1])))\n"
        "store.keep(np.arange(1000.0)); store.files.settle()"
    )
    environment = {k: v for k, v in os.environ.items() if not k.startswith("AWS_")}
    environment |= {"AWS_ENDPOINT_URL": server, "AWS_EC2_METADATA_DISABLED": "true"}
    environment |= {"HOME": str(tmp_path), "AWS_DEFAULT_REGION": "us-east-1"}
    command = [sys.executable, "-c", told, str(tmp_path)]
    found = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=".")
    assert "access is denied here" in found.stderr, found.stderr
    assert "EnvironmentFailure" in found.stderr


class ParamValidationError(Exception):
    """As botocore calls it."""


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (PermissionError("AccessDenied"), "access is denied here (AccessDenied)"),
        (ConnectionError("reset"), "the object store failed (ConnectionError: reset)"),
        (TimeoutError(), "the object store failed (TimeoutError: )"),
        (OSError(errno.ENOSPC, "No space left"), "does not fit on a disk ([Errno 28] No space"),
    ],
)
def test_what_a_store_refuses_is_a_failure_of_the_environment(
    theirs: Store, monkeypatch: pytest.MonkeyPatch, error: Exception, told: str
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise error

    assert isinstance(theirs.files, Objects)
    monkeypatch.setattr(theirs.files._system, "put_file", refuse)
    with pytest.raises(EnvironmentFailure) as found:
        theirs.keep_result({"found": np.arange(5)})
    assert told in str(found.value)
    assert "\n" not in str(found.value)
    assert str(found.value).endswith("[cluster.objects]")


def test_a_name_that_no_store_has_is_a_wrong_option(
    theirs: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise ParamValidationError("Bad\nname")

    assert isinstance(theirs.files, Objects)
    monkeypatch.setattr(theirs.files._system, "put_file", refuse)
    told = r"^--shared-folder .* is no place in an object store \(Bad name\).*\[cluster.objects\]$"
    with pytest.raises(UsageError, match=told):
        theirs.keep_result({"found": np.arange(5)})


@pytest.mark.parametrize(
    ("place", "kind", "told"),
    [
        ("nosuch://scans/some", UsageError, "nosuch"),
        ("gs://scans/some", EnvironmentFailure, "not installed"),
        (Path("/proc/no"), UsageError, "nothing can be written there"),
        (Path(__file__), UsageError, "File exists"),
        (Path("/proc/self"), EnvironmentFailure, "nothing can be written there"),
    ],
)
def test_what_cannot_be_shared_is_told_before_any_work(
    place: str | Path, kind: type[UsdBrdfError], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != Path("/proc/self"))
    said = ClusterOptions(workers=1, shared_folder=place)
    with (
        pytest.raises(kind, match=rf"^--shared-folder {place}: .*{told}.*\.\w+\]$"),
        workers_of(said),
    ):
        pytest.fail("work begins")


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("filecache::s3://scans/some", "is a chain of stores. Give .* alone, s3://scans/some"),
        ("simplecache::zip://a::gs://b", "is a chain of stores. Give .* alone, gs://b"),
        ("S3://scans/Some", "a kind of store is written in small letters. Give s3://scans/Some"),
        ("s3://bad!bucket/some", "no bucket can be called so"),
        ("s3a://b\u00fccher", "no bucket can be called so"),
        ("hdfs:///some", "names no bucket or host"),
    ],
)
def test_what_no_store_is_called_is_refused_with_what_to_give(said: str, told: str) -> None:
    with pytest.raises(UsageError, match=rf"^--shared-folder {said}: {told}.*\[usage.option\]$"):
        ClusterOptions(shared_folder=said)


def test_names_that_buckets_have_are_taken() -> None:
    point = "s3://arn:aws:s3:us-west-2:123456789012:accesspoint/some/prefix"
    for said in ("s3://Some_old.bucket-1", "s3://b/a:b", "hdfs://host:9000/a", point):
        assert ClusterOptions(shared_folder=said).shared_folder == said


def test_stores_that_nobody_can_share_or_knows_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no other process sees"):
        ClusterOptions(shared_folder="memory://scans")
    with pytest.raises(UsageError, match=r"nosuch.*\[cluster.objects\]"):
        files_at("nosuch://scans/some", tmp_path)


@pytest.mark.parametrize("said", ["s3://", "s3:///some", "://some", "gs:// /some"])
def test_a_store_without_a_bucket_is_refused(said: str) -> None:
    """The first was taken for a folder of that name."""
    with pytest.raises(UsageError, match=r"names no bucket.*\[usage.option\]"):
        ClusterOptions(shared_folder=said)


@pytest.mark.parametrize(
    "said", ["s3://b/scans[1]", "s3://b/a*/c", "s3://b/a?versionId=3", "s3://b/a::b"]
)
def test_a_prefix_that_stands_for_more_than_itself_is_refused(said: str) -> None:
    """What was uploaded below the first was never deleted: no object matched it."""
    with pytest.raises(UsageError, match=r"stores read as more than that.*\[usage.option\]"):
        ClusterOptions(shared_folder=said)
    assert ClusterOptions(shared_folder="sftp://[::1]:22/scans").shared_folder is not None


@pytest.mark.parametrize(
    "prefix",
    ["a b", "a+b", "a%20b", "100%", "ä 日本", "e\u0301", "a#b", "a//b", "a/../b", "~;&='\""],
)
def test_any_other_prefix_is_what_it_says(
    server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prefix: str
) -> None:
    let_us_in(server, monkeypatch)
    told = ClusterOptions(shared_folder=f"s3://{BUCKET}/keys/{prefix}").shared_folder
    address = address_for(str(told), tmp_path / "ours")
    ours, theirs = (Store(files_at(address, tmp_path / name)) for name in ("ours", "theirs"))
    name = ours.keep(np.arange(1000.0))
    ours.files.settle()
    assert objects(f"s3://{BUCKET}/keys")[0].startswith(f"{prefix}/usdbrdf-")
    np.testing.assert_array_equal(theirs.array(name), np.arange(1000.0))
    forget(str(told), tmp_path / "ours")
    assert objects(f"s3://{BUCKET}/keys") == []


def test_a_store_that_is_asked_at_once_and_does_not_answer_is_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def silent(*_: object, **__: object) -> None:
        raise RuntimeError("no\nanswer")

    monkeypatch.setattr(fsspec.core, "url_to_fs", silent)
    with pytest.raises(EnvironmentFailure, match=r"RuntimeError: no answer.*\[cluster.objects\]"):
        files_at("github://some:scans@/main", tmp_path)


def test_what_talks_to_a_store_may_not_be_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(EnvironmentFailure, match=r"not installed.*\[environment.fsspec\]"):
        files_at("gs://scans/some", tmp_path)


@pytest.mark.parametrize("said", ["s3://scans/some", "some/folder"])
def test_the_command_line_takes_folders_and_urls(said: str) -> None:
    command = parsed(["convert", "scan", "-o", "asset", "--shared-folder", said], COMMANDS)
    found = command.cluster.shared_folder  # type: ignore[attr-defined]
    assert found == (said if "://" in said else Path(said))
    assert type(found) is type(said if "://" in said else Path(said))
    assert isinstance(files_at(Path("some/folder"), Path()), Folder)


def write_object(url: str, content: bytes) -> None:
    folders = {"auto_mkdir": True} if url.startswith("file") else {}
    system, path = fsspec.core.url_to_fs(url, use_listings_cache=False, **folders)
    system.pipe_file(path, content)
