"""The documentation: links lead somewhere, its commands exist and run, its reference is whole."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_json_schemas import check
from usdbrdf.asset.properties import RECORDS, facts_of
from usdbrdf.command_parser import parsed
from usdbrdf.commands import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
TUTORIALS = (ROOT / "docs/tutorials.md").read_text("utf-8")
RUNS = dict(re.findall(r"<!-- run: ([\w-]+) -->\n```sh\n(.*?)```", TUTORIALS, re.DOTALL))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?://|mailto:", target):
            continue
        file, _, anchor = target.partition("#")
        place = page.parent / file if file else page
        assert place.exists(), f"{page.name}: {target}"
        if anchor:
            titles = re.findall(r"^#+ (.+)$", place.read_text("utf-8"), re.MULTILINE)
            anchors = [re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles]
            assert anchor in anchors, f"{page.name}: {target}"


def test_the_readme_is_short_and_holds_two_commands():
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= 100
    assert re.findall(r"<!-- command: (\w+) -->", text) == ["sample", "test"]
    picture = ROOT / re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)[0]
    assert picture.stat().st_size <= 200_000


def test_every_page_is_in_the_site():
    listed = re.findall(r"[\w-]+\.md", (ROOT / "mkdocs.yml").read_text("utf-8"))
    assert sorted(listed) == sorted(page.name for page in (ROOT / "docs").glob("*.md"))


@pytest.mark.parametrize("name", RUNS)
def test_the_commands_of_tutorials_exist(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    for line in RUNS[name].splitlines():
        program, *words = shlex.split(line)
        assert program == "usdbrdf"
        parsed(words, COMMANDS)


def test_the_commands_of_tutorials_run(tmp_path):
    """One after the other, on the sample."""
    (tmp_path / "samples").symlink_to(ROOT / "samples")
    search = os.pathsep.join([str(ROOT), *sys.path])
    for name, lines in RUNS.items():
        for line in lines.splitlines():
            done = subprocess.run(
                [sys.executable, "-m", *shlex.split(line)],
                cwd=tmp_path, env={**os.environ, "PYTHONPATH": search}, capture_output=True,
            )  # fmt: skip
            assert done.returncode in (0, 7 if "--strict" in line else 0), (name, line, done.stderr)
            if "convert" in line and "--json" in line:
                check(json.loads(done.stdout), "run")
    made = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"study", "study.html", "evaluation", "study.usdz", "night.png"} <= made


def test_the_site_is_whole(tmp_path):
    pytest.importorskip("mkdocstrings", reason="needs the extra docs")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path / "site")],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "site/reference/index.html").read_text("utf-8")
    assert "made:" not in page
    for name in COMMANDS:
        assert f'id="{name}"' in page, name
    for record in RECORDS:
        for _, fact in facts_of(record):
            assert fact.attribute() in page, fact
    for function in ("convert", "working_on", "evaluate", "relight"):
        assert re.search(rf'id="usdbrdf\.[\w.]*\.{function}"', page), function
