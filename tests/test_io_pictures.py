"""Still pictures and the shipped image: pixels come back as another library reads them, and spacing must be known."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from echospline.errors import InputError
from echospline.io import open_cine, open_writer, read, sample_image
from echospline.scene import Cine, RegularGrid, UltrasoundImage


def test_shipped_image_is_the_crop_its_note_describes(recordings: Path) -> None:
    original = cv2.imread(str(recordings / "timtrack" / "gastroc_jumping_048.png"), cv2.IMREAD_GRAYSCALE)
    image = sample_image("calf")
    crop = original[64:520, 112:688].astype(int)
    assert image.pixels.dtype == np.uint8
    assert np.abs(image.pixels - crop).max() <= 1  # two libraries may round luma differently
    assert "CC0" in image.source


def test_shipped_image_is_tissue_up_to_its_edges() -> None:
    pixels = sample_image().pixels.astype(float)
    lines = [pixels[:3].mean(), pixels[-3:].mean(), pixels[:, :3].mean(), pixels[:, -3:].mean()]
    assert min(lines) > 20  # no black margin
    assert max(lines) < 100  # no bright frame line


def test_shipped_image_has_the_rulers_spacing(recordings: Path) -> None:
    picture = np.asarray(Image.open(recordings / "timtrack" / "gastroc_jumping_048.png").convert("L")).astype(
        float
    )
    marked = np.flatnonzero(picture[46] > 100)  # the ruler above the tissue has one block per centimetre
    blocks = np.array([run.mean() for run in np.split(marked, np.flatnonzero(np.diff(marked) > 1) + 1)])[:6]
    per_cm = np.polyfit(np.arange(6), blocks, 1)[0]
    assert sample_image().spacing == pytest.approx((10 / per_cm, 10 / per_cm), abs=2e-4)


def test_sample_is_read_by_name() -> None:
    image = read("sample:calf")
    assert isinstance(image, UltrasoundImage)
    np.testing.assert_array_equal(image.pixels, sample_image("calf").pixels)
    with pytest.raises(InputError, match=r"no sample 'liver'; expected one of: calf"):
        read("sample:liver")


@pytest.mark.parametrize("name", ["itkpocus/interson-phantom.png", "us-detection-biopsy-needle/34.png"])
def test_png_equals_what_opencv_reads(recordings: Path, name: str) -> None:
    image = read(recordings / name, spacing=(0.0842, 0.0842))
    colour = cv2.cvtColor(cv2.imread(str(recordings / name), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    luma = colour.astype(float) @ [0.299, 0.587, 0.114]
    assert isinstance(image, UltrasoundImage)
    assert np.abs(image.pixels - luma).max() <= 0.5 + 1e-9
    assert image.spacing == (0.0842, 0.0842)
    kept = read(recordings / name, spacing=(0.0842, 0.0842), colour=True)
    if kept.pixels.ndim == 3:
        np.testing.assert_array_equal(kept.pixels, colour)


def test_missing_spacing_names_the_option(recordings: Path) -> None:
    with pytest.raises(InputError, match="--spacing LAT,DEPTH"):
        read(recordings / "itkpocus" / "interson-phantom.png")


@pytest.mark.parametrize("suffix", ["png", "tif", "bmp"])
def test_lossless_formats_return_the_pixels_written(tmp_path: Path, suffix: str) -> None:
    pixels = np.arange(12 * 17, dtype=np.uint8).reshape(12, 17)
    Image.fromarray(pixels).save(tmp_path / f"a.{suffix}")
    image = read(tmp_path / f"a.{suffix}", spacing=(0.1, 0.2))
    np.testing.assert_array_equal(image.pixels, pixels)
    assert image.grid.shape == (17, 12)
    assert image.spacing == (0.1, 0.2)


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_sixteen_bits_keep_their_values(tmp_path: Path, suffix: str) -> None:
    pixels = (np.arange(12 * 17, dtype=np.uint16) * 300).reshape(12, 17)
    cv2.imwrite(str(tmp_path / f"a.{suffix}"), pixels)
    image = read(tmp_path / f"a.{suffix}", spacing=(0.1, 0.1))
    assert image.pixels.dtype == np.uint16
    np.testing.assert_array_equal(image.pixels, pixels)


def test_jpeg_differs_from_opencv_by_rounding_alone(tmp_path: Path) -> None:
    pixels = sample_image().pixels
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=90)
    image = read(tmp_path / "a.jpg", spacing=(0.1, 0.1))
    other = cv2.imread(str(tmp_path / "a.jpg"), cv2.IMREAD_GRAYSCALE)
    assert np.abs(image.pixels.astype(int) - other).max() <= 1


def test_pages_of_a_tiff_are_a_cine_once_their_rate_is_known(tmp_path: Path) -> None:
    pages = [np.full((8, 9), k, dtype=np.uint8) for k in range(4)]
    Image.fromarray(pages[0]).save(
        tmp_path / "stack.tif", save_all=True, append_images=[Image.fromarray(p) for p in pages[1:]]
    )
    cine = read(tmp_path / "stack.tif", spacing=(0.1, 0.1), fps=20)
    assert isinstance(cine, Cine)
    np.testing.assert_array_equal(cine.frames[:, 0, 0], [0, 1, 2, 3])
    np.testing.assert_allclose(cine.times, [0, 0.05, 0.1, 0.15])
    with pytest.raises(InputError, match="--fps"):
        read(tmp_path / "stack.tif", spacing=(0.1, 0.1))
    last = read(tmp_path / "stack.tif", spacing=(0.1, 0.1), frame=-1)
    assert isinstance(last, UltrasoundImage)
    assert last.pixels[0, 0] == 3
    with pytest.raises(InputError, match="has 4 frames"):
        read(tmp_path / "stack.tif", spacing=(0.1, 0.1), frame=4)


def test_region_cuts_the_pixels_and_starts_at_zero(recordings: Path) -> None:
    whole = read(recordings / "timtrack" / "gastroc_jumping_048.png", spacing=(0.0866, 0.0866))
    part = read(
        recordings / "timtrack" / "gastroc_jumping_048.png",
        spacing=(0.0866, 0.0866),
        region=(112, 64, 688, 520),
    )
    np.testing.assert_array_equal(part.pixels, whole.pixels[64:520, 112:688])
    assert part.grid.origin == (0.0, 0.0)


@pytest.mark.parametrize(
    "region", [(0, 0, 801, 600), (-1, 0, 8, 8), (5, 5, 5, 9), (9, 5, 6, 9), (0, 0, 1), (0.5, 0, 8, 8)]
)
def test_region_outside_of_the_picture_is_refused(recordings: Path, region: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="region must"):
        read(recordings / "timtrack" / "gastroc_jumping_048.png", spacing=(0.1, 0.1), region=region)


@pytest.mark.parametrize("spacing", [(0.1, 0.0), (0.1, -1), (0.1, float("nan")), (0.1,), (0.1, 0.1, 0.1)])
def test_spacing_must_be_two_positive_lengths(recordings: Path, spacing: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="spacing must be two positive numbers"):
        read(recordings / "itkpocus" / "interson-phantom.png", spacing=spacing)


def test_a_folder_of_numbered_pictures_is_a_cine(recordings: Path) -> None:
    folder = recordings / "timtrack"
    box = (112, 64, 688, 520)
    cine = read(folder, spacing=(0.0866, 0.0866), fps=15, region=box)
    assert isinstance(cine, Cine)
    assert cine.frames.shape == (23, 456, 576)
    np.testing.assert_array_equal(cine.frames[0], sample_image().pixels)
    assert read(folder, spacing=(0.0866, 0.0866), frame=-1, region=box).pixels.shape == (456, 576)
    streamed = [image.pixels for _, image in islice(open_cine(folder, spacing=(1, 1), fps=15, region=box), 3)]
    np.testing.assert_array_equal(streamed, cine.frames[:3])
    with pytest.raises(InputError, match="--fps"):
        read(folder, spacing=(0.0866, 0.0866))


def test_pictures_follow_their_numbers_and_their_table_of_times(tmp_path: Path) -> None:
    for k in (1, 2, 10, 9):
        Image.fromarray(np.full((4, 5), k, np.uint8)).save(tmp_path / f"frame_{k}.png")
    (tmp_path / "notes.txt").write_text("left alone")
    (tmp_path / "times.csv").write_text("frame,time_s\n0,5.0\n1,5.1\n2,5.3\n3,5.4\n")
    cine = read(tmp_path, spacing=(1, 1))
    np.testing.assert_array_equal(cine.frames[:, 0, 0], [1, 2, 9, 10])
    np.testing.assert_allclose(cine.times, [0, 0.1, 0.3, 0.4])
    (tmp_path / "times.csv").write_text("frame,time_s\n0,5.0\n")
    with pytest.raises(InputError, match="each of the 4 pictures"):
        read(tmp_path, spacing=(1, 1))


def test_frames_written_here_come_back_as_a_cine(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 2**16, (3, 6, 7), dtype=np.uint16)
    grid = RegularGrid((7, 6), (0.1, 0.3))
    with open_writer(tmp_path / "frames", grid, 30) as writer:
        for k, pixels in enumerate(frames):
            writer.add(pixels, 0.2 * k)
    cine = read(tmp_path / "frames")
    np.testing.assert_array_equal(cine.frames, frames)
    np.testing.assert_allclose(cine.times, [0, 0.2, 0.4])
    assert cine.grid == grid


def test_a_picture_that_does_not_belong_is_named(tmp_path: Path) -> None:
    for k, size in enumerate([(4, 5), (4, 5), (6, 5)]):
        Image.fromarray(np.zeros(size, np.uint8)).save(tmp_path / f"{k}.png")
    with pytest.raises(InputError, match=r"2\.png has rows 6"):
        read(tmp_path, spacing=(1, 1), fps=1)
    (tmp_path / "2.png").write_bytes(b"GIF89a")
    with pytest.raises(InputError, match=r"2\.png is GIF"):
        read(tmp_path, spacing=(1, 1), fps=1)
