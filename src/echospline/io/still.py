"""PNG, JPEG, TIFF, BMP and GIF, through Pillow."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

from echospline.errors import InputError
from echospline.io.animation import gif_delays, png_delays
from echospline.io.recording import Recording, check_size, decoding, quietly
from echospline.io.tag import tagged_spacing
from echospline.scene import Pixels

_DEEP = {"I;16": np.uint16, "I;16L": np.uint16, "I;16B": np.uint16, "I": np.int32, "F": np.float32}
"""Grey of more than 8 bits keeps its values."""
_GREY = {"1", "L", "LA", "La"}
_COLOUR = {"RGB", "RGBA", "RGBa", "RGBX", "P", "PA", "CMYK", "YCbCr"}
_STILL_DELAY = 100
"""ms; the time for which browsers show a GIF frame that declares no duration."""


def open_picture(path: Path, format: str, limit: float) -> Recording:
    """Open a still image or a stack of pages.

    Parameters
    ----------
    path : Path
        PNG, JPEG, TIFF, BMP or GIF.
    format : str
        Pillow's name of the format; no other decoder is tried.
    limit : float
        MiB of decoded pixels.

    Raises
    ------
    InputError
        If the file is damaged, too large or of an unsupported pixel type.
    """
    with decoding(path, format), _quiet(), _opened(path, format) as image:
        mode = image.mode
        if mode not in _DEEP and mode not in _GREY and mode not in _COLOUR:
            raise InputError(
                f"{path} has pixels of Pillow's mode {mode!r}; expected grey or RGB: convert it to RGB"
            )
        delays = _delays(path, format)
        # Pillow counts the frames of a GIF by reading through all of them.
        frames = max(1, len(delays)) if format == "GIF" else int(getattr(image, "n_frames", 1))
        grey = mode in _GREY or (mode == "P" and frames == 1 and _grey_palette(image))
        channels = 1 if grey or mode in _DEEP else 3
        dtype = np.dtype(_DEEP.get(mode, np.uint8))
        check_size(path, image.height, image.width, frames, channels * dtype.itemsize, limit)
        rows, columns = image.height, image.width
        spacing = tagged_spacing(image.info.get("Comment")) if format == "PNG" else None

    def decode(frame: int | None, colour: bool) -> Iterator[Pixels]:
        def pages() -> Iterator[Pixels]:
            with _opened(path, format) as image:
                for i in range(frames) if frame is None else (frame,):
                    image.seek(i)
                    yield _pixels(image, path, (rows, columns), channels, dtype)

        with decoding(path, format):
            yield from quietly(pages(), _quiet)

    notes = []
    times = None
    if frames > 1 and len(delays) == frames and any(d is not None for d in delays):
        times = np.concatenate([[0.0], np.cumsum([(d or _STILL_DELAY) for d in delays[:-1]])]) / 1000.0
        if not all(delays):
            notes.append(f"some frames declare no duration: {_STILL_DELAY} ms taken, as browsers do")
    if mode in ("RGBA", "LA", "PA", "RGBa", "La"):
        notes.append("transparency is left out")
    return Recording(
        path, format, rows, columns, frames, channels, dtype, decode,
        spacing=spacing, times=times, single=frames == 1, notes=tuple(notes),
    )  # fmt: skip


@contextmanager
def _opened(path: Path, format: str) -> Iterator[Image.Image]:
    """Open with one decoder alone; Pillow's own guard against decompression bombs becomes our sentence."""
    try:
        with Image.open(path, formats=(format,)) as image:
            yield image
    except Image.DecompressionBombError as error:
        raise InputError(f"{path} declares more pixels than a picture can have: {error}") from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Pillow's warnings of large pictures (our limit decides) and of odd tags (which are not used)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _pixels(
    image: Image.Image, path: Path, shape: tuple[int, int], channels: int, dtype: np.dtype[np.generic]
) -> Pixels:
    if (image.height, image.width) != shape:
        raise InputError(
            f"{path} has pages of several sizes ({shape[1]} x {shape[0]}, then {image.width} x {image.height}): "
            "take one page with a frame number"
        )
    if image.mode not in _DEEP:
        image = image.convert("RGB" if channels == 3 else "L")
    pixels = np.asarray(image)
    if pixels.dtype != dtype or pixels.ndim != (3 if channels == 3 else 2):
        pixels = pixels.astype(dtype)
    return np.ascontiguousarray(pixels)


def _delays(path: Path, format: str) -> list[float | None]:
    """Return the times for which frames are shown, ms, from the headers: no frame is decoded for them."""
    if format == "GIF":
        return gif_delays(path)
    return png_delays(path) if format == "PNG" else []


def _grey_palette(image: Image.Image) -> bool:
    palette = np.array(image.getpalette("RGB") or [], dtype=np.uint8).reshape(-1, 3)
    return bool(len(palette)) and bool((palette == palette[:, :1]).all())
