"""What tests of forwarding share: a log that is written, and certificates of a receiver."""

from pathlib import Path

import pytest

from tests.support.certificates import Certificates, make_certificates
from tests.unit.audit.conftest import MakeLog, Notary, key, make_log, notary

__all__ = ["MakeLog", "Notary", "key", "make_log", "notary"]  # fixtures, and what they are


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where the log of a test is."""
    return tmp_path / "audit.db"


@pytest.fixture
def certificates(tmp_path: Path) -> Certificates:
    """Those of a receiver."""
    return make_certificates(tmp_path / "tls")
