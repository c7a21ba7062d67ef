"""The usual commands: `nox` for a quick check, `nox -l` for all; `nox --no-venv` uses what is here.

nox -s room -- shading      the tests of one room
nox -s figures -- OUT       accuracy on the sample, as docs/accuracy.md tells it
"""

import json
import sys
from pathlib import Path

import nox

nox.options.default_venv_backend = "venv"
nox.options.reuse_existing_virtualenvs = True
nox.options.sessions = ["style", "house", "quick"]

SAMPLE = "samples/study"


def install(session: nox.Session, extras: str) -> None:
    if not isinstance(session.virtualenv, nox.virtualenv.PassthroughEnv):
        session.install("-q", "-c", "constraints.txt", "-e", f".[{extras}]")


@nox.session
def style(session: nox.Session) -> None:
    """Lint, format and types; nothing is changed."""
    install(session, "test")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("mypy")


@nox.session
def house(session: nox.Session) -> None:
    """The rules of the house alone, in seconds."""
    install(session, "test")
    session.run("python", "-m", "pytest", "-q", "tests/test_house.py")


@nox.session
def quick(session: nox.Session) -> None:
    """All tests that are not slow: on two cores in two minutes."""
    install(session, "test")
    session.run("python", "-m", "pytest", "-q", "-m", "not slow", *session.posargs)


@nox.session
def room(session: nox.Session) -> None:
    """The tests of the rooms that are named, slow ones too."""
    if not session.posargs:
        session.error("name a room: nox -s room -- shading")
    install(session, "test")
    rooms = [name if "/" in name else f"tests/{name}" for name in session.posargs]
    session.run("python", "-m", "pytest", "-q", *rooms)


@nox.session
def everything(session: nox.Session) -> None:
    """All tests, as they run before a change is accepted."""
    install(session, "test,brackets,colmap,e57,dcc,denoise,render,farm")
    session.run("python", "-m", "pytest", *session.posargs)


@nox.session
def figures(session: nox.Session) -> None:
    """Convert the sample and hold it against its truth."""
    install(session, "test,denoise")
    asset = session.posargs[0] if session.posargs else "out/study"
    session.run("python", "-m", "usdbrdf", "convert", SAMPLE, "-o", asset)
    truth = (f"{SAMPLE}/truth", f"{SAMPLE}/mesh.ply")
    session.run("python", "benchmarks/accuracy.py", asset, *truth)


@nox.session
def speed(session: nox.Session) -> None:
    """The speed benchmarks, each against a reference of the same run."""
    install(session, "test,denoise,render")
    session.run("python", "benchmarks/run_all.py", "--quick", *session.posargs)


@nox.session(venv_backend="none")
def hashes(session: nox.Session) -> None:
    """Make constraints-hashed.txt anew from constraints.txt, for the Python at hand."""
    report = Path(session.create_tmp()) / "report.json"
    told = ("install", "-q", "--dry-run", "--ignore-installed", "--no-deps", "--report", report)
    session.run(sys.executable, "-m", "pip", *map(str, told), "-r", "constraints.txt")
    hashed = Path("constraints-hashed.txt")
    head = hashed.read_text("utf-8").splitlines()[:2]
    rows = [
        f"{item['metadata']['name'].lower().replace('_', '-')}=={item['metadata']['version']} "
        f"--hash=sha256:{item['download_info']['archive_info']['hashes']['sha256']}"
        for item in json.loads(report.read_text("utf-8"))["install"]
    ]
    hashed.write_text("\n".join([*head, *sorted(rows)]) + "\n", "utf-8")


@nox.session(venv_backend="none")
def supply(session: nox.Session) -> None:
    """SBOM and known vulnerabilities of this environment, into dist/; skipped where offline."""
    session.run("bash", ".ci/supply", *session.posargs, env={"USDBRDF_PYTHON": sys.executable})


@nox.session
def docs(session: nox.Session) -> None:
    """The documentation as a site, in out/site."""
    install(session, "docs")
    session.run("mkdocs", "build", "--strict", "-d", "out/site")


@nox.session
def wheel(session: nox.Session) -> None:
    """Build the wheel into dist/."""
    session.run("python", "-m", "pip", "wheel", "-q", "--no-deps", "-w", "dist", ".")
