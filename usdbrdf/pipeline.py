"""The method on one page.

A capture becomes a USD asset in four steps. Each opens the stage composed from the layers weaker
than its own (never the artist's), and writes one layer and its textures; so anyone can stop after a
step, look, override in edits.usda, and go on.

    ingest   files        -> scan.usdc       geometry, one prim per object, cameras as captured
    texture  frames       -> texturing.usda  L_d, the lit diffuse radiance: median of what was seen
    shade    L_d          -> shading.usda    irradiance S by ray tracing, albedo = pi L_d / S
    fit      frames       -> material.usda   roughness and specular of each object; with these, L_d
                                             and albedo again, without specular light

Of several captures of one scene, in as many lightings, texture and shade make a layer for each, and
fit one material of all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any, ParamSpec

from usdbrdf.asset.adopt import adopt, is_damaged
from usdbrdf.asset.layers.interface import cut_root_aside, is_cut, mend_root
from usdbrdf.asset.layers.scan_layer import is_edited
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import warn_of_edits
from usdbrdf.cluster.options import ClusterOptions
from usdbrdf.cluster.session import workers_of as workers_of
from usdbrdf.errors import OwnershipConflict
from usdbrdf.files.atomic import environment_failures
from usdbrdf.job.first_run import compiling_beside
from usdbrdf.job.ownership import edited_files, is_held, owned_folder
from usdbrdf.job.progress import say, warn
from usdbrdf.job.stamp import STATE_FOLDER, known_hashes
from usdbrdf.job.task import TaskResult
from usdbrdf.job.units import HERE, Workers
from usdbrdf.job.versions import refuse_version
from usdbrdf.options import ConvertOptions, HandEdits, ShadeOptions, TextureOptions
from usdbrdf.tasks.fit import fit as fit_task
from usdbrdf.tasks.fit import refuse_one_frame
from usdbrdf.tasks.ingest import ingest as ingest_task
from usdbrdf.tasks.shade import shade as shade_task
from usdbrdf.tasks.task import in_each_lighting
from usdbrdf.tasks.texture import texture as texture_task
from usdbrdf.tasks.unwrap import unwrap

P = ParamSpec("P")


def convert(
    capture: str | Path | Sequence[str | Path],
    output: str | Path,
    options: ConvertOptions | None = None,
    *,
    adapter: str | None = None,
    plugins: bool = True,
    hand_edits: HandEdits = "refuse",
    wait_s: float = 0.0,
    without_lock: bool = False,
    cluster: ClusterOptions | None = None,
    client: Any = None,
) -> dict[str, TaskResult]:
    """Do all of it: capture in, layered USD asset out; steps that are done already are kept.

    capture   folder or file that one of the adapters reads; or several, that share mesh and
              objects: one scene in as many lightings, which get the names of their folders
    output    asset folder, made if absent; its root layer is OUTPUT/<name>.usda
    adapter   name of the one that reads the capture; None: the first that recognises it, among
              those of other packages too if ``plugins``
    hand_edits, wait_s, without_lock   as of ``working_on``
    cluster, client   as of ``workers_of``
    returns   what each step found, by name

    Raises UsdBrdfError (see ``usdbrdf.errors``); an interrupted or failed call leaves what was
    valid before, and the same call again goes on where it stopped.
    """
    chosen = options or ConvertOptions()
    paths = [capture] if isinstance(capture, (str, Path)) else [*capture]
    if len(paths) > 1:
        refuse_one_frame(chosen.fit)
    working = working_on(output, hand_edits=hand_edits, wait_s=wait_s, without_lock=without_lock)
    with working as asset, compiling_beside(), workers_of(cluster, client) as workers:
        return {
            "ingest": ingest([*map(Path, paths)], asset, chosen.ingest, adapter, plugins=plugins),
            "texture": texture(asset, chosen.texture, workers),
            "shade": shade(asset, chosen.shade, workers),
            "fit": fit(asset, chosen.fit, workers),
        }


@contextmanager
def working_on(
    folder: str | Path,
    *,
    hand_edits: HandEdits = "refuse",
    wait_s: float = 0.0,
    without_lock: bool = False,
) -> Iterator[Asset]:
    """Prepare and lock an asset folder for one or more tasks; once more in the same thread does
    nothing.

    A folder that is made here, its parents too, is removed again if nothing gets written into it.

    hand_edits    what to do with files of ours that somebody changed: "refuse" (OwnershipConflict),
                  "adopt" (keep their content as adopted-N.usda beside edits.usda) or "discard"
    wait_s        for how many seconds to wait for another run in this folder before FolderBusy
    without_lock  go on where the file system has no locks, which is FolderBusy otherwise
    """
    place = Path(folder)
    if is_held(place / STATE_FOLDER):
        yield Asset.at(place)
        return
    refuse_version(place)
    with owned_folder(place, wait_s=wait_s, without_lock=without_lock) as state:
        asset, before = Asset.at(place), known_hashes(state)
        changed = edited_files(asset.folder)
        damaged = [file for file in changed if is_damaged(asset.folder / file)]
        for file in damaged:
            warn(f"{asset.folder / file}: damaged; it is made again. [layer.damaged]")
        edited = [file for file in changed if file not in damaged]
        if edited and hand_edits == "refuse":
            raise OwnershipConflict(
                f"{asset.folder}: {', '.join(edited)} changed since usdbrdf wrote them. Run "
                "`convert` with --adopt to keep the changes beside edits.usda, or --discard to "
                "drop them. [ownership.edited]"
            )
        if edited and hand_edits == "adopt":
            with environment_failures(str(asset.folder)):
                copies = adopt(asset, [asset.folder / file for file in edited])
            for copy in copies:
                say(f"{copy}: keeps what was changed by hand; add it to edits.usda to use it")
        _mend_root(asset, changed)
        yield asset
        if known_hashes(state) != before and is_edited(made := Asset.at(asset.folder)):
            warn_of_edits(made)


def _mend_root(asset: Asset, changed: Sequence[str]) -> None:
    """Have the root layer of which nothing is left written again, if the scan layer is sound and as
    it was written; else ingest writes both."""
    scan = asset.layer("scan")
    with environment_failures(str(asset.root_layer)):
        if not (is_cut(asset.root_layer) and scan.is_file()):
            return
        if scan.relative_to(asset.folder).as_posix() not in changed and not is_damaged(scan):
            mend_root(asset)
            _warn_of_cut(asset)


def _warn_of_cut(asset: Asset) -> None:
    warn(f"{asset.root_layer}: cut off; it is written again. [layer.damaged]")


def _on_its_folder(task: Callable[P, TaskResult]) -> Callable[P, TaskResult]:
    """A task that works on the folder of its asset, alone there, and says if there was no need."""

    @wraps(task)
    def run(*given: P.args, **named: P.kwargs) -> TaskResult:
        with working_on(_asset_of(task, *given, **named).folder):
            result = task(*given, **named)
        if not result.reran:
            say(f"{task.__name__.strip('_')}: up to date")
        return result

    return run


def _asset_of(task: Callable[P, TaskResult], *given: P.args, **named: P.kwargs) -> Asset:
    asset: Asset = signature(task).bind(*given, **named).arguments["asset"]
    return asset


def _making_a_cut_root_anew(task: Callable[P, TaskResult]) -> Callable[P, TaskResult]:
    """A task that writes the root layer where there is none, also where nothing is left of it."""

    @wraps(task)
    def run(*given: P.args, **named: P.kwargs) -> TaskResult:
        asset = _asset_of(task, *given, **named)
        with cut_root_aside(asset) as is_made_anew:
            done = task(*given, **named)
        if is_made_anew:
            _warn_of_cut(asset)
        return done

    return run


def _texture(asset: Asset, options: TextureOptions, workers: Workers = HERE) -> TaskResult:
    if not asset.lightings:
        return texture_task(asset, options, workers)
    shared, found = unwrap(asset, options), in_each_lighting(texture_task, asset, options, workers)
    return replace(found, reran=shared.reran or found.reran)


def _shade(asset: Asset, options: ShadeOptions, workers: Workers = HERE) -> TaskResult:
    return in_each_lighting(shade_task, asset, options, workers)


ingest = _on_its_folder(_making_a_cut_root_anew(ingest_task))
texture = _on_its_folder(_texture)
shade = _on_its_folder(_shade)
fit = _on_its_folder(fit_task)
