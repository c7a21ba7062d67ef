"""What every step does around its own work: lock, stamp, provenance, hashes of what it reads."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pxr import Ar

from usdbrdf.asset.header import Draft, Provenance, StageHeader, read_header
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.errors import InputRefused
from usdbrdf.files.atomic import environment_failures, sha256_of
from usdbrdf.job.stamp import code_version
from usdbrdf.job.task import StageResult, StageRun, run_stage


@dataclass(frozen=True, kw_only=True)
class Step:
    """One step about to run: its asset, its role ("texturing", ...), what it depends on."""

    asset: Asset
    name: str
    role: str
    parameters: Mapping[str, Any]
    inputs: Mapping[str, str]

    def run(self, work: Callable[[StageRun], dict[str, Any]]) -> StageResult:
        """Do the work unless it is done already (see ``usdbrdf.job.task``)."""
        return run_stage(
            self.asset.folder,
            self.name,
            order=1 + ROLES.index(self.role),
            parameters=self.parameters,
            inputs=self.inputs,
            work=work,
        )

    @property
    def provenance(self) -> Provenance:
        return Provenance(
            role=self.role,
            version=code_version(),
            parameters=self.parameters,
            inputs=self.inputs,
        )

    @property
    def header(self) -> StageHeader:
        return read_header(self.asset.layer("scan"))

    @property
    def draft(self) -> Draft:
        """What the step's layers begin with."""
        return Draft(asset=self.asset, header=self.header, provenance=self.provenance)


def weaker_layers(asset: Asset, role: str) -> dict[str, str]:
    """Hashes of the layers that a step of ``role`` composes; refuses if one is not there yet."""
    files = [asset.layer(weaker) for weaker in ROLES[: ROLES.index(role)]]
    if role in ("shading", "material"):
        files.append(asset.uv_layer)
    for file in files:
        if not file.is_file():
            raise InputRefused(
                f"{asset.folder}: {file.name} is missing, so an earlier step has not run here. "
                "Run `usdbrdf convert`, or the steps ingest, texture, shade, fit in this order. "
                "[asset.incomplete]"
            )
    hashes = {file.name: sha256_of(file) for file in files}
    geometry = _foreign_layers(asset)
    return {**hashes, "geometry": hash_of_files(geometry)} if geometry else hashes


def hash_of_maps(asset: Asset, *aovs: str) -> str:
    """One SHA-256 over all objects' maps of these AOVs."""
    endings = tuple(f".{aov}.exr" for aov in aovs)
    folder = asset.folder / "textures"
    return hash_of_files(sorted(f for f in folder.glob("*.exr") if f.name.endswith(endings)))


def hash_of_files(files: Iterable[Path], root: Path | None = None) -> str:
    """One SHA-256 over names (relative to ``root``, if given) and contents of many files, wherever
    they lie, in the order in which they come."""
    names = list(files)
    for name in names:
        if not name.is_file():
            raise InputRefused(
                f"{name}: this file, which was there at ingest, is missing. Run `usdbrdf convert` "
                "with the capture again, from where it lies now. [input.missing]"
            )
    with environment_failures("reading the inputs"), ThreadPoolExecutor() as pool:
        digests = list(pool.map(sha256_of, names))
    lines = [
        f"{name.relative_to(root).as_posix() if root else name.name}\0{digest}\n"
        for name, digest in zip(names, digests, strict=True)
    ]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _foreign_layers(asset: Asset) -> list[Path]:
    """The files of the USD geometry that scan.usdc refers to, if that is where its meshes are."""
    scan = asset.layer("scan").resolve()
    stage = open_weaker(asset, "texturing")  # layers are valid only as long as it is held
    # What lies in a package has the package's path, followed by its own in brackets.
    files = {
        Path(Ar.SplitPackageRelativePathOuter(layer.realPath)[0])
        for layer in stage.GetUsedLayers()
        if not layer.anonymous
    }
    return sorted(file for file in files if file.resolve() != scan)
