"""The command line as a user and a farm meet it: exit codes, sentences, and what is left behind."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.json_schemas import checked
from tests.scenes import make_capture
from usdbrdf import pipeline
from usdbrdf.capture import adapters
from usdbrdf.capture.adapters import Adapter
from usdbrdf.cli import main
from usdbrdf.command_parser import parsed
from usdbrdf.commands import COMMANDS
from usdbrdf.job.ownership import folder_lock
from usdbrdf.job.progress import set_quiet
from usdbrdf.options import BEFORE_FILTER, ConvertOptions

COARSE = ["--texel-size", "0.3", "--rays", "64", "--max-pixels", "50"]
NAMES = (
    *("convert", "ingest", "texture", "shade", "fit", "evaluate", "compare", "relight"),
    *("package", "validate", "rules", "adapters", "plugin-path", "inspect", "merge-brackets"),
    *("report", "view", "develop-raw", "develop-video", "publish"),
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("cli") / "scan").folder


@pytest.fixture(scope="module")
def asset(capture):
    folder = capture.parent / "room"
    assert main(["convert", str(capture), "-o", str(folder), "-q", *COARSE]) == 0
    return folder


@pytest.fixture(autouse=True)
def not_quiet():
    yield
    set_quiet(False)


def with_package():
    """An environment that finds the package from every folder."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}


def refused(capsys, *arguments):
    """Exit code and the one line on stderr of a call that says nothing else."""
    capsys.readouterr()
    status = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("usdbrdf: ")
    assert err.count("\n") == 1
    assert re.search(r"\[[a-z.-]+\]\n$", err), "a rule's name closes the line"
    return status, err


def run(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-m", "usdbrdf", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=900,
        **options,
    )


# Help


@pytest.mark.parametrize("name", NAMES)
def test_help_of_each_command(name, capsys):
    assert main([name, "--help"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "exit codes:" in out


def test_help_says_default_and_unit_of_every_option(capsys):
    main(["convert", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    for name, unit, default in (
        ("--wait S", "seconds", "(default: 0.0)"),
        ("--crease-angle DEG", "degrees", "(default: 40.0)"),
        ("--min-component-area M2", "m^2", "default: 0.0001 of the mesh's area"),
        ("--max-nonfinite SHARE", "share", "(default: 0.01)"),
        ("--meters-per-unit M", "metres", "default: as the format says"),
        ("--texel-size M", "metres", "default: what pixels cover, less where a pattern shows"),
        ("--quantile P", "quantile", "(default: 0.5)"),
        ("--max-texels N", "texels", "default: as many as the memory holds"),
        ("--standard-error E", "relative", "(default: 0.03)"),
        ("--rays N", "rays per texel", "default: 2048"),
        ("--environment estimate|none|HDR", "latitude-longitude", "(default: estimate)"),
        ("--seed N", "random", "(default: 0)"),
    ):
        said = text.split(f" {name} ")[-1].split(" --")[0]
        assert unit in said, name
        assert default in said, name


def test_help_says_what_the_code_does(capsys):
    main(["convert", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert f"or {BEFORE_FILTER} times as much where S is filtered" in text


@pytest.mark.parametrize(
    "arguments", [["--help"], ["convert", "--help"], ["relight", "-h"], ["adapters"]]
)
def test_nothing_that_takes_time_is_loaded_for_help_and_lists(arguments):
    code = (
        "import sys, usdbrdf.cli; status = usdbrdf.cli.main(sys.argv[1:])\n"
        "heavy = {'numpy', 'numba', 'pxr', 'scipy', 'trimesh', 'rich', 'tqdm', 'OpenImageIO'}\n"
        "sys.exit(status or ', '.join(heavy & {*sys.modules}) or None)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", ["shade", "fit"])
def test_an_option_means_the_same_in_each_command(name, capsys):
    main(["convert", "--help"])
    everything = " ".join(capsys.readouterr().out.split())
    main([name, "--help"])
    own = " ".join(capsys.readouterr().out.split())
    for option in ("--seed N seed", "--environment estimate|none|HDR light"):
        sentence = own[own.index(option) :].split(" --")[0]
        sentence = sentence.split(" exit codes")[0].split(" cluster:")[0]
        assert sentence in everything


def test_seed_reaches_shade_and_fit(asset):
    main(["convert", str(asset.parent / "scan"), "-o", str(asset), *COARSE, "--seed", "7", "-q"])
    for stamp in ("3-shade", "4-fit"):
        record = json.loads((asset / f".usdbrdf/stamps/{stamp}.json").read_text())
        assert record["parameters"]["seed"] == 7


# Wrong options


@pytest.mark.parametrize(
    "options",
    [
        ["--texel-size", "0"],
        ["--texel-size", "nan"],
        ["--texel", "0.1"],
        ["--quantile", "1"],
        ["--max-texels", "0"],
        ["--rays", "2"],
        ["--rays", "9999999999"],
        ["--standard-error", "-1"],
        ["--seed", "-1"],
        ["--seed", "1.5"],
        ["--max-pixels", "3"],
        ["--fit", "best"],
        ["--adopt", "--discard"],
        ["--crease-angle", "181"],
        ["--up-axis", "x"],
        ["--wait", "long"],
        ["--memory", "1e300"],
        ["--meters-per-unit", "1e300"],
        ["--meters-per-unit", "1e-300"],
        ["--pose-scale", "-1"],
        ["--texel-size", "1e300"],
        ["--max-texels", "1" + 30 * "0"],
        ["--max-texels", 5000 * "9"],
        ["--decimate", "0"],
    ],
)
def test_wrong_options_are_refused_before_anything_is_made(options, capture, tmp_path, capsys):
    status, _ = refused(capsys, "convert", capture, "-o", tmp_path / "out", *options)
    assert status == 2
    assert list(tmp_path.iterdir()) == []


def test_what_is_said_twice_counts_as_said_last_and_reaches_all_who_have_it():
    words = "scan -o out --seed 3 --seed 4 --memory 2 --allow-outside a --allow-outside b"
    command = parsed(["convert", *words.split(), "--sampling", "cosine"], COMMANDS)
    options = command.options
    assert (options.shade.sampling.seed, options.fit.seed) == (4, 4)
    assert (options.texture.memory, options.fit.memory) == (2, 2)
    assert options.ingest.allow_outside == (Path("a"), Path("b"))
    assert options.shade.sampling.max_rays == 10_000
    assert parsed(["convert", "scan", "-o", "out"], COMMANDS).options == ConvertOptions()


@pytest.mark.parametrize("arguments", [[], ["paint"], ["convert"], ["fit"], ["adapters", "x"]])
def test_wrong_commands(arguments, capsys):
    assert refused(capsys, *arguments)[0] == 2


# Inputs and outputs that cannot be used leave nothing behind


def test_names_that_are_not_utf8(tmp_path, capsys):
    name = os.fsdecode(b"caf\xe9")
    status, line = refused(capsys, "ingest", tmp_path / name, "-o", tmp_path / "out")
    assert (status, "caf\\udce9: the name" in line) == (2, True)
    (tmp_path / name).mkdir()
    done = run("ingest", "scan", "-o", "out", cwd=tmp_path / name, env=with_package())
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert list((tmp_path / name).iterdir()) == []


@pytest.mark.fault("R17")
@pytest.mark.parametrize("output", ["x" * 256, "/".join(["x" * 200] * 25)])
def test_names_longer_than_the_system_allows(output, capture, tmp_path, capsys):
    place = tmp_path / output
    for arguments in (["convert", capture, "-o", place], ["validate", place], ["inspect", place]):
        status, line = refused(capsys, *arguments)
        assert (status, "File name too long. Shorten it. [usage.path]" in line) == (2, True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.fault("R17")
def test_an_empty_word_is_neither_the_default_nor_the_current_folder(
    capture, tmp_path, capsys, monkeypatch
):
    """As a variable of a shell is that was never set."""
    monkeypatch.chdir(tmp_path)
    for subject, arguments in [
        ("-o", ["convert", capture, "-o", ""]),
        ("--output", ["convert", capture, "--output="]),
        ("''", ["convert", "", "-o", "a"]),
        ("''", ["validate", ""]),
        ("''", ["convert", "-q", "", "-o", "a"]),
        ("--mesh", ["convert", capture, "-o", "a", "--mesh", ""]),
        ("--rays", ["convert", capture, "-o", "a", "--rays="]),
    ]:
        status, line = refused(capsys, *arguments)
        assert (status, f"usdbrdf: {subject}: the word given here is empty" in line) == (2, True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.fault("R16")
@pytest.mark.parametrize(
    ("name", "value"),
    [("NUMBA_DISABLE_JIT", "1"), ("NUMBA_NUM_THREADS", "0"), ("NUMBA_NUM_THREADS", "-2")],
)
def test_settings_of_the_compiler_that_nothing_works_with(
    name, value, capture, tmp_path, capsys, monkeypatch
):
    """They were a defect, and a capture whose cameras look past the mesh."""
    monkeypatch.setenv(name, value)
    status, line = refused(capsys, "convert", capture, "-o", tmp_path / "out")
    assert (status, name in line, "[environment.compiler]" in line) == (4, True, True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("area", ["-1", "-inf", "nan"])
def test_an_area_is_no_less_than_nothing(capture, tmp_path, capsys, area):
    named = ["ingest", capture, "-o", tmp_path / "out", f"--min-component-area={area}"]
    status, line = refused(capsys, *named)
    assert (status, "--min-component-area" in line, "at least 0" in line) == (2, True, True)
    assert list(tmp_path.iterdir()) == []


def test_where_memory_runs_out_what_asks_for_less_is_named(capsys, monkeypatch):
    """Of a picture 65,536 pixels wide a larger --texel-size saves nothing."""

    def ends(_):
        raise MemoryError

    monkeypatch.setattr("usdbrdf.cli._run", ends)
    status, line = refused(capsys, "relight", "a", "-o", "b.exr")
    assert (status, "--width" in line, "--texel-size" in line) == (4, True, True)


@pytest.mark.fault("S9")
def test_settings_of_the_compiler_in_the_current_folder(capture, tmp_path, capsys, monkeypatch):
    """Somebody works in a capture by others that brings some along: rays hit nothing."""
    pytest.importorskip("yaml", reason="numba reads them with it")
    (tmp_path / ".numba_config.yaml").write_text("DISABLE_JIT: 1")
    monkeypatch.chdir(tmp_path)
    status, line = refused(capsys, "convert", capture, "-o", tmp_path / "out")
    assert (status, f"{tmp_path}/.numba_config.yaml: numba" in line) == (4, True)
    assert not (tmp_path / "out").exists()


@pytest.mark.fault("R17")
def test_paths_that_nobody_can_follow(capture, tmp_path, capsys):
    (tmp_path / "loop").symlink_to("loop")
    for arguments in (["convert", capture, "-o", tmp_path / "loop/out"], ["validate", "loop"]):
        arguments = [tmp_path / "loop" if word == "loop" else word for word in arguments]
        status, line = refused(capsys, *arguments)
        assert (status, "symbolic links" in line, "[usage.path]" in line) == (3, True, True)


@pytest.mark.fault("R17")
@pytest.mark.parametrize("arguments", [["convert", "scan", "-o", "out"], ["doctor"]])
def test_a_current_folder_that_is_gone(arguments, tmp_path):
    (gone := tmp_path / "gone").mkdir()
    call = f'rmdir {gone}; exec {sys.executable} -P -m usdbrdf "$@"'
    done = subprocess.run(
        ["/bin/sh", "-c", call, "sh", *arguments],
        cwd=gone, env=with_package(), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr.count("\n")) == (4, 1), done.stderr
    assert "the current folder: No such file" in done.stderr


@pytest.mark.fault("R17")
def test_a_locale_that_spells_names_otherwise_than_usd(tmp_path):
    spelt = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = run("validate", "caf\xe9", cwd=tmp_path, env=with_package() | spelt)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "set LC_ALL=C.UTF-8" in done.stderr


def test_sentences_end_once_and_tell_nothing_of_usds_own_source(tmp_path, capsys):
    code, line = refused(capsys, "convert", "scan", "-o", "room", "--texel-sizes", "1")
    assert code == 2
    assert "Did you mean --texel-size? See usdbrdf convert --help." in line
    (tmp_path / "scan.usda").write_text("no layer\n")
    code, line = refused(capsys, "convert", str(tmp_path / "scan.usda"), "-o", str(tmp_path / "o"))
    assert code == 3
    assert "is not a valid usda layer). Export it again." in line
    assert "pxrInternal" not in line


def test_missing_scan(tmp_path, capsys):
    status, line = refused(capsys, "convert", tmp_path / "none", "-o", tmp_path / "a" / "b")
    assert status == 3
    assert "none: no such file or folder" in line
    assert list(tmp_path.iterdir()) == []


def test_bad_capture_leaves_no_folder(tmp_path, capsys):
    scan = make_capture(tmp_path / "scan", frames=2)
    status, _ = refused(capsys, "convert", scan.folder, "-o", tmp_path / "out")
    assert status == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scan"]


def test_bad_capture_keeps_an_empty_folder_that_was_there(tmp_path, capsys):
    (tmp_path / "out").mkdir()
    assert refused(capsys, "convert", tmp_path / "none", "-o", tmp_path / "out")[0] == 3
    assert (tmp_path / "out").is_dir()


def test_refused_later_keeps_what_was_valid(asset, tmp_path, capsys):
    before = (asset / "layers" / "scan.usdc").read_bytes()
    status, _ = refused(capsys, "ingest", tmp_path / "none", "-o", asset)
    assert status == 3
    assert (asset / "layers" / "scan.usdc").read_bytes() == before


@pytest.mark.parametrize("name", ["texture", "shade", "fit", "validate"])
def test_steps_without_an_asset(name, tmp_path, capsys):
    assert refused(capsys, name, tmp_path / "none")[0] == 3
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["--mesh", "--objects", "--environment"])
def test_files_named_by_options_must_exist(option, capture, tmp_path, capsys):
    call = ("convert", capture, "-o", tmp_path / "out", option, tmp_path / "none")
    status, line = refused(capsys, *call)
    assert status == 3
    assert "none" in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["--mesh", "--objects", "--environment"])
def test_files_named_by_options_are_taken(option, tmp_path):
    file = tmp_path / "sky.exr"
    file.write_bytes(b"")
    chosen = parsed(["convert", "scan", "-o", "out", option, str(file)], COMMANDS).options
    parts = (chosen.ingest, chosen.shade, chosen.fit)
    assert file in [getattr(part, option[2:], None) for part in parts]
    if option == "--environment":
        assert chosen.shade.environment == chosen.fit.environment == file


def test_output_that_is_a_file_or_lies_in_one(capture, tmp_path, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    assert refused(capsys, "convert", capture, "-o", file)[0] == 4
    assert refused(capsys, "convert", capture, "-o", file / "out")[0] == 4
    assert file.read_text() == "mine"


@pytest.mark.fault("R5")
@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_output(capture, tmp_path, capsys):
    tmp_path.chmod(0o555)
    try:
        assert refused(capsys, "convert", capture, "-o", tmp_path / "out")[0] == 4
        assert refused(capsys, "convert", capture, "-o", tmp_path / "a" / "out")[0] == 4
    finally:
        tmp_path.chmod(0o755)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system without mkdir")
@pytest.mark.parametrize("output", ["/proc/out", "/proc/a/out"])
def test_output_where_nothing_can_be_made(output, capture, capsys):
    assert refused(capsys, "convert", capture, "-o", output)[0] == 4


@pytest.mark.fault("R10")
def test_foreign_folder(capture, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    assert refused(capsys, "convert", capture, "-o", tmp_path)[0] == 6
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.fault("R6")
def test_busy_folder(asset, capsys):
    held = folder_lock(asset / ".usdbrdf")
    with ThreadPoolExecutor(1) as another:
        another.submit(held.__enter__).result()
        assert refused(capsys, "fit", asset)[0] == 5
        another.submit(held.__exit__, None, None, None).result()


# What is said


def test_second_run_is_up_to_date(capture, asset, capsys):
    main(["convert", str(capture), "-o", str(asset), "-q", *COARSE])
    assert main(["convert", str(capture), "-o", str(asset), *COARSE]) == 0
    out, err = capsys.readouterr()
    assert out == ""
    for name in ("ingest", "texture", "shade", "fit"):
        assert f"{name}: up to date\n" in err
    assert err.endswith("room.usda: up to date\n")


def test_capture_that_holds_its_own_asset(tmp_path, capsys):
    scan = make_capture(tmp_path / "scan").folder
    for _ in range(2):
        assert main(["ingest", str(scan), "-o", str(scan / "asset")]) == 0
    assert "ingest: up to date" in capsys.readouterr().err


def test_quiet_says_nothing(capture, asset, capfd):
    assert main(["convert", str(capture), "-o", str(asset), "-q", *COARSE]) == 0
    assert capfd.readouterr() == ("", "")


def test_json_is_all_there_is_on_stdout(capture, tmp_path):
    done = run("ingest", capture, "-o", tmp_path / "out", "--json")
    assert done.returncode == 0
    summary = json.loads(done.stdout)
    assert summary["asset"] == str(tmp_path / "out" / "out.usda")
    assert summary["steps"]["ingest"]["reran"] is True
    assert summary["steps"]["ingest"]["frames"] == 12


@pytest.mark.parametrize("asked", ["*", "help"])
def test_what_usd_is_asked_to_tell_is_not_on_stdout(capture, tmp_path, monkeypatch, asked):
    monkeypatch.setenv("TF_DEBUG", asked)
    done = run("ingest", capture, "-o", tmp_path / "out", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "ingest" in json.loads(done.stdout)["steps"]
    assert [file.name for file in tmp_path.iterdir()] == ["out"]


def test_json_of_a_refused_run_is_empty(tmp_path, capsys):
    assert refused(capsys, "ingest", tmp_path / "none", "-o", tmp_path / "out", "--json")[0] == 3


@pytest.mark.fault("S4")
def test_message_about_a_strange_name_is_printable(tmp_path, capsys):
    main(["ingest", str(tmp_path / "no\x1b[31mne"), "-o", str(tmp_path / "out")])
    assert "\x1b" not in capsys.readouterr().err


@pytest.mark.fault("S4")
def test_message_about_a_name_with_newlines_is_one_line(tmp_path, capsys):
    main(["ingest", str(tmp_path / "no\nne"), "-o", str(tmp_path / "out")])
    assert capsys.readouterr().err.count("\n") == 1


def test_version_and_plugin_path(capsys):
    assert main(["--version"]) == 0
    assert re.fullmatch(r"usdbrdf \S+\n", capsys.readouterr().out)
    assert main(["plugin-path"]) == 0
    schemas, validators = capsys.readouterr().out.strip().split(os.pathsep)
    assert (Path(schemas) / "generatedSchema.usda").is_file()
    assert (Path(validators) / "usd_plugin.py").is_file()
    assert main(["plugin-path", "--schemas"]) == 0
    assert capsys.readouterr().out.strip() == schemas


def test_adapters_are_listed_one_per_line(monkeypatch, capsys):
    assert main(["adapters"]) == 0
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert [line.split()[0] for line in lines[: len(adapters.MODULES)]] == list(adapters.MODULES)
    assert all(re.fullmatch(r"\S+ +\S.+ \(\S+\)", line) for line in lines)
    assert err == ""

    broken = Adapter(name="bad", description="", origin="p.m", module=None, problem="no\nread")
    monkeypatch.setattr(adapters, "list_adapters", lambda: (broken,))
    main(["adapters"])
    assert capsys.readouterr().out == "bad  broken: no read (p.m)\n"


def test_validate_prints_findings_and_exits_7(asset, capsys):
    assert main(["validate", str(asset)]) == 0
    assert capsys.readouterr().out == ""
    picture = next((asset / "textures").glob("*.lit.exr"))
    away = picture.rename(asset.parent / picture.name)
    try:
        assert main(["validate", str(asset)]) == 7
    finally:
        away.rename(picture)
    (line,) = capsys.readouterr().out.splitlines()
    assert re.fullmatch(
        r"error: <[\w/:.]+> @[^@]+@: @.*@ does not exist\. .* \[usdbrdf\.MissingTexture\]", line
    )
    assert picture.name in line


def test_validate_with_warnings_alone_exits_0(asset, capsys):
    orphan = asset / "textures" / "left_over.lit.exr"
    orphan.write_bytes(b"")
    try:
        assert main(["validate", str(asset)]) == 0
    finally:
        orphan.unlink()
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("warning: </room> @")
    assert line.endswith(f"@{orphan}@. [usdbrdf.OrphanTexture]")


def test_validate_writes_cures_into_the_layer_that_is_named(asset, capsys):
    edits, fixes = asset / "edits.usda", asset / "fixes.usda"
    before = edits.read_text()
    edits.write_text(before.replace('over "room"', 'over "room" (variants = {string look = "x"})'))
    try:
        assert main(["validate", str(asset), "--fix", str(fixes)]) == 7
        assert "[usdbrdf.LookSelection]" in capsys.readouterr().out
        assert 'string look = "shaded"' in fixes.read_text()
        assert main(["validate", str(asset), "--fix", str(edits)]) == 2
    finally:
        edits.write_text(before)
        fixes.unlink(missing_ok=True)


def test_rules_are_listed(capsys):
    assert main(["rules"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("usdbrdf.LookSelection (error): ") for line in lines)
    assert all(re.match(r"[\w.:]+( \((error|warning|info)\))?: .+\.$", line) for line in lines)
    assert main(["rules", "--json"]) == 0
    listed = checked(capsys.readouterr().out, "rules")
    assert [rule["name"] for rule in listed] == [re.split(r":? ", line)[0] for line in lines]
    assert all(rule["advice"] for rule in listed if rule["name"].startswith("usdbrdf."))


# Files edited by hand


@pytest.fixture
def edited_asset(asset, capture):
    """The asset with one line more in texturing.usda; whole again afterwards."""
    layer = asset / "layers" / "texturing.usda"
    main(["convert", str(capture), "-o", str(asset), "-q", *COARSE])
    made = layer.read_bytes()
    layer.write_bytes(made + b"# by hand\n")
    yield layer, made
    layer.write_bytes(made)
    for copy in asset.glob("adopted-*.usda"):
        copy.unlink()


@pytest.mark.fault("R9")
def test_edited_by_hand_is_refused(capture, asset, edited_asset, capsys):
    layer, made = edited_asset
    status, line = refused(capsys, "convert", capture, "-o", asset, *COARSE)
    assert status == 6
    assert "layers/texturing.usda" in line
    assert "--adopt" in line
    assert "--discard" in line
    assert layer.read_bytes() == made + b"# by hand\n"


@pytest.mark.fault("R9")
def test_edited_by_hand_is_adopted(capture, asset, edited_asset, capsys):
    layer, made = edited_asset
    assert main(["convert", str(capture), "-o", str(asset), "--adopt", *COARSE]) == 0
    assert layer.read_bytes() == made
    assert (asset / "adopted-1.usda").is_file()
    assert "adopted-1.usda" in capsys.readouterr().err


@pytest.mark.fault("R9")
def test_edited_by_hand_is_discarded(capture, asset, edited_asset):
    layer, made = edited_asset
    assert main(["convert", str(capture), "-o", str(asset), "--discard", "-q", *COARSE]) == 0
    assert layer.read_bytes() == made
    assert list(asset.glob("adopted-*")) == []


# Ends that come from outside


@pytest.mark.fault("R3")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_signals(number, status, capture, tmp_path, monkeypatch, capsys):
    handler = signal.getsignal(signal.SIGTERM)

    def killed(*_arguments, **_options):
        os.kill(os.getpid(), number)

    monkeypatch.setattr(pipeline, "ingest", killed)
    # What starts in the background inherits an interrupt that is ignored.
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert main(["ingest", str(capture), "-o", str(tmp_path / "out")]) == status
    finally:
        signal.signal(signal.SIGINT, inherited)
    assert capsys.readouterr().err.endswith("the same command goes on from here.\n")
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) is handler


@pytest.mark.fault("R3")
def test_terminated_while_it_works(capture, tmp_path):
    arguments = [sys.executable, "-m", "usdbrdf", "convert", str(capture)]
    arguments += ["-o", str(tmp_path / "out"), "--texel-size", "0.02"]
    with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True) as process:
        for line in process.stderr:
            if line.startswith("texture: "):
                break
        process.terminate()
        assert process.wait(600) == 143
        assert process.stderr.read().endswith("terminated; the same command goes on from here.\n")
    assert (tmp_path / "out" / "layers" / "scan.usdc").is_file()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("module", ["cyclopts", "usdbrdf.pipeline", "pxr.Usd", "numba"])
def test_signals_while_modules_are_loaded(module, number, capture, tmp_path):
    """What is being imported may swallow an interrupt, or take it for a failure of its own."""
    code = f"""
import os, signal, sys
from usdbrdf.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            try:
                os.kill(os.getpid(), {int(number)})
            except BaseException as error:
                raise ImportError("taken for a failure") from error
sys.meta_path.insert(0, Interrupting())
sys.exit(main(sys.argv[1:]))
"""
    arguments = ["ingest", str(capture), "-o", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )
    word, status = {signal.SIGINT: ("interrupted", 130), signal.SIGTERM: ("terminated", 143)}[
        number
    ]
    assert done.stderr == f"usdbrdf: {word}; the same command goes on from here.\n"
    assert done.returncode == status
    assert list(tmp_path.iterdir()) == []


# Readers that go away


def nowhere(kind):
    """A descriptor that cannot be written to."""
    if kind == "full":
        return os.open("/dev/full", os.O_WRONLY)
    read, write = os.pipe()
    os.close(read)
    return write


def run_into(*arguments, **streams):
    """Exit code and what came through a pipe, of a call with its other stream at ``nowhere``."""
    (stream, kind), pipes = next(iter(streams.items())), {"stdout", "stderr"}
    target = nowhere(kind)
    (other,) = pipes - {stream}
    done = subprocess.run(
        [sys.executable, "-m", "usdbrdf", *map(str, arguments)],
        **{stream: target, other: subprocess.PIPE},
        text=True,
        check=False,
    )
    os.close(target)
    return done.returncode, getattr(done, other)


KINDS = pytest.mark.parametrize(
    "kind",
    [
        "gone",
        pytest.param(
            "full",
            marks=pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full"),
        ),
    ],
)


@pytest.mark.fault("R16")
@KINDS
def test_what_nobody_hears_changes_neither_work_nor_status(kind, capture, tmp_path):
    folder = tmp_path / "out"
    status, out = run_into("ingest", capture, "-o", folder, "--json", stderr=kind)
    assert status == 0
    assert json.loads(out)["steps"]["ingest"]["reran"] is True
    assert (folder / ".usdbrdf/stamps/1-ingest.json").is_file()
    assert run_into("ingest", tmp_path / "none", "-o", folder, stderr=kind) == (3, "")
    assert run_into("ingest", capture, stderr=kind) == (2, "")


@pytest.mark.fault("R16")
@pytest.mark.parametrize("arguments", [["convert", "--help"], ["adapters"], ["--version"]])
def test_a_reader_who_has_seen_enough_of_a_list(arguments):
    assert run_into(*arguments, stdout="gone") == (0, "")


def test_findings_that_nobody_reads_are_still_a_status(asset):
    picture = next((asset / "textures").glob("*.lit.exr"))
    away = picture.rename(asset.parent / picture.name)
    try:
        assert run_into("validate", asset, stdout="gone") == (7, "")
    finally:
        away.rename(picture)


@KINDS
def test_a_summary_that_cannot_be_handed_over_is_a_failure(kind, capture, tmp_path):
    status, err = run_into("ingest", capture, "-o", tmp_path / "out", "-q", "--json", stdout=kind)
    assert status == {"gone": 1, "full": 4}[kind]
    assert re.fullmatch(r"usdbrdf: stdout.* \[environment\.output\]\n", err)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("arguments", [["--help"], ["adapters"], ["--version"]])
def test_a_full_disk_behind_stdout(arguments):
    status, err = run_into(*arguments, stdout="full")
    assert (status, err.count("\n")) == (4, 1)


CURES = {
    errno.EACCES: "Correct the permission, then",
    errno.EROFS: "Make the file system writable",
    errno.ENOSPC: "Free disk space, then",
    errno.EDQUOT: "Free disk space of your quota",
    errno.EIO: "Check the disk",
    errno.ESTALE: "Check the disk",
    errno.EMFILE: "Raise this shell's limit on open files",
    errno.EAGAIN: "Raise the limits on processes",  # of a fork
}


@pytest.mark.parametrize("code", CURES)
def test_what_the_machine_refuses_is_no_defect_wherever_it_comes(
    capture, tmp_path, monkeypatch, capsys, code
):
    """As to ask for a file in a folder that one may not enter."""

    def refused(*_arguments, **_options):
        raise OSError(code, os.strerror(code), "layers/scan.usdc")

    monkeypatch.setattr(pipeline, "ingest", refused)
    assert main(["ingest", str(capture), "-o", str(tmp_path / "out")]) == 4
    err = capsys.readouterr().err
    assert err.startswith(f"usdbrdf: layers/scan.usdc: {os.strerror(code)}. {CURES[code]}")
    assert err.endswith("[environment.io]\n")


@pytest.mark.fault("R4")
def test_a_limit_on_processes_is_no_defect(capture, tmp_path):
    """Threads count as processes, and want addresses for their stacks."""
    code = (
        "import sys, threading; from usdbrdf import pipeline\n"
        "from usdbrdf.cli import main\n"
        "class Refused(threading.Thread):\n"
        '    def start(self): raise RuntimeError("can\'t start new thread")\n'
        "threading.Thread = Refused\n"
        "sys.exit(main(['ingest', *sys.argv[1:]]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(capture), "-o", str(tmp_path / "out"), "-q"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 4, done.stderr
    assert re.fullmatch(
        r"usdbrdf: this machine.*threads.*ulimit -u.* \[environment\.processes\]\n", done.stderr
    )
    assert list(tmp_path.iterdir()) == []


def test_a_defect_is_told_from_a_mistake(capture, tmp_path, monkeypatch, capsys):
    def broken(*_arguments, **_options):
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(pipeline, "ingest", broken)
    assert main(["ingest", str(capture), "-o", str(tmp_path / "out")]) == 1
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert "defect of usdbrdf" in err
    assert list(tmp_path.iterdir()) == []


# What --strict counts


@pytest.mark.fault("L1")
@pytest.mark.fault("L7")
@pytest.mark.fault("G13")
def test_strict_is_7_after_the_same_work(capture, tmp_path, capsys):
    scan, out = tmp_path / "scan", tmp_path / "out"
    shutil.copytree(capture, scan)
    call = ["ingest", str(scan), "-o", str(out), "-q", "--strict"]
    assert main(call) == 0
    (scan / "frames" / "0003.exr").unlink()
    assert main(call) == 7
    assert re.fullmatch(
        r"usdbrdf: done, with 1 warnings.*\[quality\.strict\]\n", capsys.readouterr().err
    )
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert main(call) == 7, "also where nothing has to be done"
    assert main(call[:-1]) == 0
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


@pytest.mark.fault("R6")
def test_a_file_system_without_locks(capture, tmp_path, monkeypatch, capsys):
    def no_locks(*_arguments):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "lockf", no_locks)
    call = ["ingest", str(capture), "-o", str(tmp_path / "out"), "-q"]
    status, line = refused(capsys, *call)
    assert status == 5
    assert "--without-lock" in line
    assert not (tmp_path / "out").exists()
    assert main([*call, "--without-lock"]) == 0


@pytest.mark.fault("R16")
@pytest.mark.parametrize("closed", [(), (0, 1, 2)], ids=str)
def test_without_home_locale_terminal_or_streams(capture, tmp_path, closed):
    """As a scheduler starts it: hardly any environment, and descriptors that are closed."""
    redirect = " ".join(f"{number}{'<' if number == 0 else '>'}&-" for number in closed)
    call = f"exec {sys.executable} -m usdbrdf ingest {capture} -o {tmp_path}/out --json {redirect}"
    root = Path(__file__).parents[1]
    done = subprocess.run(
        ["/bin/sh", "-c", call],
        env={"PYTHONPATH": str(root), "LANG": "C", "LC_ALL": "C", "TMPDIR": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    # The summary that was asked for cannot be handed over; the work is done all the same.
    assert done.returncode == (4 if 1 in closed else 0), done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "out/.usdbrdf/stamps/1-ingest.json").is_file()
    if not closed:
        assert json.loads(done.stdout)["steps"]["ingest"]["reran"]


@pytest.mark.fault("S5")
def test_strange_names_of_folders_pass_through_all_commands(tmp_path):
    folder = tmp_path / "a b é 椅子 # @ [1] ; <UDIM> %04d"
    made = make_capture(folder / "scan", frames=8, subdivisions=1).folder
    room = folder / ("x" * 200)
    assert main(["convert", str(made), "-o", str(room), "-q", *COARSE]) == 0
    assert main(["validate", str(room)]) == 0
    assert main(["package", str(room), "-q", "-o", str(folder / "room.usdz")]) == 0
    moved = room.rename(folder / "moved")
    assert main(["validate", str(moved)]) == 0
