"""Opening the stage as a given task of the pipeline may see it, and the hashes of what it reads."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

from pxr import Sdf, Tf, Usd, UsdUtils

from usdbrdf.asset.header import (
    Provenance,
    new_layer,
    read_header,
    read_provenance,
    refuse_newer,
    refuse_old_layout,
)
from usdbrdf.asset.layout import LIGHTING, ROLES, Asset, open_metadata
from usdbrdf.asset.manifest import refuse_converted
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.tried import (
    TIMEOUT_S,
    look_through,
    refuse_special,
    refuse_special_behind,
    try_layers,
)
from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files.atomic import environment_failures, sha256_of
from usdbrdf.job.child import run_child
from usdbrdf.job.progress import warn
from usdbrdf.job.stamp import STATE_FOLDER, hash_of_files, read_stamp
from usdbrdf.model.arrays import Array
from usdbrdf.options import NO_LIGHT, Surroundings
from usdbrdf.untrusted.usd_paths import words_of

_MAX_LENGTH = 600
# An asset path with a scheme, as USD's messages spell it.
_ADDRESS = re.compile(r"@[A-Za-z][A-Za-z0-9+.-]+:/")
# What USD says of a layer that another names and it passes over, whatever the reason, which it may
# tell.
_PASSED_OVER = re.compile(
    r"Could not (?:load sublayer|open asset) @(?P<file>/[^@]*)@ "
    r"(?:of layer|for \w+ introduced by) @(?P<by>[^@]*)@(?:<[^>]*>)?"
    r"(?: -- (?P<why>.*?))?(?:[\s;]*skipping)?"
)
# What USD says of relocates in the layer stack that has the prim which they move.
_RELOCATED = "invalid opinion at the relocation source path"
# How USD's parser calls its own rules.
_OF_PARSER = re.compile(r"\bpxrInternal\w+::(\w+::)*")


def in_one_line(error: object) -> str:
    """The text of an error of USD, which often spans lines and repeats itself, on one line. Of an
    exception what its errors say, without the places in USD's own source."""
    told = error.args if isinstance(error, Tf.ErrorException) else [error]
    parts = (words_of(part) for part in told)
    text = "; ".join(" ".join(part.split()).rstrip(".; ") for part in parts)
    text = _OF_PARSER.sub("", text)
    return text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]} ..."


def open_weaker(asset: Asset, role: str) -> Usd.Stage:
    """The stage that the task of a role builds upon: only the layers weaker than its own. Never
    edits.usda: what an artist overrides must not flow back into the measurement.
    InputRefused where one of the tasks before has not run, or a newer version made its layer."""
    return _in_lighting(_sublayered(asset, _weaker_layers(asset, role)), asset)


def open_measured(asset: Asset) -> Usd.Stage:
    """All layers that the tool wrote, without the artist's, in the asset's lighting."""
    refuse_converted(asset)
    with suppress(InputRefused):  # what is wrong with the root is no matter here
        refuse_old_layout(asset)
    common = replace(asset, lighting="")
    return _in_lighting(_sublayered(common, [common.layer(role) for role in ROLES]), asset)


def open_edited(asset: Asset) -> Usd.Stage:
    """The asset as everybody else opens it: the root layer, with the artist's opinions.
    InputRefused where it does not compose, or USD crashes on it."""
    refuse_converted(asset)
    beside = [file for file in [asset.photographs_layer] if file.is_file()]
    try_in_child(asset.root_layer, beside=beside)
    stage = open_stage(asset.root_layer)
    refuse_newer(asset.root_layer, *map(asset.layer, ROLES))
    refuse_old_layout(asset)
    for file in beside:
        open_metadata(file)  # which names it
        stage.GetSessionLayer().subLayerPaths.append(str(file))
    return _in_lighting(stage, asset)


def _in_lighting(stage: Usd.Stage, asset: Asset) -> Usd.Stage:
    """With the asset's lighting selected, for this session alone, unless that is whichever is."""
    if asset.lighting:
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            choice = stage.GetDefaultPrim().GetVariantSets().AddVariantSet(LIGHTING)
            # A stage of one lighting's own layers has none to choose from.
            choice.AddVariant(asset.lighting)
            choice.SetVariantSelection(asset.lighting)
    return stage


@contextmanager
def no_warnings() -> Iterator[None]:
    """USD prints its warnings as it goes; what they are about, findings name.

    Versions of usd-core without a trap for them print them still.
    """
    with getattr(Tf, "DiagnosticTrap", nullcontext)() as trap:
        try:
            yield
        finally:
            if trap is not None:
                trap.ClearWarnings()


def with_variant(stage: Usd.Stage, prim: Usd.Prim, choice: str, variant: str) -> Usd.Stage:
    """Another stage of the same layers, in which a prim is in another variant of a set; what is
    authored on it goes where it goes on ``stage``."""
    session = Sdf.Layer.CreateAnonymous(".usda")
    if stage.GetSessionLayer():
        session.subLayerPaths = [stage.GetSessionLayer().identifier]
    spec = Sdf.CreatePrimInLayer(session, prim.GetPath())
    spec.variantSelections[choice] = variant
    with no_warnings():  # which ``stage`` gave already
        opened = Usd.Stage.Open(stage.GetRootLayer(), session, stage.GetPathResolverContext())
        opened.SetLoadRules(stage.GetLoadRules())
        opened.MuteAndUnmuteLayers(stage.GetMutedLayers(), [])
    opened.SetEditTarget(stage.GetEditTarget())
    return opened


def warn_of_edits(asset: Asset) -> None:
    """Say what keeps the asset from opening with the artist's opinions, if anything does. What is
    measured does not depend on them."""
    try:
        try_in_child(asset.root_layer)
    except UsdBrdfError as problem:
        warn(f"{problem} The layers in layers/ are measured all the same.")


def try_in_child(layer: Path, *, composes: bool = True, beside: Sequence[Path] = ()) -> None:
    """Open a stage that an artist may have edited in a child process, to learn whether USD survives
    it: prims nested 100,000 deep make it crash. InputRefused where it does not, and for what lies
    among an asset's layers and is no regular file, which USD would wait for.

    composes  refuse what ``open_stage`` refuses, too
    beside    layers that the stage does not name, opened alone
    """
    refuse_special(layer.parent)
    run_child(
        f"{__name__}:open_in_child",
        {},
        {"layer": str(layer), "composes": composes, "beside": [*map(str, beside)]},
        TIMEOUT_S,
        f"{layer}: opening it with the layers that it names, edits.usda included,",
    )


def open_in_child(_arrays: Mapping[str, Array], parameters: Mapping[str, Any]) -> dict[str, Array]:
    """The child's part of ``try_in_child``."""
    refuse_special_behind(parameters["layer"])
    if parameters["composes"]:
        open_stage(Path(parameters["layer"]))
    else:
        with suppress(Tf.ErrorException):
            Usd.Stage.Open(parameters["layer"])
    for file in parameters["beside"]:
        look_through(file)
    return {}


def open_stage(layer: Path | Sdf.Layer) -> Usd.Stage:
    """A stage that composes without errors, from the files as they are now."""
    subject = layer if isinstance(layer, Path) else layer.subLayerPaths[0]
    try:
        stage = Usd.Stage.Open(str(layer) if isinstance(layer, Path) else layer)
        for used in stage.GetUsedLayers():
            # Another stage of this process may hold a layer from before it was written anew; one
            # that its sublayers left meanwhile is gone.
            if not used.expired and not used.anonymous:
                used.Reload()
        problems = [in_one_line(problem) for problem in stage.GetCompositionErrors()]
    except Tf.ErrorException as error:
        raise InputRefused(
            f"{subject}: USD cannot open it: {in_one_line(error)}. Correct that file, or take an "
            "earlier copy of it. [stage.open]"
        ) from error
    if problems:
        if passed_over := _PASSED_OVER.fullmatch(problems[0]):
            _refuse_named(**passed_over.groupdict())
        cure = "Correct that layer, or bring back the file that it names."
        if _ADDRESS.search(problems[0]):
            cure = (
                "That is an address: run usdbrdf where the resolver that knows it is set up "
                "(PXR_PLUGINPATH_NAME), or name a file."
            )
        if _RELOCATED in problems[0]:
            cure = (
                "Relocates rename what a layer has by reference, not what stands beside it, as an "
                "asset's own layers beside its edits.usda do: take them out there, and rename in a "
                "layer that references the asset."
            )
        raise InputRefused(
            f"{subject}: the stage does not compose: {problems[0]}. {cure} [stage.open]"
        )
    return stage


def _refuse_named(file: str, by: str, why: str | None) -> NoReturn:
    """What there is to say of a layer that another names, and USD cannot read."""
    if not Path(file).exists():
        raise InputRefused(
            f"{file}: this layer, which {by} names, is missing. Bring it back, or take its name "
            "out there. [stage.open]"
        )
    with environment_failures(file):
        Path(file).open("rb").close()
    said = f" ({why})" if why else ""
    raise InputRefused(
        f"{file}: USD cannot read this layer{said}. Correct it, or take an earlier copy of it. "
        "[stage.open]"
    )


def named_files(layer: Sdf.Layer) -> set[str]:
    """Asset paths as written: sublayers, references, payloads, clips, attributes, metadata, of all
    variants. The layer is not changed."""
    copy = Sdf.Layer.CreateAnonymous()
    copy.TransferContent(layer)
    found: set[str] = set()

    def collected(path: str) -> str:
        found.add(path)
        return path

    UsdUtils.ModifyAssetPaths(copy, collected)
    return found - {""}


def recorded_photographs(asset: Asset) -> list[Path]:
    """Where the photographs and masks of an asset lie, that has been opened; none are read."""
    layer = asset.photographs_layer
    if not layer.is_file():
        return []
    return [layer.parent / name for name in sorted(named_files(Sdf.Layer.FindOrOpen(str(layer))))]


def _sublayered(asset: Asset, layers: Sequence[Path]) -> Usd.Stage:
    for layer in layers:
        if not layer.is_file():
            raise InputRefused(
                f"{asset.folder}: {layer.name} is missing, so an earlier step has not run here. "
                "Run `usdbrdf convert`, or the steps ingest, texture, shade, fit in this order. "
                "[asset.incomplete]"
            )
    root = new_layer(read_header(layers[0]), Provenance(role="view", version="1"))
    # Texture coordinates are a sublayer of texturing.usda already.
    uv = None if asset.lighting else asset.uv_layer
    named = [*(layer for layer in reversed(layers) if layer != uv), *_beneath(asset)]
    try_layers(named, together=True)
    below = {asset.layer("texturing"): asset.uv_layer, asset.layer("shading"): asset.lights_layer}
    for layer in (*named, *(part for whole, part in below.items() if whole in layers)):
        if layer.is_file():
            open_metadata(layer)  # which names it, where USD would name the stage made here
    root.subLayerPaths = [*map(str, named)]
    refuse_newer(*layers)
    return open_stage(root)


def hashes_of_inputs(
    asset: Asset,
    role: str,
    maps: AssetMaps,
    *,
    aovs: tuple[str, ...] = (),
    photographs: bool = False,
    environment: Surroundings = NO_LIGHT,
) -> dict[str, str]:
    """By label the SHA-256 of all that a task of ``role`` reads: the weaker layers and the USD
    geometry that they refer to, the maps ``aovs``, the photographs, the picture of the sky."""
    picture = environment if isinstance(environment, Path) else None
    files = {
        "geometry": maps.layers_elsewhere(asset.folder),
        "environment": [picture] if picture else [],
        "maps": asset.textures(*aovs),
        "frames": maps.frames.recorded_in() if photographs else [],
    }
    if picture and not picture.is_file():
        raise InputRefused(f"{picture}: no such file. Check --environment. [shading.environment]")
    behind = f".{asset.lighting}" if asset.lighting else ""
    layers = [*_weaker_layers(asset, role), *_beneath(asset)]
    by_label, each = {layer.name: sha256_of(layer) for layer in layers}, dict[Path, str]()
    by_label |= {f"{k}{behind}": hash_of_files(v, each=each) for k, v in files.items() if v}
    if photographs:
        _refuse_other_photographs(maps, each)
    return by_label


def _refuse_other_photographs(maps: AssetMaps, hashes: Mapping[Path, str]) -> None:
    """InputRefused where a photograph or mask is not the one that ingest has looked at: what it
    found of poses, sizes, exposures and damage is not true of another."""
    for files, before in zip(maps.frames.recorded_by(), maps.hashes_of_frames, strict=True):
        for file, known in zip(files, before.split(), strict=False):
            if hashes[file] != known:
                raise InputRefused(
                    f"{file}: not the file that the capture was read with: its content has "
                    "changed. Bring that back, or run `usdbrdf convert`, or `usdbrdf ingest`, "
                    "with the capture again. [input.changed]"
                )


def outdated_steps(asset: Asset) -> list[str]:
    """Which steps built on a layer that has changed since, in words."""
    folder, found = asset.layer("scan").parent, []
    for path in sorted((asset.folder / STATE_FOLDER / "stamps").glob("*.json")):
        stamp = read_stamp(path)
        for name, sha256 in stamp.inputs.items() if stamp else ():
            layer = folder / name
            if layer.parent == folder and layer.is_file() and sha256_of(layer) != sha256:
                found.append(f"{stamp.stage} was made with another {name}")  # type: ignore[union-attr]
    return found


def refuse_missing(asset: Asset, order: int) -> None:
    """InputRefused where the root layer is gone, or one that a step before the one of this order
    wrote: the asset would not open, whatever is measured. After the last step that may go without
    its photographs."""
    stamps = sorted((asset.folder / STATE_FOLDER / "stamps").glob("*.json"))
    before = [read_stamp(path) for path in stamps if path.name.split("-")[0] < str(order)]
    written = {name for stamp in before if stamp for name in stamp.outputs}
    layers = {asset.root_layer, *(asset.folder / name for name in written)}
    if order > len(ROLES):
        layers.discard(asset.photographs_layer)
    for layer in sorted(layers):
        if layer.suffix.startswith(".usd") and not layer.is_file():
            raise InputRefused(
                f"{layer}: this layer of the asset is missing. Run `usdbrdf convert`, or the step "
                "that writes it, again. [asset.incomplete]"
            )


def steps_to_come(asset: Asset) -> list[str]:
    """Which steps have not been run, in any or one of the lightings, in their order."""
    found = []
    for step, role in zip(("texture", "shade", "fit"), ROLES[1:], strict=True):
        layers = {one.layer(role) for one in (asset, *asset.in_each_lighting)}
        records = [read_provenance(layer) for layer in layers if layer.is_file()]
        if any(record.get("state") == "pending" for record in records):
            found.append(step)
    return found


def not_run(steps: Sequence[str]) -> str:
    """What is to be said of them, in words."""
    if len(steps) == 1:
        return f"the step {steps[0]} was not run"
    return f"the steps {', '.join(steps[:-1])} and {steps[-1]} were not run"


def _beneath(asset: Asset) -> list[Path]:
    """What stands beside the scan layer, so far as it is there: where its objects are, and where
    its photographs lie. Earlier versions had all in one."""
    return [x for x in (asset.interface("scan"), asset.photographs_layer) if x.is_file()]


def _weaker_layers(asset: Asset, role: str) -> list[Path]:
    layers = [asset.layer(weaker) for weaker in ROLES[: ROLES.index(role)]]
    unwrapped = role in ("shading", "material") or (asset.lighting and role == "texturing")
    return [*layers, asset.uv_layer] if unwrapped else layers
