"""Enhanced US Volume files, written element by element by pydicom: their places, directions and lengths, and files that make no sense."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian

from echospline.errors import InputError
from echospline.io.volume_reading import read_volume

ENHANCED_US_VOLUME = "1.2.840.10008.5.1.4.1.1.6.2"
VOXELS = np.random.default_rng(8).integers(0, 256, (5, 6, 7), dtype=np.uint8)  # slices, rows, columns
TURNED = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
"""Rows along z, columns along x: slices go along y."""


def holding(**values: object) -> list[Dataset]:
    item = Dataset()
    for key, value in values.items():
        setattr(item, key, value)
    return [item]


def enhanced(
    path: Path,
    voxels: np.ndarray = VOXELS,
    *,
    row: tuple[float, ...] = (1.0, 0.0, 0.0),
    column: tuple[float, ...] = (0.0, 1.0, 0.0),
    gap: float = 0.5,
    order: list[int] | None = None,
    change: object = None,
) -> Path:
    """Write slices at 0.4 mm between rows and 0.3 mm between columns; ``change(data)`` spoils it at the end."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = ENHANCED_US_VOLUME, "1.2.3.5"
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID, data.Modality = ENHANCED_US_VOLUME, "1.2.3.5", "US"
    frames, data.Rows, data.Columns = voxels.shape[:3]
    data.NumberOfFrames = frames
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated = data.BitsStored = 8 * voxels.dtype.itemsize
    data.HighBit, data.PixelRepresentation = data.BitsStored - 1, 0
    order = list(range(frames)) if order is None else order
    data.PixelData = voxels[order].tobytes()
    shared = Dataset()
    shared.PixelMeasuresSequence = holding(PixelSpacing=[0.4, 0.3])
    shared.PlaneOrientationVolumeSequence = holding(ImageOrientationVolume=[*row, *column])
    data.SharedFunctionalGroupsSequence = [shared]
    normal = np.cross(row, column)
    items = []
    for k in order:
        item = Dataset()
        at = np.array([1.0, -2.0, 3.0]) + k * gap * normal
        item.PlanePositionVolumeSequence = holding(ImagePositionVolume=at.round(9).tolist())
        items.append(item)
    data.PerFrameFunctionalGroupsSequence = items
    if change is not None:
        change(data)
    data.save_as(path, enforce_file_format=True)
    return path


def test_slices_become_a_volume_with_the_lengths_of_its_axes(tmp_path: Path) -> None:
    volume = read_volume(enhanced(tmp_path / "a.dcm"))
    np.testing.assert_array_equal(volume.voxels, VOXELS)
    assert volume.spacing == pytest.approx((0.3, 0.4, 0.5))
    assert volume.origin[1] == 0.0


def test_frames_in_any_order_become_the_same_volume(tmp_path: Path) -> None:
    volume = read_volume(enhanced(tmp_path / "a.dcm", order=[3, 0, 4, 1, 2]))
    np.testing.assert_array_equal(volume.voxels, VOXELS)


def test_sixteen_bits_are_kept(tmp_path: Path) -> None:
    wide = VOXELS.astype(np.uint16) * 250
    volume = read_volume(enhanced(tmp_path / "a.dcm", wide))
    assert volume.voxels.dtype == np.uint16
    np.testing.assert_array_equal(volume.voxels, wide)


@pytest.mark.parametrize(
    ("row", "column"),
    [TURNED, ((-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)), ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0))],
)
def test_directions_are_followed_as_itk_follows_them(
    tmp_path: Path, row: tuple[float, ...], column: tuple[float, ...]
) -> None:
    """The same voxels and directions given to ITK, which turns them upright."""
    image = SimpleITK.GetImageFromArray(VOXELS)
    image.SetSpacing((0.3, 0.4, 0.5))
    image.SetDirection(np.stack([row, column, np.cross(row, column)], axis=1).ravel().tolist())
    upright = SimpleITK.DICOMOrient(image, "LPS")
    volume = read_volume(enhanced(tmp_path / "a.dcm", row=row, column=column))
    np.testing.assert_array_equal(volume.voxels, SimpleITK.GetArrayFromImage(upright))
    np.testing.assert_allclose(volume.spacing, upright.GetSpacing())


def test_depth_runs_along_the_axis_that_is_named(tmp_path: Path) -> None:
    volume = read_volume(enhanced(tmp_path / "a.dcm"), "z")
    assert volume.spacing[1] == pytest.approx(0.5)
    assert sorted(volume.shape) == [5, 6, 7]
    assert volume.shape[1] == 5


def place(data: Dataset, k: int, value: list[float]) -> None:
    data.PerFrameFunctionalGroupsSequence[k].PlanePositionVolumeSequence[0].ImagePositionVolume = value


def orient(data: Dataset, value: list[float]) -> None:
    data.SharedFunctionalGroupsSequence[0].PlaneOrientationVolumeSequence[0].ImageOrientationVolume = value


def measure(data: Dataset, value: list[float]) -> None:
    data.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].PixelSpacing = value


def tilt(data: Dataset) -> None:
    own = holding(ImageOrientationVolume=[1.0, 0.0, 0.0, 0.0, 0.8, 0.6])
    data.PerFrameFunctionalGroupsSequence[2].PlaneOrientationVolumeSequence = own


def colour(data: Dataset) -> None:
    data.SamplesPerPixel, data.PhotometricInterpretation, data.PlanarConfiguration = 3, "RGB", 0
    data.PixelData = data.PixelData * 3


HOSTILE = {
    "no places": (
        lambda d: delattr(d, "PerFrameFunctionalGroupsSequence"),
        "does not say where its frames lie",
    ),
    "a place too few": (lambda d: d.PerFrameFunctionalGroupsSequence.pop(), "says where 4 lie"),
    "a frame without place": (
        lambda d: delattr(d.PerFrameFunctionalGroupsSequence[3], "PlanePositionVolumeSequence"),
        "does not state the position of every frame",
    ),
    "two at one place": (lambda d: place(d, 4, [1.0, -2.0, 4.5]), "several frames at one place"),
    "uneven": (lambda d: place(d, 4, [1.0, -2.0, 5.4]), "even slices: resample it"),
    "aside": (lambda d: [place(d, k, [1.0 + k, -2.0, 3.0 + k / 2]) for k in range(5)], "shifted aside"),
    "not finite": (lambda d: place(d, 2, [float("nan"), 0.0, 0.0]), "not finite"),
    "two numbers": (lambda d: place(d, 2, [1.0, 2.0]), "of 2 numbers; expected 3"),
    "no directions": (lambda d: orient(d, [0.0] * 6), "two unit vectors at right angles"),
    "slanted axes": (lambda d: orient(d, [1.0, 0.0, 0.0, 0.8, 0.6, 0.0]), "two unit vectors at right angles"),
    "a fan": (tilt, "slices of different orientation"),
    "no length": (lambda d: measure(d, [0.0, 0.3]), "expected two positive lengths"),
    "negative length": (lambda d: measure(d, [0.4, -0.3]), "expected two positive lengths"),
    "no measures": (
        lambda d: delattr(d.SharedFunctionalGroupsSequence[0], "PixelMeasuresSequence"),
        "does not state the pixel spacing",
    ),
    "colour": (colour, "in colour"),
    "too many frames": (lambda d: setattr(d, "NumberOfFrames", 6), "."),
    "cut short": (lambda d: setattr(d, "PixelData", d.PixelData[:-40]), "."),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_makes_no_volume_gets_one_sentence(tmp_path: Path, name: str) -> None:
    change, said = HOSTILE[name]
    with pytest.raises(InputError, match=said) as refused:
        read_volume(enhanced(tmp_path / "a.dcm", change=change))
    assert "\n" not in str(refused.value)
    assert "Traceback" not in str(refused.value)


def test_a_file_beyond_the_limit_is_refused_before_its_pixels_are_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="more than the limit"):
        read_volume(enhanced(tmp_path / "a.dcm"), limit=1e-5)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.95])
def test_a_file_cut_short_anywhere_is_refused(tmp_path: Path, share: float) -> None:
    whole = enhanced(tmp_path / "a.dcm").read_bytes()
    (tmp_path / "b.dcm").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError):
        read_volume(tmp_path / "b.dcm")
