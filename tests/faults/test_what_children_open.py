"""Which files, programs and sockets the children that parse foreign files ask the system for, as
strace sees it: libraries of C and C++ included."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import trimesh

from tests.fuzzing import seeds
from usdbrdf.files.scratch import PREFIX

_STRACE = shutil.which("strace")
_CALLS = "execve,open,openat,creat,mkdir,mkdirat,rename,renameat,unlink,link,symlink,socket,connect"
_CALLS += ",clone,clone3,fork,vfork"
_WRITES = r"O_WRONLY|O_RDWR|O_CREAT|^(creat|mkdir|rename|unlink|link|symlink)"
_READ = """
import sys
from pathlib import Path
from usdbrdf.errors import UsdBrdfError
from usdbrdf.untrusted.mesh_files import mesh_from_file, model_from_file
from usdbrdf.untrusted.pictures import picture_from_file
from usdbrdf.untrusted.usd_cameras import cameras_from_usd
from usdbrdf.untrusted.usd_files import meshes_from_usd

folder = Path(sys.argv[1])
for read, name in (
    (mesh_from_file, "a.ply"), (model_from_file, "b.obj"), (model_from_file, "c.glb"),
    (picture_from_file, "d.exr"), (meshes_from_usd, "e.usda"), (cameras_from_usd, "f.usda"),
    (meshes_from_usd, "g.usda"), (meshes_from_usd, "h.usdz"),
):
    try:
        read(folder / name)
        print(name, "read")
    except UsdBrdfError as error:
        print(name, str(error).rpartition("[")[2].rstrip("]"))
"""
_HEAD = '#usda 1.0\n(\n defaultPrim = "m"\n)\n'
_TRIANGLE = """def Mesh "m" {
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
}
def Camera "c" {
    asset backPlate:a:image = @plate.exr@
}
"""


def _capture(folder: Path) -> None:
    """Sound files and such that name what lies outside, each in its way."""
    folder.mkdir()
    for name in ("secret.usda", "secret.mtl", "secret.bin", "secret.png"):
        (folder.parent / name).write_text('#usda 1.0\ndef "secret" {\n}\n')
    box = trimesh.creation.box()
    box.export(folder / "a.ply")
    rows = [f"v {x} {y} {z}" for x, y, z in box.vertices]
    rows += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in box.faces]
    (folder / "b.obj").write_text("\n".join(["mtllib ../secret.mtl", *rows]))
    content = box.export(file_type="glb")
    length = int.from_bytes(content[12:16], "little")
    document = json.loads(content[20 : 20 + length])
    document["images"] = [{"uri": "../secret.png"}]
    document["textures"] = [{"source": 0}]
    document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    size = (20 + len(text) + len(content[20 + length :])).to_bytes(4, "little")
    head = b"glTF" + (2).to_bytes(4, "little") + size + len(text).to_bytes(4, "little") + b"JSON"
    (folder / "c.glb").write_bytes(head + text + content[20 + length :])
    shutil.copy(seeds.exr(folder.parent / "pictures")[0].entry, folder / "d.exr")
    for name in ("e.usda", "f.usda"):
        (folder / name).write_text(_HEAD + _TRIANGLE)
    out = 'def "r" (references = @../secret.usda@</secret>) {\n}\n'
    (folder / "g.usda").write_text(_HEAD + _TRIANGLE + out)
    inner = f'#usda 1.0\ndef "r" (references = @{folder.parent}/secret.usda@</secret>) {{\n}}\n'
    root = _HEAD + _TRIANGLE + 'def "r" (references = @./sub.usda@</r>) {\n}\n'
    seeds.package(folder / "h.usdz", {"root.usda": root.encode(), "sub.usda": inner.encode()})
    # What would be loaded if USD looked for plug-ins beside its files.
    plugin = {"Plugins": [{"Type": "library", "Name": "evil", "LibraryPath": "evil.so"}]}
    (folder / "plugInfo.json").write_text(json.dumps(plugin))


@pytest.mark.fault("S1")
@pytest.mark.fault("S3")
@pytest.mark.skipif(_STRACE is None, reason="strace is not installed")
def test_children_open_the_capture_and_their_own_libraries_alone(tmp_path):
    _capture(tmp_path / "capture")
    trace = tmp_path / "trace"
    command = [str(_STRACE), "-f", "-s", "300", "-e", f"trace={_CALLS}", "-o", str(trace)]
    command += [sys.executable, "-c", _READ, str(tmp_path / "capture")]
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if "ptrace" in done.stderr or not trace.is_file():
        pytest.skip("strace may not trace here")
    said = dict(line.split() for line in done.stdout.splitlines())
    assert said == {
        "a.ply": "read", "b.obj": "paths.outside", "c.glb": "paths.outside", "d.exr": "read",
        "e.usda": "read", "f.usda": "read", "g.usda": "paths.outside", "h.usdz": "paths.outside",
    }, done.stderr  # fmt: skip
    strangers = _strangers(trace.read_text("utf-8", "replace"), tmp_path / "capture")
    assert strangers == set()
    assert "evil.so" not in trace.read_text("utf-8", "replace")


def _strangers(trace: str, capture: Path) -> set[str]:
    """What children did that is neither reading their capture and libraries nor writing into their
    own temporary folder. A child is what began with a program of its own."""
    libraries = {
        *("/usr", "/lib", "/proc", "/sys", "/etc/ld.so.cache", "/dev/null", "/dev/urandom"),
        *(sys.prefix, sys.base_prefix, str(Path(__file__).parents[2]), *sys.path),
    }
    readable = (str(capture), *(os.path.realpath(p) for p in libraries if p))
    scratch = os.path.join(os.path.realpath(tempfile.gettempdir()), PREFIX)
    first = trace.split(None, 1)[0]
    children, found = set[str](), set[str]()
    for line in trace.splitlines():
        process, _, call = line.partition(" ")
        call = call.strip()
        if call.startswith("execve(") and process != first and "child import main" in call:
            children.add(process)
            continue
        told = not call.startswith(("<...", "+++", "---"))  # where a call ends, and signals
        if process not in children or " = -1 " in call or not told:
            continue
        if begun := re.match(r"(?:clone3?|v?fork)\(.* = (\d+)$", call):
            children.add(begun[1])  # a thread of it, or what it starts
            continue
        name = re.search(r'"([^"]*)"', call)
        path = os.path.realpath(name[1]) if name and name[1].startswith("/") else ""
        relative = name is not None and not name[1].startswith("/")  # to the scratch folder
        writes = re.search(_WRITES, call)
        if call.startswith(("socket", "connect", "execve")):
            allowed = "AF_UNIX" in call
        elif writes:
            allowed = relative or path.startswith((scratch, "/dev/null"))
        else:
            allowed = relative or any(p.startswith((scratch, *readable)) for p in (path, name[1]))
        if not allowed:
            found.add(call)
    assert children, "no child was seen"
    return found
