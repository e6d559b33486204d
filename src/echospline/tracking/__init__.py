"""Motion measured in cines: trackers, their regions of interest, and tracks on disk."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.tracking.block_matching import BlockMatching
    from echospline.tracking.carrier_phase import CarrierPhase
    from echospline.tracking.dense_flow import DenseFlow
    from echospline.tracking.region import grid_over, inside_ahead, region_ahead
    from echospline.tracking.score import Score, score, truth_doubts
    from echospline.tracking.tracker import (
        FlowTracker,
        Frame,
        Frames,
        Reference,
        Track,
        Tracker,
        grey_pair,
        levelled,
        track,
    )
    from echospline.tracking.tracks import read_track, write_track
else:
    on_demand(__name__)

__all__ = [
    "BlockMatching",
    "CarrierPhase",
    "DenseFlow",
    "FlowTracker",
    "Frame",
    "Frames",
    "Reference",
    "Score",
    "Track",
    "Tracker",
    "grey_pair",
    "grid_over",
    "inside_ahead",
    "levelled",
    "read_track",
    "region_ahead",
    "score",
    "track",
    "truth_doubts",
    "write_track",
]
