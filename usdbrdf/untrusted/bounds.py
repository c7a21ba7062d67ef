"""How a foreign file is read: the limits, the child, and the way back of what it found."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from importlib import import_module
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from usdbrdf.errors import InputRefused, MeshMissing, UsdBrdfError
from usdbrdf.files.atomic import raise_shortage
from usdbrdf.files.paths import why_not_fetched
from usdbrdf.job.child import run_child
from usdbrdf.job.memory import addresses_of_libraries, machine_bytes
from usdbrdf.model.arrays import Array, Double, Float

_GIB = 1 << 30
# Of a mesh's diagonal, between neighbouring single-precision coordinates: half a pixel where a
# picture of a thousand shows all of it.
_MAX_STEP = 5e-4


class Limits(NamedTuple):
    """What one file may take: its own bytes, seconds of wall time, bytes of addresses."""

    file_bytes: int
    seconds: float
    memory_bytes: int


# What is larger or takes longer was not captured: 50 million triangles are a PLY of 1 GB or an OBJ
# of 4 GB, which are read in minutes. Documents have theirs in ``files.documents``, the frames of a
# capture in ``files.images``.
LIMITS = {
    "mesh": Limits(8 * _GIB, 600.0, 64 * _GIB),
    "stage": Limits(4 * _GIB, 600.0, 64 * _GIB),  # all of its layers together
    "model": Limits(8 * _GIB, 600.0, 64 * _GIB),
    "picture": Limits(2 * _GIB, 120.0, 24 * _GIB),
    "video": Limits(256 * _GIB, 3600.0, 24 * _GIB),  # of which some frames are written down
}
PLUGIN_SECONDS = 300.0  # for the import of another package's module, which may be a large one
_CURES = {
    "mesh": "Name the mesh with --mesh, or put mesh.ply beside the poses.",
    "stage": "Check its name and permission.",
    "model": "Copy the whole model, cameras and images.",
    "picture": "Check its name and permission.",
    "video": "Check its name and permission.",
}
T = TypeVar("T")


def read_in_child(
    kind: str,
    reader: str,
    path: Path,
    returns: type[T],
    *,
    parts: Sequence[type] = (),
    parameters: Mapping[str, Any] | None = None,
) -> T:
    """What ``reader`` ("package.module:name") makes of a foreign file, as f(path, **parameters) in
    a child process; InputRefused where the file is larger than the kind's limit.

    kind     of LIMITS; also begins the names of the rules
    returns  the type of the result: a dataclass, array or tuple
    parts    dataclasses that may be inside
    """
    refuse_large(kind, path)
    _, seconds, memory_bytes = LIMITS[kind]
    found = run_child(
        f"{__name__}:read_here",
        {},
        {"reader": reader, "path": str(path.resolve()), "more": dict(parameters or {})},
        seconds,
        f"{path}: reading this {kind}",
        # What can be limited is addresses, of which libraries take more than they fill.
        memory_limit_bytes=min(memory_bytes, machine_bytes() + addresses_of_libraries()),
    )
    value = unpacked(found, (returns, *parts))
    assert isinstance(value, returns)
    return value


def read_here(arrays: Mapping[str, Array], parameters: Mapping[str, Any]) -> dict[str, Array]:
    """The child's part of ``read_in_child``."""
    module, _, name = parameters["reader"].partition(":")
    reader = getattr(import_module(module), name)
    return packed(reader(Path(parameters["path"]), **parameters["more"]))


def problem_of_plugin(point: EntryPoint) -> str:
    """Why a module of another package cannot be imported, "" if it can. A child tries it first: it
    may hang or crash, and then this process goes on without it."""
    announced = {"name": point.name, "value": point.value, "group": point.group}
    try:
        run_child(f"{__name__}:import_here", {}, announced, PLUGIN_SECONDS, "its import")
    except UsdBrdfError as error:
        return str(error).rpartition(". [")[0]
    return ""


def import_here(arrays: Mapping[str, Array], announced: Mapping[str, str]) -> dict[str, Array]:
    """The child's part of ``problem_of_plugin``."""
    try:
        EntryPoint(**announced).load()
    except (Exception, SystemExit) as error:
        raise_shortage(error)
        raise InputRefused(f"{type(error).__name__}: {error}. [adapter.load]") from error
    return {}


def refuse_far(path: Path, points: Float | Double) -> None:
    """InputRefused where points (N, 3) of a mesh lie so far from the origin, as georeferenced ones
    do, that single precision, which USD's points have and rays are traced in, moves them."""
    far = float(np.abs(points).max())
    across = float(np.linalg.norm(np.ptp(points.astype(np.float64), axis=0)))
    step = float(np.spacing(np.float32(far)))
    if step > _MAX_STEP * across > 0:
        raise InputRefused(
            f"{path}: coordinates reach {far:.9g} in a mesh that is {across:.3g} across, so that "
            f"single precision moves its points by up to {step / 2:.2g}. Export mesh and cameras "
            "with one offset that brings both to the origin. [mesh.far]"
        )


def refuse_large(kind: str, path: Path) -> None:
    """InputRefused unless this is a regular file within the kind's limit, and the file itself."""
    if not os.path.isfile(path) or not os.access(path, os.R_OK):
        what = "cannot be read" if os.path.isfile(path) else "is not a regular file"
        what = what if os.path.exists(path) else "does not exist"
        refused = MeshMissing if kind == "mesh" else InputRefused
        raise refused(f"{path}: this {kind} {what}. {_CURES[kind]} [{kind}.missing]")
    size, limit = path.stat().st_size, LIMITS[kind].file_bytes
    if size > limit:
        raise InputRefused(
            f"{path}: {size} bytes, the limit of a {kind} is {limit}. Reduce it. [{kind}.size]"
        )
    if (why := why_not_fetched(path)) is not None:
        raise InputRefused(f"{path}: {why}. [{kind}.pointer]")


def packed(value: object) -> dict[str, Array]:
    """A value of dataclasses, tuples, plain values and arrays as named arrays."""
    arrays: dict[str, Array] = {}
    names: dict[int, str] = {}  # an array that many share travels once

    def plain(node: Any) -> Any:
        if isinstance(node, np.ndarray):
            name = names.setdefault(id(node), str(len(names)))
            arrays[name] = node
            return {"array": name}
        if isinstance(node, Path):
            return str(node)
        members = {field.name: getattr(node, field.name) for field in fields(node)}
        return {"class": type(node).__name__, "members": members}

    text = json.dumps(value, default=plain).encode()
    return {**arrays, "tree": np.frombuffer(text, np.uint8)}


def unpacked(arrays: Mapping[str, Array], classes: Iterable[type]) -> Any:
    """The value that was ``packed``; lists come back as tuples. No other class than the given is
    ever called."""
    known = {each.__name__: each for each in classes}

    def value(node: Any) -> Any:
        if isinstance(node, list):
            return tuple(map(value, node))
        if not isinstance(node, dict):
            return node
        if "array" in node:
            return arrays[node["array"]]
        members = {name: value(member) for name, member in node["members"].items()}
        return known[node["class"]](**members)

    return value(json.loads(arrays["tree"].tobytes()))
