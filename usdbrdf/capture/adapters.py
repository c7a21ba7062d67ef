"""Adapters: modules that turn a capture in some format into a Scan.

An adapter has ``NAME``, ``DESCRIPTION``, ``matches(path) -> bool`` and
``read(path, options) -> Scan``. Packages announce theirs as entry points of the group
``usdbrdf.adapters``; ours are announced in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import Distribution, EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from usdbrdf.capture.formats import DESCRIPTIONS, MODULES
from usdbrdf.errors import InputRefused, UsageError, UsdBrdfError
from usdbrdf.files.paths import refuse_nameless
from usdbrdf.job.progress import say

if TYPE_CHECKING:
    from usdbrdf.model.capture import Scan
    from usdbrdf.options import IngestOptions

GROUP = "usdbrdf.adapters"


class AdapterModule(Protocol):
    """What a module must offer to be an adapter."""

    NAME: str
    DESCRIPTION: str

    def matches(self, path: Path) -> bool:
        """Whether this looks like a capture of the format; a glance, nothing is parsed."""
        ...

    def read(self, path: Path, options: IngestOptions) -> Scan:
        """The capture, checked; raises the errors of ``usdbrdf.errors`` and no others."""
        ...


@dataclass(frozen=True, kw_only=True)
class Adapter:
    """An announced adapter; ``module`` is None and ``problem`` says why if it is broken.

    package  distribution and version that announce it; "" for ours
    """

    name: str
    description: str
    origin: str
    module: AdapterModule | None
    problem: str = ""
    package: str = ""


class _LoadedWhenUsed:
    """A module whose members are there as soon as one of them is asked for."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, member: str) -> Any:
        return getattr(import_module(self._name), member)


def list_adapters(*, plugins: bool = True) -> tuple[Adapter, ...]:
    """Our adapters, then those of other packages by name (none of these if not ``plugins``).

    Broken ones are part of the list; they are reported once and never used.
    """
    found = [
        Adapter(
            name=name,
            description=DESCRIPTIONS[name],
            origin=origin,
            module=cast(AdapterModule, _LoadedWhenUsed(origin)),
        )
        for name, origin in MODULES.items()
    ]
    if plugins:
        # Installed, we are among the announced ourselves; our names cannot be taken over.
        foreign = {p for p in entry_points(group=GROUP) if p.name not in MODULES}
        found += [_loaded(p) for p in sorted(foreign, key=lambda p: (p.name, p.value))]
    return tuple(found)


def read_scan(
    path: Path, options: IngestOptions, adapter: str | None = None, *, plugins: bool = True
) -> Scan:
    """Read a capture with the named adapter, or with the first that recognises it."""
    return read_with(choose_adapter(path, adapter, plugins=plugins), path, options)


def choose_adapter(path: Path, name: str | None = None, *, plugins: bool = True) -> Adapter:
    """The named adapter, or the first that recognises the capture."""
    adapters = list_adapters(plugins=plugins)
    if name is not None:
        return _named(name, adapters)
    if not path.exists():
        raise InputRefused(f"{path}: no such file or folder. Check the path. [capture.missing]")
    return _recognising(path, adapters)


def _loaded(point: EntryPoint) -> Adapter:
    module, problem = _imported(point)
    if problem:
        say(
            f"warning: adapter {point.name!r} ({point.value}) is skipped: {problem}. [adapter.load]"
        )
        return Adapter(
            name=point.name, description="", origin=point.value, module=None, problem=problem
        )
    return Adapter(
        name=point.name,
        description=module.DESCRIPTION,
        origin=point.value,
        module=cast(AdapterModule, module),
        package="" if point.dist is None else _name_of(point.dist),
    )


def _imported(point: EntryPoint) -> tuple[Any, str]:
    """Another package's module and "", or None and why it cannot be used."""
    # The list of adapters, where there are no others, is not to wait for numpy.
    from usdbrdf.untrusted.bounds import problem_of_plugin

    if problem := problem_of_plugin(point):
        return None, problem
    try:
        module = point.load()
    # What went well in a child may still raise here, SystemExit included.
    except (Exception, SystemExit) as error:
        return None, f"{type(error).__name__}: {error}"
    missing = [
        name
        for name, kind in (("NAME", str), ("DESCRIPTION", str))
        if not isinstance(getattr(module, name, None), kind)
    ] + [name for name in ("matches", "read") if not callable(getattr(module, name, None))]
    return module, f"it has no {', '.join(missing)}" if missing else ""


def _name_of(package: Distribution) -> str:
    return f"{package.metadata['Name']} {package.version}"


def _named(name: str, adapters: tuple[Adapter, ...]) -> Adapter:
    for adapter in adapters:
        if adapter.name == name:
            if adapter.module is None:
                raise UsageError(f"adapter {name!r} is broken: {adapter.problem}. [adapter.load]")
            return adapter
    known = ", ".join(a.name for a in adapters if a.module is not None)
    raise UsageError(f"adapter {name!r} is not installed. Use one of {known}. [adapter.unknown]")


def _recognising(path: Path, adapters: tuple[Adapter, ...]) -> Adapter:
    for adapter in adapters:
        if adapter.module is None:
            continue
        try:
            if adapter.module.matches(path):
                return adapter
        except Exception as error:
            if adapter.name in MODULES:
                raise
            say(f"warning: adapter {adapter.name!r} is skipped: {error!r}. [adapter.matches]")
    known = "; ".join(f"{a.name}: {a.description}" for a in adapters if a.module is not None)
    raise InputRefused(
        f"{path}: not a capture that any adapter recognises ({known}). Name the folder that holds "
        "the capture, or choose with --adapter. [adapter.none]"
    )


def read_with(adapter: Adapter, path: Path, options: IngestOptions) -> Scan:
    """What a chosen adapter makes of a capture."""
    assert adapter.module is not None
    for named in (path, options.mesh, options.objects):
        refuse_nameless(named)
    try:
        return adapter.module.read(path, options)
    except UsdBrdfError:
        raise
    except Exception as error:
        if adapter.name in MODULES:
            raise
        raise InputRefused(
            f"{path}: adapter {adapter.name!r} ({adapter.origin}) failed: {error!r}. Report it to "
            "its authors. [adapter.read]"
        ) from error
