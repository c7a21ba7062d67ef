"""The rooms that `benchmarks/redraw_room.py` draws, and the table that `benchmarks/rooms.py`
prints."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
pytest.importorskip("mitsuba")

import redraw_room
import rooms
import true_room

from usdbrdf.relighting.render import mitsuba_variant

# Mitsuba's descriptions of a plastic and of a metal, cut short.
PLASTIC = (
    "RoughPlastic[\n diffuse_reflectance = SRGBReflectanceSpectrum[\n value = [[0.5, 0.4, 0.3]]"
)
GLASS = (
    "SmoothDielectric[\n specular_transmittance = SRGBReflectanceSpectrum[\n value = [[0, 0, 0]]"
)


def _room(kinds: list[str]) -> Any:
    """A room with objects of these kinds, all of one size, the last of them a lamp."""
    names = [f"thing_{k}" for k in range(len(kinds))]
    materials = [
        {"name": name, "kind": kind, "emitter": name == names[-1], "textured": False}
        for name, kind in zip(names, kinds, strict=True)
    ]
    described = dict.fromkeys(names, PLASTIC)
    area = dict.fromkeys(names, 1.0)
    return SimpleNamespace(materials=materials, described=described, area=area, seen={})


def test_materials_are_drawn_from_what_is_said():
    kinds = ["dielectric_coated"] * 400 + ["metal"] * 400 + ["glass", "mask", "diffuse", "diffuse"]
    drawn = redraw_room.redrawn(_room(kinds), np.random.default_rng(3), coated=0.0, metals=0.0)
    assert [one["kind"] for one in drawn] == kinds
    coated = [one for one in drawn if one["kind"] == "dielectric_coated"]
    phi, psi = (np.array([one[key] for one in coated]) for key in ("phi", "psi"))
    assert phi.min() >= 0.02
    assert phi.max() <= 0.6
    # Log-uniform: half of them below the geometric mean.
    assert np.mean(phi < np.sqrt(0.02 * 0.6)) == pytest.approx(0.5, abs=0.1)
    assert psi.min() >= 0.1
    assert psi.max() <= 1
    assert psi.mean() == pytest.approx(0.55, abs=0.05)
    f0 = np.array([one["f0"] for one in drawn if one["kind"] == "metal"])
    assert f0.min() >= 0.15
    assert f0.max() <= 0.97
    assert np.ptp(f0, axis=1).mean() > 0.1
    assert all(one["albedo"] == [0.5, 0.4, 0.3] for one in drawn)


def test_some_become_coated_and_metal_but_no_lamp_and_nothing_large():
    room = _room(["diffuse"] * 200 + ["dielectric_coated"] * 200 + ["diffuse"])
    drawn = redraw_room.redrawn(room, np.random.default_rng(0), coated=0.5, metals=0.5)
    kinds = [one["kind"] for one in drawn]
    assert kinds[:200].count("dielectric_coated") == pytest.approx(100, abs=30)
    assert kinds[200:400].count("metal") == pytest.approx(100, abs=30)
    assert kinds[-1] == "diffuse"
    # The same seed draws the same.
    assert drawn == redraw_room.redrawn(room, np.random.default_rng(0), coated=0.5, metals=0.5)
    room.area["thing_300"] = 1e4
    large = redraw_room.redrawn(room, np.random.default_rng(0), coated=0.5, metals=1.0)[300]
    assert large["kind"] == "dielectric_coated"


def test_a_metal_has_its_f0():
    f0 = np.linspace(0.15, 0.97, 20)
    eta, k = redraw_room.complex_ior(f0)
    assert ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2) == pytest.approx(f0, abs=1e-6)
    assert (k > 0).all()


def test_what_a_plastic_reflects_agrees_with_another_s_quadrature():
    # Of a plastic with alpha = 0.1, index of refraction 1.5, whose truth somebody else wrote.
    told = [0.0, 0.0411, 0.0872, 0.1395, 0.1991, 0.2679, 0.3479, 0.4424, 0.5555, 0.6934, 0.8653]
    mi = mitsuba_variant()
    if mi.variant().startswith("scalar"):
        pytest.skip("no LLVM library")
    assert redraw_room.reflected(mi, 0.1, 0.5) == pytest.approx(told, abs=0.004)


def test_numbers_of_a_description():
    assert true_room.number_after(PLASTIC, "reflectance") == [0.5, 0.4, 0.3]
    assert true_room.number_after(GLASS, "specular_transmittance") == [0.0, 0.0, 0.0]
    assert true_room.number_after("BitmapTexture[ name = a.jpg ]", "reflectance") is None


def test_pixels_at_a_rim_do_not_count():
    objects = np.zeros((5, 6), int)
    objects[:, 4:] = 1
    objects[0, 0] = -1
    alone = true_room.of_one_object(objects)
    assert np.argwhere(alone).tolist() == [[1, 2], [2, 1], [2, 2], [3, 1], [3, 2]]


def _object(**facts: Any) -> rooms.RoomObject:
    plain = rooms.RoomObject(
        room="r", name="o", kind="dielectric_coated", emitter=False, true_phi=0.1, true_psi=0.5,
        true_f0=None, pixels=300, status="measured", phi=0.1, psi=0.5, phi_error=0.01,
        psi_error=0.1, metallic=False, colour=None, evidence=0.8, samples=500,
    )  # fmt: skip
    return rooms.RoomObject(**{**vars(plain), **facts})


def test_the_table_counts_what_it_says():
    metal = {"kind": "metal", "true_f0": [0.9, 0.8, 0.7]}
    found = rooms.materials(
        [
            _object(true_psi=0.2, psi=0.35, phi=0.115),
            _object(true_psi=0.5, psi=0.55),
            _object(true_psi=0.8, psi=0.75, phi=0.13),
            _object(status="undetermined", psi=0.9),
            _object(kind="diffuse", psi=0.02, status="undetermined"),
            _object(kind="diffuse", psi=0.9, pixels=100),
            _object(kind="glass", metallic=True),
            _object(**metal, metallic=True, colour=[0.8, 0.8, 0.8]),
            _object(**metal),
            _object(**metal, pixels=100),
            _object(**{**metal, "true_f0": [0.1, 0.8, 0.7]}),
        ]
    )
    assert (found["measured"], found["coated"]) == (3, 4)
    lobes = found["lobes"]
    assert lobes["phi_error"] == pytest.approx((0.015 + 0.03) / 3)
    assert lobes["psi_error"] == pytest.approx((0.15 + 0.05 + 0.05) / 3)
    assert lobes["psi_signed"] == pytest.approx(0.05)
    assert lobes["slope"] == pytest.approx(0.4 / 0.6)
    within = ("phi_within_1", "phi_within_2", "psi_within_1", "psi_within_2")
    assert [lobes[key] for key in within] == pytest.approx([1 / 3, 2 / 3, 2 / 3, 1])
    assert (found["diffuse"], found["diffuse_psi"]) == (1, 0.02)
    assert (found["metals"], found["metals_found"]) == (2, 1)
    assert found["f0_error"] == pytest.approx((0.1 + 0.0 + 0.1) / 3)
    assert found["others_metallic"] == 1
    assert (found["clear"], found["clear_measured"]) == (1, 1)
