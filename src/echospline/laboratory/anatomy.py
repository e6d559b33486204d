"""A kidney in the back of a prone patient, as signed distances: what lies at every point of a regular lattice.

x is lateral (+x to the feet), y depth below the skin, z elevation (+z to the spine), mm. Distances are negative inside;
those of layers are negative above. Shapes are those of textbooks, roughened by smooth noise from the seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from echospline.scene import Floats

Singles = NDArray[np.float32]
Numbers = Sequence[float] | Floats
Coordinates = tuple[Singles, Singles, Singles]
"""x, y and z, broadcastable against each other."""

FAR = np.float32(20.0)
"""mm; distance given to what lies inside the kidney at places so far from it that nobody asks."""


class SmoothNoise:
    """Noise of unit deviation on wrapped tables, interpolated linearly.

    Parameters
    ----------
    seed : int
    """

    SIZE = 64

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        shape = (self.SIZE,) * 3
        tables = [ndimage.gaussian_filter(rng.standard_normal(shape), 1.3, mode="wrap") for _ in range(4)]
        self._tables = [(t / t.std()).astype(np.float32) for t in tables]

    def on(self, p: Coordinates, scale: float | Sequence[float], channel: int) -> Singles:
        """Sample at a lattice: ``p`` as `lattice` gives it; ``scale`` is mm per table cell, one number or one per axis."""
        table = self._tables[channel % 4]
        x, y, z = (
            self._weights(a.ravel(), s, channel) for a, s in zip(p, np.broadcast_to(scale, 3), strict=True)
        )
        along_z = (z @ table.reshape(self.SIZE, -1)).reshape(len(z), self.SIZE, self.SIZE)
        noise: Singles = np.matmul(np.matmul(y[None], along_z), np.ascontiguousarray(x.T))
        return noise

    def at(self, points: Singles, scale: float, channel: int) -> Singles:
        """Sample at points (n, 3)."""
        index = points.T[::-1] / np.float32(scale) + np.float32(17.3 * channel)
        table = self._tables[channel % 4]
        return np.asarray(ndimage.map_coordinates(table, index, np.float32, order=1, mode="grid-wrap"))

    def _weights(self, a: Singles, scale: float, channel: int) -> Singles:
        """Return the matrix that interpolates a wrapped table along one axis, shape (n, SIZE)."""
        index = a / np.float32(scale) + np.float32(17.3 * channel)
        low = np.floor(index)
        share = index - low
        weights = np.zeros((len(a), self.SIZE), dtype=np.float32)
        rows = np.arange(len(a))
        weights[rows, low.astype(int) % self.SIZE] = 1 - share
        weights[rows, (low.astype(int) + 1) % self.SIZE] = share
        return weights


def lattice(x: Singles, y: Singles, z: Singles) -> Coordinates:
    """Return coordinates of a lattice that broadcast to (nz, ny, nx)."""
    return x[None, None, :], y[None, :, None], z[:, None, None]


def ellipsoid(p: Coordinates, centre: Numbers, radii: Numbers) -> Singles:
    """Approximate the signed distance to an ellipsoid, to first order at its surface."""
    q = [(a - np.float32(c)) / np.float32(r) for a, c, r in zip(p, centre, radii, strict=True)]
    size = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    slope = np.sqrt(sum((a / np.float32(r)) ** 2 for a, r in zip(q, radii, strict=True)))
    distance: Singles = size * (size - np.float32(1.0)) / np.maximum(slope, np.float32(1e-6))
    return distance


def rod(p: Coordinates, start: Numbers, end: Numbers, first: float, last: float) -> Singles:
    """Return the signed distance to a tapering rod between two points, of radius ``first`` to ``last``."""
    a, d = np.asarray(start, np.float32), np.subtract(end, start).astype(np.float32)
    q = [x - y for x, y in zip(p, a, strict=True)]
    h = np.clip((q[0] * d[0] + q[1] * d[1] + q[2] * d[2]) / (d @ d), 0.0, 1.0)
    r = [x - h * y for x, y in zip(q, d, strict=True)]
    distance: Singles = np.sqrt(r[0] ** 2 + r[1] ** 2 + r[2] ** 2) - (
        np.float32(first) + h * np.float32(last - first)
    )
    return distance


def blend(a: Singles, b: Singles, width: float) -> Singles:
    """Unite two shapes with a rounded seam of ``width`` mm."""
    h = np.maximum(np.float32(width) - np.abs(a - b), 0.0)
    joined: Singles = np.minimum(a, b) - h * h * np.float32(0.25 / width)
    return joined


@dataclass(frozen=True)
class Calyx:
    """One pyramid and the cup that it drains into, in the kidney's own frame, mm."""

    tip: Floats
    direction: Floats
    pyramid: float
    cup: float
    drain: Floats
    vessel: tuple[Floats, Floats]


class KidneyAnatomy:
    """What lies where; the same seed gives the same patient.

    Parameters
    ----------
    seed : int
    """

    CENTRE = (4.0, 57.0, -2.0)
    RADII = (43.0, 21.0, 25.0)
    ROWS = ((75.0, 6), (8.0, 6), (-62.0, 6))
    """Degrees about the kidney's axis, and number of pyramids."""
    STONE_CALYX = 4
    """The dorsal calyx near the lower pole: dilated, it holds the stone."""

    def __init__(self, seed: int = 0) -> None:
        self.noise = SmoothNoise(seed)
        rng = np.random.default_rng((seed, 7))
        ct, st, cu, su = cos(0.19), sin(0.19), cos(0.14), sin(0.14)  # the upper pole lies dorsal and medial
        turn = np.array(((ct, st, 0), (-st, ct, 0), (0, 0, 1))) @ np.array(
            ((cu, 0, -su), (0, 1, 0), (su, 0, cu))
        )
        self._turn = turn.astype(np.float32)
        self.calyces = [
            self._calyx(rng, row, j, count, angle)
            for row, (angle, count) in enumerate(self.ROWS)
            for j in range(count)
        ]
        stone = self.calyces[self.STONE_CALYX]
        self.stone = stone.tip - 2.2 * stone.direction

    def _calyx(self, rng: np.random.Generator, row: int, j: int, count: int, angle: float) -> Calyx:
        u = (j - (count - 1) / 2 + (0.5 if row == 1 else 0.0)) * 10.5 + rng.uniform(-1, 1)
        fan, a = u / 27.0 * 0.85 + rng.normal(0, 0.04), radians(angle + rng.normal(0, 6))
        d = np.array((sin(fan), -cos(fan) * sin(a), -cos(fan) * cos(a)))
        s = np.linspace(0.0, 30.0, 300, dtype=np.float32)
        ray = (np.array((u * 0.62, 1.0, 4.0))[:, None] + d[:, None] * s).astype(np.float32)
        tip = ray[:, np.argmax(self._sinus((ray[0], ray[1], ray[2])) > 0)].astype(float)
        cup = float(rng.choice((0.0, 2.4, 3.0, 3.8), p=(0.25, 0.3, 0.3, 0.15)))
        if row * 6 + j == self.STONE_CALYX:
            cup = 6.4
        drain = np.array((-13.0 if u < -8 else 13.0 if u > 8 else 0.0, 2.0, 7.0))
        root = tip - 3.0 * d + np.array((5.2, 0, 0))  # vessels run between neighbouring pyramids
        return Calyx(
            tip, d, float(rng.uniform(5.2, 6.6)), cup, drain, (root, root + 11.0 * d + np.array((2.4, 0, 0)))
        )

    def local(self, p: Coordinates) -> Coordinates:
        """Return coordinates in the kidney: u to its lower pole, v ventral, w to the hilum, round which it is bent."""
        q = [a - np.float32(c) for a, c in zip(p, self.CENTRE, strict=True)]
        u, v, w = (row[0] * q[0] + row[1] * q[1] + row[2] * q[2] for row in self._turn)
        return u, v, w - np.float32(0.0035) * u * u

    def distances(self, p: Coordinates) -> dict[str, Singles]:
        """Return signed distances, mm, by name; each of shape (nz, ny, nx)."""
        x, y, z = p
        shape = np.broadcast_shapes(x.shape, y.shape, z.shape)
        flat = (x, np.zeros((1, 1, 1), np.float32), z)
        n = self.noise.on
        d = {"skin": y - 2.0 - 0.12 * n(flat, 4.0, 3)}
        d["fascia1"] = y - 10.5 - 0.02 * x - 1.0 * n(flat, 9.0, 0) - 0.3 * n(p, 2.0, 3)
        d["fascia2"] = y - 17.0 - 0.03 * x - 0.8 * n(flat, 10.0, 1) - 0.3 * n(p, 2.0, 2)
        d["fascia3"] = y - 27.0 - 0.002 * x * x - 0.9 * n(flat, 9.0, 2) - 0.3 * n(p, 2.0, 1)
        q = self.local(p)
        body = ellipsoid(q, (0, 0, 0), self.RADII) + 0.9 * n(p, 8.0, 0) + 0.25 * n(p, 3.5, 1)
        hilum = blend(ellipsoid(q, (0, 5, 31), (15, 9, 13)), ellipsoid(q, (0, 4, 24), (9, 6, 9)), 4.0)
        d["capsule"] = np.maximum(body, -hilum)
        d["gerota"] = blend(ellipsoid(q, (0, 0, 3), (49, 25.5, 33)), 60.0 - y, 1.0) + 0.9 * n(p, 8.0, 2)
        liver = ellipsoid(p, (-46, 102, -14), (58, 34, 44)) + 0.8 * n(p, 10.0, 1)
        d["liver"] = np.maximum(liver, 3.0 + 0.5 * n(p, 5.0, 3) - d["capsule"])
        psoas = rod((np.zeros_like(x), y, z), (0, 80, 33), (1, 80.2, 33), 19, 19)
        d["psoas"] = np.maximum(psoas - 0.05 * x + 0.8 * n(p, (14, 6, 6), 3), 5.0 - d["capsule"])
        oval = (x / np.float32(1.7), y, z)  # ribs are 1.7 times as wide as thick
        eleventh = rod(oval, (-52 / 1.7, 19, 40), (-36 / 1.7, 20.5, -40), 3.4, 3.4)
        twelfth = rod(oval, (-27 / 1.7, 19.5, 40), (-17 / 1.7, 21.5, -4), 3.4, 2.6)
        d["bone"] = np.minimum(eleventh, twelfth) + 0.2 * n(p, 3.0, 2)
        d["stone"] = ellipsoid(q, self.stone, (4.4, 3.0, 3.6)) + 0.35 * n(p, 1.2, 3)
        self._inside(d, p, q, shape)
        liver_vessels = (
            ((-44, 88, -30), (-20, 84, 20), 2.6, 1.3),
            ((-44, 78, 18), (-14, 90, -14), 1.2, 2.2),
            ((-34, 85, -8), (-38, 74, 10), 1.6, 0.6),
        )
        for start, end, first, last in liver_vessels:
            vessel = np.maximum(rod(p, start, end, first, last) + 0.3 * n(p, 3.0, 0), d["liver"] + 1.0)
            d["blood"] = np.minimum(d["blood"], vessel)
        return {
            name: np.ascontiguousarray(np.broadcast_to(v, shape), dtype=np.float32) for name, v in d.items()
        }

    def _sinus(self, q: Coordinates) -> Singles:
        """Return the smooth distance to the fat of the sinus."""
        return blend(ellipsoid(q, (0, 1, 4), (27, 9, 13)), ellipsoid(q, (0, 3, 18), (11, 7, 13)), 4.0)

    def _inside(self, d: dict[str, Singles], p: Coordinates, q: Coordinates, shape: tuple[int, ...]) -> None:
        """Add sinus, pyramids, collecting system and vessels, worked out near the kidney alone."""
        names = ("urine", "sinus", "pyramid", "blood")
        d.update((name, np.full(shape, FAR)) for name in names)
        near = d["capsule"] < 14.0
        if not near.any():
            return
        q = tuple(np.broadcast_to(a, shape)[near] for a in q)  # type: ignore[assignment]
        n = {key: self.noise.on(p, *key)[near] for key in ((3.5, 1), (1.4, 2), (2.5, 3), (2.5, 0), (2.0, 1))}
        sinus = self._sinus(q) + 0.9 * n[3.5, 1] + 0.5 * n[1.4, 2]
        capsule = d["capsule"][near]
        height = (
            sinus / np.maximum(sinus - capsule, 0.5) + 0.03 * n[2.5, 3]
        )  # 0 at the sinus, 1 at the capsule
        pyramid = np.full(sinus.shape, FAR)
        for calyx in self.calyces:
            r = [a - np.float32(b) for a, b in zip(q, calyx.tip, strict=True)]
            s = sum(a * np.float32(b) for a, b in zip(r, calyx.direction, strict=True))
            rho = np.sqrt(np.maximum(r[0] ** 2 + r[1] ** 2 + r[2] ** 2 - s * s, 0.0))
            cone = rho - np.float32(calyx.pyramid) * np.clip(0.25 + 0.75 * height / 0.55, 0.12, 1.0)
            np.minimum(pyramid, np.maximum(cone, -s - 2.0), out=pyramid)
        pyramid = np.maximum(pyramid + 0.45 * n[2.5, 0], np.maximum((height - 0.60) * 15.0, capsule + 5.5))
        urine = self._collecting_system(q, pyramid) + 0.2 * n[2.0, 1]
        blood = np.maximum(self._vessels(q), 0.8 - urine)
        values = (np.maximum(urine, -d["stone"][near]), np.maximum(sinus, capsule), pyramid, blood)
        for name, value in zip(names, values, strict=True):
            d[name][near] = value

    def _collecting_system(self, q: Coordinates, pyramid: Singles) -> Singles:
        """Return the distance to pelvis, ureter, and the cups about the pyramids' tips."""
        urine = ellipsoid(q, (1, 3.5, 14), (8, 4.6, 9))
        urine = blend(urine, rod(q, (3, 5, 20), (34, 9, 33), 3.4, 2.2), 3.0)
        for u in (-13.0, 13.0):
            urine = blend(urine, rod(q, (u, 2, 7), (1, 3.5, 13), 2.4, 3.4), 3.0)
        for calyx in self.calyces:
            if calyx.cup > 0:
                ball = ellipsoid(q, calyx.tip - 0.8 * calyx.direction, (calyx.cup,) * 3)
                cup = -blend(-ball, pyramid, 2.5)
                neck = rod(q, calyx.tip - calyx.cup * calyx.direction, calyx.drain, 0.42 * calyx.cup, 1.6)
                urine = blend(urine, blend(cup, neck, 2.0), 2.0)
        return urine

    def _vessels(self, q: Coordinates) -> Singles:
        """Return the distance to vein, artery and the vessels between pyramids."""
        vein = rod(q, (-5, 9, 40), (-4, 6, 15), 4.5, 3.2)
        artery = rod(q, (-7, 0, 40), (-4, -2, 14), 2.6, 2.0)
        blood = blend(vein, artery, 0.5)
        for calyx in self.calyces:
            root, end = calyx.vessel
            side = -4.0 if calyx.tip[0] < 0 else 4.0
            branch = np.minimum(rod(q, root, end, 1.0, 0.55), rod(q, (side, 5, 13), root, 1.3, 1.0))
            np.minimum(blood, branch, out=blood)
        return blood
