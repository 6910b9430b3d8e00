import ipaddress

import pytest

from appliance.audit.log.budget import Budget
from appliance.features.fleet.bundle_gate import LostRights
from appliance.features.fleet.bundle_health import RobotHealth, counted_denials
from appliance.policy.model import Decision
from appliance.policy.policy_compiler import compile_policy
from appliance.quotas.pool import QuotaClass
from appliance.telemetry.audit_trail import Asker, AuditTrail
from tests.unit.telemetry.test_audit_trail import log_of

ROBOT = "192.168.1.10"
_POLICY = compile_policy(
    "[Publishers]\ndefault = robot 10.0.0.0/24 10.1.0.1 10.1.0.2 10.1.0.3 10.1.0.4 10.1.0.5\n",
    file="policy.ini",
    robot=[ipaddress.ip_address(ROBOT)],
)
_NONE = RobotHealth(0, frozenset(), frozenset())


@pytest.mark.parametrize(
    ("denied", "why"),
    [
        ({"10.0.0.66": 40}, ""), ({"10.0.0.66": 1_000_000, "": 1_000_000}, ""),
        ({f"10.0.0.{number}": 40 for number in range(1, 255)}, ""),
        ({f"10.1.0.{number}": 40 for number in range(1, 4)}, ""),
        ({f"10.1.0.{number}": 40 for number in range(1, 5)}, "12 denials"), ({ROBOT: 10}, ""),
        ({ROBOT: 11}, "11 denials"),
    ],
    ids=["guest", "guest and unknown hosts", "one network", "three hosts", "four hosts", "calm robot", "robot"],
)  # fmt: skip
def test_only_the_robot_or_several_hosts_spoil_a_trial(denied: dict[str, int], why: str) -> None:
    health = _NONE._replace(denials=counted_denials(denied, _POLICY))
    assert health.worse_than(_NONE).startswith(why)
    assert bool(health.worse_than(_NONE)) == bool(why)


def test_other_hosts_hide_no_illness_of_the_robot() -> None:
    noise = {"": 10**6} | {f"10.1.0.{number}": 10**6 for number in range(1, 6)}
    before = _NONE._replace(denials=counted_denials(noise, _POLICY))
    assert _NONE._replace(denials=counted_denials({ROBOT: 37}, _POLICY)).worse_than(before)


def test_denials_are_counted_by_host() -> None:
    log = log_of()
    log.budget = Budget(lambda host: QuotaClass.UNKNOWN if host.startswith("203.") else QuotaClass.NAMED)
    trail = AuditTrail(log, strict=True, deny_when_failed=False)
    for host, allowed in (
        (ROBOT, True),
        ("10.0.0.66", False),
        ("203.0.113.1", False),
        ("203.0.113.2", False),
    ):
        trail.decided(Asker(host, "/n", 0), "c", "publish", "/t", Decision(allowed, None, "why"))
    assert trail.meter.denied_hosts.counts() == {"10.0.0.66": 1, "": 2}


def test_denials_that_the_new_policy_causes_do_not_count() -> None:
    hosts = [f"10.1.0.{number}" for number in range(1, 5)]
    narrower = compile_policy(
        "[Publishers]\ndefault = robot 10.0.0.0/24 10.1.0.1 10.1.0.2 10.1.0.3 10.1.0.4 10.1.0.5\n/stop/* = robot\n",
        file="policy.ini",
        robot=[ipaddress.ip_address(ROBOT)],
    )
    denied = dict.fromkeys(hosts, 40)
    assert counted_denials(denied, narrower, LostRights(_POLICY, narrower).took_from) == 0
    assert counted_denials(denied, _POLICY, LostRights(narrower, _POLICY).took_from) == 12, (
        "a wider policy causes no denial"
    )
    assert counted_denials({ROBOT: 11} | denied, narrower, LostRights(_POLICY, narrower).took_from) == 11


def test_a_right_that_now_needs_an_approval_is_lost() -> None:
    plain, asked = (
        compile_policy(f"[Publishers]\n/cmd_vel = {hosts}\n", file="policy.ini")
        for hosts in (ROBOT, f"ask {ROBOT}")
    )
    assert LostRights(plain, asked).took_from(ipaddress.ip_address(ROBOT))
