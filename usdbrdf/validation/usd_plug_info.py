"""plugInfo.json, from which USD knows of our validators before it loads them.

python -m usdbrdf.validation.usd_plug_info        writes it anew, after a change of the rules
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from usdbrdf.files.atomic import write_text_atomic
from usdbrdf.stage.schema import validators_path
from usdbrdf.validation.rules import RULES

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
