"""Our rules as validators of UsdValidation, with their cures as fixers; and plugInfo.json, from
which USD knows of them before it loads them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pxr import Sdf, Usd, UsdValidation

from usdbrdf.asset.properties import validators_path
from usdbrdf.files.atomic import write_text_atomic
from usdbrdf.validation.asset_stage import AssetStage
from usdbrdf.validation.rule import Rule, Severity, Site
from usdbrdf.validation.validate import RULES

# USD imports the module of this name, and begins the names of its validators with it.
PLUGIN = "usdbrdf.validation.usd_plugin"
SUITE = "All"
_KEYWORDS = ["usdBrdf"]


def plug_info() -> str:
    """The file's text."""
    validators: dict[str, Any] = {
        rule.name: {"doc": f"{rule.description} {rule.advice}", "keywords": _KEYWORDS}
        for rule in RULES
    }
    validators[SUITE] = {"doc": "All rules of usdbrdf.", "isSuite": True, "keywords": _KEYWORDS}
    plugin = {
        "Info": {"Validators": validators},
        "Name": PLUGIN,
        "ResourcePath": ".",
        "Root": ".",
        "Type": "python",
    }
    return json.dumps({"Plugins": [plugin]}, indent=4, sort_keys=True) + "\n"


def write_plug_info(folder: Path) -> None:
    write_text_atomic(folder / "plugInfo.json", plug_info())


if __name__ == "__main__":
    write_plug_info(validators_path())

# The first version that takes fixers from Python.
_PYTHON_FIXERS = (0, 26, 11)
_TYPES = {
    Severity.ERROR: UsdValidation.ValidationErrorType.Error,
    Severity.WARNING: UsdValidation.ValidationErrorType.Warn,
    Severity.INFO: UsdValidation.ValidationErrorType.Info,
}


def register_validators() -> None:
    """Tell USD what each of the validators that plugInfo.json lists does."""
    registry = UsdValidation.ValidationRegistry()
    for rule in RULES:
        name = f"{PLUGIN}:{rule.name}"
        fixers = [_fixers(rule)] if Usd.GetVersion() >= _PYTHON_FIXERS else []
        registry.RegisterPluginStageValidator(name, _stage_task(rule), *fixers)
    names = [f"{PLUGIN}:{rule.name}" for rule in RULES]
    validators = registry.GetOrLoadValidatorsByName(names)
    registry.RegisterPluginValidatorSuite(f"{PLUGIN}:{SUITE}", validators)


def _stage_task(rule: Rule) -> Any:
    def check(stage: Usd.Stage, _times: Any) -> list[UsdValidation.ValidationError]:
        return [
            UsdValidation.ValidationError(
                rule.name,
                _TYPES[fault.severity or rule.severity],
                [_error_site(stage, fault.site)],
                fault.message,
            )
            for fault in rule.check(AssetStage(stage))
        ]

    return check


def _error_site(stage: Usd.Stage, site: Site) -> UsdValidation.ValidationErrorSite:
    if isinstance(site, Sdf.Layer):
        return UsdValidation.ValidationErrorSite(site, Sdf.Path.absoluteRootPath)
    return UsdValidation.ValidationErrorSite(stage, site.GetPath())


def _fixers(rule: Rule) -> list[UsdValidation.ValidationFixer]:
    cure = rule.cure
    if cure is None:
        return []

    def can_apply(error: Any, target: Usd.EditTarget, _time: Any) -> bool:
        sites = [site for site in error.GetSites() if site.IsPrim() or site.IsProperty()]
        return bool(sites) and all(_is_free(target.GetLayer(), site.GetStage()) for site in sites)

    def apply(error: Any, target: Usd.EditTarget, _time: Any) -> bool:
        done = []
        if not can_apply(error, target, _time):
            return False
        for site in error.GetSites():
            subject = site.GetPrim() if site.IsPrim() else site.GetProperty()
            with Usd.EditContext(subject.GetStage(), target):
                done.append(cure.apply(subject))
        return bool(done) and all(done)

    return [
        UsdValidation.ValidationFixer(
            name=cure.name,
            description=cure.description,
            fixerImplFn=apply,
            canApplyFn=can_apply,
            keywords=[],
            errorName=rule.name,
        )
    ]


def _is_free(layer: Sdf.Layer, stage: Usd.Stage) -> bool:
    """Whether cures may go there: what the pipeline writes is lost with the next run, and the root
    layer, a stage's edit target unless one says otherwise, is to stay as it was made."""
    scene = AssetStage(stage)
    return layer not in (*scene.own_layers, scene.asset_root)


register_validators()
