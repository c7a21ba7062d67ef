"""BlocksExchange XML, written after Bentley's documentation of the format (CC Orientations) and its
annotated sample of Paris."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.format_truth import (
    HEIGHT,
    WIDTH,
    assert_bends,
    assert_same,
    truth,
    write_image,
    write_obj,
)
from usdbrdf.capture.adapters import choose_adapter, files_beside, read_scan
from usdbrdf.capture.reconstructions.blocks_exchange import shots_of
from usdbrdf.errors import InputRefused
from usdbrdf.files.images import write_exr
from usdbrdf.files.tables import read_xml
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
ENU = "ENU:39.97523,-83.00678"
# What the pictures' right, down and away from the camera are called, by the names of x and y.
SIDES = {"Right": (1, 0, 0), "Left": (-1, 0, 0), "Down": (0, 1, 0), "Up": (0, -1, 0)}


def _rotation(turn, how):
    if how == "angles":  # R = (Rx(omega) Ry(phi) Rz(kappa))^T
        omega, phi = np.arctan2(-turn.T[1, 2], turn.T[2, 2]), np.arcsin(turn.T[0, 2])
        kappa = np.arctan2(-turn.T[0, 1], turn.T[0, 0])
        named = zip(("Omega", "Phi", "Kappa"), np.degrees([omega, phi, kappa]), strict=True)
    else:
        named = ((f"M_{i}{k}", turn[i, k]) for i in range(3) for k in range(3))
    return "".join(f"<{name}>{float(number)!r}</{name}>" for name, number in named)


def _document(room, *, axes="XRightYDown", how="matrix", origin=(0, 0, 0), camera=None, extra=""):
    x, y = (np.array(SIDES[word], float) for word in axes[1:].split("Y"))
    sides = np.stack([x, y, np.cross(x, y)])
    fx, _, cx, cy = room.intrinsics[0].tolist()
    camera = camera or (
        f"<FocalLengthPixels>{fx}</FocalLengthPixels>"
        f"<PrincipalPoint><x>{cx - 0.5}</x><y>{cy - 0.5}</y></PrincipalPoint>"
    )
    photos = []
    for i, pose in enumerate(room.opencv):
        turn = sides @ pose[:3, :3].T
        place = pose[:3, 3] + origin
        centre = "".join(f"<{a}>{float(n)!r}</{a}>" for a, n in zip("xyz", place, strict=True))
        photos.append(
            f"<Photo><Id>{i}</Id><ImagePath>D:/Work/undistorted photos/{i:04d}.jpg</ImagePath>"
            f"<Component>1</Component><Pose><Rotation>{_rotation(turn, how)}"
            f"<Accurate>true</Accurate></Rotation><Center>{centre}</Center>"
            "<Metadata><SRSId>0</SRSId><Center><x>-83</x><y>39</y><z>157</z></Center></Metadata>"
            "</Pose></Photo>"
        )
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n<BlocksExchange version="3.2">'
        "<SpatialReferenceSystems><SRS><Id>0</Id><Name>WGS 84</Name>"
        "<Definition>EPSG:4326+5773</Definition></SRS>"
        f"<SRS><Id>2</Id><Name>Local</Name><Definition>{ENU}</Definition></SRS>"
        "</SpatialReferenceSystems><Block><Name>Block_1 - AT</Name><SRSId>2</SRSId><Photogroups>"
        "<Photogroup><Name>1</Name><ImageDimensions>"
        f"<Width>{WIDTH}</Width><Height>{HEIGHT}</Height></ImageDimensions>"
        "<CameraModelType>Perspective</CameraModelType><CameraModelBand>Visible</CameraModelBand>"
        f"{camera}<CameraOrientation>{axes}</CameraOrientation>{extra}"
        "<AspectRatio>1</AspectRatio><Skew>0</Skew>"
        f"{''.join(photos)}</Photogroup></Photogroups></Block></BlocksExchange>"
    )


def _write(folder, room, document, mesh="mesh.obj"):
    for i, image in enumerate(room.images):
        write_image(folder / "images" / f"{i:04d}.jpg", image)
    (folder / mesh).parent.mkdir(parents=True, exist_ok=True)
    write_obj(folder / mesh, room)
    (folder / "block.xml").write_text(document)


def _shots(tmp_path, document):
    (tmp_path / "block.xml").write_text(document)
    return list(shots_of(read_xml(tmp_path / "block.xml"), np.zeros(3), tmp_path / "block.xml"))


@pytest.mark.parametrize("how", ["matrix", "angles"])
@pytest.mark.parametrize("axes", ["XRightYDown", "XRightYUp", "XLeftYDown", "XDownYLeft"])
def test_the_block_is_the_room(tmp_path, axes, how):
    room = truth().square()
    _write(tmp_path, room, _document(room, axes=axes, how=how))
    assert choose_adapter(tmp_path / "block.xml").name == "blocks-exchange"
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room, names=room.names)
    assert not any("[capture.unit]" in said for said in scan.warnings)


def test_angles_are_those_of_the_sample_of_the_format(tmp_path):
    """The one photograph of which it states both."""
    angles = "<Omega>179.6523471469934</Omega><Phi>0.04985630236313049</Phi>"
    angles += "<Kappa>179.9065465708369</Kappa>"
    room = truth()
    document = _document(room)
    first = document.index("<M_00>")
    changed = document[:first] + angles + document[document.index("<Accurate>") :]
    found = _shots(tmp_path, changed)[0].world_from_camera[:3, :3].T
    expected = [
        [-0.9999982912233401, -0.001636319085375301, -0.0008602425863163225],
        [-0.001631068695467463, 0.9999802528616577, -0.00606906089589293],
        [0.0008701565192966738, -0.006067647409696231, -0.9999812130648239],
    ]
    np.testing.assert_allclose(found, expected, atol=1e-11)


@pytest.mark.parametrize("given", ["beside", "above the model"])
def test_models_have_an_origin_of_their_own(tmp_path, given):
    """As those of projected coordinates, of which single precision would keep decimetres."""
    room, origin = truth().square(), (512_000.25, 4_400_000.5, 150.0)
    tile = "Data/Tile_+000_+000/Tile_+000_+000.obj"
    base, made = tmp_path / "capture", tmp_path / "made"
    _write(base, room, _document(room, origin=origin), tile if given == "beside" else "mesh.obj")
    folder = base if given == "beside" else made / "Production_1"
    if given != "beside":
        (base / "mesh.obj").unlink()
        (folder / tile).parent.mkdir(parents=True)
        write_obj(folder / tile, room)
    text = f"<SRS>enu: 39.97523, -83.00678</SRS><SRSOrigin>{','.join(map(str, origin))}</SRSOrigin>"
    (folder / "metadata.xml").write_text(f"<ModelMetadata version='1'>{text}</ModelMetadata>")
    mesh = None if given == "beside" else folder / tile
    scan = read_scan(base, IngestOptions(assume_srgb=True, mesh=mesh))
    assert_same(scan, room)
    if mesh is not None:
        beside = files_beside(choose_adapter(base), base, mesh)
        assert beside == [folder / "metadata.xml"]


def test_millimetres_are_of_the_longer_side(tmp_path):
    room = truth().square()
    fx, _, cx, cy = room.intrinsics[0].tolist()
    mm = 23.5 / WIDTH
    camera = (
        f"<SensorSize>23.5</SensorSize><FocalLength>{fx * mm}</FocalLength>"
        f"<PrincipalPoint><xmm>{(cx - WIDTH / 2) * mm}</xmm><ymm>{(HEIGHT / 2 - cy) * mm}</ymm>"
        "</PrincipalPoint>"
    )
    for said in (
        camera,
        camera.replace("SensorSize>23.5</SensorSize", f"PixelSize>{mm}</PixelSize"),
    ):
        found = _shots(tmp_path, _document(room, axes="XRightYUp", camera=said))[0].camera
        np.testing.assert_allclose(found.intrinsics, room.intrinsics[0], atol=1e-9)
    found = _shots(tmp_path, _document(room, camera=camera.split("<PrincipalPoint>")[0]))[0].camera
    np.testing.assert_allclose(found.intrinsics[2:], (WIDTH / 2, HEIGHT / 2))


def _brown(plane, terms):
    """Brown's model as the format's documentation refers to it: P1 goes with r^2 + 2 x^2."""
    (x, y), (k1, k2, k3, p1, p2) = plane, terms
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y,
        y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y,
    )


def test_distortions_are_those_of_the_format(tmp_path):
    room, terms = truth().square(), (-0.1, 0.02, 0.01, 0.004, -0.003)
    named = zip(("K1", "K2", "K3", "P1", "P2"), terms, strict=True)
    said = "".join(f"<{name}>{number}</{name}>" for name, number in named)
    shots = _shots(tmp_path, _document(room, extra=f"<Distortion>{said}</Distortion>"))
    assert_bends(shots[0].camera, room, _brown, terms)


def _fisheye_pixels(points, pose, matrix, terms, centre):
    """As Pix4D's manual writes its fisheye, and ContextCapture's with p4: the angle in parts of a
    quarter of a turn, a polynomial of it, a matrix."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    across = np.linalg.norm(local[:, :2], axis=1)
    theta = 2 / np.pi * np.arctan2(across, local[:, 2])
    rho = sum(p * theta ** (i + 1) for i, p in enumerate(terms))
    return (local[:, :2] * (rho / across)[:, None]) @ np.transpose(matrix) + centre


@pytest.mark.parametrize(
    ("matrix", "terms"),
    [
        ([[30.0, 0], [0, 30]], (1.0,)),
        ([[31.0, 0], [0, 30]], (0.9, 0.05, -0.03, 0.01)),
        ([[31.0, 0.4], [-0.3, 30.5]], (1.0, 0.05, -0.03)),
        (None, (1.0, -0.04, 0.02)),
    ],
)
def test_fisheyes(tmp_path, matrix, terms):
    """Also such as are turned and skewed by their matrix, or have a focal length alone."""
    room = truth().square()
    fx, _, cx, cy = room.intrinsics[0].tolist()
    said = "".join(f"<P{i + 1}>{p}</P{i + 1}>" for i, p in enumerate(terms))
    said = f"<FisheyeDistortion><P0>0</P0>{said}</FisheyeDistortion>"
    if matrix is not None:
        entries = (f"<M_{i}{k}>{matrix[i][k]}</M_{i}{k}>" for i in (0, 1) for k in (0, 1))
        said += f"<FisheyeFocalMatrix>{''.join(entries)}</FisheyeFocalMatrix>"
    document = _document(room, axes="XRightYUp", extra=said).replace("Perspective", "Fisheye")
    matrix = np.eye(2) * fx * np.pi / 2 if matrix is None else matrix
    around = np.random.default_rng(0).normal(size=(500, 3))
    for shot, pose in zip(_shots(tmp_path, document), room.opencv, strict=True):
        points = pose[:3, 3] + around
        expected = _fisheye_pixels(points, pose, matrix, terms, (cx, cy))
        local = (points - shot.world_from_camera[:3, 3]) @ shot.world_from_camera[:3, :3]
        found = shot.camera.lens.project(local * (1, -1, -1), shot.camera.intrinsics)
        front = (around @ pose[:3, :3])[:, 2] > 0.1
        np.testing.assert_allclose(found[front], expected[front], atol=1e-9)


def test_a_room_through_a_fisheye(tmp_path):
    """Pictures that fisheyes took become frames whose lines are straight."""
    room = truth().square()
    _write(tmp_path, room, _document(room).replace("Perspective", "Fisheye"))
    scan = read_scan(tmp_path, OPTIONS)
    assert len(scan.frames) == 10
    assert scan.views[0].lens.curve == "fisheye"


def test_pixels_that_are_not_square_are_told(tmp_path):
    room = truth().square()
    intrinsics = room.intrinsics * (1, 0.98, 1, 1)
    wide = dataclasses.replace(room, intrinsics=intrinsics)
    _write(tmp_path, room, _document(room).replace("Ratio>1<", "Ratio>0.98<"))
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, wide)
    assert any("pixels that are not square; AspectRatio" in said for said in scan.warnings)


def test_several_groups_of_photographs(tmp_path):
    """As of two cameras; what one of them lacks does not concern the other."""
    room = truth().square()
    document = _document(room)
    head = document[document.index("<Photogroup>") : document.index("<Photo>")]
    parts = document.split("<Photo>")
    parts[5] += f"</Photogroup>{head.replace('<Skew>0</Skew>', '')}"
    _write(tmp_path, room, "<Photo>".join(parts))
    assert_same(read_scan(tmp_path, OPTIONS), room)


@pytest.mark.parametrize(
    ("stated", "lies"),
    [
        ("D:/Work/masks/{}_msk.png", "masks/{}_msk.png"),
        ("{}_mask.png", "images/{}_mask.png"),
        ("D:\\Work\\sky\\{}.png", "sky/{}.png"),
    ],
)
def test_masks_that_the_block_names_are_used(tmp_path, stated, lies):
    room = truth().square()
    parts = _document(room).split("</ImagePath>")
    for i in range(3):
        parts[i + 1] = f"<MaskPath>{stated.format(f'{i:04d}')}</MaskPath>{parts[i + 1]}"
        if i:
            mask = np.ones_like(room.images[i])
            mask[: HEIGHT // 2] = 0
            write_image(tmp_path / lies.format(f"{i:04d}"), mask)
    _write(tmp_path, room, "</ImagePath>".join(parts))
    scan = read_scan(tmp_path, OPTIONS)
    assert [view and view.mask for view in scan.views][:4] == [
        None,
        *(tmp_path / lies.format(f"{i:04d}") for i in (1, 2)),
        None,
    ]
    missing = stated.format("0000")
    assert any(
        f"1 of the masks that it names are not there, first {missing!r}" in w for w in scan.warnings
    )
    assert not any("[capture.unused]" in said for said in scan.warnings)


@pytest.mark.parametrize("place", ["images", "elsewhere"])
def test_masks_do_not_lead_out_of_the_capture(tmp_path, place):
    room, capture = truth().square(), tmp_path / "capture"
    first = "0000.jpg</ImagePath>"
    named = _document(room).replace(first, f"{first}<MaskPath>sky.png</MaskPath>")
    _write(capture, room, named)
    write_image(tmp_path / "outside.png", room.images[0])
    (capture / "images/sky.png").symlink_to(tmp_path / "outside.png")
    frames = (capture / "images").rename(tmp_path / place) if place == "elsewhere" else None
    with pytest.raises(InputRefused, match=r"leads outside that folder.*\[paths\.outside\]$"):
        read_scan(capture, dataclasses.replace(OPTIONS, frames=frames))


def test_a_photograph_is_not_the_mask_of_its_radiance(tmp_path):
    """Masks in a folder that was not copied are called as the photographs are."""
    room = truth().square()
    document = _document(room)
    for i in range(len(room.images)):
        said = f"{i:04d}.jpg</ImagePath>"
        document = document.replace(said, f"{said}<MaskPath>D:/Masks/{i:04d}.jpg</MaskPath>")
    _write(tmp_path, room, document)
    for i, image in enumerate(room.images):
        write_exr(tmp_path / f"images/{i:04d}.exr", np.float32(image))
    scan = read_scan(tmp_path, IngestOptions())
    assert {path.suffix for path in scan.frames.image_paths} == {".exr"}
    assert scan.views == ()
    assert any("10 of the masks that it names are not there" in said for said in scan.warnings)


def test_spheres(tmp_path):
    document = _document(truth()).replace(">Perspective<", ">Spherical<")
    camera = _shots(tmp_path, document)[0].camera
    assert (camera.lens.curve, camera.resolution) == ("equirectangular", (WIDTH, HEIGHT))


def test_photographs_that_were_not_placed_are_left_out(tmp_path):
    room = truth().square()
    parts = _document(room).split("<Photo>")
    parts[3] = parts[3].replace("<Component>1<", "<Component>0<")
    parts[5] = parts[5].replace("<M_11>", "<M_11>nan ")
    _write(tmp_path, room, "<Photo>".join(parts))
    scan = read_scan(tmp_path, OPTIONS)
    assert len(scan.frames) == 8
    assert any("it is of no component of the block" in said for said in scan.warnings)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (">Perspective<", ">Tunnel<", "cameras of the type 'Tunnel' are not read"),
        ("<Skew>0<", "<Skew>0.5<", "cameras with Skew are not read"),
        (
            ">Perspective</CameraModelType>",
            ">Fisheye</CameraModelType><FisheyeDistortion><P0>0.1</P0></FisheyeDistortion>",
            "P0 of FisheyeDistortion is 0.1, which leaves a hole",
        ),
        (
            ">Perspective</CameraModelType><CameraModelBand>Visible</CameraModelBand>"
            "<FocalLengthPixels>",
            ">Fisheye</CameraModelType><FocalLengthPixels>-",
            "only 0 of 10 frames can be used",
        ),
        ("M_00>", "Yaw>", "its rotations are headings, pitches and rolls"),
        ("<SRSId>2<", "<SRSId>0<", r"its coordinates are longitudes .*\(EPSG:4326"),
        (
            "<Photogroup>",
            "<Photogroup><SRSId>0</SRSId>",
            r"several coordinate systems \(SRSId 0, 2",
        ),
        (
            "<SRSId>2</SRSId><Photogroups><Photogroup>",
            "<Photogroups><Photogroup><SRSId>0</SRSId>",
            r"its coordinates are longitudes .*\(EPSG:4326",
        ),
        (f">{ENU}<", ">WGS84<", "its coordinates are longitudes and latitudes"),
        ("<Rotation>", "<Rot>", "not valid XML"),
        ("Rotation>", "Rot>", "no photograph with rotation and centre"),
        ("<BlocksExchange", "<!DOCTYPE a><BlocksExchange", "an XML document with a document type"),
        ("XRightYDown", "XRightYLeft", "only 0 of 10 frames can be used"),
        ("FocalLengthPixels>", "Focal>", "only 0 of 10 frames can be used"),
        (
            ">Perspective</CameraModelType>",
            ">Fisheye</CameraModelType><FisheyeDistortion><P1>-1</P1></FisheyeDistortion>",
            "only 0 of 10 frames can be used",
        ),
    ],
)
def test_what_is_not_read_is_refused(tmp_path, old, new, said):
    room = truth().square()
    _write(tmp_path, room, _document(room).replace(old, new))
    with pytest.raises(InputRefused, match=said):
        read_scan(tmp_path, OPTIONS)


def _write_in_tiles(tmp_path, room):
    _write(tmp_path, room, _document(room), "Data/Tile_0/Tile_0.obj")
    (tmp_path / "Data/Tile_0/Tile_0.obj").unlink()
    left = room.points[room.triangles][:, :, 0].mean(axis=1) < room.points[:, 0].mean()
    for i, of in enumerate((left, ~left)):
        used, corners = np.unique(room.triangles[of], return_inverse=True)
        piece = dataclasses.replace(
            room,
            points=room.points[used],
            triangles=corners.reshape(-1, 3),
            face_object=room.face_object[of],
        )
        (tmp_path / f"Data/Tile_{i}").mkdir(exist_ok=True)
        write_obj(tmp_path / f"Data/Tile_{i}/Tile_{i}.obj", piece)


def test_a_model_in_tiles_is_one(tmp_path):
    """Each is a piece of it, and its materials are those of the piece."""
    room = truth().square()
    _write_in_tiles(tmp_path, room)
    (tmp_path / "model.mtl").write_text("newmtl wall\n")
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room)
    assert any("2 tiles, first Data/Tile_0/Tile_0.obj. [mesh.tiles]" in w for w in scan.warnings)
    assert not {each.label for each in scan.objects} & set(room.names)
    write_obj(tmp_path / "Data/Tile_1/Tile_1_L19.obj", room)
    with pytest.raises(InputRefused, match=r"have levels of detail\. Produce it without these"):
        read_scan(tmp_path, OPTIONS)
    write_obj(tmp_path / "whole.obj", room)
    assert_same(
        read_scan(tmp_path, dataclasses.replace(OPTIONS, mesh=tmp_path / "whole.obj")), room
    )


@pytest.mark.parametrize("name", ["mesh.obj", "house.obj"])
def test_a_mesh_beside_tiles_is_taken_instead(tmp_path, name):
    """Also where these have levels of detail."""
    room = truth().square()
    _write_in_tiles(tmp_path, room)
    write_obj(tmp_path / "Data/Tile_1/Tile_1_L19.obj", room)
    write_obj(tmp_path / name, room)
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room)
    assert not any("[mesh.tiles]" in said for said in scan.warnings)


def test_tiles_do_not_lead_out_of_the_capture(tmp_path):
    room, capture = truth().square(), tmp_path / "capture"
    _write_in_tiles(capture, room)
    (capture / "Data/Tile_1").rename(tmp_path / "elsewhere")
    (capture / "Data/Tile_1").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputRefused, match=r"leads outside that folder.*\[paths\.outside\]$"):
        read_scan(capture, OPTIONS)


def test_a_model_of_another_system_is_refused(tmp_path):
    room = truth().square()
    _write(tmp_path, room, _document(room))
    for text, said in (
        (
            "<SRS>EPSG:32617</SRS>",
            "is in the coordinate system EPSG:32617, the cameras of block.xml",
        ),
        (f"<SRS>{ENU}</SRS><SRSOrigin>1,2</SRSOrigin>", "SRSOrigin is '1 2', not three numbers"),
        (f"<SRS>{ENU}</SRS><SRSOrigin>1,2,inf</SRSOrigin>", "not three numbers"),
    ):
        (tmp_path / "metadata.xml").write_text(f"<ModelMetadata>{text}</ModelMetadata>")
        with pytest.raises(InputRefused, match=said):
            read_scan(tmp_path, OPTIONS)


@pytest.mark.parametrize(
    "system",
    [
        "LOCAL_CS[&quot;Local (m)&quot;]",
        "WGS 84 / UTM zone 17N",
        "PROJCS[&quot;WGS 84 / UTM zone 17N&quot;,GEOGCS[&quot;WGS 84&quot;]]",
        "EPSG:32617+5773",
        "EPSG:4549",  # CGCS2000 / 3-degree Gauss-Kruger, among the codes of geographic ones
        "EPSG:4647",  # ETRS89 / UTM zone 32N (zE-N)
    ],
)
def test_systems_whose_coordinates_are_lengths_are_read(tmp_path, system):
    room = truth().square()
    _write(tmp_path, room, _document(room).replace(f">{ENU}<", f">{system}<"))
    assert_same(read_scan(tmp_path, OPTIONS), room)


@pytest.mark.parametrize("other", [ENU, f" {ENU.lower()}\n"])
def test_a_system_that_is_listed_twice_is_one(tmp_path, other):
    room = truth().square()
    again = f"<SRS><Id>3</Id><Name>Again</Name><Definition>{other}</Definition></SRS>"
    end = "</SpatialReferenceSystems>"
    document = _document(room).replace(end, f"{again}{end}")
    document = document.replace("<Photogroup>", "<Photogroup><SRSId>3</SRSId>")
    _write(tmp_path, room, document)
    assert_same(read_scan(tmp_path, OPTIONS), room)


def test_systems_that_nothing_defines_are_known_by_their_ids(tmp_path):
    room = truth().square()
    document = _document(room).replace("<Photogroup>", "<Photogroup><SRSId>7</SRSId>")
    _write(tmp_path, room, document.replace("<SRSId>2<", "<SRSId>8<"))
    with pytest.raises(InputRefused, match=r"several coordinate systems \(SRSId 7, 8\)"):
        read_scan(tmp_path, OPTIONS)


def test_of_several_blocks_the_one_with_most_poses_is_read(tmp_path):
    room = truth().square()
    other = "<Block><Name>Block_1</Name><Photogroups/></Block><Block><Name>"
    _write(tmp_path, room, _document(room).replace("<Block><Name>", other))
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room)
    assert any("2 blocks; taken is 'Block_1 - AT'" in said for said in scan.warnings)


@pytest.mark.parametrize(
    "system",
    [
        "EPSG:4258", "EPSG:4269+5703", "epsg: 4283", "EPSG:4490", "EPSG:4978", "EPSG:6318",
        "EPSG:7844", "urn:ogc:def:crs:EPSG:9.8:4258", "+proj=latlong +datum=WGS84",
        "GEOGCS[&quot;ETRS89&quot;]", "GEOGRAPHICCRS[&quot;ETRS89&quot;]",
        "COMPD_CS[&quot;a&quot;,GEOGCS[&quot;NAD83&quot;],VERT_CS[&quot;NAVD88&quot;]]",
        "GEOCCS[&quot;WGS 84&quot;]", "GEODCRS[&quot;WGS 84&quot;]",
    ],
)  # fmt: skip
def test_systems_in_degrees_are_refused(tmp_path, system):
    room = truth().square()
    _write(tmp_path, room, _document(room).replace(f">{ENU}<", f">{system}<"))
    with pytest.raises(InputRefused, match=r"longitudes and latitudes, or from the Earth's centre"):
        read_scan(tmp_path, OPTIONS)


@pytest.mark.parametrize(
    ("model", "block", "warned"),
    [
        ("EPSG:32617", "EPSG:32617+5773", 1),
        ("EPSG: 32617 + 5773", "epsg:32617", 1),
        ("EPSG:32617+5773", "EPSG:32617+5773", 0),
        ("EPSG:32617+5703", "EPSG:32617+5773", None),
        ("EPSG:32618", "EPSG:32617+5773", None),
    ],
)
def test_of_a_models_system_the_horizontal_part_is_the_blocks(tmp_path, model, block, warned):
    room = truth().square()
    _write(tmp_path, room, _document(room).replace(f">{ENU}<", f">{block}<"))
    text = f"<SRS>{model}</SRS><SRSOrigin>0,0,0</SRSOrigin>"
    (tmp_path / "metadata.xml").write_text(f"<ModelMetadata>{text}</ModelMetadata>")
    if warned is None:
        with pytest.raises(InputRefused, match=r"Export both in one\. \[capture\.unit\]$"):
            read_scan(tmp_path, OPTIONS)
        return
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room)
    assert sum("one says nothing of heights" in said for said in scan.warnings) == warned


def test_of_several_documents_one_is_to_be_named(tmp_path):
    for name in ("a.xml", "b.xml"):
        (tmp_path / name).write_text("<BlocksExchange/>")
    with pytest.raises(InputRefused, match=r": 2 documents of BlocksExchange XML\. Name the file"):
        read_scan(tmp_path, OPTIONS)
