"""Our rules as validators of UsdValidation, with their cures as fixers; and plugInfo.json, from
which USD knows of them before it loads them."""

from __future__ import annotations

import json
from typing import Any

from pxr import Sdf, Usd, UsdValidation

from usdbrdf.asset.schemas import validators_path
from usdbrdf.files.atomic import write_text_atomic
from usdbrdf.validation.rule import AssetStage, Cure, Rule, Severity
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


if __name__ == "__main__":
    write_text_atomic(validators_path() / "plugInfo.json", plug_info())

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
    names = [f"{PLUGIN}:{rule.name}" for rule in RULES]
    for name, rule in zip(names, RULES, strict=True):
        fixers = []
        if Usd.GetVersion() >= _PYTHON_FIXERS:
            fixers.append([_fixer(rule.cure, rule.name)] if rule.cure else [])
        registry.RegisterPluginStageValidator(name, _stage_task(rule), *fixers)
    validators = registry.GetOrLoadValidatorsByName(names)
    registry.RegisterPluginValidatorSuite(f"{PLUGIN}:{SUITE}", validators)


def _stage_task(rule: Rule) -> Any:
    def check(stage: Usd.Stage, _times: Any) -> list[UsdValidation.ValidationError]:
        errors = []
        for fault in rule.check(AssetStage(stage)):
            place = fault.site, Sdf.Path.absoluteRootPath
            if not isinstance(fault.site, Sdf.Layer):
                place = stage, fault.site.GetPath()
            kind = _TYPES[fault.severity or rule.severity]
            site = UsdValidation.ValidationErrorSite(*place)
            errors.append(UsdValidation.ValidationError(rule.name, kind, [site], fault.message))
        return errors

    return check


def _fixer(cure: Cure, error_name: str) -> UsdValidation.ValidationFixer:
    def can_apply(error: Any, target: Usd.EditTarget, _time: Any) -> bool:
        sites = [site for site in error.GetSites() if site.IsPrim() or site.IsProperty()]
        # What the pipeline writes is lost with the next run, and the root layer, a stage's edit
        # target unless one says otherwise, is to stay as it was made.
        scenes = [AssetStage(site.GetStage()) for site in sites]
        kept = [layer for scene in scenes for layer in (*scene.own_layers, scene.asset_root)]
        return bool(sites) and target.GetLayer() not in kept

    def apply(error: Any, target: Usd.EditTarget, _time: Any) -> bool:
        if not can_apply(error, target, _time):
            return False
        done = []
        for site in error.GetSites():
            subject = site.GetPrim() if site.IsPrim() else site.GetProperty()
            with Usd.EditContext(subject.GetStage(), target):
                done.append(cure.apply(subject))
        return bool(done) and all(done)

    return UsdValidation.ValidationFixer(
        name=cure.name,
        description=cure.description,
        fixerImplFn=apply,
        canApplyFn=can_apply,
        keywords=[],
        errorName=error_name,
    )


register_validators()
