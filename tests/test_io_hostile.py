"""Files that are damaged, mislabelled or made to harm: one clear sentence comes out, never anything else."""

from __future__ import annotations

import os
import resource
import struct
import subprocess
import sys
import zipfile
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from pydicom.data import get_testdata_file

from echospline.errors import EchosplineError, InputError
from echospline.io import DisplacementWriter, displacement_shapes, open_writer, read, read_displacement
from echospline.scene import NeedlePose, RegularGrid
from written_inputs import dicom, nifti, oriented, sequence, video

STACK = np.random.default_rng(7).integers(0, 256, (3, 12, 17), dtype=np.uint8)


def samples() -> dict[str, bytes]:
    """One small whole file of every kind."""
    made: dict[str, bytes] = {}
    for name in ("png", "jpeg", "tiff", "bmp"):
        buffer = BytesIO()
        Image.fromarray(STACK[0]).save(buffer, format=name.upper())
        made[name] = buffer.getvalue()
    folder = Path(os.environ.get("TMPDIR", "/tmp")) / f"echospline-samples-{os.getpid()}"
    folder.mkdir(exist_ok=True)
    try:
        image = SimpleITK.GetImageFromArray(STACK)
        for suffix, packed in (("mha", False), ("nrrd", False), ("nii", False), ("nii.gz", False)):
            SimpleITK.WriteImage(image, str(folder / f"a.{suffix}"), packed)
            made[suffix] = (folder / f"a.{suffix}").read_bytes()
        for suffix, packed in (("mha", True), ("nrrd", True)):
            SimpleITK.WriteImage(image, str(folder / f"z.{suffix}"), packed)
            made[f"packed {suffix}"] = (folder / f"z.{suffix}").read_bytes()
        for suffix in ("mp4", "gif"):
            with open_writer(folder / f"a.{suffix}", RegularGrid((17, 12), (0.1, 0.1)), 20) as writer:
                for k, pixels in enumerate(STACK):
                    writer.add(pixels, k / 20)
            made[suffix] = (folder / f"a.{suffix}").read_bytes()
        with DisplacementWriter(folder / "a.npz", RegularGrid((3, 2), (1.0, 1.0)).nodes) as record:
            for k in range(3):
                record.add(np.full((6, 2), k), float(k), NeedlePose((0, 0), (0, 1), 1))
        made["npz"] = (folder / "a.npz").read_bytes()
        written = {
            "sequence mha": sequence(folder / "s.mha", stack=STACK, fields=("ElementSpacing = 0.1 0.1 1",)),
            "time nii": nifti(folder / "t.nii", stack=STACK, slope=0.5, units=10, time=0.1, order=">"),
            "turned mp4": video(folder / "t.mp4", matrix=(0, 1, -1, 0), frames=STACK[:, :12, :16]),
            "turned jpg": oriented(folder / "t.jpg", 6, STACK[0]),
            "turned tif": oriented(folder / "t.tif", 8, STACK[0]),
            "bare dcm": dicom(folder / "b.dcm", frames=1, bare=True),
            "timed dcm": dicom(
                folder / "t.dcm", frames=3, FrameTime=40, FrameTimeVector=[0, 40, 50], RescaleSlope="2",
                FrameIncrementPointer=0x00181065,
            ),
        }  # fmt: skip
        made |= {kind: path.read_bytes() for kind, path in written.items()}
    finally:
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
    for key, name in (("dcm", "SC_rgb_small_odd.dcm"), ("jpeg dcm", "SC_rgb_small_odd_jpeg.dcm")):
        made[key] = Path(get_testdata_file(name)).read_bytes()
    made["rle dcm"] = Path(get_testdata_file("MR_small_RLE.dcm")).read_bytes()
    return made


SAMPLES = samples()


def take(path: Path) -> None:
    """Read a file in whatever way its content asks for."""
    if path.name.endswith(".npz"):
        read_displacement(path)
    else:
        read(path, spacing=(0.1, 0.1), fps=10, limit=64)


def refusal(path: Path) -> str | None:
    """Return what echospline says against a file; None when it reads it."""
    try:
        take(path)
    except EchosplineError as error:
        return str(error)
    return None


def suffix_of(kind: str) -> str:
    return kind.rsplit(maxsplit=1)[-1]


@pytest.mark.parametrize("kind", SAMPLES)
def test_the_whole_file_is_read(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a.{suffix_of(kind)}"
    path.write_bytes(SAMPLES[kind])
    take(path)


@pytest.mark.parametrize("kind", SAMPLES)
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_changed_bytes_give_one_sentence_or_a_picture(tmp_path: Path, kind: str, data: st.DataObject) -> None:
    content = bytearray(SAMPLES[kind])
    head = min(len(content), 600)
    for _ in range(data.draw(st.integers(1, 6))):
        # Headers are where harm is done, so most changes fall there.
        where = data.draw(
            st.one_of(st.integers(0, head - 1), st.integers(0, head - 1), st.integers(0, len(content) - 1))
        )
        content[where] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content))) :]
    path = tmp_path / f"a.{suffix_of(kind)}"
    path.write_bytes(content)
    sentence = refusal(path)
    if sentence is not None:
        assert str(path) in sentence or "compress" in sentence
        assert "\n" not in sentence


@pytest.mark.parametrize("kind", SAMPLES)
def test_a_wrong_suffix_changes_nothing_or_is_named(tmp_path: Path, kind: str) -> None:
    wrong = "dcm" if suffix_of(kind) in ("png", "npz") else "png"
    path = tmp_path / f"a.{wrong}"
    path.write_bytes(SAMPLES[kind])
    if kind == "npz":
        with pytest.raises(InputError, match="read_displacement"):
            take(path)
    else:
        take(path)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty"),
        (b"\x89PNG\r\n\x1a\n", "damaged or cut short"),
        (b"%PDF-1.7 ...", "is a PDF document"),
        (b"hello, this is no picture", "begins with 'hello, t'"),
        (b"MATLAB 5.0 MAT-file", "Matlab"),
        (b"\x1f\x8b\x08\x00junk", "which no known format does"),
    ],
)
def test_strangers_are_named(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError) as caught:
        read(tmp_path / "a.png", spacing=(0.1, 0.1))
    assert says in str(caught.value)
    assert "expected" in str(caught.value) or "empty" in str(caught.value)


def test_what_is_no_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no file"):
        read(tmp_path / "missing.png", spacing=(0.1, 0.1))
    with pytest.raises(InputError, match="is a folder without pictures"):
        read(tmp_path, spacing=(0.1, 0.1))
    with pytest.raises(InputError, match="cannot read"):
        read(str(tmp_path / "a\0b.png"), spacing=(0.1, 0.1))
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="cannot read"):
        read(tmp_path / "file" / "a.png", spacing=(0.1, 0.1))
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(InputError, match="a pipe"):
            read(tmp_path / "pipe", spacing=(0.1, 0.1))


def test_an_empty_file_gets_one_reason_and_one_advice(tmp_path: Path) -> None:
    (tmp_path / "a.png").touch()
    with pytest.raises(InputError) as caught:
        read(tmp_path / "a.png", spacing=(0.1, 0.1))
    assert str(caught.value) == f"{tmp_path / 'a.png'} is empty (0 bytes): copy or record it again"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(SAMPLES["png"])
    (tmp_path / "a.png").chmod(0)
    with pytest.raises(InputError, match="cannot read"):
        read(tmp_path / "a.png", spacing=(0.1, 0.1))


def png_of(columns: int, rows: int) -> bytes:
    """A PNG that declares a size and holds next to nothing."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    header = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * 1000))
        + chunk(b"IEND", b"")
    )


def npz_of(shape: str, content: bytes = b"", name: str = "displacement") -> bytes:
    """A displacement record whose one array declares a shape of its own."""
    buffer = BytesIO()
    with (
        zipfile.ZipFile(BytesIO(SAMPLES["npz"])) as source,
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as target,
    ):
        for member in source.namelist():
            body = source.read(member)
            if member == f"{name}.npy":
                text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
                body = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + content
            target.writestr(member, body)
    return buffer.getvalue()


@pytest.mark.parametrize("size", [(100_000, 100_000), (2**31 - 1, 2**31 - 1), (60_000, 50_000)])
def test_a_png_that_declares_a_size_beyond_memory_is_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    (tmp_path / "a.png").write_bytes(png_of(*size))
    with pytest.raises(InputError, match=r"more than the limit|more pixels than|damaged"):
        read(tmp_path / "a.png", spacing=(0.1, 0.1))


@pytest.mark.parametrize(
    "shape", ["(1000000000, 6, 2)", "(3, 6, 2, 1)", "(-3, -6, 2)", "(3,)", "()", "(10**9,)", "'abc'"]
)
def test_a_displacement_record_must_hold_what_it_declares(tmp_path: Path, shape: str) -> None:
    (tmp_path / "a.npz").write_bytes(npz_of(shape, bytes(3 * 6 * 2 * 8)))
    with pytest.raises(InputError):
        read_displacement(tmp_path / "a.npz")
    if shape.count(",") == 2 and "-" not in shape:  # what is declared is checked before any array is read
        with pytest.raises(InputError, match=r"declares shape .* but holds 288 bytes"):
            displacement_shapes(tmp_path / "a.npz")


def test_a_zip_bomb_is_refused_before_it_is_inflated(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(npz_of("(300000, 6, 2)", bytes(300_000 * 6 * 2 * 8)))
    assert (tmp_path / "a.npz").stat().st_size < 100_000
    with pytest.raises(InputError, match="limit of 16 MiB"):
        read_displacement(tmp_path / "a.npz", limit=16)


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", points=np.array([print], dtype=object))
    with pytest.raises(InputError, match="floating point"):
        read_displacement(tmp_path / "a.npz")


@pytest.mark.parametrize("key", ["points", "displacement", "times", "tip", "entry", "speed"])
def test_a_missing_or_infinite_array_is_named(tmp_path: Path, key: str) -> None:
    with np.load(BytesIO(SAMPLES["npz"])) as whole:
        arrays = dict(whole)
    np.savez(tmp_path / "a.npz", **{name: a for name, a in arrays.items() if name != key})
    with pytest.raises(InputError, match=f"lacks the array '{key}'"):
        read_displacement(tmp_path / "a.npz")
    arrays[key] = np.full_like(arrays[key], np.inf)
    np.savez(tmp_path / "b.npz", **arrays)
    with pytest.raises(InputError, match=f"{key} holds a number that is not finite"):
        read_displacement(tmp_path / "b.npz")


BOUNDED = """
import resource, sys
from echospline.errors import InputError
from echospline.io import read, read_displacement
import echospline.io.still, echospline.io.dicom, echospline.io.volume, echospline.io.video
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for name in sys.argv[1:]:
    try:
        (read_displacement if name.endswith("npz") else lambda p: read(p, spacing=(1, 1), fps=1))(name)
    except InputError:
        pass
    else:
        sys.exit(f"{name} was read")
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak of memory as Linux counts it")
def test_declared_sizes_beyond_memory_cost_no_memory(tmp_path: Path) -> None:
    files = {
        "a.png": png_of(100_000, 100_000),
        "a.npz": npz_of("(100000000, 6, 2)", b""),
        "a.mha": SAMPLES["mha"].replace(b"DimSize = 17 12 3", b"DimSize = 170000 120000 3000"),
        "a.nrrd": SAMPLES["nrrd"].replace(b"sizes: 17 12 3", b"sizes: 170000 120000 3000"),
        "a.nii": SAMPLES["nii"][:42] + struct.pack("<3h", 32000, 32000, 32000) + SAMPLES["nii"][48:],
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    run = subprocess.run(
        [sys.executable, "-c", BOUNDED, *(str(tmp_path / name) for name in files)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert int(run.stdout) < 100_000  # KiB
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss > 0
