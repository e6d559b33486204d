"""Arrays of packs that are written shorter: read again bit for bit, by Python as by the page, and refused when they lie."""

from __future__ import annotations

import subprocess
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import page_scene
from echospline.errors import InputError
from echospline.page import Pack, packed_space
from echospline.page.codings import (
    LARGEST_WEIGHT,
    NEIGHBOURS,
    from_kept,
    from_residuals,
    kept,
    residuals,
    weights_of,
)
from echospline.page.pack import MirroredPart, MirrorPart, NeighboursPart, deflated, table
from echospline.page.packing_space import _mirrors
from echospline.scenario import spatial_scene
from node_here import NODE, STEADY
from test_page_pack import changed, put
from test_page_pack_space import opened

RNG = np.random.default_rng(5)
SHAPES = [(3, 4, 5), (1, 1, 1), (1, 1, 9), (1, 9, 1), (9, 1, 1), (2, 17, 3), (17, 2, 2), (2, 3, 40)]
WILD = [LARGEST_WEIGHT, -LARGEST_WEIGHT, LARGEST_WEIGHT, -LARGEST_WEIGHT, LARGEST_WEIGHT, 1, -1]
PLAIN = [200, 98, -50, 194, -146, -62, 23]


@pytest.fixture(scope="module")
def scene():
    return opened()


@pytest.fixture(scope="module")
def pack(scene):
    return packed_space(scene)


@pytest.fixture(scope="module")
def data(pack):
    return pack.to_bytes()


def one_by_one(left, weights):
    """The voxels of residuals as the page's description of the coding says, one after the other in Python's own numbers."""
    voxels = np.zeros(left.shape, int)
    for z, y, x in np.ndindex(left.shape):
        total = 128
        for (a, b, c), weight in zip(NEIGHBOURS, weights, strict=True):
            if z >= a and y >= b and x >= c:
                total += weight * int(voxels[z - a, y - b, x - c])
        voxels[z, y, x] = (int(left[z, y, x]) + min(max(total >> 8, 0), 255)) % 256
    return voxels.astype(np.uint8)


def volumes(shape):
    z, y, x = np.indices(shape)
    yield RNG.integers(0, 256, shape, dtype=np.uint8)
    yield np.zeros(shape, np.uint8)
    yield np.full(shape, 255, np.uint8)
    yield np.where((x + y + z) % 2, 255, 0).astype(np.uint8)
    yield ((3 * x + 5 * y + 7 * z) % 256).astype(np.uint8)


# --- neighbours


@pytest.mark.parametrize("shape", SHAPES)
def test_a_volume_is_read_as_it_was_written_whatever_the_weights(shape):
    for voxels in volumes(shape):
        for weights in (PLAIN, WILD, [-w for w in WILD], [0] * 7, weights_of(voxels)):
            left = residuals(voxels, weights)
            np.testing.assert_array_equal(from_residuals(left, weights), voxels)
            np.testing.assert_array_equal(one_by_one(left, weights), voxels)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.integers(1, 8)] * 3),
    st.lists(st.integers(-LARGEST_WEIGHT, LARGEST_WEIGHT), min_size=7, max_size=7),
    st.randoms(use_true_random=False),
)
def test_any_bytes_are_the_residuals_of_one_volume(shape, weights, random):
    left = np.frombuffer(random.randbytes(int(np.prod(shape))), np.uint8).reshape(shape)
    voxels = from_residuals(left, weights)
    np.testing.assert_array_equal(voxels, one_by_one(left, weights))
    np.testing.assert_array_equal(residuals(voxels, weights), left)


def test_a_volume_that_its_neighbours_tell_leaves_next_to_nothing():
    """A ramp along every axis is told by its neighbours; weights are rounded to 256ths, so that a grey level or two remain."""
    z, y, x = np.indices((24, 30, 36))
    voxels = (20 + 2 * x + y + 3 * z).astype(np.uint8)
    inside = residuals(voxels, weights_of(voxels))[1:, 1:, 1:].astype(np.int8)
    assert np.abs(inside.astype(int)).max() <= 2


def test_smooth_speckle_takes_much_less():
    waves = RNG.normal(size=(34, 40, 50))
    for axis in range(3):
        waves = sum(np.roll(waves, k, axis) for k in range(4)) / 2
    voxels = np.clip(120 + 40 * waves, 0, 255).astype(np.uint8)
    left = residuals(voxels, weights_of(voxels))
    assert len(deflated(left.tobytes())) < 0.8 * len(deflated(voxels.tobytes()))


# --- mirrors


def following(values, mirrors):
    """The table of written values, entry after entry."""
    columns = len(mirrors[0][1])
    rest, out = iter(values.tolist()), []
    for at in range(len(mirrors[0][0]) * columns):
        r, c = divmod(at, columns)
        for rows, places in mirrors:
            image = (abs(rows[r]) - 1) * columns + abs(places[c]) - 1
            if image < at:
                out.append(out[image] * np.sign(rows[r]) * np.sign(places[c]))
                break
        else:
            out.append(next(rest))
    assert next(rest, None) is None
    return np.array(out, values.dtype)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 7), st.integers(1, 7), st.integers(1, 3), st.data())
def test_any_mirrors_give_the_table_of_one_entry_after_the_other(height, width, count, draw):
    def side(n):
        return draw.draw(
            st.lists(st.sampled_from([k for k in range(-n, n + 1) if k]), min_size=n, max_size=n)
        )

    mirrors = [(side(height), side(width)) for _ in range(count)]
    values = np.arange(1, kept(mirrors).sum() + 1).astype(np.float32)
    found = from_kept(values, mirrors)
    np.testing.assert_array_equal(found, following(values, mirrors))
    np.testing.assert_array_equal(found[kept(mirrors)], values)


def test_answers_of_a_block_are_written_by_quarters_and_stay_what_they_were(scene, pack):
    """The middle of the block mirrors its sources across the plane and along it; the surface does not."""
    part = pack.manifest.arrays["green.answers"]
    assert len(part.coding.mirrors) == 2
    total = np.prod(part.shape)
    assert 0.25 * total <= part.count < 0.27 * total
    core = spatial_scene(scene.scenario, scene.scenario.space.grid(scene.volume), scene.tissue, "green")
    exact = core.arrays["answers"].ravel()
    rounding = 2.0**-24 * np.abs(exact)
    apart = np.abs(pack.arrays["green.answers"].ravel() - exact)
    assert (apart <= rounding + 1e-11 * np.abs(exact).max()).all()


def test_a_table_that_is_not_its_image_has_no_mirrors(scene):
    core = spatial_scene(scene.scenario, scene.scenario.space.grid(scene.volume), scene.tissue, "green")
    assert len(_mirrors(core)) == 2
    answers = np.array(core.arrays["answers"])
    answers.flat[1234] += 1e-6 * np.abs(answers).max()
    assert _mirrors(replace(core, arrays={**core.arrays, "answers": answers})) == []
    sources = np.array(core.arrays["sources"])
    sources.flat[0] += 1e-3
    assert _mirrors(replace(core, arrays={**core.arrays, "sources": sources})) == []


def test_a_table_that_is_not_its_image_is_not_written(pack):
    arrays = dict(pack.arrays)
    arrays["green.answers"] = np.array(arrays["green.answers"])
    arrays["green.answers"].flat[-1] += 1
    with pytest.raises(InputError, match="images differ"):
        Pack(pack.manifest, arrays)


# --- packs


def test_a_pack_without_codings_is_the_same_scene(pack, data):
    plain = page_scene.uncoded(pack)
    assert b"coding" not in plain.to_bytes()
    read = Pack.from_bytes(plain.to_bytes())
    assert read.digest != pack.digest
    assert len(data) < 0.6 * len(plain.to_bytes())
    coded = Pack.from_bytes(data)
    for name, array in pack.arrays.items():
        assert read.arrays[name].tobytes() == coded.arrays[name].tobytes() == array.tobytes()


VOXELS, ANSWERS = ("arrays", "voxels", "coding"), ("arrays", "green.answers", "coding")
MIRROR = (*ANSWERS, "mirrors", 0)
HOSTILE = {
    "a coding of no kind": (put(*VOXELS, "kind", "huffman"), "neighbours"),
    "six weights": (put(*VOXELS, "weights", [1] * 6), "weights"),
    "a weight beyond 32 bits": (put(*VOXELS, "weights", [2**31] * 7), "weights"),
    "a weight that is no whole number": (put(*VOXELS, "weights", [0.5] * 7), "weights"),
    "neighbours of floats": (put(*ANSWERS, {"kind": "neighbours", "weights": [0] * 7}), "uint8 of three axes"),
    "neighbours of an empty volume": (put("arrays", "voxels", "shape", [0, 2**28, 2**28]), "up to 4096"),
    "mirrors of bytes": (put(*VOXELS, {"kind": "mirrored", "mirrors": [{"rows": [1], "columns": [1]}]}), "floats"),
    "no mirrors": (put(*ANSWERS, "mirrors", []), "mirrors"),
    "a mirror of another table": (put(*MIRROR, "rows", [1]), "rows and columns"),
    "a row that is none": (lambda tree: tree["arrays"]["green.answers"]["coding"]["mirrors"][0]["rows"].__setitem__(0, 0), "rows and columns"),
    "a row beyond the table": (lambda tree: tree["arrays"]["green.answers"]["coding"]["mirrors"][0]["rows"].__setitem__(0, 9999), "rows and columns"),
    "rows that are text": (put(*ANSWERS, "mirrors", 0, "rows", "rows"), "rows"),
    "mirrors that leave less": (lambda tree: tree["arrays"]["green.answers"]["coding"]["mirrors"].pop() and tree, "overlaps|ends beyond|arrays end"),
    "an endless table": (put("arrays", "green.answers", "shape", [2**27]), "mirrors code up to"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_coding_is_refused_in_one_sentence_by_both_readers(data, name, tmp_path):
    change, said = HOSTILE[name]
    bad = changed(data, change)
    with pytest.raises(InputError, match=said) as refused:
        Pack.from_bytes(bad)
    assert len(str(refused.value).splitlines()) == 1
    assert len(str(refused.value)) < 500
    if NODE is not None:
        done = in_the_page(bad, tmp_path, "voxels")
        assert done.returncode == 1
        assert "PackError" in done.stderr


def in_the_page(data, folder, *names):
    (folder / "scene.pack").write_bytes(data)
    return subprocess.run(
        [NODE, STEADY, "tests/node/read_pack.mjs", str(folder / "scene.pack"), str(folder / "out"), *names],
        cwd=page_scene.ROOT, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


@pytest.mark.skipif(NODE is None, reason="Node is not installed: the page's reader is not checked")
@pytest.mark.parametrize(
    "weights", [None, PLAIN, WILD, [-w for w in WILD]], ids=["own", "plain", "wild", "turned"]
)
def test_the_page_reads_the_very_bytes(pack, weights, tmp_path):
    """The scene's own volume, and extreme ones under extreme weights; the table of answers beside it, by two mirrors or by maps that are none."""
    shape = pack.arrays["voxels"].shape
    for k, voxels in enumerate([pack.arrays["voxels"], *volumes(shape)]):
        arrays = {**pack.arrays, "voxels": voxels}
        codings = {
            "voxels": NeighboursPart(weights=weights or weights_of(voxels)),
            "green.answers": pack.manifest.arrays["green.answers"].coding,
        }
        if k == 1:
            rows, columns = codings["green.answers"].pairs[0]
            maps = [MirrorPart(rows=signed(len(rows)), columns=signed(len(columns))) for _ in range(3)]
            codings["green.answers"] = MirroredPart(mirrors=maps)
            left = kept(codings["green.answers"].pairs)
            values = RNG.normal(size=left.sum()).astype(np.float32)
            arrays["green.answers"] = from_kept(values, codings["green.answers"].pairs)
        coded = Pack(pack.manifest.model_copy(update={"arrays": table(arrays, codings)}), arrays)
        done = in_the_page(coded.to_bytes(), tmp_path, "voxels", "green.answers")
        assert done.returncode == 0, done.stderr
        read = (tmp_path / "out").read_bytes()
        assert read == arrays["voxels"].tobytes() + arrays["green.answers"].tobytes()


def signed(count):
    return (RNG.integers(1, count + 1, count) * RNG.choice([-1, 1], count)).tolist()
