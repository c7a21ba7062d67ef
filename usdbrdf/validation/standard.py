"""The checks of OpenUSD itself: does the stage open and compose, and what do its validators say."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdShade, UsdValidation

from usdbrdf.asset.readers.compose import in_one_line, try_in_child
from usdbrdf.validation.rule import Finding, Severity, Site, layer_in_words, site_in_words

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
        if _is_materialx_unknown(error):
            continue
        sites = [_site(site) for site in error.GetSites()] or [stage.GetRootLayer()]
        yield Finding(
            severity=_SEVERITIES.get(error.GetType(), Severity.ERROR),
            site=", ".join(site_in_words(site) for site in sites),
            layer=layer_in_words(sites[0]),
            message=in_one_line(error.GetMessage()),
            rule=error.GetIdentifier(),
        )


def standard_rules() -> Iterator[tuple[str, str]]:
    """(name, description) of all that ``standard_findings`` looks for."""
    yield OPEN, "USD can open the root layer, and the layers that it needs."
    for metadata in _built_in():
        yield metadata.name, " ".join(metadata.doc.split())


def _not_opened(file: str, error: Tf.ErrorException) -> Finding:
    return Finding(
        severity=Severity.ERROR,
        site="</>",
        layer=f"@{file}@",
        message=f"USD cannot open it: {in_one_line(error)}.",
        rule=OPEN,
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
    found = [
        metadata
        for metadata in UsdValidation.ValidationRegistry().GetAllValidatorMetadata()
        if metadata.name.split(":")[0] in _BUILT_IN and not metadata.isSuite
    ]
    kept = [metadata for metadata in found if metadata.name not in _REPLACED]
    return sorted(kept, key=lambda metadata: str(metadata.name))


def _is_materialx_unknown(error: UsdValidation.ValidationError) -> bool:
    """usd-core is built without MaterialX: it calls every one of its nodes unknown."""
    if error.GetName() != "MissingShaderIdInRegistry":
        return False
    prims = [(s.GetProperty() if s.IsProperty() else s).GetPrim() for s in error.GetSites()]
    return all(str(UsdShade.Shader(prim).GetShaderId()).startswith("ND_") for prim in prims)


def _site(site: UsdValidation.ValidationErrorSite) -> Site:
    if site.IsPrim():
        return site.GetPrim()
    if site.IsProperty():
        return site.GetProperty()
    return site.GetLayer() or site.GetStage().GetRootLayer()


@contextmanager
def _no_warnings() -> Iterator[None]:
    """USD prints its warnings as it goes; what they are about, the findings name.

    Versions of usd-core without a trap for them print them still.
    """
    if not hasattr(Tf, "DiagnosticTrap"):
        yield
        return
    with Tf.DiagnosticTrap() as trap:
        try:
            yield
        finally:
            trap.ClearWarnings()
