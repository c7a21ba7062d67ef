"""Images that say themselves which colour space they have, written by OpenImageIO."""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.scenes import edited, make_capture
from usdbrdf.capture.adapters import read_scan
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_radiance
from usdbrdf.options import IngestOptions

# The Academy's AP1 primaries and white, S-2014-004; and from them to linear Rec.709, its white
# adapted after Bradford, as the Academy publishes it.
AP1 = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
REC709_FROM_AP1 = np.array([
    [1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297],
])  # fmt: skip


def _tag(capture, **said):
    """Write all frames again with attributes of their headers."""
    for i in range(len(capture.world_from_camera)):
        pixels = read_radiance(capture.image(i))
        spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "float")
        for name, value in said.items():
            if isinstance(value, tuple):
                spec.attribute(name, oiio.TypeDesc("float[8]"), value)
            else:
                spec.attribute(name.replace("__", ":"), value)
        output = oiio.ImageOutput.create(str(capture.image(i)))
        assert output.open(str(capture.image(i)), spec)
        assert output.write_image(pixels)
        assert output.close()


@pytest.fixture
def capture(tmp_path):
    return make_capture(tmp_path / "capture")


@pytest.mark.parametrize("said", [{"chromaticities": AP1}, {"oiio__ColorSpace": "lin_ap1_scene"}])
def test_what_the_header_says_is_believed_and_told(capture, said):
    _tag(capture, **said)
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.frames.encoding == "lin_ap1_scene"
    assert any("lin_ap1_scene" in s and "[capture.encoding]" in s for s in scan.warnings)
    stored = read_radiance(capture.image(0))
    shown = read_frame(scan.frames, 0)
    expected = stored @ REC709_FROM_AP1.T
    assert np.allclose(shown.radiance[shown.valid], expected[shown.valid], rtol=2e-3, atol=2e-3)


def test_the_document_and_the_user_come_before_the_header(capture):
    _tag(capture, chromaticities=AP1)
    own = read_scan(capture.folder, IngestOptions(encoding="lin_rec2020_scene"))
    assert own.frames.encoding == "lin_rec2020_scene"
    with edited(capture.folder / "transforms.json") as document:
        document["encoding"] = "lin_rec709_scene"
    assert read_scan(capture.folder, IngestOptions()).frames.encoding == "lin_rec709_scene"


def test_a_header_that_says_nothing_known_changes_nothing(capture):
    _tag(capture, chromaticities=(0.6, 0.3, 0.3, 0.5, 0.1, 0.1, 0.3, 0.3))
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.frames.encoding == "lin_rec709_scene"
    assert not any("[capture.encoding]" in sentence for sentence in scan.warnings)
