"""What lies where no adapter recognises a capture, and how to make one of it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from usdbrdf.errors import InputRefused

# As in ``named_pictures`` and ``mesh_files``, which load NumPy; a glance needs names alone.
_PICTURES = frozenset((".exr", ".hdr", ".tif", ".tiff", ".png", ".jpg", ".jpeg"))
_MESHES = frozenset((".ply", ".obj", ".glb", ".gltf", ".stl", ".fbx"))
_STAGES = frozenset((".usd", ".usda", ".usdc", ".usdz"))
_OF_COLMAP = frozenset(
    f"{part}.{kind}" for part in ("cameras", "images", "points3D") for kind in ("bin", "txt")
)
# Whose bytes say nothing of a program; and which may hold cameras, that are not read.
_NO_DOCUMENTS = _PICTURES | _MESHES | _STAGES
_SCENES = frozenset((".fbx", ".glb", ".gltf"))
# What is no capture yet, whatever else it holds: by suffixes, what it is and what to do.
_NOT_YET = (
    (
        (".zip", ".7z", ".rar", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".zst"),
        "is an archive. Unpack it, and name the folder of what it held",
    ),
    (
        (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".insv", ".360"),
        "is a video, which does not say where its camera stood. Extract frames, have their poses "
        "found (COLMAP), and name the folder that holds both",
    ),
    (
        (
            ".heic", ".heif", ".hif", ".webp", ".avif", ".jxl", ".bmp",
            ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf",
        ),
        "is a picture of a kind that is not read here, and nothing says where its camera stood. "
        "Have the poses of all found (COLMAP, Metashape), and name the folder that holds both",
    ),
    (
        (".las", ".laz", ".pts", ".ptx", ".pcd", ".rcp", ".rcs", ".splat", ".ksplat", ".spz"),
        "holds points or splats alone. Make a mesh of the scan, and bring the photographs with "
        "the document of their cameras",
    ),
)  # fmt: skip
_MOST_FILES, _HEAD = 10_000, 4096  # looked at in a folder; bytes of a document


class _Program(NamedTuple):
    """Whose cameras are not read: how their documents begin, end or are called, and what to do.

    suffixes, names  of documents that are theirs whatever they say; names begin those of JSON
    says             what their documents say in their first bytes
    only             documents of this name alone are theirs if they say that; "": of any
    """

    name: str
    suffixes: tuple[str, ...]
    names: tuple[str, ...]
    says: bytes
    how: str
    only: str = ""

    def owns(self, document: Path, head: bytes) -> bool:
        name = document.name.lower()
        if name.endswith(self.suffixes) or (name.endswith(".json") and name.startswith(self.names)):
            return True
        return self.only in ("", name) and re.search(self.says, head) is not None


_ANEW = "Reconstruct the same photographs with COLMAP, and name its folder"
_BY_HAND = "Write a transforms.json of the pictures' poses and lens"
_AS_USD = "Export cameras and meshes as USD, and convert that"
_NOTHING = rb"(?!)"

# The beginning of a table: three rows of one number and so many before it; and the last row of four
# that turn and move, without which they may be any numbers.
_TABLE = rb"\A(?:[ \t]*(?:[-+.\deE]+[ \t,]+){%b}[-+.\deE]+[ \t]*\r?\n){3}"
_OF_A_POSE = rb"[ \t]*(?:-?0(?:\.0*)?(?:[eE][-+]?\d+)?[ \t,]+){3}1(?:\.0*)?(?:[eE][-+]?0+)?\s*\Z"
# Of Open3D's logs: three whole numbers, and a matrix of four rows. And of what others' tables and
# lists begin with that are read, the former by one name alone.
OPEN3D_LOG = rb"\A\d+\s+\d+\s+\d+[ \t\r]*\n(?:[ \t]*(?:[-+.\de]+\s+){4}){4}"
STRAY_TABLE = rb"\A(?:\xef\xbb\xbf)?timestamp, *frame, *x, *y, *z, *qx"
OF_MATTERPORT = rb"(?m)^dataset matterport"
_PROGRAMS = (
    _Program(
        "OpenMVG", ("sfm_data.bin", "sfm_data.xml"), (), _NOTHING,
        "Make a sfm_data.json of them with openMVG_main_ConvertSfM_DataFormat",
    ),
    _Program(
        "Meshroom", (".mg", ".baf"), (), _NOTHING,
        "Name cameras.sfm, which its node StructureFromMotion writes",
    ),
    _Program(
        "OpenSfM", (), (), rb'"shots"', "Call the file reconstruction.json, and name its folder",
    ),
    _Program("VisualSFM", (".nvm",), (), rb"NVM_V", _ANEW),
    _Program(
        "Polycam", (), (), rb'"t_00"',
        "Name the whole folder of its raw data, which holds keyframes/, raw.glb and mesh_info.json",
    ),
    _Program(
        "Record3D", (), (), rb'"poses"',
        "Name the folder of its export, in which rgb/ lies beside it",
        "metadata.json",
    ),
    # "metadata" of one that has been unpacked.
    _Program(
        "Record3D", (".r3d",), (), rb'"poses"',
        "Unzip the .r3d, which is a ZIP file, and name the folder that has metadata and rgbd/",
        "metadata",
    ),
    _Program(
        "Open3D", (), (), rb'"PinholeCameraParameters"',
        "Put the picture of each beside it, of its name or called ScreenCapture for ScreenCamera",
    ),
    _Program(
        "ScanNet", (".sens",), (), _NOTHING,
        "Unpack it here with ScanNet's reader.py (--export_color_images --export_poses "
        "--export_intrinsics)",
    ),
    _Program(
        "TUM RGB-D", (), (), rb"(?m)\A# ground truth trajectory|^# *timestamp +tx +ty +tz +qx",
        f"{_BY_HAND}, and fuse the depths into a mesh (Open3D)",
    ),
    _Program(
        "7-Scenes", (".pose.txt",), (), _NOTHING,
        f"{_BY_HAND}, and fuse the depths into a mesh (Open3D)",
    ),
    _Program(
        "ARKitScenes", (".traj", ".pincam"), (), _NOTHING,
        "Name the video's folder, which has lowres_wide.traj, lowres_wide/ and its _intrinsics/",
    ),
    _Program(
        "Gaussian splatting", (), (), rb'"img_name"',
        "Name the folder of the COLMAP model that the splats were trained on", "cameras.json",
    ),
    _Program("SDFStudio", (), (), rb'"camtoworld"', _ANEW),
    _Program("NeuS", (), (), rb"\APK", _ANEW, "cameras_sphere.npz"),
    _Program("IDR", (), (), rb"\APK", _ANEW, "cameras.npz"),
    _Program(
        "Metashape", (".psx", ".psz"), (), _NOTHING,
        "Export them (File > Export > Export Cameras, XML) and the model into one folder",
    ),
    _Program(
        "RealityScan", (".rcproj", ".rsproj"), (), _NOTHING,
        "Export 'Internal/External camera parameters' (CSV) and the model into one folder",
    ),
    _Program("OpenMVS", (".mvs",), (), _NOTHING, _ANEW),
    _Program(
        "ContextCapture", (".xmz",), (), _NOTHING,
        "Unzip it: it holds a BlocksExchange XML, which is read",
    ),
    # Name, places in any coordinates and angles: all of its tables but the one that is read. Who
    # measures markers writes names and places too, but no angles, and no # before them.
    _Program(
        "RealityScan", (), (),
        rb"(?mi)^(#)? *name *, *x[^,\n]*, *y[^,\n]*, *(?:z|alt)\b"
        rb"(?(1)|(?=[^,\n]*, *(?:heading|yaw|omega)))",
        "Export 'Internal/External camera parameters' (CSV) instead, which has the lens too",
    ),
    _Program(
        "Pix4D", (), (), rb"\A *imageName +X +Y +Z +Omega",
        "Bring the project's 1_initial/params/*_calibrated_camera_parameters.txt",
    ),
    _Program(
        "Metashape", (), (), rb"(?mi)^#.*\bomega\b.*\bphi\b.*\bkappa\b",
        "Export them as Agisoft XML (File > Export > Export Cameras), which has the lens too",
    ),
    _Program(
        "Pix4D", (".p4d", "camera_parameters.txt", "camera_parameters.cam", "pmatrix.txt"), (),
        _NOTHING, "Bring the project's 1_initial/params/*_calibrated_camera_parameters.txt",
    ),
    _Program(
        "PIX4Dmatic", (), (), rb'"application/opf-(?!project)',
        "Name the project's folder, which has its .opf",
    ),
    _Program(
        "OpenDroneMap", ("shots.geojson",), (), _NOTHING,
        "Bring opensfm/reconstruction.json of the project, and a mesh in its frame",
    ),
    _Program("MicMac", (), (), rb"<(?:ExportAPERO|OrientationConique)>", _ANEW),
    _Program(
        "ScanNet++'s telephone", ("pose_intrinsic_imu.json",), (), _NOTHING,
        "Name the scene's folder, which holds dslr/ and scans/",
    ),
    _Program(
        "Spectacular AI", (), (), rb'\A\s*\{[^\n]*"time"',
        "Make a transforms.json of them with its 'sai-cli process', and a mesh in its frame",
        "data.jsonl",
    ),
    # Along which it is rendered, or which its viewer has stored.
    _Program(
        "nerfstudio's renders", (), ("camera_path",), _NOTHING,
        "Name the transforms.json of the photographs",
    ),
    _Program(
        "Nerfies", (), (), rb'\A\s*\{(?=[^}]*"orientation")(?=[^}]*"pixel_aspect_ratio")', _BY_HAND,
    ),
    _Program("EasyMocap", ("extri.yml", "intri.yml"), (), _NOTHING, _BY_HAND),
    # Rows of a time, a place and a quaternion, or of a matrix of 3 x 4.
    _Program(
        "ORB-SLAM", ("trajectory.txt",), (), _NOTHING,
        f"{_BY_HAND}, and fuse the depths into a mesh (Open3D)",
    ),
    _Program(
        "KITTI", (), (), rb"\A(?:[-+.\de]+ ){11}[-+.\de]+\r?\n",
        f"{_BY_HAND}, and fuse the depths into a mesh (Open3D)", "poses.txt",
    ),
    _Program(
        "Replica for Semantic-NeRF", ("traj_w_c.txt",), (), _NOTHING,
        f"{_BY_HAND}, and name the scene's mesh in it",
    ),
    _Program(
        "RTAB-Map", (), (), rb"\A#timestamp x y z qx qy qz qw",
        f"{_BY_HAND}, and put the mesh that it exports beside it",
    ),
    _Program(
        "MultiScan", (), (), rb'\A\s*\{[^\n]*"exposure_duration"',
        f"Extract the video's frames. {_BY_HAND} and its mesh",
    ),
    _Program(
        "Project Aria", (".vrs", "closed_loop_trajectory.csv"), (), _NOTHING,
        f"{_BY_HAND} (projectaria_tools has both), and name a mesh",
    ),
    _Program("EuRoC", (), (), rb"\A#timestamp.*p_RS_R_x", f"{_BY_HAND}, and fuse a mesh (Open3D)"),
    _Program(
        "Stray Scanner", (), (), STRAY_TABLE, "Call it odometry.csv, and name its folder",
    ),
    _Program(
        "NavVis", (), (), rb"\A# *pano poses",
        f"{_BY_HAND} (EQUIRECTANGULAR), and name the scan's mesh in it",
    ),
    _Program("MVSNet", ("_cam.txt",), (), _NOTHING, f"{_BY_HAND}, and name the scene's mesh in it"),
    _Program(
        "Hypersim", ("camera_keyframe_positions.hdf5", "metadata_cameras.csv"), (), _NOTHING,
        f"{_BY_HAND}, and name the scene's mesh in it",
    ),
    _Program(
        "kapture", (), (), rb"\A# *kapture format",
        "Make a COLMAP model of them with kapture_export_colmap.py",
    ),
    _Program("MVE", (), (), rb"\A# *MVE view meta data", _ANEW, "meta.ini"),
    _Program("PMVS", (), (), rb"\ACONTOUR", _ANEW),
    _Program("Strecha's benchmark", (".camera",), (), _NOTHING, _BY_HAND),
    _Program("MeshLab", (".mlp",), (), _NOTHING, _BY_HAND),
    _Program("ROS", (".bag", ".mcap"), (), _NOTHING, f"Extract the photographs. {_ANEW}"),
    _Program("Blender", (".blend",), (), _NOTHING, _AS_USD),
    _Program("Houdini", (".hip", ".hiplc", ".hipnc"), (), _NOTHING, _AS_USD),
    _Program("Maya", (".ma", ".mb"), (), _NOTHING, _AS_USD),
    _Program("Cinema 4D", (".c4d",), (), _NOTHING, _AS_USD),
    _Program("Nuke", (".nk", ".chan"), (), _NOTHING, f"Import them into Blender. {_AS_USD}"),
    # By their numbers alone, so after all that say who wrote them: a row of each camera, or a file.
    _Program(
        "KITTI", (), (), _TABLE % b"11", f"{_BY_HAND}, and fuse the depths into a mesh (Open3D)",
    ),
    _Program(
        "Replica for NICE-SLAM", (), (), _TABLE % b"15",
        "Call the file traj.txt, and put its pictures into results/ and the mesh beside them",
    ),
    _Program(
        "TUM RGB-D", (), (), _TABLE % b"7", f"{_BY_HAND}, and fuse the depths into a mesh (Open3D)",
    ),
    _Program(
        "a data set with a file of each camera", (), (), _TABLE % b"3" + _OF_A_POSE,
        f"{_BY_HAND}, and name the scene's mesh in it",
    ),
    _Program(
        "COLMAP", (), (), rb"\ASQLite format 3",
        "This database has no poses: have them found with 'colmap mapper'", "database.db",
    ),
)  # fmt: skip


def of_record3d(metadata: Path) -> bool:
    """Whether a file of this name is Record3D's: others call theirs so too, and its keys have no
    order."""
    from usdbrdf.files.documents import read_text
    from usdbrdf.files.tables import beginning_in_utf8

    if beginning_in_utf8(metadata).lstrip()[:1] != b"{":
        return False
    with suppress(InputRefused):
        said = read_text(metadata)
        return '"poses"' in said and ('"K"' in said or '"perFrameIntrinsicCoeffs"' in said)
    return False


def other_program(document: Path) -> str:
    """Whose cameras a file holds that are not read, and how to have them read, or that it has not
    been fetched; else ""."""
    from usdbrdf.files.paths import why_not_fetched
    from usdbrdf.files.tables import beginning_of

    if (why := why_not_fetched(document)) is not None:
        return f"{document.name} is {why}"
    head = beginning_of(document, _HEAD)
    for one in _PROGRAMS:
        if one.owns(document, head):
            said = f"holds the cameras of {one.name}, which are not read as they lie"
            return f"{document.name} {said}. {one.how}"
    return ""


def what_lies_there(path: Path, *, above: Path | None = None) -> str:
    """One sentence on what a folder or file is that is no capture, one on what to do.

    above  a folder that it lies in and that is a capture: its pictures or mesh are that one's
    """
    if path.is_file() and path.name in _OF_COLMAP:
        return (
            f"{path.name} is a part of a COLMAP model. Name the folder that holds the model and "
            "its images"
        )
    files = list(_files(path))
    # The parts into which the first NeRFs, and who follows them, divide their photographs.
    parts = [f for f in files if f.match("transforms_*.json")]
    if parts:
        largest = max(parts, key=lambda file: file.stat().st_size)
        return f"{largest.name} holds the cameras of some of its pictures. Name that file"
    if (said := _by_another_name(files)) != "":
        return said
    for file in files:
        if file.suffix.lower() not in _NO_DOCUMENTS and (said := other_program(file)):
            return said
    halves = [file.name for file in files if file.name in _OF_COLMAP]
    if halves:
        return (
            f"it holds {', '.join(halves[:3])} of a COLMAP model, which is not whole without "
            "cameras and images of one kind (.bin or .txt). Export it again"
        )
    stages = [file for file in files if file.suffix.lower() in _STAGES and file.parent == path]
    if len(stages) > 1:
        return (
            f"it holds {len(stages)} USD files, first {stages[0].name}. Name the one that has "
            "cameras and meshes"
        )
    scans = [file for file in files if file.suffix.lower() == ".e57"]
    if scans:
        return (
            f"{scans[0].name} is an E57 without pictures. Export the stations with their "
            "photographs"
            if len(scans) == 1
            else f"it holds {len(scans)} E57 files, first {scans[0].name}. Name the one whose "
            "stations took the pictures"
        )
    pictures = sum(file.suffix.lower() in _PICTURES for file in files)
    meshes = [file for file in files if file.suffix.lower() in _MESHES]
    held = f"{pictures} picture{'s' * (pictures != 1)}" if pictures else ""
    if meshes:
        first = f"the mesh {meshes[0].name}" if len(meshes) == 1 else f"{len(meshes)} meshes"
        held = f"{held} and {first}" if held else first
    if not held and (said := _not_yet(files)):
        return said
    if not held:
        return "it holds neither pictures nor cameras. Name the folder that holds the capture"
    if above is not None:
        return f"it holds {held} of the capture in {above}. Name that folder"
    how = (
        "Export them with the mesh as USD, or bring the scanning program's document of its cameras"
        if any(mesh.suffix.lower() in _SCENES for mesh in meshes)
        else "Bring the document that the scanning program writes of its cameras"
        if meshes
        else "Have them found (COLMAP, Metashape, RealityScan), and name the folder that holds both"
    )
    return f"it holds {held}, but nothing known here says where the cameras stood. {how}"


def _by_another_name(files: Sequence[Path]) -> str:
    """Which of these is a transforms.json that is called otherwise, as Transforms.json, or with a
    (1) or .txt behind it, and what to do; "" where none is."""
    from usdbrdf.files.tables import beginning_of

    for file in files:
        if file.suffix.lower() in (".json", ".txt"):
            head = beginning_of(file, _HEAD)
            if b'"frames"' in head and b'"transform_matrix"' in head and b'"file_path"' in head:
                return f"{file.name} has poses as a transforms.json has. Call it transforms.json"
    return ""


def _not_yet(files: Sequence[Path]) -> str:
    """What the first of these files is that may become a capture, and how; "" where none is."""
    for suffixes, what in _NOT_YET:
        for file in files:
            if file.suffix.lower() in suffixes:
                return f"{file.name} {what}"
    return ""


def _files(path: Path) -> Iterator[Path]:
    """The file, or those in the folder, in its folders and in theirs, some thousands of them."""
    if path.is_file():
        yield path
        return
    below = (sorted(path.glob(pattern)) for pattern in ("*/", "*/*/"))
    places = [path, *(p for found in below for p in found if p.name[0] != ".")]
    listed = (file for place in places for file in sorted(place.iterdir()))
    for _, file in zip(range(_MOST_FILES), listed, strict=False):
        if file.is_file() and file.name[0] != ".":
            yield file
