"""The link control <-> forwarder of the audit log. The forwarder only sends reports."""

from appliance.channel.messages.message import Message


class ForwardingReported(Message):
    """Progress after a change, at most once a second.

    `sent` counts since the start of the process, up to record `sequence` and checkpoint `checkpoint`. `behind` records
    wait, the oldest for `seconds`. `missed` records were removed before they could be sent.
    """

    sent: int = 0
    sequence: int = 0
    checkpoint: int = 0
    behind: int = 0
    seconds: float = 0.0
    missed: int = 0
    trouble: str = ""


ForwardingLink = ForwardingReported
