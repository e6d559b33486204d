"""Differences between two displacement fields, equation (24)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from echospline.errors import InputError
from echospline.scene.grid import Floats

MOVED = 1e-9
"""mm; a node that moves less counts as not moved by the reference."""


@dataclass(frozen=True)
class FieldError:
    """Difference of two fields over the N nodes that the reference moves, equation (24).

    Attributes
    ----------
    mae, rmse : float
        Mean and root mean square of the distance epsilon between the nodes, mm.
    worst : float
        Largest distance, mm.
    mean_displacement : float
        Of the reference over the same nodes, mm.
    nodes : int
        N, over all frames.
    """

    mae: float
    rmse: float
    worst: float
    mean_displacement: float
    nodes: int

    @property
    def mae_percent(self) -> float:
        """MAE as a share of the mean displacement of the reference, %."""
        return 100.0 * self.mae / self.mean_displacement

    @property
    def rmse_percent(self) -> float:
        """RMSE as a share of the mean displacement of the reference, %."""
        return 100.0 * self.rmse / self.mean_displacement


def distance(a: ArrayLike, b: ArrayLike) -> Floats:
    """Return epsilon = |a - b| per node, mm, shape (..., n) of fields (..., n, 2)."""
    difference = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
    if difference.shape[-1:] != (2,):
        raise InputError(f"displacement fields must have shape (..., n, 2) in mm; got {difference.shape}")
    epsilon: Floats = np.hypot(difference[..., 0], difference[..., 1])
    return epsilon


def field_error(field: ArrayLike, reference: ArrayLike) -> FieldError:
    """Compare a displacement field with a reference, equation (24).

    Parameters
    ----------
    field, reference : array_like, shape (..., n, 2)
        mm. Where the reference is not a number (a point that could not be tracked), nothing is compared.

    Raises
    ------
    InputError
        If shapes differ, or the reference moves no node.
    """
    a, b = np.asarray(field, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if a.shape != b.shape:
        raise InputError(f"both fields must have one shape; got {a.shape} and {b.shape}")
    size = distance(b, np.zeros_like(b))
    moved = size > MOVED  # False where the reference is nan
    if not moved.any():
        raise InputError("the reference displaces no node, so there is nothing to compare with")
    epsilon = distance(a, b)[moved]
    if not np.isfinite(epsilon).all():
        raise InputError("the field holds a number that is not finite where the reference is known")
    return FieldError(
        float(epsilon.mean()),
        float(np.sqrt(np.mean(epsilon**2))),
        float(epsilon.max()),
        float(size[moved].mean()),
        int(moved.sum()),
    )
