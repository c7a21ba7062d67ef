"""What of the machine, of the libraries and of the extras is there, and whether what every run
needs works: not whether it is installed but whether it does its work."""

from __future__ import annotations

import ctypes.util
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numpy as np

from usdbrdf.asset.schemas import plugin_path, verify
from usdbrdf.errors import EnvironmentFailure, UsdBrdfError
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.identity import tasks_identity
from usdbrdf.job.memory import GIB, machine_bytes, refuse_few_addresses
from usdbrdf.job.ownership import folder_lock
from usdbrdf.job.processes import granted_cores
from usdbrdf.job.stamp import code_version
from usdbrdf.kernel import mark_of_compiled, num_threads

State = Literal["ok", "missing", "broken"]
# Below these a room of a hundred frames will hardly go through.
_LEAST_MEMORY, _LEAST_DISK = 4 * GIB, 2 * GIB
_FOR_DEVELOPERS = ("browser", "dev", "docs", "test")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Of one thing: whether it is there and works, in words what it is or what to do, and whether
    nothing goes without it."""

    part: Literal["machine", "needed", "extra", "program"]
    name: str
    state: State
    text: str
    needed: bool = False


def examine() -> list[Finding]:
    """All that is looked at, in the order in which it is told. Takes some seconds."""
    return [*_machine(), *_needed(), *_extras(), *_programs()]


def is_broken(findings: list[Finding]) -> bool:
    """Whether something is not there or does not work that every run needs."""
    return any(finding.needed and finding.state != "ok" for finding in findings)


def lines(findings: list[Finding]) -> list[str]:
    """One for each finding, with its state first."""
    width = max(len(finding.name) for finding in findings)
    marks = {"ok": "ok", "missing": "--", "broken": "BROKEN"}
    return [f"{marks[f.state]:6}  {f.name:{width}}  {f.text}" for f in findings]


def _machine() -> Iterator[Finding]:
    def told(name: str, text: str, state: State = "ok", *, needed: bool = False) -> Finding:
        return Finding(part="machine", name=name, state=state, text=text, needed=needed)

    yield told("usdbrdf", f"{code_version()}, in {Path(__file__).parent}")
    system = f"{platform.system()} {platform.machine()}"
    yield told("python", f"{platform.python_version()} on {system}")
    yield told("cores", f"{granted_cores()}; kernels run in {num_threads()} threads")
    memory = machine_bytes()
    few = memory < _LEAST_MEMORY
    advice = "; little: choose a larger --texel-size where it does not suffice" if few else ""
    yield told("memory", f"{memory / GIB:.1f} GiB{advice}")
    for name, folder in (("disk", Path.cwd()), ("temporary", Path(tempfile.gettempdir()))):
        free = shutil.disk_usage(folder).free
        little = "; little: assets take some 50 to 500 MB" if free < _LEAST_DISK else ""
        yield told(name, f"{free / GIB:.1f} GiB free in {folder}{little}")
    mark = mark_of_compiled(tasks_identity())
    if mark is None:
        yield told(
            "kernels", "no folder keeps them: each run compiles; set NUMBA_CACHE_DIR", "missing"
        )
    else:
        compiled = "compiled" if mark.exists() else "the first convert compiles them"
        yield told("kernels", f"{compiled}; kept in {mark.parent.parent}")


def _needed() -> Iterator[Finding]:
    for name, work in (
        ("libraries", _required_packages),
        ("addresses", refuse_few_addresses),
        ("images", _images_survive),
        ("rays", _rays_hit),
        ("locks", _locks_work),
        ("schemas", _schemas_known),
    ):
        yield _tried(name, work)


def _tried(name: str, work: Callable[[], str | None]) -> Finding:
    """What every run needs, used once."""
    state: State = "ok"
    try:
        text = work() or "works"
    except Exception as error:  # whatever a library that is broken may raise
        state, text = "broken", f"{error or type(error).__name__}"
    return Finding(part="needed", name=name, state=state, text=text, needed=True)


def _required_packages() -> str:
    absent = [name for name in _packages_of("") if _version(name) is None]
    if absent:
        raise EnvironmentFailure(f"{', '.join(absent)}: not installed. Install usdbrdf again.")
    if others := _of_other_versions(""):
        raise EnvironmentFailure(f"{_asked(others)}. Install usdbrdf again, or these alone.")
    known = ("numpy", "numba", "usd-core", "openimageio", "embreex")
    return ", ".join(f"{name} {_version(name)}" for name in known)


def _images_survive() -> str:
    with tempfile.TemporaryDirectory(prefix="usdbrdf-doctor-") as folder:
        picture = np.linspace(0, 4, 48, dtype=np.float32).reshape(4, 4, 3)
        write_exr(Path(folder) / "a.exr", picture, half=False)
        if not np.array_equal(read_exr(Path(folder) / "a.exr"), picture):
            raise EnvironmentFailure("an EXR does not read back as it was written")
    return "EXR written and read back"


def _rays_hit() -> str:
    from usdbrdf.transport.rays import RayScene  # which does not load without Embree

    points = np.array([[0, 0, 1], [2, 0, 1], [0, 2, 1]], np.float32)
    scene = RayScene(points, np.array([[0, 1, 2]], np.int32))
    origins = np.array([[0.5, 0.5, 0], [3, 3, 0]], np.float32)
    hits = scene.closest(origins, np.array([[0, 0, 1]] * 2, np.float32))
    if hits.face.tolist() != [0, -1]:
        raise EnvironmentFailure(f"Embree or a kernel is wrong: rays met {hits.face.tolist()}")
    return "Embree and compiled kernels trace"


def _locks_work() -> str:
    with tempfile.TemporaryDirectory(prefix="usdbrdf-doctor-") as folder, folder_lock(Path(folder)):
        return "files can be locked in the temporary folder"


def _schemas_known() -> str:
    verify()
    return f"USD knows them, from {plugin_path()}"


def _extras() -> Iterator[Finding]:
    for extra in sorted(_metadata_of_all().get_all("Provides-Extra") or ()):
        if extra in _FOR_DEVELOPERS:
            continue
        found = {name: _version(name) for name in _packages_of(extra)}
        absent = [name for name, version in found.items() if version is None]
        here = ", ".join(f"{name} {version}" for name, version in found.items() if version)
        others = [] if absent else _of_other_versions(extra)
        cure = f"pip install 'usdbrdf[{extra}]'"
        state: State = "missing" if absent else "broken" if others else "ok"
        text = f"{', '.join(absent)} not installed: {cure}" if absent else here
        text = f"{_asked(others)}: {cure}" if others else text
        yield Finding(part="extra", name=extra, state=state, text=text)


def _programs() -> Iterator[Finding]:
    def told(name: str, found: str | None, otherwise: str) -> Finding:
        return Finding(
            part="program",
            name=name,
            state="missing" if found is None else "ok",
            text=found or otherwise,
        )

    slow = "relight takes Mitsuba's slow way: apt install libllvm19"
    yield told("LLVM", _llvm(), slow if _version("mitsuba") else "not used without Mitsuba")
    gl = ctypes.util.find_library("EGL") or ctypes.util.find_library("GL")
    storm = gl if gl and find_spec("pxr.UsdImagingGL") else None
    yield told("Storm", storm, "no GL, or USD without imaging: usdview and usdrecord need both")
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    yield told("browser", browser, "no Chromium: the page opens in any browser, its tests need it")


def _llvm() -> str | None:
    with suppress(UsdBrdfError, OSError):
        from usdbrdf.relighting.render import VARIANTS, mitsuba_variant

        variant = mitsuba_variant().variant()
        return f"Mitsuba's variant {variant}" if variant == VARIANTS[0] else None
    return None


def _metadata_of_all() -> metadata.PackageMetadata:
    try:
        return metadata.metadata("usdbrdf")
    except metadata.PackageNotFoundError as error:
        raise EnvironmentFailure(
            "usdbrdf runs from its sources, but was never installed: what it requires is not "
            "known. Run: pip install -e . [environment.installation]"
        ) from error


def _packages_of(extra: str) -> list[str]:
    """Names of what an extra requires on this Python; of "" what every run does."""
    return [name for name, _ in _requirements_of(extra)]


def _of_other_versions(extra: str) -> list[tuple[str, str]]:
    """Names and versions asked for of those whose installed version is another."""
    return [
        (name, asked)
        for name, asked in _requirements_of(extra)
        if (version := _version(name)) is not None and not _is_within(version, asked)
    ]


def _asked(others: list[tuple[str, str]]) -> str:
    return ", ".join(f"{name} is {_version(name)}, not {asked}" for name, asked in others)


def _is_within(version: str, asked: str) -> bool:
    """Whether a version lies between the bounds, ">=1.2,<3": of those we ask for no others."""

    def number(text: str) -> list[int]:
        release = re.match(r"\d+(?:\.\d+)*", text)
        parts = [int(part) for part in release[0].split(".")] if release else [0]
        return parts + [0] * (8 - len(parts))

    bounds = re.findall(r"(>=|<)\s*([\w.]+)", asked)
    return all((number(version) >= number(bound)) == (sign == ">=") for sign, bound in bounds)


def _requirements_of(extra: str) -> list[tuple[str, str]]:
    """Names of the same, and the versions that are asked for."""
    found = []
    for line in _metadata_of_all().get_all("Requires-Dist") or ():
        name = re.match(r"([\w.-]+)(?:\[[^]]*\])?\s*\(?([^;)]*)", line)
        own = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        below = re.search(r"python_version < ['\"]3\.(\d+)['\"]", line)
        here = below is None or sys.version_info[1] < int(below[1])
        if name and here and (own[1] if own else "") == extra:
            found.append((name[1], name[2].strip()))
    return found


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
