"""What was found about one object, as rows of (label, value) for a person to read.

The usdview and the Blender plug-in are installed apart: each has its copy of this file.
"""

_STATUS = {
    "measured": "MEASURED in the photographs",
    "bounded": "BOUNDED, not measured: highlights are weaker than usual, if there are any",
    "undetermined": "UNDETERMINED, not measured: what remains likely by the photographs",
    "unseen": "UNSEEN, not measured: no photograph shows enough of the object",
    "failed": "FAILED, not measured: the photograph does not determine the values",
}
_MODEL = {
    "dielectric": "a colour under a gloss",
    "diffuse": "a colour alone: no highlight was found",
    "conductor": "a metal",
    "transparent": "clear glass, which is not fitted",
}
_RADIANCE = {
    "measured": "measured in the photographs",
    "estimated": "estimated from the light that it casts",
    "lowerBound": "a LOWER BOUND: clipped in every photograph",
}


def fit_rows(facts):
    """Rows for a mapping of attribute names (``usdBrdf:fit:phi``, ...) to their values.

    Facts that are absent are not known, and are told so; they are not replaced by defaults.
    """
    rows = [
        ("Object", _object(facts)),
        ("Status", _status(facts)),
        ("Material", _material(facts)),
        ("Roughness phi", _parameter(facts, "phi")),
        ("Specular psi", _parameter(facts, "psi") + _bound(facts)),
        ("Evidence", _number(facts, "usdBrdf:fit:evidence", "of the highlights explained")),
        ("Loss", _number(facts, "usdBrdf:fit:cost", "at its minimum")),
        ("Method", _method(facts)),
        ("Target frame", _target_frame(facts)),
    ]
    if "usdBrdf:emitter:radiance" in facts:
        rows.append(("Emits", _emission(facts)))
    return rows


def _object(facts):
    label, kind = facts.get("usdBrdf:label", ""), facts.get("usdBrdf:class", "")
    return f"{label} ({kind})" if kind else label or "without a name"


def _status(facts):
    status = facts.get("usdBrdf:fit:status", "")
    status = "undetermined" if status == "prior" else status  # in assets of older versions
    return _STATUS.get(status, f"{status or 'not fitted'}, not measured")


def _material(facts):
    # "kind" in assets of older versions
    model = facts.get("usdBrdf:fit:model", facts.get("usdBrdf:fit:kind"))
    unseen = facts.get("usdBrdf:fit:status", "unseen") == "unseen"
    return "not known" if unseen and model != "transparent" else _MODEL.get(model, "not known")


def _bound(facts):
    upper = facts.get("usdBrdf:fit:psiUpper95", 1.0)
    told = facts.get("usdBrdf:fit:status") != "measured" and upper < 0.995
    return f", below {upper:.2g} with 95 %" if told else ""


def _parameter(facts, name):
    value = facts.get(f"usdBrdf:fit:{name}")
    if value is None:
        return "not known"
    error = facts.get(f"usdBrdf:fit:{name}Error")
    deviation = "error not known" if error is None else f"± {error:.2g}"
    confidence = facts.get(f"usdBrdf:fit:{name}Confidence", "none")
    return f"{value:.3g} {deviation} (confidence {confidence})"


def _number(facts, name, what):
    return f"{facts[name]:.3g} {what}" if name in facts else "not known"


def _method(facts):
    method = facts.get("usdBrdf:fit:method") or "none"
    return f"{method}, {facts.get('usdBrdf:fit:numPixels', 0)} pixels"


def _target_frame(facts):
    frame = facts.get("usdBrdf:fit:targetFrame", -1)
    return f"{frame} (time code {frame + 1})" if frame >= 0 else "none"


def _emission(facts):
    red, green, blue = facts["usdBrdf:emitter:radiance"]
    how = _RADIANCE.get(facts.get("usdBrdf:emitter:radianceStatus"), "origin not known")
    error = facts.get("usdBrdf:emitter:radianceError")
    deviation = "" if error is None else f" ± {error:.0%}"
    return f"({red:.3g}, {green:.3g}, {blue:.3g}){deviation}, {how}"
