"""Programs of this folder in Blender's own Python, which must not see our build of USD."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any


def in_blender(program: str, folder: Path, job: dict[str, Any]) -> None:
    """Run PROGRAM.py on a document with the job, which stays in ``folder``, by the interpreter with
    the module bpy that the environment variable USDBRDF_BPY_PYTHON names."""
    document = folder / "job.json"
    document.write_text(json.dumps(job))
    hidden = ("PYTHONPATH", "PXR_PLUGINPATH_NAME")
    subprocess.run(
        [os.environ["USDBRDF_BPY_PYTHON"], Path(__file__).with_name(f"{program}.py"), document],
        env={name: value for name, value in os.environ.items() if name not in hidden},
        check=True,
        stdout=subprocess.DEVNULL,
    )
