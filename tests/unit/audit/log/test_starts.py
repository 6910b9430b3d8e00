"""A robot that is started again and again beside a guest that floods: what the audit log charges to each of them."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from appliance.audit.log.budget import THE_ROBOT, Budget, DiskGroup, DiskParts, weight
from appliance.audit.log.log import AuditLog
from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.record import AuditRecord
from appliance.base import clock
from appliance.policy.model import Decision, Rule
from appliance.quotas.pool import QuotaClass
from appliance.telemetry.audit_trail import Asker, AuditTrail
from tests.support.engines import ByHand, let_pass

ROBOT, GUEST, UNKNOWN = "127.0.0.1", "10.0.0.66", "10.9.9.9"
NODES, PARAMETERS, TOPICS, STARTS = 100, 20, 5, 20
FREE, FLOOD = 2 << 30, 30_000
RULE = Rule("Publishers", "/node_*", "/etc/rosrv/robot.ini", 31)
ALLOW = Decision(True, RULE, "[Publishers] /node_* lets robot publish")


class Robot:
    """The records of a robot with `NODES` nodes, each of which reads its parameters and registers its topics."""

    def __init__(self, folder: Path) -> None:
        self.budget = Budget(
            lambda host: QuotaClass.UNKNOWN if host == UNKNOWN else QuotaClass.NAMED,
            parts=DiskParts({ROBOT: THE_ROBOT, GUEST: DiskGroup(GUEST)}.get),
        )
        self.log = AuditLog(folder / "audit.db", drive=ByHand, budget=self.budget)
        self.trail = AuditTrail(self.log, strict=False, deny_when_failed=True)
        self.waited = 0.0
        self.written: list[AuditRecord] = []

    def call(self, host: str, caller: str, method: str, resource: str, **asked_of: str) -> None:
        while seconds := self.trail.pause(host):
            self.waited += seconds
            let_pass(self.log, seconds)
        reads = method in {"getParam", "hasParam"}
        category = "command" if asked_of else "publish"
        asker = Asker(host, caller, clock.now_ns())
        self.trail.decided(asker, method, category, resource, ALLOW, reads=reads, **asked_of)

    def start(self, prefix: str) -> None:
        for number in range(NODES):
            name = f"{prefix}/node_{number}"
            for one in range(PARAMETERS):
                self.call(ROBOT, "/roslaunch", "setParam", "setParam", key=f"{name}/gain_{one}")
        for number in range(NODES):
            name = f"{prefix}/node_{number}"
            self.call(ROBOT, name, "getParam", "getParam", key="/use_sim_time")
            for one in range(PARAMETERS):
                self.call(ROBOT, name, "getParam", "getParam", key=f"{name}/gain_{one}")
            for topic in range(TOPICS):
                self.call(ROBOT, name, "registerPublisher", f"{name}/topic_{topic}")
                self.call(ROBOT, name, "registerSubscriber", f"{name}/topic_{topic}")
                self.call(ROBOT, name, "requestTopic", f"{name}/topic_{topic}")
            let_pass(self.log, 0.03)


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    disk = os.statvfs_result((1, 1, 2 * FREE, FREE, FREE, 1000, 1000, 1000, 0, 255))
    monkeypatch.setattr(os, "statvfs", lambda _folder: disk)
    one = Robot(tmp_path)
    let_pass(one.log, 1)

    def append(_writer: ChainWriter, records: Sequence[AuditRecord], _folds: object = ()) -> None:
        one.written += [record for record in records if record.host is not None]

    monkeypatch.setattr(ChainWriter, "append", append)
    yield one
    assert one.log.close() is None


def test_a_robot_that_is_started_again_and_again_never_waits(robot: Robot) -> None:
    """Beside it a guest floods until the guest itself must wait."""
    flood = guest_waits = 0
    for number in range(STARTS):
        while flood < FLOOD and not robot.trail.pause(GUEST):
            flood += 1
            robot.call(GUEST, "/g", "hasParam", "hasParam", key=f"/{flood}" + "k" * 900)
            if not flood % 100:
                let_pass(robot.log, 0.03)
        guest_waits += robot.trail.pause(GUEST) > 0
        robot.start("/r" if number % 2 else "")
        let_pass(robot.log, 5)
    assert robot.waited == 0
    assert guest_waits > STARTS // 2


def test_a_start_is_written_in_few_records(robot: Robot) -> None:
    """All reads of a node are two records: the first in full, and one with the list of all others."""
    robot.start("")
    let_pass(robot.log, 30)
    reads = [one for one in robot.written if str(one.detail.get("call")) == "getParam"]
    own = [read for read in reads if read.detail.get("key") != "/use_sim_time"]
    assert (len(own), len(reads)) == (2 * NODES, 3 * NODES)
    listed = {name for one in own for name in one.detail.get("parameters", {one.detail.get("key"): 1})}
    assert listed == {f"/node_{node}/gain_{one}" for node in range(NODES) for one in range(PARAMETERS)}
    assert sum(map(weight, robot.written)) < 2_500_000
