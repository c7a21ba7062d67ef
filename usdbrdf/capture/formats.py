"""What our own adapters read: apart from them, so that to list them loads neither NumPy nor USD."""

from __future__ import annotations

MODULES = {"transforms": "usdbrdf.capture.transforms", "scanner-app": "usdbrdf.capture.scanner_app"}
DESCRIPTIONS = {
    "transforms": "folder with transforms.json (nerfstudio), scene-linear images and a mesh",
    "scanner-app": 'export folder of "3d Scanner App" (frame_*.json, frame_*.jpg and a mesh)',
}
