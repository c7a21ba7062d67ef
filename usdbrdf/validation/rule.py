"""What a rule is, and what it finds. The rules themselves know of no framework that runs them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

from pxr import Sdf, Usd

from usdbrdf.validation.asset_stage import AssetStage

Site: TypeAlias = "Usd.Prim | Usd.Property | Sdf.Layer"
# Before the name of a rule of ours, where it stands among those of others.
PREFIX = "usdbrdf"


class Severity(str, Enum):
    """An error shows in pictures or numbers; a warning is likely not what was meant."""

    ERROR = "error"
    WARNING = "warning"
    INFO = "info"


@dataclass(frozen=True)
class Fault:
    """One thing that a rule does not accept; ``severity`` only where it is not the rule's own."""

    site: Site
    message: str
    severity: Severity | None = None


@dataclass(frozen=True, kw_only=True)
class Cure:
    """What sets a fault right beyond doubt.

    ``apply`` authors at the edit target of the site's stage and returns whether it could. It never
    chooses a layer: whoever calls it does.
    """

    name: str
    description: str
    apply: Callable[[Site], bool]


Check: TypeAlias = Callable[[AssetStage], Iterable[Fault]]


@dataclass(frozen=True, kw_only=True)
class Rule:
    """A rule about stages of ours.

    description  what is wrong, and what comes of it
    advice       what to do
    check        the faults of a stage; none for a stage that the rule is not about
    """

    name: str
    severity: Severity
    description: str
    advice: str
    check: Check
    cure: Cure | None = None


def cure(description: str) -> Callable[[Callable[[Site], bool]], Cure]:
    """Decorates what authors a cure: the cure of its name (``read_raw`` becomes ReadRaw)."""
    return lambda apply: Cure(name=_title(apply), description=description, apply=apply)


def rule(severity: Severity, *, advice: str, cure: Cure | None = None) -> Callable[[Check], Rule]:
    """Decorates a check: the rule of its name (``layer_missing`` becomes LayerMissing), whose
    description is its docstring."""
    return lambda check: Rule(
        name=_title(check),
        severity=severity,
        description=" ".join((check.__doc__ or "").split()),
        advice=advice,
        check=check,
        cure=cure,
    )


def _title(function: Callable[..., object]) -> str:
    return function.__name__.title().replace("_", "")


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A fault in words.

    site   the prim or property in <>; of a file its default prim
    layer  in @@ the file itself; of a property the layer whose opinion wins; else the root layer
    """

    severity: Severity
    site: str
    layer: str
    message: str
    rule: str

    def __str__(self) -> str:
        return f"{self.severity.value}: {self.site} {self.layer}: {self.message} [{self.rule}]"


def finding_of(rule: Rule, fault: Fault) -> Finding:
    """A fault of one of our rules in words."""
    return Finding(
        severity=fault.severity or rule.severity,
        site=site_in_words(fault.site),
        layer=layer_in_words(fault.site),
        message=fault.message,
        rule=f"{PREFIX}.{rule.name}",
    )


def site_in_words(site: Site) -> str:
    """<path> of a prim or a property; of a layer that of its default prim, </> without one."""
    if isinstance(site, Sdf.Layer):
        return f"</{site.defaultPrim.lstrip('/')}>"
    return f"<{site.GetPath()}>"


def layer_in_words(site: Site) -> str:
    """@file@ of a layer, of the one whose opinion of a property wins, or of a prim's stage."""
    if isinstance(site, Usd.Property):
        stack = site.GetPropertyStack(Usd.TimeCode.Default())
        layer = stack[0].layer if stack else site.GetStage().GetRootLayer()
    else:
        layer = site if isinstance(site, Sdf.Layer) else site.GetStage().GetRootLayer()
    return f"@{layer.realPath or layer.identifier}@"
