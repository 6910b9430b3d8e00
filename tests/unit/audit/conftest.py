"""What tests of the audit log share: a place, a log with a signer that lives in the test, and records."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log import AuditLog

MakeLog = Callable[..., AuditLog]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where the log of a test is."""
    return tmp_path / "audit.db"


@pytest.fixture
def key() -> Ed25519PrivateKey:
    """The key of a test's signer."""
    return Ed25519PrivateKey.generate()


@pytest.fixture
def make_log(path: Path, key: Ed25519PrivateKey) -> Iterator[MakeLog]:
    """Opens logs at `path` that are signed at once, and closes them after the test."""
    logs: list[AuditLog] = []
    public = key.public_key().public_bytes_raw()

    def sign(number: int, text: bytes) -> None:
        if logs:  # what a log asks while it is being made is asked again by `request_signatures`
            logs[-1].signed(number, key.sign(text), public)

    def make(**settings: Any) -> AuditLog:
        settings.setdefault("signer", sign)
        log = AuditLog(path, **settings)
        logs.append(log)
        log.request_signatures()
        return log

    yield make
    for log in logs:
        log.close()
