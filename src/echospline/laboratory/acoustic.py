"""The slow reference: channel data of scatterers by an acoustic simulator (SIMUS of PyMUST, an extra)."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from echospline.errors import MissingExtraError
from echospline.laboratory.beamform import LinearArray
from echospline.scene import Floats


def channel_data(
    positions: Floats, amplitudes: Floats, array: LinearArray, *, elements: int = 64, bandwidth: float = 0.6
) -> tuple[Floats, LinearArray]:
    """Simulate one plane wave sent straight ahead: diffraction, element directivity, pulse.

    Parameters
    ----------
    positions : ndarray, shape (n, 2)
        Scatterers, (lateral, depth) mm; the array is centred on x = 0 at depth 0.
    amplitudes : ndarray, shape (n,)
    array : LinearArray
        Frequency, pitch and speed of sound; sampling is raised to four times the frequency.
    elements : int
    bandwidth : float
        Share of the frequency, pulse-echo, -6 dB.

    Returns
    -------
    rf : ndarray, shape (samples, elements)
    array : LinearArray
        With the sampling recorded, for `beamform.demodulate` and `beamform.delay_and_sum`.

    Raises
    ------
    MissingExtraError
        If PyMUST is not installed.
    """
    try:
        pymust: Any = import_module("pymust")
    except ImportError as missing:
        raise MissingExtraError("pymust", "acoustic", "acoustic simulation") from missing
    param = pymust.utils.Param()
    param.fc, param.fs = array.frequency * 1e6, 4.0 * array.frequency * 1e6
    param.pitch, param.kerf = array.pitch * 1e-3, 0.1 * array.pitch * 1e-3
    param.width = param.pitch - param.kerf
    param.Nelements, param.bandwidth = elements, 100.0 * bandwidth
    param.c, param.radius, param.attenuation = array.sound_speed * 1e3, np.inf, 0.0
    x, z = positions.T * 1e-3
    # a plane wave: every element fires at once
    rf = pymust.simus(x, z, np.asarray(amplitudes), np.zeros((1, elements)), param)[0]
    recorded = LinearArray(
        array.frequency, 4.0 * array.frequency, array.pitch, 0.0, array.sound_speed, array.f_number
    )
    return np.asarray(rf, dtype=np.float64), recorded
