"""The speckle phantom against the exact sum, the statistics of speckle, and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal, stats

from echospline.errors import InputError, MissingExtraError
from echospline.laboratory import Inclusion, Layer, LinearArray, Phantom, Scatterers, channel_data
from echospline.laboratory.phantom import deposit
from echospline.scene import Display, Echo, RegularGrid, Transducer
from echospline.scene.transducer import CONVEX, LINEAR

GRID = RegularGrid((200, 200), (0.1, 0.1))
QUIET = replace(LINEAR, snr=float("inf"))


def shear(p):
    return np.column_stack([0.02 * p[:, 1], 0.03 * p[:, 0] - 0.01 * p[:, 1]])


@pytest.mark.parametrize("probe", [QUIET, replace(CONVEX, focus=8.0, snr=float("inf"))])
def test_convolution_equals_the_exact_sum_over_moved_scatterers(probe):
    h = 0.1 if probe is QUIET else 0.17
    phantom = Phantom(probe, RegularGrid((150, 150), (h, h)), seed=3)
    chosen = np.random.default_rng(0).integers(0, phantom.samples.size, 300)
    got = phantom.form(shear).iq.reshape(-1)[chosen]
    truth = phantom.exact(phantom.samples.nodes[chosen], shear)
    assert np.linalg.norm(got - truth) < 0.02 * np.linalg.norm(truth)


def test_error_of_the_deposit_falls_with_the_square_of_the_spacing():
    # the hat function's aliases fall as h^2, and so must the error: halve the pixels, quarter it
    errors = []
    for h in (0.1, 0.05):
        n = round(12 / h)
        phantom = Phantom(QUIET, RegularGrid((n, 2 * n), (h, h / 2)), seed=1)
        assert phantom.samples == phantom.grid
        points = np.random.default_rng(1).integers(0, phantom.samples.size, 200)
        truth = phantom.exact(phantom.samples.nodes[points])
        errors.append(np.linalg.norm(phantom.form().iq.reshape(-1)[points] - truth) / np.linalg.norm(truth))
    assert errors[0] / errors[1] > 3.0


def test_envelope_of_developed_speckle_is_rayleigh():
    iq = Phantom(QUIET, GRID, seed=5).form().iq
    apart = np.abs(iq[:: 2 * 5, ::12]).ravel()  # further apart than a speckle: independent draws
    assert stats.kstest(apart, stats.rayleigh(scale=np.sqrt(0.5)).cdf).pvalue > 0.01
    assert apart.mean() / apart.std() == pytest.approx(1.913, rel=0.1)


def test_too_few_scatterers_are_not_rayleigh():
    iq = Phantom(QUIET, GRID, seed=5, per_cell=0.3).form().iq
    apart = np.abs(iq[::10, ::12]).ravel()
    assert stats.kstest(apart, stats.rayleigh(scale=np.sqrt(0.5)).cdf).pvalue < 1e-3


@pytest.mark.parametrize("probe", [QUIET, replace(CONVEX, snr=float("inf"))])
def test_speckle_is_as_wide_as_the_point_spread(probe):
    # autocorrelation of the complex field: a Gaussian of sqrt(2) times the point spread's width
    h = 0.1 if probe is QUIET else 0.17
    phantom = Phantom(probe, RegularGrid((300, 300), (h, h)), seed=2)
    iq = phantom.form().iq
    dx, dy = phantom.samples.spacing
    for axis, spacing, sigma in ((0, dy, probe.sigma_axial), (1, dx, probe.sigma_lateral)):
        lag = max(1, round(sigma / spacing))
        a, b = (
            np.take(iq, np.arange(iq.shape[axis] - lag), axis),
            np.take(iq, np.arange(lag, iq.shape[axis]), axis),
        )
        rho = np.abs((a.conj() * b).sum()) / np.sqrt((np.abs(a) ** 2).sum() * (np.abs(b) ** 2).sum())
        assert rho == pytest.approx(np.exp(-((lag * spacing) ** 2) / (4 * sigma**2)), abs=0.04)


def test_mean_power_is_one_at_every_depth_under_a_fixed_focus():
    # the widest beam leaves some 250 cells in the deepest third: four seeds bring the spread down to 3.5 %
    grid, probe = RegularGrid((300, 300), (0.1, 0.1)), replace(QUIET, focus=5.0, f_number=1.5)
    power = np.mean([np.abs(Phantom(probe, grid, seed).form().iq) ** 2 for seed in range(4)], axis=0)
    thirds = [part.mean() for part in np.array_split(power, 3)]
    assert thirds == pytest.approx([1.0, 1.0, 1.0], abs=0.12)
    assert probe.beam(25.0) > 2 * probe.beam(5.0)


def test_noise_has_the_power_that_the_probe_asks_for():
    # RF noise per sample at 40 MHz, by an independent route: real lines, their variance against the signal's
    phantom = Phantom(replace(LINEAR, snr=10.0), GRID, seed=1)
    clean, noisy = phantom.form(), phantom.form(noise_seed=4)
    noise = Echo(noisy.iq - clean.iq, clean.grid, clean.carrier).rf(40.0)[0]
    rf = clean.rf(40.0)[0]
    share = (1.54 / 2 / phantom.samples.spacing[1]) / 20.0  # of the 20 MHz the samples carry this much
    assert 10 * np.log10(rf.var() / (noise.var() / share)) == pytest.approx(10.0, abs=0.4)


def test_attenuation_drowns_the_deep_half_in_noise():
    phantom = Phantom(replace(LINEAR, snr=20.0, attenuation=0.5), GRID, seed=1)
    noise = np.abs(phantom.noise(3)) ** 2
    top, bottom = noise[:50].mean(), noise[-50:].mean()
    between = (phantom.samples.shape[1] - 50) * phantom.samples.spacing[1] / 10  # cm
    assert 10 * np.log10(bottom / top) == pytest.approx(2 * 0.5 * 5.0 * between, rel=0.05)


def test_regions_have_their_levels():
    regions = (Layer(10.0, 20.0, -12.0), Inclusion((5.0, 5.0), (3.0, 2.0), 9.0))
    power = np.abs(Phantom(QUIET, GRID, seed=0, regions=regions).form().iq) ** 2
    db = 10 * np.log10([power[60:140, 30:70].mean(), power[240:380].mean(), power[30:170, 130:190].mean()])
    assert db == pytest.approx([9.0, -12.0, 0.0], abs=1.0)


def test_frames_repeat_with_the_seed_and_differ_without():
    a, b = (Phantom(LINEAR, GRID, seed=7).form(shear, noise_seed=1).iq for _ in range(2))
    other = Phantom(LINEAR, GRID, seed=8).form(shear, noise_seed=1).iq
    assert np.array_equal(a, b)
    assert np.abs(np.vdot(a, other)) < 0.1 * np.vdot(a, a).real


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_replaced_scatterers_decorrelate_by_their_share(share):
    phantom = Phantom(QUIET, GRID, seed=7)
    a, b = phantom.form().iq, phantom.form(replaced=share).iq
    rho = np.vdot(a, b).real / np.sqrt(np.vdot(a, a).real * np.vdot(b, b).real)
    assert rho == pytest.approx(1.0 - share, abs=0.04)


def test_rigid_motion_by_whole_pixels_moves_the_picture():
    phantom = Phantom(QUIET, GRID, seed=4)
    a = np.abs(phantom.form().iq)
    b = np.abs(phantom.form(lambda p: np.full_like(p, 0.5)).iq)
    inner = slice(20, -20)
    assert np.allclose(b[inner, inner][10:, 5:], a[inner, inner][:-10, :-5], atol=0.02 * a.max())


def test_rf_and_iq_are_the_same_echo():
    phantom = Phantom(QUIET, GRID, seed=4)
    echo = phantom.form()
    rf, grid = echo.rf(40.0)
    # exact real signal, straight from the definition
    rows = np.arange(50, 900, 50)
    points = np.column_stack([np.full(len(rows), 10.0), grid.y[rows]])
    truth = np.real(phantom.exact(points) * np.exp(2j * np.pi * LINEAR.carrier * points[:, 1]))
    assert np.linalg.norm(rf[rows, 100] - truth) < 0.03 * np.linalg.norm(truth)
    back = Echo.from_rf(rf, grid, echo.carrier)
    direct = np.abs(signal.hilbert(rf, axis=0))
    assert np.allclose(back.envelope()[50:-50], direct[50:-50], rtol=1e-3, atol=1e-3)
    again = np.interp(echo.grid.y[50:350], grid.y, back.envelope()[:, 60])
    assert np.corrcoef(again, echo.envelope()[50:350, 60])[0, 1] > 0.999


def test_grey_and_envelope_are_inverse():
    display = Display(60.0, 10.0)
    grey = np.arange(1, 255, dtype=np.uint8)
    assert np.array_equal(display.grey(display.envelope(grey)), grey)
    assert np.diff(20 * np.log10(display.envelope(grey))) == pytest.approx(60.0 / 255.0)


def test_picture_on_a_foreign_grid_is_refused():
    echo = Phantom(QUIET, GRID, seed=0).form()
    with pytest.raises(InputError, match="must lie on the echo samples"):
        echo.b_mode(grid=RegularGrid((20, 20), (0.13, 0.1)))


def test_deposit_keeps_the_sum_and_the_first_moment():
    rng = np.random.default_rng(2)
    points, values = rng.uniform(0.5, 8.5, (500, 2)), rng.standard_normal(500)
    grid = RegularGrid((10, 10), (1.0, 1.0))
    out = deposit(points, values, grid)
    assert out.sum() == pytest.approx(values.sum(), rel=1e-5)
    assert out.ravel() @ grid.nodes == pytest.approx(values @ points, rel=1e-4)
    turned = deposit(points, values, grid, (0.3, 0.7))
    assert turned.sum() == pytest.approx((values * np.exp(-2j * np.pi * points @ [0.3, 0.7])).sum(), rel=1e-4)
    assert not deposit(np.array([[-0.1, 3.0], [9.5, 3.0], [3.0, np.nan]]), np.ones(3), grid).any()


def test_compounding_brings_the_envelope_closer_to_its_mean():
    # the covariance of two looks' intensities is the squared coherence of the point spread at the difference of
    # their carriers, and a share that a finite number of scatterers adds; the variance of the mean is its mean
    phantom = Phantom(QUIET, RegularGrid((300, 300), (0.1, 0.1)), seed=3)
    angles = (-8.0, 0.0, 8.0)
    powers = [np.abs(phantom.form(steering=a).iq) ** 2 for a in angles]
    theta = np.radians(angles)
    kx, ky = LINEAR.carrier * np.sin(theta), LINEAR.carrier * np.cos(theta)
    dx, dy = kx[:, None] - kx, ky[:, None] - ky
    coherence = np.exp(
        -2 * (np.pi * LINEAR.sigma_lateral * dx) ** 2 - 2 * (np.pi * LINEAR.sigma_axial * dy) ** 2
    )
    mean = np.mean(powers, axis=0)
    few = 1.0 / (phantom.scatterers.density * 2.0 * np.pi * LINEAR.sigma_lateral * LINEAR.sigma_axial)
    assert few == pytest.approx(0.07, abs=0.01)
    assert mean.var() / mean.mean() ** 2 == pytest.approx(coherence.mean() + few, rel=0.12)
    one = powers[1]
    assert one.var() / one.mean() ** 2 == pytest.approx(1.0 + few, rel=0.1)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Transducer(frequency=0.0), "frequency must be a positive number MHz"),
        (lambda: Transducer(sampling=8.0), "sampling must be at least 16 MHz"),
        (lambda: Transducer(snr=float("nan")), "snr must be a number"),
        (lambda: Inclusion((0, 0), (1, -1), 0), "positive half axes"),
        (lambda: Layer(3, 3, 0), "top above bottom"),
        (lambda: Layer(1, 3, float("nan")), "level in dB"),
        (lambda: Phantom(LINEAR, GRID, per_cell=0), "per_cell"),
        (lambda: Phantom(LINEAR, RegularGrid((40000, 40000), (0.1, 0.1))), "scatterers"),
        (lambda: Scatterers.random((0, 1, 0, 1), 10, 0).replaced(1.5, 0), "between 0 and 1"),
        (lambda: Phantom(LINEAR, GRID).form(lambda p: p[:3]), "finite and \\(n, 2\\)"),
        (lambda: Echo(np.zeros((3, 3)), RegularGrid((3, 3), (1, 1)), 6.5), "complex samples"),
        (lambda: Echo.from_rf(np.zeros((9, 3)), RegularGrid((3, 9), (1, 1)), 6.5), "closer than"),
    ],
)
def test_bad_input_is_refused_with_a_reason(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_missing_simulator_names_the_command(monkeypatch):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr("echospline.laboratory.acoustic.import_module", absent)
    with pytest.raises(MissingExtraError, match="echospline\\[acoustic\\]"):
        channel_data(np.zeros((1, 2)), np.ones(1), LinearArray(5.0, 20.0, 0.3))
