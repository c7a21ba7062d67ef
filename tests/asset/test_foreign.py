"""Layers that somebody else wrote: values of another type are refused in a sentence."""

from __future__ import annotations

import errno
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from pxr import Gf, Sdf, Vt

from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layers.interface import NEEDS, needs_too
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_edited, open_measured, open_stage
from usdbrdf.asset.readers.foreign import refuses_foreign
from usdbrdf.asset.readers.scene import (
    frames_from_stage,
    hashes_of_photographs,
    read_aovs,
    read_fit,
    read_shading,
    read_unwrapped,
    scene_from_stage,
)
from usdbrdf.errors import EnvironmentFailure, InputRefused, UsageError
from usdbrdf.files.atomic import sha256_of
from usdbrdf.job.stamp import stamp_of, stamp_path, write_stamp

TYPES = Sdf.ValueTypeNames
OTHERS = {
    "gone": (None, None),
    "text": (TYPES.String, "x"),
    "number": (TYPES.Int, -1),
    "numbers": (TYPES.IntArray, Vt.IntArray([5, 7, 9])),
    "path": (TYPES.Asset, Sdf.AssetPath("../../../x")),
    "vector": (TYPES.Float3, Gf.Vec3f(float("nan"))),
}
ATTRIBUTES = {
    "scan": (
        "points", "faceVertexCounts", "faceVertexIndices", "normals", "xformOp:transform",
        "usdBrdf:label", "usdBrdf:capture:exposureTime", "usdBrdf:capture:pinhole",
        "usdBrdf:capture:resolution", "usdBrdf:capture:noiseFloorRadiance",
    ),
    "texturing_uv": ("primvars:st",),
    "texturing": ("usdBrdf:texturing:resolution", "usdBrdf:aov:lit:file", "usdBrdf:aov:lit:scale"),
    "shading": ("usdBrdf:shading:raysPerTexel", "usdBrdf:aov:irradiance:unit"),
    "material": ("usdBrdf:fit:status", "usdBrdf:fit:phi"),
}  # fmt: skip
CASES = [(role, name) for role, names in ATTRIBUTES.items() for name in names]


@pytest.fixture(scope="module")
def room(tmp_path_factory, synthetic):
    folder = tmp_path_factory.mktemp("foreign")
    return synthetic.build(folder / "room", synthetic.make_scan(folder / "capture")).asset


def file_of(asset, role):
    return asset.uv_layer if role == "texturing_uv" else asset.layer(role)


def look(asset):
    """All that a step or a report asks the stage for; how many refused."""
    stage, refused = open_measured(asset), []

    def objects():
        for one in scene_from_stage(stage).objects:
            for read in (read_shading, read_fit, read_aovs, read_unwrapped):
                read(stage, one.prim_path)

    def photographs():
        frames_from_stage(stage)
        hashes_of_photographs(stage)

    for ask in (objects, photographs):
        try:
            ask()
        except InputRefused as error:
            refused.append(str(error))
    return refused


@pytest.mark.fault("S8")
@pytest.mark.parametrize(("role", "name"), CASES)
def test_a_value_of_another_type_is_refused_or_passed_over(room, role, name):
    file = file_of(room, role)
    sound = file.read_bytes()
    changed = 0
    try:
        for kind, value in OTHERS.values():
            layer = Sdf.Layer.OpenAsAnonymous(str(file))
            places = []
            layer.Traverse(
                Sdf.Path.absoluteRootPath,
                lambda path, found=places: path.name == name and found.append(path),
            )
            for place in places:
                spec = layer.GetAttributeAtPath(place)
                if spec is None:
                    continue
                prim, times = spec.owner, layer.ListTimeSamplesForPath(place)
                prim.RemoveProperty(spec)
                changed += 1
                if kind is None:
                    continue
                spec = Sdf.AttributeSpec(prim, name, kind)
                for time in times:
                    layer.SetTimeSample(place, time, value)
                if not times:
                    spec.default = value
            layer.Export(str(file))
            for sentence in look(room):
                assert "[" in sentence
                assert "\n" not in sentence
    finally:
        file.write_bytes(sound)
    assert changed
    assert not look(room)


@pytest.mark.fault("S8")
@pytest.mark.parametrize(
    "record",
    [
        "x",
        5,
        {"parameters": "x", "inputs": 3, "lightings": 7},
        {"lightings": Vt.StringArray(["../../x", "b"])},
        {"lightings": Vt.StringArray(["a/b"])},
        {"lightings": "ab"},
    ],
)
def test_a_record_of_another_kind_says_nothing(room, record):
    """Names of lightings are parts of paths that steps write to."""
    file = room.layer("scan")
    sound = file.read_bytes()
    layer = Sdf.Layer.OpenAsAnonymous(str(file))
    layer.customLayerData = {"usdbrdf": record}
    try:
        layer.Export(str(file))
        assert room.lightings == ()
        with pytest.raises(UsageError):
            room.in_lighting("../../x")
        told = read_provenance(file)
        assert all(isinstance(told.get(key, {}), dict) for key in ("parameters", "inputs"))
        assert not look(room)
    finally:
        file.write_bytes(sound)


def test_a_stumble_over_what_we_wrote_ourselves_is_no_fault_of_the_file(room, monkeypatch):
    """That the layers are not what usdbrdf writes would be untrue, and hide where the defect is."""

    def stumbles(stage):
        raise KeyError("of ours")

    monkeypatch.setattr("usdbrdf.asset.readers.scene.capture_camera", stumbles)
    stage = open_measured(room)
    record = stamp_path(room.folder, 1, "ingest")
    record.parent.mkdir(parents=True)
    files = sorted((room.folder / "layers").iterdir())
    hashes = {file.relative_to(room.folder).as_posix(): sha256_of(file) for file in files}
    stamp = replace(stamp_of("ingest", {}, {}), outputs=hashes)
    try:
        write_stamp(record, stamp)
        with pytest.raises(KeyError, match="of ours"):
            frames_from_stage(stage)
        # One of the bytes is another than the step wrote, or the step was another version's.
        scan = room.layer("scan").relative_to(room.folder).as_posix()
        changed = replace(stamp, outputs=hashes | {scan: "0" * 64})
        for other in (changed, replace(stamp, version="0.0.1")):
            write_stamp(record, other)
            with pytest.raises(InputRefused, match=r"KeyError: 'of ours'.*\[stage.content\]"):
                frames_from_stage(stage)
    finally:
        record.unlink()
        record.parent.rmdir()
        (room.folder / ".usdbrdf").rmdir()


@pytest.mark.parametrize(
    ("edits", "said"),
    [
        (
            "#usda 1.0\nover {",
            r"USD cannot read this layer \(.*edits\.usda:2:\d+: .*\)\. Correct it",
        ),
        (None, r"this layer, which \S+\.usda names, is missing\. Bring it back"),
    ],
)
def test_a_layer_that_cannot_be_read_is_what_the_sentence_is_about(room, edits, said):
    """Neither the root layer that names it, nor what USD's parser calls its rules."""
    sound = room.edits_layer.read_text()
    try:
        if edits is None:
            room.edits_layer.unlink()
        else:
            room.edits_layer.write_text(edits)
        with pytest.raises(
            InputRefused, match=rf"^{re.escape(str(room.edits_layer))}: {said}"
        ) as it:
            open_edited(room)
        assert "pxrInternal" not in str(it.value)
    finally:
        room.edits_layer.write_text(sound)


def test_a_layer_that_one_may_not_read_is_no_damage(room, monkeypatch):
    sound = room.edits_layer.read_text()

    def forbidden(self, *_):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))

    try:
        # USD says the same of a layer that it may not read.
        room.edits_layer.write_text("")
        monkeypatch.setattr(Path, "open", forbidden)
        with pytest.raises(EnvironmentFailure, match=r"edits\.usda: Permission denied"):
            open_stage(room.root_layer)
    finally:
        monkeypatch.undo()
        room.edits_layer.write_text(sound)


def test_a_reader_for_which_there_is_no_thread_blames_no_layer(room):
    @refuses_foreign("nothing")
    def read(stage):
        raise RuntimeError("can't start new thread")

    with pytest.raises(EnvironmentFailure, match=r"\[environment\.processes\]$"):
        read(open_measured(room))


@pytest.mark.parametrize("edit", ["gone", "no prim", "text", "numbers", "broken"])
def test_an_interface_that_was_edited_by_hand_is_named(room, tmp_path, edit):
    """And adopted: a later step adds to what it says."""
    folder = tmp_path / "room"
    shutil.copytree(room.folder, folder)
    asset = Asset.made(folder)
    file = asset.interface("scan")
    layer = Sdf.Layer.OpenAsAnonymous(str(file))
    path = layer.rootPrims[0].path
    told = {"text": "x", "numbers": Vt.IntArray([1, 2])}
    if edit in told:
        layer.rootPrims[0].SetInfo("assetInfo", {NEEDS: told[edit]})
    elif edit == "no prim":
        layer = Sdf.Layer.CreateAnonymous()
    layer.Export(str(file))
    if edit == "gone":
        file.unlink()
    elif edit == "broken":
        file.write_text("#usda 1.0\ndef {")
    own = Sdf.Layer.CreateAnonymous()  # a prim lives as long as its layer
    root = Sdf.CreatePrimInLayer(own, path)
    with pytest.raises(InputRefused, match=rf"^{re.escape(str(file))}: .*\[stage\.content\]$"):
        needs_too(root, asset, [Path("a.usdc")])
    assert not root.HasInfo("assetInfo")
