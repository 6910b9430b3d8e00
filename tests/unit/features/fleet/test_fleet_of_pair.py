from pathlib import Path
from typing import Any

import pytest

from appliance.features.fleet.control_part import compare_fleets
from appliance.features.fleet.settings import Fleet
from appliance.store.state_file import StateStore
from tests.support.core import FakeTrail
from tests.support.engines import InlineDatabase

FILES: dict[str, Any] = {name: Path(name) for name in ("ca", "certificate", "key", "receipt_key")}
JOINED = Fleet(collector="https://10.0.0.9:8444", robot="arm7", **FILES)
OTHER = Fleet(collector="https://10.0.0.9:8444", robot="arm8", **FILES)


@pytest.mark.parametrize(
    ("takeovers", "alarms"),
    [
        ([("a", JOINED), ("b", JOINED), ("a", JOINED)], 0),
        ([("a", Fleet()), ("b", Fleet())], 0),
        ([("a", JOINED), ("b", Fleet()), ("b", Fleet()), ("b", JOINED)], 2),
        ([("a", JOINED), ("b", OTHER)], 1),
        ([("a", JOINED), ("a", Fleet()), ("b", Fleet())], 0),
    ],
    ids=["both", "none", "one", "as another robot", "left"],
)
def test_an_appliance_that_did_not_join_raises_an_alarm(
    takeovers: list[tuple[str, Fleet]], alarms: int, tmp_path: Path
) -> None:
    store = StateStore(tmp_path, failed=lambda _reason: None, kind=InlineDatabase)
    trail = FakeTrail()
    for name, fleet in takeovers:
        compare_fleets(fleet, store, trail, name=name)
    assert len(trail.records) == alarms
    if alarms == 2:
        assert "rosrv-fleet robot invite arm7 --appliance b" in trail.records[0].reason
