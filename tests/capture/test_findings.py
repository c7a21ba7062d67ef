"""What is said when too many frames were dropped."""

from __future__ import annotations

from pathlib import Path

import pytest

from usdbrdf.capture.checks import Findings
from usdbrdf.errors import InputRefused


@pytest.mark.parametrize(
    ("rule", "cure"),
    [("capture.file", "Copy the missing images"), ("colmap.track", "leave them out")],
)
def test_the_refusal_names_a_frame_the_rule_and_a_cure(rule: str, cure: str):
    findings = Findings()
    findings.drop("7.exr", "it is a portrait", rule)
    with pytest.raises(InputRefused, match=rf"7 of 8 .*'7.exr': it is a portrait\. .*{cure}") as e:
        findings.refuse_too_few_frames(Path("scan.json"), 8)
    assert str(e.value).endswith(f"[{rule}]")
