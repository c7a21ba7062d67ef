"""Rules about what the layers state of a measurement: attributes of the usdBrdf schemas."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

from pxr import Sdf, Usd

from usdbrdf.asset.schema import schema_names
from usdbrdf.validation.asset_stage import AssetStage, authored
from usdbrdf.validation.rule import Cure, Fault, Rule, Severity, Site

_INSTANCE = "__INSTANCE_NAME__"


class _Declared(NamedTuple):
    """The schema that declares an attribute, its instance ("" for none), and its tokens."""

    schema: str
    instance: str
    tokens: tuple[str, ...]


def _fit_range(scene: AssetStage) -> Iterator[Fault]:
    for prim in scene.recorded:
        for name in ("phi", "psi", "phiError", "psiError", "cost", "evidence"):
            value = authored(prim, f"usdBrdf:fit:{name}")
            if value is None:
                continue
            upper = 1.0 if name in ("phi", "psi", "evidence") else math.inf
            lower = -math.inf if name == "evidence" else 0.0
            if not (math.isfinite(value) and lower <= value <= upper):
                yield Fault(
                    site=prim.GetAttribute(f"usdBrdf:fit:{name}"),
                    message=f"the value is {value:g}, outside {lower:g} to {upper:g}.",
                )


def _fit_status(scene: AssetStage) -> Iterator[Fault]:
    for prim in scene.recorded:
        status = authored(prim, "usdBrdf:fit:status")
        wanted = {"measured": ["phi", "psi", "phiError"], "prior": ["phi", "psi"]}.get(status, [])
        if status == "measured" and authored(prim, "usdBrdf:fit:method") == "views":
            wanted = [*wanted, "psiError"]  # a single frame does not tell it
        missing = [name for name in wanted if authored(prim, f"usdBrdf:fit:{name}") is None]
        if status == "measured":
            names = ("phiConfidence", "psiConfidence")
            sure = {name: authored(prim, f"usdBrdf:fit:{name}") for name in names}
            missing += [name for name, value in sure.items() if value in (None, "none")]
        if missing:
            yield Fault(
                site=prim.GetAttribute("usdBrdf:fit:status"),
                message=f"the status is {status}, but there is no {', '.join(missing)}.",
            )


def _tokens(scene: AssetStage) -> Iterator[Fault]:
    for _, attribute, declared in _declared_attributes(scene):
        value = attribute.Get()
        if declared and declared.tokens and value not in declared.tokens:
            yield Fault(
                site=attribute,
                message=f"{value!r} is none of {', '.join(declared.tokens)}.",
            )


def _undeclared(scene: AssetStage) -> Iterator[Fault]:
    for _, attribute, declared in _declared_attributes(scene):
        if declared is None:
            yield Fault(
                site=attribute,
                message="no usdBrdf schema declares an attribute of this name: nothing reads it.",
            )


def _not_applied(scene: AssetStage) -> Iterator[Fault]:
    for prim in scene.recorded:
        applied = {name for layer_names in _api_schemas(prim) for name in layer_names}
        attributes = _attributes(prim)
        wanted = {full_name(d) for d in map(_declaration, attributes) if d}
        for name in sorted(wanted - applied):
            yield Fault(
                site=prim,
                message=f"it has attributes of {name}, but that schema is not applied to it.",
            )


def full_name(declared: _Declared) -> str:
    """The schema's name as it is applied."""
    return f"{declared.schema}:{declared.instance}" if declared.instance else declared.schema


def _apply_schemas(site: Site) -> bool:
    wanted = {full_name(d) for d in map(_declaration, _attributes(site)) if d}
    applied = {name for names in _api_schemas(site) for name in names}
    done = [site.AddAppliedSchema(name) for name in sorted(wanted - applied)]
    return all(done)


def _identifiers(scene: AssetStage) -> Iterator[Fault]:
    first: dict[str, Usd.Prim] = {}
    for item in scene.objects:
        identifier = str(authored(item, "usdBrdf:identifier") or "")
        if not Sdf.Path.IsValidIdentifier(identifier):
            yield Fault(
                site=item,
                message=f"usdBrdf:identifier is {identifier!r}, which names no material.",
            )
        elif identifier in first:
            yield Fault(
                site=item,
                message=f"<{first[identifier].GetPath()}> has the identifier {identifier} too.",
            )
        first.setdefault(identifier, item)


def _albedo(scene: AssetStage) -> Iterator[Fault]:
    for prim in scene.recorded:
        albedo = authored(prim, "usdBrdf:shading:meanAlbedo")
        if albedo is not None and not all(0 <= value <= 1 for value in albedo):
            yield Fault(
                site=prim.GetAttribute("usdBrdf:shading:meanAlbedo"),
                message=f"the mean albedo is {tuple(round(float(v), 3) for v in albedo)}: a "
                "surface reflects between none and all of the light.",
            )


def _declared_attributes(
    scene: AssetStage,
) -> Iterator[tuple[Usd.Prim, Usd.Attribute, _Declared | None]]:
    """All attributes of ours with their declaration; none where USD does not know the schemas."""
    if _declarations():
        for prim in scene.recorded:
            for attribute in _attributes(prim):
                yield prim, attribute, _declaration(attribute)


def _attributes(prim: Usd.Prim) -> list[Usd.Attribute]:
    found = prim.GetAuthoredPropertiesInNamespace("usdBrdf")
    return [a for a in found if isinstance(a, Usd.Attribute) and a.HasAuthoredValue()]


def _api_schemas(prim: Usd.Prim) -> list[list[str]]:
    """Applied schemas as authored: GetAppliedSchemas leaves out those that USD does not know."""
    listed = prim.GetMetadata("apiSchemas")
    return [listed.GetAddedOrExplicitItems()] if listed else []


def _declaration(attribute: Usd.Attribute) -> _Declared | None:
    name = attribute.GetName()
    declared = _declarations().get(name)
    parts = name.split(":")
    if declared or len(parts) < 4:
        return declared
    # usdBrdf:aov:INSTANCE:file
    general = _declarations().get(":".join([*parts[:2], _INSTANCE, *parts[3:]]))
    return general._replace(instance=parts[2]) if general else None


@cache
def _declarations() -> dict[str, _Declared]:
    registry = Usd.SchemaRegistry()
    found = {}
    for schema in schema_names():
        definition = registry.FindAppliedAPIPrimDefinition(schema)
        for name in definition.GetPropertyNames() if definition else ():
            tokens = definition.GetPropertyMetadata(name, "allowedTokens") or ()
            found[name] = _Declared(schema, "", tuple(tokens))
    return found


RULES = (
    Rule(
        name="FitRange",
        severity=Severity.ERROR,
        description="phi and psi lie between 0 and 1, and their errors are finite and not "
        "negative. Other values have no meaning in the model of the lobe.",
        advice="Remove the opinion that is stronger than the measurement's, or run usdbrdf fit.",
        check=_fit_range,
    ),
    Rule(
        name="FitStatus",
        severity=Severity.ERROR,
        description="An object whose status is measured states phi, psi, their errors and how far "
        "the photographs determine them; one whose status is prior states phi and psi. A number "
        "without its error must not pass for a measurement.",
        advice="Run usdbrdf fit again; do not change the status by hand.",
        check=_fit_status,
    ),
    Rule(
        name="AllowedTokens",
        severity=Severity.ERROR,
        description="Attributes with a fixed vocabulary, such as usdBrdf:fit:status, hold one of "
        "its words. USD itself does not check that.",
        advice="Use one of the words that the message lists.",
        check=_tokens,
    ),
    Rule(
        name="UndeclaredAttribute",
        severity=Severity.WARNING,
        description="Attributes whose names begin with usdBrdf: are declared by the schemas. One "
        "that is not is misspelt, or comes from another version of usdbrdf.",
        advice="Correct the name, or put values of your own into another namespace.",
        check=_undeclared,
    ),
    Rule(
        name="SchemaNotApplied",
        severity=Severity.WARNING,
        description="A prim with attributes of a usdBrdf schema has that schema applied. Some "
        "tools lose applied schemas while they copy attributes; applications then show the values "
        "without documentation, and find no objects by their schema.",
        advice="Apply the schema to the prim.",
        check=_not_applied,
        cure=Cure(name="Apply", description="apply the missing schemas", apply=_apply_schemas),
    ),
    Rule(
        name="ObjectIdentifier",
        severity=Severity.ERROR,
        description="Every object has an identifier of its own, which names its material and its "
        "textures. A copied object that keeps the identifier shares both with the original, and "
        "what is measured of one overwrites the other.",
        advice="Author another usdBrdf:identifier on the copy, or remove usdBrdf:label from it: it "
        "is then no object of the capture.",
        check=_identifiers,
    ),
    Rule(
        name="AlbedoRange",
        severity=Severity.WARNING,
        description="The mean albedo of an object lies between 0 and 1. More means that light was "
        "missed: a lamp that no photograph shows, or photographs that are not radiometric.",
        advice="Look at the irradiance map of the object and at the lamps; see the options of "
        "usdbrdf shade.",
        check=_albedo,
    ),
)
