"""Cures of an asset's faults, written as a new layer that an artist may add, or not."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pxr import Sdf, Usd

from usdbrdf.asset.header import Provenance, new_layer, read_header
from usdbrdf.asset.layout import Asset
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.files.atomic import environment_failures, publish, temporary_beside
from usdbrdf.validation.rule import AssetStage, Cure, Finding, Site, finding_of
from usdbrdf.validation.validate import RULES, open_or_finding


@dataclass(frozen=True, kw_only=True)
class Cured:
    """Which findings the layer cures; it is written only if there are any."""

    layer: Path
    findings: tuple[Finding, ...]


def write_cures(asset: Asset, layer: Path) -> Cured:
    """Write ``layer``, a new .usda file, with what sets faults right beyond doubt.

    No other file is touched: it takes effect where somebody makes it the first sublayer of
    NAME.usda. Only those findings count as cured that are gone once it is.
    """
    path = layer.absolute()
    _check_place(asset, path)
    stage = open_or_finding(asset.root_layer)
    if isinstance(stage, Finding):
        raise InputRefused(f"{stage.layer}: {stage.message} [{stage.rule}]")
    with environment_failures(str(path)), temporary_beside(path) as written:
        header = new_layer(read_header(asset.root_layer), Provenance(role="cures", version="1"))
        header.documentation = (
            "Cures by usdbrdf validate --fix. They take effect as the first sublayer of "
            f"{asset.root_layer.name}."
        )
        header.Export(str(written))
        cures = Sdf.Layer.FindOrOpen(str(written))
        # Stronger than all other layers, in memory alone.
        stage.GetSessionLayer().subLayerPaths.insert(0, cures.identifier)
        stage.SetEditTarget(Usd.EditTarget(cures))
        # In words before any cure: it may change which layer's opinion wins.
        before = list(_curable(stage))
        applied = dict.fromkeys(found for cure, site, found in before if cure.apply(site))
        after = {_complaint(found) for _, _, found in _curable(stage)}
        cured = tuple(found for found in applied if _complaint(found) not in after)
        if cured:
            cures.Save()
            _publish(written, path)
    return Cured(layer=path, findings=cured)


def _curable(stage: Usd.Stage) -> Iterator[tuple[Cure, Site, Finding]]:
    scene = AssetStage(stage)
    for rule in RULES:
        if rule.cure:
            for fault in rule.check(scene):
                yield rule.cure, fault.site, finding_of(rule, fault)


def _complaint(finding: Finding) -> tuple[str, str, str]:
    """A finding, whichever layer it is that has the opinion."""
    return finding.rule, finding.site, finding.message


def _check_place(asset: Asset, path: Path) -> None:
    if path.suffix != ".usda":
        raise UsageError(f"{path}: the cures are written as text; name a .usda file. [fix.suffix]")
    if os.path.lexists(path):
        raise _taken(path)
    reserved = [asset.folder / name for name in ("layers", "textures", ".usdbrdf")]
    if any(path.is_relative_to(folder) for folder in reserved):
        raise UsageError(
            f"{path}: the folder is the pipeline's own. Name a file beside "
            f"{asset.root_layer.name}. [fix.place]"
        )


def _publish(written: Path, path: Path) -> None:
    """Never over a file that somebody wrote in the meantime: the name is taken before it is used.

    A hard link would do both at once, but not every file system has them.
    """
    try:
        path.open("xb").close()
    except FileExistsError as error:
        raise _taken(path) from error
    try:
        publish(written, path)
    except BaseException:
        path.unlink()
        raise


def _taken(path: Path) -> UsageError:
    return UsageError(
        f"{path}: the file exists, and cures never go into a layer that somebody wrote. Name a "
        "new file. [fix.exists]"
    )
