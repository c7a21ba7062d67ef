"""What the package is made of: licences that may be, and bounds on what is installed."""

from __future__ import annotations

import json
import re
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Ask for no more than their notice; MPL and TOST for nothing where files of theirs stay unchanged.
ALLOWED = re.compile(
    r"MIT|BSD|Apache|PSF|Python Software Foundation|MPL|Mozilla|Zlib|CC0|ISC|TOST", re.IGNORECASE
)
# Packages whose metadata say something else, and why they may be here all the same.
ODD = {
    "axe-playwright-python": "MIT: its metadata name none; it brings axe-core, MPL-2.0, for tests",
    "embreex": "BSD-2-Clause: its metadata hold the text in the place of a name",
    "opencolorio": "BSD-3-Clause: its metadata hold the text in the place of a name",
    "pymeshlab": "GPL-3: arrays are exchanged with a process of its own; README, Licences",
}


@pytest.fixture(scope="module")
def project():
    tomllib = pytest.importorskip("tomllib")  # part of Python from 3.11 on
    return tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def _name(requirement: str) -> str:
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert found
    return re.sub(r"[-_.]+", "-", found[0]).lower()


def _installed(requirements: list[str]) -> dict[str, Distribution]:
    """All that these bring along, as far as it is installed here."""
    found: dict[str, Distribution] = {}
    waiting = [_name(requirement) for requirement in requirements]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            continue
        waiting += [_name(each) for each in found[name].requires or [] if "extra ==" not in each]
    return found


def _licence(package: Distribution) -> str:
    metadata = package.metadata
    classes = metadata.get_all("Classifier") or []
    told = [each.rpartition(" :: ")[2] for each in classes if each.startswith("License ::")]
    return metadata.get("License-Expression") or "; ".join(told) or metadata.get("License") or ""


def _all(project) -> dict[str, Distribution]:
    extras = project["optional-dependencies"].values()
    return _installed([*project["dependencies"], *(each for extra in extras for each in extra)])


def test_licences_are_those_that_were_agreed_to(project):
    found = _all(project)
    assert len(found) > 20
    strange = {
        name: _licence(package)[:80]
        for name, package in found.items()
        if not ALLOWED.search(_licence(package).partition("\n")[0])
    }
    assert strange.keys() - ODD.keys() == set(), strange
    assert "GPL" in _licence(found["pymeshlab"])


def test_copyleft_is_no_licence_of_ours(project):
    assert not ALLOWED.search("GPL-3.0-or-later")
    assert project["license"] == "Apache-2.0"


def test_every_dependency_has_an_upper_bound(project):
    """What comes out next year was never tested."""
    assert [each for each in project["dependencies"] if "<" not in each] == []


def test_all_that_is_required_is_pinned_for_the_tests(project):
    pinned = {_name(line) for line in (ROOT / "constraints.txt").read_text().splitlines()[1:]}
    # Installers and build backends are not of the environment.
    assert _all(project).keys() - pinned - {"pip", "setuptools", "usdbrdf"} == set()


def test_the_hashed_constraints_are_the_same():
    lines = (ROOT / "constraints-hashed.txt").read_text().splitlines()[2:]
    hash_of_all = [re.fullmatch(r"\S+==\S+ --hash=sha256:\w{64}", line) for line in lines]
    assert None not in hash_of_all
    hashed = {line.partition(" ")[0] for line in lines}
    exact = (ROOT / "constraints.txt").read_text().splitlines()[1:]
    older = {line.partition(";")[0] for line in exact if '< "3.11"' in line}
    assert hashed == {line.partition(";")[0] for line in exact} - older


def test_constraints_and_hashes_name_no_place():
    for file in ROOT.glob("*.txt"):
        assert not re.search(r"://|--(extra-)?index|--find-links", file.read_text()), file.name


def test_what_browsers_are_given_is_pinned_and_small():
    static, web = ROOT / "usdbrdf/page/static", ROOT / "web"
    packages = json.loads((web / "package-lock.json").read_text("utf-8"))["packages"]
    wanted = json.loads((web / "package.json").read_text("utf-8"))["devDependencies"]
    assert all(re.fullmatch(r"[\d.]+", version) for version in wanted.values())
    assert not any("resolved" in package for package in packages.values())
    three = packages["node_modules/three"]
    assert (three["version"], three["license"]) == (wanted["three"], "MIT")
    bundle = (static / "room.bundle.js").read_bytes()
    assert len(bundle) <= 1_500_000
    # three.js writes the release that it is of into the scene.
    assert f'"{three["version"].split(".")[1]}"'.encode() in bundle
    licence = (static / "room.bundle.LICENCE.txt").read_text("utf-8")
    assert licence.startswith(f"three.js {three['version']}\n")
    assert "The MIT License" in licence
    assert "three.js authors" in licence
