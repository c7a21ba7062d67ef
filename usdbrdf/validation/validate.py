"""All rules of ours and the checks of OpenUSD itself: does a stage open and compose, what do both
find, what is looked for; and cures of what they find, written as a new layer that an artist may
add, or not."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from operator import attrgetter
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdShade, UsdValidation

from usdbrdf.asset.header import Provenance, new_layer, read_header
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import in_one_line, no_warnings, try_in_child
from usdbrdf.errors import EnvironmentFailure, InputRefused, UsageError
from usdbrdf.files.atomic import cure_of_writing, environment_failures, publish, temporary_beside
from usdbrdf.job.ownership import reading
from usdbrdf.job.versions import refuse_version
from usdbrdf.validation import file_rules, material_rules, record_rules, review_rules, variant_rules
from usdbrdf.validation.rule import (
    PREFIX,
    AssetStage,
    Cure,
    Finding,
    Rule,
    Severity,
    Site,
    finding_of,
)

# In the order of the modules, and there in that of the text.
RULES: tuple[Rule, ...] = tuple(
    each
    for module in (file_rules, record_rules, material_rules, variant_rules, review_rules)
    for each in vars(module).values()
    if isinstance(each, Rule)
)

OPEN = "usd.Open"
# The plug-ins of usd-core itself: others that are installed may need a network, or a licence.
_BUILT_IN = frozenset(
    ["usdValidation", "usdPhysicsValidators"]
    + [f"usd{name}Validators" for name in ("Geom", "Lux", "Media", "Shade", "Skel", "Utils")]
)
# Ours tell textures from photographs, and where a missing file is named.
_REPLACED = frozenset({"usdUtilsValidators:MissingReferenceValidator"})
_COMPOSES = "usdValidation:CompositionErrorTest.CompositionError"
_SEVERITIES = {
    UsdValidation.ValidationErrorType.Warn: Severity.WARNING,
    UsdValidation.ValidationErrorType.Info: Severity.INFO,
}


@dataclass(frozen=True, kw_only=True)
class ListedRule:
    """A rule as ``usdbrdf rules`` shows it.

    severity  "" for those of USD, which decide from case to case
    fix       what its cure authors, "" if it has none
    """

    name: str
    severity: str
    description: str
    advice: str = ""
    fix: str = ""


def validate(root_layer: Path) -> list[Finding]:
    """Findings of our rules and of USD's, in that order; ``root_layer`` is NAME.usda."""
    with reading(root_layer):
        opened = open_or_finding(root_layer)
        if isinstance(opened, Finding):
            return [opened]
        scene = AssetStage(opened)
        others = map(standard_findings, scene.only_in_other_looks())
        found = [*standard_findings(opened), *chain.from_iterable(others)]
        gone = [f"@{layer}@" for layer in scene.missing_layers]
        # LayerMissing says it in words that help.
        again = [f for f in found if f.rule == _COMPOSES and any(x in f.message for x in gone)]
        return [*own_findings(scene), *(f for f in found if f not in again)]


def own_findings(subject: Usd.Stage | AssetStage) -> list[Finding]:
    """Findings of our rules about any stage, once each."""
    scene = subject if isinstance(subject, AssetStage) else AssetStage(subject)
    found = (finding_of(rule, fault) for rule in RULES for fault in rule.check(scene))
    return list(dict.fromkeys(found))


def has_errors(findings: Sequence[Finding]) -> bool:
    return any(finding.severity is Severity.ERROR for finding in findings)


def listed_rules() -> list[ListedRule]:
    """Ours, then USD's."""
    ours = [
        ListedRule(
            name=f"{PREFIX}.{rule.name}",
            severity=rule.severity.value,
            description=rule.description,
            advice=rule.advice,
            fix=rule.cure.description if rule.cure else "",
        )
        for rule in RULES
    ]
    opens = (OPEN, "USD can open the root layer, and the layers that it needs.")
    theirs = [opens, *((each.name, " ".join(each.doc.split())) for each in _built_in())]
    return ours + [ListedRule(name=n, severity="", description=text) for n, text in theirs]


def open_or_finding(root_layer: Path) -> Usd.Stage | Finding:
    """The stage, from the files as they are now; or why USD cannot open it. InputRefused where it
    crashes on them."""
    try_in_child(root_layer, composes=False)
    try:
        with no_warnings():
            stage = Usd.Stage.Open(str(root_layer))
            for layer in stage.GetUsedLayers():
                # Another stage of this process may hold a layer from before it was written anew.
                if not layer.anonymous:
                    layer.Reload()
    except Tf.ErrorException as error:
        return _not_opened(str(root_layer), error)
    return stage


def standard_findings(subject: Usd.Stage | Sequence[Usd.Prim]) -> Iterator[Finding]:
    """What usd-core's validators find in a stage, errors of composition among it; or in prims of a
    stage alone."""
    stage = subject if isinstance(subject, Usd.Stage) else subject[0].GetStage()
    registry = UsdValidation.ValidationRegistry()
    names = [metadata.name for metadata in _built_in()]
    context = UsdValidation.ValidationContext(validators=registry.GetOrLoadValidatorsByName(names))
    try:
        with no_warnings():
            errors = context.Validate(subject)
    except Tf.ErrorException as failure:
        # A validator opened a layer itself, and the stage's own open had passed over it.
        unreadable = {}
        for layer in stage.GetUsedLayers():
            for path in layer.GetCompositionAssetDependencies():
                try:
                    Sdf.Layer.FindOrOpenRelativeToLayer(layer, path)
                except Tf.ErrorException as refusal:
                    file = layer.ComputeAbsolutePath(path)
                    unreadable[file] = _not_opened(file, refusal)
        root = stage.GetRootLayer().realPath
        yield from [unreadable[file] for file in sorted(unreadable)] or [_not_opened(root, failure)]
        return
    for error in errors:
        if not _is_materialx_unknown(error):
            sites = [_site(site) for site in error.GetSites()]
            yield Finding.at(
                sites or [stage.GetRootLayer()],
                _SEVERITIES.get(error.GetType(), Severity.ERROR),
                in_one_line(error.GetMessage()),
                error.GetIdentifier(),
            )


def _site(site: UsdValidation.ValidationErrorSite) -> Site:
    if site.IsPrim():
        return site.GetPrim()
    if site.IsProperty():
        return site.GetProperty()
    return site.GetLayer() or site.GetStage().GetRootLayer()


def _not_opened(file: str, error: Tf.ErrorException) -> Finding:
    message = f"USD cannot open it: {in_one_line(error)}."
    return Finding(
        severity=Severity.ERROR, site="</>", layer=f"@{file}@", message=message, rule=OPEN
    )


def _built_in() -> list[UsdValidation.ValidatorMetadata]:
    every = UsdValidation.ValidationRegistry().GetAllValidatorMetadata()
    kept = [
        each
        for each in every
        if each.name.split(":")[0] in _BUILT_IN and each.name not in _REPLACED and not each.isSuite
    ]
    return sorted(kept, key=lambda each: str(each.name))


def _is_materialx_unknown(error: UsdValidation.ValidationError) -> bool:
    """usd-core is built without MaterialX: it calls every one of its nodes unknown."""
    if error.GetName() != "MissingShaderIdInRegistry":
        return False
    prims = [(s.GetProperty() if s.IsProperty() else s).GetPrim() for s in error.GetSites()]
    return all(str(UsdShade.Shader(prim).GetShaderId()).startswith("ND_") for prim in prims)


@dataclass(frozen=True, kw_only=True)
class Cured:
    """Which findings the layer cures; it is written only if there are any."""

    layer: Path
    findings: tuple[Finding, ...]


@contextmanager
def _on_disk(path: Path, written: Path) -> Iterator[None]:
    """What USD says while it writes a file, to be ``path``, is about the disk."""
    try:
        yield
    except Tf.ErrorException as error:
        raise EnvironmentFailure(
            f"{path}: USD could not write it ({in_one_line(error)}). {cure_of_writing(written)}, "
            "then run the same command again. [environment.io]"
        ) from error


def write_cures(asset: Asset, layer: Path) -> Cured:
    """Write ``layer``, a new .usda file, with what sets faults right beyond doubt.

    No other file is touched: it takes effect where somebody makes it the first sublayer of
    NAME.usda. Only those findings count as cured that are gone once it is.
    """
    path = layer.absolute()
    taken = (
        f"{path}: the file exists, and cures never go into a layer that somebody wrote. Name a "
        "new file. [fix.exists]"
    )
    if path.suffix != ".usda":
        raise UsageError(f"{path}: the cures are written as text; name a .usda file. [fix.suffix]")
    refuse_version(path)
    if os.path.lexists(path):
        raise UsageError(taken)
    reserved = [asset.folder / name for name in ("layers", "textures", ".usdbrdf")]
    if any(path.is_relative_to(folder) for folder in reserved):
        raise UsageError(
            f"{path}: the folder is the pipeline's own. Name a file beside "
            f"{asset.root_layer.name}. [fix.place]"
        )
    stage = open_or_finding(asset.root_layer)
    if isinstance(stage, Finding):
        raise InputRefused(f"{stage.layer}: {stage.message} [{stage.rule}]")
    with environment_failures(str(path)), temporary_beside(path) as written:
        header = new_layer(read_header(asset.root_layer), Provenance(role="cures", version="1"))
        header.documentation = (
            "Cures by usdbrdf validate --fix. They take effect as the first sublayer of "
            f"{asset.root_layer.name}."
        )
        with _on_disk(path, written):
            header.Export(str(written))
        cures = Sdf.Layer.FindOrOpen(str(written))
        # Stronger than all other layers, in memory alone.
        stage.GetSessionLayer().subLayerPaths.insert(0, cures.identifier)
        stage.SetEditTarget(Usd.EditTarget(cures))
        # In words before any cure: it may change which layer's opinion wins.
        scene = AssetStage(stage)
        before = list(_curable(scene))
        applied = dict.fromkeys(found for cure, site, found in before if cure.apply(site))
        # The same complaint, whichever layer it is that has the opinion.
        complaint = attrgetter("rule", "site", "message")
        after = {complaint(found) for _, _, found in _curable(AssetStage(stage))}
        cured = tuple(found for found in applied if complaint(found) not in after)
        if cured:
            with _on_disk(path, written):
                cures.Save()
            _publish_new(written, path, taken)
    return Cured(layer=path, findings=cured)


def _publish_new(written: Path, path: Path, taken: str) -> None:
    """Never over a file that somebody wrote in the meantime: the name is taken before it is used.

    A hard link would do both at once, but not every file system has them.
    """
    try:
        path.open("xb").close()
    except FileExistsError as error:
        raise UsageError(taken) from error
    try:
        publish(written, path)
    except BaseException:
        path.unlink()
        raise


def _curable(scene: AssetStage) -> Iterator[tuple[Cure, Site, Finding]]:
    """Sites hold as long as the scene does."""
    for rule in RULES:
        if rule.cure:
            for fault in rule.check(scene):
                yield rule.cure, fault.site, finding_of(rule, fault)
