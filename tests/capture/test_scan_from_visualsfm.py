"""VisualSFM's .nvm, written after its documentation of the format, the exporter of COLMAP
(reconstruction_io.cc, ExportNVM) and the data of PBA (DataInterface.h, SaveNVM)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image, write_obj
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.reconstructions.visualsfm import shots_of
from usdbrdf.errors import InputRefused
from usdbrdf.model.lens import Lens
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True, meters_per_unit=1.0)
OTHER = "1\nother.jpg 20 1 0 0 0 0 0 0 0 0\n1\n0 0 0 1 2 3 1 0 5 1.5 2.5\n"


def _document(room, *, k=0.0, matrices=False):
    lines = ["NVM_V3_R9T" if matrices else "NVM_V3 ", " ", f"{len(room.images)}  "]
    for i, pose in enumerate(room.opencv):
        turn = pose[:3, :3].T
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        place = [*turn.ravel(), *(-turn @ pose[:3, 3])] if matrices else [w, x, y, z, *pose[:3, 3]]
        numbers = " ".join(f"{n:.17g}" for n in (room.intrinsics[i, 0], *place, k, 0))
        lines.append(f'D:\\my"shoot\\Bild"{i:04d}.jpg {numbers}')
    return "\n".join([*lines, "", "2", "0 0 0 255 0 0 1 0 7 1 2", "1 0 0 9 9 9 1 1 3 4 5", "", "0"])


def _write(folder, room, document):
    for i, image in enumerate(room.images):
        write_image(folder / "images" / f"Bild {i:04d}.jpg", image)
    write_obj(folder / "mesh.obj", room)
    (folder / "room.nvm").write_text(document + "\n")


@pytest.mark.parametrize("matrices", [False, True])
def test_the_document_is_the_room(tmp_path, matrices):
    room = truth().centred()
    _write(tmp_path, room, _document(room, matrices=matrices))
    assert choose_adapter(tmp_path / "room.nvm").name == choose_adapter(tmp_path).name
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room, names=room.names)
    assert scan.adapter == "visualsfm"


@pytest.mark.parametrize("k", [-0.08, 0.15, 1e-9])
def test_what_is_measured_is_undistorted_by_its_number(tmp_path, k):
    """From a pixel to the direction, the way of the format."""
    room = truth().centred()
    (tmp_path / "a.nvm").write_text(_document(room, k=k))
    shot = shots_of(tmp_path / "a.nvm", Findings())[2]
    camera = shot.camera.of_size(WIDTH, HEIGHT)
    focal = room.intrinsics[2, 0]
    for measured in ((9.5, -7.25), (-12.0, 3.0), (0.0, 0.0), (16.0, 12.0)):
        m = np.array(measured) / focal
        x, y = m * (1 + k * (m**2).sum())
        pixel = camera.lens.project(np.array([x, -y, -1.0]), camera.intrinsics)
        np.testing.assert_allclose(pixel - (WIDTH / 2, HEIGHT / 2), measured, atol=1e-6)


def test_a_lens_that_turns_back_ends_there():
    """k r^3 + r has its largest value at r = 1 / sqrt(-3 k)."""
    lens = Lens(curve="undistorting", shape=(-0.2,))
    edge = 1 / np.sqrt(0.6)
    assert lens.widest_angle == pytest.approx(np.arctan(edge * (1 - 0.2 * edge**2)), abs=2e-4)
    assert np.isnan(lens.project(np.array([3.0, 0, -1]), (1, 1, 0, 0))).all()
    assert not Lens(curve="undistorting", shape=(0.0,)).bends


def test_of_several_reconstructions_the_largest_is_read(tmp_path):
    room = truth().centred()
    head, rest = _document(room).split("\n", 1)
    _write(tmp_path, room, f"{head}\n{OTHER}{rest}")
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room)
    assert any("2 reconstructions" in said for said in scan.warnings)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("NVM_V3 ", "NVM_V3 FixedK 20 16 20 12", "without a fixed calibration"),
        ("NVM_V3 ", "NVM_V3_X", "it begins with 'NVM_V3_X'"),
        ("10  ", "0", "no reconstruction with cameras"),
        ("10  ", "200", "14 cameras where it announces 200"),
        ("10  ", "9" * 30, "how many cameras or points follow"),
        ("10  ", "ten", "'ten' where it is to say how many cameras"),
    ],
)
def test_what_is_not_read_is_refused(tmp_path, old, new, said):
    room = truth().centred()
    _write(tmp_path, room, _document(room).replace(old, new, 1))
    with pytest.raises(InputRefused, match=said):
        read_scan(tmp_path, OPTIONS)


def test_damaged_cameras_are_left_out(tmp_path):
    room = truth().centred()
    lines = _document(room).splitlines()
    lines[4] = lines[4].replace(" ", " nan ", 1)
    name = lines[6].split()[0]
    lines[6] = f"{name} 20 0 0 0 0 1 2 3 0 0"
    _write(tmp_path, room, "\n".join(lines))
    assert len(read_scan(tmp_path, OPTIONS).frames) == 8


def test_of_several_files_one_is_to_be_named(tmp_path):
    for name in ("a.nvm", "b.nvm"):
        (tmp_path / name).write_text("NVM_V3")
    with pytest.raises(
        InputRefused, match=r": 2 files \.nvm that begin with NVM_V3.*\. Name the one"
    ):
        read_scan(tmp_path, OPTIONS)
