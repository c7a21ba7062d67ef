"""The bundle of a farm: OpenJD's own model takes it, and names of scans hold."""

from __future__ import annotations

import errno
import json
import os
import re
import shlex
from pathlib import Path

import pytest

from tests.fault_injection import run_fresh
from tests.json_schemas import checked
from tests.scenes import make_capture
from usdbrdf.cli import main
from usdbrdf.cluster.options import ClusterOptions
from usdbrdf.commands import COMMANDS
from usdbrdf.errors import EnvironmentFailure, InputRefused, OwnershipConflict, UsageError
from usdbrdf.farm import bundle as bundles
from usdbrdf.farm.bundle import bundle_of, write_bundle
from usdbrdf.farm.options import FarmOptions
from usdbrdf.farm.scans import list_of, listed_in, numbers_in, read_list
from usdbrdf.options import (
    ConvertOptions,
    FitOptions,
    IngestOptions,
    Sampling,
    ShadeOptions,
    TextureOptions,
)


def folders(root: Path, *names: str) -> list[Path]:
    made = [root / name for name in names]
    for folder in made:
        folder.mkdir(parents=True)
    return made


def job_of(folder: Path, values: dict[str, str]):
    """The job that OpenJD makes of a bundle, and its steps by name."""
    model = pytest.importorskip("openjd.model", reason="needs the extra farm")
    text = json.loads((folder / "template.json").read_text())
    extensions = ["TASK_CHUNKING"]
    template = model.decode_job_template(template=text, supported_extensions=extensions)
    known = model.preprocess_job_parameters(
        job_template=template, job_parameter_values=values, job_template_dir=folder,
        current_working_dir=folder,
    )  # fmt: skip
    return model.create_job(job_template=template, job_parameter_values=known)


def test_a_scan_is_there_once_however_often_and_by_whichever_way_it_is_named(tmp_path):
    first, second = folders(tmp_path, "a", "b")
    link = tmp_path / "link"
    link.symlink_to(first)
    assert list_of([second, first, link, tmp_path / "b" / ".", second]).places == ("b", "a")
    assert list_of([link, second, first]).places == ("link", "b")


def test_a_main_file_beside_its_folder_is_the_same_scan(tmp_path):
    folder = make_capture(tmp_path / "a", frames=1).folder
    other = folder / "night.json"
    other.write_bytes((folder / "transforms.json").read_bytes())
    assert list_of([folder / "transforms.json", folder]).places == ("a",)
    assert list_of([folder, other]).places == ("a", "a/night.json")
    assert list_of([folder / "transforms.json"]).places == ("transforms.json",)


def test_openjd_makes_a_job_of_it(tmp_path):
    scans = list_of(folders(tmp_path / "scans", "a", "b", "c", "d", "e"))
    sky, outside = tmp_path / "sky.exr", tmp_path / "outside"
    sky.touch(), outside.mkdir()
    options = ConvertOptions(
        ingest=IngestOptions(refine_poses=True, allow_outside=(outside, tmp_path)),
        texture=TextureOptions(texel_size=0.25),
        shade=ShadeOptions(sampling=Sampling(max_rays=64), environment=sky),
        fit=FitOptions(environment=sky, mapping="measured"),
    )
    farm = FarmOptions(chunk=2, cores=4, ram=16)
    made = bundle_of("street {1}", scans, options, farm, "transforms", plugins=False)
    write_bundle(tmp_path / "bundle", scans, made)
    job = job_of(tmp_path / "bundle", made.values)
    model = pytest.importorskip("openjd.model")
    work, table = job.steps
    assert job.name == "usdbrdf street 1 (5 scans)"
    chunks = [
        str(p["Scan"].value) for p in model.StepParameterSpaceIterator(space=work.parameterSpace)
    ]
    assert [numbers_in(chunk, 5) for chunk in chunks] == [[1, 2], [3, 4], [5]]
    needs = {one.name: one.min for one in work.hostRequirements.amounts}
    assert {name: float(least) for name, least in needs.items()} == {
        "amount.worker.vcpu": 4, "amount.worker.memory": 16 * 1024,
    }  # fmt: skip
    assert [one.dependsOn for one in table.dependencies] == [work.name]

    # What its tasks run is a command line that means the same again.
    words = [str(word) for word in work.script.actions.onRun.args]
    values = {name: value.value for name, value in job.parameters.items()}
    values = {"Param." + name: value for name, value in values.items()} | {"Task.Param.Scan": "1-2"}
    said = [_resolved(word, values) for word in words]
    from usdbrdf.command_parser import parsed

    command = parsed(said, COMMANDS)
    assert command.options == ConvertOptions(
        ingest=IngestOptions(refine_poses=True, allow_outside=(outside, tmp_path)),
        texture=TextureOptions(texel_size=0.25, memory=12),
        shade=ShadeOptions(sampling=Sampling(max_rays=64), environment=sky),
        fit=FitOptions(environment=sky, mapping="measured", memory=12),
    )
    assert (command.adapter, command.plugins, command.chosen) == ("transforms", False, "1-2")
    assert command.root == scans.root
    assert command.bundle == tmp_path / "bundle" / "scans.json"
    assert command.results == tmp_path / "bundle" / "results"


def _resolved(word: str, values: dict[str, str]) -> str:
    return re.sub(r"\{\{ *([\w.]+) *\}\}", lambda found: str(values[found[1]]), word)


def test_values_may_begin_with_a_dash(tmp_path):
    from usdbrdf.command_parser import parsed

    scans = list_of(folders(tmp_path, "a"))
    given = Path("-meshes/mesh.ply")
    options = ConvertOptions(ingest=IngestOptions(allow_outside=(given,)))
    made = bundle_of("b", scans, options, FarmOptions(), "-mine", wait_s=90, without_lock=True)
    words = made.template["steps"][0]["script"]["actions"]["onRun"]["args"]
    # As whoever submits the job may write them.
    values = {"Param.AllowOutside": str(given), "Param.Adapter": "-mine", "Param.Scans": "b"}
    values |= {"Param.ScanRoot": "/", "Param.Results": "r", "Task.Param.Scan": "1"}
    command = parsed([_resolved(word, values) for word in words], COMMANDS)
    assert command.options.ingest.allow_outside == (given,)
    assert (command.adapter, command.wait_s, command.without_lock) == ("-mine", 90, True)


@pytest.mark.parametrize("root", [["--root", ""], ["--root="]])
def test_without_a_folder_above_all_scans_the_list_tells_it(root):
    """What OpenJD makes of the parameter's default, in the command that ``usdbrdf farm`` tells."""
    from usdbrdf.command_parser import parsed

    command = parsed(["farm-work", "scans.json", *root, "--scans", "1"], COMMANDS)
    assert (command.root, command.chosen) == (None, "1")
    with pytest.raises(UsageError, match="--scans: the word given here is empty"):
        parsed(["farm-work", "scans.json", "--scans", ""], COMMANDS)


def test_what_is_told_can_be_pasted_into_a_shell(tmp_path, capsys):
    scan, mesh = folders(tmp_path, "a")[0], tmp_path / "the mesh; x.ply"
    mesh.touch()
    bundle = tmp_path / "our bundle"
    assert main(["farm", str(scan), "-o", str(bundle), "--mesh", str(mesh), "--json"]) == 0
    printed = capsys.readouterr()
    assert checked(printed.out, "farm")["tasks"] == 1
    written, here, cloud = printed.err.splitlines()
    assert written.endswith("written, 1 scan in 1 task")
    assert shlex.split(here.partition(":")[2]) == [
        "openjd", "run", str(bundle / "template.json"), "--step", "Table", "--run-dependencies",
        "-p", f"Mesh={mesh}",
    ]  # fmt: skip
    assert shlex.split(cloud.partition(":")[2]) == ["deadline", "bundle", "submit", str(bundle)]


def test_paths_are_told_so_that_a_farm_can_map_them(tmp_path):
    scans = list_of(folders(tmp_path, "scans/a", "scans/more/b"))
    mesh = tmp_path / "mesh.ply"
    mesh.touch()
    made = bundle_of("x", scans, ConvertOptions(ingest=IngestOptions(mesh=mesh)), FarmOptions())
    write_bundle(tmp_path / "bundle", scans, made)
    told = json.loads((tmp_path / "bundle/parameter_values.json").read_text())["parameterValues"]
    assert {one["name"]: one["value"] for one in told} == {
        "Mesh": str(mesh), "ScanRoot": str(tmp_path / "scans"),
    }  # fmt: skip
    kinds = {one["name"]: one["type"] for one in made.template["parameterDefinitions"]}
    assert {name for name, kind in kinds.items() if kind == "PATH"} == {
        "Mesh", "Results", "ScanRoot", "Scans",
    }  # fmt: skip
    references = json.loads((tmp_path / "bundle/asset_references.json").read_text())
    assert references["assetReferences"]["inputs"]["directories"] == [
        str(tmp_path / "scans/a"), str(tmp_path / "scans/more/b"),
    ]  # fmt: skip
    # Nowhere else does the template name a place of this machine.
    assert str(tmp_path) not in (tmp_path / "bundle/template.json").read_text()


@pytest.mark.parametrize(
    ("given", "names"),
    [
        (("one", "two"), ["one", "two"]),
        (("x/room", "y/room", "hall"), ["x_room", "y_room", "hall"]),
        (("a b", "a_b"), None),
        (("Room", "room"), None),
        (("Küche 1", "3rd floor"), ["Kuche_1", "_3rd_floor"]),
        (("部屋",), ["scan"]),
    ],
)
def test_names_tell_scans_apart_whatever_their_order(tmp_path, given, names):
    places = folders(tmp_path, *given)
    found = dict(zip(given, list_of(places).names, strict=True))
    again = dict(zip(reversed(given), list_of(places[::-1]).names, strict=True))
    assert found == again
    assert len({name.lower() for name in found.values()}) == len(given)
    assert names is None or [*found.values()] == names


def test_a_main_file_is_called_after_its_folder_too(tmp_path):
    places = [folder / "transforms.json" for folder in folders(tmp_path, "a", "b")]
    for place in places:
        place.touch()
    assert list_of(places).names == ("a_transforms", "b_transforms")
    assert list_of([places[0], places[0]]).places == ("transforms.json",)


def test_a_scan_that_is_not_there_is_said_at_once(tmp_path, capsys):
    there = folders(tmp_path, "a")[0]
    words = [
        "farm",
        str(there),
        str(tmp_path / "b"),
        str(tmp_path / "c"),
        "-o",
        str(tmp_path / "o"),
    ]
    assert main(words) == 3
    said = capsys.readouterr().err
    assert f"{tmp_path / 'b'}: no such file or folder (and 1 others of the list)" in said
    assert not (tmp_path / "o").exists()
    assert main(["farm", "-o", str(tmp_path / "o")]) == 2
    assert main(["farm", str(there), "-o", str(tmp_path / "o"), "--texel-size", "0"]) == 2


@pytest.mark.parametrize("character", ["\n", "\r", "\x1b", "\u2028"])
def test_no_job_holds_names_that_break_its_lines(tmp_path, capsys, character):
    broken = tmp_path / f"a{character}b"
    good, inside, other = folders(tmp_path, "a", f"{broken.name}/c", f"{broken.name}/d")
    bundle = str(tmp_path / "o")

    def refused(*words: str) -> str:
        status = main([*words, "-q"])
        said = capsys.readouterr().err
        assert repr(str(broken)) in said
        assert status in (2, 3)
        assert len(said.splitlines()) == 1
        return said

    assert "[farm.scan]" in refused("farm", str(inside), str(other), "-o", bundle)
    assert "-o" in refused("farm", str(good), "-o", str(broken))
    assert [*broken.iterdir()] == [inside, other]
    assert not (tmp_path / "o").exists()
    # In the list alone such a name does no harm.
    assert main(["farm", str(good), str(inside), "-o", bundle, "-q"]) == 0
    assert "--root" in refused("farm-work", bundle, "--root", str(broken))
    assert "--results" in refused("farm-work", bundle, "--results", str(broken))
    assert "--results" in refused("farm-table", bundle, "--results", str(broken))
    assert "BUNDLE" in refused("farm-table", str(broken))
    assert not (tmp_path / "o/results").exists()
    assert "--shared-folder" in refused("shade", str(good), "--shared-folder", str(broken))
    with pytest.raises(UsageError, match="--shared-folder 's3://a"):
        ClusterOptions(shared_folder=f"s3://a/b{character}c")
    with pytest.raises(UsageError, match="--scheduler"):
        ClusterOptions(scheduler=f"tcp://head{character}:8786")


def test_scans_come_from_a_file_too(tmp_path):
    places = folders(tmp_path, "scans/a b", "scans/c")
    (tmp_path / "scans.txt").write_text(f"# of today\nscans/a b\n\n{places[1]}\n")
    assert listed_in(tmp_path / "scans.txt") == places
    (tmp_path / "scans.txt").write_text("one\x85name\r\nanother # with a sign\n")
    assert [place.name for place in listed_in(tmp_path / "scans.txt")] == [
        "one\x85name", "another # with a sign",
    ]  # fmt: skip
    with pytest.raises(InputRefused, match=r"\[document.missing\]"):
        listed_in(tmp_path / "none.txt")


def test_a_folder_keeps_its_names(tmp_path):
    first, second = folders(tmp_path, "x/room", "y/room")
    for scans in (list_of([first]), list_of([first, *folders(tmp_path, "x/hall")])):
        write_bundle(
            tmp_path / "bundle", scans, bundle_of("b", scans, ConvertOptions(), FarmOptions())
        )
    other = list_of([second])
    with pytest.raises(OwnershipConflict, match=r"room is the scan .*x/room here.*\[farm.name\]"):
        write_bundle(
            tmp_path / "bundle", other, bundle_of("b", other, ConvertOptions(), FarmOptions())
        )
    assert read_list(tmp_path / "bundle/scans.json").names == ("room", "hall")


def names_after(bundle: Path, *scans: Path) -> dict[str, str]:
    """Names of the places that the list holds after ``usdbrdf farm`` with these."""
    assert main(["farm", *map(str, scans), "-o", str(bundle), "-q"]) == 0
    listed = read_list(bundle / "scans.json")
    return {str(listed.root / p): n for n, p in zip(listed.names, listed.places, strict=True)}


def test_a_name_is_never_given_again(tmp_path):
    first, hall, second = folders(tmp_path, "x/room", "z/hall", "y/room")
    bundle = tmp_path / "bundle"
    assert names_after(bundle, first) == {str(first): "room"}
    assert names_after(bundle, hall) == {str(hall): "hall"}
    # The results may hold an asset of x/room still.
    assert names_after(bundle, second) == {str(second): "y_room"}
    assert names_after(bundle, second, first) == {str(second): "y_room", str(first): "room"}
    names_after(bundle, hall)
    other = list_of([second])
    made = bundle_of("b", other, ConvertOptions(), FarmOptions())
    with pytest.raises(OwnershipConflict, match=r"room is the scan .*x/room here.*\[farm.name\]"):
        write_bundle(bundle, other, made)


def test_a_scan_that_is_added_renames_none(tmp_path):
    first, second, third = folders(tmp_path, "x/room", "y/room", "Y_Room")
    bundle = tmp_path / "bundle"
    names_after(bundle, first)
    state = (bundle / "scans.json").stat()
    names_after(bundle, first)
    assert (bundle / "scans.json").stat().st_mtime_ns == state.st_mtime_ns
    assert (bundle / "scans.json").stat().st_ino == state.st_ino
    after = names_after(bundle, first, second)
    assert after == {str(first): "room", str(second): "y_room"}
    more = names_after(bundle, third, first, second)
    assert {place: more[place] for place in after} == after
    assert len({name.lower() for name in more.values()}) == 3


@pytest.mark.parametrize(
    ("scan", "bundle"),
    [("scan", "scan/farm"), ("scan", "scan"), ("scan", "link/farm"), ("out/scan", "out")],
)
def test_scans_and_results_lie_apart(tmp_path, capsys, scan, bundle):
    place = folders(tmp_path, scan)[0]
    (tmp_path / "link").symlink_to(place)
    assert main(["farm", str(place), "-o", str(tmp_path / bundle)]) == 2
    assert "[farm.inside]" in capsys.readouterr().err
    assert not [*tmp_path.rglob("scans.json")]


@pytest.mark.parametrize("command", ["farm-work", "farm-table"])
@pytest.mark.parametrize("results", ["there/scan", "there/scan/results", "link"])
def test_results_of_another_place_lie_apart_too(tmp_path, capsys, command, results):
    """They were written into the scan that they are of, which the next task then found changed."""
    place = folders(tmp_path, "there/scan")[0]
    (tmp_path / "link").symlink_to(place)
    bundle = str(tmp_path / "bundle")
    assert main(["farm", str(place), "-o", bundle, "-q"]) == 0
    if command == "farm-work":  # where the scans were brought to counts, not where they were
        (tmp_path / "there").rename(tmp_path / "moved")
        place = tmp_path / "moved/scan"
        (tmp_path / "link").unlink()
        (tmp_path / "link").symlink_to(place)
        results = results.replace("there", "moved")
    root = ["--root", str(place.parent)] if command == "farm-work" else []
    assert main([command, bundle, *root, "--results", str(tmp_path / results)]) == 2
    assert "[farm.inside]" in capsys.readouterr().err
    assert not [*place.iterdir()]


def test_a_folder_of_somebody_else_stays(tmp_path):
    scans = list_of(folders(tmp_path, "a"))
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs/letter.txt").touch()
    made = bundle_of("b", scans, ConvertOptions(), FarmOptions())
    with pytest.raises(OwnershipConflict, match=r"\[farm.folder\]"):
        write_bundle(tmp_path / "theirs", scans, made)
    with pytest.raises(OwnershipConflict, match=r"\[farm.folder\]"):
        write_bundle(tmp_path / "theirs/letter.txt", scans, made)
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(OwnershipConflict, match=r"\[farm.folder\]"):
        write_bundle(tmp_path / "link", scans, made)
    assert [*(tmp_path / "theirs").iterdir()] == [tmp_path / "theirs/letter.txt"]


def test_a_full_disk_leaves_no_folder_behind(tmp_path, monkeypatch):
    scans = list_of(folders(tmp_path, "a"))
    made = bundle_of("b", scans, ConvertOptions(), FarmOptions())

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(bundles, "write_json", full)
    (tmp_path / "there").mkdir()
    for place in ("new/job", "there"):
        with pytest.raises(EnvironmentFailure):
            write_bundle(tmp_path / place, scans, made)
    assert not (tmp_path / "new").exists()
    assert not [*(tmp_path / "there").iterdir()]


@pytest.mark.parametrize("text", ["", "0-3", "4", "x", "3-1", "1-", "1-3:0", "-1"])
def test_what_is_no_range(text):
    with pytest.raises(UsageError, match=r"\[farm.range\]"):
        numbers_in(text, 3)


def test_ranges():
    assert numbers_in("2", 9) == [2]
    assert numbers_in("7,1-3, 9", 9) == [1, 2, 3, 7, 9]
    assert numbers_in("1-9:4", 9) == [1, 5, 9]


@pytest.mark.parametrize(
    "damage",
    ['{"schema": 2}', "[]", '{"schema": 1, "root": "/", "scans": [{"name": "../x", "place": "a"}]}',
     '{"schema": 1, "root": "/", "scans": []}', '{"schema": 1, "root": 3, "scans": [{}]}'],
)  # fmt: skip
def test_a_list_that_is_none(tmp_path, damage):
    (tmp_path / "scans.json").write_text(damage)
    with pytest.raises(InputRefused, match=r"\[farm.list\]"):
        read_list(tmp_path / "scans.json")


@pytest.mark.parametrize(
    ("names", "retired"), [(["a", "A"], []), (["a"], ["A"]), (["x" * 300], []), ([""], [])]
)
def test_names_that_would_mix_or_be_no_files(tmp_path, names, retired):
    rows, left = ([{"name": n, "place": f"/{n}"} for n in part] for part in (names, retired))
    document = {"schema": 1, "root": "/", "scans": rows, "retired": left}
    (tmp_path / "scans.json").write_text(json.dumps(document))
    with pytest.raises(InputRefused, match=r"\[farm.list\]"):
        read_list(tmp_path / "scans.json")


KILLED = """
import sys
from pathlib import Path
from tests.fault_injection import killed_at_each_change
from tests.farm import test_bundle as tests
from usdbrdf.farm.scans import known_in
top = Path(sys.argv[1])
scans = [tests.list_of(tests.folders(top / "scans", *names)) for names in ("ab", "cde")]
def write(folder, number):
    known = known_in(folder)
    listed = tests.list_of([scans[number].root / place for place in scans[number].places], known)
    made = tests.bundle_of("job", listed, tests.ConvertOptions(), tests.FarmOptions())
    tests.write_bundle(folder, listed, made)
def found(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.name[0] != "."}
write(top / "whole", 0)
for number in killed_at_each_change(lambda: write(top / "new" / "job", 0)):
    write(top / "new" / "job", 0)
    assert found(top / "new" / "job") == found(top / "whole"), number
first, seen = found(top / "whole"), set()
write(top / "new" / "job", 1)
second = found(top / "new" / "job")
for number in killed_at_each_change(lambda: write(top / "whole", 1)):
    there = found(top / "whole")
    seen.add("first" if there == first else "second" if there == second else "none")
    assert there in (first, second) or "template.json" not in there, number
    write(top / "whole", 1)
    assert found(top / "whole") == second, number
    for name, content in first.items():
        (top / "whole" / name).write_bytes(content)
print(*sorted(seen))
"""


@pytest.mark.fault("R2")
def test_killed_at_any_change_no_bundle_is_of_two_lists(tmp_path):
    assert run_fresh(KILLED, tmp_path).split() == ["first", "none", "second"]
