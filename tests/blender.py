"""Programs in Blender's own Python, a process that must not see our build of USD."""

import os
import subprocess

import pytest

BLENDER = os.environ.get("USDBRDF_BPY_PYTHON", "")

needs_blender = pytest.mark.skipif(
    not BLENDER, reason="USDBRDF_BPY_PYTHON names no interpreter with the module bpy"
)


def in_blender(*arguments, folder, timeout=900, **environment):
    """What it prints; started in ``folder``, with more environment variables as given."""
    hidden = ("PYTHONPATH", "PXR_PLUGINPATH_NAME")
    own = {name: value for name, value in os.environ.items() if name not in hidden}
    done = subprocess.run(
        [BLENDER, *map(str, arguments)],
        env={**own, **environment},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
