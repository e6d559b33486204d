"""A block of scatterers in space and the B-mode picture of any plane through it.

Every plane gathers the scatterers of its slab, weighted by the beam across the slice, on a lattice in complex baseband.
Attenuation is summed along the beams, so that shadow and enhancement follow by themselves; Fourier transforms apply
pulse and beam. Looks of a steered beam are bands of lateral frequency of the same lattice: a beam turned by theta holds
lateral frequencies around K sin(theta), with K = 2 f0 / c cycles per mm, so that three looks cost little more than one.

Reflecting faces keep their normals when tissue moves, and refraction and multiple scattering are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, log, pi, sqrt

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from echospline.errors import InputError
from echospline.laboratory.beam_lattice import LINE, SAMPLE, BeamLattice, Reals
from echospline.laboratory.scattering import Complexes, Faces, Scattering, Singles
from echospline.scene import (
    Display,
    Floats,
    ImagingPlane,
    Probe,
    RegularGrid,
    Transducer,
    UltrasoundImage,
    Volume,
)

SpatialDisplacement = Callable[[Floats], Floats]
"""Displacement (n, 3) in mm at points (n, 3) in mm of undeformed tissue."""

ABDOMINAL = Transducer(frequency=3.5, bandwidth=0.6, f_number=2.6)
"""3.5 MHz abdominal array."""
LOOKS = (-8.0, 0.0, 8.0)
"""Degrees of the beams whose envelopes are averaged. Steered more, shadows of ribs and stones end early; less, looks resemble each other."""
COLUMN = 0.4
"""mm; columns of a face further apart along the picture would be seen singly by the beam."""
COARSE = (0.75, 0.5)
"""mm (lateral, depth); lattice on which attenuation is summed: shadows have no finer detail."""
CUT = 2.5
"""Sigmas of the slice beyond which scatterers are left out; fewer make neighbouring planes less alike than their beams are."""
PIECE = 2**15
"""Scatterers that are worked on together."""
LAG = 7
"""Samples between the reverberation of one look and of the next."""
FLOOR = -58.0
"""dB; electronic noise against speckle of 0 dB at the surface, before the gain over depth."""
DISPLAY = Display(dynamic_range=60.0, top=38.0)
"""Cortex of the kidney at a dark grey, bone and stone white."""


@dataclass(frozen=True, eq=False)
class SpatialPhantom:
    """Tissue in space that any probe can image.

    Parameters
    ----------
    scattering : Scattering
    faces : Faces
    attenuation : Volume
        One way, dB/(cm MHz).
    gain : ndarray, shape (n,)
        Time gain compensation, dB, at depths 0, 1, 2 ... times ``gain_step``.
    gain_step : float
        mm.
    transducer : Transducer
        Frequency, bandwidth and f-number.
    """

    scattering: Scattering
    faces: Faces
    attenuation: Volume
    gain: Floats
    gain_step: float
    transducer: Transducer = ABDOMINAL

    def image_plane(
        self,
        plane: ImagingPlane,
        probe: Probe,
        displacement: SpatialDisplacement | None = None,
        *,
        looks: Sequence[float] = LOOKS,
        display: Display | None = None,
        noise_seed: int = 0,
    ) -> UltrasoundImage:
        """Image a plane anew from its scatterers.

        Parameters
        ----------
        plane : ImagingPlane
            Where the probe is, in the frame of the tissue.
        probe : Probe
            Shape of the picture and thickness of its slice, which must be above 0.
        displacement : callable, optional
            (n, 3) -> (n, 3), mm: where the tissue has moved.
        looks : sequence of float
            Degrees of the beams whose envelopes are averaged; one leaves the full contrast of speckle.
        display : Display, optional
            Log compression; `DISPLAY` when not given.
        noise_seed : int
            Of the electronic noise: the frame's number.

        Returns
        -------
        UltrasoundImage
            8-bit, on the probe's grid; 0 where its beams do not reach.

        Raises
        ------
        InputError
            If the slice has no thickness, or a look is steered by more than the lattice can hold.
        """
        envelope, beams = self.envelope(plane, probe, displacement, looks=looks, noise_seed=noise_seed)
        with np.errstate(divide="ignore"):
            level = np.maximum(20.0 * np.log10(envelope), np.float32(-200.0))
        q, d = _beam_coordinates(probe, probe.grid.nodes)
        column = ((q - beams.origin[0]) / beams.spacing[0]).reshape(probe.grid.shape[::-1])
        row = (d / beams.spacing[1]).reshape(column.shape)
        shown = cv2.remap(
            level, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )  # fmt: skip
        grey = (display or DISPLAY).grey(10.0 ** (shown / 20.0))
        grey[~probe.mask] = 0
        return UltrasoundImage(grey, probe.grid)

    def envelope(
        self,
        plane: ImagingPlane,
        probe: Probe,
        displacement: SpatialDisplacement | None = None,
        *,
        looks: Sequence[float] = LOOKS,
        noise_seed: int = 0,
        floor: float = FLOOR,
    ) -> tuple[Singles, RegularGrid]:
        """Compute the envelope of a plane, averaged over looks; the rms of 0 dB speckle is 1.

        Parameters
        ----------
        plane, probe, displacement, looks, noise_seed
            As `image_plane` takes them.
        floor : float
            Electronic noise, dB against 0 dB speckle; minus infinity for none.

        Returns
        -------
        envelope : ndarray, shape (samples, lines), float32
        beams : RegularGrid
            Lines and samples in mm: along the probe's face (an arc's length for a curved array) and from it.
        """
        lattice = BeamLattice.of(probe, self.transducer, looks)
        scattered = lattice.with_pulse(self._scattered(lattice, plane, displacement))
        reflected = lattice.with_pulse(self._reflected(lattice, plane, displacement))
        straight = self._transmission(lattice, plane, 0.0, displacement)
        trail = lattice.with_trail(reflected * straight)
        noise = None
        if floor > -np.inf:
            rng = np.random.default_rng((noise_seed, 2))
            noise = rng.standard_normal((*lattice.shape, 2), np.float32).view(np.complex64)[..., 0]
            noise *= np.float32(10.0 ** (floor / 20.0) / sqrt(2.0))
        total = np.zeros(lattice.shape, dtype=np.float32)
        for number, look in enumerate(lattice.looks):
            share = straight if look == 0.0 else self._transmission(lattice, plane, look, displacement)
            # Each look has its own reverberation and noise; shifting them is as good as drawing them anew.
            through = reflected * share
            through[LAG * number :] += trail[: len(trail) - LAG * number]
            through *= lattice.steering(look)
            through += scattered * share
            if noise is not None:
                through += np.roll(noise, 37 * number, axis=0)
            total += np.abs(lattice.with_beam(through, look))
        depths = np.arange(len(self.gain)) * self.gain_step
        gain = 10.0 ** (np.interp(lattice.depths, depths, self.gain) / 20.0) / len(lattice.looks)
        inner, rows = lattice.inner
        envelope = (total * gain[:, None].astype(np.float32))[:rows, inner]
        grid = RegularGrid(
            (envelope.shape[1], envelope.shape[0]), (LINE, SAMPLE), (float(lattice.lines[inner][0]), 0.0)
        )
        return np.ascontiguousarray(envelope), grid

    def _scattered(
        self, lattice: BeamLattice, plane: ImagingPlane, displacement: SpatialDisplacement | None
    ) -> Complexes:
        """Put the scatterers of the slab on the lattice."""
        scattering = self.scattering
        chosen = self._bricks_of(lattice, plane, displacement)
        points: Reals = scattering.points[:, chosen].reshape(3, -1)
        amplitudes = scattering.amplitudes[chosen].reshape(-1)
        if displacement is not None and points.size:
            points = points + _displaced(displacement, points)
        # Pieces that stay in the processor's cache take a third less time than all at once.
        pieces = [
            _slab_echoes(lattice, plane, points[:, k : k + PIECE], amplitudes[k : k + PIECE])
            for k in range(0, max(1, len(amplitudes)), PIECE)
        ]
        q, d, real, imag = (np.concatenate(part) for part in zip(*pieces, strict=True))
        return lattice.deposited(q, d, real, imag)

    def _bricks_of(
        self, lattice: BeamLattice, plane: ImagingPlane, displacement: SpatialDisplacement | None
    ) -> NDArray[np.intp]:
        """Return the bricks that the slab may reach.

        Where tissue moves, a brick may lie anywhere between the displacements of its corners and its centre, and half of their
        difference further: displacement that varies within half a brick (1 to 1.6 mm) may leave scatterers out.
        """
        s = self.scattering
        half = np.array(s.size) / 2.0
        centres = _mesh(
            [low + (np.arange(n) + 0.5) * h for n, h, low in zip(s.bricks, s.size, s.low, strict=True)]
        )
        place = np.stack(_in_plane(centres.reshape(3, -1), plane))
        reach = (np.abs(plane.matrix[:3, :3]).T @ half)[:, None]
        low, high = place - reach, place + reach
        if displacement is not None:
            corners = _mesh(
                [low + np.arange(n + 1) * h for n, h, low in zip(s.bricks, s.size, s.low, strict=True)]
            )
            turn = plane.matrix[:3, :3].T
            inside = (turn @ _displaced(displacement, centres.reshape(3, -1))).reshape(centres.shape)
            at = (turn @ _displaced(displacement, corners.reshape(3, -1))).reshape(corners.shape)
            least, most = inside, inside
            for k, j, i in np.ndindex(2, 2, 2):
                nz, ny, nx = centres.shape[1:]
                corner = at[:, k : k + nz, j : j + ny, i : i + nx]
                least, most = np.minimum(least, corner), np.maximum(most, corner)
            spare = (most - least) / 2.0
            low = low + (least - spare).reshape(3, -1)
            high = high + (most + spare).reshape(3, -1)
        # Range is depth for a linear array; beside the middle of a curved one it is more, by at most the lateral distance.
        beside = np.maximum(np.abs(low[0]), np.abs(high[0])) if lattice.probe.shape == "curved" else 0.0
        sigma = np.sqrt(np.maximum(lattice.slice_variance(low[1]), lattice.slice_variance(high[1] + beside)))
        within = (low[2] < CUT * sigma) & (high[2] > -CUT * sigma)
        deepest, outermost = lattice.depths[-1], lattice.lines[-1]
        u, v = lattice.place(np.array((outermost, outermost)), np.array((0.0, deepest)))
        within &= (low[0] < u.max()) & (high[0] > -u.max())
        within &= (high[1] > min(0.0, float(v[0]))) & (low[1] < deepest)
        return np.flatnonzero(within)

    def _reflected(
        self, lattice: BeamLattice, plane: ImagingPlane, displacement: SpatialDisplacement | None
    ) -> Complexes:
        """Put the reflecting points of the slab on the lattice: in phase along a face, the weaker the more it slants."""
        faces = self.faces
        points: Reals = faces.points.T
        u, v, e = _in_plane(points, plane)
        if displacement is not None and points.size:
            points = points + _displaced(displacement, points)
            u, v, e = _in_plane(points, plane)
        _, d, _ = lattice.beam(u, v)
        near = np.flatnonzero(np.abs(e) < CUT * np.sqrt(lattice.slice_variance(d)) + max(faces.cell))
        points, normals, powers = points[:, near], faces.normals[near].T, faces.powers[near]
        # The beam must not see single columns: split those that lie wide apart along the picture.
        lateral = np.abs(plane.matrix[:3, 0])
        parts = [max(1, ceil(h * lateral[i] / COLUMN)) for h, i in zip(faces.cell, (0, 2), strict=True)]
        steep = np.where(np.abs(normals[1]) < 0.3, np.float32(np.inf), normals[1])
        area = faces.cell[0] * faces.cell[1] / (parts[0] * parts[1])
        n = plane.matrix[:3, :3].T.astype(np.float32) @ normals
        found = []
        for i, k in np.ndindex(*parts):
            dx = np.float32(((i + 0.5) / parts[0] - 0.5) * faces.cell[0])
            dz = np.float32(((k + 0.5) / parts[1] - 0.5) * faces.cell[1])
            dy = -(normals[0] * dx + normals[2] * dz) / steep
            u, v, e = _in_plane(points + np.stack((np.full_like(dy, dx), dy, np.full_like(dy, dz))), plane)
            q, d, angle = lattice.beam(u, v)
            variance = lattice.slice_variance(d)
            scale = np.exp(np.float32(-0.5) * e * e / variance) / np.sqrt(np.float32(2 * pi) * variance)
            scale *= np.float32(area / LINE) / lattice.spread(d)
            along = sum(
                np.abs(n[0] * np.sin(angle + np.float32(look)) + n[1] * np.cos(angle + np.float32(look)))
                ** powers
                for look in lattice.looks
            )
            found.append((q, d, faces.amplitudes[near] * (scale * along / np.float32(len(lattice.looks)))))
        q, d, strength = (np.concatenate(part) for part in zip(*found, strict=True))
        return lattice.deposited(q, d, strength.real, strength.imag)

    def _transmission(
        self,
        lattice: BeamLattice,
        plane: ImagingPlane,
        look: float,
        displacement: SpatialDisplacement | None,
    ) -> Singles:
        """Return the share of amplitude that comes back from every place of the lattice along a steered beam."""
        dq, dd = COARSE
        d = np.arange(0.0, lattice.depths[-1] + dd, dd)[:, None]
        lean = lattice.lean(d, look)
        widest = float(np.abs(lean).max())
        start = np.arange(lattice.lines[0] - widest, lattice.lines[-1] + widest + dq, dq)
        u, v = lattice.place(start + lean, d)
        points = plane.lift(np.stack((u.ravel(), v.ravel()), axis=1))
        above = points[:, 1] < 0.0
        if displacement is not None:
            points = _origins(displacement, points)
        a = self.attenuation
        index = (points - a.origin) / np.array(a.spacing)
        found = ndimage.map_coordinates(a.voxels, index.T[::-1], np.float32, order=1, mode="nearest")
        found[above] = 0.0
        # Both ways, dB. A step's loss is complete at its end: half a step below its sample.
        loss = np.cumsum(found.reshape(u.shape), axis=0) * np.float32(
            2.0 * self.transducer.frequency * dd / 10.0
        )
        column = ((lattice.lines - lattice.lean(lattice.depths[:, None], look)) - start[0]) / dq
        row = np.broadcast_to(lattice.depths[:, None] / dd - 0.5, column.shape)
        fine = cv2.remap(
            loss, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )  # fmt: skip
        share: Singles = np.exp(fine * np.float32(-log(10.0) / 20.0))
        return share


def _slab_echoes(
    lattice: BeamLattice, plane: ImagingPlane, points: Reals, amplitudes: Singles
) -> tuple[Reals, Reals, Singles, Singles]:
    """Return line, range, and real and imaginary part of the echo of the scatterers (3, n) that the slice holds."""
    u, v, e = _in_plane(points, plane)
    q, d, _ = lattice.beam(u, v)
    variance = lattice.slice_variance(d)
    near = np.flatnonzero(e * e < np.float32(CUT**2) * variance)
    q, d, e, variance = q[near], d[near], e[near], variance[near]
    row = np.clip((d * np.float32(1.0 / SAMPLE)).astype(np.int32), 0, lattice.shape[0] - 1)
    strength = amplitudes[near] * lattice.weight[row]
    strength *= np.exp(np.float32(-0.5) * e * e / variance) / np.sqrt(np.float32(2 * pi) * variance)
    turn = d * np.float32(lattice.carrier)
    turn -= np.floor(turn)
    turn *= np.float32(-2.0 * pi)
    return q, d, strength * np.cos(turn), strength * np.sin(turn)


def _mesh(axes: Sequence[Reals]) -> Floats:
    """Return coordinates (3, nz, ny, nx) of the lattice with these x, y and z."""
    Z, Y, X = np.meshgrid(*axes[::-1], indexing="ij")
    return np.stack((X, Y, Z))


def _in_plane(points: Reals, plane: ImagingPlane) -> tuple[Reals, Reals, Reals]:
    """Return lateral position, depth and distance (mm) of points (3, n) from the plane, in their own type."""
    m = plane.matrix.astype(points.dtype)
    origin, turn = m[:3, 3], np.ascontiguousarray(m[:3, :3].T)
    u, v, e = turn @ points - (turn @ origin)[:, None]
    return u, v, e


def _beam_coordinates(probe: Probe, points: Floats) -> tuple[Floats, Floats]:
    """Return line and range, mm, of points (n, 2) of the picture."""
    x, y = points.T
    if probe.shape == "linear":
        return x, y
    return probe.radius * np.arctan2(x, y + probe.radius), np.hypot(x, y + probe.radius) - probe.radius


def _displaced(displacement: SpatialDisplacement, points: Reals) -> Reals:
    """Return the displacement of points (3, n), in their shape and type."""
    u = np.asarray(displacement(np.ascontiguousarray(points.T, dtype=np.float64)))
    if u.shape != (points.shape[1], 3) or not np.isfinite(u).all():
        raise InputError(
            f"a displacement gives three finite numbers in mm per point, shape {(points.shape[1], 3)}; got shape {u.shape}"
        )
    moved: Reals = u.T.astype(points.dtype)
    return moved


def _origins(displacement: SpatialDisplacement, points: Floats) -> Floats:
    """Return where tissue at points (n, 3) lay before it moved, to 0.05 mm where it strains by less than a half."""
    found = points
    for _ in range(6):
        before, found = found, points - _displaced(displacement, found.T).T
        if np.abs(found - before).max() < 0.05:
            break
    return found
