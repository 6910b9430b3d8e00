import asyncio
from contextlib import closing
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log import AuditLog
from appliance.audit.proof.copies import signed_checkpoints
from appliance.audit.proof.verification import verify
from appliance.base.clock import wall_ns
from appliance.channel import messages
from appliance.control.links.signer_requests import ReceiptFloor, SignerRequests
from appliance.ipsec.signed_checkpoints import CheckpointMemory
from tests.support.audit import decision
from tests.support.engines import ByHand, let_pass
from tests.support.memory_channel import MemoryChannel, memory_link

_ANY = 1 << 63


def floor(folder: Path, *, waits: bool, reserve: int = 1 << 20) -> ReceiptFloor:
    (folder / "control").mkdir()
    return ReceiptFloor(folder, reserve, holding=waits)


def test_it_follows_the_receipts(tmp_path: Path) -> None:
    waiting = floor(tmp_path, waits=True)
    assert waiting.through() == 0
    waiting.received(812)
    assert waiting.through() == 812


def test_without_the_setting_it_allows_any_record(tmp_path: Path) -> None:
    free = floor(tmp_path, waits=False)
    free.received(812)
    assert free.through() == _ANY


def test_on_a_nearly_full_disk_it_allows_any_record(tmp_path: Path) -> None:
    waiting = floor(tmp_path, waits=True, reserve=1 << 60)
    waiting.received(812)
    assert waiting.through() == _ANY


class _Signer:
    """Signs like the real process: never a checkpoint that precedes a signed one."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        self._memory = CheckpointMemory(folder, wall_ns)
        self._key = Ed25519PrivateKey.generate()

    def serve(self, requests: SignerRequests) -> None:
        ours, theirs = memory_link(messages.SignerLink)
        theirs.attach(
            asyncio.get_running_loop(), lambda message, _: self._sign(theirs, message), lambda: None
        )
        requests.attach(ours)

    def _sign(self, link: MemoryChannel, wanted: messages.SignatureWanted) -> None:
        self._memory.accept(wanted.text)
        public = self._key.public_key().public_bytes_raw()
        link.send(messages.SignatureMade(wanted.number, self._key.sign(wanted.text), public))


@pytest.mark.anyio
@pytest.mark.parametrize("sealed_before", [1, 3])
async def test_a_checkpoint_that_is_made_while_the_signer_connects_waits_for_earlier_ones(
    tmp_path: Path, sealed_before: int
) -> None:
    requests = SignerRequests(lambda: log)
    log = AuditLog(tmp_path / "audit.db", drive=ByHand, signer=requests.want, checkpoint_seconds=1e6)
    with closing(log):
        for number in range(sealed_before):
            log.record(decision(log, number))
            let_pass(log, 1)
            log.housekeeping.attempt(log.housekeeping.seal)
        await asyncio.sleep(0)
        signer = _Signer(tmp_path / "signer")
        signer.serve(requests)  # it asks the log's thread for all signatures, which seals first
        log.housekeeping.attempt(log.housekeeping.seal)
        for _ in range(3):
            await asyncio.sleep(1)
            let_pass(log, 1)
        log.housekeeping.attempt(log.housekeeping.seal)
        await asyncio.sleep(1)
        let_pass(log, 1)
    checkpoints = signed_checkpoints(tmp_path / "audit.db", 0, 100)
    assert [checkpoint.number for checkpoint in checkpoints] == [*range(1, sealed_before + 3)]
    assert verify(tmp_path / "audit.db", signer=tmp_path / "signer").findings == []
