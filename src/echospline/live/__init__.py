"""The live loop: one tissue model stepped at a fixed rate; newest command in, newest snapshot out, no queue."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.live.engine import LiveEngine, ModelFactory
    from echospline.live.motion import follow
    from echospline.live.pacer import Metronome, Pacer, Stepped
    from echospline.live.recorder import Recorder, Trace
    from echospline.live.slot import Numbered, Slot
    from echospline.live.snapshot import Command, Snapshot
    from echospline.live.space_engine import SpatialEngine, SpatialSnapshot
else:
    on_demand(__name__)

__all__ = [
    "Command",
    "LiveEngine",
    "Metronome",
    "ModelFactory",
    "Numbered",
    "Pacer",
    "Recorder",
    "Slot",
    "Snapshot",
    "SpatialEngine",
    "SpatialSnapshot",
    "Stepped",
    "Trace",
    "follow",
]
