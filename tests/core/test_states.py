"""States as bytes: saved, loaded, refused; and tissues in threads."""

from __future__ import annotations

import ctypes
import math
import struct
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from echospline import _native

VERSION_AT, FINGERPRINT_AT = 8, 16  # bytes before a state's version and its scene's fingerprint
PLANE: dict[str, Any] = {"dimension": 2, "shape": (30, 24), "spacing": (1.38, 1.3)}
SPACE: dict[str, Any] = {
    "dimension": 3,
    "shape": (14, 12, 10),
    "spacing": (2.9, 2.7, 2.8),
    "contact_spacing": 2.5,
    "anchor_spacing": 5.0,
}
SCENES = {
    f"{name}, {kernel.name}, {precision.name}": {**options, "kernel": kernel, "precision": precision}
    for name, options in (("plane", PLANE), ("space", SPACE))
    for kernel in _native.Kernel
    for precision in _native.Precision
}
# mm; a loaded state has its contacts' inverse made anew, which rounds differently from
# one that grew: 4e-11 mm with the thin plate in the plane, 1e-14 mm elsewhere
WITHIN = {_native.Precision.DOUBLE: 1e-9, _native.Precision.SINGLE: 1e-5}


class Scene:
    """A scene and tissues in it."""

    def __init__(self, options: dict[str, Any]) -> None:
        self.library = _native.library()
        given = _native.SceneOptions(struct_size=ctypes.sizeof(_native.SceneOptions))
        self.library.echospline_scene_defaults(given)
        for name, value in options.items():
            if isinstance(value, tuple):
                getattr(given, name)[: len(value)] = value
            else:
                setattr(given, name, value)
        self.dimension, self.handle = given.dimension, ctypes.c_void_p()
        status = self.library.echospline_scene_create(given, self.handle)
        _native.check(status, self.library.echospline_scene_message, self.handle)
        self.nodes = self.library.echospline_scene_node_count(self.handle)
        self.tissues: list[Tissue] = []

    def tissue(self) -> Tissue:
        self.tissues.append(Tissue(self))
        return self.tissues[-1]

    def close(self) -> None:
        for tissue in self.tissues:
            self.library.echospline_tissue_destroy(tissue.handle)
        self.library.echospline_scene_destroy(self.handle)


class Tissue:
    """One session in a scene; failures raise."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.library, self.handle = scene, scene.library, ctypes.c_void_p()
        self.check(self.library.echospline_tissue_create(scene.handle, self.handle))

    def check(self, status: int) -> None:
        _native.check(status, self.library.echospline_tissue_message, self.handle)

    @property
    def message(self) -> str:
        text: bytes = self.library.echospline_tissue_message(self.handle)
        return text.decode()

    def step(self, pose: _native.Pose) -> None:
        self.check(self.library.echospline_advance(self.handle, pose))

    def field(self) -> np.ndarray:
        field = np.empty((self.scene.nodes, self.scene.dimension))
        self.check(self.library.echospline_displacement(self.handle, field.ctypes.data, field.size))
        return field

    def save(self) -> bytes:
        saved = ctypes.create_string_buffer(self.library.echospline_state_size(self.handle))
        self.check(self.library.echospline_state_save(self.handle, saved, len(saved)))
        return saved.raw

    def load(self, saved: bytes) -> int:
        status: int = self.library.echospline_state_load(self.handle, saved, len(saved))
        return status


def poses(seed: int, count: int, dimension: int) -> Iterator[_native.Pose]:
    """Pushes, pulls, stops and tilts at random."""
    rng, dt = np.random.default_rng(seed), 1 / 30
    entry, depth, speed = np.array([18.0, 0.0, 12.0]), 0.0, 12.0
    angle, turn = float(rng.uniform(1.2, 1.9)), 0.0
    for i in range(count):
        if i % 15 == 0:
            speed, turn = float(rng.choice([-8, 0, 6, 12])) if i else 12.0, float(rng.choice([-0.2, 0, 0.2]))
        depth, angle = float(np.clip(depth + speed * dt, 0, 22)), float(np.clip(angle + turn * dt, 1.0, 2.1))
        tip = entry + depth * np.array([math.cos(angle), math.sin(angle), 0.1 if dimension == 3 else 0.0])
        yield _native.Pose(tuple(entry), tuple(tip), speed, dt)


def checksum(data: bytes) -> int:
    """The sum at a state's end, to forge states that are damaged elsewhere."""
    total = 14695981039346656037
    for i in range(0, len(data), 8):
        word = int.from_bytes(data[i : i + 8], "little")
        total = ((total ^ word) * 1099511628211) & 0xFFFFFFFFFFFFFFFF
    return total ^ total >> 32


def forged(saved: bytes, at: int, value: bytes) -> bytes:
    """A state with other bytes at one place, and the sum that belongs to them."""
    body = bytearray(saved[:-8])
    body[at : at + len(value)] = value
    return bytes(body) + checksum(bytes(body)).to_bytes(8, "little")


@pytest.fixture
def scene_of() -> Iterator[Any]:
    made: list[Scene] = []

    def make(**options: Any) -> Scene:
        made.append(Scene({**PLANE, **options}))
        return made[-1]

    yield make
    for scene in made:
        scene.close()


@pytest.mark.parametrize("name", SCENES)
def test_a_loaded_state_continues_as_the_one_that_was_saved(scene_of, name):
    options = SCENES[name]
    scene = scene_of(**options)
    first, second = scene.tissue(), scene.tissue()
    path = list(poses(1, 120, scene.dimension))
    for pose in path[:70]:
        first.step(pose)
    for pose in poses(2, 25, scene.dimension):  # the other tissue has been somewhere else
        second.step(pose)
    assert second.load(first.save()) == _native.Status.OK
    largest = 0.0
    for pose in [None, *path[70:]]:
        for tissue in (first, second):
            if pose is not None:
                tissue.step(pose)
        ours, theirs = first.field(), second.field()
        assert np.abs(ours - theirs).max() < WITHIN[options["precision"]]
        largest = max(largest, float(np.abs(ours).max()))
    assert largest > 0.3
    assert first.save()[:16] == second.save()[:16]


def test_a_state_saved_twice_is_the_same_bytes_and_loading_keeps_them(scene_of):
    tissue = scene_of().tissue()
    for pose in poses(3, 60, 2):
        tissue.step(pose)
    saved = tissue.save()
    assert tissue.save() == saved
    assert tissue.load(saved) == _native.Status.OK
    assert tissue.save() == saved


def test_rest_is_a_state(scene_of):
    scene = scene_of()
    rest, moved = scene.tissue().save(), scene.tissue()
    for pose in poses(3, 60, 2):
        moved.step(pose)
    assert moved.field().any()
    assert moved.load(rest) == _native.Status.OK
    assert not moved.field().any()


def refusals(saved: bytes) -> dict[str, tuple[bytes, str]]:
    contact = len(saved) - 8 - 64  # the last contact
    nan = struct.pack("<d", math.nan)
    return {
        "empty": (b"", "too few"),
        "a piece": (saved[:100], "too few"),
        "truncated": (saved[:-64], "does not fit"),
        "longer": (saved + bytes(64), "does not fit"),
        "one bit of a contact": (
            saved[:contact] + bytes([saved[contact] ^ 1]) + saved[contact + 1 :],
            "damaged",
        ),
        "one bit of the sum": (saved[:-1] + bytes([saved[-1] ^ 128]), "damaged"),
        "foreign": (bytes(range(256)) * 8, "begin differently"),
        "zeros": (bytes(len(saved)), "begin differently"),
        "older": (forged(saved, VERSION_AT, struct.pack("<I", 0)), "another version"),
        "newer": (forged(saved, VERSION_AT, struct.pack("<I", 99)), "another version"),
        "another scene": (forged(saved, FINGERPRINT_AT, bytes(8)), "another mesh"),
        "count below zero": (forged(saved, 24, struct.pack("<q", -1)), "does not fit"),
        "count too large": (forged(saved, 24, struct.pack("<q", 1 << 60)), "does not fit"),
        "tip of no kind": (forged(saved, 44, struct.pack("<i", 7)), "out of its range"),
        "tip nowhere": (forged(saved, 48, nan), "out of its range"),
        "contact that is no source": (forged(saved, contact, struct.pack("<i", 1 << 30)), "out of its range"),
        "contacts out of order": (forged(saved, contact, struct.pack("<i", 0)), "out of its range"),
        "contact moved nowhere": (forged(saved, contact + 8, nan), "out of its range"),
    }


def test_bytes_that_are_no_state_of_the_scene_are_refused_and_change_nothing(scene_of):
    scene = scene_of(precision=_native.Precision.DOUBLE)
    tissue, twin = scene.tissue(), scene.tissue()
    path = list(poses(4, 90, 2))
    for pose in path[:60]:
        tissue.step(pose)
        twin.step(pose)
    saved, field = tissue.save(), tissue.field()
    assert forged(saved, 0, b"") == saved  # forging itself is right
    for name, (wrong, words) in refusals(saved).items():
        assert tissue.load(wrong) == _native.Status.WRONG_STATE, name
        assert words in tissue.message, name
        assert tissue.save() == saved, name
        assert np.array_equal(tissue.field(), field), name
    for pose in path[60:]:
        tissue.step(pose)
        twin.step(pose)
    assert np.array_equal(tissue.field(), twin.field())


@pytest.mark.parametrize(
    "other",
    [
        {"shape": (30, 25)},
        {"spacing": (1.38, 1.31)},
        {"origin": (0.5, 0.0)},
        {"sigma": 0.7},
        {"clamped": int(_native.Edge.BOTTOM | _native.Edge.LEFT)},
        {"kernel": _native.Kernel.ELASTIC},
        {"drag": 0.3},
        {"dimension": 3, "shape": (14, 12, 10), "spacing": (2.9, 2.7, 2.8)},
    ],
    ids=lambda options: next(iter(options)),
)
def test_states_of_another_scene_are_refused(scene_of, other):
    tissue, foreign = scene_of().tissue(), scene_of(**other).tissue()
    for pose in poses(5, 40, 2):
        tissue.step(pose)
    before = foreign.save()
    assert foreign.load(tissue.save()) == _native.Status.WRONG_STATE
    assert foreign.save() == before


def test_states_pass_between_scenes_made_alike(scene_of):
    ours, theirs = scene_of().tissue(), scene_of().tissue()
    for pose in poses(5, 40, 2):
        ours.step(pose)
    assert theirs.load(ours.save()) == _native.Status.OK
    assert np.abs(theirs.field() - ours.field()).max() < 1e-5


def test_pointers_that_are_missing_are_refused(scene_of):
    tissue = scene_of().tissue()
    library, size = tissue.library, len(tissue.save())
    assert library.echospline_state_load(tissue.handle, None, size) == _native.Status.NULL_POINTER
    assert library.echospline_state_load(None, bytes(size), size) == _native.Status.NULL_POINTER
    assert library.echospline_state_save(tissue.handle, None, size) == _native.Status.NULL_POINTER
    room = ctypes.create_string_buffer(size)
    assert library.echospline_state_save(tissue.handle, room, size - 1) == _native.Status.WRONG_SIZE


@pytest.mark.parametrize("name", SCENES)
def test_tissues_of_one_scene_in_two_threads_give_the_numbers_of_one(scene_of, name):
    scene = scene_of(**SCENES[name])
    paths = [list(poses(seed, 80, scene.dimension)) for seed in (6, 7)]

    def fields(tissue: Tissue, path: list[_native.Pose]) -> list[np.ndarray]:
        found = []
        for pose in path:
            tissue.step(pose)
            found.append(tissue.field())
        return found

    alone = [fields(scene.tissue(), path) for path in paths]
    together: list[list[np.ndarray]] = [[], []]
    tissues, begin = [scene.tissue(), scene.tissue()], threading.Barrier(2)

    def work(k: int) -> None:
        begin.wait()
        together[k] = fields(tissues[k], paths[k])

    threads = [threading.Thread(target=work, args=(k,)) for k in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for one, two in zip(alone, together, strict=True):
        assert len(two) == len(one)
        assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
