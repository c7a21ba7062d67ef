"""Values as documents: what a unit of work is given, told to another process without pickles.

An object is its class and what its constructor's parameters are called on it, which holds for
dataclasses, named tuples and ``RayScene``; classes and functions are names of ours. Arrays that are
not small are files, named by the SHA-256 of their bytes.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from usdbrdf.cluster.store import Store
from usdbrdf.errors import UsdBrdfError

Document: TypeAlias = Any
# Bytes of an array that is told by its digits.
_SMALL = 1 << 10
_OURS = "usdbrdf."


def described(value: Any, store: Store) -> Document:
    """JSON of a value, whose arrays the store keeps."""

    def of(value: Any) -> Document:
        if value is None or type(value) in (bool, int, str):
            return value
        if type(value) is float:
            return value if math.isfinite(value) else {"float": str(value)}
        if isinstance(value, np.generic):
            return {"number": [value.dtype.str, value.tobytes().hex()]}
        if isinstance(value, np.ndarray):
            if value.dtype.hasobject:
                raise UsdBrdfError("an array of objects cannot be told to workers. [cluster.value]")
            if value.nbytes > _SMALL:
                return {"array": store.keep(value)}
            return {"digits": [value.dtype.str, [*value.shape], value.tobytes().hex()]}
        if isinstance(value, Path):
            return store.files.path_told(value)
        if isinstance(value, range):
            return {"range": [value.start, value.stop, value.step]}
        if isinstance(value, slice):
            return {"slice": [of(value.start), of(value.stop), of(value.step)]}
        if type(value) in (tuple, list):
            return {type(value).__name__: [of(item) for item in value]}
        if isinstance(value, dict | MappingProxyType):
            return {"dict": [[of(key), of(item)] for key, item in value.items()]}
        if inspect.isfunction(value) or inspect.isclass(value):
            return {"name": name_of(value)}
        made = name_of(type(value))
        parameters = _parameters(made)
        return {"made": made, "of": {name: of(getattr(value, name)) for name in parameters}}

    return of(value)


def restored(
    document: Document, store: Store, costly: Callable[[Document, Callable[[], Any]], Any]
) -> Any:
    """The value of a document; the store finds arrays by their names. ``costly`` is given the
    document of an object that is more than its parts, and what makes it, and may know it already.
    """

    def of(told: Document) -> Any:
        if not isinstance(told, dict):
            return told
        if "made" in told:
            kind = named(told["made"])

            def make() -> Any:
                return kind(**{name: of(part) for name, part in told["of"].items()})

            return make() if _is_plain(kind) else costly(told, make)
        ((form, parts),) = told.items()
        match form:
            case "float":
                return float(parts)
            case "number":
                return np.frombuffer(bytes.fromhex(parts[1]), parts[0])[0]
            case "array":
                return store.array(parts)
            case "digits":
                dtype, shape, digits = parts
                return np.frombuffer(bytearray.fromhex(digits), dtype).reshape(shape)
            case "path" | "file":
                return store.files.path_found(told)
            case "range":
                return range(*parts)
            case "slice":
                return slice(*map(of, parts))
            case "tuple":
                return tuple(of(item) for item in parts)
            case "list":
                return [of(item) for item in parts]
            case "dict":
                return {of(key): of(item) for key, item in parts}
            case "name":
                return named(parts)
        raise UsdBrdfError(f"{form!r} is no form of a value. [cluster.value]")

    return of(document)


def name_of(thing: Any) -> str:
    """MODULE:NAME of a function or class at the top of one of our modules."""
    module, name = thing.__module__, thing.__qualname__
    if not module.startswith(_OURS) or "." in name:
        raise UsdBrdfError(f"{module}:{name} is not for workers to know. [cluster.value]")
    return f"{module}:{name}"


def named(name: str) -> Any:
    """The inverse of ``name_of``."""
    module, _, within = name.partition(":")
    if not module.startswith(_OURS) or "." in within:
        raise UsdBrdfError(f"{name!r} is not for workers to know. [cluster.value]")
    return getattr(import_module(module), within)


def _is_plain(kind: type) -> bool:
    return dataclasses.is_dataclass(kind) or issubclass(kind, tuple)


@cache
def _parameters(made: str) -> tuple[str, ...]:
    return tuple(inspect.signature(named(made)).parameters)
