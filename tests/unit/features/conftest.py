from pathlib import Path

import pytest

from tests.support.certificates import Certificates, make_certificates
from tests.unit.audit.conftest import MakeLog, Notary, key, make_log, notary

__all__ = ["MakeLog", "Notary", "key", "make_log", "notary"]  # fixtures and their types


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "audit.db"


@pytest.fixture
def certificates(tmp_path: Path) -> Certificates:
    return make_certificates(tmp_path / "tls")
