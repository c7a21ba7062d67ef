"""Where the asset paths of USD files that somebody else made lead: checked before anything is
composed, and once more in what was.

USD follows absolute paths, ``../`` and links without a question, wherever they lead; what is named
without a leading ``./`` it looks for in other folders too.
"""

from __future__ import annotations

import os
import posixpath
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pxr import Ar, Sdf, Tf, Usd, UsdUtils

from usdbrdf.errors import InputRefused
from usdbrdf.untrusted.bounds import LIMITS

USD_SUFFIXES = frozenset({".usd", ".usda", ".usdc", ".usdz"})
_MAX_LAYERS = 1000


def check_asset_paths(path: Path, allowed: Sequence[str]) -> list[Path]:
    """The files of the layers that ``path`` reaches, itself first; InputRefused unless every path
    in them stays in one of the ``allowed`` folders, which are absolute and without links.

    Layers, references, payloads, of every variant, and asset-valued attributes count, in packages
    too; links are judged by where they lead. Entries of a package that nothing reaches do not, nor
    do attributes in it that name what is not there: a picture that is missing. What a crafted
    crate file does to USD's own reader is not caught here: call this in a child process.
    """
    waiting, seen, files, total = [str(path.resolve())], list[str](), list[Path](), 0
    variables = ""
    searched_from = Ar.GetResolver().CreateDefaultContextForAsset(waiting[0])
    while waiting:
        layer = waiting.pop()
        if layer in seen:
            continue
        seen.append(layer)
        file = Path(Ar.SplitPackageRelativePathOuter(layer)[0])
        if file not in files:
            files.append(file)
            total += file.stat().st_size
        if len(seen) > _MAX_LAYERS or total > LIMITS["stage"].file_bytes:
            raise InputRefused(
                f"{path}: more than {_MAX_LAYERS} layers or {LIMITS['stage'].file_bytes} bytes of "
                "layers. Flatten the stage, or name the part that was captured. [stage.input_size]"
            )
        if entries := _entries(layer):
            waiting.append(Ar.JoinPackageRelativePath(layer, entries[0]))
            continue
        with usd_errors(Path(layer)), Ar.ResolverContextBinder(searched_from):
            opened = Sdf.Layer.FindOrOpen(layer)
            found = UsdUtils.ExtractExternalReferences(layer)
            arcs = set(opened.GetCompositionAssetDependencies()) if opened else set()
            variables = layer if opened and opened.HasExpressionVariables() else variables
            for reference in sorted({r for kind in found for r in kind if r}):
                target = _target(layer, reference, allowed, opens=reference in arcs)
                if target:
                    waiting.append(target)
    for layer in seen if variables else ():
        if expression := _expression_in(layer):
            # Which value counts depends on the layer that composes this one.
            raise InputRefused(
                f"{layer}: the asset path {expression[:200]!r} may hold variables "
                f"(expressionVariables of {variables}), so that nobody can say where it leads. "
                "Flatten the stage. [paths.variables]"
            )
    return files


def refuse_unchecked(stage: Usd.Stage, files: Sequence[Path]) -> None:
    """InputRefused where a stage is composed of another file than those that were checked."""
    for layer in stage.GetUsedLayers(includeClipLayers=False):
        file = Ar.SplitPackageRelativePathOuter(layer.realPath)[0]
        if file and Path(os.path.realpath(file)) not in files:
            raise _outside(stage.GetRootLayer().realPath, layer.identifier, "was found elsewhere")


def _entries(layer: str) -> tuple[str, ...]:
    """What lies in a USDZ, which may itself lie in one, its root layer first; nothing in others."""
    name = Ar.SplitPackageRelativePathInner(layer)[1] or layer
    if not name.lower().endswith(".usdz"):
        return ()
    with usd_errors(Path(layer)):
        package = Sdf.ZipFile.Open(layer)
    names = tuple(package.GetFileNames()) if package else ()
    for name in names:
        if name.startswith(("/", "\\")) or ".." in Path(name).parts:
            raise _outside(layer, name, "is an entry that leaves the package")
    return names


def _expression_in(layer: str) -> str:
    """An asset path of a layer that is an expression, as it is written; "" where none is."""
    found: list[str] = []

    def look(path: str) -> str:
        if Sdf.VariableExpression.IsExpression(path):
            found.append(path)
        return path

    copy = Sdf.Layer.CreateAnonymous()
    opened = Sdf.Layer.FindOrOpen(layer)
    if opened:
        copy.TransferContent(opened)
    UsdUtils.ModifyAssetPaths(copy, look)
    return found[0] if found else ""


def _target(layer: str, reference: str, allowed: Sequence[str], *, opens: bool) -> str:
    """The layer that a reference leads to, "" where it leads to none; InputRefused where it may
    lead out.

    opens  whether it is an arc, which USD opens itself
    """
    name, inner = Ar.SplitPackageRelativePathOuter(reference.partition(":SDF_FORMAT_ARGS:")[0])
    package, entry = Ar.SplitPackageRelativePathInner(layer)
    uri, absolute = "://" in name or name.startswith(("\\\\", "//")), os.path.isabs(name)
    if (uri or absolute) and entry and not opens and not os.path.lexists(name):
        return ""
    if uri or absolute:
        raise _outside(layer, reference, "is a URI" if uri else "is an absolute path")
    searched = not name.startswith(("./", "../"))
    if searched and ".." in Path(name).parts:
        raise _outside(layer, reference, "is searched for in several folders, and leads out of one")
    if entry:
        target = _in_package(layer, reference, package, entry, name)
        if target or not searched:
            return _with_entry(target, inner)
    else:
        target = os.path.realpath(Path(layer).parent / name)
    if searched and not os.path.exists(target):
        target = os.path.realpath(str(Ar.GetResolver().Resolve(name)) or target or allowed[0])
    if not any(Path(target).is_relative_to(folder) for folder in allowed):
        raise _outside(layer, reference, "leads outside the capture")
    if os.path.exists(target) and not (os.path.isfile(target) or os.path.isdir(target)):
        raise InputRefused(
            f"{target}: not a regular file, and {layer} names it. Put the file there, or take the "
            "path out of the stage. [stage.file]"
        )
    return _with_entry(target, inner) if os.path.isfile(target) else ""


def _in_package(layer: str, reference: str, package: str, entry: str, name: str) -> str:
    """What a layer in a package calls ``name``, beside it or beside the root layer; "" where that
    is not in there."""
    entries = _entries(package)
    for beside in (entry, entries[0]):
        inside = posixpath.normpath(posixpath.join(posixpath.dirname(beside), name))
        if inside in entries:
            return str(Ar.JoinPackageRelativePath(package, inside))
    if inside.startswith("../"):
        raise _outside(layer, reference, "leads out of the package")
    return ""


def _with_entry(target: str, inner: str) -> str:
    """The layer in a package, or the target itself; "" where that is no layer."""
    target = str(Ar.JoinPackageRelativePath(target, inner)) if target and inner else target
    return target if Path(target.rstrip("]")).suffix.lower() in USD_SUFFIXES else ""


def _outside(layer: Path | str, reference: str, reason: str) -> InputRefused:
    return InputRefused(
        f"{layer}: the asset path {reference[:200]!r} {reason}. Keep what belongs to the stage "
        "beside it and name it by relative paths. [paths.outside]"
    )


@contextmanager
def usd_errors(path: Path) -> Iterator[None]:
    """USD's own errors become InputRefused, and text of the file that Python cannot hold."""
    try:
        yield
    except UnicodeDecodeError as error:
        shown = repr(error.object[max(error.start - 20, 0) : error.start + 20])
        raise InputRefused(
            f"{path}: a name or a path in it is not UTF-8 ({shown}), so no program can be told of "
            "it. Rename it, or export the file again. [stage.input]"
        ) from error
    except Tf.ErrorException as error:
        raise InputRefused(
            f"{path}: USD cannot read it ({one_line(error)}). Export it again. [stage.input]"
        ) from error


def one_line(error: object) -> str:
    """Of an exception what its errors say, without the places in USD's own source."""
    told = error.args if isinstance(error, Tf.ErrorException) else [error]
    return "; ".join(" ".join(words_of(part).split()) for part in told)[:300]


def words_of(error: object) -> str:
    """What an error of USD says, which may quote bytes of a file that are no text."""
    try:
        return str(getattr(error, "commentary", error))
    except UnicodeDecodeError as undecoded:
        return undecoded.object.decode("utf-8", "replace")
