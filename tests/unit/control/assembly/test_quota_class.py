import ipaddress
from dataclasses import replace

from appliance.audit.log.budget import Budget, DiskParts
from appliance.base.actors import APPLIANCE, ROBOT, UNKNOWN
from appliance.control.assembly.listener_limits import HostQuotaClass
from appliance.control.assembly.robot import charged_to
from appliance.policy.policy import CurrentPolicy, Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.quotas.pool import QuotaClass

NAMED, OTHER = ipaddress.ip_address("10.0.0.1"), ipaddress.ip_address("10.0.0.2")


def in_force(policy: Policy) -> CurrentPolicy:
    current = CurrentPolicy()
    current.set(policy)
    return current


def test_the_class_follows_reloads_and_registrations() -> None:
    policies = [
        compile_policy("[Nodes]\n/a = 10.0.0.1\n", file="a.ini"),
        compile_policy("[Nodes]\n/a = 10.0.0.2\n", file="b.ini"),
    ]
    registered = dict[object, int]()
    current = in_force(policies[0])
    quota_class = HostQuotaClass(current, lambda host: registered.get(host, 0))
    assert (quota_class(NAMED), quota_class(OTHER)) == (QuotaClass.NAMED, QuotaClass.UNKNOWN)
    registered[OTHER] = 1
    assert quota_class(OTHER) is QuotaClass.UNKNOWN  # in audit-only mode any host can register
    current.set(policies[1])
    assert (quota_class(NAMED), quota_class(OTHER)) == (QuotaClass.UNKNOWN, QuotaClass.REGISTERED)
    registered.clear()
    assert quota_class(OTHER) is QuotaClass.NAMED
    assert quota_class(ipaddress.ip_address("127.0.0.1")) is QuotaClass.NAMED


def test_acts_are_charged_by_the_policys_names() -> None:
    policy = compile_policy(
        "[Nodes]\n/a = robot 10.0.0.9 10.1.0.0/16\n", file="p.ini", robot=[ipaddress.ip_address("172.17.0.1")]
    )
    hosts = ("172.17.0.1", "127.0.0.1", "10.0.0.9", "10.1.2.3", "10.9.9.9", "")
    assert [charged_to(policy, host) for host in hosts] == [
        ROBOT, ROBOT, "10.0.0.9", "10.1.0.0/16", UNKNOWN, APPLIANCE,
    ]  # fmt: skip


def test_a_blocked_host_is_unknown() -> None:
    policy = replace(
        compile_policy("[Nodes]\n/a = 10.0.0.1 10.0.0.2\n", file="a.ini"), blocks={NAMED: "blocked"}
    )
    quota_class = HostQuotaClass(in_force(policy), lambda _host: 0)
    assert (quota_class(NAMED), quota_class(OTHER)) == (QuotaClass.UNKNOWN, QuotaClass.NAMED)
    assert (quota_class.of_text("10.0.0.1"), charged_to(policy, "10.0.0.1")) == (QuotaClass.UNKNOWN, UNKNOWN)


def test_the_last_of_the_disk_is_for_named_hosts_also_after_a_restart() -> None:
    rules = "[Groups]\nocus = 10.2.0.0/24\n[Nodes]\n/a = 10.0.0.1 ocus\ndefault = *\n"
    policy = compile_policy(rules, file="a.ini", robot=[ipaddress.ip_address("172.17.0.1")])
    registered: dict[object, int] = {ipaddress.ip_address("10.0.0.66"): 1}
    current = CurrentPolicy()
    quota_class = HostQuotaClass(current, lambda host: registered.get(host, 0))
    budget = Budget(quota_class.of_text, parts=DiskParts(quota_class.disk_group))
    budget.room(1)
    assert budget.shut_out("127.0.0.1")
    assert quota_class.of_text("10.0.0.67") is QuotaClass.NAMED
    current.set(policy)
    hosts = ("172.17.0.1", "127.0.0.1", "10.0.0.1", "10.2.0.7", "10.0.0.66", "10.0.0.67", "")
    assert [not budget.shut_out(host) for host in hosts] == [True] * 4 + [False] * 3
    current.set(compile_policy("[Nodes]\ndefault = *\n", file="b.ini", robot=policy.robot))
    assert [not budget.shut_out(host) for host in hosts] == [True, True, False, False, True, False, False]
    current.set(replace(policy, blocks={NAMED: "blocked", ipaddress.ip_address("172.17.0.1"): "blocked"}))
    assert budget.shut_out("10.0.0.1")
    assert budget.shut_out("172.17.0.1")
