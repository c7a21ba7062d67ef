"""Is the asset sound? USD's own validators, composition, and files that are not there."""

from __future__ import annotations

from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdValidation

from usdbrdf.stage.frames_from_stage import asset_file
from usdbrdf.stage.usd_errors import in_one_line

# The plug-ins of usd-core itself: others that are installed may need a network, or a licence.
_BUILT_IN = frozenset(
    ["usdValidation"]
    + [f"usd{name}Validators" for name in ("Geom", "Lux", "Media", "Shade", "Skel", "Utils")]
    + ["usdPhysicsValidators"]
)


def validate(asset_root_layer: Path) -> list[str]:
    """Findings, one line each, empty for a sound asset; ``asset_root_layer`` is NAME.usda."""
    try:
        stage = Usd.Stage.Open(str(asset_root_layer))
    except Tf.ErrorException as error:
        return [f"{asset_root_layer}: USD cannot open it: {in_one_line(error)}. [validate.open]"]
    composition = [
        f"{in_one_line(error)}. [validate.composition]" for error in stage.GetCompositionErrors()
    ]
    return composition + _built_in_findings(stage) + _missing_files(stage)


def _built_in_findings(stage: Usd.Stage) -> list[str]:
    registry = UsdValidation.ValidationRegistry()
    names = [
        metadata.name
        for metadata in registry.GetAllValidatorMetadata()
        if metadata.name.split(":")[0] in _BUILT_IN and not metadata.isSuite
    ]
    context = UsdValidation.ValidationContext(
        validators=registry.GetOrLoadValidatorsByName(sorted(names))
    )
    findings = []
    for error in context.Validate(stage):
        sites = ", ".join(_site(site) for site in error.GetSites())
        findings.append(f"{sites}: {in_one_line(error.GetMessage())} [{error.GetIdentifier()}]")
    return findings


def _site(site: UsdValidation.ValidationErrorSite) -> str:
    if site.IsPrim():
        return f"<{site.GetPrim().GetPath()}>"
    if site.IsProperty():
        return f"<{site.GetProperty().GetPath()}>"
    return f"@{site.GetLayer().identifier}@" if site.GetLayer() else "stage"


def _missing_files(stage: Usd.Stage) -> list[str]:
    """Textures and photographs that the composed stage names but that do not exist."""
    findings = []
    for prim in stage.Traverse():
        for attribute in prim.GetAttributes():
            if attribute.GetTypeName() != Sdf.ValueTypeNames.Asset:
                continue
            for time in [Usd.TimeCode.Default(), *attribute.GetTimeSamples()]:
                file = asset_file(attribute, time)
                if file is not None and not file.is_file() and "<UDIM>" not in file.name:
                    findings.append(
                        f"<{attribute.GetPath()}>: @{file}@ does not exist. [validate.missing]"
                    )
    return sorted(set(findings))
