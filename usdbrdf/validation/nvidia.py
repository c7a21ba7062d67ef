"""Our rules in usd-validation-nvidia, which finds this module by its entry point.

Its engine looks at stages once per combination of variants where a rule asks for prims. Ours look
at whole stages, and at every look by themselves. They offer it no fixes: it would write them into
the layers where the faults are, and those are written again.
"""

from __future__ import annotations

from typing import Any

import usd_validation_nvidia as validator
from pxr import Sdf, Usd

from usdbrdf.validation.rule import AssetStage, Rule, Severity
from usdbrdf.validation.validate import RULES

CATEGORY = "usdbrdf"


class Plugin:
    """What the entry point names: adds the rules when the validator starts."""

    def __init__(self) -> None:
        scenes = _Scenes()
        self._checkers = [_checker(rule, scenes) for rule in RULES]

    def on_startup(self) -> None:
        for checker in self._checkers:
            validator.register_rule(CATEGORY)(checker)

    def on_shutdown(self) -> None:
        for checker in self._checkers:
            validator.unregister_rule(checker)


class _Scenes:
    """The stage that is being checked, as all rules look at it: what several of them need is
    gathered once. The engine runs all checks of a stage before it switches its first variant."""

    def __init__(self) -> None:
        self._latest: AssetStage | None = None

    def of(self, stage: Usd.Stage) -> AssetStage:
        if self._latest is None or self._latest.stage != stage:
            self._latest = AssetStage(stage)
        return self._latest

    def forget(self) -> None:
        self._latest = None


def _checker(rule: Rule, scenes: _Scenes) -> type[Any]:
    """A rule as a class; its name begins with UsdBrdf, as all names share one namespace."""

    # What is no coroutine it would run in another thread, while it switches the stage's variants.
    async def check_stage(self: Any, stage: Usd.Stage) -> None:
        adders = {
            # "failed check" is its word for a broken rule; "error" for one that cannot run.
            Severity.ERROR: self._AddFailedCheck,
            Severity.WARNING: self._AddWarning,
            Severity.INFO: self._AddInfo,
        }
        for fault in rule.check(scenes.of(stage)):
            layer = isinstance(fault.site, Sdf.Layer)
            message = f"@{fault.site.realPath}@: {fault.message}" if layer else fault.message
            at = None if layer else fault.site
            adders[fault.severity or rule.severity](message=message, at=at)

    body = {
        "__doc__": f"{rule.description} {rule.advice}",
        "CheckStage": check_stage,
        "ResetCaches": lambda self: scenes.forget(),
    }
    return type(f"UsdBrdf{rule.name}", (validator.BaseRuleChecker,), body)
