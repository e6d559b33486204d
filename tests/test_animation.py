"""Animated GIF and PNG: frames and their times by the headers, against Pillow, which decodes every frame."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import GifImagePlugin, Image, ImageSequence

from echospline.io import read, read_image
from echospline.io.animation import gif_delays, png_delays

RNG = np.random.default_rng(4)


def animation(path: Path, frames: int, durations: list[int] | int, side: int = 24) -> Path:
    pictures = [
        Image.fromarray(RNG.integers(0, 255, (side, side + 7), dtype=np.uint8)) for _ in range(frames)
    ]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations)
    return path


@pytest.mark.parametrize("suffix", ["gif", "png"])
def test_the_headers_give_the_times_that_pillow_finds_by_decoding(tmp_path: Path, suffix: str) -> None:
    path = animation(tmp_path / f"a.{suffix}", 12, [10 * k for k in range(1, 13)])
    with Image.open(path) as image:
        expected = [page.info.get("duration") for page in ImageSequence.Iterator(image)]
    assert (gif_delays if suffix == "gif" else png_delays)(path) == expected
    cine = read(path, spacing=(0.1, 0.1))
    np.testing.assert_allclose(cine.times, np.concatenate([[0.0], np.cumsum(expected[:-1])]) / 1000.0)


@pytest.mark.parametrize("mode", ["L", "P", "RGB"])
def test_colour_tables_of_frames_are_passed_over(tmp_path: Path, mode: str) -> None:
    pictures = [
        Image.fromarray(RNG.integers(0, 255, (9, 11, 3), dtype=np.uint8)).convert(mode) for _ in range(6)
    ]
    path = tmp_path / "a.gif"
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=70, comment=b"x" * 700)
    assert gif_delays(path) == [70.0] * 6


def test_stray_zeros_between_blocks_are_passed_over(tmp_path: Path) -> None:
    pictures = [Image.fromarray(np.full((9, 11), 40 * k, np.uint8)) for k in range(5)]
    path = tmp_path / "a.gif"
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=70)
    block = b"\x21\xf9\x04"
    assert path.read_bytes().count(block) == 5
    path.write_bytes(path.read_bytes().replace(block, b"\0\0" + block))
    assert gif_delays(path) == [70.0] * 5
    np.testing.assert_allclose(read(path, spacing=(0.1, 0.1)).times, 0.07 * np.arange(5))


@pytest.mark.parametrize("blocks", [True, False])
def test_a_gif_without_delays_has_the_times_of_browsers(tmp_path: Path, blocks: bool) -> None:
    path = animation(tmp_path / "a.gif", 4, 0)
    if not blocks:
        path.write_bytes(
            re.sub(rb"\x21\xf9\x04.{4}\0(?=[\x2c\x21])", b"", path.read_bytes(), flags=re.DOTALL)
        )
        assert gif_delays(path) == [None] * 4
    cine = read(path, spacing=(0.1, 0.1))
    np.testing.assert_allclose(cine.times, 0.1 * np.arange(4))
    assert any("no duration" in note for note in cine.notes)


def test_a_picture_before_the_animation_is_a_frame_without_a_duration(tmp_path: Path) -> None:
    pictures = [Image.fromarray(np.full((9, 11), 40 * k, np.uint8)) for k in range(4)]
    path = tmp_path / "a.png"
    pictures[0].save(
        path, save_all=True, default_image=True, append_images=pictures[1:], duration=[30, 50, 70]
    )
    assert png_delays(path) == [30.0, 50.0, 70.0]
    cine = read(path, spacing=(0.1, 0.1))
    assert [frame[0, 0] for frame in cine.frames] == [0, 40, 80, 120]
    np.testing.assert_allclose(cine.times, [0.0, 0.1, 0.13, 0.18])
    assert any("no duration" in note for note in cine.notes)


def test_a_still_picture_has_one_frame_and_no_times(tmp_path: Path) -> None:
    Image.fromarray(RNG.integers(0, 255, (9, 11), dtype=np.uint8)).save(tmp_path / "a.gif")
    Image.fromarray(RNG.integers(0, 255, (9, 11), dtype=np.uint8)).save(tmp_path / "a.png")
    assert gif_delays(tmp_path / "a.gif") == [None]
    assert png_delays(tmp_path / "a.png") == []
    assert read_image(tmp_path / "a.gif", spacing=(1, 1)).pixels.shape == (9, 11)


def test_the_first_of_many_frames_is_decoded_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = animation(tmp_path / "a.gif", 300, 40, side=6)
    decoded = []
    load = GifImagePlugin.GifImageFile.load
    seek = GifImagePlugin.GifImageFile._seek

    def counted(self: GifImagePlugin.GifImageFile, *arguments: object) -> object:
        decoded.append("load")
        return load(self, *arguments)

    def sought(self: GifImagePlugin.GifImageFile, frame: int, *arguments: object) -> object:
        decoded.append(f"seek {frame}")
        return seek(self, frame, *arguments)

    monkeypatch.setattr(GifImagePlugin.GifImageFile, "load", counted)
    monkeypatch.setattr(GifImagePlugin.GifImageFile, "_seek", sought)
    image = read_image(path, spacing=(0.1, 0.1))
    assert image.pixels.shape == (6, 13)
    assert not [one for one in decoded if one.startswith("seek") and one != "seek 0"]
    assert 1 <= decoded.count("load") <= 3


@settings(max_examples=300)
@given(
    st.booleans(),
    st.lists(st.tuples(st.integers(0, 3000), st.integers(0, 255)), max_size=6),
    st.integers(0, 3000),
)
def test_damaged_headers_end_the_walk_and_raise_nothing(
    tmp_path_factory: pytest.TempPathFactory, gif: bool, changes: list[tuple[int, int]], cut: int
) -> None:
    data = bytearray(SEEDS[gif])
    for at, value in changes:
        data[at % len(data)] = value
    path = tmp_path_factory.getbasetemp() / "damaged"
    path.write_bytes(bytes(data[: max(1, len(data) - cut)]))
    delays = gif_delays(path) if gif else png_delays(path)
    assert len(delays) < len(data)
    assert all(d is None or d >= 0 for d in delays)


def _seed(suffix: str) -> bytes:
    import tempfile  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder:
        return animation(Path(folder) / f"a.{suffix}", 5, 50, side=10).read_bytes()


SEEDS = {True: _seed("gif"), False: _seed("png")}
