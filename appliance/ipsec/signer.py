"""The signer: the process that holds the audit key and signs checkpoints with it. It has no network.

Invariants:
1. The private key is made at the first start in the signer's own directory (mode 0600) and never leaves the
   process; a key file that is damaged or readable by others is an error, never replaced.
2. It parses only the messages of its lifeline and its link to control, and signs only audit checkpoints.
3. It remembers what it signed (`checkpoints.py`) and signs no second past; `rosrv audit verify` holds the log
   against that memory, so cutting the log's end or taking its signatures away is found.
"""

import asyncio
import os
import socket
import stat
import sys
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)

from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.messages import (
    Failed,
    Lifeline,
    LinkOpened,
    Ping,
    Pong,
    Ready,
    SignatureMade,
    SignatureRefused,
    SignatureWanted,
    SignerLink,
    Stop,
)
from appliance.ipsec.checkpoints import CheckpointRefusedError, SignedCheckpoints

KEY_FILE = "audit.key"
PUBLIC_KEY_FILE = "audit.pub"


class SignerKeyError(Exception):
    """The key file cannot be used; the message says which, why, and what to do."""


def load_or_create_key(directory: Path) -> Ed25519PrivateKey:
    """The audit key in `directory`, made if there is none. Raises `SignerKeyError` or `OSError`."""
    path = directory / KEY_FILE
    if not path.exists():
        _create_key(directory)
    status = path.stat()
    if status.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise SignerKeyError(f"{path}: others may read this private key (mode {status.st_mode & 0o777:o});"
                             " treat it as stolen, or set its mode to 600 if you know better")  # fmt: skip
    try:
        key = load_pem_private_key(path.read_bytes(), password=None)
    except (ValueError, TypeError) as error:
        raise SignerKeyError(
            f"{path}: not a private key in PEM: {error}; restore it from a backup"
        ) from error
    if not isinstance(key, Ed25519PrivateKey):
        raise SignerKeyError(f"{path}: not an Ed25519 key; restore it from a backup")
    public = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    _write(directory / PUBLIC_KEY_FILE, public, 0o644)
    return key


def _create_key(directory: Path) -> None:
    if (directory / PUBLIC_KEY_FILE).exists():
        raise SignerKeyError(f"{directory / KEY_FILE}: missing, but its public half is there; restore it from"
                             f" a backup, or remove {PUBLIC_KEY_FILE} to begin with a new key")  # fmt: skip
    key = Ed25519PrivateKey.generate()
    _write(directory / KEY_FILE, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()), 0o600)


def _write(path: Path, data: bytes, mode: int) -> None:
    """Replace a file as a whole, on the disk when this returns."""
    making = path.with_name(path.name + ".new")
    making.unlink(missing_ok=True)
    descriptor = os.open(making, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    making.rename(path)


class Signer:
    """Answers one lifeline and the link to control until it is told to stop."""

    def __init__(self, lifeline: Channel, directory: Path, key: Ed25519PrivateKey) -> None:
        self._lifeline = lifeline
        self._signed = SignedCheckpoints(directory)
        self._key = key
        self._public_key = key.public_key().public_bytes_raw()
        self._control: Channel | None = None
        self._stopped = asyncio.Event()

    async def run(self) -> None:
        """Serve until `Stop` arrives or the supervisor is gone."""
        self._lifeline.attach(asyncio.get_running_loop(), self._supervisor_said, self._stopped.set)
        self._lifeline.send(Ready(detail={"public_key": self._public_key.hex()}))
        await self._stopped.wait()
        if self._control is not None:
            self._control.close()

    def _supervisor_said(self, message: Any, descriptors: tuple[int, ...]) -> None:
        match message:
            case Ping(number):
                self._lifeline.send(Pong(number))
            case Stop():
                self._stopped.set()
            case LinkOpened(role="control"):
                self._open_link(descriptors[0])
            case _:
                for descriptor in descriptors:
                    os.close(descriptor)

    def _open_link(self, descriptor: int) -> None:
        if self._control is not None:
            self._control.close()
        link = Channel(socket.socket(fileno=descriptor), SignerLink)
        self._control = link
        link.attach(
            asyncio.get_running_loop(),
            lambda message, _descriptors: self._control_said(link, message),
            lambda: self._link_closed(link),
        )

    def _link_closed(self, link: Channel) -> None:
        if self._control is link:
            self._control = None

    def _control_said(self, link: Channel, message: Any) -> None:
        if not isinstance(message, SignatureWanted):
            return
        answer: SignatureMade | SignatureRefused
        try:
            self._signed.approve(message.text)
        except (CheckpointRefusedError, OSError) as error:
            answer = SignatureRefused(message.number, str(error))
        else:
            answer = SignatureMade(message.number, self._key.sign(message.text), self._public_key)
        try:
            link.send(answer)
        except ChannelClosedError:
            self._link_closed(link)  # control asks again over its next link


def main(lifeline_fd: int, directory: Path) -> None:
    """Be the signer: `lifeline_fd` is the lifeline's descriptor, `directory` the signer's own."""
    lifeline = Channel(socket.socket(fileno=lifeline_fd), Lifeline)
    try:
        os.umask(0o077)
        key = load_or_create_key(directory)
    except (SignerKeyError, OSError) as error:
        lifeline.send(Failed(f"the signer cannot use its key: {error}"))
        sys.exit(1)
    asyncio.run(Signer(lifeline, directory, key).run())
