"""Videos and GIFs: frames, times and colours as other decoders say, streamed or as a whole."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import islice
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from echospline.errors import InputError
from echospline.io import open_cine, open_recording, open_writer, read
from echospline.scene import Cine, RegularGrid

GRID = RegularGrid((48, 32), (0.1, 0.1))


def moving(count: int = 9) -> np.ndarray:
    y, x = np.mgrid[:32, :48]
    return np.stack(
        [np.rint(127 + 100 * np.sin(x / 6 + y / 5 + k / 2)).astype(np.uint8) for k in range(count)]
    )


def opencv_frames(path: Path) -> Iterator[np.ndarray]:
    capture = cv2.VideoCapture(str(path))
    while True:
        found, frame = capture.read()
        if not found:
            return
        yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)


def encoded(path: Path, codec: str, pix_fmt: str, container: str, frames: np.ndarray, rate: int = 20) -> Path:
    with av.open(str(path), "w", format=container) as movie:
        stream = movie.add_stream(codec, rate=rate)
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], pix_fmt
        stream.time_base = Fraction(1, rate)
        for pixels in frames:
            movie.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="gray")))
        movie.mux(stream.encode(None))
    return path


def test_butterfly_cine_has_the_frames_times_and_greys_of_opencv(recordings: Path) -> None:
    path = recordings / "itkpocus" / "butterfly-ocular-phantom.mp4"
    recording = open_recording(path)
    capture = cv2.VideoCapture(str(path))
    assert (recording.columns, recording.rows, recording.frames) == (
        776,
        1080,
        int(capture.get(cv2.CAP_PROP_FRAME_COUNT)),
    )
    cine = open_cine(path, spacing=(0.0577, 0.0577))
    assert cine.frames == 369
    for (t, image), expected in zip(islice(cine, 8), opencv_frames(path), strict=False):
        luma = expected.astype(float) @ [0.299, 0.587, 0.114]
        error = np.abs(image.pixels - luma)
        assert error.mean() < 0.6
        assert np.quantile(error, 0.999) <= 3
        assert t == pytest.approx(recording.times[cine_index(recording.times, t)])
    capture = cv2.VideoCapture(str(path))
    starts = []
    while len(starts) < 8 and capture.grab():
        starts.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
    np.testing.assert_allclose(recording.times[:8], np.array(starts) - starts[0], atol=2e-3)


def cine_index(times: np.ndarray, t: float) -> int:
    return int(np.argmin(np.abs(times - t)))


@pytest.mark.parametrize(
    ("codec", "pix_fmt", "container", "suffix"),
    [
        ("ffv1", "gray", "avi", "avi"),
        ("rawvideo", "gray", "avi", "avi"),
        ("ffv1", "gray", "matroska", "mkv"),
        ("mjpeg", "yuvj420p", "avi", "avi"),
        ("mpeg4", "yuv420p", "avi", "avi"),
        ("libx264", "yuv420p", "mp4", "mp4"),
        ("libx264", "yuv420p", "mov", "mov"),
        ("libvpx-vp9", "yuv420p", "webm", "webm"),
    ],
)
def test_every_container_is_told_by_content(
    tmp_path: Path, codec: str, pix_fmt: str, container: str, suffix: str
) -> None:
    frames = moving()
    path = encoded(
        tmp_path / f"named.{'avi' if suffix == 'mp4' else 'mp4'}", codec, pix_fmt, container, frames
    )
    cine = read(path, spacing=(0.1, 0.2))
    assert isinstance(cine, Cine)
    assert cine.frames.shape == frames.shape
    np.testing.assert_allclose(cine.times, np.arange(9) / 20, atol=2e-3)
    error = np.abs(cine.frames.astype(int) - frames)
    assert error.max() == 0 if pix_fmt == "gray" else error.mean() < 6
    np.testing.assert_array_equal(read(path, spacing=(0.1, 0.2), frame=-2).pixels, cine.frames[7])


def test_video_needs_spacing(tmp_path: Path) -> None:
    path = encoded(tmp_path / "a.avi", "ffv1", "gray", "avi", moving())
    with pytest.raises(InputError, match="--spacing LAT,DEPTH"):
        read(path)


def test_own_mp4_and_gif_come_back_with_their_times(tmp_path: Path) -> None:
    frames, times = moving(6), np.array([0.0, 0.05, 0.1, 0.2, 0.25, 0.4])
    for name in ("a.mp4", "a.gif"):
        with open_writer(tmp_path / name, GRID, 20) as writer:
            for pixels, t in zip(frames, times, strict=True):
                writer.add(pixels, t)
        cine = read(tmp_path / name, spacing=(0.1, 0.1))
        np.testing.assert_allclose(cine.times, times, atol=1e-4)
        assert np.abs(cine.frames.astype(int) - frames).mean() < (2.5 if name == "a.mp4" else 1e-9)


def test_given_rate_is_preferred_to_the_files(tmp_path: Path) -> None:
    path = encoded(tmp_path / "a.avi", "ffv1", "gray", "avi", moving())
    np.testing.assert_allclose(read(path, spacing=(0.1, 0.1), fps=100).times, np.arange(9) / 100)
    assert [t for t, _ in open_cine(path, spacing=(0.1, 0.1), fps=100)] == pytest.approx(np.arange(9) / 100)
    with pytest.raises(InputError, match="fps must be"):
        read(path, spacing=(0.1, 0.1), fps=0)


def test_gif_without_delays_is_shown_as_browsers_do(tmp_path: Path) -> None:
    pages = [Image.fromarray(p) for p in moving(3)]
    pages[0].save(tmp_path / "a.gif", save_all=True, append_images=pages[1:])
    cine = read(tmp_path / "a.gif", spacing=(0.1, 0.1))
    np.testing.assert_allclose(cine.times, [0, 0.1, 0.2])
    assert "no duration" in cine.source
    np.testing.assert_array_equal(cine.frames, moving(3))


def test_colour_video_keeps_its_channels(tmp_path: Path) -> None:
    frames = np.zeros((3, 32, 48, 3), np.uint8)
    frames[:] = (190, 60, 30)
    with open_writer(tmp_path / "a.mp4", GRID, 20) as writer:
        for k, pixels in enumerate(frames):
            writer.add(pixels, k / 20)
    kept = read(tmp_path / "a.mp4", spacing=(0.1, 0.1), colour=True).frames
    np.testing.assert_allclose(kept, frames, atol=6)


def test_a_long_video_is_streamed_under_a_limit_that_it_exceeds_as_a_whole(tmp_path: Path) -> None:
    path = encoded(tmp_path / "a.avi", "ffv1", "gray", "avi", moving(60))
    size = 32 * 48 / 2**20
    with pytest.raises(InputError, match="limit"):
        read(path, spacing=(0.1, 0.1), limit=50 * size)
    shown = [image.pixels for _, image in open_cine(path, spacing=(0.1, 0.1), limit=2 * size)]
    np.testing.assert_array_equal(shown, moving(60))


@pytest.mark.parametrize("share", [0.2, 0.6, 0.95])
@pytest.mark.parametrize(
    ("codec", "pix_fmt", "container"), [("ffv1", "gray", "avi"), ("libx264", "yuv420p", "mp4")]
)
def test_a_video_cut_short_is_refused(
    tmp_path: Path, codec: str, pix_fmt: str, container: str, share: float
) -> None:
    data = encoded(tmp_path / "a", codec, pix_fmt, container, moving(30)).read_bytes()
    (tmp_path / "b").write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=r"cut short|damaged"):
        read(tmp_path / "b", spacing=(0.1, 0.1))


def test_sound_alone_is_no_cine(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mp4"), "w") as movie:
        stream = movie.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        movie.mux(stream.encode(frame))
        movie.mux(stream.encode(None))
    with pytest.raises(InputError, match="without a video stream"):
        read(tmp_path / "a.mp4", spacing=(0.1, 0.1))


@pytest.mark.parametrize(
    ("codec", "pix_fmt"),
    [("ffv1", "gray"), ("mjpeg", "yuvj420p"), ("libx264", "yuv420p"), ("mpeg4", "yuv420p")],
)
def test_a_video_with_a_hole_in_its_middle_is_refused(tmp_path: Path, codec: str, pix_fmt: str) -> None:
    data = bytearray(encoded(tmp_path / "a", codec, pix_fmt, "avi", moving(30)).read_bytes())
    packets = data.find(b"movi") + 4, data.rfind(b"idx1")
    middle, length = sum(packets) // 2, (packets[1] - packets[0]) // 8
    data[middle : middle + length] = bytes(length)
    (tmp_path / "b").write_bytes(data)
    with pytest.raises(InputError, match=r"cut short|damaged"):
        read(tmp_path / "b", spacing=(0.1, 0.1))


def test_a_comment_in_another_encoding_does_not_stop_the_reader(tmp_path: Path) -> None:
    with open_writer(tmp_path / "a.mp4", GRID, 20) as writer:
        writer.add(moving(1)[0], 0.0)
    data = (tmp_path / "a.mp4").read_bytes()
    assert data.count(b"echospline") == 1
    (tmp_path / "b.mp4").write_bytes(data.replace(b"echospline", b"\xe9\xe8hospline"))
    assert read(tmp_path / "b.mp4", spacing=(0.1, 0.1)).frames.shape == (1, 32, 48)
