"""The status of a session in one sentence: model, needle and faults."""

from __future__ import annotations

from echospline.live import Snapshot
from echospline.openigtlink.text import NOT_READY, UNKNOWN_ERROR, Status
from echospline.openigtlink.transforms import Located
from echospline.scene import Reach, RegularGrid


def status_of(snapshot: Snapshot, located: Located, grid: RegularGrid, reach: Reach) -> Status:
    """Describe a scene as STATUS.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.
    located : Located
        Plane and needle, by the newest transforms.
    grid : RegularGrid
        The image's pixels.
    reach : Reach
        Distances up to which the needle is seen and touches the tissue.
    """
    if snapshot.failure:
        return Status(
            UNKNOWN_ERROR,
            0,
            "ModelFailed",
            f"{snapshot.model} failed: {snapshot.failure}; reset to go on",
        )
    if located.trouble and not (located.held and located.needle):
        return Status(NOT_READY, 0, located.fault, located.trouble)
    state = "frozen" if snapshot.frozen else "playing" if snapshot.replaying else "live"
    x, y = snapshot.pose.tip
    told = f"{snapshot.model}, {state}; tip {x:.1f} {y:.1f} mm, depth {snapshot.pose.depth:.1f} mm"
    if located.held:
        return Status(NOT_READY, 0, located.fault, f"{located.trouble}: {told}")
    if located.needle is None:
        return Status(text=f"{told}; no tracked needle yet")
    seen = located.needle.seen(grid.extent[2], reach)
    brightness = 0.0 if seen is None else seen.brightness
    away = "" if located.needle.pose(grid, reach) else ", too far to touch"
    return Status(
        text=f"{told}; {located.needle.out_of_plane:+.1f} mm out of plane, tilt {located.needle.tilt:.0f} deg, "
        f"echo {100 * brightness:.0f} %{away}"
    )
