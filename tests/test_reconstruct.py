"""A volume from a tracked sweep: against a known field, PLUS' own reconstruction and SciPy's interpolation."""

import json

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from echospline.cli import main
from echospline.errors import InputError
from echospline.io.volume_writing import write_volume
from echospline.laboratory.reconstruct import reconstruct
from echospline.scene import Volume

CALIBRATION = (
    "-0.00157821 0.0785919 -0.00803285 15.3978 -0.0839128 0.00372697 0.0153803 49.5705 "
    "0.0159024 0.00714276 0.0803604 -8.63446 0 0 0 1"
)
"""ImageToProbe of the sweep, from PLUS' PlusDeviceSet_SpinePhantomFreehandReconstructionOnly.xml (BSD-3-Clause)."""


def field(p):
    """Smooth brightness of (n, 3) mm, 0 to 255."""
    return 120 + 60 * np.sin(p[:, 0] / 3) + 50 * np.cos(p[:, 1] / 4) * np.sin(p[:, 2] / 3)


def turned(angle, axis):
    c, s = np.cos(angle), np.sin(angle)
    m = np.eye(4)
    i, j = [k for k in range(3) if k != axis]
    m[i, i] = m[j, j] = c
    m[i, j], m[j, i] = -s, s
    return m


def sweep(count=30, rows=60, columns=80, step=0.5, pixel=0.25, tilt=0.2):
    """Pictures of `field` and where they lie: the probe moves along z and rocks."""
    matrices, frames = [], []
    index = np.mgrid[:rows, :columns].reshape(2, -1)
    places = np.stack([index[1], index[0], 0 * index[0], 1 + 0 * index[0]])
    for k in range(count):
        m = turned(0.3, 2) @ turned(tilt * np.sin(k / 5), 0) @ np.diag([pixel, pixel, 1.0, 1.0])
        m[2, 3] = k * step
        matrices.append(m)
        frames.append(field((m @ places)[:3].T).reshape(rows, columns))
    return np.array(frames), np.array(matrices)


def nodes(volume):
    z, y, x = np.mgrid[tuple(slice(0, n) for n in volume.voxels.shape)].reshape(3, -1)
    return np.stack([x, y, z], axis=1) * volume.spacing + volume.origin


@pytest.mark.parametrize("insertion", ["linear", "nearest"])
def test_voxels_hold_the_field_that_the_pictures_saw(insertion):
    frames, matrices = sweep()
    volume = reconstruct(frames, matrices, 0.5, insertion=insertion, fill=0)
    error = np.abs(volume.voxels.ravel() - field(nodes(volume)))[volume.filled.ravel()]
    # a voxel holds the mean over the pixels around it: at most a voxel away, the steepest slope being 25 per mm
    assert volume.filled.mean() > 0.3
    assert np.median(error) < 2.0
    assert error.max() < 0.5 * np.sqrt(3) * 25


def test_filled_holes_hold_the_field_too_and_nothing_is_filled_outside():
    frames, matrices = sweep(count=8, step=1.5, tilt=0.0)
    volume = reconstruct(frames, matrices, 0.5, fill=9)
    bare = reconstruct(frames, matrices, 0.5, fill=0)
    added = volume.filled & ~bare.filled
    assert added.sum() > 0.5 * bare.filled.sum()
    assert np.abs(volume.voxels.ravel() - field(nodes(volume)))[added.ravel()].mean() < 8.0
    local = (np.linalg.inv(turned(0.3, 2)) @ np.c_[nodes(volume)[added.ravel()], np.ones(added.sum())].T)[:2]
    reach = 0.5 * np.sqrt(2)  # a pixel is shared by voxels up to a voxel away along each axis
    assert local[0].min() > -reach
    assert local[0].max() < 79 * 0.25 + reach
    assert local[1].min() > -reach
    assert local[1].max() < 59 * 0.25 + reach


def test_lines_longer_than_allowed_stay_empty():
    frames, matrices = sweep(count=2, step=6.0, tilt=0.0)
    assert (
        reconstruct(frames, matrices, 0.5, fill=9).filled.sum()
        == reconstruct(frames, matrices, 0.5, fill=0).filled.sum()
    )
    assert reconstruct(frames, matrices, 0.5, fill=14).filled.all(axis=0).any()


def test_uniform_pictures_give_a_uniform_volume_of_their_type():
    frames, matrices = sweep()
    volume = reconstruct(np.full(frames.shape, 77, dtype=np.uint8), matrices, 0.5)
    assert volume.voxels.dtype == np.uint8
    assert set(np.unique(volume.voxels[volume.filled])) == {77}
    assert set(np.unique(volume.voxels[~volume.filled])) <= {0}


def test_a_volume_is_sampled_as_scipy_does():
    rng = np.random.default_rng(3)
    volume = Volume(rng.uniform(0, 255, (7, 9, 11)), (0.5, 0.75, 1.25), (-3.0, 2.0, 5.0))
    points = rng.uniform(-0.2, 1.2, (500, 3)) * volume.size + volume.origin
    index = (points - volume.origin) / volume.spacing
    inside = volume.contains(points)
    expected = map_coordinates(volume.voxels, index[:, ::-1].T, order=1)
    np.testing.assert_allclose(volume.sample(points)[inside], expected[inside], atol=1e-9)
    assert (volume.sample(points, outside=-1.0)[~inside] == -1.0).all()
    assert 0 < inside.sum() < 500


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"spacing": 1e-4}, "larger spacing"),
        ({"spacing": 0.0}, "positive number in mm"),
        ({"spacing": 0.5, "insertion": "cubic"}, "linear, nearest"),
        ({"spacing": 0.5, "region": (0, 0, 999, 5)}, "within 80 x 60 pixels"),
        ({"spacing": 0.5, "fill": -1}, "0 or more"),
    ],
)
def test_what_makes_no_sense_gets_a_sentence(change, said):
    frames, matrices = sweep(count=3)
    with pytest.raises(InputError, match=said):
        reconstruct(frames, matrices, **change)


def test_frames_without_a_transform_are_refused():
    frames, matrices = sweep(count=3)
    matrices[1] = np.nan
    with pytest.raises(InputError, match="finite"):
        reconstruct(frames, matrices, 0.5)
    with pytest.raises(InputError, match="every frame has a transform"):
        reconstruct(frames, matrices[:2], 0.5)


def test_a_written_volume_is_read_by_itk(tmp_path):
    itk = pytest.importorskip("SimpleITK")
    rng = np.random.default_rng(1)
    volume = Volume(rng.integers(0, 255, (4, 5, 6)).astype(np.uint8), (0.5, 0.6, 0.7), (1.0, -2.0, 3.0))
    read = itk.ReadImage(str(write_volume(tmp_path / "v.mha", volume)))
    assert read.GetSpacing() == volume.spacing
    assert read.GetOrigin() == volume.origin
    np.testing.assert_array_equal(itk.GetArrayFromImage(read), volume.voxels)


def test_the_spine_sweep_is_what_plus_makes_of_it(recordings, tmp_path, capsys, monkeypatch):
    itk = pytest.importorskip("SimpleITK")
    spine = recordings / "pluslib"
    config, out = tmp_path / "plus.xml", tmp_path / "volume.mha"
    config.write_text(
        "<PlusConfiguration><CoordinateDefinitions>"
        f'<Transform From="Image" To="Probe" Matrix="{CALIBRATION}"/>'
        "</CoordinateDefinitions></PlusConfiguration>"
    )
    command = [
        "echospline",
        "reconstruct",
        str(spine / "SpinePhantomFreehand.igs.mha"),
        "--config",
        str(config),
        "--out",
        str(out),
        "--json",
    ]
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    told = json.loads(capsys.readouterr().out)
    assert told["frames"] == 21
    ours, theirs = (
        itk.ReadImage(str(out)),
        itk.ReadImage(str(spine / "SpinePhantomFreehandReconstructed.mha")),
    )
    np.testing.assert_allclose(ours.GetOrigin(), theirs.GetOrigin(), atol=1e-3)
    a, b = itk.GetArrayFromImage(ours).astype(float), itk.GetArrayFromImage(theirs).astype(float)
    common = tuple(slice(0, min(m, n)) for m, n in zip(a.shape, b.shape, strict=True))
    a, b = a[common], b[common]
    both = (a > 0) & (b > 0)
    assert both.mean() > 0.28  # PLUS has filled 29 %
    assert np.corrcoef(a[both], b[both])[0, 1] > 0.99
