"""Time of a step and of a frame on this machine, against the limit of each, the display's 60 Hz and the haptic 1 kHz."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from time import perf_counter
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.mechanics import Elastic, Kernel, ThinPlate, TPSModel, TPSParameters
from echospline.mechanics.native import NativeStep
from echospline.mechanics.tps import State
from echospline.picture import Deformation, Drawing, InverseMap, NeedleEcho
from echospline.scene import Floats, NeedlePose, RegularGrid, UltrasoundImage

MESHES = {1200: (40, 30), 4524: (78, 58)}
"""Nodes of the meshes measured, on 40 x 30 mm."""

PERIODS = {"1 kHz": 1e-3, "60 Hz": 1 / 60}
"""s; haptic devices and displays."""
PERIOD, SPEED = PERIODS["1 kHz"], 10.0
"""s and mm/s: a haptic rate, a brisk push."""
PIXELS = 512
"""Columns and rows of the frames."""


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
        Median of the limit: for a step the bare float32 product of landmarks and mesh, two components, in its best layout; for a frame
        `cv2.remap` of the same picture.
    ratio_to_limit : float
        median_ms / limit_ms.
    level : str
        Processor level that the core uses.
    """

    name: str
    nodes: int
    landmarks: int
    median_ms: float
    p99_ms: float
    limit_ms: float
    ratio_to_limit: float
    level: str

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


def native(model: TPSModel) -> NativeStep:
    """Return the core's step of a model; one that refits has none."""
    if model.native is None:
        raise InputError('only the solver "response" is measured here')
    return model.native


def time_steps(model: TPSModel, poses: list[NeedlePose], period: float = PERIOD) -> tuple[Floats, int]:
    """Time every step of a push as a program in Python makes it, from pose to mesh displacement.

    Returns
    -------
    seconds : ndarray, shape (k,)
    landmarks : int
        Moving landmarks after the last step.
    """
    state, seconds = model.rest(), np.empty(len(poses))
    for i, pose in enumerate(poses):
        begin = perf_counter()
        state = model.advance(state, pose, period)
        model.displacement(state)
        seconds[i] = perf_counter() - begin
    return seconds, moving(model, state)


def moving(model: TPSModel, state: State) -> int:
    """Return the number of landmarks that move: contacts and tip."""
    found = model.landmarks(state)
    return len(found.contacts) + (found.tip is not None)


def bare_product(nodes: int, landmarks: int, components: int = 1, repeats: int = 400) -> float:
    """Return the median seconds of the float32 product of weights and rows: one read of the response, the lower limit of a step.

    Parameters
    ----------
    nodes, landmarks : int
        Of the mesh; that move.
    components : {1, 2}
        Displacement components that one weight moves: 1 for a thin plate, whose rows serve both, 2 for an elastic kernel.
    repeats : int
        Number of products timed.
    """
    rows = np.random.default_rng(0).random((landmarks * components, nodes * components), dtype=np.float32)
    weights = np.ones((2 // components, len(rows)), dtype=np.float32)
    out = np.empty((len(weights), rows.shape[1]), dtype=np.float32)
    return median_time(lambda: np.dot(weights, rows, out=out), repeats)


def median_time(call: Callable[[], object], repeats: int) -> float:
    """Return the median time of a call, s."""
    seconds = np.empty(repeats)
    for i in range(repeats):
        begin = perf_counter()
        call()
        seconds[i] = perf_counter() - begin
    return float(np.median(seconds))


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
    for shape in MESHES.values():
        report(f"frames of {PIXELS} x {PIXELS} pixels, {shape[0]} x {shape[1]} nodes")
        rows += _frames(shape)
    return rows


def _steps(name: str, shape: tuple[int, int], kernel: Kernel) -> list[Row]:
    model = scene(shape, kernel)
    step, poses = native(model), {rate: list(path(period)) for rate, period in PERIODS.items()}
    in_python, landmarks = time_steps(model, poses["1 kHz"])
    limit = bare_product(shape[0] * shape[1], landmarks, 2 if isinstance(kernel, Elastic) else 1)
    parts = {}
    for rate, period in PERIODS.items():
        seconds, changed = step.time_steps(poses[rate], period)
        parts[f"{name}step at {rate}"] = _late(seconds)
        if rate == "1 kHz":
            parts[f"{name}contact change"] = _late(seconds)[_late(changed)]
    parts[f"{name}step from Python"] = _late(in_python)
    return [_row(label, shape, landmarks, times, limit, step.level) for label, times in parts.items()]


def _frames(shape: tuple[int, int]) -> list[Row]:
    """Time whole frames at 60 Hz, from pose to picture, and cv2.remap after them."""
    model, period = scene(shape), PERIODS["60 Hz"]
    grid = RegularGrid((PIXELS, PIXELS), (40.0 / (PIXELS - 1), 30.0 / (PIXELS - 1)))
    noise = np.random.default_rng(0).integers(0, 255, (PIXELS, PIXELS), dtype=np.uint8)
    image = UltrasoundImage(noise, grid)
    rows = []
    for name, draw in drawings(model, image).items():
        state, frames = model.rest(), []
        for pose in path(period):
            begin = perf_counter()
            state = model.advance(state, pose, period)
            draw(model.displacement(state), pose)
            frames.append(perf_counter() - begin)
        remaps = _remaps(noise, Deformation(model.grid, model.displacement(state)).inverse(grid))
        limit = float(np.median(remaps))
        rows.append(
            _row(name, shape, moving(model, state), _late(np.array(frames)), limit, native(model).level)
        )
    return rows


def _remaps(pixels: NDArray[Any], found: InverseMap, repeats: int = 100) -> list[float]:
    """Time cv2.remap of a deformed picture, in one thread."""
    threads, times = cv2.getNumThreads(), []
    cv2.setNumThreads(1)
    for _ in range(repeats):
        begin = perf_counter()
        cv2.remap(pixels, found.x, found.y, cv2.INTER_LINEAR)
        times.append(perf_counter() - begin)
    cv2.setNumThreads(threads)
    return times


Draw = Callable[[Floats, NeedlePose], object]
"""Displacement of the mesh nodes and the needle's pose -> the picture."""


def drawings(model: TPSModel, image: UltrasoundImage) -> dict[str, Draw]:
    """Return the ways to draw a frame, by the names of their rows."""
    echo = NeedleEcho()
    pull = Drawing(image, model.grid, inverse="auto")
    exact = Drawing(image, model.grid, inverse="exact")
    return {
        "frame, pull": lambda displacement, pose: pull.draw(displacement, pose, echo).image,
        "frame, exact": lambda displacement, pose: exact.draw(displacement, pose, echo).image,
    }


def _late(values: NDArray[Any]) -> NDArray[Any]:
    """Return the last quarter, where nearly all contacts are there."""
    return values[len(values) * 3 // 4 :]


def _row(name: str, shape: tuple[int, int], landmarks: int, seconds: Floats, limit: float, level: str) -> Row:
    median, p99 = (1000.0 * float(q) for q in np.quantile(seconds, [0.5, 0.99]))
    return Row(
        name, shape[0] * shape[1], landmarks, median, p99, 1000.0 * limit, median / (1000.0 * limit), level
    )
