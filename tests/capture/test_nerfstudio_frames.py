"""Meshes that nerfstudio exports beside its transforms.json, turned, moved and scaled as its
dataparser does (nerfstudio_dataparser.py, auto_orient_and_center_poses)."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation

from tests.capture.test_pointers import POINTER
from tests.capture.test_scan_from_colmap import pycolmap, reconstruction, write_model
from tests.scenes import as_mitsubas, edited, make_capture, write_ply
from usdbrdf.capture.adapters import choose_adapter, files_beside, read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])
OLD = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


@pytest.fixture
def capture(tmp_path):
    return make_capture(tmp_path / "room")


def _train(made, *, applied=None, applied_scale=None, legacy=False, folder=None, name):
    """The document as ns-process-data leaves it, and the mesh of a training on it."""
    matrix, larger = (OLD if legacy else np.eye(4) if applied is None else applied), 1.0
    with edited(made.manifest) as document:
        if applied is not None:
            document["applied_transform"] = applied[:3].tolist()
        if applied_scale is not None:
            document["applied_scale"] = larger = applied_scale
        for frame in document["frames"]:
            pose = matrix @ np.array(frame["transform_matrix"])
            pose[:3, 3] *= larger
            frame["transform_matrix"] = pose.tolist()
        poses = np.array([frame["transform_matrix"] for frame in document["frames"]])
    stored = larger * (made.points @ matrix[:3, :3].T + matrix[:3, 3])
    if legacy:
        (made.folder / "colmap/sparse/0").mkdir(parents=True)
    rotation = Rotation.from_euler("xyz", [20, -35, 110], degrees=True).as_matrix()
    centre = poses[:, :3, 3].mean(axis=0)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, rotation @ -centre
    scale = 1 / np.abs((poses[:, :3, 3] - centre) @ rotation.T).max()
    trained = scale * ((stored - centre) @ rotation.T)
    (made.folder / "mesh.ply").unlink()
    folder = folder or made.folder
    folder.mkdir(exist_ok=True)
    write_ply(folder / name, trained, made.triangles, made.face_object)
    said = {"transform": (transform @ matrix)[:3].tolist(), "scale": scale * larger}
    (folder / "dataparser_transforms.json").write_text(json.dumps(said))
    return folder / name


@pytest.mark.parametrize(
    "how", [{}, {"applied": Y_UP}, {"applied": Y_UP, "applied_scale": 2.5}, {"legacy": True}]
)
def test_an_exported_mesh_is_brought_back(capture, how):
    _train(capture, name="poisson_mesh.ply", **how)
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.frames.world_from_camera, capture.world_from_camera, atol=1e-9)
    np.testing.assert_allclose(scan.mesh.points, capture.points, atol=1e-5)
    corners = scan.mesh.points[scan.mesh.triangles].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    flat = np.cross(edges[:, 0], edges[:, 1])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    np.testing.assert_allclose((scan.mesh.corner_normals * flat[:, None]).sum(axis=2), 1, atol=1e-4)
    assert [o.identifier for o in scan.objects] == list(capture.names)
    (said,) = (sentence for sentence in scan.warnings if "[mesh.frame]" in sentence)
    assert "poisson_mesh.ply: dataparser_transforms.json beside it says" in said


def test_a_mesh_elsewhere_is_brought_back_by_what_lies_beside_it(capture, tmp_path):
    mesh = _train(capture, folder=tmp_path / "export", name="mesh.ply")
    scan = read_scan(capture.folder, IngestOptions(mesh=mesh))
    np.testing.assert_allclose(scan.mesh.points, capture.points, atol=1e-5)
    beside = files_beside(choose_adapter(capture.folder), capture.folder, mesh)
    assert beside == [mesh.parent / "dataparser_transforms.json"]


def test_an_exported_mesh_alone_says_what_is_missing(capture):
    """No more: others call theirs so too, and who moved it back need not rename it."""
    _train(capture, name="tsdf_mesh.ply")
    (capture.folder / "dataparser_transforms.json").unlink()
    scan = read_scan(capture.folder, IngestOptions())
    (said,) = (sentence for sentence in scan.warnings if "[mesh.frame]" in sentence)
    assert "Put dataparser_transforms.json, which lies beside the training's config.yml" in said


def test_areas_are_those_of_the_capture(capture):
    """A part that is large enough, and would be too small in the training's metres, which are
    larger."""
    (capture.folder / "objects.json").unlink()
    area, least, square = 1.1, 1.05, np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    added = np.array([[0, 1, 2], [0, 2, 3]]) + len(capture.points)
    larger = replace(
        capture,
        points=np.concatenate([capture.points, np.sqrt(area) * square + (0, 0, 0.37)]),
        triangles=np.concatenate([capture.triangles, added]),
        face_object=None,
    )
    options = IngestOptions(min_component_area_m2=least)
    mesh = _train(larger, name="mesh.ply")
    statement = capture.folder / "dataparser_transforms.json"
    assert area * json.loads(statement.read_text())["scale"] ** 2 < least < area
    before = read_scan(capture.folder, options)
    write_ply(mesh, larger.points, larger.triangles)
    statement.unlink()
    after = read_scan(capture.folder, options)
    assert len(after.objects) > 1
    assert [o.label for o in before.objects] == [o.label for o in after.objects]


@pytest.mark.parametrize(
    "stated",
    [
        {"transform": [[1, 0, 0, 0]] * 3, "scale": 1},
        {"transform": np.eye(4)[:3].tolist(), "scale": 0},
        {"transform": np.eye(4)[:3].tolist(), "scale": 1e300},
        {"transform": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1},
        {"transform": np.diag([1, 1, -1, 1])[:3].tolist(), "scale": 1},
        {"transform": {}, "scale": 1},
        {"scale": 1},
        [],
    ],
)
def test_a_statement_that_says_no_frame_is_refused(capture, stated):
    _train(capture, name="mesh.ply")
    (capture.folder / "dataparser_transforms.json").write_text(json.dumps(stated))
    with pytest.raises(InputRefused, match=r"nobody knows where the mesh lies.*\[mesh\.frame\]$"):
        read_scan(capture.folder, IngestOptions())


def test_a_usd_mesh_in_the_frame_of_the_training_is_refused(capture):
    """USD states its own unit and axes, in which nobody exports from nerfstudio."""
    mesh = _train(capture, name="poisson_mesh.ply")
    stage = Usd.Stage.CreateNew(str(capture.folder / "mesh.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    made = UsdGeom.Mesh.Define(stage, "/room")
    stage.SetDefaultPrim(made.GetPrim())
    made.CreatePointsAttr(capture.points.astype(np.float32))
    made.CreateFaceVertexCountsAttr(np.full(len(capture.triangles), 3, np.int32))
    made.CreateFaceVertexIndicesAttr(capture.triangles.ravel().astype(np.int32))
    stage.Save()
    mesh.unlink()
    (capture.folder / "objects.json").unlink()
    options = IngestOptions(mesh=capture.folder / "mesh.usda")
    with pytest.raises(InputRefused, match=r"USD files are not brought back\. .*\[mesh\.frame\]$"):
        read_scan(capture.folder, options)
    (capture.folder / "dataparser_transforms.json").unlink()
    scan = read_scan(capture.folder, options)
    np.testing.assert_allclose(np.ptp(scan.mesh.points, axis=0), np.ptp(capture.points, axis=0))


def _recentred(made, folder, *, similarity, names=None, points=()):
    """COLMAP's model of a capture in ``folder``, and its document as colmap2nerf.py leaves it:
    the world turned, moved and scaled, and no word of that."""
    names = names or [f"{i:04d}.exr" for i in range(len(made.world_from_camera))]
    camera = pycolmap.Camera(model="PINHOLE", width=32, height=24, params=[24.0, 24, 16, 12])
    model = reconstruction(made, [camera], names)
    for point in points:
        model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    write_model(made.folder / folder, model, text="text" in folder)
    scale = np.cbrt(np.linalg.det(similarity[:3, :3]))
    with edited(made.manifest) as document:
        for frame in document["frames"]:
            pose = similarity @ np.array(frame["transform_matrix"])
            pose[:3, :3] /= scale
            frame["transform_matrix"] = pose.tolist()


def test_colmaps_mesh_is_brought_to_poses_that_instant_ngp_moved(capture):
    folder = "colmap_sparse/0"
    similarity = np.eye(4)
    similarity[:3, :3] = 0.4 * Rotation.from_euler("xyz", [70, 10, -50], degrees=True).as_matrix()
    similarity[:3, 3] = 0.3, -0.2, 0.5
    _recentred(capture, folder, similarity=similarity)
    expected = capture.points @ similarity[:3, :3].T + similarity[:3, 3]
    mesh = capture.folder / "mesh.ply"
    (capture.folder / "objects.json").unlink()
    # Of one that is called otherwise nobody knows, and poses inside of it hit it anyhow.
    told = read_scan(capture.folder, IngestOptions()).warnings
    assert any("--adapter colmap. [mesh.frame]" in said for said in told)
    mesh.rename(capture.folder / "meshed-poisson.ply")
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.mesh.points, expected, atol=1e-5)
    assert any(
        f"the frame of COLMAP's model {folder}; it is brought" in said for said in scan.warnings
    )
    scan = read_scan(capture.folder, IngestOptions(), "colmap")
    np.testing.assert_allclose(scan.mesh.points, capture.points, atol=1e-5)


def _points_on(made, count=400):
    """(count, 3) on the surface of what a capture was made of, a hundredth of its size off it."""
    chance = np.random.default_rng(3)
    corners = made.points[made.triangles[chance.integers(len(made.triangles), size=count)]]
    places = (chance.dirichlet((1, 1, 1), count)[:, :, None] * corners).sum(axis=1)
    return places + chance.normal(scale=0.01 * np.ptp(made.points), size=places.shape)


@pytest.mark.parametrize("folder", ["colmap_sparse/0", "colmap_text"])
@pytest.mark.parametrize("name", ["mesh.ply", "meshed-poisson.ply"])
@pytest.mark.parametrize("lies", ["with the model", "with the poses", "elsewhere"])
def test_the_points_of_the_model_tell_in_which_frame_a_mesh_lies(capture, folder, name, lies):
    """Whatever it is called: renamed ones lay elsewhere, and moved ones were moved again."""
    similarity = np.eye(4)
    similarity[:3, :3] = 1.7 * Rotation.from_euler("xyz", [70, 10, -50], degrees=True).as_matrix()
    similarity[:3, 3] = 0.3, -0.2, 0.5
    _recentred(capture, folder, similarity=similarity, points=_points_on(capture))
    expected = capture.points @ similarity[:3, :3].T + similarity[:3, 3]
    stored = {"with the model": capture.points, "with the poses": expected}.get(lies)
    if stored is None:
        stored = 0.8 * expected + np.ptp(expected)
    (capture.folder / "mesh.ply").unlink()
    (capture.folder / "objects.json").unlink()
    write_ply(capture.folder / name, stored, capture.triangles, capture.face_object)
    options = IngestOptions()
    if lies == "elsewhere":
        with pytest.raises(InputRefused):
            read_scan(capture.folder, options)
        return
    scan = read_scan(capture.folder, options)
    np.testing.assert_allclose(scan.mesh.points, expected, atol=1e-5)
    told = [said for said in scan.warnings if "[mesh.frame]" in said]
    if lies == "with the model":
        assert [f"lies in the frame of COLMAP's model {folder};" in said for said in told] == [True]
    else:
        assert ["it stays there" in said for said in told] == [True] * (name != "mesh.ply")


def test_a_mesh_in_a_frame_of_its_own_is_told(capture):
    """Neither COLMAP's nor that of the poses; cameras inside of it hit it anyhow."""
    similarity = np.eye(4)
    similarity[:3, :3] = 0.4 * Rotation.from_euler("xyz", [70, 10, -50], degrees=True).as_matrix()
    corners = capture.points[capture.triangles[:: len(capture.triangles) // 100]]
    _recentred(capture, "colmap_text", similarity=similarity, points=corners.mean(axis=1))
    (capture.folder / "objects.json").unlink()
    own = np.array([3.0, 2.0, 1.0]) - capture.points
    write_ply(capture.folder / "mesh.ply", 2 * own[:, [2, 0, 1]], capture.triangles)
    told = read_scan(capture.folder, IngestOptions()).warnings
    assert any("lies neither on the points of the model colmap_text nor" in said for said in told)


def test_points_that_cannot_be_read_cost_nothing_but_what_they_tell(capture):
    """As where Git LFS has fetched the cameras alone: captures were refused that need no points."""
    similarity = np.eye(4)
    similarity[:3, :3] = 1.7 * Rotation.from_euler("xyz", [70, 10, -50], degrees=True).as_matrix()
    folder = "colmap_sparse/0"
    _recentred(capture, folder, similarity=similarity, points=_points_on(capture))
    (capture.folder / folder / "points3D.bin").write_text(POINTER)
    expected = capture.points @ similarity[:3, :3].T
    write_ply(capture.folder / "mesh.ply", expected, capture.triangles, capture.face_object)
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.mesh.points, expected, atol=1e-5)


@pytest.mark.parametrize("digits", [15, 5])
@pytest.mark.parametrize("lies", ["with the model", "with the document"])
def test_a_mesh_in_the_frame_of_the_documents_poses_is_undone_as_they_are(capture, lies, digits):
    """As it is fused of depths and these poses; that of COLMAP lies in the frame before. What is
    rounded passed for a frame of its own."""
    folder, scale = "colmap/sparse/0", 1.5
    _recentred(capture, folder, similarity=np.eye(4), points=_points_on(capture))
    with edited(capture.manifest) as document:
        document |= {"applied_transform": Y_UP[:3].tolist(), "applied_scale": scale}
        for frame in document["frames"]:
            pose = Y_UP @ np.array(frame["transform_matrix"])
            pose[:3, 3] *= scale
            frame["transform_matrix"] = pose.round(digits).tolist()
    if lies == "with the document":
        stored = scale * (capture.points @ Y_UP[:3, :3].T + Y_UP[:3, 3])
        write_ply(capture.folder / "mesh.ply", stored, capture.triangles, capture.face_object)
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.mesh.points, capture.points, atol=1e-5)
    told = [said for said in scan.warnings if "applied_transform is undone of it" in said]
    assert len(told) == (lies == "with the document")


def test_cameras_of_one_name_in_several_folders_are_told_apart(capture):
    """As rigs have them."""
    similarity = np.eye(4)
    similarity[:3, 3] = 0.3, -0.2, 0.5
    names = [f"cam{i % 2}/{i // 2:04d}.exr" for i in range(len(capture.world_from_camera))]
    _recentred(capture, "colmap_text", similarity=similarity, names=names)
    with edited(capture.manifest) as document:
        for frame, name in zip(document["frames"], names, strict=True):
            place = capture.folder / "frames" / name
            place.parent.mkdir(exist_ok=True)
            (capture.folder / frame["file_path"]).rename(place)
            frame["file_path"] = f"frames/{name}"
    (capture.folder / "mesh.ply").rename(capture.folder / "meshed-poisson.ply")
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.mesh.points, capture.points + similarity[:3, 3], atol=1e-5)


@pytest.mark.parametrize("others", ["names", "poses"])
def test_colmaps_mesh_beside_a_model_of_other_cameras_is_told(capture, others):
    count = len(capture.world_from_camera)
    similarity = np.eye(4)
    similarity[:3, 3] = 0.3, -0.2, 0.5
    names = [f"other_{i}.exr" for i in range(count)] if others == "names" else None
    _recentred(capture, "colmap_text", similarity=similarity, names=names)
    with edited(capture.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            pose = np.array(frame["transform_matrix"])
            if others == "poses":
                pose[:3, 3] += 0.4 * np.sin([i, 2 * i, 3 * i])
            frame["transform_matrix"] = pose.tolist()
    (capture.folder / "mesh.ply").rename(capture.folder / "meshed-poisson.ply")
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.mesh.points.tobytes() == capture.points.tobytes()
    assert any("frame than the poses is not known, as its" in said for said in scan.warnings)


def test_of_cameras_in_one_place_it_is_that_which_is_said(capture):
    _recentred(capture, "colmap_text", similarity=np.eye(4))
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] = 1, 1, 1
            frame["transform_matrix"] = pose.tolist()
    (capture.folder / "mesh.ply").rename(capture.folder / "meshed-poisson.ply")
    with pytest.raises(InputRefused, match=r"there is no parallax.*\[capture\.parallax\]$"):
        read_scan(capture.folder, IngestOptions())


def test_colmaps_mesh_stays_where_the_poses_are_its_models(capture):
    _recentred(capture, "colmap_text", similarity=np.eye(4))
    (capture.folder / "mesh.ply").rename(capture.folder / "meshed-poisson.ply")
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.mesh.points.tobytes() == capture.points.tobytes()
    assert not any("[mesh.frame]" in said for said in scan.warnings)
    (capture.folder / "colmap_text/images.txt").write_text("1 0 cut off")
    scan = read_scan(capture.folder, IngestOptions())
    assert any("as its model was not read" in said for said in scan.warnings)


def test_the_points_that_nerfstudio_begins_from_are_no_mesh(capture):
    points = [" ".join(map(str, p)) for p in capture.points.tolist()]
    head = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    head += [*(f"property float {axis}" for axis in "xyz"), "end_header"]
    (capture.folder / "sparse_pc.ply").write_text("\n".join([*head, *points, ""]))
    (capture.folder / "mesh.ply").rename(capture.folder / "room.ply")
    assert len(read_scan(capture.folder, IngestOptions()).mesh.points) == len(capture.points)
    (capture.folder / "room.ply").unlink()
    with pytest.raises(InputRefused, match=r"no mesh \(sparse_pc\.ply holds points alone\)\. Put"):
        read_scan(capture.folder, IngestOptions())


def test_points_are_known_by_their_header_whatever_they_are_called(capture):
    """OpenMVS and COLMAP's users call meshes fused.ply too."""
    (capture.folder / "mesh.ply").rename(capture.folder / "fused.ply")
    cloud = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    cloud += b"property float z\nelement face 0\nproperty list uchar int vertex_indices\n"
    (capture.folder / "room.ply").write_bytes(cloud + b"end_header\n0 0 0\n")
    assert len(read_scan(capture.folder, IngestOptions()).mesh.points) == len(capture.points)
    (capture.folder / "fused.ply").unlink()
    with pytest.raises(InputRefused, match=r"no mesh \(room\.ply holds points alone\)\. Put"):
        read_scan(capture.folder, IngestOptions())


def test_the_only_mesh_beside_the_poses_is_theirs(capture):
    (capture.folder / "mesh.ply").rename(capture.folder / "room.ply")
    assert len(read_scan(capture.folder, IngestOptions()).mesh.points) == len(capture.points)
    (capture.folder / "room.ply").rename(capture.folder / "room.ply.gz")
    with pytest.raises(InputRefused, match=r"no mesh. Put mesh\.ply beside the poses, or name one"):
        read_scan(capture.folder, IngestOptions())


@pytest.mark.parametrize("kind", ["ply", "obj"])
@pytest.mark.parametrize("stated", [{}, {"scale": 0.2, "offset": [0.5, 0.3, 0.8]}])
def test_meshes_of_instant_ngp_have_their_axes_turned_back(capture, kind, stated):
    """As save_mesh of marching_cubes.cu writes them: (p - offset) / scale of p = (y, z, x) of
    scale x + offset."""
    with edited(capture.manifest) as document:
        document.update(stated)
    scale, offset = stated.get("scale", 0.33), np.array(stated.get("offset", [0.5] * 3))
    inside = (capture.points * scale + offset)[:, [1, 2, 0]]
    rows = [" ".join(f"{n:.5f}" for n in p) for p in (inside - offset) / scale]
    (capture.folder / "mesh.ply").unlink()
    if kind == "ply":
        head = [
            "ply", "format ascii 1.0",
            "comment output from https://github.com/NVlabs/instant-ngp",
            f"element vertex {len(rows)}", *(f"property float {axis}" for axis in "xyz"),
            f"element face {len(capture.triangles)}", "property list uchar int vertex_index",
            "end_header",
        ]  # fmt: skip
        faces = [f"3 {a} {b} {c}" for a, b, c in capture.triangles]
        (capture.folder / "mesh.ply").write_text("\n".join([*head, *rows, *faces, ""]))
    else:
        faces = [f"f {a} {b} {c}" for a, b, c in capture.triangles + 1]
        lines = ["mtllib nerf.mtl", *(f"v {row}" for row in rows), "usemtl nerf", *faces, ""]
        (capture.folder / "fox.obj").write_text("\n".join(lines))
    (capture.folder / "objects.json").unlink()
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.mesh.points, capture.points, atol=1e-4)
    assert any("is one of instant-ngp's" in said for said in scan.warnings)


@pytest.mark.parametrize("mark", [{"from_mitsuba": True}, {"normal_mts_args": [1, 2]}])
def test_of_mitsubas_documents_instant_ngp_turns_no_axes(capture, mark):
    as_mitsubas(capture, mark)
    mesh = capture.folder / "mesh.ply"
    head = b"comment output from https://github.com/NVlabs/instant-ngp\nelement vertex"
    mesh.write_bytes(mesh.read_bytes().replace(b"element vertex", head, 1))
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.mesh.points, capture.points, atol=1e-6)
    assert not any("[mesh.frame]" in said for said in scan.warnings)


@pytest.mark.parametrize(
    "stated", [{"aabb": [[0, 0, 0], [1, 1, 1]]}, {"offset": [1, 2]}, {"scale": 0}]
)
def test_meshes_of_instant_ngp_that_lie_anywhere_are_refused(capture, stated):
    with edited(capture.manifest) as document:
        document.update(stated)
    mesh = capture.folder / "mesh.obj"
    mesh.write_text("mtllib nerf.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(InputRefused, match=r"do not say where it lies.*\[mesh\.frame\]$"):
        read_scan(capture.folder, IngestOptions(mesh=mesh))
