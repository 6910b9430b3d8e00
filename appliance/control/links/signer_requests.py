"""Send requests to the signer: sign checkpoints of the audit log, approve removals from the log, make certificates.

Missing signatures are requested again whenever a signer process starts. Before that, a new signer gets no request:
after the present checkpoint, it would refuse the earlier ones.
"""

import asyncio
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

from appliance.audit.log.log import AuditLog
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.link import Link

_ANY = 1 << 63


class ReceiptFloor:
    """The last record that retention by age may remove: any record, or if `holding`, only what another machine has.

    While only the reserve of the log's disk is free, it may remove any. One thread writes, another reads.
    """

    def __init__(self, state: Path, reserve: int, *, holding: bool) -> None:
        self._folder = state / "control"
        self._reserve = reserve
        self._received = 0 if holding else _ANY

    def received(self, sequence: int) -> None:
        if self._received != _ANY:
            self._received = sequence

    def through(self) -> int:
        disk = os.statvfs(self._folder)
        return self._received if disk.f_bavail * disk.f_frsize >= self._reserve else _ANY


class SignerRequests:
    """The link to the signer; `want` and `want_removal` are thread-safe."""

    def __init__(self, audit: Callable[[], AuditLog]) -> None:
        self.link = Link(self._heard)
        self.signed = asyncio.Event()
        """Set with each signature of a checkpoint, after the log got it."""
        self._audit = audit
        self._loop = asyncio.get_running_loop()
        self._in_order = False  # whether the present signer has got the oldest request

    def want(self, number: int, text: bytes, *, oldest: bool) -> None:
        wanted = messages.SignatureWanted(number, text)
        self._loop.call_soon_threadsafe(partial(self._want, wanted, oldest=oldest))

    def _want(self, message: messages.SignatureWanted, *, oldest: bool) -> None:
        if oldest or self._in_order:
            self._in_order = self.link.send(message)

    def want_removal(self, number: int, checkpoint: bytes, newest: bytes) -> None:
        message = messages.RemovalWanted(number, checkpoint, newest)
        self._loop.call_soon_threadsafe(self.link.send, message)

    def attach(self, channel: Channel) -> None:
        self._in_order = False
        self.link.attach(channel)
        self._audit().request_signatures()

    def _heard(self, message: object) -> None:
        match message:
            case messages.SignatureMade(number, signature, public_key, others):
                self._audit().other_logs(others)
                self._audit().store_signature(number, signature, public_key)
                self.signed.set()
            case messages.SignatureRefused(number, reason):
                self._audit().refused(number, reason)
            case messages.RemovalSigned(number, text, signature, public_key):
                self._audit().removal_signed(number, text, signature, public_key)
            case messages.RemovalRefused(number, reason, early):
                self._audit().removal_refused(number, reason, early=early)
            case (
                messages.AuthorityStated(number)
                | messages.CertificateMade(number)
                | messages.CertificateRefused(number)
                | messages.RevocationsMade(number)
            ):
                self.link.answered(number, message)
