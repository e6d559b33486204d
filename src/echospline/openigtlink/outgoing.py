"""Messages of one state of the scene: the deformed picture, the needle, the targets and the mesh."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from echospline.live import Snapshot
from echospline.openigtlink.image import Image
from echospline.openigtlink.message import Message
from echospline.openigtlink.polydata import Attribute, Point, Points, PolyData
from echospline.openigtlink.pose import Position, QuaternionTransform, Transform, quaternion_of
from echospline.openigtlink.tools import QuaternionTrackingData, Tool, TrackingData
from echospline.openigtlink.transforms import Naming
from echospline.picture import Drawing, NeedleEcho
from echospline.scene import Floats, ImagingPlane, Pixels, RegularGrid, Visible

ORIENTATION = {"UltrasoundImageOrientation": "MF"}
"""Metadata of every image: columns grow to the marked side of the probe, rows away from it."""


@dataclass(frozen=True)
class Looks:
    """Naming and looks of the scene in messages.

    Parameters
    ----------
    naming : Naming
        Names of frames.
    embed : bool
        Whether the image carries its place in the reference frame (as with PLUS' EmbeddedTransformToFrame); otherwise
        it is in pixels, and a transform ``ImageToReference`` is sent with it.
    echo : NeedleEcho or None
        The needle's looks; None leaves it out of the picture.
    """

    naming: Naming = field(default_factory=Naming)
    embed: bool = True
    echo: NeedleEcho | None = field(default_factory=NeedleEcho)


def draw(drawing: Drawing, snapshot: Snapshot, visible: Visible | None, looks: Looks) -> Pixels:
    """Draw the deformed pixels with the part of the needle inside the beam.

    Parameters
    ----------
    drawing : Drawing
        Of the image at rest, with the mesh of the snapshot's displacement.
    snapshot : Snapshot
        The scene.
    visible : Visible or None
        The piece of the needle inside the beam.
    looks : Looks
        Naming and looks.
    """
    if looks.echo is None or visible is None:
        return drawing.draw(snapshot.displacement).image.pixels
    echo = looks.echo.fainter(visible.brightness)
    return drawing.draw(snapshot.displacement, visible.of(snapshot.pose), echo).image.pixels


def image_message(
    pixels: Pixels, grid: RegularGrid, plane: ImagingPlane, looks: Looks, now: float
) -> list[Message]:
    """Build IMAGE, and its transform where it is not embedded.

    Parameters
    ----------
    pixels : ndarray
        (rows, columns) or (rows, columns, 3).
    grid : RegularGrid
        Their positions in mm.
    plane : ImagingPlane
        Their plane.
    looks : Looks
        Naming and looks.
    now : float
        Seconds since 1970.
    """
    n, matrix = looks.naming, plane.image_matrix(grid)
    embedded = Image(pixels[None], matrix if looks.embed else np.eye(4))
    messages = [Message(embedded, n.image, now, metadata=ORIENTATION)]
    if not looks.embed:
        messages.append(Message(Transform(matrix), f"{n.image}To{n.reference}", now))
    return messages


def needle_messages(snapshot: Snapshot, plane: ImagingPlane, naming: Naming, now: float) -> list[Message]:
    """Build the messages of the needle in the picture; see `tip_messages`."""
    return tip_messages(plane.tip_matrix(snapshot.pose), naming, now)


def tip_messages(matrix: Floats, naming: Naming, now: float) -> list[Message]:
    """Build the messages of a needle by the matrix of its tip: TRANSFORM for all; the others go to peers that asked for them."""
    name = f"{naming.needles[0]}To{naming.reference}"
    x, y, z = (float(v) for v in matrix[:3, 3])
    position, quaternion = (x, y, z), quaternion_of(matrix)
    # the tool's own name: the C++ library 1.11 reads none of 20 characters, and NeedleTipToReference has that many
    tools = (Tool(naming.needles[0], matrix),)
    return [
        Message(Transform(matrix), name, now),
        Message(TrackingData(tools), "echospline", now),
        Message(QuaternionTrackingData(tools), "echospline", now),
        Message(QuaternionTransform(position, quaternion), name, now),
        Message(Position(position, quaternion), name, now),
    ]


def target_message(snapshot: Snapshot, plane: ImagingPlane, naming: Naming, now: float) -> Message | None:
    """Build POINT of the watched points at their deformed positions; None if none are watched."""
    if not len(snapshot.watched):
        return None
    places = plane.lift(snapshot.watched)
    names = ["Target"] + [f"Target{i + 1}" for i in range(1, len(places))]
    points = (
        Point(name, (float(x), float(y), float(z)), 1.0, "Target", (255, 80, 0, 255), naming.image)
        for name, (x, y, z) in zip(names, places, strict=True)
    )
    return Message(Points(tuple(points)), "Target", now)


def mesh_message(snapshot: Snapshot, grid: RegularGrid, plane: ImagingPlane, now: float) -> Message:
    """Build POLYDATA of the displaced mesh; each node carries its displacement vector, mm, in the reference frame."""
    nx, ny = grid.shape
    first = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
    quads = np.column_stack((first, first + 1, first + 1 + nx, first + nx))
    vectors = snapshot.displacement @ plane.matrix[:3, :2].T
    displacement = Attribute("displacement", 1, vectors.astype(np.float32))
    points = plane.lift(grid.nodes + snapshot.displacement)
    return Message(PolyData(points, polygons=quads, attributes=(displacement,)), "Mesh", now)
