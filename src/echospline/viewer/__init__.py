"""The live page: server, protocol, exercises, scores and stored sessions."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.viewer.exercise import Disc, Exercise, default_exercises
    from echospline.viewer.room import Settings
    from echospline.viewer.scoring import score
    from echospline.viewer.served_scene import Scene
    from echospline.viewer.server import announce, build_app, serve, steer
    from echospline.viewer.sessions import Import, Sessions, sessions_csv, trace_csv
    from echospline.viewer.upload import UploadLimits
else:
    on_demand(__name__)

__all__ = [
    "Disc",
    "Exercise",
    "Import",
    "Scene",
    "Sessions",
    "Settings",
    "UploadLimits",
    "announce",
    "build_app",
    "default_exercises",
    "score",
    "serve",
    "sessions_csv",
    "steer",
    "trace_csv",
]
