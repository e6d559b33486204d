"""Frames written as DICOM come back as they were, with their scale and pace, through pydicom and this package's own reader."""

from __future__ import annotations

import io
import json
from datetime import datetime

import numpy as np
import pydicom
import pytest

from echospline.errors import InputError
from echospline.io import dicom_cine, open_recording, read_image
from echospline.viewer.recordings import as_dicom
from live_scene import get, running

RNG = np.random.default_rng(8)
GREY = RNG.integers(0, 256, (5, 33, 47), dtype=np.uint8)  # an odd number of bytes
COLOUR = RNG.integers(0, 256, (3, 20, 30, 3), dtype=np.uint8)


@pytest.mark.parametrize("frames", [GREY, GREY[:1], COLOUR], ids=["grey", "one", "colour"])
def test_pydicom_reads_every_pixel_and_the_pace(frames):
    read = pydicom.dcmread(
        io.BytesIO(dicom_cine(frames, 24.0, (0.2, 0.1), title="Calf \\ 1", when=datetime(2026, 3, 1, 10, 20)))
    )
    np.testing.assert_array_equal(np.squeeze(read.pixel_array), np.squeeze(frames))
    assert read.SOPClassUID.name == "Ultrasound Multi-frame Image Storage"
    assert int(read.NumberOfFrames) == len(frames)
    assert float(read.FrameTime) == pytest.approx(1000 / 24, rel=1e-5)
    assert (read.StudyDate, read.ContentTime, read.SeriesDescription) == ("20260301", "102000", "Calf  1")
    assert read.file_meta.MediaStorageSOPInstanceUID == read.SOPInstanceUID


def test_this_packages_reader_takes_scale_and_pace_from_it(tmp_path):
    path = tmp_path / "page.dcm"
    path.write_bytes(dicom_cine(GREY, 24.0, (0.2, 0.1)))
    image = read_image(path)
    assert image.grid.spacing == pytest.approx((0.2, 0.1))
    np.testing.assert_array_equal(image.pixels, GREY[0])
    recording = open_recording(path)
    assert recording.frames == 5
    without = tmp_path / "sector.dcm"
    without.write_bytes(dicom_cine(GREY, 24.0, None))
    with pytest.raises(InputError, match="spacing"):
        read_image(without)


@pytest.mark.parametrize(
    ("frames", "rate", "spacing", "match"),
    [
        (GREY.astype(np.float32), 24.0, None, "uint8"),
        (GREY[0], 24.0, None, r"\(n, rows, columns\)"),
        (COLOUR[..., :2], 24.0, None, "uint8 of shape"),
        (GREY[:0], 24.0, None, "one frame or more"),
        (GREY, 0.0, None, "frames per second"),
        (GREY, float("nan"), None, "frames per second"),
        (GREY, 24.0, (0.1, 0.0), "spacing"),
    ],
)
def test_what_no_file_can_hold_is_refused(frames, rate, spacing, match):
    with pytest.raises(InputError, match=match):
        dicom_cine(frames, rate, spacing)


HEAD = {"columns": 47, "rows": 33, "frames": 5, "spacing": [0.2, 0.1], "title": "Calf"}


def sent(head=HEAD, pixels=None):
    pixels = GREY.tobytes() if pixels is None else pixels
    return json.dumps(head).encode() + b"\n" + pixels


def test_a_page_gets_its_frames_as_dicom(tmp_path):
    with running(tmp_path) as (address, _, _):
        status, headers, body = get(address, "/api/dicom?rate=24", "POST", sent())
        assert (status, headers["content-type"]) == (200, "application/dicom")
        read = pydicom.dcmread(io.BytesIO(body))
        np.testing.assert_array_equal(read.pixel_array, GREY)
        assert read.SequenceOfUltrasoundRegions[0].PhysicalDeltaX == pytest.approx(0.02)
        status, _, said = get(address, "/api/dicom?rate=24", "POST", sent()[:-1])
        assert (status, b"7755 bytes" in said) == (422, True)


@pytest.mark.parametrize(
    ("data", "rate"),
    [
        (b"", "30"), (b"{}\n", "30"), (b"[" * 5000 + b"\n", "30"), (b"x" * 10_000, "30"), (sent({**HEAD, "columns": 10**9}), "30"),
        (sent({**HEAD, "frames": 0}), "30"), (sent({**HEAD, "samples": 2}), "30"), (sent({**HEAD, "more": 1}), "30"),
        (sent({**HEAD, "spacing": [0, 1]}), "30"), (sent(pixels=b""), "30"), (sent(), "fast"), (sent(), "nan"), (sent(), "-1"),
    ],
)  # fmt: skip
def test_frames_that_are_not_what_they_say_are_refused(data, rate):
    with pytest.raises(InputError):
        as_dicom(data, rate)
