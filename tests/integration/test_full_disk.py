from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from appliance.channel import admin
from appliance.channel.operations import request_named
from appliance.cli.connection.admin_client import AdminSocket
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.small_disk import small_disk
from tests.support.waiting import eventually

RULE = "silent() { event said() /chatter std_msgs/String '{}' { } }\n"
CLOSED = OPEN_POLICY.replace("default = *", "default = 10.9.9.9")
REQUEST = "a signing request"


def of_feature(verb: str, **fields: Any) -> list[admin.AdminRequest[Any]]:
    request = request_named(verb)
    return [] if request is None else [request(**fields)]


ORDERS: tuple[admin.AdminRequest[Any], ...] = (
    admin.PolicyReload(),
    admin.PolicyRollback(1),
    admin.PolicyLoad(CLOSED),
    admin.PolicyConfirm(),
    admin.MonitorLoad({"loud.rv": RULE.replace("silent", "loud")}),
    admin.MonitorReplace("silent", RULE.replace("said", "heard")),
    admin.MonitorReload(),
    admin.MonitorRemove(["silent"]),
    admin.MonitorRollback(1),
    admin.MonitorConfirm(),
    admin.MonitorSwitch(["silent"], False),
    admin.MonitorShadow(["silent"], True),
    admin.MonitorResume(["silent"]),
    admin.MonitorGive("silent", {"limit": 1}),
    *of_feature("alarm acknowledge", kind="none"),
    *of_feature("alarm silence", kind="none"),
    admin.TokenAdd("late", "viewer", 3600.0),
    admin.TokenRotate("guest"),
    *of_feature("host unblock", address="192.0.2.66"),
    *of_feature("host token", name="laptop", endpoint="192.0.2.1"),
    *of_feature("host add", name="laptop", request=REQUEST),
    *of_feature("host enrol", token="rosrv-enrol_none", request=REQUEST, peer="192.0.2.2"),  # noqa: S106  no token
    *of_feature("host renew", name="laptop", request=REQUEST),
    *of_feature("host renew itself", name="laptop", request=REQUEST, proof=b"", peer="192.0.2.2"),
    *of_feature("host renewed", name="laptop", peer="192.0.2.2"),
    *of_feature("host ports", name="192.0.2.3", state="closed"),
    *of_feature("hosts reload"),
    *of_feature("door add", name="alice"),
    *of_feature("door ticket", name="alice", seconds=60.0),
    *of_feature("guard new", preset="deadman", topics={"command": "/cmd_vel"}),
    *of_feature("guard set", name="silent", values={"limit": "1"}),
    *of_feature("guard upgrade", name="silent"),
    *of_feature("driver check", command="/cmd_vel", by="/odom"),
)
UNSTORED = {
    "host block", "host revoke", "token revoke", "record now", "recording memory", "recording remove",
    "standby promote", "door remove", "drive take", "drive give", "drive ask", "sso end", "sso sign out",
    "door visit", "approve", "approval refuse", "guard try", "guard test",
}  # fmt: skip
LOOKS: tuple[admin.AdminRequest[Any], ...] = (
    admin.PolicyRevisions(), admin.MonitorRevisions(), admin.MonitorsWanted(True), admin.TokenList(),
    *of_feature("host blocks"), *of_feature("host list"),
)  # fmt: skip


class SmallDisk:
    def __init__(self, appliance: Appliance) -> None:
        self.appliance = appliance
        self.filler = appliance.state / "filler"

    def ask(self, request: admin.AdminRequest[Any]) -> admin.AdminAnswer[Any]:
        return AdminSocket(self.appliance.state).ask(request)

    def fill(self) -> None:
        with self.filler.open("wb", buffering=0) as file, pytest.raises(OSError, match="No space"):
            while True:
                file.write(bytes(1 << 16))

    def revoked(self) -> set[str]:
        known = self.ask(admin.TokenList()).body
        return {token.name for token in known.tokens if token.revoked is not None} if known else set()

    def all(self) -> list[object]:
        return [msgspec.to_builtins(self.ask(look).body) for look in LOOKS]


@pytest.fixture
def small() -> Iterator[SmallDisk]:
    appliance = Appliance()
    try:
        with small_disk(appliance.state, "32m", "mode=755"):
            appliance.start()
            disk = SmallDisk(appliance)
            assert disk.ask(admin.TokenAdd("guest", "viewer", 3600.0)).ok
            loaded = disk.ask(admin.MonitorLoad({"silent.rv": RULE}))
            assert loaded.ok, loaded.findings
            yield disk
            appliance.stop()
    finally:
        appliance.close()


def test_a_change_that_cannot_be_stored_has_no_effect(small: SmallDisk) -> None:
    before = small.all()
    small.fill()
    for order in ORDERS:
        answer = small.ask(order)
        assert (answer.ok, answer.trouble) == (False, "failed"), order
        assert answer.error is not None
        assert "nothing was changed: free space" in answer.error, order
    assert small.all() == before
    small.filler.unlink()
    stored: tuple[admin.AdminRequest[Any], ...] = (
        admin.TokenAdd("late", "viewer", 3600.0),
        admin.PolicyLoad(CLOSED),
        *of_feature("host ports", name="192.0.2.3", state="open"),
    )
    for order in stored:
        assert small.ask(order).ok, order
    after = small.all()
    small.appliance.kill("control")
    assert eventually(lambda: small.all() or None, small.appliance.story) == after


def test_a_revocation_is_effective_even_if_it_cannot_be_stored(small: SmallDisk) -> None:
    small.fill()
    answer = small.ask(admin.TokenRevoke("guest"))
    assert answer.error is not None
    assert "free space: until then a restart undoes recent changes" in answer.error
    assert small.revoked() == {"guest"}
    small.filler.unlink()
    eventually(lambda: small.ask(admin.TokenAdd("late", "viewer", 3600.0)).ok, small.appliance.story)
    small.appliance.kill("control")
    assert eventually(small.revoked, small.appliance.story) == {"guest"}
