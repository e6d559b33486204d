"""The page that simulates: scenes as packs, the page as one file, sessions run again, exercises and scores."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.page.bundle import assembled, bundle, core_bytes, served_page
    from echospline.page.exercise import Disc, Exercise, check_exercises, default_exercises
    from echospline.page.pack import Pack
    from echospline.page.packing import doubts, packed
    from echospline.page.packing_space import packed_space
    from echospline.page.replay import Verified, pack_of_page, replay, verify
    from echospline.page.rules import beyond, broken_rules
    from echospline.page.scoring import Score, score
    from echospline.page.sessions_file import RecordedSession, parsed_sessions, read_sessions
else:
    on_demand(__name__)

__all__ = [
    "Disc",
    "Exercise",
    "Pack",
    "RecordedSession",
    "Score",
    "Verified",
    "assembled",
    "beyond",
    "broken_rules",
    "bundle",
    "check_exercises",
    "core_bytes",
    "default_exercises",
    "doubts",
    "pack_of_page",
    "packed",
    "packed_space",
    "parsed_sessions",
    "read_sessions",
    "replay",
    "score",
    "served_page",
    "verify",
]
