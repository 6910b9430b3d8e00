import asyncio
import os
import socket
import stat
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, closing
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
from appliance.audit.proof.checkpoints import read_signer_memory
from appliance.audit.proof.verification import verify
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.channel.channel import Channel
from appliance.channel.messages import (
    AuthorityRequest,
    AuthorityStated,
    CertificateMade,
    CertificateRefused,
    CertificateWanted,
    Failed,
    Lifeline,
    LinkOpened,
    Message,
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
from appliance.ipsec.signer import KEY_FILE, PUBLIC_KEY_FILE, open_signer, serve
from tests.support.audit import decision
from tests.support.engines import open_log

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("local_sockets")]

_TEXT = (
    f"rosrv audit checkpoint 1\nlog {'a' * 32}\nnumber 1\nsequence 1\nhash {'b' * 64}\ntime 1\nprevious {'0' * 64}\n"
).encode()


@pytest.fixture
async def lifeline(tmp_path: Path, local_sockets: None) -> AsyncIterator[Channel]:
    """Yield the supervisor's end of the lifeline of a signer, which is ready and ends in order."""
    (tmp_path / "signer").mkdir(mode=0o700)
    ours, theirs = socket.socketpair()
    lifeline = Channel(ours, Lifeline)
    signer = open_signer(Channel(theirs, Lifeline), tmp_path / "signer")
    running = asyncio.create_task(signer.run())
    assert [type(message) for message in await heard_from(lifeline)] == [Ready]
    yield lifeline
    lifeline.send(Stop())
    await running
    lifeline.close()
    theirs.close()


async def heard_from(channel: Channel) -> list[Any]:
    loop, readable = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(channel.fileno(), readable.set)
    await readable.wait()
    loop.remove_reader(channel.fileno())
    return [message for message, _descriptors in channel.receive()]


@pytest.fixture
def new_link(lifeline: Channel) -> Iterator[Callable[[], Channel]]:
    with ExitStack() as opened:

        def new_link() -> Channel:
            ours, theirs = socket.socketpair()
            lifeline.send(LinkOpened(role="control", index=0), (theirs.fileno(),))
            theirs.close()
            return opened.enter_context(closing(Channel(ours, SignerLink)))

        yield new_link


@pytest.fixture
def link(new_link: Callable[[], Channel]) -> Channel:
    return new_link()


async def asked(link: Channel, message: Message) -> Any:
    link.send(message)
    [answer] = await heard_from(link)
    return answer


def run_once(directory: Path, *, orders: tuple[Message, ...] = (Stop(),)) -> tuple[Any, int]:
    """Return what a signer says that gets some orders and then loses its supervisor, and its exit status."""
    ours, theirs = socket.socketpair()
    lifeline, mask, status = Channel(ours, Lifeline), os.umask(0o022), 0
    for order in orders:
        lifeline.send(order)
    ours.shutdown(socket.SHUT_WR)
    try:
        serve(theirs.detach(), directory)
    except SystemExit as ended:
        status = int(ended.code or 0)
    finally:
        os.umask(mask)
    ((message, _descriptors),) = lifeline.receive()
    lifeline.close()
    return message, status


async def test_answers_pings(lifeline: Channel) -> None:
    assert await asked(lifeline, Ping(7)) == Pong(7)


def test_key_is_made_once_and_private(tmp_path: Path) -> None:
    keys = [run_once(tmp_path)[0].detail["public_key"] for _life in range(2)]
    assert keys[0] == keys[1] == read_public_key(tmp_path / PUBLIC_KEY_FILE).hex()
    assert stat.S_IMODE((tmp_path / KEY_FILE).stat().st_mode) == 0o600


async def test_signs_a_checkpoint(link: Channel) -> None:
    made = await asked(link, SignatureWanted(1, _TEXT))
    assert isinstance(made, SignatureMade)
    key = Ed25519PublicKey.from_public_bytes(made.public_key)
    key.verify(made.signature, _TEXT)
    with pytest.raises(InvalidSignature):
        key.verify(made.signature, _TEXT + b" ")


async def test_signs_nothing_else(link: Channel) -> None:
    refused = await asked(link, SignatureWanted(1, b"a certificate for me, please"))
    assert refused == SignatureRefused(1, "the data to sign is not an audit checkpoint")
    assert isinstance(await asked(link, SignatureWanted(1, _TEXT)), SignatureMade)
    other = await asked(link, SignatureWanted(1, _TEXT.replace(b"time 1", b"time 2")))
    assert "another checkpoint 1" in other.reason


async def test_new_link_replaces_the_old(link: Channel, new_link: Callable[[], Channel]) -> None:
    link.close()
    assert isinstance(await asked(new_link(), SignatureWanted(1, _TEXT)), SignatureMade)


async def test_garbage_on_the_link_does_not_end_it(link: Channel, new_link: Callable[[], Channel]) -> None:
    os.write(link.fileno(), b"\xff" * 5000)
    assert isinstance(await asked(new_link(), SignatureWanted(1, _TEXT)), SignatureMade)


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda key: key.chmod(0o644), "others may read this private key"),
        (lambda key: key.write_text("rubbish"), "not a private key"),
        (lambda key: key.unlink(), "restore it from a backup"),
    ],
    ids=["readable", "rubbish", "missing"],
)
def test_damaged_key(tmp_path: Path, damage: Callable[[Path], object], reason: str) -> None:
    run_once(tmp_path)
    damage(tmp_path / KEY_FILE)
    failed, status = run_once(tmp_path)
    assert isinstance(failed, Failed)
    assert reason in failed.reason
    assert str(tmp_path) in failed.reason
    assert status == 1


def test_supervisor_gone(tmp_path: Path) -> None:
    ready, status = run_once(tmp_path, orders=())
    assert isinstance(ready, Ready)
    assert status == 0


async def test_log_and_signer_together(new_link: Callable[[], Channel], tmp_path: Path) -> None:
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
            assert await log.wait_durable() is None
    await log.wait_durable()
    assert verify(path).signed_checkpoints == 0
    link.append(new_link())
    log.request_signatures()
    while verify(path).signed_checkpoints < verify(path).checkpoints:
        for message in await heard_from(link[0]):
            assert isinstance(message, SignatureMade)
            log.store_signature(message.number, message.signature, message.public_key)
        await log.wait_durable()
    log.close()
    result = verify(path, signer=tmp_path / "signer")
    assert result.ok, result.findings
    assert result.signed_checkpoints >= 5
    memory = read_signer_memory(tmp_path / "signer", result.log)
    assert memory is not None
    assert memory.hashes
    assert not search(path, Filter(event="signature refused")).entries


async def test_an_unexpected_parser_error_is_a_refusal(
    link: Channel, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_arguments: object, **_named: object) -> None:
        raise RuntimeError("something is odd")

    monkeypatch.setattr(CertificateAuthority, "issue", fail)
    refused = await asked(link, CertificateWanted(1, b"x", "a", 1))
    assert isinstance(refused, CertificateRefused)
    assert "something is odd" in refused.reason
    assert isinstance(await asked(link, AuthorityRequest(2)), AuthorityStated)


async def test_certificates_over_the_link(link: Channel) -> None:
    key = ec.generate_private_key(ec.SECP384R1())
    request = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(x509.Name([]))
        .sign(key, hashes.SHA384())
        .public_bytes(Encoding.PEM)
    )
    stated = await asked(link, AuthorityRequest(1))
    assert isinstance(stated, AuthorityStated)
    made = await asked(link, CertificateWanted(2, request, "ocu-1", 90))
    assert isinstance(made, CertificateMade)
    root = x509.load_pem_x509_certificate(stated.certificate)
    x509.load_pem_x509_certificate(made.certificate).verify_directly_issued_by(root)
    revoked = [RevokedCertificate(made.serial, 1_700_000_000)]
    revocations = await asked(link, RevocationsRequest(3, revoked))
    assert isinstance(revocations, RevocationsMade)
    listed = x509.load_pem_x509_crl(revocations.revocations)
    assert [entry.serial_number for entry in listed] == [int(made.serial, 16)]
    refused = await asked(link, CertificateWanted(4, b"rubbish", "ocu-1", 90))
    assert isinstance(refused, CertificateRefused)
    assert refused.number == 4
    assert "not a signing request" in refused.reason
