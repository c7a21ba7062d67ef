"""The usual commands: `nox` for a quick check, `nox -l` for all; `nox --no-venv` uses what is here.

nox -s room -- shading      the tests of one room
nox -s figures -- OUT       accuracy on the sample, as docs/accuracy.md tells it
"""

import sys

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
    readers = "test,colmap,e57,denoise"
    install(session, f"{readers},dcc,render" if sys.version_info < (3, 13) else readers)
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


@nox.session
def wheel(session: nox.Session) -> None:
    """Build the wheel into dist/."""
    session.run("python", "-m", "pip", "wheel", "-q", "--no-deps", "-w", "dist", ".")
