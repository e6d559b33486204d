"""The live page: server, protocol, exercises, scores and stored sessions."""

from echospline.viewer.exercise import Disc, Exercise, default_exercises
from echospline.viewer.room import Settings
from echospline.viewer.scoring import score
from echospline.viewer.served_scene import Scene
from echospline.viewer.server import announce, build_app, serve, steer
from echospline.viewer.sessions import Sessions, sessions_csv, trace_csv
from echospline.viewer.upload import UploadLimits

__all__ = [
    "Disc",
    "Exercise",
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
