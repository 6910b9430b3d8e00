"""The messages between control and the process `hook`."""

from appliance.channel.messages.message import Message


class CallWaits(Message, frozen=True):
    """A call began to wait for an approval."""

    number: int
    host: str
    caller_id: str
    category: str
    resource: str
    type: str
    seconds: float
    """Until it expires."""


class CallSent(Message, frozen=True):
    """The web hook got a call; otherwise `trouble` is the reason."""

    number: int
    trouble: str


HookLink = CallWaits | CallSent
