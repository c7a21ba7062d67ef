"""Asset folder in, a new version beside the earlier ones out: complete in itself, with a manifest,
never changed again. The work folder keeps ``edits.usda``; a version has what it said then."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import string
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from pxr import Sdf

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.manifest import Manifest, changes, read_manifest, write_manifest
from usdbrdf.delivery.copy_of_asset import SPACES, write_copy
from usdbrdf.delivery.packaged_files import ADDRESS
from usdbrdf.errors import InputRefused, OwnershipConflict, UsageError
from usdbrdf.files.atomic import environment_failures, publish_folder, sha256_of, temporary_folder
from usdbrdf.job.ownership import folder_lock
from usdbrdf.job.stamp import STATE_FOLDER
from usdbrdf.options import PublishOptions

_LOCKED = ".usdbrdf-publish"  # holds the lock of a folder of versions
_STAGED = "staged"  # in there, what is not whole yet
_VERSION = re.compile(r"v(\d{3,9})")
_ENCODINGS = {"text": "usda", "binary": "usdc"}


def publish(
    folder: Path,
    destination: Path,
    options: PublishOptions | None = None,
    *,
    wait_s: float = 0.0,
    without_lock: bool = False,
) -> dict[str, Any]:
    """Write the asset in ``folder`` as the next version in ``destination``, a folder vNNN in it,
    whole or not at all; what was published before is not touched.

    Where the latest version holds the same already, nothing is written. Equal assets give equal
    bytes. Returns a summary of plain values.

    wait_s, without_lock   as of ``pipeline.working_on``; of the asset and of ``destination``

    Raises UsageError for options that cannot be, InputRefused where the asset names files that are
    missing or lie elsewhere, OwnershipConflict for a version that is there with another content.
    """
    options = options or PublishOptions()
    asset = Asset.made(folder)
    asset.refuse_output(destination, "publish.destination")
    if destination.exists() and not destination.is_dir():
        raise OwnershipConflict(
            f"{destination}: this is a file, and versions are published into a folder. Choose "
            "another place. [publish.destination]"
        )
    if any((asset.folder / STATE_FOLDER).glob("publishing-*.json")):
        raise InputRefused(
            f"{asset.folder}: a run was stopped while it put its files in place. Run `usdbrdf "
            "convert` again, which ends it, and publish then. [publish.unfinished]"
        )
    state, lock = asset.folder / STATE_FOLDER, destination / _LOCKED
    # Where nobody can write, nobody works.
    state = state if os.access(state, os.W_OK) else lock
    locked = partial(folder_lock, wait_s=wait_s, without_lock=without_lock)
    with environment_failures(str(destination)), _made(destination):
        lock.mkdir(exist_ok=True)
        with locked(lock), locked(state):
            return _published(asset, destination, options)


@contextmanager
def _made(destination: Path) -> Iterator[None]:
    """The folder, made; gone again where nothing was published into it."""
    new = [f for f in (destination, *destination.parents) if not f.exists()]
    destination.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        if new and {entry.name for entry in destination.iterdir()} <= {_LOCKED}:
            shutil.rmtree(destination / _LOCKED, ignore_errors=True)
            for place in new:
                place.rmdir()
        raise


def _published(asset: Asset, destination: Path, options: PublishOptions) -> dict[str, Any]:
    # What a killed run left half lies where nobody else makes anything.
    shutil.rmtree(destination / _LOCKED / _STAGED, ignore_errors=True)
    earlier = versions_in(destination)
    latest = earlier[-1] if earlier else ""
    version = _version(options.version, latest, earlier)
    final = destination / version
    like = destination / (version if version in earlier else latest)
    with temporary_folder(destination / _LOCKED / _STAGED / version) as staged:
        manifest = _write(asset, staged, version, options)
        if earlier and manifest.content == _content_of(like):
            return _summary(like, read_manifest(like), new=False)
        if version in earlier:
            raise OwnershipConflict(
                f"{final}: this version is there and holds something else. Versions never change: "
                "leave --version out, or name a later one. [publish.version]"
            )
        for file in (each for each in staged.rglob("*") if each.is_file()):
            file.chmod(0o444)
        publish_folder(staged, final)
    return _summary(final, manifest, new=True)


def versions_in(destination: Path) -> list[str]:
    """Names of the versions in a folder, the latest last."""
    names = [entry.name for entry in destination.iterdir() if _VERSION.fullmatch(entry.name)]
    return sorted(names, key=lambda name: int(name[1:]))


def _version(asked: str | None, latest: str, earlier: list[str]) -> str:
    number = int(latest[1:]) if latest else 0
    if asked is None:
        return f"v{number + 1:03d}"
    if not _VERSION.fullmatch(asked):
        raise UsageError(
            f"--version {asked}: versions are v and a number of three digits or more, such as "
            "v001. [publish.version]"
        )
    if asked not in earlier and int(asked[1:]) <= number:
        raise UsageError(
            f"--version {asked}: {latest} is there already, and later versions have higher "
            "numbers. [publish.version]"
        )
    return asked


def _content_of(version: Path) -> str:
    """The content of a version that is still what was published; "" of any other."""
    with suppress(InputRefused):
        if next(changes(version), None) is None:
            return read_manifest(version).content
    return ""


def _write(asset: Asset, folder: Path, version: str, options: PublishOptions) -> Manifest:
    root, space = f"{asset.name}.usd", SPACES[options.texture_space]
    identifier = _identifier(options.uri, asset.name, version) or f"./{root}"
    said = hashlib.sha256(f"{options.encoding}\0{options.uri}\0{space}\0".encode())

    def describe(layer: Sdf.Layer) -> None:
        said.update(layer.ExportToString().encode())
        _describe(layer, asset.name, version, identifier)

    found = write_copy(
        asset,
        folder,
        root=root,
        encoding=_ENCODINGS[options.encoding],
        space=space,
        photographs=options.photographs,
        proxies=options.proxies,
        describe=describe,
    )
    files = {
        file.relative_to(folder).as_posix(): sha256_of(file)
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }
    for path, sha256 in files.items():
        if path != root:
            said.update(f"{path}\0{sha256}\n".encode())
    manifest = Manifest(
        name=asset.name,
        version=version,
        identifier=identifier,
        texture_space=space,
        photographs=bool(found.photographs),
        content=said.hexdigest(),
        files=files,
    )
    write_manifest(folder, manifest)
    return manifest


def _identifier(template: str | None, name: str, version: str) -> str:
    if template is None:
        return ""
    problem = ""
    try:
        fields = {
            field for _, field, _, _ in string.Formatter().parse(template) if field is not None
        }
        if not ADDRESS.match(template):
            problem = "is no URI"
        elif fields - {"name", "version"}:
            problem = "has fields other than {name} and {version}"
        else:
            return template.format(name=name, version=version)
    except (ValueError, KeyError, IndexError, AttributeError) as error:
        problem = f"cannot be filled in ({error})"
    raise UsageError(
        f"--uri {template}: {problem}. Write it like "
        "'ayon+entity://show/assets?product={name}&version={version}'. [publish.uri]"
    )


def _describe(layer: Sdf.Layer, name: str, version: str, identifier: str) -> None:
    """What the root layer of a version says of it."""
    layer.documentation = (
        "A published version, which never changes. Reference it, or put opinions into a layer of "
        "your own above it."
    )
    root = Sdf.CreatePrimInLayer(layer, f"/{layer.defaultPrim}")
    known = dict(root.GetInfo("assetInfo")) if root.HasInfo("assetInfo") else {}
    told = {"identifier": Sdf.AssetPath(identifier), "name": name, "version": version}
    root.SetInfo("assetInfo", {**known, **told})


def _summary(version: Path, manifest: Manifest, *, new: bool) -> dict[str, Any]:
    size = sum((version / path).stat().st_size for path in manifest.files)
    return {
        "publish": str(version),
        "version": manifest.version,
        "identifier": manifest.identifier,
        "texture_space": manifest.texture_space,
        "files": len(manifest.files),
        "bytes": size,
        "new": new,
    }
