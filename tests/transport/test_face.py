"""What the rest of the package knows of light transport."""

from __future__ import annotations

import ast
from pathlib import Path

import usdbrdf

PACKAGE = Path(usdbrdf.__file__).parent
FACE = {
    "rays", "lit_scene", "surface_texture", "environment", "lights", "irradiance",
    "lobe_radiance", "let_through", "renderer_match", "sunlight", "brdf", "warps", "denoise",
}  # fmt: skip


def test_nothing_else_reaches_behind_the_face_of_transport():
    reached = set()
    for path in PACKAGE.rglob("*.py"):
        if path.is_relative_to(PACKAGE / "transport"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module == "usdbrdf.transport":
                reached |= {(name.name, path.name) for name in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                room, _, module = node.module.rpartition(".")
                if room == "usdbrdf.transport":
                    reached.add((module, path.name))
    assert len(reached) > 20
    assert {module for module, _ in reached} <= FACE, sorted(reached)
