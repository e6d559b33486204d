"""Orders from peers: STRING (as PLUS and Slicer's remote control send them, or plain words) and COMMAND; their answers."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

from echospline.errors import InputError
from echospline.openigtlink.message import Message
from echospline.openigtlink.stage import AnyStage
from echospline.openigtlink.text import UNKNOWN_ERROR, CommandMessage, CommandReply, Status, String

LONGEST = 16 * 1024
"""Characters of an order."""

NAMES = {
    "start": "start", "stop": "stop", "reset": "reset", "freeze": "freeze", "unfreeze": "unfreeze",
    "load": "load", "loadscenario": "load", "model": "model", "switchmodel": "model",
}  # fmt: skip
"""Orders by their name in small letters."""


@dataclass(frozen=True)
class Order:
    """An order of a peer.

    Parameters
    ----------
    name : str
        One of the values of `NAMES`.
    argument : str
        Name of a model, file of a scenario; empty otherwise.
    """

    name: str
    argument: str = ""


def order_of(message: Message) -> Order | None:
    """Return the order in a STRING or COMMAND; None if the text is no order.

    A text is an order if it is XML ``<Command Name="..." .../>``, if its device says so (``CMD_...``, ``Command``),
    or if it comes as COMMAND.

    Raises
    ------
    InputError
        If it is an unknown or malformed order.
    """
    content = message.content
    if isinstance(content, CommandReply):
        return None
    if isinstance(content, CommandMessage):
        return (
            _from_xml(content.text)
            if content.text.lstrip().startswith("<")
            else _named(content.name, content.text)
        )
    if isinstance(content, String):
        text = content.text.strip()
        if text.startswith("<Command") and not text.startswith("<CommandReply"):
            return _from_xml(text)
        if message.device.startswith("CMD_") or message.device.lower() == "command":
            name, _, argument = text.partition(" ")
            return _named(name, argument)
    return None


def _from_xml(text: str) -> Order:
    if len(text) > LONGEST or "<!" in text:
        raise InputError(
            f"an order is XML of at most {LONGEST} characters without declarations; got {len(text)}"
        )
    try:
        element = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"an order is <Command Name=.../>; this is no XML: {error}") from error
    attributes: Mapping[str, str] = {k.lower(): v for k, v in element.attrib.items()}
    argument = attributes.get("model") or attributes.get("file") or attributes.get("value") or ""
    return _named(attributes.get("name", ""), argument)


def _named(name: str, argument: str) -> Order:
    key = name.strip().lower().replace("_", "").replace(" ", "")
    if key not in NAMES:
        raise InputError(f"orders are {', '.join(dict.fromkeys(NAMES.values()))}; got {name[:40]!r}")
    return Order(NAMES[key], argument.strip())


def carry_out(order: Order, stage: AnyStage) -> str:
    """Carry out an order, other than to load a scenario; returns a sentence for the peer.

    Raises
    ------
    InputError
        If the stage has no such model or no planned insertion.
    """
    engine = stage.engine
    if order.name == "start":
        return f"the planned insertion runs, {stage.start():.1f} s"
    if order.name == "stop":
        engine.freeze(True)
        return "time stands still"
    if order.name == "reset":
        engine.reset()
        return "needle and tissue are at rest"
    if order.name in ("freeze", "unfreeze"):
        on = order.name == "freeze" and order.argument.lower() not in ("off", "false", "0")
        engine.freeze(on)
        return "time stands still" if on else "time runs"
    if order.argument not in stage.models:
        raise InputError(f"a model is one of {', '.join(stage.models)}; got {order.argument!r}")
    engine.switch(order.argument)
    return f"the tissue is {order.argument} now"


def answer(message: Message, text: str, *, done: bool) -> Message:
    """Build the answer to an order, in the form of the order.

    Parameters
    ----------
    message : Message
        The order: STRING of device ``CMD_id`` is answered by STRING ``ACK_id``, COMMAND by RTS_COMMAND, other
        STRING by STATUS.
    text : str
        The result.
    done : bool
        Whether the order was carried out.
    """
    status = "SUCCESS" if done else "FAIL"
    xml = f"<CommandReply Status={quoteattr(status)} Message={quoteattr(text)} />"
    content = message.content
    if isinstance(content, CommandMessage):
        error = "" if done else text.encode("ascii", "replace").decode()[:100]
        said = CommandReply(content.id, error, xml)
        return Message(
            said, message.device, time.time(), message.version, {"Status": status, "Message": text}
        )
    if message.device.startswith("CMD_"):
        return Message(String(xml), ("ACK_" + message.device[4:])[:20], time.time(), message.version)
    said_status = Status(text=text) if done else Status(UNKNOWN_ERROR, 0, "OrderFailed", text)
    return Message(said_status, message.device, time.time(), message.version)
