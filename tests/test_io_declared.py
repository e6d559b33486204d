"""What a container says of its pixels is followed or noted, whatever the format; the right values are computed here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from echospline.cli.info import describe
from echospline.errors import InputError
from echospline.io import open_cine, open_recording, read, read_image
from echospline.io.declared import Turn
from echospline.io.sequence import read_sequence
from echospline.scene import Cine, UltrasoundImage
from written_inputs import (
    COLUMNS,
    FRAMES,
    ROWS,
    SHOWN,
    STACK,
    dicom,
    nifti,
    oriented,
    sequence,
    video,
    volume_header,
    ybr_422,
)

SPACING = (0.1, 0.1)


def one(path: Path, **options) -> UltrasoundImage:
    found = read(path, **options)
    assert isinstance(found, UltrasoundImage)
    return found


def cine(path: Path, **options) -> Cine:
    found = read(path, **options)
    assert isinstance(found, Cine)
    return found


# --- orientation


@pytest.mark.parametrize(("matrix", "number"), [
    ((0, 1, -1, 0), 6), ((-1, 0, 0, -1), 3), ((0, -1, 1, 0), 8), ((-1, 0, 0, 1), 2), ((1, 0, 0, -1), 4),
])  # fmt: skip
def test_a_display_matrix_turns_the_video(tmp_path: Path, matrix: tuple[int, ...], number: int) -> None:
    plain = cine(video(tmp_path / "plain.mp4"), spacing=SPACING).frames
    path = video(tmp_path / "turned.mp4", matrix=matrix)
    found = cine(path, spacing=SPACING)
    np.testing.assert_array_equal(found.frames, np.stack([SHOWN[number](frame) for frame in plain]))
    assert any("display matrix is followed" in note for note in found.notes)
    assert any("display matrix is followed" in note for note in describe(str(path))["notes"])


@pytest.mark.parametrize("matrix", [(0, 1, -1, 0), (-1, 0, 0, -1)])
def test_a_turned_video_is_that_of_opencv(tmp_path: Path, matrix: tuple[int, ...]) -> None:
    path = video(tmp_path / "turned.mp4", matrix=matrix)
    seen = cv2.VideoCapture(str(path))
    seen.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    frames = cine(path, spacing=SPACING).frames
    for frame in frames:
        there, picture = seen.read()
        assert there
        assert np.abs(picture[..., 0].astype(int) - frame).mean() < 2


def test_a_skewed_display_matrix_is_noted_not_followed(tmp_path: Path) -> None:
    path = video(tmp_path / "a.mp4", matrix=(1, 1, -1, 1))
    found = cine(path, spacing=SPACING)
    assert found.frames.shape == STACK.shape
    assert any("no multiple of 90 degrees" in note for note in found.notes)


@pytest.mark.parametrize("suffix", ["png", "tif", "jpg"])
@pytest.mark.parametrize("number", range(1, 9))
def test_exif_and_tiff_orientation_are_followed(tmp_path: Path, suffix: str, number: int) -> None:
    path = oriented(tmp_path / f"a.{suffix}", number)
    found = one(path, spacing=SPACING)
    right = SHOWN[number](STACK[0])
    assert found.pixels.shape == right.shape
    assert np.abs(found.pixels.astype(int) - right).max() <= (20 if suffix == "jpg" else 0)
    assert any("orientation" in note for note in found.notes) == (number > 1)


@pytest.mark.parametrize("number", range(1, 9))
def test_a_turned_jpeg_is_that_of_opencv(tmp_path: Path, number: int) -> None:
    path = oriented(tmp_path / "a.jpg", number)
    seen = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert np.abs(one(path, spacing=SPACING).pixels.astype(int) - seen).max() <= 2


def test_pages_of_a_turned_tiff_are_turned(tmp_path: Path) -> None:
    pages = [Image.fromarray(frame) for frame in STACK[:3]]
    exif = Image.Exif()
    exif[274] = 6
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:], exif=exif)
    found = cine(tmp_path / "a.tif", spacing=SPACING, fps=10)
    # Pillow writes the orientation on the first page alone; it holds for the picture
    np.testing.assert_array_equal(found.frames, np.stack([np.rot90(frame, -1) for frame in STACK[:3]]))


def test_turns_are_those_of_their_definitions() -> None:
    for number, shown in SHOWN.items():
        np.testing.assert_array_equal(Turn.of_exif(number).of_pixels(STACK[0]), shown(STACK[0]))
    assert Turn.of_letters("MFA") == Turn()
    assert Turn.of_letters("XY") is None
    assert Turn.of_letters("MM") is None
    assert not Turn.of_exif("6")


def test_a_region_is_one_of_the_shown_picture(tmp_path: Path) -> None:
    path = oriented(tmp_path / "a.png", 6)
    np.testing.assert_array_equal(
        one(path, spacing=SPACING, region=(3, 5, 20, 70)).pixels, np.rot90(STACK[0], -1)[5:70, 3:20]
    )


# --- aspect


def test_pixels_that_are_not_square_are_noted(tmp_path: Path) -> None:
    path = video(tmp_path / "a.mp4", aspect=(8, 9))
    assert any("0.888889 times" in note for note in describe(str(path))["notes"])
    right = cine(path, spacing=(0.08, 0.09))
    assert not any("contradicts" in note for note in right.notes)
    assert any("contradicts" in note for note in cine(path, spacing=SPACING).notes)


def test_the_aspect_turns_with_the_picture(tmp_path: Path) -> None:
    path = video(tmp_path / "a.mp4", aspect=(8, 9), matrix=(0, 1, -1, 0))
    assert open_recording(path).aspect == pytest.approx(9 / 8)


@pytest.mark.parametrize("kind", ["png", "jpg", "dicom"])
def test_unequal_densities_are_an_aspect(tmp_path: Path, kind: str) -> None:
    if kind == "dicom":
        path = dicom(tmp_path / "a.dcm", frames=1, PixelAspectRatio=[4, 3])  # height, then width
        assert any("contradicts" in note for note in one(path).notes)
    else:
        path = tmp_path / f"a.{kind}"
        Image.fromarray(STACK[0]).save(path, dpi=(96, 72))
    assert open_recording(path).aspect == pytest.approx(3 / 4, rel=1e-3)


# --- rescale


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_slope_and_intercept_of_nifti_are_applied(tmp_path: Path, name: str, order: str) -> None:
    path = nifti(tmp_path / name, slope=0.5, intercept=-10, stack=STACK.astype(np.int16), order=order)
    found = cine(path, fps=10)
    np.testing.assert_array_equal(found.frames, 0.5 * STACK.astype(float) - 10)
    assert found.frames.dtype == np.float32
    np.testing.assert_array_equal(one(path, frame=7).pixels, found.frames[7])
    assert any("0.5 x value - 10" in note for note in found.notes)
    assert found.grid.spacing == (0.1, 0.2)


@pytest.mark.parametrize("slope", [0.0, float("nan")])
def test_a_slope_that_is_none_leaves_the_values(tmp_path: Path, slope: float) -> None:
    found = cine(nifti(tmp_path / "a.nii", slope=slope, intercept=3), fps=10)
    np.testing.assert_array_equal(found.frames, STACK)


def test_dicom_and_metaimage_are_rescaled_too(tmp_path: Path) -> None:
    found = cine(dicom(tmp_path / "a.dcm", RescaleSlope="2", RescaleIntercept="-5", FrameTime=40))
    np.testing.assert_array_equal(found.frames, 2.0 * STACK - 5)
    path = sequence(
        tmp_path / "a.mha",
        top=("ElementToIntensityFunctionSlope = 2", "ElementToIntensityFunctionOffset = -5"),
    )
    np.testing.assert_array_equal(cine(path).frames, 2.0 * STACK - 5)


# --- times


def test_the_frame_increment_pointer_decides(tmp_path: Path) -> None:
    tags = {"FrameTimeVector": [0] + [10] * 9, "FrameTime": 50}
    found = cine(dicom(tmp_path / "a.dcm", FrameIncrementPointer=0x00181063, **tags))
    np.testing.assert_allclose(found.times, 0.05 * np.arange(FRAMES))
    assert any("Frame Time Vector makes it" in note for note in found.notes)
    found = cine(dicom(tmp_path / "b.dcm", FrameIncrementPointer=0x00181065, **tags))
    np.testing.assert_allclose(found.times, 0.01 * np.arange(FRAMES))


@pytest.mark.parametrize("vector", [[0] * 10, [0] * 9, [0, -10] * 5, [1e-7] * 10])
def test_a_source_of_times_that_makes_none_is_passed_over(tmp_path: Path, vector: list[float]) -> None:
    path = dicom(tmp_path / "a.dcm", FrameIncrementPointer=0x00181065, FrameTimeVector=vector, FrameTime=33)
    found = cine(path)
    np.testing.assert_allclose(found.times, 0.033 * np.arange(FRAMES))
    assert any("Frame Time Vector" in note and "passed over" in note for note in found.notes)


def test_times_of_no_use_are_named_where_no_other_is_left(tmp_path: Path) -> None:
    path = dicom(tmp_path / "a.dcm", FrameTimeVector=[0] * 10, FrameTime=0)
    with pytest.raises(InputError, match=r"Frame Time Vector puts its frames 0 s apart.*--fps"):
        read(path)
    assert any("puts its frames 0 s apart" in note for note in describe(str(path))["notes"])


def test_a_frame_without_time_stamp_is_named(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a.igs.mha", stamp=lambda i: None if i == 4 else 0.05 * i)
    with pytest.raises(InputError, match=r"lacks frame 4.*--fps"):
        read(path)
    assert any("lacks frame 4" in note for note in describe(str(path))["notes"])


def test_the_number_of_digits_is_free(tmp_path: Path) -> None:
    for digits in (1, 4, 10):
        path = sequence(tmp_path / f"{digits}.igs.mha", digits=digits)
        np.testing.assert_allclose(cine(path).times, 0.05 * np.arange(FRAMES), atol=1e-5)
        np.testing.assert_allclose(read_sequence(path).times, 1.5e9 + 0.05 * np.arange(FRAMES))


def test_the_fourth_axis_of_nifti_is_time_in_its_unit(tmp_path: Path) -> None:
    for units, factor in ((2 + 8, 1.0), (2 + 16, 1e-3), (2 + 24, 1e-6)):
        path = nifti(tmp_path / "a.nii", units=units, time=0.05 / factor)
        np.testing.assert_allclose(cine(path).times, 0.05 * np.arange(FRAMES))
    with pytest.raises(InputError, match="--fps"):
        read(nifti(tmp_path / "b.nii", units=2, time=0.05))


def test_imagej_says_frames_slices_interval_and_calibration(tmp_path: Path) -> None:
    def pages(name: str, text: str) -> Path:
        pictures = [Image.fromarray(frame) for frame in STACK]
        info = {270: text, 282: 10.0, 283: 5.0}
        pictures[0].save(tmp_path / name, save_all=True, append_images=pictures[1:], tiffinfo=info)
        return tmp_path / name

    found = cine(pages("a.tif", "ImageJ=1.54\nimages=10\nframes=10\nfinterval=0.04\nunit=mm\n"))
    np.testing.assert_allclose(found.times, 0.04 * np.arange(FRAMES))
    assert found.grid.spacing == pytest.approx((0.1, 0.2))
    with pytest.raises(InputError, match="volume of 10 slices"):
        read(pages("b.tif", "ImageJ=1.54\nimages=10\nslices=10\nunit=cm\n"), spacing=SPACING)


# --- spacing


def test_unknown_spacing_of_plus_is_asked_for_everywhere(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a.igs.mha", spacing="1 1 1")
    for take in (read, read_image, open_cine, lambda p: read_sequence(p).grid()):
        with pytest.raises(InputError, match="--spacing"):
            take(path)
    assert describe(str(path))["spacing_mm"] is None


def test_the_frames_own_spacing_is_followed(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a.igs.mha", spacing="1 1 1", fields=("ElementSpacing = 0.0257 0.03 1",))
    assert cine(path).grid.spacing == (0.0257, 0.03)
    assert read_sequence(path).grid().spacing == (0.0257, 0.03)


def test_the_calibration_is_followed_and_goes_first(tmp_path: Path) -> None:
    calibration = "ImageToProbeTransform = 0 0.08 0 -8 0.06 0 0 0 0 0 0.08 0 0 0 0 1"
    fields = (calibration, "ImageToProbeTransformStatus = OK", "ElementSpacing = 0.2 0.2 1")
    path = sequence(tmp_path / "a.igs.mha", spacing="1 1 1", fields=fields)
    found = cine(path)
    assert found.grid.spacing == pytest.approx((0.06, 0.08))
    assert any("ElementSpacing says 0.2 x 0.2 mm" in note for note in found.notes)
    assert read_sequence(path).grid().spacing == pytest.approx((0.06, 0.08))


def test_a_calibration_that_is_invalid_or_the_identity_is_none(tmp_path: Path) -> None:
    lost = "ImageToProbeTransform = 0.08 0 0 -8 0 0.08 0 0 0 0 0.08 0 0 0 0 1"
    identity = "ImageToProbeTransform = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
    for name, fields in (("a", (lost, "ImageToProbeTransformStatus = INVALID")), ("b", (identity,))):
        path = sequence(tmp_path / f"{name}.igs.mha", spacing="1 1 1", fields=fields)
        for take in (read, lambda p: read_sequence(p).grid()):
            with pytest.raises(InputError, match="--spacing"):
                take(path)


def test_lengths_that_no_picture_has_are_passed_over(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a.mha", spacing="86.6 86.6 1")  # micrometres
    with pytest.raises(InputError, match="--spacing"):
        read(path)
    assert any("86.6 x 86.6 mm is no distance" in note for note in describe(str(path))["notes"])


# --- validity


def test_frames_that_are_not_good_are_left_out(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a.igs.mha", status=lambda i: "INVALID" if i in (0, 5) else "OK")
    kept = [1, 2, 3, 4, 6, 7, 8, 9]
    found = cine(path)
    np.testing.assert_array_equal(found.frames, STACK[kept])
    np.testing.assert_allclose(found.times, 0.05 * (np.array(kept) - 1), atol=1e-5)
    streamed = list(open_cine(path))
    assert [t for t, _ in streamed] == pytest.approx(list(found.times))
    np.testing.assert_array_equal(np.stack([image.pixels for _, image in streamed]), STACK[kept])
    image = read_image(path)
    np.testing.assert_array_equal(image.pixels, STACK[1])
    assert any("frame 1 taken, the first good one" in note for note in image.notes)
    asked = read_image(path, frame=5)
    np.testing.assert_array_equal(asked.pixels, STACK[5])
    assert any("does not call good" in note for note in asked.notes)
    assert describe(str(path))["fps"] == pytest.approx(7 / 0.4, abs=0.01)


def test_a_bad_frame_needs_no_time_stamp(tmp_path: Path) -> None:
    path = sequence(
        tmp_path / "a.igs.mha",
        status=lambda i: "INVALID" if i == 4 else "OK",
        stamp=lambda i: None if i == 4 else 0.05 * i,
    )
    assert len(cine(path)) == FRAMES - 1
    assert read_sequence(path).valid.sum() == FRAMES - 1


def test_a_file_without_any_good_frame_is_refused(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a.igs.mha", status=lambda i: "INVALID")
    for take in (read, read_image, open_cine):
        with pytest.raises(InputError, match="none of its 10 frames good"):
            take(path)
    np.testing.assert_array_equal(read_image(path, frame=2).pixels, STACK[2])
    assert describe(str(path))["frames"] == FRAMES


# --- volumes


@pytest.mark.parametrize("make", [
    lambda p: volume_header(p / "a.mha"),
    lambda p: volume_header(p / "a.mha", "Kinds = domain domain domain"),
    lambda p: volume_header(p / "a.mha", "Kinds = domain domain list"),  # as PLUS writes reconstructions
    lambda p: nifti(p / "a.nii"),
    lambda p: dicom(p / "a.dcm", SOPClassUID="1.2.840.10008.5.1.4.1.1.6.2", FrameTime=40),
])  # fmt: skip
def test_a_volume_is_one_and_asks_which_slice(tmp_path: Path, make) -> None:
    path = make(tmp_path)
    about = describe(str(path))
    assert about["slices"] == FRAMES
    assert "frames" not in about
    assert any("a volume of 10 slices" in note for note in about["notes"])
    with pytest.raises(InputError, match=r"volume of 10 slices.*--frame"):
        read_image(path)
    with pytest.raises(InputError, match=r"volume of 10 slices.*--fps"):
        open_cine(path)
    np.testing.assert_array_equal(read_image(path, frame=3).pixels, STACK[3])
    assert len(cine(path, fps=10)) == FRAMES  # the user says that it is time


@pytest.mark.parametrize("extra", ["Kinds = domain domain list", "Kinds = domain domain time"])
def test_an_axis_of_time_is_a_cine(tmp_path: Path, extra: str) -> None:
    path = volume_header(tmp_path / "a.mha", extra, spacing="0.1 0.1 0.04")
    assert describe(str(path))["frames"] == FRAMES
    with pytest.raises(InputError, match="--fps"):
        read(path)
    np.testing.assert_array_equal(read_image(path).pixels, STACK[0])


# --- names and beginnings


def test_pixels_in_a_file_with_a_space_in_its_name(tmp_path: Path) -> None:
    STACK.tofile(tmp_path / "my scan.raw")
    path = sequence(tmp_path / "my scan.mhd", data="my scan.raw")
    np.testing.assert_array_equal(cine(path).frames, STACK)


def test_dicom_without_preamble_is_read(tmp_path: Path) -> None:
    whole, bare = dicom(tmp_path / "a.dcm", frames=1), dicom(tmp_path / "b.dcm", frames=1, bare=True)
    assert bare.read_bytes()[128:132] != b"DICM"
    np.testing.assert_array_equal(one(bare).pixels, STACK[0])
    assert one(bare).spacing == one(whole).spacing == pytest.approx((0.1, 0.1))
    assert any("without its preamble" in note for note in one(bare).notes)
    # as some archives keep it: preamble cut off, meta information left
    (tmp_path / "c.dcm").write_bytes(whole.read_bytes()[132:])
    np.testing.assert_array_equal(one(tmp_path / "c.dcm").pixels, STACK[0])


def test_frames_with_shared_chroma_are_grey_as_alone(tmp_path: Path) -> None:
    path = dicom(
        tmp_path / "a.dcm", frames=2, SamplesPerPixel=3, PhotometricInterpretation="YBR_FULL_422",
        PlanarConfiguration=0, FrameTime=40, PixelData=ybr_422(STACK[:2]),
    )  # fmt: skip
    found = cine(path)
    assert np.abs(found.frames.astype(int) - STACK[:2]).max() <= 1
    for i in (0, 1):
        np.testing.assert_array_equal(one(path, frame=i).pixels, found.frames[i])


def test_colour_of_sixteen_bits_is_said_to_be_cut(tmp_path: Path) -> None:
    deep = (np.random.default_rng(0).random((ROWS, COLUMNS, 3)) * 65535).astype(np.uint16)
    for suffix in ("png", "tiff"):
        cv2.imwrite(str(tmp_path / f"a.{suffix}"), deep)
        found = one(tmp_path / f"a.{suffix}", spacing=SPACING)
        assert found.pixels.dtype == np.uint8
        assert any("16 bits per channel, of which the upper 8 are read" in note for note in found.notes)
    cv2.imwrite(str(tmp_path / "grey.png"), deep[..., 0])
    assert one(tmp_path / "grey.png", spacing=SPACING).notes == ()


def test_delays_of_a_gif_are_read_without_decoding_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pages = [Image.fromarray(frame) for frame in STACK]
    pages[0].save(
        tmp_path / "a.gif", save_all=True, append_images=pages[1:], duration=[30 + 10 * i for i in range(10)]
    )
    with Image.open(tmp_path / "a.gif") as image:
        right = []
        for i in range(image.n_frames):
            image.seek(i)
            right.append(image.info["duration"])
    monkeypatch.setattr(Image.Image, "load", lambda self: pytest.fail("a frame was decoded"))
    recording = open_recording(tmp_path / "a.gif")
    assert recording.frames == FRAMES
    np.testing.assert_allclose(recording.times, np.concatenate([[0], np.cumsum(right[:-1])]) / 1000)


def test_a_comment_with_spacing_belongs_to_the_shown_picture(tmp_path: Path) -> None:
    text = PngImagePlugin.PngInfo()
    text.add_text("Comment", "echospline: pixels of 0.1 mm lateral, 0.2 mm depth")
    exif = Image.Exif()
    exif[274] = 6
    Image.fromarray(STACK[0]).save(tmp_path / "a.png", pnginfo=text, exif=exif)
    assert one(tmp_path / "a.png").spacing == (0.1, 0.2)


def test_a_reconstruction_of_plus_is_a_volume(recordings: Path) -> None:
    about = describe(str(recordings / "pluslib" / "SpinePhantomFreehandReconstructed.mha"))
    assert about["slices"] == 104
    assert describe(str(recordings / "pluslib" / "SpinePhantomFreehand.igs.mha"))["frames"] == 21
