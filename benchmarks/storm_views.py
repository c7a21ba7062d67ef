"""Render a USD layer with Hydra Storm: runs in an interpreter with the module `bpy`, which has it.

    BLENDER_PYTHON storm_views.py JOB.json

JOB.json: `layer`; `frames`, each with `camera` (prim path), `time`, `width` in pixels and `out`, a
linear EXR. Without a display: OpenGL by EGL's surfaceless platform, in software where there is no
GPU (Debian: libegl1 libgl1 libgl1-mesa-dri).
"""

import ctypes as c
import json
import os
import sys
from pathlib import Path

_SURFACELESS, _OPENGL = 0x31DD, 0x30A2
_PBUFFER = (c.c_int * 5)(0x3033, 1, 0x3040, 8, 0x3038)
_SIZE = (c.c_int * 5)(0x3057, 64, 0x3056, 64, 0x3038)
# OpenGL 4.5, compatibility profile: Storm draws by it without complaints.
_PROFILE = (c.c_int * 7)(0x3098, 4, 0x30FB, 5, 0x30FD, 2, 0x3038)


def make_context():
    """A current OpenGL context, for as long as the process lives."""
    os.environ.setdefault("EGL_PLATFORM", "surfaceless")
    egl = c.CDLL("libEGL.so.1", mode=c.RTLD_GLOBAL)
    c.CDLL("libGL.so.1", mode=c.RTLD_GLOBAL)
    pointer = c.c_void_p
    egl.eglGetProcAddress.restype = pointer
    display_of = c.CFUNCTYPE(pointer, c.c_uint, pointer, pointer)(
        egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    )
    display = display_of(_SURFACELESS, None, None)
    egl.eglInitialize.argtypes = [pointer] * 3
    if not egl.eglInitialize(display, None, None):
        raise SystemExit("EGL cannot open a surfaceless display")
    egl.eglBindAPI(_OPENGL)
    config, count = pointer(), c.c_int()
    egl.eglChooseConfig.argtypes = [pointer] * 3 + [c.c_int, pointer]
    egl.eglChooseConfig(display, _PBUFFER, c.byref(config), 1, c.byref(count))
    for name in ("eglCreateContext", "eglCreatePbufferSurface"):
        getattr(egl, name).restype = pointer
    egl.eglCreateContext.argtypes = [pointer] * 4
    egl.eglCreatePbufferSurface.argtypes = [pointer] * 3
    context = egl.eglCreateContext(display, config, None, _PROFILE)
    surface = egl.eglCreatePbufferSurface(display, config, _SIZE)
    egl.eglMakeCurrent.argtypes = [pointer] * 4
    if not egl.eglMakeCurrent(display, surface, surface, context):
        raise SystemExit("EGL cannot make an OpenGL context current")


def main(job):
    make_context()
    import bpy

    bpy.utils.expose_bundled_modules()
    from pxr import Usd, UsdAppUtils, UsdGeom

    stage = Usd.Stage.Open(job["layer"])
    recorder = UsdAppUtils.FrameRecorder("HdStormRendererPlugin", True)
    recorder.SetColorCorrectionMode("disabled")
    recorder.SetCameraLightEnabled(False)
    for frame in job["frames"]:
        camera = UsdGeom.Camera.Get(stage, frame["camera"])
        recorder.SetImageWidth(frame["width"])
        if not recorder.Record(stage, camera, Usd.TimeCode(frame["time"]), frame["out"]):
            raise SystemExit(f"Storm did not render {frame['camera']}")


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text()))
