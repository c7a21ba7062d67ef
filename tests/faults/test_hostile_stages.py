"""USD files that were made to do harm: paths that lead elsewhere, values of types that their
attributes cannot have; and what looks like such a one and is sound."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.faults.test_hostile_files import _refused
from tests.fuzzing.seeds import package
from usdbrdf.relighting.relit_scene import _scene_of_others
from usdbrdf.untrusted.usd_cameras import cameras_from_usd
from usdbrdf.untrusted.usd_files import meshes_from_usd

# --- Stages that lead elsewhere -------------------------------------------------------------------

_TRIANGLE = """def Mesh "m" {
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
}
"""
_HEAD = '#usda 1.0\n(\n defaultPrim = "m"\n)\n'
_SECRET = '#usda 1.0\ndef Xform "secret" {\n double secret = 3\n}\n'


def _referring(path: str) -> str:
    return f'#usda 1.0\ndef "r" (references = @{path}@</secret>) {{\n}}\n'


def _packed(folder: Path, inner: str) -> Path:
    """A package whose root layer refers to another one in it."""
    root = _HEAD + _TRIANGLE + 'def "r" (references = @./sub.usda@</r>) {\n}\n'
    entries = {"root.usda": root.encode(), "sub.usda": _referring(inner).encode()}
    return package(folder / "a.usdz", entries)


def _packed_absolute(folder: Path) -> Path:
    return _packed(folder, str(folder.parent / "secret.usda"))


def _packed_twice(folder: Path) -> Path:
    content = _packed_absolute(folder).read_bytes()
    root = _HEAD + _TRIANGLE + 'def "r" (references = @inner.usdz@</m>) {\n}\n'
    return package(folder / "b.usdz", {"root.usda": root.encode(), "inner.usdz": content})


def _packed_and_referred_to(folder: Path) -> Path:
    _packed_absolute(folder)
    path = folder / "b.usda"
    path.write_text(_HEAD + _TRIANGLE + 'def "r" (references = @a.usdz[sub.usda]@</r>) {\n}\n')
    return path


def _variable_of_a_stronger_layer(folder: Path) -> Path:
    """What the layer says of itself leads to its neighbour, what is composed leads out."""
    (folder / "inner.usda").write_text(_SECRET)
    own = 'expressionVariables = {{\n string X = "{}"\n}}\n'
    referring = _referring('`"${X}"`').replace(
        "#usda 1.0\n", f"#usda 1.0\n(\n{own.format('inner.usda')})\n"
    )
    (folder / "b.usda").write_text(referring)
    head = _HEAD.replace(")\n", own.format("../secret.usda") + ")\n")
    path = folder / "a.usda"
    path.write_text(head + _TRIANGLE + 'def "r" (references = @b.usda@</r>) {\n}\n')
    return path


def _with(arc: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / "a.usda").write_text(f'{_HEAD}{_TRIANGLE}def "r" ({arc}) {{\n}}\n')
        return folder / "a.usda"

    return write


def _searched_in_a_package(folder: Path) -> Path:
    return _packed(folder, "x/../../secret.usda")


def _searched_from_the_root(folder: Path) -> Path:
    """Beside the layer there is no such thing, two folders above the root's there would be."""
    (folder / "s1" / "s2").mkdir(parents=True)
    (folder / "s1" / "s2" / "d.usda").write_text(_referring("x/../../secret.usda"))
    return _with("references = @./s1/s2/d.usda@</r>")(folder)


def _beside_a_package(folder: Path) -> Path:
    (folder / "evil.usda").write_text(_referring(str(folder.parent / "secret.usda")))
    root = _HEAD + _TRIANGLE + 'def "r" (references = @./sub.usda@</r>) {\n}\n'
    sub = '#usda 1.0\ndef "r" (references = @evil.usda@</r>) {\n}\n'
    return package(folder / "a.usdz", {"root.usda": root.encode(), "sub.usda": sub.encode()})


def _searched_in_a_package_outside(folder: Path) -> Path:
    package(folder.parent / "secret.usdz", {"secret.usda": _SECRET.encode()})
    return _packed(folder, "x/../../secret.usdz[secret.usda]")


_CLIP = 'clips = {{\n dictionary default = {{\n {}\n string primPath = "/secret"\n}}\n}}'
STAGES: dict[str, Callable[[Path], Path]] = {
    "absolute path in a package": _packed_absolute,
    "absolute path in a package in a package": _packed_twice,
    "absolute path in a package that a layer refers to": _packed_and_referred_to,
    "variable of a stronger layer": _variable_of_a_stronger_layer,
    "search in a package": _searched_in_a_package,
    "search from the root's folder": _searched_from_the_root,
    "layer beside a package": _beside_a_package,
    "package outside, searched for in a package": _searched_in_a_package_outside,
    "expression": _with('references = @`"../secret.usda"`@</secret>'),
    "payload": _with("payload = @../secret.usda@</secret>"),
    "arguments of a format": _with("references = @../secret.usda:SDF_FORMAT_ARGS:a=b@</secret>"),
    "clip": _with(
        _CLIP.format("asset[] assetPaths = [@../secret.usda@]\n double2[] active = [(0, 0)]")
    ),
    "template of clips": _with(
        _CLIP.format('string templateAssetPath = "../secret.#.usda"\n'
                     "double templateStartTime = 1\n"
                     "double templateEndTime = 2\n double templateStride = 1")
    ),
    "URL": _with("references = @http://localhost:9/secret.usda@</secret>"),
    "format of a plug-in": _with("payload = @x.evil@</secret>"),
}  # fmt: skip


@pytest.mark.fault("S1")
@pytest.mark.fault("S3")
@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_that_leads_out_is_refused(tmp_path, stage):
    (tmp_path / "capture").mkdir()
    for name in ("secret.usda", "secret.1.usda", "secret.2.usda"):
        (tmp_path / name).write_text(_SECRET)
    path = STAGES[stage](tmp_path / "capture")
    message = _refused(meshes_from_usd, path, tmp_path)
    assert re.search(r"\[(paths\.(outside|variables)|stage\.input)\]$", message)


def test_a_package_of_several_layers_is_read(tmp_path):
    """What is refused above is not that there are several."""
    sub = _referring("more/secret.usda").encode()
    root = (_HEAD + _TRIANGLE + 'def "r" (references = @./sub.usda@</r>) {\n}\n').encode()
    entries = {"root.usda": root, "sub.usda": sub, "more/secret.usda": _SECRET.encode()}
    found = meshes_from_usd(package(tmp_path / "a.usdz", entries))
    assert len(found.mesh.triangles) == 1


_PICTURE = 'def Shader "s" {{\n asset inputs:file = @{}@\n}}\n'
_INSIDE: dict[str, dict[str, str]] = {
    "a layer that nothing refers to": {"root.usda": _HEAD + _TRIANGLE, "old.usda": "no USD"},
    "a picture that was elsewhere": {
        "root.usda": _HEAD + _TRIANGLE + _PICTURE.format("/Users/me/tex/a.png")
    },
    "a shader of a URL": {
        "root.usda": _HEAD + _TRIANGLE + 'def "r" (references = @./s.usda@</s>) {\n}\n',
        "s.usda": "#usda 1.0\n" + _PICTURE.format("https://localhost:9/a.mdl"),
    },
    "a root layer in a folder": {
        "Scene/root.usda": _HEAD + _TRIANGLE + _PICTURE.format("../textures/a.png"),
        "textures/a.png": "x",
    },
}


@pytest.mark.parametrize("kind", _INSIDE)
def test_a_package_with_what_leads_nowhere_is_read(tmp_path, kind):
    entries = {name: text.encode() for name, text in _INSIDE[kind].items()}
    path = package(tmp_path / "a.usdz", entries)
    assert len(meshes_from_usd(path).mesh.triangles) == 1


def test_variables_that_no_path_holds_are_no_matter(tmp_path):
    head = _HEAD.replace(")\n", 'expressionVariables = {\n string X = "x"\n}\n)\n')
    (tmp_path / "a.usda").write_text(head + _TRIANGLE)
    assert len(meshes_from_usd(tmp_path / "a.usda").mesh.triangles) == 1


@pytest.mark.parametrize(
    "other",
    ["", "token visibility = 'invisible'\n", 'uniform token purpose = "guide"\n'
     "int[] faceVertexCounts = [2]\n int[] faceVertexIndices = [0, 1]\n"
     "point3f[] points = [(0, 0, 0), (1, 0, 0)]\n"],
    ids=["empty", "hidden", "guide"],
)  # fmt: skip
def test_a_mesh_that_is_not_rendered_stops_no_scene(tmp_path, other):
    text = f'{_HEAD}def "m" {{\n{_TRIANGLE}def Mesh "e" {{\n{other}}}\n}}\n'
    (tmp_path / "a.usda").write_text(text)
    assert len(_scene_of_others(tmp_path / "a.usda", ()).surfaces) == 1


@pytest.mark.parametrize("value", ['string[] semantics:labels:class = ["wall"]',
                                   'string semantics:labels:class = "wall"'])  # fmt: skip
def test_labels_may_be_strings(tmp_path, value):
    text = _TRIANGLE.replace("point3f", f"{value}\n    point3f")
    (tmp_path / "a.usda").write_text(_HEAD + text)
    (found,) = meshes_from_usd(tmp_path / "a.usda").objects
    assert found.class_name == "wall"


# --- Values of types that their attributes cannot have --------------------------------------------

_TYPES = {
    "points": (_TRIANGLE.replace("point3f[] points", "double[] points").replace(
        "[(0, 0, 0), (1, 0, 0), (0, 1, 0)]", "[1, 2, 3, 4]"), "mesh.topology"),
    "points of a type that nobody knows": (
        _TRIANGLE.replace("point3f[]", "vector9q[]"), "mesh.topology"
    ),
    "indices beyond 32 bits": (
        _TRIANGLE.replace("int[] faceVertexIndices = [0, 1, 2]",
                          "int64[] faceVertexIndices = [0, 1, 99999999999]"), "mesh.topology"
    ),
    "counts of one number": (
        _TRIANGLE.replace("int[] faceVertexCounts = [3]", "int faceVertexCounts = 3"),
        "mesh.topology",
    ),
    "indices in pairs": (
        _TRIANGLE.replace("int[] faceVertexIndices = [0, 1, 2]",
                          "int2[] faceVertexIndices = [(0, 1), (2, 0)]"), "mesh.topology"
    ),
    "indices that would wrap round": (
        _TRIANGLE.replace("int[] faceVertexIndices = [0, 1, 2]",
                          "int64[] faceVertexIndices = [0, 1, 4294967298]"), "mesh.topology"
    ),
    "one hole": (_TRIANGLE.replace("point3f", "int holeIndices = 0\n    point3f"), ""),
    "normals": (_TRIANGLE.replace("point3f", "string normals = 'up'\n    point3f"), ""),
    "labels": (
        _TRIANGLE.replace("point3f", "double semantics:labels:class = 3\n    point3f"), ""
    ),
}  # fmt: skip


@pytest.mark.fault("G2")
@pytest.mark.parametrize("kind", _TYPES)
@pytest.mark.parametrize("read", [meshes_from_usd, _scene_of_others])
def test_a_value_of_another_type_ends_in_a_sentence_or_counts_as_none(tmp_path, read, kind):
    text, rule = _TYPES[kind]
    (tmp_path / "a.usda").write_text(_HEAD + text)
    read_it = read if read is meshes_from_usd else lambda path: _scene_of_others(path, ())
    if rule:
        assert f"[{rule}]" in _refused(read_it, tmp_path / "a.usda", tmp_path)
    else:
        read_it(tmp_path / "a.usda")


def test_a_back_plate_that_is_no_path_is_none(tmp_path):
    camera = 'def Camera "c" {\n custom string backPlate:a:image = "x.exr"\n}\n'
    (tmp_path / "a.usda").write_text(_HEAD + _TRIANGLE + camera)
    (found,) = cameras_from_usd(tmp_path / "a.usda").cameras
    assert found.images == ("",)


def test_a_back_plate_that_is_not_there_is_an_absolute_path(tmp_path):
    camera = 'def Camera "c" {\n asset backPlate:a:image = @x.exr@\n}\n'
    (tmp_path / "a.usda").write_text(_HEAD + _TRIANGLE + camera)
    (found,) = cameras_from_usd(tmp_path / "a.usda").cameras
    assert found.images == (str(tmp_path / "x.exr"),)
    (tmp_path / "a.usda").write_text(_HEAD + _TRIANGLE + camera.replace("x.", "x/../../x."))
    assert "[paths.outside]" in _refused(cameras_from_usd, tmp_path / "a.usda", tmp_path)
