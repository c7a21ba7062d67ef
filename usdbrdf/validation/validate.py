"""All rules of ours; an asset folder -> findings; the list of what is looked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pxr import Usd

from usdbrdf.validation import (
    capture_rules,
    file_rules,
    layer_rules,
    lights_rules,
    look_rules,
    material_rules,
    record_rules,
)
from usdbrdf.validation.asset_stage import AssetStage
from usdbrdf.validation.rule import PREFIX, Finding, Rule, Severity, finding_of
from usdbrdf.validation.standard import open_or_finding, standard_findings, standard_rules

RULES: tuple[Rule, ...] = (
    *layer_rules.RULES,
    *file_rules.RULES,
    *capture_rules.RULES,
    *record_rules.RULES,
    *material_rules.RULES,
    *look_rules.RULES,
    *lights_rules.RULES,
)


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
    return ours + [
        ListedRule(name=name, severity="", description=text) for name, text in standard_rules()
    ]
