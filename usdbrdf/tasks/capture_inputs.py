"""What a run reads of a capture: its files as hashes, by which what changed is read anew."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from usdbrdf.asset.layout import Asset, relative_path
from usdbrdf.capture.adapters import refuse_missing
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import json_text, read_json
from usdbrdf.files.paths import files_below
from usdbrdf.job.stamp import hash_of_files
from usdbrdf.options import AUTO, IngestOptions
from usdbrdf.tasks.task import HANDED_ON
from usdbrdf.untrusted.usd_files import layers_of_usd
from usdbrdf.untrusted.usd_paths import USD_SUFFIXES


def parameters_of(options: IngestOptions) -> dict[str, Any]:
    """What of the options the scan depends on, but for files, whose content counts."""
    files = ("mesh", "objects", "frames", "allow_outside")
    parameters = {k: v for k, v in asdict(options).items() if k not in files}
    return parameters | ({"objects": AUTO} if options.objects == AUTO else {})


def inputs_of_captures(
    captures: Mapping[str, tuple[Path, Sequence[Path]]], options: IngestOptions, asset: Asset
) -> tuple[dict[str, str], dict[str, str], dict[Path, str]]:
    """``inputs_of_capture`` of each lighting's capture and the files beside it, with the lighting's
    name behind every label; of the only one, "", as they are. And the hash of every file."""
    inputs: dict[str, str] = {}
    each: dict[Path, str] = {}
    places: dict[str, str] = {}
    for lighting, (capture, beside) in captures.items():
        behind = f".{lighting}" if lighting else ""
        found = inputs_of_capture(capture, options, asset, each, beside)
        for every, some in zip((inputs, places), found, strict=True):
            every.update({f"{label}{behind}": value for label, value in some.items()})
    return inputs, places, each


def inputs_of_capture(
    capture: Path,
    options: IngestOptions,
    asset: Asset,
    each: dict[Path, str],
    beside: Sequence[Path],
) -> tuple[dict[str, str], dict[str, str]]:
    """Hashes of all that ingest may read: the capture's folder and those that its documents may
    point into, without the asset if that lies in one, what options name, and the files ``beside``
    that its adapter reads. And where these lie, seen from scan.usdc, which names photographs and
    USD geometry by such paths: what is moved must be read anew. ``each`` is told the hash of every
    file in these folders."""
    folder = (capture if capture.is_dir() else capture.parent).resolve()
    refuse_missing(capture)
    outside = {f"outside-{i}": place.resolve() for i, place in enumerate(options.allow_outside)}
    if options.frames is not None:
        outside["frames"] = options.frames.resolve()
    objects = options.objects if isinstance(options.objects, Path) else folder / "objects.json"
    inputs = {
        label: hash_of_files(
            [
                f
                for f in files_below(place, without=asset.folder)
                if f.resolve() != objects.resolve()
            ],
            place,
            each,
        )
        for label, place in ({"capture": folder} | outside).items()
    } | _inputs_of_objects(objects)
    if beside:
        inputs["beside"] = hash_of_files(beside)
    mesh = options.mesh
    if mesh is not None and mesh.is_file():
        # What a USD mesh refers to may lie beside it, out of the capture.
        usd = mesh.suffix.lower() in USD_SUFFIXES
        layers = layers_of_usd(mesh, (folder, *options.allow_outside)) if usd else [mesh]
        inputs["mesh"] = hash_of_files(layers)
    named = {"mesh": mesh.resolve()} if mesh is not None else {}
    places = {"capture": capture.resolve()} | named | outside
    here = asset.layer("scan").parent
    return inputs, {name: relative_path(place, here) for name, place in places.items()}


def _inputs_of_objects(file: Path) -> dict[str, str]:
    """Of an objects.json what the scan depends on, and apart from that its directives: these alone
    may change without a new scan. Where it is none its adapter will say so."""
    if not file.is_file():
        return {}
    whole = {"objects": hash_of_files([file])}
    with suppress(InputRefused):
        document = read_json(file)
        rows = document.get("objects") if isinstance(document, dict) else None
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            return whole
        asked = [str(row.pop("directive", "")) for row in rows]
        texts = {"objects": json_text(document)}
        if any(asked):
            texts[HANDED_ON] = json_text(asked)
        return {k: hashlib.sha256(text.encode()).hexdigest() for k, text in texts.items()}
    return whole


def no_asset(capture: Path) -> Path:
    """The path of a capture itself; InputRefused where it is that of an asset, or of a part of
    one."""
    if asset := Asset.around(capture):
        what = "a published version of an asset" if asset.is_published else "an asset"
        part = "" if capture.absolute() == asset.folder else f"part of {asset.folder}, "
        raise InputRefused(
            f"{capture}: {part}{what} that usdbrdf wrote, and no capture. Name the capture that it "
            "was made of; validate, report and view look at assets. [capture.asset]"
        )
    return capture
