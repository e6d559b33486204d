"""The server of the page that simulates, and the sessions that it keeps."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.viewer.aside import unfinished
    from echospline.viewer.class_answers import (
        class_answer,
        curves_csv,
        session_file,
        sessions_csv,
        sessions_file,
        trace_csv,
    )
    from echospline.viewer.learning_curve import Criterion
    from echospline.viewer.served_scene import Scene
    from echospline.viewer.server import announce, build_app, serve, steer, turn
    from echospline.viewer.sessions import Record, Session, Sessions
    from echospline.viewer.settings import Settings
    from echospline.viewer.upload import UploadLimits
else:
    on_demand(__name__)

__all__ = [
    "Criterion",
    "Record",
    "Scene",
    "Session",
    "Sessions",
    "Settings",
    "UploadLimits",
    "announce",
    "build_app",
    "class_answer",
    "curves_csv",
    "serve",
    "session_file",
    "sessions_csv",
    "sessions_file",
    "steer",
    "trace_csv",
    "turn",
    "unfinished",
]
