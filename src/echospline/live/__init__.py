"""The live loop: one tissue model stepped at a fixed rate; newest command in, newest snapshot out, no queue."""

from echospline.live.engine import LiveEngine, ModelFactory
from echospline.live.motion import follow
from echospline.live.pacer import Metronome, Pacer
from echospline.live.recorder import Recorder, Trace
from echospline.live.slot import Numbered, Slot
from echospline.live.snapshot import Command, Snapshot

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
    "Trace",
    "follow",
]
