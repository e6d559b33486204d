"""Volumes read from files: axes, spacing and directions against SimpleITK's own, and files that are no volume."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from scipy.spatial.transform import Rotation

from echospline.errors import InputError
from echospline.io import read_image
from echospline.io.samples import IN_SPACE
from echospline.io.volume_reading import along_frame, read_volume, read_volume_and_axis
from echospline.io.volume_writing import write_volume
from echospline.laboratory import sample_volume
from echospline.laboratory.sample_volumes import SAMPLE_VOLUMES
from echospline.scene import Volume

RNG = np.random.default_rng(4)
VOXELS = RNG.integers(0, 255, (5, 6, 7), dtype=np.uint8)  # z, y, x


def written(
    path: Path, voxels: np.ndarray = VOXELS, direction: np.ndarray | None = None, **more: object
) -> Path:
    image = SimpleITK.GetImageFromArray(voxels, **more)
    image.SetSpacing((0.3, 0.4, 0.5)[: image.GetDimension()])
    if direction is not None:
        image.SetDirection(direction.ravel().tolist())
    SimpleITK.WriteImage(image, str(path), useCompression=path.suffix in (".mha", ".gz"))
    return path


@pytest.mark.parametrize("name", ["a.mha", "a.mhd", "a.nrrd", "a.nii", "a.nii.gz"])
def test_every_format_gives_the_same_volume(tmp_path: Path, name: str) -> None:
    # NIfTI has no identity in the others' frame: ITK writes it turned and reads it back
    volume = read_volume(written(tmp_path / name))
    np.testing.assert_array_equal(volume.voxels, VOXELS)
    assert volume.spacing == (0.3, 0.4, 0.5)
    assert volume.origin[1] == 0.0
    assert volume.origin[0] == pytest.approx(-0.9)
    assert volume.source == name


@pytest.mark.parametrize("dtype", [np.int16, np.uint16, np.float32])
def test_voxel_types_are_kept(tmp_path: Path, dtype: type) -> None:
    volume = read_volume(written(tmp_path / "a.nrrd", VOXELS.astype(dtype)))
    assert volume.voxels.dtype == dtype
    np.testing.assert_array_equal(volume.voxels, VOXELS)


@pytest.mark.parametrize("depth", ["x", "-x", "y", "-y", "z", "-z"])
def test_depth_runs_along_the_axis_that_is_named(tmp_path: Path, depth: str) -> None:
    index = {"x": 2, "y": 1, "z": 0}[depth[-1]]
    ramp = np.moveaxis(
        np.broadcast_to(np.arange(VOXELS.shape[index]), np.moveaxis(VOXELS, index, -1).shape), -1, index
    )
    ramp = np.flip(ramp, index) if depth[0] == "-" else ramp
    volume = read_volume(written(tmp_path / "a.mha", ramp.astype(np.uint8)), depth)
    assert volume.spacing[1] == (0.3, 0.4, 0.5)[2 - index]
    np.testing.assert_array_equal(volume.voxels[0, :, 0], np.arange(VOXELS.shape[index]))


@pytest.mark.parametrize(
    "rows",
    [
        ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
        ((-1, 0, 0), (0, 0, -1), (0, -1, 0)),
        ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ],
)
@pytest.mark.parametrize("suffix", ["mha", "nrrd", "nii"])
def test_directions_are_followed_as_itk_follows_them(
    tmp_path: Path, suffix: str, rows: tuple[tuple[int, ...], ...]
) -> None:
    path = written(tmp_path / f"a.{suffix}", direction=np.array(rows, dtype=float))
    upright = SimpleITK.DICOMOrient(SimpleITK.ReadImage(str(path)), "LPS")
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.voxels, SimpleITK.GetArrayFromImage(upright))
    np.testing.assert_allclose(volume.spacing, upright.GetSpacing(), rtol=1e-6)


def test_a_slanted_volume_keeps_its_axes_and_says_so(tmp_path: Path) -> None:
    c, s = np.cos(0.2), np.sin(0.2)
    volume = read_volume(written(tmp_path / "a.mha", direction=np.array(((c, -s, 0), (s, c, 0), (0, 0, 1)))))
    np.testing.assert_array_equal(volume.voxels, VOXELS)
    assert "slanted by 11.5 degrees" in volume.source


def test_a_unit_holds_for_every_axis(tmp_path: Path) -> None:
    header = (
        "NRRD0005\ntype: uint8\ndimension: 3\nspace: left-posterior-superior\nsizes: 7 6 5\n"
        'space directions: (0.03,0,0) (0,0.04,0) (0,0,0.05)\nspace units: "cm" "cm" "cm"\n'
        "kinds: domain domain domain\nencoding: raw\n\n"
    )
    path = tmp_path / "a.nrrd"
    path.write_bytes(header.encode() + VOXELS.tobytes())
    np.testing.assert_allclose(read_volume(path).spacing, (0.3, 0.4, 0.5), rtol=1e-6)


def test_a_written_volume_is_read_back(tmp_path: Path) -> None:
    path = write_volume(tmp_path / "a.mha", Volume(VOXELS, (0.25, 0.5, 0.75)))
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.voxels, VOXELS)
    assert volume.spacing == (0.25, 0.5, 0.75)


def test_what_is_no_volume_gets_one_sentence(tmp_path: Path) -> None:
    flat = written(tmp_path / "flat.mha", VOXELS[0])
    with pytest.raises(InputError, match="2 or more along each of three axes"):
        read_volume(flat)
    colour = written(tmp_path / "c.mha", RNG.integers(0, 9, (4, 5, 6, 3), dtype=np.uint8), isVector=True)
    with pytest.raises(InputError, match="in colour"):
        read_volume(colour)
    holes = VOXELS.astype(np.float32)
    holes[0, 0, 0] = np.nan
    with pytest.raises(InputError, match="not finite"):
        read_volume(written(tmp_path / "n.mha", holes))
    four = SimpleITK.JoinSeries([SimpleITK.GetImageFromArray(VOXELS)] * 2)
    SimpleITK.WriteImage(four, str(tmp_path / "four.nrrd"))
    with pytest.raises(InputError, match="axes of"):
        read_volume(tmp_path / "four.nrrd")
    (tmp_path / "a.txt").write_text("no volume")
    with pytest.raises(InputError, match="no known format does"):
        read_volume(tmp_path / "a.txt")
    with pytest.raises(InputError, match="there is no file"):
        read_volume(tmp_path / "nowhere.mha")
    with pytest.raises(InputError, match="depth runs along one of"):
        read_volume(written(tmp_path / "d.mha"), "depth")
    with pytest.raises(InputError, match="more than the limit"):
        read_volume(written(tmp_path / "l.mha"), limit=1e-6)


@pytest.mark.parametrize("name", ["a.mha", "a.nrrd", "a.nii", "a.nii.gz"])
def test_a_file_cut_short_at_any_place_is_refused(tmp_path: Path, name: str) -> None:
    whole = written(tmp_path / name).read_bytes()
    path = tmp_path / f"cut-{name}"
    for end in (1, len(whole) // 3, len(whole) // 2, len(whole) - 20):
        path.write_bytes(whole[:end])
        with pytest.raises(InputError):
            read_volume(path)


def test_a_header_that_names_pixels_elsewhere_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mhd"
    path.write_text(
        "ObjectType = Image\nNDims = 3\nDimSize = 7 6 5\nElementType = MET_UCHAR\nElementSpacing = 1 1 1\n"
        "ElementDataFile = ../../etc/passwd\n"
    )
    with pytest.raises(InputError, match="in the same folder"):
        read_volume(path)


def test_sample_spine_is_the_phantom_with_its_skin_up() -> None:
    """Against the file's own bytes, inflated here: the third axis is depth."""
    volume, tissue = sample_volume("spine")
    assert tissue is None
    assert volume.shape == (147, 104, 106)
    assert volume.spacing == (0.5, 0.5, 0.5)
    assert volume.origin == (-36.5, 0.0, -26.25)
    assert "BSD-3-Clause" in volume.source
    data = Path(__file__).resolve().parent.parent / "src" / "echospline" / "data"
    raw = (data / "spine.mha").read_bytes()
    start = raw.index(b"ElementDataFile = LOCAL\n") + len(b"ElementDataFile = LOCAL\n")
    stored = np.frombuffer(zlib.decompress(raw[start:]), np.uint8).reshape(104, 106, 147)
    np.testing.assert_array_equal(volume.voxels, stored.transpose(1, 0, 2)[::-1])
    assert "spine.mha" in (data / "SOURCES.md").read_text()
    assert "Redistribution and use" in (data / "spine.LICENSE").read_text()
    # soft tissue above, the shadow of the bone below
    filled = volume.voxels > 0
    above, below = (volume.voxels[:, rows][filled[:, rows]].mean() for rows in (slice(8, 30), slice(60, 90)))
    assert above > 10 * below


def test_a_volume_at_any_slant_is_turned_by_the_smallest_turn_and_never_mirrored() -> None:
    turns = Rotation.random(300, random_state=1).as_matrix()
    turns = np.concatenate([turns, turns[:100] * [1.0, 1.0, -1.0]])  # files whose own axes are left-handed
    rotations = Rotation.create_group("O").as_matrix()
    for direction in turns:
        signed = np.zeros((3, 3))
        for axis in range(3):
            mark = np.zeros((3, 3, 3))
            mark[tuple(2 if 2 - k == axis else 1 for k in range(3))] = (
                1.0  # one voxel along this axis of the file
            )
            told = along_frame(Volume(mark, (1.0, 1.0, 1.0)), direction)
            signed[:, axis] = np.argwhere(told.voxels == 1.0)[0][::-1] - 1
        hand = np.linalg.det(direction)
        assert np.linalg.det(signed) == pytest.approx(hand)
        mirror = np.diag([1.0, 1.0, 1.0 if hand > 0 else -1.0])
        nearest = max(np.trace((turn @ mirror).T @ direction) for turn in rotations)
        assert np.trace(signed.T @ direction) == pytest.approx(nearest)


@pytest.mark.parametrize("depth", ["x", "-x", "y", "-y", "z", "-z"])
@pytest.mark.parametrize("code", ["LPS", "RAS", "SPL", "AIR"])
def test_the_axis_of_the_file_that_is_named_is_the_one_along_which_depth_runs(
    tmp_path: Path, code: str, depth: str
) -> None:
    turned = SimpleITK.DICOMOrient(SimpleITK.GetImageFromArray(VOXELS), code)
    path = tmp_path / "a.nii.gz"
    SimpleITK.WriteImage(turned, str(path))
    volume, said = read_volume_and_axis(path, depth)
    of_file = SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(path)))
    axis, _, backwards = said.partition(", ")
    along = np.moveaxis(of_file, {"the first": 2, "the second": 1, "the third": 0}[axis], 0)
    along = along[::-1] if backwards else along
    for k in range(len(along)):
        np.testing.assert_array_equal(np.sort(volume.voxels[:, k].ravel()), np.sort(along[k].ravel()))


def test_a_tracked_sweep_is_no_volume_until_it_is_reconstructed(tmp_path: Path) -> None:
    path = tmp_path / "sweep.mha"
    fields = "".join(f"Seq_Frame{k:04d}_Timestamp = {0.1 * k}\n" for k in range(5))
    header = (
        "ObjectType = Image\nNDims = 3\nDimSize = 7 6 5\nElementSpacing = 1 1 1\nElementType = MET_UCHAR\n"
        f"Kinds = domain domain list\n{fields}ElementDataFile = LOCAL\n"
    )
    path.write_bytes(header.encode() + VOXELS.tobytes())
    with pytest.raises(InputError, match=r"is a cine.*`echospline reconstruct`"):
        read_volume(path)


def test_a_sample_that_is_a_volume_is_named_where_a_picture_is_expected() -> None:
    assert set(IN_SPACE) == set(SAMPLE_VOLUMES)
    for name in IN_SPACE:
        with pytest.raises(InputError, match="is a volume; expected a picture: sample:calf"):
            read_image(f"sample:{name}")
        with pytest.raises(InputError, match=name):
            read_image("sample:kidny")
