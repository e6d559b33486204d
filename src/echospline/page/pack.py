"""The pack: one scene as bytes, with everything that a page needs to simulate it, by a reader and a writer that check it.

Eight bytes `ECHOPACK`, the length of the manifest (uint32, little-endian), the manifest (JSON, UTF-8), zeros up to a multiple of eight, then the
arrays, each at a multiple of eight from where they begin. The manifest is `Manifest` below, with a table of the arrays; an array may be coded.
"""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import isfinite, prod
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from echospline.errors import InputError
from echospline.page.codings import LARGEST_WEIGHT, from_kept, from_residuals, kept, residuals
from echospline.page.exercise import Exercise, check_exercises
from echospline.scene import RegularGrid

MAGIC = b"ECHOPACK"
FORMAT: Literal[1] = 1
LARGEST_MANIFEST = 4_000_000
"""Bytes."""
LARGEST = 256 * 2**20
"""Bytes of a pack; a page's memory ends not far beyond."""
MOST_NODES = 1_000_000
"""Of a mesh."""
MOST_MIRRORED = 2**24
"""Entries of an array whose mirror images are left out."""
UNIT = 1e-6
"""Distance of a direction's length from 1 that rounding explains."""

Finite = Annotated[float, Field(ge=-1e9, le=1e9)]
Positive = Annotated[float, Field(gt=0, le=1e9)]
Side = Annotated[int, Field(ge=2, le=4096)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_.-]{0,63}$")]
Text = Annotated[str, Field(min_length=1, max_length=400)]
Values = dict[Name, int | float | list[int] | list[float]]


class Part(BaseModel):
    """A table of the manifest; unknown keys, other types and numbers that are not finite are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ImagePart(Part):
    """The picture at rest, grey, 8-bit."""

    columns: Side
    rows: Side
    spacing: tuple[Positive, Positive]
    origin: tuple[Finite, Finite]
    pixels: Name


class VolumePart(Part):
    """The tissue at rest in space, grey, 8-bit; x fastest, then y."""

    shape: list[Annotated[int, Field(ge=2, le=4096)]] = Field(min_length=3, max_length=3)
    spacing: list[Positive] = Field(min_length=3, max_length=3)
    origin: list[Finite] = Field(min_length=3, max_length=3)
    voxels: Name


class ProbePart(Part):
    """The probe of a scene in space: its picture, the thickness of its slice, and where a hand holds it at first."""

    shape: Literal["linear", "curved"]
    columns: Side
    rows: Side
    spacing: list[Positive] = Field(min_length=2, max_length=2)
    origin: list[Finite] = Field(min_length=2, max_length=2)
    radius: float = Field(ge=1, le=500)
    opening: float = Field(ge=1, le=179)
    depth: float = Field(ge=1, le=500)
    pose: list[Finite] = Field(min_length=6, max_length=6)
    elevation: float = Field(ge=0, le=100)
    elevation_depth: float = Field(ge=0.1, le=1000)
    element_height: float = Field(ge=0, le=200)


class MeshPart(Part):
    """The mesh whose nodes carry the displacement."""

    shape: list[Annotated[int, Field(ge=2, le=4096)]] = Field(min_length=2, max_length=3)
    spacing: list[Positive] = Field(min_length=2, max_length=3)
    origin: list[Finite] = Field(min_length=2, max_length=3)


class ModelPart(Part):
    """A tissue model: what the core is given for it."""

    name: Annotated[Name, Field(max_length=40)]
    label: str = Field(min_length=1, max_length=40)
    sentence: dict[Name, Text]
    kind: Literal["landmarks", "forced"]
    options: Values
    response: Values | None = None
    arrays: dict[Name, Name] = {}


class NeedlePart(Part):
    """Where the needle begins, how it follows the hand, and its looks."""

    entry: list[Finite] = Field(min_length=2, max_length=3)
    direction: list[Finite] = Field(min_length=2, max_length=3)
    lag: float = Field(ge=0, le=10)
    fastest: float = Field(gt=0, le=1e5)
    echo: Values


class NeighboursPart(Part):
    """Coding of a volume (nz, ny, nx) of bytes: each is what is left, modulo 256, of its prediction from the voxels before it.

    The prediction is (sum of weight times voxel + 128) >> 8, held to 0 to 255; voxels beside the volume are 0. The weights are of
    x-1; y-1; x-1 y-1; z-1; x-1 z-1; y-1 z-1; x-1 y-1 z-1.
    """

    kind: Literal["neighbours"] = "neighbours"
    weights: list[Annotated[int, Field(ge=-LARGEST_WEIGHT, le=LARGEST_WEIGHT)]] = Field(
        min_length=7, max_length=7
    )


Image = Annotated[int, Field(ge=-MOST_MIRRORED, le=MOST_MIRRORED)]


class MirrorPart(Part):
    """A mirror of a table: where the image of every row and column is, from 1, negative where its sign changes."""

    rows: list[Image] = Field(min_length=1)
    columns: list[Image] = Field(min_length=1)


class MirroredPart(Part):
    """Coding of a table: an entry is left out where a mirror has its image earlier; it is then that image, by the first mirror that has."""

    kind: Literal["mirrored"] = "mirrored"
    mirrors: list[MirrorPart] = Field(min_length=1, max_length=3)

    @property
    def pairs(self) -> list[tuple[list[int], list[int]]]:
        """Rows and columns of every mirror."""
        return [(mirror.rows, mirror.columns) for mirror in self.mirrors]


Coding = Annotated[NeighboursPart | MirroredPart, Field(discriminator="kind")]


class ArrayPart(Part):
    """Where an array lies, and how it is written there; plainly without a coding."""

    dtype: Literal["uint8", "float32", "float64", "int32", "int64"]
    shape: list[Annotated[int, Field(ge=0, le=LARGEST)]] = Field(min_length=1, max_length=4)
    offset: int = Field(ge=0, le=LARGEST, multiple_of=8)
    coding: Coding | None = None

    @model_validator(mode="after")
    def _checked(self) -> ArrayPart:
        if isinstance(self.coding, NeighboursPart):
            fit = self.dtype == "uint8" and len(self.shape) == 3 and all(1 <= n <= 4096 for n in self.shape)
            if not fit:
                raise ValueError(
                    f"neighbours code uint8 of three axes up to 4096; got {self.dtype} of {self.shape}"
                )
        if isinstance(self.coding, MirroredPart):
            if not self.dtype.startswith("float") or prod(self.shape) > MOST_MIRRORED:
                raise ValueError(
                    f"mirrors code up to {MOST_MIRRORED} floats; got {self.dtype} of {self.shape}"
                )
            rows, columns = self.coding.pairs[0]
            for sides in self.coding.pairs:
                fit = len(sides[0]) * len(sides[1]) == prod(self.shape) and len(sides[0]) == len(rows)
                if not fit or any(not 1 <= abs(k) <= len(side) for side in sides for k in side):
                    raise ValueError(
                        f"rows and columns of a mirror lie in the table of {prod(self.shape)} numbers, {len(rows)} x {len(columns)}"
                    )
        return self

    @property
    def count(self) -> int:
        """Numbers that are written."""
        return (
            int(kept(self.coding.pairs).sum()) if isinstance(self.coding, MirroredPart) else prod(self.shape)
        )

    def written(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return what is written of an array.

        Raises
        ------
        InputError
            If it is not as its coding says.
        """
        if isinstance(self.coding, NeighboursPart):
            return residuals(array, self.coding.weights)
        if isinstance(self.coding, MirroredPart):
            left = array.ravel()[kept(self.coding.pairs)]
            if from_kept(left, self.coding.pairs).tobytes() != array.tobytes():
                raise InputError("an array of a pack is coded by mirrors, and its images differ from it")
            return left
        return array

    def read(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the array of which ``values`` were written."""
        if isinstance(self.coding, NeighboursPart):
            return from_residuals(values.reshape(self.shape), self.coding.weights)
        if isinstance(self.coding, MirroredPart):
            values = from_kept(values, self.coding.pairs)
        return values.reshape(self.shape)


class Manifest(Part):
    """Everything of a scene but its arrays."""

    format: Literal[1] = FORMAT
    version: str = Field(min_length=1, max_length=40)
    title: str = Field(min_length=1, max_length=200)
    language: Literal["en", "de"] = "en"
    image: ImagePart | None = None
    volume: VolumePart | None = None
    probe: ProbePart | None = None
    mesh: MeshPart
    rate: float = Field(120.0, ge=10, le=1000)
    models: list[ModelPart] = Field(min_length=1, max_length=8)
    needle: NeedlePart
    exercises: list[Exercise] = Field([], max_length=100)
    arrays: dict[Name, ArrayPart]


@dataclass(frozen=True, eq=False)
class Pack:
    """A scene that a page simulates.

    Parameters
    ----------
    manifest : Manifest
        Everything but the arrays.
    arrays : mapping of str to ndarray
        The arrays that the manifest names.
    digest : str
        SHA-256 of the pack's bytes, in hexadecimal; of those that were read, or that `to_bytes` writes.

    Raises
    ------
    InputError
        If manifest and arrays do not fit together.
    """

    manifest: Manifest
    arrays: Mapping[str, NDArray[Any]]
    digest: str = ""

    def __post_init__(self) -> None:
        for array in self.arrays.values():
            array.setflags(write=False)
        _check(self)
        if not self.digest:
            object.__setattr__(self, "digest", hashlib.sha256(self.to_bytes()).hexdigest())

    @property
    def dimension(self) -> int:
        """2 in the plane, 3 in space."""
        return len(self.manifest.mesh.shape)

    @cached_property
    def mesh(self) -> RegularGrid:
        """The mesh in the plane."""
        (nx, ny), (dx, dy), (x, y) = (
            self.manifest.mesh.shape,
            self.manifest.mesh.spacing,
            self.manifest.mesh.origin,
        )
        return RegularGrid((nx, ny), (dx, dy), (x, y))

    @property
    def corners(self) -> tuple[list[float], list[float]]:
        """Least and greatest corner of the mesh, mm."""
        m = self.manifest.mesh
        last = [o + h * (n - 1) for o, h, n in zip(m.origin, m.spacing, m.shape, strict=True)]
        return list(m.origin), last

    def model(self, name: str) -> ModelPart:
        """Return the model of a name.

        Raises
        ------
        InputError
            If there is none.
        """
        for model in self.manifest.models:
            if model.name == name:
                return model
        known = ", ".join(model.name for model in self.manifest.models)
        raise InputError(f"this pack has no model {name!r}; it has {known}")

    def array(self, model: ModelPart, role: str) -> NDArray[Any] | None:
        """Return an array of a model by its role; None where it has none."""
        name = model.arrays.get(role)
        return None if name is None else self.arrays[name]

    def to_bytes(self) -> bytes:
        """Write the pack."""
        head = self.manifest.model_dump(mode="json", exclude_none=True)
        text = json.dumps(head, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
        out = bytearray(MAGIC + struct.pack("<I", len(text)) + text)
        out += bytes(-len(out) % 8)
        start = len(out)
        for name, part in self.manifest.arrays.items():
            out += bytes(start + part.offset - len(out))
            out += part.written(self.arrays[name]).tobytes()
        return bytes(out)

    @classmethod
    def from_bytes(cls, data: bytes) -> Pack:
        """Read a pack.

        Raises
        ------
        InputError
            If it is cut, says another size than it has, or holds anything but a scene.
        """
        if len(data) > LARGEST:
            raise InputError(f"a pack has at most {LARGEST} bytes; got {len(data)}")
        if data[:8] != MAGIC or len(data) < 12:
            raise InputError(
                "a pack begins with ECHOPACK and the length of its manifest; this is something else"
            )
        (length,) = struct.unpack_from("<I", data, 8)
        if length > LARGEST_MANIFEST or 12 + length > len(data):
            raise InputError(
                f"the manifest of this pack says a length of {length} bytes, and {len(data) - 12} follow"
            )
        try:
            manifest = Manifest.model_validate_json(data[12 : 12 + length], strict=True)
        except ValidationError as error:
            raise InputError(f"the manifest of this pack is damaged: {_fault(error)}") from None
        start = 12 + length + -(12 + length) % 8
        arrays = {}
        end = 0
        for name, part in manifest.arrays.items():
            kind = np.dtype(part.dtype).newbyteorder("<")
            count = part.count
            size = count * kind.itemsize
            if part.offset < end or start + part.offset + size > len(data):
                raise InputError(
                    f"array {name!r} of this pack overlaps another or ends beyond the pack's {len(data)} bytes"
                )
            end = part.offset + size
            flat = np.frombuffer(data, kind, count, start + part.offset)
            arrays[name] = part.read(flat.astype(part.dtype))
        if start + end != len(data):
            raise InputError(f"this pack has {len(data)} bytes, and its arrays end at {start + end}")
        return cls(manifest, arrays, hashlib.sha256(data).hexdigest())


def deflated(data: bytes) -> bytes:
    """Compress as a page inflates it (raw deflate), by the shorter of two ways: what is left of a speckled volume repeats nothing."""
    packers = [
        zlib.compressobj(9, zlib.DEFLATED, -15, 9, way) for way in (zlib.Z_DEFAULT_STRATEGY, zlib.Z_FILTERED)
    ]
    return min((packer.compress(data) + packer.flush() for packer in packers), key=len)


def inflated(data: bytes, most: int = LARGEST) -> bytes:
    """Decompress what `deflated` wrote.

    Raises
    ------
    InputError
        If it is damaged or longer than ``most`` bytes.
    """
    unpacker = zlib.decompressobj(-15)
    try:
        out = unpacker.decompress(data, most + 1)
    except zlib.error:
        raise InputError("packed data of a page is damaged") from None
    if len(out) > most or not unpacker.eof or unpacker.unused_data:
        raise InputError(f"packed data of a page is cut or longer than {most} bytes")
    return out


def table(
    arrays: Mapping[str, NDArray[Any]], codings: Mapping[str, NeighboursPart | MirroredPart] | None = None
) -> dict[str, ArrayPart]:
    """Lay arrays out one after the other, some of them coded."""
    parts, at = {}, 0
    for name, array in arrays.items():
        kind: Any = array.dtype.name
        part = ArrayPart(dtype=kind, shape=list(array.shape), offset=at, coding=(codings or {}).get(name))
        parts[name] = part
        size = part.count * array.dtype.itemsize
        at += size + -size % 8
    return parts


def _fault(error: ValidationError) -> str:
    fault = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(name) for name in fault["loc"])
    words = fault["msg"].removeprefix("Value error, ").splitlines()[0]
    return f"{where}: {words}"[:300] if where else words[:300]


def _check(pack: Pack) -> None:
    """Refuse a manifest and arrays that do not fit together."""
    m = pack.manifest
    if set(pack.arrays) != set(m.arrays):
        raise InputError("the arrays of a pack are not those of its manifest")
    for name, part in m.arrays.items():
        array = pack.arrays[name]
        if array.dtype.name != part.dtype or list(array.shape) != part.shape:
            raise InputError(f"array {name!r} of a pack has another type or shape than its manifest says")
    shown = _check_shown(pack)
    names = [model.name for model in m.models]
    if len(set(names)) < len(names):
        raise InputError(f"two models of a pack have one name: {', '.join(names)}")
    for model in m.models:
        _check_model(pack, model)
    used = {shown, *(name for model in m.models for name in model.arrays.values())}
    if used != set(m.arrays):
        raise InputError(f"arrays of a pack that nothing uses: {', '.join(sorted(set(m.arrays) - used))}")
    _check_needle(m.needle, pack.dimension)
    tables = {"needle.echo": m.needle.echo}
    for model in m.models:
        tables |= {model.name: model.options, f"{model.name}.response": model.response or {}}
    for key, value in _numbers(tables):
        if not isfinite(value):
            raise InputError(f"{key} of a pack must be a finite number; got {value}")
    check_exercises(m.exercises, *pack.corners)


def _check_shown(pack: Pack) -> str:
    """Refuse a mesh, picture or volume that do not fit; returns the array of what is shown."""
    m, D = pack.manifest, pack.dimension
    if not len(m.mesh.shape) == len(m.mesh.spacing) == len(m.mesh.origin) == D:
        raise InputError(f"shape, spacing and origin of a pack's mesh need {D} numbers each")
    if (m.image is None) != (D == 3) or (m.volume is None) != (D == 2) or (m.probe is None) != (D == 2):
        raise InputError(
            "a pack holds an image and a mesh of two axes, or a volume, a probe and a mesh of three"
        )
    if prod(m.mesh.shape) > MOST_NODES:
        raise InputError(f"the mesh of a pack has at most {MOST_NODES} nodes; got {prod(m.mesh.shape)}")
    if m.volume is not None:
        _typed(pack, m.volume.voxels, "uint8", tuple(m.volume.shape[::-1]), "the volume")
        return m.volume.voxels
    assert m.image is not None
    _typed(pack, m.image.pixels, "uint8", (m.image.rows, m.image.columns), "the picture")
    return m.image.pixels


def _check_needle(n: NeedlePart, D: int) -> None:
    if len(n.entry) != D or len(n.direction) != D:
        raise InputError(
            f"entry and direction of the needle need {D} numbers; got {n.entry} and {n.direction}"
        )
    if abs(sum(c * c for c in n.direction) - 1) > UNIT:
        raise InputError(f"the needle's direction must have length 1; got {n.direction}")


def _numbers(tables: Mapping[str, Values]) -> Iterator[tuple[str, float]]:
    for table_, values in tables.items():
        for key, value in values.items():
            for number in value if isinstance(value, list) else [value]:
                yield f"{table_}.{key}", number


def _check_model(pack: Pack, model: ModelPart) -> None:
    for name in model.arrays.values():
        if name not in pack.arrays:
            raise InputError(f"model {model.name!r} of a pack names array {name!r}, which it does not hold")
    if model.kind == "landmarks":
        _check_landmarks(pack, model)
    elif pack.dimension == 2:
        _check_forced(pack, model)
    else:
        _check_spatial(pack, model)


def _check_mesh(pack: Pack, model: ModelPart, values: Values) -> None:
    """Refuse a model of another mesh than the pack's."""
    mesh, D = pack.manifest.mesh, pack.dimension
    expected: dict[str, Any] = {"shape": mesh.shape, "spacing": mesh.spacing, "origin": mesh.origin}
    if model.kind == "landmarks":
        expected["dimension"] = D
    for key, wanted in expected.items():
        came = values.get(key)
        if (came[:D] if isinstance(came, list) else came) != wanted:
            raise InputError(
                f"{key} of model {model.name!r} must be that of the pack's mesh, {wanted}; got {came}"
            )


def _check_landmarks(pack: Pack, model: ModelPart) -> None:
    _check_mesh(pack, model, model.options)
    if model.response is not None:
        raise InputError(f"model {model.name!r} of a pack has a response, which landmarks have not")
    allowed = {"clamped_points", "stiffness"}
    if not set(model.arrays) <= allowed:
        raise InputError(
            f"a model of landmarks has arrays {', '.join(sorted(allowed))}; got {', '.join(model.arrays)}"
        )
    if (points := pack.array(model, "clamped_points")) is not None:
        role = model.arrays["clamped_points"]
        _typed(pack, role, "float64", (len(points), pack.dimension), "clamped points")
        if not np.isfinite(points).all():
            raise InputError("clamped points of a pack must be finite")
    if (firm := pack.array(model, "stiffness")) is not None:
        nodes = prod(pack.manifest.mesh.shape)
        _typed(pack, model.arrays["stiffness"], "float64", (nodes,), "the stiffness")
        if not (firm > 0).all():
            raise InputError("every stiffness of a pack must be positive (or infinite)")


def _check_forced(pack: Pack, model: ModelPart) -> None:
    from echospline.scenario import ForcedScene  # noqa: PLC0415 - packs without it are read without the numerics

    _check_mesh(pack, model, model.response or {})
    ForcedScene(_law(model), model.response or {}, _finite_arrays(pack, model))


def _check_spatial(pack: Pack, model: ModelPart) -> None:
    """Refuse tables of a forced model in space that do not fit each other or the mesh."""
    from echospline.scenario import SpatialForcedScene  # noqa: PLC0415 - as above

    response = model.response or {}
    for name, wanted in zip(("low", "high"), pack.corners, strict=True):
        came = response.get(name)
        if not isinstance(came, list) or len(came) != 3 or not np.allclose(came, wanted, atol=1e-6):
            raise InputError(f"{name} of model {model.name!r} must be that of the mesh, {wanted}; got {came}")
    SpatialForcedScene(_law(model), response, _finite_arrays(pack, model))


def _finite_arrays(pack: Pack, model: ModelPart) -> dict[str, NDArray[Any]]:
    given = {role: pack.arrays[name] for role, name in model.arrays.items()}
    for role, array in given.items():
        if not np.isfinite(array).all():
            raise InputError(f"{role} of model {model.name!r} of a pack must be finite")
    return given


def _law(model: ModelPart) -> dict[str, float]:
    law = {name: value for name, value in model.options.items() if not isinstance(value, list)}
    if len(law) < len(model.options):
        raise InputError(f"every option of model {model.name!r} of a pack is one number")
    return law


def _typed(pack: Pack, name: str, dtype: str, shape: tuple[int, ...], what: str) -> None:
    array = pack.arrays.get(name)
    if array is None:
        raise InputError(f"{what} of a pack is array {name!r}, which it does not hold")
    if array.dtype.name != dtype or array.shape != shape:
        raise InputError(
            f"{what} of a pack must be {dtype} of shape {shape}; got {array.dtype.name} of {array.shape}"
        )
