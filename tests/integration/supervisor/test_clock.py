import json
import os
import time
from collections.abc import Iterator

import pytest

from appliance.audit.log.log import AuditLog
from appliance.supervisor.clock_sync import clock_is_synchronised
from tests.support.appliance import Appliance
from tests.support.audit import decision, settle
from tests.support.rosmaster import master_at

_HOUR = 3_600_000_000_000


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    with Appliance() as running:
        yield running


def test_the_state_of_the_clock_is_reported(appliance: Appliance) -> None:
    known = clock_is_synchronised()
    status = json.loads(appliance.rosrv("status", "--json").stdout)
    assert status["clock"] == {"synchronised": known, "behind_seconds": 0.0, "before_program_seconds": 0.0}
    value = {None: "-1.0", False: "0.0", True: "1.0"}[known]
    assert f"rosrv_clock_synchronised {value}" in appliance.rest().get("/metrics").body.decode()
    if known is False:
        appliance.recorded("--event", "clock *")
    assert len(appliance.audit("--event", "clock *")) == (known is False)
    assert ("not synchronised" in appliance.rosrv("status").stdout) == (known is False)
    with master_at(appliance.master_uri) as master:
        assert master.setParam("/worker", "/value", 1)[0] == 1


def test_a_clock_that_was_set_back_while_the_appliance_was_off(appliance: Appliance) -> None:
    assert appliance.stop() == 0
    path = appliance.state / "control" / "audit.db"
    owner = path.stat()
    log = AuditLog(path, clock=lambda: time.time_ns() + _HOUR)
    log.record(decision(log))
    settle(log)
    log.close()
    for file in path.parent.glob("audit.db*"):
        os.chown(file, owner.st_uid, owner.st_gid)
    appliance.start()
    (record,) = appliance.recorded("--event", "clock set back")
    assert record["severity"] == "warning"
    assert 3500 < record["detail"]["seconds"] <= 3600
    assert "clock" in appliance.rosrv("status").stdout
    status = json.loads(appliance.rosrv("status", "--json").stdout)
    assert 3400 < status["clock"]["behind_seconds"] <= 3600
    with master_at(appliance.master_uri) as master:
        assert master.setParam("/worker", "/value", 1)[0] == 1
    assert "The log is " in appliance.rosrv("audit", "verify").stdout
