"""Tasks of a farm: what is good, refused, to be tried again; the table and the page of all."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.json_schemas import checked
from tests.scenes import make_capture
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.manifest import Manifest, write_manifest
from usdbrdf.cli import main
from usdbrdf.errors import EnvironmentFailure, FolderBusy, InputRefused
from usdbrdf.farm import work as module
from usdbrdf.farm.page import page_of
from usdbrdf.farm.records import Record, Results, read_record, write_record
from usdbrdf.farm.scans import list_of
from usdbrdf.farm.table import exit_code, rows_of
from usdbrdf.farm.work import Work, work_on
from usdbrdf.job.interrupts import Terminated
from usdbrdf.job.stamp import stamp_of, stamp_path, write_stamp
from usdbrdf.options import ConvertOptions

COARSE = ["--texel-size", "0.4", "--rays", "16", "--max-pixels", "50", "--environment", "none"]


@pytest.fixture(scope="module")
def farm(tmp_path_factory):
    """A bundle of three scans, one bad, run by OpenJD on a machine where the scans lie elsewhere:
    its folder, what the session said, and its status."""
    pytest.importorskip("openjd.cli", reason="needs the extra farm")
    here = tmp_path_factory.mktemp("farm")
    make_capture(here / "scans/day/room")
    shutil.copytree(here / "scans/day/room", here / "scans/night/room")
    shutil.copytree(here / "scans/day/room", here / "scans/bad")
    (here / "scans/bad/mesh.ply").unlink()
    places = [str(here / "scans" / name) for name in ("day/room", "night/room", "bad")]
    words = ["farm", *places, "-o", str(here / "bundle"), "--chunk", "3", "-q", *COARSE]
    assert main(words) == 0
    (here / "scans").rename(here / "there")
    rule = {
        "source_path_format": "POSIX", "source_path": str(here / "scans"),
        "destination_path": str(here / "there"),
    }  # fmt: skip
    rules = {"version": "pathmapping-1.0", "path_mapping_rules": [rule]}
    command = [
        sys.executable, "-m", "openjd", "run", str(here / "bundle/template.json"),
        "--step", "Table", "--run-dependencies", "-p", f"ScanRoot={here / 'scans'}",
        "--path-mapping-rules", json.dumps(rules),
    ]  # fmt: skip
    (here / "bin").mkdir()
    program = here / "bin/usdbrdf"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m usdbrdf "$@"\n')
    program.chmod(0o755)
    environment = os.environ | {
        "PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    return here, done.stdout + done.stderr, done.returncode


def written(folder: Path) -> dict[str, int]:
    found = (path for path in folder.rglob("*") if path.is_file() and path.name != "lock")
    return {str(path): path.stat().st_mtime_ns for path in found}


def test_good_scans_become_assets_and_a_bad_one_a_sentence(farm):
    here, said, status = farm
    results = here / "bundle/results"
    assert status != 0, said
    assert "exited with code: 3" in said
    assert "openjd_progress: 33.3" in said
    assert "openjd_status: bad: refused" in said
    assert {path.name for path in (results / "assets").iterdir()} >= {"day_room", "night_room"}
    for name in ("day_room", "night_room"):
        assert (results / f"assets/{name}/{name}.usda").is_file()
        assert (results / f"pages/{name}.html").stat().st_size > 10_000
    assert not (results / "pages/bad.html").exists()
    record = read_record(results / "records/bad.json")
    assert record.status == "refused"
    assert record.sentence.endswith("[mesh.missing]")


def test_the_table_says_what_came_of_each(farm, capsys):
    here, said, _ = farm
    words = [str(here / "bundle")]
    assert main(["farm-table", *words]) == 3
    text = capsys.readouterr().out
    assert text.splitlines()[-1] == "3 scans: 2 good, 1 refused"
    assert text.splitlines()[-1] in said
    assert main(["farm-table", *words, "--json"]) == 3
    told = checked(capsys.readouterr().out, "farm-table")
    assert told["counts"] == {"good": 2, "refused": 1}
    good = told["scans"][0]
    stamp = json.loads(
        (here / "bundle/results/assets/day_room/.usdbrdf/stamps/4-fit.json").read_text()
    )
    assert good["objects"] == len(stamp["summary"]["objects"])
    assert good["page"] == "pages/day_room.html"
    page = (here / "bundle/results/index.html").read_text("utf-8")
    assert 'href="pages/day_room.html"' in page
    assert "[mesh.missing]" in page
    assert "http" not in page.replace("http-equiv", "")


def test_a_second_run_does_nothing(farm, capsys):
    here, _, _ = farm
    results = here / "bundle/results"
    before = {part: written(results / part) for part in ("assets", "pages")}
    records = {path: path.read_bytes() for path in (results / "records").iterdir()}
    words = ["farm-work", str(here / "bundle"), "--root", str(here / "there"), *COARSE]
    assert main([*words, "--json", "-q"]) == 0
    assert {part: written(results / part) for part in ("assets", "pages")} == before
    assert {path: path.read_bytes() for path in (results / "records").iterdir()} == records
    found = checked(capsys.readouterr().out, "farm-work")["scans"]
    assert [one["status"] for one in found.values()] == ["good", "good", "refused"]


@pytest.fixture
def one(tmp_path, monkeypatch):
    """A scan whose conversion does what the test says, the results, and a function that works."""
    (tmp_path / "scan").mkdir()
    results = Results(tmp_path / "results")
    work = Work(results=results, options=ConvertOptions())
    heard: list[tuple[int, str]] = []

    def run(*raised: BaseException | None) -> tuple[list[str], int]:
        left = list(raised)

        def convert(*_, **__):
            raise left.pop(0)

        monkeypatch.setattr(module, "convert", convert)
        names = [f"scan_{i}" for i in range(len(raised))]
        scans = [(name, tmp_path / "scan") for name in names]
        records, status = work_on(scans, work, lambda *told: heard.append(told))
        return [records[name].status for name in names], status

    return run, results, heard


def test_no_line_begins_with_what_a_scan_is_called(tmp_path, monkeypatch, capsys):
    worked = []

    def convert(place, folder, options, **told):
        worked.append((folder.name, told["wait_s"], told["without_lock"]))
        raise InputRefused(f"{place}: bad. [x]")

    monkeypatch.setattr(module, "convert", convert)
    places = [tmp_path / name for name in ("openjd_fail", "a\nopenjd_env: A=B")]
    for place in places:
        place.mkdir()
    assert main(["farm", *map(str, places), "-o", str(tmp_path / "b"), "-q"]) == 0
    words = ["farm-work", str(tmp_path / "b"), "--wait", "7", "--without-lock", "--openjd"]
    assert main(words) == 0
    assert worked == [("openjd_fail", 7, True), ("a_openjd_env_A_B", 7, True)]
    assert main(["farm-table", str(tmp_path / "b")]) == 3
    said = capsys.readouterr()
    lines = [line for line in (said.out + said.err).splitlines() if line.startswith("openjd_")]
    assert {line.partition(":")[0] for line in lines} == {"openjd_status", "openjd_progress"}


def test_a_page_is_made_anew_without_its_photographs(tmp_path, monkeypatch):
    (tmp_path / "scan").mkdir()
    pages = []

    def report(_, page, options):
        pages.append(options.photographs)
        page.parent.mkdir(parents=True, exist_ok=True)
        page.touch()

    monkeypatch.setattr(module, "convert", lambda *_, **__: {})
    monkeypatch.setattr(module, "validate", lambda _: [])
    monkeypatch.setattr(module, "report", report)
    monkeypatch.setattr(module, "_counts", lambda _: {})
    for photographs in (True, True, False, False):
        (tmp_path / "results/assets/scan").mkdir(parents=True, exist_ok=True)
        (tmp_path / "results/assets/scan/scan.usda").touch()
        work = Work(
            results=Results(tmp_path / "results"), options=ConvertOptions(), photographs=photographs
        )
        records, _ = work_on([("scan", tmp_path / "scan")], work, lambda *_: None)
        assert records["scan"].status == "good", records
    assert pages == [True, False]


def test_only_what_trying_again_may_help_fails_the_task(one):
    run, results, heard = one
    assert run(InputRefused("bad."), ValueError("x"), InputRefused("bad too.")) == (
        ["refused", "defect", "refused"], 0,
    )  # fmt: skip
    assert run(InputRefused("bad."), FolderBusy("busy."), EnvironmentFailure("full.")) == (
        ["refused", "unfinished", "unfinished"], 5,
    )  # fmt: skip
    assert run(PermissionError(errno.EACCES, "denied", "scan.usdc")) == (["unfinished"], 4)
    assert run(MemoryError()) == (["unfinished"], 4)
    assert heard[-1] == (1, "scan_0: unfinished")
    assert "--ram" in read_record(results.record("scan_0")).sentence


def test_a_scan_that_kills_its_tasks_is_left_out(one):
    run, results, _ = one
    file = results.record("scan_0")
    # What a task leaves that was killed: it had written that it began.
    write_record(file, Record(status="begun", begun=2))
    assert run(InputRefused("bad.")) == (["refused"], 0)
    write_record(file, Record(status="begun", begun=3))
    assert run(InputRefused("never asked.")) == (["crashed"], 0)
    assert "3 tasks died" in read_record(file).sentence
    # The next run begins anew.
    assert run(InputRefused("bad.")) == (["refused"], 0)


def test_a_busy_scan_keeps_the_record_of_the_task_that_is_at_it(one):
    run, results, _ = one
    file, other = results.record("scan_0"), Record(status="begun", begun=1, seconds=3.0)
    write_record(file, other)
    assert run(FolderBusy("busy.")) == (["unfinished"], 5)
    assert read_record(file) == other


def test_what_stops_a_task_from_outside_is_no_try(one):
    run, results, _ = one
    for _ in range(5):
        with pytest.raises(Terminated):
            run(Terminated())
        assert read_record(results.record("scan_0")).begun == 0
    assert run(InputRefused("bad.")) == (["refused"], 0)


def test_a_damaged_record_is_none(tmp_path):
    for text in ("", "{", "[]", '{"schema": 1}', '{"schema": 1, "status": "good", "begun": "x"}'):
        (tmp_path / "record.json").write_text(text)
        assert read_record(tmp_path / "record.json") is None
    write_record(tmp_path / "record.json", Record(status="good", seconds=2.5))
    assert read_record(tmp_path / "record.json") == Record(status="good", seconds=2.5)


def test_the_whole_is_as_good_as_its_worst(tmp_path):
    for name in ("a", "b", "c"):
        (tmp_path / "scans" / name).mkdir(parents=True)
    scans = list_of(sorted((tmp_path / "scans").iterdir()))
    results = Results(tmp_path / "results")

    def code(*statuses: str) -> int:
        for name, status in zip(scans.names, statuses, strict=True):
            make_asset(results.asset(name))
            write_record(results.record(name), Record(status=status))
        return exit_code(rows_of(scans, results))

    assert [row.status for row in rows_of(scans, results)] == ["waiting"] * 3
    assert exit_code(rows_of(scans, results)) == 4
    assert code("good", "good", "good") == 0
    assert code("good", "invalid", "good") == 7
    assert code("refused", "invalid", "good") == 3
    assert code("refused", "defect", "good") == 1
    assert code("refused", "crashed", "unfinished") == 4
    assert code("begun", "good", "good") == 4


def make_asset(folder: Path) -> None:
    """Of one map, with the stamp of its step."""
    (folder / ".usdbrdf/stamps").mkdir(parents=True, exist_ok=True)
    (folder / "map.exr").touch()
    stamp = stamp_of("texture", {}, {})
    write_stamp(stamp_path(folder, 2, "texture"), replace(stamp, outputs={"map.exr": "0" * 64}))


@pytest.mark.parametrize("lost", ["map.exr", ".usdbrdf", ""])
@pytest.mark.parametrize("status", ["good", "invalid"])
def test_an_asset_that_is_gone_is_not_good(tmp_path, capsys, lost, status):
    """Though its record says so."""
    (tmp_path / "scan").mkdir()
    assert main(["farm", str(tmp_path / "scan"), "-o", str(tmp_path / "farm"), "-q"]) == 0
    results = Results(tmp_path / "farm/results")
    asset = results.asset("scan")
    make_asset(asset)
    write_record(results.record("scan"), Record(status=status, objects=3, measured=2))
    results.page("scan").parent.mkdir()
    results.page("scan").touch()
    words = ["farm-table", str(tmp_path / "farm"), "--json"]
    capsys.readouterr()
    assert main(words) == (0 if status == "good" else 7)
    assert checked(capsys.readouterr().out, "farm-table")["measured"] == 2
    if (asset / lost).is_dir():
        shutil.rmtree(asset / lost)
    else:
        (asset / lost).unlink()
    assert main(words) == 4
    told = checked(capsys.readouterr().out, "farm-table")
    assert told["counts"] == {"unfinished": 1}
    assert told["measured"] == 0
    assert told["scans"][0]["sentence"].startswith(f"{asset}/")
    assert 'href="pages/scan.html"' not in results.table.read_text("utf-8")


def test_an_asset_without_photographs_is_whole(tmp_path, capsys):
    """As who hands it on takes out what tells where they lie."""
    (tmp_path / "scan").mkdir()
    assert main(["farm", str(tmp_path / "scan"), "-o", str(tmp_path / "farm"), "-q"]) == 0
    results = Results(tmp_path / "farm/results")
    asset = results.asset("scan")
    make_asset(asset)
    stamp = stamp_of("ingest", {}, {})
    outputs = {"layers/photographs.usdc": "0" * 64}
    write_stamp(stamp_path(asset, 1, "ingest"), replace(stamp, outputs=outputs))
    write_record(results.record("scan"), Record(status="good", objects=3, measured=2))
    assert main(["farm-table", str(tmp_path / "farm"), "-q"]) == 0
    (asset / "map.exr").unlink()
    assert main(["farm-table", str(tmp_path / "farm"), "-q"]) == 4


def test_a_published_version_in_the_place_of_an_asset_is_known_by_its_manifest(tmp_path, capsys):
    (tmp_path / "scan").mkdir()
    assert main(["farm", str(tmp_path / "scan"), "-o", str(tmp_path / "farm"), "-q"]) == 0
    results = Results(tmp_path / "farm/results")
    asset = Asset.at(results.asset("scan"))
    root = asset._published_root
    root.parent.mkdir(parents=True)
    root.touch()
    assert asset.is_published
    files = {root.relative_to(asset.folder).as_posix(): "0" * 64}
    said = Manifest(
        name="scan", version="v001", identifier="", texture_space="", photographs=False,
        content="", files=files,
    )  # fmt: skip
    write_manifest(asset.folder, said)
    write_record(results.record("scan"), Record(status="good", objects=3, measured=2))
    words = ["farm-table", str(tmp_path / "farm"), "--json"]
    assert main(words) == 0
    write_manifest(asset.folder, replace(said, files=files | {"layers/scan.usdc": "0" * 64}))
    capsys.readouterr()
    assert main(words) == 4
    told = checked(capsys.readouterr().out, "farm-table")["scans"][0]["sentence"]
    gone = f"{asset.folder}/layers/scan.usdc"
    assert told == f"{gone}: is gone. Bring it back from a copy. [farm.asset]"
    (asset.folder / "manifest.json").write_text("{}")
    assert main(words) == 4
    assert "[publish.manifest]" in capsys.readouterr().out


@pytest.mark.parametrize("code", [0, 1, 2, 3, 4, 5, 7])
def test_snakemake_keeps_the_page_of_scans_that_are_not_good(tmp_path, code):
    snakefile = Path(__file__).parents[2] / "docs/packaging/snakemake/Snakefile"
    line = next(
        line for line in snakefile.read_text().splitlines() if '"usdbrdf farm-table' in line
    )
    told = line.strip().strip('"').replace("{params.bundle:q}", "'a b'")
    told = told.replace("{log:q}", f"'{tmp_path}/the log'")
    command = f"usdbrdf() {{ echo $*; return {code}; }}; set -euo pipefail; {told}"
    done = subprocess.run(["bash", "-c", command], check=False)
    assert (done.returncode == 0) is (code in (0, 1, 3, 7))
    assert (tmp_path / "the log").read_text() == "farm-table a b\n"


def test_the_page_escapes_what_others_wrote(tmp_path):
    (tmp_path / "<script>").mkdir()
    scans = list_of([tmp_path / "<script>"])
    results = Results(tmp_path / "results")
    evil = '</td><script>alert("1")</script> /*STYLE*/'
    write_record(results.record(scans.names[0]), Record(status="refused", sentence=evil))
    page = page_of(rows_of(scans, results), "a & <b>")
    assert "<script" not in page
    assert "a &amp; &lt;b&gt;" in page
    assert page.count("color-scheme: light dark") == 1
    assert "/*STYLE*/" in page
