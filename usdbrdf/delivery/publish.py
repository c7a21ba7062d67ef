"""Asset folder in, a new version beside the earlier ones out: complete in itself, with a manifest,
never changed again. The work folder keeps ``edits.usda``; a version has what it said then."""

from __future__ import annotations

import hashlib
import shutil
import string
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from pxr import Sdf

from usdbrdf.asset.layers.author import export
from usdbrdf.asset.layers.interface import UNPUBLISHED
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.manifest import Manifest, changes, read_manifest, write_manifest
from usdbrdf.asset.readers.compose import not_run, open_edited, outdated_steps, steps_to_come
from usdbrdf.delivery.copy_of_asset import SPACES, write_copy
from usdbrdf.delivery.packaged_files import ADDRESS
from usdbrdf.errors import InputRefused, NoLocks, OwnershipConflict, UsageError
from usdbrdf.files.atomic import (
    environment_failures,
    make_folders,
    publish_folder,
    sha256_of,
    temporary_folder,
)
from usdbrdf.job.ownership import edited_files, folder_lock, reading
from usdbrdf.job.versions import VERSION, versions_in
from usdbrdf.options import PublishOptions

_LOCKED = ".usdbrdf-publish"  # holds the lock of a folder of versions
_STAGED = "staged"  # in there, what is not whole yet
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

    Where the latest version holds the same already, nothing is written, unless ``options`` name a
    version, which is there then. Equal assets give equal bytes. Returns a summary of plain values.

    wait_s, without_lock   as of ``pipeline.working_on``: the first of the asset and of
                           ``destination``, the second of ``destination``

    Raises UsageError for options that cannot be; InputRefused where the asset names files that are
    missing or lie elsewhere, or where its steps are not of one run; OwnershipConflict for a version
    that is there with another content, and where files of the asset were changed by hand.
    """
    options = options or PublishOptions()
    asset = Asset.made(folder)
    _refuse_names(options, asset.name)
    asset.refuse_output(destination, "publish.destination")
    if destination.exists() and not destination.is_dir():
        raise OwnershipConflict(
            f"{destination}: this is a file, and versions are published into a folder. Choose "
            "another place. [publish.destination]"
        )
    with reading(asset.folder, wait_s=wait_s):
        _refuse_unsound(asset, options)
        with (
            environment_failures(str(destination)),
            _locked(destination, wait_s, without_lock=without_lock),
        ):
            return _published(asset, destination, options)


def _refuse_names(options: PublishOptions, name: str) -> None:
    """UsageError for what can be no version's name or address, whatever the asset holds."""
    version = options.version or "v001"
    if not VERSION.fullmatch(version):
        raise UsageError(
            f"--version {version}: versions are v and a number of three digits or more, such as "
            "v001. [publish.version]"
        )
    _identifier(options.uri, name, version)


def _refuse_unsound(asset: Asset, options: PublishOptions) -> None:
    """OwnershipConflict for files that somebody changed by hand; InputRefused for steps that were
    run after those that build on them, and for those that were not run, unless asked for."""
    if edited := edited_files(asset.folder):
        raise OwnershipConflict(
            f"{asset.folder}: {', '.join(edited)} changed since usdbrdf wrote them. Run `usdbrdf "
            "convert` with --adopt to keep the changes beside edits.usda, or --discard to drop "
            "them, and publish then. [ownership.edited]"
        )
    if old := outdated_steps(asset):
        raise InputRefused(
            f"{asset.folder}: {'; '.join(old)}. Run `usdbrdf convert` again, which brings all "
            "steps up to date, and publish then. [publish.outdated]"
        )
    if (missing := steps_to_come(asset)) and not options.unfinished:
        raise InputRefused(
            f"{asset.folder}: {not_run(missing)}, so what others take in would lack its measured "
            "materials for good. Run `usdbrdf convert`, which goes on from there, or publish it as "
            "it is with --unfinished. [publish.unfinished]"
        )


@contextmanager
def _locked(destination: Path, wait_s: float, *, without_lock: bool) -> Iterator[None]:
    """The folder, made, and nobody else publishing into it; gone again where nothing was published
    into it, while it is still held: who waits for it makes it anew."""
    lock, new = destination / _LOCKED, list[Path]()
    with ExitStack() as held:
        while True:
            new = [f for f in (destination, *destination.parents) if f in new or not f.exists()]
            make_folders(destination)
            try:
                lock.mkdir(exist_ok=True)
                held.enter_context(folder_lock(lock, wait_s, without_lock=without_lock))
                break
            except FileNotFoundError:
                continue  # another publish failed, and took the folder away
            except NoLocks:
                _remove_unused(destination, new)
                raise
        try:
            yield
        except BaseException:
            _remove_unused(destination, new)
            raise


def _remove_unused(destination: Path, new: Iterable[Path]) -> None:
    """Folders that were made for what was not published then, the innermost first."""
    if new and {entry.name for entry in destination.iterdir()} <= {_LOCKED}:
        shutil.rmtree(destination / _LOCKED, ignore_errors=True)
        with suppress(OSError):  # others have put something there meanwhile
            for place in new:
                place.rmdir()


def _published(asset: Asset, destination: Path, options: PublishOptions) -> dict[str, Any]:
    # What a killed run left half lies where nobody else makes anything.
    shutil.rmtree(destination / _LOCKED / _STAGED, ignore_errors=True)
    earlier = versions_in(destination)
    latest = earlier[-1] if earlier else ""
    version = _version(options.version, latest, earlier)
    final = destination / version
    # Who names a version is to find it, though the latest may hold the same.
    like = destination / (version if options.version else latest)
    with temporary_folder(destination / _LOCKED / _STAGED / version) as staged:
        manifest = _write(asset, staged, version, options)
        if like.name in earlier and manifest.content == _content_of(like):
            return _summary(asset, like, read_manifest(like), new=False)
        if version in earlier:
            raise OwnershipConflict(
                f"{final}: this version is there and holds something else. Versions never change: "
                "leave --version out, or name a later one. [publish.version]"
            )
        for file in (each for each in staged.rglob("*") if each.is_file()):
            file.chmod(file.stat().st_mode & 0o444)
        publish_folder(staged, final)
    return _summary(asset, final, manifest, new=True)


def _version(asked: str | None, latest: str, earlier: list[str]) -> str:
    number = int(latest[1:]) if latest else 0
    if asked is None:
        return f"v{number + 1:03d}"
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
    components, missing = _unpublished(asset), steps_to_come(asset)
    said = hashlib.sha256(f"{options.encoding}\0{options.uri}\0{space}\0".encode())

    def describe(layer: Sdf.Layer) -> None:
        said.update(layer.ExportToString().encode())
        _describe(layer, asset.name, version, identifier, missing)
        for path in components:
            _tell(Sdf.CreatePrimInLayer(layer, path), version=version)

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
    # Afterwards, for the number is no content.
    for own in {asset.component(path.name) for path in components} & files.keys():
        _tell_alone(folder / own, version)
        files[own] = sha256_of(folder / own)
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


def _unpublished(asset: Asset) -> list[Sdf.Path]:
    """Components, which get the version's number where the root layer says its own, and in their
    own files: other layers are the same in every version that says the same."""
    stage = open_edited(asset)
    known = ((prim.GetPath(), prim.GetAssetInfo().get("version")) for prim in stage.TraverseAll())
    return [path for path, version in known if version == UNPUBLISHED]


def _tell_alone(file: Path, version: str) -> None:
    """The file of an object, which composes without the root layer's opinions of it."""
    layer = Sdf.Layer.OpenAsAnonymous(str(file))
    _tell(layer.GetPrimAtPath(f"/{layer.defaultPrim}"), version=version)
    export(layer, file, folder=file.parent)


def _tell(prim: Sdf.PrimSpec, **info: object) -> None:
    known = dict(prim.GetInfo("assetInfo")) if prim.HasInfo("assetInfo") else {}
    prim.SetInfo("assetInfo", {**known, **info})


def _describe(
    layer: Sdf.Layer, name: str, version: str, identifier: str, missing: list[str]
) -> None:
    """What the root layer of a version says of it."""
    layer.documentation = (
        "A published version, which never changes. Reference it, or put opinions into a layer of "
        "your own above it."
    ) + (f" It is unfinished: {not_run(missing)}." if missing else "")
    root = Sdf.CreatePrimInLayer(layer, f"/{layer.defaultPrim}")
    _tell(root, identifier=Sdf.AssetPath(identifier), name=name, version=version)


def _summary(asset: Asset, version: Path, manifest: Manifest, *, new: bool) -> dict[str, Any]:
    size = sum((version / path).stat().st_size for path in manifest.files)
    return {
        "publish": str(version),
        "version": manifest.version,
        "identifier": manifest.identifier,
        "texture_space": manifest.texture_space,
        "files": len(manifest.files),
        "bytes": size,
        "unfinished": steps_to_come(asset),
        "new": new,
    }
