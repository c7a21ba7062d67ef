"""All rules of ours and the checks of OpenUSD itself: does a stage open and compose, what do both
find, and what is looked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdShade, UsdValidation

from usdbrdf.asset.readers.compose import in_one_line, try_in_child
from usdbrdf.validation import file_rules, material_rules, record_rules, variant_rules
from usdbrdf.validation.rule import PREFIX, AssetStage, Finding, Rule, Severity, Site, finding_of

# In the order of the modules, and there in that of the text.
RULES: tuple[Rule, ...] = tuple(
    each
    for module in (file_rules, record_rules, material_rules, variant_rules)
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
    opened = open_or_finding(root_layer)
    if isinstance(opened, Finding):
        return [opened]
    return [*own_findings(opened), *standard_findings(opened)]


def own_findings(stage: Usd.Stage) -> list[Finding]:
    """Findings of our rules about any stage, once each."""
    scene = AssetStage(stage)
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
        with _no_warnings():
            stage = Usd.Stage.Open(str(root_layer))
            for layer in stage.GetUsedLayers():
                # Another stage of this process may hold a layer from before it was written anew.
                if not layer.anonymous:
                    layer.Reload()
    except Tf.ErrorException as error:
        return _not_opened(str(root_layer), error)
    return stage


def standard_findings(stage: Usd.Stage) -> Iterator[Finding]:
    """What usd-core's validators find; errors of composition are among it."""
    registry = UsdValidation.ValidationRegistry()
    names = [metadata.name for metadata in _built_in()]
    context = UsdValidation.ValidationContext(validators=registry.GetOrLoadValidatorsByName(names))
    try:
        with _no_warnings():
            errors = context.Validate(stage)
    except Tf.ErrorException as failure:
        # A validator opened a layer itself, and the stage's own open had passed over it.
        yield from _unreadable(stage) or [_not_opened(stage.GetRootLayer().realPath, failure)]
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


def _unreadable(stage: Usd.Stage) -> list[Finding]:
    """The layers that those of the stage name, and that USD cannot read."""
    found = {}
    for layer in stage.GetUsedLayers():
        for path in layer.GetCompositionAssetDependencies():
            try:
                Sdf.Layer.FindOrOpenRelativeToLayer(layer, path)
            except Tf.ErrorException as error:
                file = layer.ComputeAbsolutePath(path)
                found[file] = _not_opened(file, error)
    return [finding for _, finding in sorted(found.items())]


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


@contextmanager
def _no_warnings() -> Iterator[None]:
    """USD prints its warnings as it goes; what they are about, the findings name.

    Versions of usd-core without a trap for them print them still.
    """
    with getattr(Tf, "DiagnosticTrap", nullcontext)() as trap:
        try:
            yield
        finally:
            if trap is not None:
                trap.ClearWarnings()
