"""PNG, JPEG, TIFF, BMP and GIF, through Pillow."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from echospline.errors import InputError
from echospline.io.animation import gif_delays, png_delays
from echospline.io.declared import Clock, Declared, Lengths, Turn, followed
from echospline.io.recording import Recording, check_size, decoding, quietly
from echospline.io.tag import tagged_spacing
from echospline.io.tiff_orientation import tiff_orientation, without_orientation
from echospline.scene import Pixels

_DEEP = {"I;16": np.uint16, "I;16L": np.uint16, "I;16B": np.uint16, "I": np.int32, "F": np.float32}
"""Grey of more than 8 bits keeps its values."""
_GREY = {"1", "L", "LA", "La"}
_COLOUR = {"RGB", "RGBA", "RGBa", "RGBX", "P", "PA", "CMYK", "YCbCr"}
_DESCRIPTION, _BITS, _RESOLUTION = 270, 258, (282, 283)
"""TIFF tags: text, bits per sample, pixels per unit across and down."""
_TO_MM = {"mm": 1.0, "millimeter": 1.0, "cm": 10.0, "um": 1e-3, "µm": 1e-3, "micron": 1e-3, "m": 1000.0}
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
    turned: tuple[int, ...] = ()
    orientation = 1
    with decoding(path, format), _quiet():
        if format == "TIFF":
            orientation, places = tiff_orientation(path)
            turned = places if orientation != 1 else ()
    with decoding(path, format), _quiet(), _opened(path, format, turned) as image:
        mode = image.mode
        if mode not in _DEEP and mode not in _GREY and mode not in _COLOUR:
            raise InputError(
                f"{path} has pixels of Pillow's mode {mode!r}; expected grey or RGB: convert it to RGB"
            )
        delays = _delays(path, format)
        if getattr(image, "default_image", False):
            delays = [None, *delays]  # a picture for programs that know no animation comes first
        # Pillow counts the frames of a GIF by reading through all of them.
        frames = max(1, len(delays)) if format == "GIF" else int(getattr(image, "n_frames", 1))
        grey = mode in _GREY or (mode == "P" and frames == 1 and _grey_palette(image))
        channels = 1 if grey or mode in _DEEP else 3
        dtype = np.dtype(_DEEP.get(mode, np.uint8))
        check_size(path, image.height, image.width, frames, channels * dtype.itemsize, limit)
        rows, columns = image.height, image.width
        said, notes = _declared(image, format, orientation, frames)
        if (bits := _bits(path, image, format)) > 8 and dtype == np.dtype(np.uint8):
            notes.append(f"{bits} bits per channel, of which the upper 8 are read")

    def decode(frame: int | None, colour: bool) -> Iterator[Pixels]:
        def pages() -> Iterator[Pixels]:
            with _opened(path, format, turned) as image:
                for i in range(frames) if frame is None else (frame,):
                    image.seek(i)
                    yield _pixels(image, path, (rows, columns), channels, dtype)

        with decoding(path, format):
            yield from quietly(pages(), _quiet)

    if frames > 1 and len(delays) == frames and (format == "GIF" or any(d is not None for d in delays)):
        times = np.concatenate([[0.0], np.cumsum([(d or _STILL_DELAY) for d in delays[:-1]])]) / 1000.0
        said = replace(said, clocks=(Clock("the frames' delays", times), *said.clocks))
        if not all(delays):
            notes.append(f"some frames declare no duration: {_STILL_DELAY} ms taken, as browsers do")
    if mode in ("RGBA", "LA", "PA", "RGBa", "La"):
        notes.append("transparency is left out")
    stored = Recording(
        path, format, rows, columns, frames, channels, dtype, decode, single=frames == 1, notes=tuple(notes)
    )
    return followed(stored, said)


def _declared(image: Image.Image, format: str, orientation: int, frames: int) -> tuple[Declared, list[str]]:
    """Collect the statements of EXIF, of echospline's own comment and of ImageJ's and OME's descriptions."""
    if format != "TIFF":
        orientation = _exif_orientation(image)
    name = "the TIFF orientation" if format == "TIFF" else "the EXIF orientation"
    said = Declared(turn=Turn.of_exif(orientation), turned_by=f"{name} {orientation}", aspect=_aspect(image))
    if format == "PNG" and (own := tagged_spacing(image.info.get("Comment"))):
        return replace(said, lengths=(Lengths(own, "echospline's comment", shown=True),)), []
    if format != "TIFF":
        return said, []
    tags: Any = getattr(image, "tag_v2", {})
    text = str(tags.get(_DESCRIPTION, ""))
    if text.startswith("ImageJ="):
        return _of_imagej(said, text, tags, frames), []
    if "<OME" in text[:2000]:
        sizes = {k: int(v) for k, v in re.findall(r'\bSize([ZTC])="(\d{1,7})"', text)}
        if sizes.get("Z", 1) > 1:
            return replace(said, volume=f"its OME description says SizeZ={sizes['Z']}"), []
        return said, ["it has an OME description, whose lengths and times are not read"]
    return said, []


def _of_imagej(said: Declared, text: str, tags: Any, frames: int) -> Declared:
    """Follow ImageJ's description: slices or frames, frame interval, and a calibration in a unit of length."""
    fields = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)

    def number(key: str) -> float:
        try:
            return float(fields.get(key, "0"))
        except ValueError:
            return 0.0

    if number("slices") > 1:
        said = replace(said, volume=f"its ImageJ description says slices={fields['slices']}")
    interval = number("finterval") or (1.0 / number("fps") if number("fps") > 0 else 0.0)
    if interval > 0:
        said = replace(said, clocks=(Clock("ImageJ's frame interval", np.arange(frames) * interval),))
    scale = _TO_MM.get(fields.get("unit", "").strip().replace("\\u00B5", "µ"))
    per = [tags.get(tag) for tag in _RESOLUTION]
    if scale and all(per) and all(float(v) > 0 for v in per):
        lengths = Lengths((scale / float(per[0]), scale / float(per[1])), "ImageJ's calibration")
        said = replace(said, lengths=(lengths,))
    return said


def _exif_orientation(image: Image.Image) -> int:
    found = image.getexif().get(ExifTags.Base.Orientation, 1)
    return found if isinstance(found, int) and 1 <= found <= 8 else 1


def _aspect(image: Image.Image) -> float | None:
    """Return width over height of a pixel where the densities of both directions differ.

    Densities are those of a printer, so they give no lengths; their ratio is a statement about the pixels.
    """
    density = image.info.get("aspect") or image.info.get("jfif_density") or image.info.get("dpi")
    try:
        across, down = (float(v) for v in density)  # type: ignore[union-attr]
    except (TypeError, ValueError):
        return None
    return down / across if across > 0 and down > 0 and across != down else None


def _bits(path: Path, image: Image.Image, format: str) -> int:
    """Return the stored bits per channel, of which Pillow keeps 8 in colour."""
    if format == "PNG":
        with path.open("rb") as file:
            start = file.read(25)
        return start[24] if start[12:16] == b"IHDR" and len(start) == 25 else 8
    if format == "TIFF":
        tags: Any = getattr(image, "tag_v2", {})
        return max(np.atleast_1d(tags.get(_BITS, 8)).tolist(), default=8)
    return 8


@contextmanager
def _opened(path: Path, format: str, turned: tuple[int, ...] = ()) -> Iterator[Image.Image]:
    """Open with one decoder alone; Pillow's own guard against decompression bombs becomes our sentence.

    ``turned`` holds the places of TIFF orientations that Pillow must not follow.
    """
    try:
        source = without_orientation(path, turned) if turned else path
        with Image.open(source, formats=(format,)) as image:
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
