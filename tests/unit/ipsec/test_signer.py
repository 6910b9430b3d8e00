import asyncio
import contextlib
import os
import select
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding

from appliance.audit.log.signatures import read_public_key
from appliance.audit.proof.signer_memory import read_signer_memory
from appliance.audit.proof.verification import verify
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.messages import (
    AuthorityRequest,
    AuthorityStated,
    CertificateMade,
    CertificateRefused,
    CertificateWanted,
    Failed,
    Lifeline,
    LinkOpened,
    Ping,
    Pong,
    Ready,
    RevocationsMade,
    RevocationsRequest,
    RevokedCertificate,
    SignatureMade,
    SignatureRefused,
    SignatureWanted,
    SignerLink,
    Stop,
)
from appliance.ipsec.certificate_authority import CertificateAuthority
from appliance.ipsec.removals import RetentionLimits
from appliance.ipsec.signer import KEY_FILE, PUBLIC_KEY_FILE, Signer, load_or_create_key
from tests.support.audit import decision, settle
from tests.support.engines import open_log

pytestmark = [pytest.mark.anyio, pytest.mark.nightly]

_LIMIT_SECONDS = 30
_TEXT = (
    f"rosrv audit checkpoint 1\nlog {'a' * 32}\nnumber 1\nsequence 1\nhash {'b' * 64}\ntime 1\nprevious {'0' * 64}\n"
).encode()


class SignerProcess:
    def __init__(self, directory: Path) -> None:
        ours, theirs = socket.socketpair()
        command = (
            "import sys; from pathlib import Path; from appliance.ipsec.signer import serve\n"
            "serve(int(sys.argv[1]), Path(sys.argv[2]))"
        )
        self.process = subprocess.Popen(
            [sys.executable, "-c", command, str(theirs.fileno()), str(directory)], pass_fds=[theirs.fileno()]
        )
        theirs.close()
        self.lifeline = Channel(ours, Lifeline)
        self.links: list[Channel] = []

    def open_link(self) -> Channel:
        ours, theirs = socket.socketpair()
        self.lifeline.send(LinkOpened(role="control", index=0), (theirs.fileno(),))
        theirs.close()
        self.links.append(Channel(ours, SignerLink))
        return self.links[-1]

    def end(self) -> int:
        for link in self.links:
            link.close()
        with contextlib.suppress(ChannelClosedError):
            self.lifeline.send(Stop())
        self.lifeline.close()
        return self.process.wait(_LIMIT_SECONDS)


def hear(channel: Channel) -> Any:
    assert select.select([channel], [], [], _LIMIT_SECONDS)[0], "no answer"
    ((message, _descriptors),) = channel.receive()
    return message


@pytest.fixture
def signer(tmp_path: Path) -> Iterator[SignerProcess]:
    (tmp_path / "signer").mkdir(mode=0o700)
    running = SignerProcess(tmp_path / "signer")
    assert isinstance(hear(running.lifeline), Ready)
    yield running
    assert running.end() == 0


def test_answers_pings(signer: SignerProcess) -> None:
    signer.lifeline.send(Ping(7))
    assert hear(signer.lifeline) == Pong(7)


def test_key_is_made_once_and_private(tmp_path: Path) -> None:
    keys = []
    for _life in range(2):
        running = SignerProcess(tmp_path)
        keys.append(hear(running.lifeline).detail["public_key"])
        assert running.end() == 0
    assert keys[0] == keys[1] == read_public_key(tmp_path / PUBLIC_KEY_FILE).hex()
    assert stat.S_IMODE((tmp_path / KEY_FILE).stat().st_mode) == 0o600


def test_signs_a_checkpoint(signer: SignerProcess) -> None:
    link = signer.open_link()
    link.send(SignatureWanted(1, _TEXT))
    made = hear(link)
    assert isinstance(made, SignatureMade)
    key = Ed25519PublicKey.from_public_bytes(made.public_key)
    key.verify(made.signature, _TEXT)
    with pytest.raises(InvalidSignature):
        key.verify(made.signature, _TEXT + b" ")


def test_signs_nothing_else(signer: SignerProcess) -> None:
    link = signer.open_link()
    link.send(SignatureWanted(1, b"a certificate for me, please"))
    assert hear(link) == SignatureRefused(1, "the data to sign is not an audit checkpoint")
    link.send(SignatureWanted(1, _TEXT))
    assert isinstance(hear(link), SignatureMade)
    link.send(SignatureWanted(1, _TEXT.replace(b"time 1", b"time 2")))
    assert "another checkpoint 1" in hear(link).reason


def test_new_link_replaces_the_old(signer: SignerProcess) -> None:
    signer.open_link().close()
    link = signer.open_link()
    link.send(SignatureWanted(1, _TEXT))
    assert isinstance(hear(link), SignatureMade)


def test_garbage_on_the_link_does_not_end_it(signer: SignerProcess) -> None:
    link = signer.open_link()
    os.write(link.fileno(), b"\xff" * 5000)
    again = signer.open_link()
    again.send(SignatureWanted(1, _TEXT))
    assert isinstance(hear(again), SignatureMade)


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda key: key.chmod(0o644), "others may read this private key"),
        (lambda key: key.write_text("rubbish"), "not a private key"),
        (lambda key: key.unlink(), "restore it from a backup"),
    ],
    ids=["readable", "rubbish", "missing"],
)
def test_damaged_key(tmp_path: Path, damage: Any, reason: str) -> None:
    first = SignerProcess(tmp_path)
    hear(first.lifeline)
    first.end()
    damage(tmp_path / KEY_FILE)
    second = SignerProcess(tmp_path)
    failed = hear(second.lifeline)
    assert isinstance(failed, Failed)
    assert reason in failed.reason
    assert str(tmp_path) in failed.reason
    assert second.end() == 1


def test_supervisor_gone(tmp_path: Path) -> None:
    running = SignerProcess(tmp_path)
    hear(running.lifeline)
    running.lifeline.close()
    assert running.process.wait(_LIMIT_SECONDS) == 0


def test_log_and_signer_together(signer: SignerProcess, tmp_path: Path) -> None:
    path = tmp_path / "audit.db"
    link: list[Channel] = []
    log = open_log(
        path,
        checkpoint_every=10,
        signer=lambda number, text, **_: link[0].send(SignatureWanted(number, text)) if link else None,
    )
    for number in range(100):
        log.record(decision(log, number))
        if number % 10 == 9:
            assert settle(log) is None
    settle(log)
    assert verify(path).signed_checkpoints == 0
    link.append(signer.open_link())
    log.request_signatures()
    while verify(path).signed_checkpoints < verify(path).checkpoints:
        assert select.select([link[0]], [], [], _LIMIT_SECONDS)[0], "no answer"
        for message, _descriptors in link[0].receive():
            assert isinstance(message, SignatureMade)
            log.signed(message.number, message.signature, message.public_key)
        settle(log)
    log.close()
    result = verify(path, signer=tmp_path / "signer")
    assert result.ok, result.findings
    assert result.signed_checkpoints >= 5
    memory = read_signer_memory(tmp_path / "signer", result.log)
    assert memory is not None
    assert memory.hashes
    assert not search(path, Filter(event="signature refused")).entries


async def test_an_unexpected_parser_error_is_a_refusal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class OddError(Exception):
        pass

    def fail(*_arguments: object, **_named: object) -> None:
        raise OddError("something is odd")

    (ours, theirs), (lifeline, child) = socket.socketpair(), socket.socketpair()
    own = Channel(child, Lifeline)
    authority = CertificateAuthority(tmp_path)
    monkeypatch.setattr(authority, "issue", fail)
    signer = Signer(own, tmp_path, load_or_create_key(tmp_path), authority, RetentionLimits())
    running = asyncio.create_task(signer.run())
    supervisor, link = Channel(lifeline, Lifeline), Channel(ours, SignerLink)
    supervisor.send(LinkOpened("control", 0), (theirs.fileno(),))
    theirs.close()
    link.send(CertificateWanted(1, b"x", "a", 1))
    link.send(AuthorityRequest(2))
    heard: list[Any] = []
    both = asyncio.Event()

    def hear_one(message: Any, _descriptors: tuple[int, ...]) -> None:
        heard.append(message)
        if len(heard) == 2:
            both.set()

    link.attach(asyncio.get_running_loop(), hear_one, both.set)
    await asyncio.wait_for(both.wait(), _LIMIT_SECONDS)
    assert isinstance(heard[0], CertificateRefused)
    assert "something is odd" in heard[0].reason
    assert isinstance(heard[1], AuthorityStated)
    supervisor.send(Stop())
    await asyncio.wait_for(running, _LIMIT_SECONDS)
    for one in (own, supervisor, link):
        one.close()


def test_certificates_over_the_link(tmp_path: Path) -> None:
    signer = SignerProcess(tmp_path)
    key = ec.generate_private_key(ec.SECP384R1())
    request = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(x509.Name([]))
        .sign(key, hashes.SHA384())
        .public_bytes(Encoding.PEM)
    )
    try:
        link = signer.open_link()
        link.send(AuthorityRequest(1))
        stated = hear(link)
        assert isinstance(stated, AuthorityStated)
        link.send(CertificateWanted(2, request, "ocu-1", 90))
        made = hear(link)
        assert isinstance(made, CertificateMade)
        root = x509.load_pem_x509_certificate(stated.certificate)
        x509.load_pem_x509_certificate(made.certificate).verify_directly_issued_by(root)
        link.send(RevocationsRequest(3, [RevokedCertificate(made.serial, 1_700_000_000)]))
        revocations = hear(link)
        assert isinstance(revocations, RevocationsMade)
        assert [one.serial_number for one in x509.load_pem_x509_crl(revocations.revocations)] == [
            int(made.serial, 16)
        ]
        link.send(CertificateWanted(4, b"rubbish", "ocu-1", 90))
        refused = hear(link)
        assert isinstance(refused, CertificateRefused)
        assert refused.number == 4
        assert "not a signing request" in refused.reason
    finally:
        assert signer.end() == 0
