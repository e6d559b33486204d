"""Time of a step on this machine, against the bare product that is its limit, the display's 60 Hz and the haptic 1 kHz."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from time import perf_counter

import numpy as np

from echospline.errors import InputError
from echospline.mechanics import Elastic, Kernel, ThinPlate, TPSModel, TPSParameters
from echospline.mechanics.fused import FusedStep
from echospline.mechanics.response import Statistics
from echospline.picture import Deformation, warp
from echospline.scene import Floats, NeedlePose, RegularGrid, UltrasoundImage

MESHES = {1200: (40, 30), 4524: (78, 58)}
"""Nodes of the meshes measured, on 40 x 30 mm."""

PERIOD, SPEED = 1e-3, 10.0
"""s and mm/s: a haptic rate, a brisk push."""


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Parameters
    ----------
    name : str
        Name of the timing.
    nodes, landmarks : int
        Of the mesh; moving landmarks (contacts and tip), at the end.
    median_ms, p99_ms : float
        Of one step or frame.
    limit_ms : float
        Median of the bare float32 product of landmarks and mesh, two components, in its best layout.
    ratio_to_limit : float
        median_ms / limit_ms.
    """

    name: str
    nodes: int
    landmarks: int
    median_ms: float
    p99_ms: float
    limit_ms: float
    ratio_to_limit: float

    def as_json(self) -> dict[str, str | int | float]:
        """Return the row as values for JSON."""
        return asdict(self)


def scene(shape: tuple[int, int], kernel: Kernel | None = None) -> TPSModel:
    """Build the tissue for the measurement: 40 x 30 mm, three clamped edges, a contact about every millimetre."""
    grid = RegularGrid(shape, (40.0 / (shape[0] - 1), 30.0 / (shape[1] - 1)))
    return TPSModel(grid, parameters=TPSParameters(delta=1.1, contact_spacing=1.0), kernel=kernel)


def path(period: float = PERIOD, depth: float = 26.0) -> Iterator[NeedlePose]:
    """Return the poses of an oblique push from the surface down to ``depth`` mm, one each ``period`` s."""
    axis = np.array([0.4, np.sqrt(1 - 0.16)])
    for i in range(1, int(depth / SPEED / period) + 1):
        tip = np.array([12.3, 0.0]) + axis * (i * period * SPEED)
        yield NeedlePose((12.3, 0.0), (float(tip[0]), float(tip[1])), SPEED)


def time_steps(
    model: TPSModel, poses: list[NeedlePose], period: float = PERIOD
) -> tuple[Floats, list[str], int]:
    """Time every step of a push, from pose to mesh displacement.

    Returns
    -------
    milliseconds : ndarray, shape (k,)
    kinds : list of str, length k
        "contacts change"; "patch": none changes, but the tip's next patch is begun or a row of it built, or the tip's
        row evaluated; or "plain".
    landmarks : int
        Moving landmarks after the last step.
    """
    if model.fast is None:
        raise InputError('only the solver "response" is measured here')
    statistics = model.fast.response.statistics
    state, times, kinds = model.rest(), [], []
    for pose in poses:
        changes, before = statistics.joined + statistics.left, _work(statistics)
        begin = perf_counter()
        state = model.advance(state, pose, period)
        model.displacement(state)
        times.append(perf_counter() - begin)
        if statistics.joined + statistics.left > changes:
            kinds.append("contacts change")
        else:
            kinds.append("patch" if _work(statistics) > before else "plain")
    return 1000.0 * np.array(times), kinds, model.fast.response.count + 1


def _work(statistics: Statistics) -> int:
    """Count the work done for the tip's column so far."""
    return statistics.patches + statistics.built + statistics.direct


def bare_product(step: FusedStep, repeats: int = 400) -> float:
    """Return the median time in ms of the float32 product of the contacts' displacements and their rows: the lower limit of a step."""
    r, c = step.response, step.response.scene.components
    rows = r.single[r.head : r.head + r.count * c]
    weights = np.ones((2 // c, len(rows)), dtype=np.float32)
    out = np.empty((len(weights), rows.shape[1]), dtype=np.float32)
    times = np.empty(repeats)
    for i in range(repeats):
        begin = perf_counter()
        np.dot(weights, rows, out=out)
        times[i] = perf_counter() - begin
    return 1000.0 * float(np.median(times))


def benchmark(report: Callable[[str], None] = lambda _: None) -> list[Row]:
    """Measure everything; under a minute.

    Parameters
    ----------
    report : callable
        Called with a short text before each part.
    """
    rows: list[Row] = []
    kernels: dict[str, Kernel] = {"": ThinPlate(), "elastic ": Elastic()}
    for name, kernel in kernels.items():
        for shape in MESHES.values():
            report(f"{name}steps, {shape[0]} x {shape[1]} nodes")
            rows += _steps(name, shape, kernel)
    report("frames of 512 x 512 pixels")
    rows.append(_frames(MESHES[4524]))
    return rows


def _steps(name: str, shape: tuple[int, int], kernel: Kernel) -> list[Row]:
    model = scene(shape, kernel)
    times, kinds, landmarks = time_steps(model, list(path()))
    limit = bare_product(_fast(model))
    late = np.arange(len(times)) > len(times) * 3 // 4  # nearly all contacts are there
    kind = np.array(kinds)
    parts = {
        f"{name}step": late & (kind != "contacts change"),
        f"{name}contact change": late & (kind == "contacts change"),
        f"{name}all steps": late,
    }
    return [_row(label, shape, landmarks, times[mask], limit) for label, mask in parts.items()]


def _frames(shape: tuple[int, int]) -> Row:
    model, size, fps = scene(shape), 512, 60.0
    grid = RegularGrid((size, size), (40.0 / (size - 1), 30.0 / (size - 1)))
    pixels = np.random.default_rng(0).integers(0, 255, (size, size), dtype=np.uint8)
    image, state, times = UltrasoundImage(pixels, grid), model.rest(), []
    for pose in path(1 / fps):
        begin = perf_counter()
        state = model.advance(state, pose, 1 / fps)
        warp(image, Deformation(model.grid, model.displacement(state)).inverse(grid))
        times.append(perf_counter() - begin)
    late = 1000.0 * np.array(times[len(times) // 4 :])
    return _row("frame", shape, _fast(model).response.count + 1, late, bare_product(_fast(model)))


def _row(name: str, shape: tuple[int, int], landmarks: int, times: Floats, limit: float) -> Row:
    median, p99 = np.quantile(times, [0.5, 0.99])
    return Row(name, shape[0] * shape[1], landmarks, float(median), float(p99), limit, float(median) / limit)


def _fast(model: TPSModel) -> FusedStep:
    if model.fast is None:
        raise InputError('only the solver "response" is measured here')
    return model.fast
