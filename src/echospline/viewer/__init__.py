"""The server of the page that simulates, and the sessions that it keeps."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.viewer.aside import unfinished
    from echospline.viewer.recording import keep
    from echospline.viewer.served_scene import Scene
    from echospline.viewer.server import announce, build_app, serve, steer, turn
    from echospline.viewer.sessions import Import, Sessions, sessions_csv, trace_csv
    from echospline.viewer.settings import Settings
    from echospline.viewer.upload import UploadLimits
else:
    on_demand(__name__)

__all__ = [
    "Import",
    "Scene",
    "Sessions",
    "Settings",
    "UploadLimits",
    "announce",
    "build_app",
    "keep",
    "serve",
    "sessions_csv",
    "steer",
    "trace_csv",
    "turn",
    "unfinished",
]
