"""The method on one page.

A capture becomes a USD asset in four steps. Each opens the stage composed from the layers weaker
than its own (never the artist's), and writes one layer and its textures; so anyone can stop after a
step, look, override in edits.usda, and go on.

    ingest   files        -> scan.usdc       geometry, one prim per object, cameras as captured
    texture  frames       -> texturing.usda  L_d, the lit diffuse radiance: median of what was seen
    shade    L_d          -> shading.usda    irradiance S by ray tracing, albedo = pi L_d / S
    fit      frames       -> material.usda   roughness and specular of each object; with these, L_d
                                             and albedo again, without specular light
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from usdbrdf.asset.adopt import adopt, is_damaged
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import warn_of_edits
from usdbrdf.capture.ingest_options import IngestOptions
from usdbrdf.errors import OwnershipConflict
from usdbrdf.job.ownership import edited_files, owned_folder
from usdbrdf.job.progress import say
from usdbrdf.job.stamp import known_hashes
from usdbrdf.job.task import TaskResult
from usdbrdf.tasks.fit import fit
from usdbrdf.tasks.fit_objects import FitOptions
from usdbrdf.tasks.ingest import ingest
from usdbrdf.tasks.shade import ShadeOptions, shade
from usdbrdf.tasks.texture import TextureOptions, texture


@dataclass(frozen=True, kw_only=True)
class ConvertOptions:
    """The options of all four steps."""

    ingest: IngestOptions = field(default_factory=IngestOptions)
    texture: TextureOptions = field(default_factory=TextureOptions)
    shade: ShadeOptions = field(default_factory=ShadeOptions)
    fit: FitOptions = field(default_factory=FitOptions)


def convert(
    capture: str | Path,
    output: str | Path,
    options: ConvertOptions | None = None,
    *,
    adapter: str | None = None,
) -> dict[str, TaskResult]:
    """Do all of it: capture in, layered USD asset out; steps that are done already are kept.

    capture   folder or file that one of the adapters reads
    output    asset folder, made if absent; its root layer is OUTPUT/<name>.usda
    returns   what each step found, by name

    Raises UsdBrdfError (see ``usdbrdf.errors``); an interrupted or failed call leaves what was
    valid before, and the same call again goes on where it stopped.
    """
    chosen = options or ConvertOptions()
    with working_on(output) as asset:
        return {
            "ingest": ingest(Path(capture), asset, chosen.ingest, adapter),
            "texture": texture(asset, chosen.texture),
            "shade": shade(asset, chosen.shade),
            "fit": fit(asset, chosen.fit),
        }


@contextmanager
def working_on(
    folder: str | Path,
    *,
    hand_edits: str = "refuse",
    wait_s: float = 0.0,
    without_lock: bool = False,
) -> Iterator[Asset]:
    """Prepare and lock an asset folder for one or more steps.

    A folder that is made here, its parents too, is removed again if nothing gets written into it.

    hand_edits    what to do with files of ours that somebody changed: "refuse"
                  (OwnershipConflict), "adopt" (keep their content as adopted-N.usda beside
                  edits.usda) or "discard"
    wait_s        how long to wait for another run in the folder before FolderBusy
    without_lock  go on where the file system has no locks, which is FolderBusy otherwise
    """
    with owned_folder(Path(folder), wait_s=wait_s, without_lock=without_lock) as state:
        asset, before = Asset.at(Path(folder)), known_hashes(state)
        _settle(asset, edited_files(asset.folder), hand_edits)
        yield asset
        if known_hashes(state) != before:
            warn_of_edits(Asset.at(asset.folder))


def _settle(asset: Asset, changed: list[str], hand_edits: str) -> None:
    damaged = [file for file in changed if is_damaged(asset.folder / file)]
    for file in damaged:
        say(f"warning: {asset.folder / file}: damaged; it is made again. [layer.damaged]")
    edited = [file for file in changed if file not in damaged]
    if edited and hand_edits == "refuse":
        raise OwnershipConflict(
            f"{asset.folder}: {', '.join(edited)} changed since usdbrdf wrote them. Run `convert` "
            "with --adopt to keep the changes beside edits.usda, or --discard to drop them. "
            "[ownership.edited]"
        )
    if edited and hand_edits == "adopt":
        for copy in adopt(asset, [asset.folder / file for file in edited]):
            say(f"{copy}: keeps what was changed by hand; add it to edits.usda to use it")
