"""The recipe of ``sample:kidney``: percutaneous nephrolithotomy on a patient that echospline makes itself.

Skin, fat, muscle, ribs, and a kidney with calyces, vessels and a stone, as scatterers, reflecting faces, attenuation
and stiffness. Numbers about tissue carry their source in `TISSUES`; brightness is set by eye. No sonographer has
judged it. `docs/kidney.md` shows the pictures and says what is missing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from echospline.errors import InputError
from echospline.laboratory.anatomy import Coordinates, KidneyAnatomy, Singles, SmoothNoise, lattice
from echospline.laboratory.beam_lattice import LINE, SAMPLE
from echospline.laboratory.scattering import CELL, Faces, Scattering
from echospline.laboratory.sonogram import ABDOMINAL, DISPLAY, SpatialPhantom
from echospline.scene import Floats, Probe, Volume, probe_plane


@dataclass(frozen=True)
class TissueKind:
    """One kind of tissue.

    Parameters
    ----------
    name : str
    level : float
        Of its diffuse echo, dB against renal cortex.
    attenuation : float
        One way, dB/(cm MHz).
    young : float
        Young's modulus, kPa.
    """

    name: str
    level: float
    attenuation: float
    young: float


# Attenuation: PMC10001275, table 4 (muscle and kidney set lower, skin higher).
# Young's modulus: kidney by elastography, BMC Nephrology 2017;18:265; the others are of the order that
# elastography finds; bone and stone are rigid beside tissue. Levels: by eye against clinical pictures.
TISSUES = (
    TissueKind("skin", 8.0, 0.60, 60.0),
    TissueKind("fat", -3.0, 0.55, 4.0),
    TissueKind("muscle", -1.0, 0.90, 20.0),
    TissueKind("perirenal fat", 7.0, 0.55, 3.0),
    TissueKind("cortex", 0.0, 0.75, 14.0),
    TissueKind("pyramid", -8.5, 0.75, 11.0),
    TissueKind("sinus", 12.0, 0.80, 8.0),
    TissueKind("urine", -60.0, 0.01, 0.5),
    TissueKind("blood", -24.0, 0.15, 2.0),
    TissueKind("liver", 2.0, 0.50, 6.0),
    TissueKind("bone", 6.0, 15.0, 1e6),
    TissueKind("stone", 14.0, 20.0, 1e6),
)
"""The value of a label is its index here."""

FACES = {
    "skin": (24.0, 8.0),
    "fascia1": (17.0, 12.0),
    "fascia2": (14.0, 12.0),
    "fascia3": (19.0, 12.0),
    "gerota": (12.0, 10.0),
    "capsule": (22.0, 5.0),
    "urine": (15.0, 4.0),
    "liver": (17.0, 8.0),
    "psoas": (17.0, 8.0),
    "bone": (42.0, 2.0),
    "stone": (42.0, 1.2),
}
"""Level of a face square to the beam, dB against cortex, and the exponent of its cosine; by eye."""
SHEETS = 4
"""Layers of a fascia, 0.4 mm apart, each fainter."""
LOW, CELLS = (-59.4, 0.0, -32.0), (216, 464, 64)
"""Lowest corner (mm) of the block of scatterers, and cells along x, y and z: 119 x 93 x 64 mm."""
SHADOW_BLUR = 2.0
"""mm; sigma across the beam of the attenuation: an aperture, not a pencil, throws the shadow."""
EDGE_LOSS = 1.5
"""dB/(cm MHz); added where the capsule grazes the beam, in place of the refraction that darkens its edge."""
VOXEL = (0.35, 2 * SAMPLE, 0.75)
"""mm, of the volume along x, y and z: finer than speckle along each."""
WIDTH, DEPTH, THICKNESS = 112.0, 90.0, 60.0
"""Extent of the volume, mm."""
PROBE = Probe(width=90.0, depth=90.0, pixel=0.2, elevation=0.95, elevation_depth=62.0, element_height=4.0)
"""A linear view of the whole kidney; the slice is focused at the stone."""
CURVED = Probe(
    "curved", radius=60.0, opening=50.0, depth=88.0, pixel=0.25, elevation=0.95, elevation_depth=62.0,
    element_height=4.0,
)  # fmt: skip
"""An abdominal curved array."""


@dataclass(frozen=True, eq=False)
class LabelledTissue:
    """Which tissue lies where, and how stiff it is.

    Parameters
    ----------
    labels : Volume
        Index into ``kinds`` for each voxel.
    kinds : tuple of TissueKind
    """

    labels: Volume
    kinds: tuple[TissueKind, ...]

    @property
    def young(self) -> Singles:
        """Young's modulus for each voxel, kPa, shape (nz, ny, nx)."""
        moduli = np.array([k.young for k in self.kinds], dtype=np.float32)
        young: Singles = moduli[self.labels.voxels.astype(np.intp)]
        return young

    def mask(self, name: str) -> NDArray[np.bool_]:
        """Return the voxels of one tissue, shape (nz, ny, nx).

        Raises
        ------
        InputError
            If there is no such tissue.
        """
        names = [k.name for k in self.kinds]
        if name not in names:
            raise InputError(f"there is no tissue {name!r}; expected one of: {', '.join(names)}")
        mask: NDArray[np.bool_] = self.labels.voxels == names.index(name)
        return mask

    def label_at(self, points: ArrayLike) -> NDArray[np.intp]:
        """Return the label of the nearest voxel at points (n, 3) in mm, shape (n,); outside, that of the nearest face."""
        p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        index = np.rint((p - self.labels.origin) / np.array(self.labels.spacing)).astype(np.intp)
        x, y, z = np.clip(index, 0, np.subtract(self.labels.shape, 1)).T
        label: NDArray[np.intp] = self.labels.voxels[z, y, x].astype(np.intp)
        return label

    def young_at(self, points: ArrayLike) -> Floats:
        """Return Young's modulus at points (n, 3) in mm, kPa, shape (n,)."""
        return np.array([k.young for k in self.kinds])[self.label_at(points)]


@dataclass(frozen=True, eq=False)
class BuiltTissue:
    """Everything that the recipe works out on the cells of the block.

    Parameters
    ----------
    labels : ndarray, shape (nz, ny, nx), uint8
    levels : ndarray, shape (nz, ny, nx), float16
        dB.
    attenuation : ndarray, shape (nz, ny / 2, nx), float16
        One way, dB/(cm MHz), blurred across the beam.
    gain : ndarray, shape (ny / 2,)
        Median two-way loss down to each depth, dB.
    faces : Faces
    """

    labels: NDArray[np.uint8]
    levels: NDArray[np.float16]
    attenuation: NDArray[np.float16]
    gain: Floats
    faces: Faces

    def phantom(self, seed: int) -> SpatialPhantom:
        """Draw the scatterers."""
        dx, dy, dz = CELL
        origin = (LOW[0] + dx / 2, LOW[1] + dy, LOW[2] + dz / 2)
        attenuation = Volume(self.attenuation.astype(np.float32), (dx, 2 * dy, dz), origin)
        scattering = Scattering.of_levels(self.levels, LOW, seed)
        return SpatialPhantom(scattering, self.faces, attenuation, self.gain, 2 * dy, ABDOMINAL)

    def tissue(self, like: Volume) -> LabelledTissue:
        """Return the labels on the voxels of a volume: each has that of the cell it lies in."""
        index = [
            np.clip(np.floor((o + h * np.arange(n) - low) / cell + 1e-6).astype(int), 0, cells - 1)
            for o, h, n, low, cell, cells in zip(
                like.origin, like.spacing, like.shape, LOW, CELL, CELLS, strict=True
            )
        ]
        voxels = np.ascontiguousarray(self.labels[np.ix_(*index[::-1])])
        return LabelledTissue(Volume(voxels, like.spacing, like.origin), TISSUES)


def build_tissue(seed: int) -> BuiltTissue:
    """Work out labels, levels, attenuation and faces of one patient, a few slices at a time."""
    anatomy = KidneyAnatomy(seed)
    x, y, z = (
        (low + (np.arange(n) + 0.5) * h).astype(np.float32)
        for low, n, h in zip(LOW, CELLS, CELL, strict=True)
    )
    nx, ny, nz = CELLS
    labels = np.empty((nz, ny, nx), dtype=np.uint8)
    levels = np.empty((nz, ny, nx), dtype=np.float16)
    attenuation = np.empty((nz, ny // 2, nx), dtype=np.float32)
    alpha = np.array([k.attenuation for k in TISSUES], dtype=np.float32)
    faces: list[Faces] = []
    chunk = 8
    for k in range(0, nz, chunk):
        # One more slice on either side, for the normals.
        p = lattice(x, y, z[0] + np.arange(k - 1, k + chunk + 1, dtype=np.float32) * np.float32(CELL[2]))
        d = anatomy.distances(p)
        inner = (p[0], p[1], p[2][1:-1])
        faces.extend(_faces_of(anatomy.noise, p, d))
        d = {name: value[1:-1] for name, value in d.items()}
        part = slice(k, k + chunk)
        labels[part] = _labels_of(d)
        levels[part] = _levels_of(anatomy, inner, d, labels[part])
        steep = np.gradient(d["capsule"], CELL[1], axis=1)
        grazing = np.exp(-((steep / np.float32(0.2)) ** 2)) * (np.abs(d["capsule"]) < 1.0)
        loss = alpha[labels[part]] + np.float32(EDGE_LOSS) * grazing
        attenuation[part] = loss.reshape(len(loss), ny // 2, 2, nx).mean(axis=2)
    step = 2 * CELL[1]
    gain = np.median(np.cumsum(attenuation, axis=1), axis=(0, 2)) * (2 * ABDOMINAL.frequency * step / 10.0)
    across = (SHADOW_BLUR / 2 / CELL[2], 0.0, SHADOW_BLUR / 2 / CELL[0])
    blurred = ndimage.gaussian_filter(attenuation, across).astype(np.float16)
    whole = Faces(
        np.concatenate([f.points for f in faces]),
        np.concatenate([f.amplitudes for f in faces]),
        np.concatenate([f.normals for f in faces]),
        np.concatenate([f.powers for f in faces]),
    )
    return BuiltTissue(labels, levels, blurred, gain.astype(np.float64), whole)


def _index(name: str) -> int:
    return [k.name for k in TISSUES].index(name)


def _labels_of(d: dict[str, Singles]) -> NDArray[np.uint8]:
    """Name the tissue of every cell; what comes later lies inside what comes before."""
    label = np.full(d["skin"].shape, _index("perirenal fat"), dtype=np.uint8)
    for distance, name in (
        ("liver", "liver"), ("psoas", "muscle"), ("fascia3", "muscle"), ("fascia1", "fat"), ("skin", "skin"),
        ("capsule", "cortex"), ("sinus", "sinus"), ("pyramid", "pyramid"), ("blood", "blood"), ("urine", "urine"),
        ("bone", "bone"), ("stone", "stone"),
    ):  # fmt: skip
        label[d[distance] < 0] = _index(name)
    return label


def _levels_of(
    anatomy: KidneyAnatomy, p: Coordinates, d: dict[str, Singles], label: NDArray[np.uint8]
) -> Singles:
    """Return the level of the diffuse echo, dB: the tissue's own, and its texture."""
    n = anatomy.noise.on
    level = np.array([k.level for k in TISSUES], dtype=np.float32)[label] + 0.8 * n(p, 4.0, 2)

    def ridge(scale: tuple[float, float, float], channel: int, width: float) -> Singles:
        """1 on thin curved sheets where the noise is near 0."""
        r: Singles = np.exp(-((n(p, scale, channel) / np.float32(width)) ** 2))
        return r

    textures = {
        "fat": 14 * ridge((6, 1.6, 6), 1, 0.16) - 2.0 + 2.0 * n(p, (4, 1.5, 4), 3),
        "perirenal fat": 3.5 * n(p, (5, 2, 5), 0) + 8 * ridge((6, 2.2, 6), 2, 0.14) - 2.0 + 2.0 * n(p, (12, 8, 12), 1),
        "sinus": 4.0 * n(p, (2.4, 1.3, 2.4), 3),
        "cortex": 0.9 * n(p, (2.2, 1.4, 2.2), 1),
        "liver": 1.0 * n(p, (3, 2, 3), 0),
        "muscle": _fibres(anatomy.noise, p, d["fascia2"] < 0),
    }  # fmt: skip
    for name, texture in textures.items():
        inside = label == _index(name)
        level[inside] += texture[inside]
    # Tubules run to the capsule: cortex is weakest end-on (Insana 1991).
    u, v, w = ((a / np.float32(r * r)) ** 2 for a, r in zip(anatomy.local(p), anatomy.RADII, strict=True))
    cortex = label == _index("cortex")
    scale = np.float32(anatomy.RADII[1] ** 2)
    share = scale * v / (scale * (u + v + w) + np.float32(1e-9))
    level[cortex] += (1.2 - 2.5 * share)[cortex]
    wall = (d["blood"] > 0) & (d["blood"] < 0.45)
    wall &= np.isin(label, [_index(t) for t in ("cortex", "pyramid", "liver")])
    level[wall] += 9.0
    return level


def _fibres(noise: SmoothNoise, p: Coordinates, upper: NDArray[np.bool_]) -> Singles:
    """Return the texture of muscle, dB: bright septa along slanting fibres, otherwise darker."""
    x, y, z = p
    step = float(y[0, 1, 0] - y[0, 0, 0])
    extra = int(np.ceil(0.16 * float(np.abs(x).max()) / step)) + 1
    longer = (np.arange(-extra, y.shape[1] + extra, dtype=np.float32) * np.float32(step))[None, :, None]
    longer = longer + y[0, 0, 0]
    septa = 14 * np.exp(-((noise.on((x, longer, z), (11, 0.7, 4), 2) / np.float32(0.28)) ** 2))
    texture = septa - 5.0 + 3.0 * noise.on((x, longer, z), (6, 1.2, 4), 0)
    row = np.arange(y.shape[1])[None, :, None] + extra
    down = np.take_along_axis(texture, row + np.rint(0.05 * x / step).astype(int), axis=1)
    up = np.take_along_axis(texture, row + np.rint(-0.16 * x / step).astype(int), axis=1)
    return np.where(upper, down, up)


def _faces_of(noise: SmoothNoise, p: Coordinates, d: dict[str, Singles]) -> Iterator[Faces]:
    """Find where distances change sign along depth, in all slices but the outermost."""
    (dx, dy, dz), (x, y, z) = CELL, (a.ravel() for a in p)
    for name, (level, power) in FACES.items():
        f = d[name]
        k, j, i = np.nonzero((f[1:-1, :-1] < 0) != (f[1:-1, 1:] < 0))
        k += 1
        here, below = f[k, j, i], f[k, j + 1, i]
        points = np.stack((x[i], y[j] + np.float32(dy) * here / (here - below), z[k]), axis=1)
        left, right = np.maximum(i - 1, 0), np.minimum(i + 1, f.shape[2] - 1)
        slope = np.stack(
            (
                (f[k, j, right] - f[k, j, left]) / ((right - left) * np.float32(dx)),
                (below - here) / np.float32(dy),
                (f[k + 1, j, i] - f[k - 1, j, i]) / np.float32(2 * dz),
            ),
            axis=1,
        )
        normals = (slope / (np.linalg.norm(slope, axis=1, keepdims=True) + 1e-6)).astype(np.float32)
        solid, fascia = name in ("bone", "stone"), name.startswith("fascia")
        rough = 1.0 if solid else 1.5 if fascia else 1.2
        decibels = level + rough * (4.0 * noise.at(points, 6.0, 1) + 3.5 * noise.at(points, 1.3, 2))
        size = 10.0 ** (decibels / 20.0) * np.exp(1.2j * noise.at(points, 3.0, 2))
        if fascia:  # a fascia is interrupted
            size *= 1.0 / (1.0 + np.exp(-4.0 * (noise.at(points, 5.0, 3) + 0.7)))
        if solid:  # bone and stone shine on the near side only
            size[normals[:, 1] > 0] = 0.0
        if name == "gerota":  # its deep sheet lies against the peritoneum and is not seen apart
            size[points[:, 1] >= 56.0] = 0.0
        kept = np.abs(size) > 0
        points, normals, size = points[kept], normals[kept], size[kept]
        for sheet in range(SHEETS if fascia else 1):
            shifted = points.copy()
            shifted[:, 1] += sheet * (0.38 + 0.12 * noise.at(points, 4.0, sheet))
            fade = 10.0 ** (-(5.0 * sheet + 5.0 * (sheet > 0) * noise.at(points, 3.0, sheet)) / 20.0)
            yield Faces(
                shifted.astype(np.float32),
                (size * fade).astype(np.complex64),
                normals,
                np.full(len(points), power, dtype=np.float32),
            )


def build_volume(phantom: SpatialPhantom) -> Volume:
    """Image parallel planes, three looks each, into an 8-bit volume whose surface is y = 0."""
    dx, dy, dz = VOXEL
    depth, width = np.arange(0.0, DEPTH + dy / 2, dy), np.arange(-WIDTH / 2, WIDTH / 2 + 1e-6, dx)
    elevation = np.arange(-THICKNESS / 2, THICKNESS / 2 + 1e-6, dz)
    probe = Probe(
        width=WIDTH, depth=DEPTH, pixel=0.2, elevation=PROBE.elevation, elevation_depth=PROBE.elevation_depth,
        element_height=PROBE.element_height,
    )  # fmt: skip
    voxels = np.empty((len(elevation), len(depth), len(width)), dtype=np.uint8)
    for k, z in enumerate(elevation):
        envelope, beams = phantom.envelope(probe_plane((0.0, 0.0, float(z))), probe, noise_seed=k)
        rows = (envelope[: 2 * len(depth) : 2] + envelope[1 : 2 * len(depth) : 2])[: len(depth)] / 2
        index = (width - beams.origin[0]) / LINE
        low = np.minimum(np.floor(index).astype(int), envelope.shape[1] - 2)
        share = (index - low).astype(np.float32)
        voxels[k] = DISPLAY.grey(rows[:, low] * (1 - share) + rows[:, low + 1] * share)
    return Volume(voxels, VOXEL, (-WIDTH / 2, 0.0, -THICKNESS / 2), source="sample:kidney")
