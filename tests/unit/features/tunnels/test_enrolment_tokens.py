from pathlib import Path

import pytest

from appliance.base import clock
from appliance.features.tunnels.enrolment_tokens import BadEnrolmentTokenError, EnrolmentTokens
from appliance.store.host_tables import EnrolmentTokenRow
from appliance.store.state_file import EndRow, StateStore
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase
from tests.support.virtual_clock import VirtualClock

WALL = 1_790_000_000.0
DIGEST = "0f007385b6f9d4b7eeb2748605afe1a984a0a3bfa3f014d09e2a784ce9e5cd1a"  # of 43 times A, by sha256sum


def test_a_token_of_an_earlier_version_enrols_its_host_once(tmp_path: Path) -> None:
    with clock.using(VirtualClock(wall=WALL)):
        store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
        row = EnrolmentTokenRow(
            "ocu", "5c0f3d2b9a11", bytes.fromhex(DIGEST), WALL, WALL + 60.0, "10.99.0.9", 30.0, {}, "ann"
        )
        store.hosts.save_awaited(row)
        store.save_end(EndRow("enrolment", row.name, int((WALL + 60.0) * 1e9), int(WALL * 1e9), 0))
        tokens = EnrolmentTokens(store.hosts, ends_of(store, tmp_path))
        text = f"rosrv-enrol_5c0f3d2b9a11_{'A' * 43}"
        with pytest.raises(BadEnrolmentTokenError):
            tokens.find(text[:-1] + "B", "request", {})
        found = tokens.find(text, "request", {})
        assert found == row
        tokens.use(found, "request", "serial")
        with pytest.raises(BadEnrolmentTokenError):
            tokens.find(text, "another request", {})
