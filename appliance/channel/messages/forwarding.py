"""The link control <-> the forwarder of the audit log, which only reports."""

from appliance.channel.messages.message import Message


class ForwardingReported(Message):
    """How far the audit log was forwarded; once a second at most, when something has changed.

    `sent` messages in this life of the process, up to record `sequence` and checkpoint `checkpoint`; `behind` records
    wait, the oldest for `seconds`; `missed` were removed before they could be sent; `trouble` is why nothing goes on.
    """

    sent: int = 0
    sequence: int = 0
    checkpoint: int = 0
    behind: int = 0
    seconds: float = 0.0
    missed: int = 0
    trouble: str = ""


ForwardingLink = ForwardingReported
