from pathlib import Path

import pytest

from appliance.control.rest.rest_certificate import RestCertificate
from appliance.store.state_file import StateStore
from tests.support.control_parts import Records
from tests.support.engines import InlineDatabase


def test_a_replaced_certificate_is_recorded_once(tmp_path: Path) -> None:
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    records = Records()

    def state(appliance: str, sha256: str) -> int:
        RestCertificate(store, records, appliance).stated(sha256)
        return len(records.pairs)

    first, second = "a" * 64, "b" * 64
    assert [state("a", first), state("a", first), state("b", second), state("a", ""), state("a", first)] == [
        0
    ] * 5
    assert [state("a", second), state("a", second), state("b", second)] == [1] * 3
    assert records.pairs == [("rest certificate replaced", None)]
    store.close()
