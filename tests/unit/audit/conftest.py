import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log import AuditLog
from appliance.base import clock
from appliance.ipsec.signed_checkpoints import CheckpointMemory, CheckpointRefusedError
from appliance.ipsec.signer import RemovalJudge, RemovalRefusedError, RetentionLimits
from tests.support.engines import ByHand
from tests.support.virtual_clock import VirtualClock

MakeLog = Callable[..., AuditLog]


class Notary:
    def __init__(self, directory: Path) -> None:
        directory.mkdir()
        self.directory = directory
        self.ago = 0
        self.kept = RetentionLimits()
        self.refused: Callable[[bool], object] = bool  # records whether age was the reason
        self._signed = CheckpointMemory(directory, clock=self._now)

    def _now(self) -> int:
        return clock.wall_ns() - self.ago

    def sign(self, text: bytes) -> None:
        with contextlib.suppress(CheckpointRefusedError):
            self._signed.accept(text)

    def accept(self, checkpoint: bytes, newest: bytes) -> bytes:
        return RemovalJudge(self._signed, self.kept, clock=self._now).accept(checkpoint, newest)


@pytest.fixture(autouse=True)
def time() -> Iterator[VirtualClock]:
    time = VirtualClock(wall=1_800_000_000)
    with clock.using(time):
        yield time


@pytest.fixture
def notary(tmp_path: Path) -> Notary:
    return Notary(tmp_path / "notary")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "audit.db"


@pytest.fixture
def key() -> Ed25519PrivateKey:
    return Ed25519PrivateKey.generate()


@pytest.fixture
def make_log(path: Path, key: Ed25519PrivateKey, notary: Notary) -> Iterator[MakeLog]:
    logs: list[AuditLog] = []  # the open log
    made: list[AuditLog] = []
    public = key.public_key().public_bytes_raw()

    def sign(number: int, text: bytes, *, oldest: bool = True) -> None:
        if logs:  # requests made by the constructor are repeated by `request_signatures`
            notary.sign(text)
            logs[-1].store_signature(number, key.sign(text), public)

    def accept(number: int, checkpoint: bytes, newest: bytes) -> None:
        if not logs:
            return
        try:
            text = notary.accept(checkpoint, newest)
        except RemovalRefusedError as error:
            logs[-1].removal_refused(number, str(error), early=error.early)
            notary.refused(error.early)
        else:
            logs[-1].removal_signed(number, text, key.sign(text), public)

    def make(**settings: Any) -> AuditLog:
        settings.setdefault("signer", sign)
        settings.setdefault("removals", accept)
        logs.clear()
        if "retention" in settings:
            notary.kept = RetentionLimits(settings["retention"].days, settings["retention"].size)
        log = AuditLog(path, drive=ByHand, **settings)
        logs.append(log)
        made.append(log)
        log.request_signatures()
        return log

    yield make
    for log in made:
        log.close()
