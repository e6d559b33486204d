"""MetaImage, NRRD and NIfTI: pixels, spacing and times as SimpleITK's own reader or the text of the header says."""

from __future__ import annotations

import gzip
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from echospline.errors import InputError
from echospline.io import open_cine, open_writer, read
from echospline.scene import Cine, RegularGrid, UltrasoundImage
from written_inputs import nifti

STACK = np.random.default_rng(5).integers(0, 256, (4, 21, 33), dtype=np.uint8)
SUFFIXES = ["mha", "mhd", "nrrd", "nhdr", "nii", "nii.gz"]


def written(
    path: Path, array: np.ndarray = STACK, spacing: tuple[float, ...] = (0.1, 0.2, 0.3), packed: bool = False
) -> Path:
    image = SimpleITK.GetImageFromArray(array)
    image.SetSpacing(spacing[: image.GetDimension()])
    SimpleITK.WriteImage(image, str(path), packed)
    return path


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_third_axis_is_a_cine(tmp_path: Path, suffix: str, packed: bool) -> None:
    path = written(tmp_path / f"a.{suffix}", packed=packed)
    cine = read(path, fps=10)
    assert isinstance(cine, Cine)
    np.testing.assert_array_equal(cine.frames, STACK)
    assert cine.grid == RegularGrid((33, 21), (0.1, 0.2))
    one = read(path, frame=2)
    assert isinstance(one, UltrasoundImage)
    np.testing.assert_array_equal(one.pixels, STACK[2])
    np.testing.assert_array_equal([image.pixels for _, image in open_cine(path, fps=10)], STACK)


@pytest.mark.parametrize("suffix", ["mha", "nrrd", "nii.gz"])
def test_two_axes_are_an_image(tmp_path: Path, suffix: str) -> None:
    image = read(written(tmp_path / f"a.{suffix}", STACK[0]))
    assert isinstance(image, UltrasoundImage)
    np.testing.assert_array_equal(image.pixels, STACK[0])
    assert image.spacing == (0.1, 0.2)


@pytest.mark.parametrize("dtype", [np.int8, np.uint16, np.int16, np.int32, np.float32, np.float64])
@pytest.mark.parametrize("suffix", ["mha", "nrrd", "nii"])
def test_pixel_types_are_kept(tmp_path: Path, suffix: str, dtype: type) -> None:
    array = (STACK.astype(np.float64) - 128).astype(dtype)
    image = read(written(tmp_path / f"a.{suffix}", array), frame=1)
    assert image.pixels.dtype == dtype
    np.testing.assert_array_equal(image.pixels, array[1])


def test_colour_becomes_luma_or_stays(tmp_path: Path) -> None:
    rgb = np.random.default_rng(2).integers(0, 256, (21, 33, 3), dtype=np.uint8)
    SimpleITK.WriteImage(SimpleITK.GetImageFromArray(rgb, isVector=True), str(tmp_path / "a.mha"))
    np.testing.assert_array_equal(read(tmp_path / "a.mha", spacing=(0.1, 0.1), colour=True).pixels, rgb)
    np.testing.assert_allclose(
        read(tmp_path / "a.mha", spacing=(0.1, 0.1)).pixels, rgb @ [0.299, 0.587, 0.114], atol=0.5001
    )


def test_mouse_liver_equals_itk_and_its_header(recordings: Path) -> None:
    path = recordings / "itkultrasound" / "MouseLiverB.mha"
    cine = read(path, fps=1)
    np.testing.assert_array_equal(cine.frames, SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(path))))
    header = path.read_bytes()[:600].decode("latin-1")
    spacing = [float(v) for v in re.findall(r"ElementSpacing = (\S+) (\S+)", header)[0]]
    assert cine.grid.spacing == pytest.approx(spacing)
    assert cine.grid.shape == (128, 512)
    with pytest.raises(InputError, match="--fps"):
        read(path)


def test_one_by_one_millimetre_is_no_spacing_but_asked_for(recordings: Path) -> None:
    path = recordings / "pluslib" / "BkCurvilinearScanConvertedData.igs.mha"
    with pytest.raises(InputError, match=r"1 x 1 mm, which writers put where nothing is known.*--spacing"):
        read(path)
    image = read(path, spacing=(0.2, 0.2))
    assert image.grid.shape == (600, 400)
    assert image.spacing == (0.2, 0.2)
    assert any("1 x 1 mm" in note for note in image.notes)


def test_plus_lines_are_turned_so_that_depth_runs_down(recordings: Path) -> None:
    image = read(recordings / "pluslib" / "BkCurvilinearRfData.igs.mhd", spacing=(0.2, 0.02))
    raw = np.fromfile(recordings / "pluslib" / "BkCurvilinearRfData.raw", dtype="<i2").reshape(358, 3480)
    np.testing.assert_array_equal(image.pixels, raw.T)
    assert "not B-mode" in image.source


@pytest.mark.parametrize(("letters", "turned"), [
    ("MFA", lambda p: p), ("UFA", lambda p: p[:, ::-1]), ("MNA", lambda p: p[::-1]), ("UN", lambda p: p[::-1, ::-1]),
    ("FMA", lambda p: p.T), ("NU", lambda p: p.T[::-1, ::-1]),
])  # fmt: skip
def test_orientation_letters_are_followed(tmp_path: Path, letters: str, turned: object) -> None:
    data = written(tmp_path / "a.mha", STACK[0]).read_bytes()
    marked = data.replace(b"ElementType", f"UltrasoundImageOrientation = {letters}\nElementType".encode(), 1)
    (tmp_path / "b.mha").write_bytes(marked)
    image = read(tmp_path / "b.mha")
    np.testing.assert_array_equal(image.pixels, turned(STACK[0]))
    assert image.spacing == ((0.2, 0.1) if letters[0] in "FN" else (0.1, 0.2))


def test_a_sequence_written_here_comes_back_with_its_times(tmp_path: Path) -> None:
    times = np.array([2.0, 2.03, 2.07, 2.2])  # a recording rarely begins at 0
    with open_writer(tmp_path / "a.mha", RegularGrid((33, 21), (0.1, 0.2)), 30) as writer:
        for pixels, t in zip(STACK, times, strict=True):
            writer.add(pixels, t)
    cine = read(tmp_path / "a.mha")
    np.testing.assert_array_equal(cine.frames, STACK)
    np.testing.assert_allclose(cine.times, times - 2.0, atol=1e-12)
    assert cine.grid.spacing == (0.1, 0.2)


def slicer_sequence(path: Path, *, list_first: bool, encoding: str = "raw") -> None:
    """A sequence as 3D Slicer writes it: a list axis, an index in seconds, spacing in the other axes."""
    sizes = "4 33 21" if list_first else "33 21 4"
    kinds = "list domain domain" if list_first else "domain domain list"
    directions = "none (0.1,0) (0,0.2)" if list_first else "(0.1,0) (0,0.2) none"
    header = (
        f"NRRD0005\ntype: uint8\ndimension: 3\nspace dimension: 2\nsizes: {sizes}\nkinds: {kinds}\n"
        f"space directions: {directions}\nencoding: {encoding}\nspace origin: (0,0)\n"
        "axis 0 index type:=numeric\naxis 0 index values:=0 0.1 0.25 0.3\n\n"
    )
    array = np.moveaxis(STACK, 0, -1) if list_first else STACK
    path.write_bytes(header.encode() + np.ascontiguousarray(array).tobytes())


def test_slicer_sequence_with_the_list_first_is_a_cine_with_its_times(tmp_path: Path) -> None:
    slicer_sequence(tmp_path / "a.seq.nrrd", list_first=True)
    cine = read(tmp_path / "a.seq.nrrd")
    np.testing.assert_array_equal(cine.frames, STACK)
    np.testing.assert_allclose(cine.times, [0, 0.1, 0.25, 0.3])
    assert cine.grid.spacing == pytest.approx((0.1, 0.2))
    np.testing.assert_array_equal(read(tmp_path / "a.seq.nrrd", frame=3).pixels, STACK[3])


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("cm", 10.0), ("um", 1e-3), ("m", 1000.0)])
def test_nrrd_lengths_become_millimetres(tmp_path: Path, unit: str, factor: float) -> None:
    header = (
        "NRRD0004\ntype: uint8\ndimension: 2\nspace dimension: 2\nsizes: 33 21\n"
        f"space directions: ({0.1 / factor:.9g},0) (0,{0.2 / factor:.9g})\n"
        f'space units: "{unit}" "{unit}"\nencoding: raw\n\n'
    )
    (tmp_path / "a.nrrd").write_bytes(header.encode() + STACK[0].tobytes())
    assert read(tmp_path / "a.nrrd").spacing == pytest.approx((0.1, 0.2))


def test_a_header_without_spacing_names_the_option(tmp_path: Path) -> None:
    data = re.sub(rb"ElementSpacing[^\n]*\n", b"", written(tmp_path / "a.mha", STACK[0]).read_bytes())
    (tmp_path / "b.mha").write_bytes(data)
    with pytest.raises(InputError, match="--spacing LAT,DEPTH"):
        read(tmp_path / "b.mha")


@pytest.mark.parametrize("suffix", ["mha", "nrrd", "nii", "nii.gz"])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_file_cut_short_is_refused(tmp_path: Path, suffix: str, packed: bool, share: float) -> None:
    data = written(tmp_path / f"a.{suffix}", packed=packed).read_bytes()
    (tmp_path / f"b.{suffix}").write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=r"cut short"):
        read(tmp_path / f"b.{suffix}", fps=10)


@pytest.mark.parametrize("name", ["/etc/passwd", "../a.raw", "LIST", "a%02d.raw 1 3 1", "missing.raw"])
def test_a_header_never_reads_pixels_from_elsewhere(tmp_path: Path, name: str) -> None:
    (tmp_path / "in").mkdir()
    header = written(tmp_path / "in" / "a.mhd").read_text().replace("a.raw", name)
    (tmp_path / "in" / "b.mhd").write_text(header)
    with pytest.raises(InputError, match="beside it"):
        read(tmp_path / "in" / "b.mhd", fps=10)
    header = written(tmp_path / "in" / "a.nhdr").read_text().replace("a.raw", name)
    (tmp_path / "in" / "b.nhdr").write_text(header)
    with pytest.raises(InputError, match=r"beside it|cut short"):
        read(tmp_path / "in" / "b.nhdr", fps=10)


@pytest.mark.parametrize("suffix", ["mha", "nrrd"])
def test_a_size_beyond_memory_is_refused_before_it_is_allocated(tmp_path: Path, suffix: str) -> None:
    data = written(tmp_path / f"a.{suffix}").read_bytes()
    (tmp_path / f"b.{suffix}").write_bytes(re.sub(rb"33 21 4", b"200000 200000 90000", data, count=1))
    with pytest.raises(InputError, match=r"more than the limit of 2,048 MiB"):
        read(tmp_path / f"b.{suffix}", fps=10)


def test_the_limit_can_be_raised_and_lowered(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mha", np.zeros((3, 600, 700), np.uint8))  # 1.2 MiB
    with pytest.raises(InputError, match="limit"):
        read(path, fps=10, limit=1.0)
    assert read(path, fps=10, limit=1.3).frames.shape == (3, 600, 700)
    assert read(path, frame=0, limit=0.5).pixels.shape == (600, 700)
    with pytest.raises(InputError, match="limit must be"):
        read(path, limit=0)


def test_values_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    array = np.ones((21, 33))
    array[3, 4] = np.nan
    with pytest.raises(InputError, match="not finite"):
        read(written(tmp_path / "a.mha", array))


def test_four_axes_and_five_values_per_pixel_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="axes"):
        read(written(tmp_path / "a.nrrd", np.zeros((2, 3, 4, 5), np.uint8)))
    SimpleITK.WriteImage(
        SimpleITK.GetImageFromArray(np.zeros((4, 5, 6), np.uint8), isVector=True), str(tmp_path / "b.mha")
    )
    with pytest.raises(InputError, match="values per pixel"):
        read(tmp_path / "b.mha")


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("suffix", ["mha", "nrrd"])
def test_big_endian_pixels_are_turned_round(tmp_path: Path, suffix: str, packed: bool) -> None:
    values = (STACK.astype(np.int16) - 100) * 200
    content = values.astype(">i2").tobytes()
    if suffix == "mha":
        head = (
            "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = True\n"
            f"CompressedData = {packed}\nDimSize = 33 21 4\nElementSpacing = 0.1 0.2 1\nElementType = MET_SHORT\n"
            "ElementDataFile = LOCAL\n"
        )
        content = zlib.compress(content) if packed else content
    else:
        head = (
            "NRRD0004\ntype: short\ndimension: 3\nsizes: 33 21 4\nspacings: 0.1 0.2 1\nkinds: domain domain list\n"
            f"endian: big\nencoding: {'gzip' if packed else 'raw'}\n\n"
        )
        content = gzip.compress(content) if packed else content
    (tmp_path / f"a.{suffix}").write_bytes(head.encode() + content)
    np.testing.assert_array_equal(read(tmp_path / f"a.{suffix}", fps=10).frames, values)
    for k in range(4):
        np.testing.assert_array_equal(read(tmp_path / f"a.{suffix}", frame=k).pixels, values[k])


def test_a_gzip_file_of_several_members_is_read_to_its_end(tmp_path: Path) -> None:
    whole = nifti(tmp_path / "a.nii", stack=STACK).read_bytes()
    parts = [whole[i : i + 500] for i in range(0, len(whole), 500)]
    (tmp_path / "b.nii.gz").write_bytes(b"".join(gzip.compress(part) for part in parts))
    np.testing.assert_array_equal(read(tmp_path / "b.nii.gz", fps=10).frames, STACK)
    (tmp_path / "c.nii.gz").write_bytes(b"".join(gzip.compress(part) for part in parts[:-1]))
    with pytest.raises(InputError, match="cut short"):
        read(tmp_path / "c.nii.gz", fps=10)


def test_encodings_that_only_itk_reads_are_left_to_it(tmp_path: Path) -> None:
    head = (
        "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 33 21 4\nspacings: 0.1 0.2 1\nkinds: domain domain list\n"
        "encoding: ascii\n\n"
    )
    (tmp_path / "a.nrrd").write_text(head + " ".join(map(str, STACK.ravel())) + "\n")
    np.testing.assert_array_equal(read(tmp_path / "a.nrrd", fps=10).frames, STACK)
    np.testing.assert_array_equal(read(tmp_path / "a.nrrd", frame=2).pixels, STACK[2])


def test_nifti_2_is_read(tmp_path: Path) -> None:
    h = bytearray(544)
    struct.pack_into("<i8s2h8q", h, 0, 540, b"n+2\0\r\n\x1a\n", 4, 16, 3, 33, 21, 4, 1, 1, 1, 1)
    struct.pack_into("<8dq2d", h, 104, 1, 0.1, 0.2, 1, 1, 1, 1, 1, 544, 2.0, 1.0)
    struct.pack_into("<i", h, 500, 2)
    (tmp_path / "a.nii").write_bytes(bytes(h) + STACK.astype("<i2").tobytes())
    cine = read(tmp_path / "a.nii", fps=10)
    np.testing.assert_array_equal(cine.frames, 2.0 * STACK + 1)
    assert cine.grid.spacing == (0.1, 0.2)


@pytest.mark.parametrize(
    "kinds", ["RGB-color domain domain", "domain domain RGB-color", "4-color domain domain"]
)
def test_colour_of_nrrd_is_where_its_kinds_say(tmp_path: Path, kinds: str) -> None:
    n = 4 if kinds.startswith("4") else 3
    rgb = np.random.default_rng(2).integers(0, 256, (21, 33, n), dtype=np.uint8)
    last = kinds.endswith("color")
    sizes = f"33 21 {n}" if last else f"{n} 33 21"
    head = f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: {sizes}\nkinds: {kinds}\nencoding: raw\n\n"
    content = (np.moveaxis(rgb, -1, 0) if last else rgb).tobytes()
    (tmp_path / "a.nrrd").write_bytes(head.encode() + content)
    np.testing.assert_array_equal(
        read(tmp_path / "a.nrrd", colour=True, spacing=(0.1, 0.1)).pixels, rgb[..., :3]
    )


def test_nifti_equals_what_itk_reads(tmp_path: Path) -> None:
    path = nifti(tmp_path / "a.nii", stack=STACK.astype(np.int16), slope=2.0, intercept=1.0)
    itk = SimpleITK.ReadImage(str(path))
    cine = read(path, fps=10)
    np.testing.assert_array_equal(cine.frames, SimpleITK.GetArrayFromImage(itk))
    assert cine.grid.spacing == pytest.approx(itk.GetSpacing()[:2])
