"""validate --fix: cures go into a new layer and nowhere else, and work where it is put."""

import errno
import resource
import signal
from dataclasses import replace

import pytest
from pxr import Sdf, Usd

from tests.fault_injection import inject
from tests.validation.faults import CHAIR, FAULTS, SURFACE, Types, edited, opinion
from usdbrdf.errors import EnvironmentFailure, UsageError
from usdbrdf.validation.validate import open_or_finding, own_findings, write_cures

CURABLE = ("CameraExposure", "SpecularColor", "LobeMatchesFit", "LookSelection", "EmitterAlbedo")


def test_cures_of_several_faults_take_effect_as_the_first_sublayer(built):
    for name in CURABLE:
        FAULTS[name](built)
    FAULTS["OrphanTexture"](built)  # has no cure
    asset = built.asset
    files = {p: p.read_bytes() for p in asset.folder.rglob("*") if p.is_file()}
    cured = write_cures(asset, asset.folder / "fixes.usda")
    assert {finding.rule for finding in cured.findings} == {f"usdbrdf.{name}" for name in CURABLE}
    assert files == {p: p.read_bytes() for p in files}, "no other file is touched"
    new = {p for p in asset.folder.rglob("*") if p.is_file()} - set(files)
    assert new == {asset.folder / "fixes.usda"}
    with edited(asset.root_layer) as root:
        root.subLayerPaths.insert(0, "./fixes.usda")
    remaining = own_findings(Usd.Stage.Open(str(asset.root_layer)))
    assert [finding.rule for finding in remaining] == ["usdbrdf.OrphanTexture"]


def test_equal_faults_give_equal_bytes(built):
    FAULTS["LookMaterial"](built)
    texts = []
    for name in ("one.usda", "two.usda"):
        write_cures(built.asset, built.asset.folder / name)
        texts.append((built.asset.folder / name).read_bytes())
    assert texts[0] == texts[1]
    assert str(built.asset.folder).encode() not in texts[0]


def test_nothing_is_written_where_nothing_can_be_cured(built):
    FAULTS["OrphanTexture"](built)
    before = sorted(built.asset.folder.rglob("*"))
    assert write_cures(built.asset, built.asset.folder / "fixes.usda").findings == ()
    assert sorted(built.asset.folder.rglob("*")) == before


def test_a_record_that_was_edited_is_as_measured_again(built):
    """The material does not follow what somebody wrote about the measurement."""
    built.fitted = tuple(replace(item, mapping="matched") for item in built.fitted)
    built.write_layer("material")
    asset = built.asset
    numbers = [f"{SURFACE}.inputs:{name}" for name in ("roughness", "ior")]
    numbers.append("/room/geo/Stuhl_No_1/mtl/Stuhl_No_1/BaseColorTexture.inputs:scale")
    record = [f"{CHAIR}.usdBrdf:fit:{name}" for name in ("phi", "psi", "mapping")]
    sound = _values(asset, *numbers, *record)
    FAULTS["LobeMatchesFit"](built)
    opinion(built, CHAIR, "usdBrdf:fit:psi", Types.Float, 1.0)
    opinion(built, CHAIR, "usdBrdf:fit:mapping", Types.Token, "measured")
    cured = write_cures(asset, asset.folder / "fixes.usda")
    assert {finding.rule for finding in cured.findings} == {"usdbrdf.LobeMatchesFit"}
    with edited(asset.root_layer) as root:
        root.subLayerPaths.insert(0, "./fixes.usda")
    assert _values(asset, *numbers, *record) == sound
    assert own_findings(Usd.Stage.Open(str(asset.root_layer))) == []


def test_a_material_of_ours_that_was_edited_follows_the_record_and_the_artist_stays(built):
    asset = built.asset
    roughness, ior = (f"{SURFACE}.inputs:{name}" for name in ("roughness", "ior"))
    sound = _values(asset, roughness)
    with edited(asset.layer("material")) as layer:
        layer.GetAttributeAtPath(roughness).default = 0.9
    opinion(built, SURFACE, "inputs:ior", Types.Float, 1.2)
    write_cures(asset, asset.folder / "fixes.usda")
    with edited(asset.root_layer) as root:
        root.subLayerPaths.insert(0, "./fixes.usda")
    assert _values(asset, roughness) == pytest.approx(sound)
    assert _values(asset, ior) == [pytest.approx(1.2)]


def _values(asset, *paths):
    stage = Usd.Stage.Open(str(asset.root_layer))
    return [stage.GetAttributeAtPath(path).Get() for path in paths]


@pytest.mark.parametrize(
    ("place", "code"),
    [
        ("edits.usda", "[fix.exists]"),
        ("layers/material.usda", "[fix.exists]"),
        ("layers/fixes.usda", "[fix.place]"),
        ("textures/fixes.usda", "[fix.place]"),
        ("fixes.usdc", "[fix.suffix]"),
    ],
)
def test_cures_are_refused_a_place_that_is_somebodys(built, place, code):
    FAULTS["LookMaterial"](built)
    with pytest.raises(UsageError) as refused:
        write_cures(built.asset, built.asset.folder / place)
    assert code in str(refused.value)


def test_a_file_that_appears_meanwhile_is_kept(built, monkeypatch):
    FAULTS["LookMaterial"](built)
    layer = built.asset.folder / "fixes.usda"

    def open_late(root_layer):
        layer.write_text("somebody's")
        return open_or_finding(root_layer)

    monkeypatch.setattr("usdbrdf.validation.validate.open_or_finding", open_late)
    with pytest.raises(UsageError, match=r"\[fix\.exists\]"):
        write_cures(built.asset, layer)
    assert layer.read_text() == "somebody's"
    assert not list(layer.parent.glob(".tmp-*"))


def test_a_disk_that_is_full_leaves_no_name_behind(built, monkeypatch):
    FAULTS["LookMaterial"](built)
    inject("enospc@publish:before_replace", monkeypatch)
    with pytest.raises(EnvironmentFailure, match="No space left"):
        write_cures(built.asset, built.asset.folder / "fixes.usda")
    assert not list(built.asset.folder.glob("*fixes*"))
    assert not list(built.asset.folder.glob(".tmp-*"))


@pytest.mark.fault("R1")
def test_a_disk_that_takes_none_of_it_is_said(built, monkeypatch):
    FAULTS["LookMaterial"](built)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def open_then_full(root_layer):
        stage = open_or_finding(root_layer)
        resource.setrlimit(resource.RLIMIT_FSIZE, (10, limits[1]))
        return stage

    monkeypatch.setattr("usdbrdf.validation.validate.open_or_finding", open_then_full)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        with pytest.raises(EnvironmentFailure, match=r"fixes.usda: USD could .+\[environment\.io"):
            write_cures(built.asset, built.asset.folder / "fixes.usda")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert not list(built.asset.folder.glob("*fixes*"))


def test_file_systems_without_hard_links_will_do(built, monkeypatch):
    FAULTS["LookMaterial"](built)

    def none(*_arguments, **_options):
        raise OSError(errno.ENOTSUP, "not supported")

    monkeypatch.setattr("os.link", none)
    layer = built.asset.folder / "fixes.usda"
    assert write_cures(built.asset, layer).findings
    assert Sdf.Layer.FindOrOpen(str(layer)).rootPrims


def test_the_fault_is_the_artists_to_keep(built):
    FAULTS["LobeMatchesFit"](built)
    text = built.asset.edits_layer.read_text()
    write_cures(built.asset, built.asset.folder / "fixes.usda")
    assert built.asset.edits_layer.read_text() == text
    assert not Sdf.Layer.FindOrOpen(str(built.asset.edits_layer)).dirty
