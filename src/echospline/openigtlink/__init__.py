"""OpenIGTLink: messages, link and session."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.openigtlink.header import PORT
    from echospline.openigtlink.link import Link, LinkLimits
    from echospline.openigtlink.message import Message
    from echospline.openigtlink.outgoing import Looks
    from echospline.openigtlink.plus import read_calibration
    from echospline.openigtlink.pose import Position, Transform
    from echospline.openigtlink.session import Session
    from echospline.openigtlink.stage import Rates, SessionOptions, SpatialStage, Stage
    from echospline.openigtlink.text import Status, String
    from echospline.openigtlink.transforms import Naming
else:
    on_demand(__name__)

__all__ = [
    "PORT",
    "Link",
    "LinkLimits",
    "Looks",
    "Message",
    "Naming",
    "Position",
    "Rates",
    "Session",
    "SessionOptions",
    "SpatialStage",
    "Stage",
    "Status",
    "String",
    "Transform",
    "read_calibration",
]
