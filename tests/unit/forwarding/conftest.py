"""What tests of forwarding share: a log that is written, and certificates of a receiver."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log import AuditLog
from tests.support.certificates import Certificates, make_certificates

MakeLog = Callable[..., AuditLog]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where the log of a test is."""
    return tmp_path / "audit.db"


@pytest.fixture
def make_log(path: Path) -> Iterator[MakeLog]:
    """Opens logs at `path` that are signed at once, and closes them after the test."""
    logs: list[AuditLog] = []
    key = Ed25519PrivateKey.generate()
    public = key.public_key().public_bytes_raw()

    def sign(number: int, text: bytes) -> None:
        if logs:  # what a log asks while it is being made is asked again by `request_signatures`
            logs[-1].signed(number, key.sign(text), public)

    def make(**settings: Any) -> AuditLog:
        settings.setdefault("signer", sign)
        logs.append(AuditLog(path, **settings))
        logs[-1].request_signatures()
        return logs[-1]

    yield make
    for log in logs:
        log.close()


@pytest.fixture
def certificates(tmp_path: Path) -> Certificates:
    """Those of a receiver."""
    return make_certificates(tmp_path / "tls")
