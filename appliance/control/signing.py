"""Control's link to the signer: checkpoints of the audit log and removals from it are signed there, certificates made.

Unsigned checkpoints are asked for again whenever a signer appears.
"""

import asyncio

from appliance.audit.log import AuditLog
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.hosts.authority import Authority


class Signing:
    """The link to the signer; `want` and `want_removal` may be called on any thread."""

    def __init__(self, authority: Authority) -> None:
        self._authority = authority
        self._loop = asyncio.get_running_loop()
        self._channel: Channel | None = None

    def want(self, number: int, text: bytes) -> None:
        """Have a checkpoint signed. Called on the log's thread."""
        self._ask(messages.SignatureWanted(number, text))

    def want_removal(self, number: int, checkpoint: bytes, newest: bytes) -> None:
        """Have the removal of the records up to a checkpoint signed. Called on the log's thread."""
        self._ask(messages.RemovalWanted(number, checkpoint, newest))

    def _ask(self, message: messages.Message) -> None:
        def ask() -> None:
            if self._channel is not None:
                self._channel.send(message)

        self._loop.call_soon_threadsafe(ask)

    def attach(self, channel: Channel, audit: AuditLog) -> None:
        """A signer is there."""
        self._channel = channel
        self._authority.attach(channel)

        def received(message: object, _descriptors: tuple[int, ...]) -> None:
            if self._authority.received(message):
                return
            if isinstance(message, messages.SignatureMade):
                audit.signed(message.number, message.signature, message.public_key)
            elif isinstance(message, messages.SignatureRefused):
                audit.refused(message.number, message.reason)
            elif isinstance(message, messages.RemovalApproved):
                audit.removal_approved(message.number, message.text, message.signature, message.public_key)
            elif isinstance(message, messages.RemovalRefused):
                audit.removal_refused(message.number, message.reason)

        def closed() -> None:
            if self._channel is channel:
                self._channel = None
                self._authority.attach(None)

        channel.attach(self._loop, received, closed)
        audit.request_signatures()
