"""Where linear elasticity stops being good: its distance to neo-Hookean tissue under the same forces, by the size of the motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from echospline.errors import SolverError
from echospline.mechanics import Clamps
from echospline.mechanics.fem_response import FEMResponse
from echospline.mechanics.finite_elements import point_loads
from echospline.mechanics.neo_hookean import NeoHookean
from echospline.scene import Insertion, Tissue, field_error
from echospline.study.accuracy import CLAMPED, Case

PEAKS = (0.2, 1.0, 3.0)
"""Largest displacement of a node by linear elasticity, mm."""
NEEDLE = ((12.0, 0.0), 60.0, 22.0)
"""Entry (mm), angle (degrees), depth (mm): the tip is 11 mm from the bottom."""


def linearity(nodes: tuple[int, int] = (40, 30), peaks: Sequence[float] = PEAKS) -> list[dict[str, Any]]:
    """Compare both materials under a force at a needle's tip in the study's scene.

    Returns
    -------
    list of dict
        ``plane``, ``peak_mm``, ``force_n``, ``difference_percent_of_mean`` (of the neo-Hookean displacement; None where there is no
        equilibrium, and ``refused`` says why), one per plane law and peak.
    """
    case, rows = Case(nodes=nodes), []
    insertion = Insertion.straight(*NEEDLE)
    pose = insertion.pose(insertion.duration)
    unit = point_loads(case.grid, pose.tip, np.array(pose.axis))
    clamps = Clamps.of(case.grid, CLAMPED)
    for plane in ("stress", "strain"):
        tissue = Tissue(case.young, plane=plane)
        per_newton = FEMResponse(case.grid, clamps, tissue).factored.solve(unit)
        large = NeoHookean(case.grid, clamps, tissue)
        for peak in peaks:
            force = peak / float(np.hypot(*per_newton.T).max())
            row: dict[str, Any] = {"plane": plane, "peak_mm": peak, "force_n": force, "refused": None}
            try:
                truth = large.solve(force * unit).displacement
                row["difference_percent_of_mean"] = field_error(force * per_newton, truth).mae_percent
            except SolverError as stuck:
                row |= {"difference_percent_of_mean": None, "refused": str(stuck)}
            rows.append(row)
    return rows
