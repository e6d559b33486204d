"""DICOM: spacing, region, colours and times as other decoders and the pictures' own rulers say."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import pydicom
import pytest
from PIL import Image
from pydicom.data import get_testdata_file
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.encaps import encapsulate, generate_frames
from pydicom.uid import ExplicitVRLittleEndian, UltrasoundMultiFrameImageStorage

from echospline.errors import InputError, MissingExtraError
from echospline.io import open_recording, read
from echospline.scene import Cine, UltrasoundImage

SONOQUE = "itkpocus/sonoque_anechoic-3mm-3mm.dcm"
CARDIAC = "pydicom/examples_ybr_color.dcm"


def jpeg_frames(path: Path) -> list[Image.Image]:
    """Frames as libjpeg alone decodes them, by the JPEG's own markers."""
    header = pydicom.dcmread(path)
    frames = generate_frames(header.PixelData, number_of_frames=int(header.get("NumberOfFrames") or 1))
    return [Image.open(BytesIO(frame)) for frame in frames]


def ultrasound(
    path: Path, *regions: dict[str, object], frames: int = 3, size: tuple[int, int] = (40, 60), **more: object
) -> np.ndarray:
    """Write a small grey multi-frame file and return its pixels."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = UltrasoundMultiFrameImageStorage
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    meta.MediaStorageSOPInstanceUID = "1.2.3.4"
    data = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPInstanceUID = "1.2.3.4"
    data.SOPClassUID, data.Modality = UltrasoundMultiFrameImageStorage, "US"
    data.Rows, data.Columns, data.NumberOfFrames = (*size, frames)
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated = data.BitsStored = 8
    data.HighBit, data.PixelRepresentation = 7, 0
    pixels = np.random.default_rng(1).integers(0, 256, (frames, *size), dtype=np.uint8)
    data.PixelData = pixels.tobytes()
    items = []
    for region in regions:
        item = Dataset()
        item.RegionSpatialFormat, item.RegionDataType = 1, 1
        item.PhysicalUnitsXDirection = item.PhysicalUnitsYDirection = 3
        for name, value in region.items():
            setattr(item, name, value)
        items.append(item)
    if items:
        data.SequenceOfUltrasoundRegions = items
    for name, value in more.items():
        setattr(data, name, value)
    data.save_as(path, enforce_file_format=True)
    return pixels


def box(x0: int, y0: int, x1: int, y1: int, **more: object) -> dict[str, object]:
    """Region with 0.02 cm across and 0.01 cm down."""
    names = ("RegionLocationMinX0", "RegionLocationMinY0", "RegionLocationMaxX1", "RegionLocationMaxY1")
    return {
        **dict(zip(names, (x0, y0, x1, y1), strict=True)),
        "PhysicalDeltaX": 0.02,
        "PhysicalDeltaY": 0.01,
        **more,
    }


def test_spacing_comes_from_the_region_and_agrees_with_the_depth_ruler(recordings: Path) -> None:
    image = read(recordings / SONOQUE)
    assert isinstance(image, UltrasoundImage)
    assert image.spacing == pytest.approx((0.0291, 0.0291))
    # The ruler at the left edge: its long ticks, one or two rows high, are 10 mm apart.
    marked = np.flatnonzero(image.pixels[:, 20] > 60)
    runs = np.split(marked, np.flatnonzero(np.diff(marked) > 1) + 1)
    ticks = np.array([run.mean() for run in runs if len(run) <= 2])
    assert len(ticks) == 4
    np.testing.assert_allclose(np.diff(ticks) * image.spacing[1], 10.0, rtol=0.005)


def test_jpeg_labelled_rgb_is_decoded_as_the_jpeg_itself_says(recordings: Path) -> None:
    image = read(recordings / SONOQUE, colour=True)
    expected = np.asarray(jpeg_frames(recordings / SONOQUE)[0].convert("RGB")).astype(int)
    assert np.abs(image.pixels.astype(int) - expected).max() <= 2
    assert "YCbCr" in image.source
    region = read(recordings / SONOQUE, region=(370, 60, 1700, 1412), colour=True).pixels.astype(int)
    assert (region.max(axis=2) - region.min(axis=2)).max() <= 4  # speckle is grey, not green and purple


def test_region_keeps_the_burnt_in_margins_out_of_the_tissue(recordings: Path) -> None:
    image = read(recordings / SONOQUE, region=(370, 60, 1700, 1412))
    whole = read(recordings / SONOQUE)
    np.testing.assert_array_equal(image.pixels, whole.pixels[60:1412, 370:1700])
    assert image.spacing == whole.spacing
    assert "margins" in whole.source


def test_regions_of_a_larger_matrix_are_rescaled_and_said_so(recordings: Path) -> None:
    path = recordings / CARDIAC
    cine = read(path)
    header = pydicom.dcmread(path, stop_before_pixels=True)
    delta = header.SequenceOfUltrasoundRegions[0].PhysicalDeltaX
    assert isinstance(cine, Cine)
    # 640 x 480 regions on 320 x 240 pixels: one pixel is two of the scanner's, cm become mm
    assert cine.grid.spacing == pytest.approx((2 * 10 * delta, 2 * 10 * delta))
    assert cine.frames.shape == (30, 191, 256)
    assert "2 times as large (640 x 480)" in cine.source
    np.testing.assert_allclose(cine.times, np.arange(30) * 0.033333)


def test_ycbcr_frames_equal_libjpegs_luma(recordings: Path) -> None:
    path = recordings / CARDIAC
    cine = read(path)
    left, top, right, bottom = open_recording(path).region or (0, 0, 0, 0)
    for k in (0, 13, 29):
        luma = np.asarray(jpeg_frames(path)[k].convert("L")).astype(int)[top:bottom, left:right]
        assert np.abs(cine.frames[k] - luma).max() <= 2
    one = read(path, frame=13)
    np.testing.assert_array_equal(one.pixels, cine.frames[13])


def test_palette_colours_and_a_picture_cut_at_the_bottom() -> None:
    path = get_testdata_file("examples_palette.dcm")
    image = read(path)
    # The picture's own ruler: blue ticks at rows 97 and 287 are 5 cm apart.
    assert 190 * image.spacing[1] == pytest.approx(50, rel=0.01)
    assert "bottom" in image.source
    assert image.grid.shape == (680, 290)
    assert image.pixels.dtype == np.uint8
    header = pydicom.dcmread(path)
    red, green, blue = (
        np.frombuffer(header[f"{c}PaletteColorLookupTableData"].value, "<u2") >> 8
        for c in ("Red", "Green", "Blue")
    )
    index = header.pixel_array[60:350, 120:800]
    np.testing.assert_allclose(
        image.pixels, 0.299 * red[index] + 0.587 * green[index] + 0.114 * blue[index], atol=0.51
    )


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("examples_rgb_color.dcm", (240, 320)),
        ("examples_jpeg2k.dcm", (480, 640)),
        ("SC_rgb_rle.dcm", (100, 100)),
        ("SC_ybr_full_422_uncompressed.dcm", (100, 100)),
        ("ExplVR_BigEnd.dcm", (60, 80)),
        ("image_dfl.dcm", (512, 512)),
        ("MR_small_padded.dcm", (64, 64)),
    ],
)
def test_every_transfer_syntax_that_needs_no_extra_is_read(name: str, shape: tuple[int, int]) -> None:
    path = get_testdata_file(name)
    image = read(path, spacing=(0.1, 0.1))
    assert image.pixels.shape == shape
    assert image.pixels.std() > 1


KILLS = [(4743, 145), (4967, 179), (4028, 74), (1631, 224), (5010, 95), (1353, 202)]
"""Bytes of the first lossless file, and values that make GDCM 3.2 abort its process."""
LOSSLESS = ["SC_rgb_jpeg_gdcm.dcm", "MR_small_jpeg_ls_lossless.dcm"]


@pytest.mark.parametrize("name", LOSSLESS)
def test_a_compression_that_needs_the_extra_says_which(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("echospline.io.dicom.pixels.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"pip install 'echospline\[dicom\]'"):
        read(get_testdata_file(name), spacing=(0.1, 0.1))


@pytest.mark.parametrize(("name", "same"), [*zip(LOSSLESS, ["SC_rgb_rle.dcm", "MR_small.dcm"], strict=True)])
def test_lossless_jpeg_equals_the_picture_without_it(name: str, same: str) -> None:
    pytest.importorskip("gdcm", reason="the extra dicom is not installed")
    image = read(get_testdata_file(name), colour=True)
    np.testing.assert_array_equal(image.pixels, pydicom.dcmread(get_testdata_file(same)).pixel_array)


def test_lossless_frames_are_read_one_by_one_or_all(tmp_path: Path) -> None:
    pytest.importorskip("gdcm", reason="the extra dicom is not installed")
    data = pydicom.dcmread(get_testdata_file(LOSSLESS[1]))
    frame = next(generate_frames(data.PixelData, number_of_frames=1))
    data.PixelData, data.NumberOfFrames = encapsulate([frame, frame]), 2
    data.save_as(tmp_path / "a.dcm")
    cine = read(tmp_path / "a.dcm", fps=10)
    assert cine.frames.shape == (2, 64, 64)
    np.testing.assert_array_equal(cine.frames[0], cine.frames[1])
    np.testing.assert_array_equal(read(tmp_path / "a.dcm", frame=1).pixels, cine.frames[0])


def test_a_frame_that_kills_the_lossless_decoder_is_one_damaged_file(tmp_path: Path) -> None:
    pytest.importorskip("gdcm", reason="the extra dicom is not installed")
    content = bytearray(Path(get_testdata_file(LOSSLESS[0])).read_bytes())
    for where, value in KILLS:
        content[where] = value
    (tmp_path / "a.dcm").write_bytes(content)
    with pytest.raises(InputError, match="cannot be decoded"):
        read(tmp_path / "a.dcm")


def test_twelve_bit_jpeg_has_no_decoder_and_is_not_called_damaged() -> None:
    with pytest.raises(InputError, match="12 bits, for which there is no decoder"):
        read(get_testdata_file("JPGExtended.dcm"))


def test_lateral_and_depth_spacing_are_not_swapped(tmp_path: Path) -> None:
    pixels = ultrasound(tmp_path / "a.dcm", box(10, 5, 49, 34), CineRate=20)
    cine = read(tmp_path / "a.dcm")
    assert cine.grid.spacing == (0.2, 0.1)
    np.testing.assert_array_equal(cine.frames, pixels[:, 5:35, 10:50])
    np.testing.assert_allclose(cine.times, [0, 0.05, 0.1])
    ultrasound(tmp_path / "b.dcm", PixelSpacing=[0.3, 0.4], FrameTimeVector=[7, 40, 60])  # rows first
    cine = read(tmp_path / "b.dcm")
    assert cine.grid.spacing == (0.4, 0.3)
    np.testing.assert_allclose(cine.times, [0, 0.04, 0.1])


def test_the_tissue_region_is_preferred_to_larger_others(tmp_path: Path) -> None:
    doppler = box(0, 0, 59, 39, RegionSpatialFormat=3, RegionDataType=3, PhysicalUnitsXDirection=4)
    flow = box(0, 0, 50, 30, RegionDataType=2)
    ultrasound(tmp_path / "a.dcm", doppler, flow, box(8, 4, 20, 14), FrameTime=50)
    recording = open_recording(tmp_path / "a.dcm")
    assert recording.region == (8, 4, 21, 15)
    assert [r.content for r in recording.regions] == ["spectral PW Doppler", "2-D colour flow", "2-D tissue"]


def test_a_file_without_lengths_names_the_option(tmp_path: Path) -> None:
    ultrasound(tmp_path / "a.dcm", box(0, 0, 30, 30, PhysicalUnitsXDirection=0), FrameTime=50)
    with pytest.raises(InputError, match="--spacing LAT,DEPTH"):
        read(tmp_path / "a.dcm")
    assert read(tmp_path / "a.dcm", spacing=(0.3, 0.2)).grid.spacing == (0.3, 0.2)


def test_a_cine_without_times_names_the_option(tmp_path: Path) -> None:
    ultrasound(tmp_path / "a.dcm", box(0, 0, 30, 30))
    with pytest.raises(InputError, match="--fps"):
        read(tmp_path / "a.dcm")
    np.testing.assert_allclose(read(tmp_path / "a.dcm", fps=10).times, [0, 0.1, 0.2])
    assert read(tmp_path / "a.dcm", frame=2).pixels.shape == (31, 31)


def test_white_on_black_is_restored(tmp_path: Path) -> None:
    pixels = ultrasound(
        tmp_path / "a.dcm", box(0, 0, 59, 39), PhotometricInterpretation="MONOCHROME1", FrameTime=40
    )
    np.testing.assert_array_equal(read(tmp_path / "a.dcm").frames, 255 - pixels)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"NumberOfFrames": 2_000_000_000}, "more than the limit"),
        ({"Rows": 65535, "Columns": 65535}, "more than the limit"),
        ({"NumberOfFrames": 4}, "damaged|cut short"),
        ({"Rows": 0}, "one or more"),
        ({"BitsAllocated": 64}, "64 bits"),
        ({"PhotometricInterpretation": "HSV"}, "expected MONOCHROME"),
    ],
)
def test_a_header_that_promises_what_is_not_there_is_refused(
    tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    ultrasound(tmp_path / "a.dcm", box(0, 0, 30, 30), FrameTime=40, **changes)
    with pytest.raises(InputError, match=message):
        read(tmp_path / "a.dcm")


def test_a_report_is_no_picture() -> None:
    with pytest.raises(InputError, match="holds no picture"):
        read(get_testdata_file("reportsi.dcm"))
