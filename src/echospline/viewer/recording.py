"""Keep a session that was run again: once, with what its page said of it."""

from __future__ import annotations

from typing import Any

from echospline.page import Verified
from echospline.viewer.sessions import Import, Sessions


def keep(sessions: Sessions, found: Verified, *, source: str = "", upload: str = "") -> tuple[int, bool]:
    """Store a session, or find it if it is stored.

    Parameters
    ----------
    sessions : Sessions
        Where.
    found : Verified
        The session, run again.
    source : str
        What its scene was made from, as JSON; empty where that is not known.
    upload : str
        Name of the stored picture that it was recorded in; empty for the scene that a server began with.

    Returns
    -------
    (int, bool)
        Its number, and whether it is new.
    """
    session = found.session
    known = sessions.number_of(session.digest)
    if known is not None:
        return known, False
    made: dict[str, Any] = {
        "version": session.version, "core": session.core, "pack": session.scene.pack, "attempt": session.attempt,
        "ended": session.ended, "examination": session.examination, "events": session.events,
    }  # fmt: skip
    number = sessions.add(
        session.exercise, found.trace, found.score, trainee=session.trainee, scene=session.scene.title,
        model=session.model, source=source, upload=upload,
        imported=Import(session.when, "; ".join(found.differences) or "yes", made, session.digest),
    )  # fmt: skip
    return number, True
