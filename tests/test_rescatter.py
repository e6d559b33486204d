"""The image model that re-forms speckle, beside the warp."""

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.errors import InputError
from echospline.io import read, read_image
from echospline.laboratory import Phantom, phantom_pictures, rescatter, speckle_statistics
from echospline.laboratory.rescatter import FINE
from echospline.laboratory.speckle import correlation_coefficient
from echospline.picture import Deformation, warp
from echospline.scenario import load
from echospline.scene import RegularGrid, UltrasoundImage
from echospline.scene.transducer import LINEAR


@pytest.fixture(scope="module")
def calf():
    return read_image("sample:calf")


def still(image):
    return Deformation(RegularGrid.covering(image.grid, (20, 20)), np.zeros((400, 2)))


def test_scatterers_that_left_stay_away():
    scatterers = Phantom(LINEAR, RegularGrid((100, 100), (0.1, 0.1)), seed=1).scatterers
    fewer, more = (scatterers.replaced(share, 9).amplitudes for share in (0.2, 0.5))
    changed = fewer != scatterers.amplitudes
    assert changed.mean() == pytest.approx(0.1, abs=0.01)  # half of those drawn anew keep their sign
    assert (more[changed] == fewer[changed]).mean() > 0.99


def test_out_of_plane_motion_decorrelates_more_and_more():
    phantom = Phantom(LINEAR, RegularGrid((100, 100), (0.1, 0.1)), seed=1)
    echoes = []
    form = phantom_pictures(phantom, fps=2.0, out_of_plane=0.4, record=lambda i, e: echoes.append(e.iq))
    rest = Deformation(RegularGrid.covering(phantom.grid, (5, 5)), np.zeros((25, 2)))
    for _ in range(5):
        form(rest, rest.inverse(phantom.grid))
    rho = [abs(np.vdot(echoes[0], e)) / np.linalg.norm(echoes[0]) / np.linalg.norm(e) for e in echoes]
    assert rho[2] == pytest.approx(0.6, abs=0.06)  # a second, so 40 % have left
    assert rho[4] == pytest.approx(0.36, abs=0.08)


def test_rescattered_picture_is_as_bright_as_the_image_everywhere(calf):
    rest = still(calf)
    got = rescatter(calf, FINE)(rest, rest.inverse(calf.grid)).pixels.astype(float)

    def blocks(p):
        return p[:456, :576].reshape(12, 38, 12, 48).mean(axis=(1, 3))

    want = blocks(calf.pixels.astype(float))
    assert np.corrcoef(want.ravel(), blocks(got).ravel())[0, 1] > 0.97
    assert np.abs(blocks(got) - want).mean() < 15.0


def test_rescattered_speckle_decorrelates_under_strain_and_warped_does_not(calf):
    mesh = RegularGrid.covering(calf.grid, (20, 20))
    strained = Deformation(mesh, np.column_stack([np.zeros(400), 0.04 * mesh.nodes[:, 1]]))
    form, rest = rescatter(calf, FINE, angles=(0.0,)), still(calf)
    pairs = {
        "warp": (calf.pixels, warp(calf, strained).pixels),
        "rescatter": tuple(form(d, d.inverse(calf.grid)).pixels for d in (rest, strained)),
    }
    y, x = np.mgrid[100:400, 50:500].astype(np.float32)
    found = {}
    for name, (a, b) in pairs.items():
        back = cv2.remap(b, x, (y * 1.04).astype(np.float32), cv2.INTER_LINEAR)
        # what speckle alone does: brightness of structures taken off
        fine = [
            p.astype(np.float32) - cv2.GaussianBlur(p.astype(np.float32), (0, 0), 6)
            for p in (a[100:400, 50:500], back)
        ]
        found[name] = correlation_coefficient(*fine)
    assert found["warp"] > 0.9
    assert 1.0 - found["rescatter"] > 2.0 * (1.0 - found["warp"])
    assert found["rescatter"] < 0.85


def test_frames_of_one_former_have_noise_of_their_own(calf):
    form, rest = rescatter(calf, FINE), still(calf)
    a, b = (form(rest, rest.inverse(calf.grid)).pixels for _ in range(2))
    assert not np.array_equal(a, b)
    assert correlation_coefficient(a, b) > 0.95
    assert np.array_equal(a, rescatter(calf, FINE)(rest, rest.inverse(calf.grid)).pixels)


def test_rescatter_is_an_option_of_simulate(tmp_path):
    result = CliRunner().invoke(
        app,
        ["simulate", "sample:calf", "--out", str(tmp_path), "--image-model", "rescatter", "--fps", "1", "--depth", "5",
         "--dwell", "0", "--no-retract", "--formats", "mha", "--no-figure"],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    frames = read(tmp_path / "cine.mha", frame=0)
    assert frames.pixels.shape[:2] == read_image("sample:calf").pixels.shape[:2]
    assert not np.array_equal(frames.pixels, read_image("sample:calf").pixels)
    assert load(tmp_path / "scenario.toml").output.image_model == "rescatter"


def test_statistics_of_a_known_field():
    # Rayleigh envelope of white noise smoothed by a Gaussian: autocovariance of its width is known
    rng = np.random.default_rng(0)
    z = rng.normal(size=(2, 600, 600))
    smooth = [cv2.GaussianBlur(part, (0, 0), 3.0, sigmaY=2.0) for part in z]
    found = speckle_statistics(np.hypot(*smooth), (0.1, 0.1))
    assert found.snr == pytest.approx(1.913, rel=0.03)
    assert found.distance < 0.02
    # covariance of the envelope is close to the squared coherence exp(-lag^2 / (2 sigma^2))
    assert found.lateral == pytest.approx(2.355 * 0.3, rel=0.06)
    assert found.axial == pytest.approx(2.355 * 0.2, rel=0.06)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: rescatter(UltrasoundImage(np.zeros((40, 40)), RegularGrid((40, 40), (0.1, 0.1)))), "8-bit image"),
        (
            lambda: rescatter(UltrasoundImage(np.zeros((40, 40), np.uint8), RegularGrid((40, 40), (0.1, 0.1))), angles=()),
            "one beam angle or more",
        ),
        (lambda: phantom_pictures(Phantom(LINEAR, RegularGrid((40, 40), (0.1, 0.1))), out_of_plane=2.0), "a share from 0 to 1"),
        (lambda: speckle_statistics(np.ones((20, 20)), (0.1, 0.1)), "varying piece"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_with_a_reason(make, words):
    with pytest.raises(InputError, match=words):
        make()
