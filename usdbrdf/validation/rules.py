"""All rules of ours."""

from __future__ import annotations

from usdbrdf.validation import (
    capture_rules,
    file_rules,
    layer_rules,
    lights_rules,
    look_rules,
    material_rules,
    record_rules,
)
from usdbrdf.validation.rule import Rule

RULES: tuple[Rule, ...] = (
    *layer_rules.RULES,
    *file_rules.RULES,
    *capture_rules.RULES,
    *record_rules.RULES,
    *material_rules.RULES,
    *look_rules.RULES,
    *lights_rules.RULES,
)
