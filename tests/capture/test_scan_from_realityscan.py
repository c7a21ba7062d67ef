"""RealityScan's exports, written from their definition: Euler angles by another library."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image, write_obj
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.formats.named_pictures import pictures_of
from usdbrdf.capture.formats.realityscan import records_of_sidecars, records_of_table
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
_HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
_NEWER = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"


@pytest.fixture
def room():
    return truth().square()


def write_pictures(folder, room):
    for i, image in enumerate(room.images):
        write_image(folder / "images" / f"IMG_{i:04d}.jpg", image)
    write_obj(folder / "model.obj", room)
    return folder


def _lens(room):
    """35 mm focal length and principal point, over the longer side, which is the width here."""
    fx, _, cx, cy = room.intrinsics[0]
    return fx / WIDTH * 36, (cx - WIDTH / 2) / WIDTH, (cy - HEIGHT / 2) / WIDTH


def write_table(folder, room, header=_HEADER, bent="0,0,0,0,0,0", separator=","):
    f, px, py = _lens(room)
    rows = [header]
    for i, pose in enumerate(room.world_from_camera):
        # Turned about its own y, then x, then against the clock about the world's up.
        yaw, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZXY", degrees=True)
        x, y, z = pose[:3, 3]
        numbers = (x, y, z, -yaw, pitch, roll, f, px, py)
        rows.append(f"IMG_{i:04d}.jpg," + ",".join(f"{n:.15e}" for n in numbers) + f",{bent}")
    text = "\n".join(rows).replace(",", separator)
    (folder / "registration.csv").write_text(f"# cameras 10\n{text}\n")
    return folder


@pytest.mark.parametrize(("header", "separator"), [(_HEADER, ","), (_NEWER, ";")])
def test_cameras_of_the_table(tmp_path, room, header, separator):
    folder = write_table(write_pictures(tmp_path / "scan", room), room, header, separator=separator)
    assert choose_adapter(folder).name == "realityscan"
    scan = read_scan(folder, OPTIONS)
    assert_same(scan, room, names=room.names)
    assert (scan.adapter, scan.up_axis) == ("realityscan", "Z")


def test_a_table_that_a_spreadsheet_has_saved(tmp_path, room):
    folder = write_table(write_pictures(tmp_path / "scan", room), room)
    table = folder / "registration.csv"
    rows = table.read_text().splitlines()[1:]
    table.unlink()
    (folder / "Registration.CSV").write_bytes("\r\n".join(rows).encode("utf-8-sig"))
    assert choose_adapter(folder).name == "realityscan"
    assert_same(read_scan(folder, OPTIONS), room, names=room.names)


@pytest.mark.parametrize(
    "beside", ["#name,x,y,alt", "Name;X;Y;Alt;Accuracy XY", "#name,x,y,alt,yaw,pitch,roll"]
)
def test_places_of_points_and_of_a_flight_are_no_cameras(tmp_path, room, beside):
    """Control points, and what a drone logs, which people keep beside the registration."""
    folder = write_table(write_pictures(tmp_path / "scan", room), room)
    by = ";" if ";" in beside else ","
    row = by.join(["P1", *"1234567"[: beside.count(by)]])
    (folder / "a points.csv").write_text(f"{beside}\n{row}\n{row}\n")
    assert_same(read_scan(folder, OPTIONS), room, names=room.names)


def _with_decimal_commas(text):
    return text.replace(",", ";").replace(".jpg", "?jpg").replace(".", ",").replace("?jpg", ".jpg")


@pytest.mark.parametrize(
    "written",
    [
        lambda text: text.encode("utf-16"),
        lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
        lambda text: f"sep=,\r\n{text}".encode(),
        lambda text: f'\ufeff"sep=;"\n{text.replace(",", ";")}'.encode(),
        lambda text: _with_decimal_commas(text).encode(),
        lambda text: f"sep=;\n{_with_decimal_commas(text)}".encode("utf-16"),
        lambda text: _with_decimal_commas(text).replace(";", "\t").encode("utf-16"),
        lambda text: (
            f"{text}\n# 10 cameras, all aligned\nexported by, the user\nThe end.\n\n".encode()
        ),
        lambda text: (text + "\n" + 15 * "," + "\n").encode(),
        lambda text: f"# exported by, the user, in metres\n{text}".encode(),
    ],
)
def test_tables_as_programs_and_spreadsheets_write_them(tmp_path, room, written):
    folder = write_table(write_pictures(tmp_path / "scan", room), room)
    table = folder / "registration.csv"
    text = table.read_text().split("\n", 1)[1].rstrip()
    table.write_bytes(written(text))
    assert choose_adapter(folder).name == "realityscan"
    assert_same(read_scan(folder, OPTIONS), room, names=room.names)


def test_radiance_beside_the_pictures_is_taken_with_their_masks(tmp_path, room):
    folder = write_table(write_pictures(tmp_path / "scan", room), room)
    for i, image in enumerate(room.images):
        write_image(folder / "images" / f"IMG_{i:04d}.exr", image)
        write_image(folder / "masks" / f"IMG_{i:04d}.jpg.png", np.ones_like(image))
    scan = read_scan(folder, IngestOptions())
    assert {path.suffix for path in scan.frames.photographs} == {".exr"}
    assert scan.frames.radiometric
    assert all(scan.frames.masks)
    assert [s for s in scan.warnings if "10 of the photographs" in s and "[capture.file]" in s]
    assert not [s for s in scan.warnings if "[capture.unused]" in s]


@pytest.mark.parametrize("kind", ["CR2", "HEIC"])
def test_pictures_may_be_called_after_what_the_camera_wrote(tmp_path, room, kind):
    folder = write_table(write_pictures(tmp_path / "scan", room), room)
    table = folder / "registration.csv"
    table.write_text(table.read_text().replace(".jpg", f".{kind}"))
    assert_same(read_scan(folder, OPTIONS), room, names=room.names)


@pytest.mark.parametrize("as_attributes", [False, True])
def test_cameras_of_sidecars(tmp_path, room, as_attributes):
    folder = write_sidecars(tmp_path / "scan", room, as_attributes=as_attributes)
    assert choose_adapter(folder).name == "realityscan"
    assert_same(read_scan(folder, OPTIONS), room, names=room.names)


def test_sidecars_lie_beside_their_pictures_in_any_folder_of_these(tmp_path, room):
    """One name in several folders, an XMP without a picture, and one of another program's."""
    folder = write_sidecars(tmp_path / "scan", room, as_attributes=True)
    images = folder / "images"
    for i in range(10):
        (images / "rig" / f"{i % 2}").mkdir(parents=True, exist_ok=True)
        for kind in ("jpg", "xmp"):
            place = images / "rig" / f"{i % 2}" / f"IMG_{i // 2}.{kind}"
            (images / f"IMG_{i:04d}.{kind}").rename(place)
    (images / "rig" / "0" / "IMG_4.jpg").unlink()
    (images / "rig" / "IMG.xmp").write_text('<x:xmpmeta xmlns:x="adobe:ns:meta/"/>')
    assert choose_adapter(folder).name == "realityscan"
    scan = read_scan(folder, OPTIONS)
    order = [0, 2, 4, 6, 1, 3, 5, 7, 9]
    assert_same(scan, room, poses=room.world_from_camera[order], names=room.names)
    assert [s for s in scan.warnings if "'rig/0/IMG_4': no picture" in s]


def test_sidecars_may_be_called_in_capitals(tmp_path, room):
    folder = write_sidecars(tmp_path / "scan", room, as_attributes=True)
    (folder / "images" / "rig").mkdir()
    for i in range(10):
        for kind, named in (("jpg", "JPG"), ("xmp", "XMP")):
            below = folder / "images" / ("rig" if i % 2 else "")
            (folder / "images" / f"IMG_{i:04d}.{kind}").rename(below / f"{i // 2}.{named}")
    assert choose_adapter(folder).name == "realityscan"
    order = [*range(0, 10, 2), *range(1, 10, 2)]
    assert_same(read_scan(folder, OPTIONS), room, poses=room.world_from_camera[order])


@pytest.mark.parametrize("first", [False, True])
def test_sidecars_may_hold_what_other_programs_say(tmp_path, room, first):
    """As Lightroom and ExifTool write it: a description for each of them."""
    folder = write_sidecars(tmp_path / "scan", room, as_attributes=False)
    ours = "<rdf:Description xcr:"
    other = (
        '<rdf:Description rdf:about="" xmlns:crs="http://ns.adobe.com/camera-raw-settings/1.0/" '
        f'crs:Rotation="90"><crs:Position>1 2 3</crs:Position>{3000 * " "}</rdf:Description>'
    )
    for path in folder.glob("images/*.xmp"):
        text = path.read_text()
        changed = text.replace(ours, other + ours) if first else text.replace("</rdf:RDF>", other)
        path.write_text(changed if first else changed.replace(other, other + "</rdf:RDF>"))
    assert choose_adapter(folder).name == "realityscan"
    assert_same(read_scan(folder, OPTIONS), room, names=room.names)


def write_sidecars(folder, room, *, as_attributes):
    """XMP beside each picture, its values as attributes or as elements; returns the folder."""
    write_pictures(folder, room)
    f, u, v = _lens(room)
    for i, pose in enumerate(room.opencv):
        # x_camera = R (X - position)
        rotation = " ".join(f"{n:.15f}" for n in pose[:3, :3].T.ravel())
        place = " ".join(f"{n:.15f}" for n in pose[:3, 3])
        names = ("Rotation", "Position", "DistortionCoeficients")
        values = dict(zip(names, (rotation, place, "0 0 0 0 0 0"), strict=True))
        attributes = elements = ""
        if as_attributes:
            attributes = " ".join(f'xcr:{k}="{value}"' for k, value in values.items())
        else:
            elements = "".join(f"<xcr:{k}>{value}</xcr:{k}>" for k, value in values.items())
        (folder / "images" / f"IMG_{i:04d}.xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
            '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
            'xcr:Version="3" xcr:PosePrior="exact" xcr:Coordinates="absolute" '
            f'xcr:DistortionModel="brown3" xcr:FocalLength35mm="{f}" xcr:Skew="0" '
            f'xcr:AspectRatio="1" xcr:PrincipalPointU="{u}" xcr:PrincipalPointV="{v}" {attributes} '
            f'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">{elements}'
            "</rdf:Description></rdf:RDF></x:xmpmeta>"
        )
    return folder


def _with_lens(folder, model, terms):
    for file in folder.rglob("*.xmp"):
        text = file.read_text().replace("brown3", model)
        file.write_text(text.replace(">0 0 0 0 0 0<", f">{terms}<"))
    return folder


@pytest.mark.parametrize("bent", ["", "0", "0 0 0 0 0 0"])
def test_a_division_without_terms_is_a_pinhole(tmp_path, room, bent):
    """As those write it who cut panoramas into pictures."""
    folder = write_sidecars(tmp_path / "scan", room, as_attributes=False)
    scan = read_scan(_with_lens(folder, "division", bent), OPTIONS)
    assert_same(scan, room)
    assert not any("Division" in said for said in scan.warnings)


@pytest.mark.parametrize("bent", ["-0.1 0 0 0 0 0", "-0.1"])
def test_a_division_straightens_by_its_term(tmp_path, room, bent):
    """A pixel at the radius r off the axis shows what a pinhole shows at r / (1 + k1 r^2)."""
    folder = _with_lens(
        write_sidecars(tmp_path / "scan", room, as_attributes=False), "division", bent
    )
    said = f"the lens model of {len(room.images)} cameras is Division"
    assert any(said in warning for warning in read_scan(folder, OPTIONS).warnings)
    records = _records_of(folder)
    fx, fy, cx, cy = room.intrinsics[0]
    pixels = np.random.default_rng(0).uniform((0, 0), (WIDTH, HEIGHT), (50, 2))
    bent_plane = (pixels - (cx, cy)) / (fx, fy)
    straight = bent_plane / (1 - 0.1 * (bent_plane**2).sum(axis=1, keepdims=True))
    rays = np.column_stack([straight[:, 0], -straight[:, 1], -np.ones(50)])
    seen = records[0].lens.project(rays, records[0].intrinsics)
    np.testing.assert_allclose(seen, pixels, atol=1e-6)


@pytest.mark.parametrize(
    ("model", "terms"),
    [("division", "-0.1 0.02 0 0 0 0"), ("division", "-0,1 0 0"), ("brown3", "-0,1 0 0 0 0 0"),
     ("brown3", "0 0 0 0 0 0 0.1"), ("brown3", "nan 0 0"), ("fisheye", "0.1 0 0"),
     # Where t1 stands is not known: the fourth of five may be it.
     ("brown3t2", "-0.1 0.06 -0.01 0.002 0.001"), ("brown4t2", "-0.1 0.06 -0.01 0 0.001")],
)  # fmt: skip
def test_terms_that_nobody_knows_are_refused(tmp_path, room, model, terms):
    folder = _with_lens(write_sidecars(tmp_path / "scan", room, as_attributes=False), model, terms)
    with pytest.raises(InputRefused, match=rf"lens model '{model}' is not read with the terms"):
        read_scan(folder, OPTIONS)


@pytest.mark.parametrize("terms", ["", "0 0 0", "-0.1 0 0"])
def test_without_a_model_there_are_no_terms(tmp_path, room, terms):
    folder = write_sidecars(tmp_path / "scan", room, as_attributes=False)
    for file in folder.rglob("*.xmp"):
        text = file.read_text().replace('xcr:DistortionModel="brown3" ', "")
        file.write_text(text.replace(">0 0 0 0 0 0<", f">{terms}<"))
    if "1" in terms:
        with pytest.raises(InputRefused, match=r"the lens model '' is not read with the terms"):
            read_scan(folder, OPTIONS)
    else:
        assert_same(read_scan(folder, OPTIONS), room)


def test_of_a_division_without_its_picture_no_warning_counts_the_camera(tmp_path, room):
    folder = write_sidecars(tmp_path / "scan", room, as_attributes=False)
    first = min(folder.rglob("*.xmp"))
    _with_lens(folder, "division", "-0.1")
    next(p for p in first.parent.glob(f"{first.stem}.*") if p != first).unlink()
    findings = Findings()
    files = sorted(folder.rglob("*.xmp"))
    records = list(records_of_sidecars(files, pictures_of(folder, OPTIONS), findings))
    assert len(records) == len(files) - 1
    assert any(f"the lens model of {len(records)} cameras" in said for said in findings.warnings)


def test_terms_of_zero_may_be_left_out(tmp_path, room):
    """Scripts that write XMP state as many as brown3 has."""
    folder = write_sidecars(tmp_path / "scan", room, as_attributes=False)
    _with_lens(folder, "brown3", "-0.1 0.06 -0.01")
    assert [record.lens.radial for record in _records_of(folder)] == [
        (-0.1, 0.06, -0.01, 0.0)
    ] * len(room.images)


def _records_of(folder):
    files = sorted(folder.rglob("*.xmp"))
    return list(records_of_sidecars(files, pictures_of(folder, OPTIONS), Findings()))


def test_the_model_none_is_a_pinhole_whatever_terms_stand_there(tmp_path, room):
    """One of the program's own names, beside perspective."""
    folder = write_sidecars(tmp_path / "scan", room, as_attributes=False)
    for file in folder.rglob("*.xmp"):
        text = file.read_text().replace("brown3", "none")
        file.write_text(text.replace(">0 0 0 0 0 0<", ">-0.1 0 0 0 0 0<"))
    assert_same(read_scan(folder, OPTIONS), room, names=room.names)


def _with_skew(folder, skew):
    for file in folder.rglob("*.xmp"):
        text = file.read_text()
        assert 'Skew="0"' in text
        file.write_text(text.replace('Skew="0"', f'Skew="{skew}"'))
    return folder


def test_rounding_is_no_skew(tmp_path, room):
    folder = _with_skew(write_sidecars(tmp_path / "scan", room, as_attributes=False), "-2.1e-15")
    assert_same(read_scan(folder, OPTIONS), room, names=room.names)


def test_a_skew_is_refused(tmp_path, room):
    folder = _with_skew(write_sidecars(tmp_path / "scan", room, as_attributes=False), "0.002")
    with pytest.raises(InputRefused, match=r"a skew of 0\.002, which is not read.*camera\]$"):
        read_scan(folder, OPTIONS)


@pytest.mark.parametrize(
    ("bent", "told"), [("-0.05,0,0,0,0,0", True), ("-0.05,0.01,0,0,0,0", False)]
)
def test_a_lens_of_k1_alone_is_told(tmp_path, room, bent, told):
    """The table does not say whether it is that of Division, which bends the other way."""
    folder = write_table(write_pictures(tmp_path / "scan", room), room, bent=bent)
    warnings = read_scan(folder, OPTIONS).warnings
    assert any("have k1 alone, as the model Division does" in said for said in warnings) == told


def test_the_lens_is_a_polynomial_of_the_ray(tmp_path, room):
    folder = write_pictures(tmp_path / "scan", room)
    write_table(folder, room, bent="-0.1,0.06,-0.01,0.002,0.003,0.004")
    pictures = pictures_of(folder, OPTIONS)
    record, *_ = records_of_table(folder / "registration.csv", pictures, Findings())
    points = np.random.default_rng(0).uniform((-0.6, -0.5, -1.2), (0.6, 0.5, -1), (50, 3))
    x, y = points[:, 0] / -points[:, 2], -points[:, 1] / -points[:, 2]
    r2 = x**2 + y**2
    bend = 1 - 0.1 * r2 + 0.06 * r2**2 - 0.01 * r2**3 + 0.002 * r2**4
    # The program's own template for OpenCV has k1, k2, t2, t1, k3, k4 where OpenCV has p1, p2.
    p2, p1 = 0.003, 0.004
    across = x * bend + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    down = y * bend + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    fx, fy, cx, cy = room.intrinsics[0]
    expected = np.stack([cx + fx * across, cy + fy * down], axis=1)
    np.testing.assert_allclose(record.lens.project(points, record.intrinsics), expected, atol=1e-6)


def _no_model(folder):
    (folder / "model.obj").unlink()


def _other_export(folder):
    """ "Image list with places", the export that is chosen by mistake."""
    rows = (folder / "registration.csv").read_text().splitlines()[1:]
    (folder / "registration.csv").write_text(
        "\n".join(",".join(row.split(",")[:4]) for row in rows)
    )


def _two_exports(folder):
    (folder / "second.csv").write_text((folder / "registration.csv").read_text())


def _cut(folder):
    text = (folder / "registration.csv").read_text().rstrip()
    (folder / "registration.csv").write_text(text[: text.rindex(",")])


def _other_pictures(folder):
    for path in folder.glob("images/*"):
        path.rename(path.with_stem(f"small {path.stem}"))


def _degrees(folder):
    """Longitudes and latitudes instead of metres."""
    rows = (folder / "registration.csv").read_text().splitlines()
    table = [row.split(",") for row in rows]
    for row in table[2:]:
        row[1], row[2] = f"{-34.82 + float(row[1]) / 1e5}", f"{-7.16 + float(row[2]) / 1e5}"
    (folder / "registration.csv").write_text("\n".join(",".join(row) for row in table))


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_no_model, r"no mesh\. Export the model .*--mesh\. \[mesh.missing\]"),
        (_other_export, r"without directions.*Internal/External.*\[capture.format\]"),
        (_two_exports, r"2 CSV exports of cameras.*\[capture.format\]"),
        (_cut, r"15 values under 16 names.*\[document.table\]"),
        (_other_pictures, r"only 0 of 10 frames.*has this name.*\[capture.file\]"),
        (_degrees, r"no parallax|camera rays hit the mesh"),
    ],
)
def test_refusals(tmp_path, room, damage, sentence):
    folder = write_table(write_pictures(tmp_path / "scan", room), room)
    damage(folder)
    with pytest.raises(InputRefused, match=sentence):
        read_scan(folder, OPTIONS)
