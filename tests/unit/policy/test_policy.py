import ipaddress
import re
from dataclasses import replace

import pytest

from appliance.policy.commands import COMMANDS, DECIDED_ELSEWHERE, NAMED_ONLY
from appliance.policy.model import Address, Category, Decision, Request, text_for_caller
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.rights import decide, rights_of

FIGURE = """
[Groups]
localhost = 127.0.0.1
certikos = 10.0.0.1 10.0.0.2, 10.0.0.3
ocu = 10.0.0.5
[Nodes]
default=localhost
/landshark_radar=certikos
/ocu = ocu
[Publishers]
default=localhost certikos
/landshark_control/trigger= ocu
[Subscribers]
default = localhost certikos
/landshark/gps = ocu
[Commands]
# Commands: full access
getSystemState = localhost certikos ocu
lookupNode = localhost certikos
shutdown = localhost
"""


def compiled(text: str, **given: object) -> Policy:
    return compile_policy(text, file="p.ini", **given)  # type: ignore[arg-type]  # forwarded as given


def ask(policy: Policy, host: str, category: str, resource: str, caller_id: str = "/n") -> Decision:
    return policy.decide(Request(ipaddress.ip_address(host), caller_id, Category(category), resource))


@pytest.mark.parametrize("host", ["10.0.0.9", "2001:db8::9", "127.0.0.1"])
def test_the_error_of_a_denied_host_names_no_other_host(host: str) -> None:
    people = "10.0.0.1 10.7.0.0/16 2001:db8::/40 host:bot robot"
    text = f"""
[Groups]
few = {people}
[Nodes]
/a = {people}
/b = few
[Publishers]
/a = few, host:bot
/b =
[Parameters]
read /a = few
read /a/b = host:bot
write default = robot
[Commands]
default = few
"""
    policy = compiled(
        text, hosts={"bot": ipaddress.ip_address("10.9.9.9")}, robot=[ipaddress.ip_address("10.8.8.8")]
    )
    denied = 0
    for category in Category:
        for resource in ("/a", "/b", "/c", "/a/b", "shutdown", "getPid", "nonsense"):
            request = Request(ipaddress.ip_address(host), "/b", category, resource)
            for decision in (policy.decide(request), decide(policy, rights_of(request))):
                if decision.allowed:
                    continue
                denied += 1
                told = text_for_caller(decision, policy.tell).replace(host, "")
                assert not re.search(r"[0-9]+\.[0-9]+\.[0-9]+|2001:|few|bot|robot", told), told
                assert text_for_caller(decision, "full") == decision.reason
                assert text_for_caller(decision, "id") == "denied"
    assert denied > 20


def test_denial_names_who_may_and_the_rule() -> None:
    decision = ask(compiled(FIGURE), "10.0.0.9", "publish", "/landshark_control/trigger")
    assert decision.reason == (
        "10.0.0.9 is not among the hosts that may publish /landshark_control/trigger: "
        "only ocu (10.0.0.5) may, by [Publishers] /landshark_control/trigger (p.ini:12)"
    )
    assert decision.rule is not None
    assert (decision.rule.section, decision.rule.key, decision.rule.line) == (
        "Publishers",
        "/landshark_control/trigger",
        12,
    )


def test_reason_stays_short_and_keeps_the_place() -> None:
    name = "/" + "n" * 900
    text = (
        f"[Groups]\n{'g' * 500} = ::1\n[Parameters]\nwrite {name} = {'g' * 500} host:{'h' * 200} fd00::/16\n"
    )
    policy = compile_policy(text, file="d/" + "f" * 300 + ".ini")
    host = "fd01:1111:2222:3333:4444:5555:6666:7777"
    for decision in (
        ask(policy, host, "write", name),
        policy.decide_parameter(
            Request(ipaddress.ip_address("::1"), "/n", Category.WRITE, "/"), namespace=False
        ),
        ask(policy, host, "write", name + "x"),
        ask(policy, host, "command", "x" * 900),
        ask(policy, host, "publish", "\x00" * 900),
        ask(policy, host, "read", name),
    ):
        assert len(decision.reason) < 300
    assert ask(policy, host, "write", name).reason.endswith(":4)")


def test_an_empty_value_denies_all_hosts() -> None:
    decision = ask(compiled("[Publishers]\ndefault = *\n/cmd =\n"), "10.0.0.1", "publish", "/cmd")
    assert not decision.allowed
    assert "no host may" in decision.reason


def test_robot_and_enrolled_hosts_come_from_outside() -> None:
    text = "[Nodes]\ndefault = robot host:ocu-1 host:gone\n"
    given_hosts: dict[str, Address] = {"ocu-1": ipaddress.ip_address("10.77.0.11")}
    policy = compiled(text, hosts=given_hosts, robot=[ipaddress.ip_address("172.17.0.1")])
    assert ask(policy, "172.17.0.1", "node", "/n").allowed
    assert ask(policy, "10.77.0.11", "node", "/n").allowed
    assert not ask(policy, "10.77.0.12", "node", "/n").allowed
    assert [(w.line, w.column) for w in policy.warnings if '"gone"' in w.text] == [(2, 28)]


def test_a_door_is_a_host_of_a_group() -> None:
    text = "[Groups]\nalice = door:alice door:gone\n[Nodes]\ndefault = alice\n"
    given: dict[str, Address] = {
        "door:alice": ipaddress.ip_address("198.18.0.2"),
        "alice": ipaddress.ip_address("10.77.0.11"),
    }
    policy = compiled(text, hosts=given)
    assert ask(policy, "198.18.0.2", "node", "/n").allowed
    assert not ask(policy, "10.77.0.11", "node", "/n").allowed
    assert [(w.line, w.column) for w in policy.warnings if 'no door "gone"' in w.text] == [(2, 20)]


@pytest.mark.parametrize("category", ["node", "publish", "subscribe", "command"])
def test_missing_section_of_the_thesis_denies(category: str) -> None:
    resource = "getPid" if category == "command" else "/x"
    decision = ask(compiled("[Groups]\n"), "127.0.0.1", category, resource)
    assert not decision.allowed
    assert "has no [" in decision.reason


@pytest.mark.parametrize("category", ["offer", "call", "read", "write"])
def test_missing_extension_keeps_the_behaviour_of_the_thesis(category: str) -> None:
    section = {"offer": "Services", "call": "Clients"}.get(category, "Parameters")
    assert ask(compiled(FIGURE), "10.9.9.9", category, "/x").allowed
    assert Category(category) not in compiled(FIGURE).present
    assert not ask(compiled(f"{FIGURE}[{section}]\n"), "10.9.9.9", category, "/x").allowed


def test_an_unknown_call_is_denied_with_any_default() -> None:
    policy = compiled("[Commands]\ndefault = *\n")
    assert all(ask(policy, "127.0.0.1", "command", name).allowed for name in COMMANDS - NAMED_ONLY)
    for name in ("getparam", "foo", "", "default", *DECIDED_ELSEWHERE):
        assert not ask(policy, "127.0.0.1", "command", name).allowed


@pytest.mark.parametrize(
    "name", ["", "/", "x", "//x", "/x/", "/x\n", "/x y", "~x", "/ä", "/**", "/x/*", "/" + "a" * 2000]
)
def test_name_that_is_not_resolved_is_denied(name: str) -> None:
    policy = compiled("[Nodes]\n/** = *\n[Publishers]\n/** = *\n[Subscribers]\ndefault = *\n")
    assert not any(
        ask(policy, "10.0.0.1", category, name).allowed for category in ("node", "publish", "subscribe")
    )


def test_audit_only_allows_and_reports_would_deny() -> None:
    policy = compiled(f"{FIGURE}[Options]\naudit-only = publishers\n")
    decision = ask(policy, "10.9.9.9", "publish", "/landshark_control/trigger")
    assert (decision.allowed, decision.would_deny) == (True, True)
    assert decision.rule is not None
    assert not ask(policy, "10.9.9.9", "subscribe", "/landshark/gps").allowed
    assert policy.audit_only(Category.PUBLISH)
    assert not policy.audit_only(Category.SUBSCRIBE)


def test_unknown_address_is_known_as_such() -> None:
    policy = compiled(f"[Groups]\nunused = 10.8.8.8\n{FIGURE.replace('[Groups]', '')}")
    assert policy.knows(ipaddress.ip_address("10.0.0.5"))
    assert policy.knows(ipaddress.ip_address("::ffff:10.0.0.5"))
    assert not policy.knows(ipaddress.ip_address("10.8.8.8"))
    assert not policy.knows(ipaddress.ip_address("10.0.0.99"))
    assert compiled("[Clients]\ndefault = *\n").knows(ipaddress.ip_address("10.8.8.8"))


def test_audit_only_serves_every_host_and_still_knows_the_named_ones() -> None:
    unnamed, named = ipaddress.ip_address("10.8.8.8"), ipaddress.ip_address("10.0.0.5")
    policy = compiled("[Nodes]\n/a = 10.0.0.5\n[Options]\naudit-only = Nodes\n")
    assert [(policy.serves(host), policy.knows(host)) for host in (named, unnamed)] == [
        (True, True),
        (True, False),
    ]
    assert policy.counted_as(unnamed) == ""
    empty = compiled("[Options]\naudit-only = all\n")
    assert (empty.serves(unnamed), empty.knows(unnamed)) == (True, True)
    blocked = replace(policy, blocks={unnamed: "blocked"})
    assert not blocked.serves(unnamed)
    assert not compiled("[Nodes]\n/a = 10.0.0.5\n").serves(unnamed)


def test_memory_does_not_grow_with_requests() -> None:
    policy = compiled(FIGURE)
    for number in range(20_000):
        ask(policy, "10.0.0.1", "publish", f"/topic{number}")
    ask(policy, "10.0.0.1", "publish", "/" + "x" * 900)
    for number in range(5_000):
        ask(policy, f"10.1.{number >> 8}.{number & 255}", "publish", "/topic")
    assert len(policy.kept) <= 8192
    assert len(policy.standings) <= 1024
    assert max(len(key[-1]) for key in policy.kept) <= 256


BLOCK = {
    ipaddress.ip_address(
        "10.0.0.5"
    ): "blocked by ann until noon: odd; lift it with `rosrv host unblock 10.0.0.5`"
}


@pytest.mark.parametrize("options", ["", "[Options]\naudit-only = all\n"])
@pytest.mark.parametrize("spelling", ["10.0.0.5", "::ffff:10.0.0.5"])
def test_a_block_denies_every_request_of_its_host_alone(options: str, spelling: str) -> None:
    free = compiled(
        options + "[Nodes]\ndefault=10.0.0.0/24\n[Commands]\ndefault=*\nshutdownMaster=10.0.0.5\n"
    )
    policy = replace(free, blocks=BLOCK)
    asked = [("node", "/n"), ("read", "/p"), ("write", "/"), ("publish", "nonsense")]
    asked += [("command", name) for name in ("getPid", "shutdownMaster", "nonsense")]
    for category, resource in asked:
        decision = ask(policy, spelling, category, resource)
        assert (decision.allowed, decision.would_deny, decision.rule) == (False, False, None)
        assert decision.reason == f"10.0.0.5 is {next(iter(BLOCK.values()))}"
        request = Request(ipaddress.ip_address(spelling), "/n", Category(category), resource)
        assert not decide(policy, rights_of(request)).allowed
        if category in ("read", "write"):
            assert not policy.decide_parameter(request, namespace=True).allowed
        assert ask(policy, "10.0.0.6", category, resource) == ask(free, "10.0.0.6", category, resource)
    assert ask(free, spelling, "command", "getPid").allowed


def test_a_blocked_host_counts_as_unknown() -> None:
    policy = replace(compiled("[Nodes]\ndefault=10.0.0.0/24 10.0.0.5\n"), blocks=BLOCK)
    host, other = ipaddress.ip_address("::ffff:10.0.0.5"), ipaddress.ip_address("10.0.0.6")
    assert (policy.knows(host), policy.names(host), policy.counted_as(host)) == (False, False, "")
    assert (policy.knows(other), policy.names(other), policy.counted_as(other)) == (True, True, "10.0.0.0/24")


@pytest.mark.parametrize(("tell", "told"), [("rule", "is blocked by an operator"), ("id", "denied")])
def test_a_blocked_host_learns_neither_operator_nor_note(tell: str, told: str) -> None:
    policy = replace(compiled("[Nodes]\ndefault=*\n"), blocks=BLOCK)
    decision = ask(policy, "10.0.0.5", "node", "/n")
    assert text_for_caller(decision, tell).removeprefix("10.0.0.5 ") == told
    assert text_for_caller(decision, "full") == decision.reason


@pytest.mark.parametrize("line", ["take base = op ag", "rank base = op > ag"])
def test_a_host_that_must_ask_learns_neither_holder_nor_rank(line: str) -> None:
    text = "[Groups]\nop = 10.0.0.1\nag = 10.0.0.2\n[Publishers]\n/v = op, ask ag\n[Authority]\nbase = /v\n"
    policy = replace(compiled(text + line), holders={"base": ipaddress.ip_address("10.0.0.1")})
    decision = ask(policy, "10.0.0.2", Category.PUBLISH.value, "/v")
    assert decision.asks
    assert "while it" in text_for_caller(decision, "full")
    assert not re.search(r"10\.0\.0\.1|\bop\b", text_for_caller(decision, "rule"))


OWN = [ipaddress.ip_address(text) for text in ("192.168.1.2", "172.17.0.1", "fd00::2")]


def test_the_machines_own_addresses_are_the_robot() -> None:
    policy = compiled("[Publishers]\ndefault = robot\n", robot=[ipaddress.ip_address("10.111.0.1")], own=OWN)
    hosts = {
        "10.111.0.1": True,
        "192.168.1.2": True,
        "fd00::2": True,
        "192.168.1.3": False,
        "172.17.0.2": False,
    }
    assert {host: ask(policy, host, "publish", "/cmd_vel").allowed for host in hosts} == hosts


def test_a_policy_that_names_an_own_address_decides_as_before() -> None:
    text = (
        "[Groups]\nbase = 192.168.1.2\nlab = 172.17.0.0/16\n[Publishers]\ndefault = robot\n/led = base lab\n"
    )
    policy = compiled(text, robot=[ipaddress.ip_address("10.111.0.1")], own=OWN)
    assert ask(policy, "192.168.1.2", "publish", "/led").allowed
    assert not ask(policy, "192.168.1.2", "publish", "/cmd_vel").allowed
    assert ask(policy, "172.17.0.1", "publish", "/cmd_vel").allowed, "named only by its network"
    hosts = compiled(text, hosts={"other": OWN[0]}, robot=[ipaddress.ip_address("10.111.0.1")], own=OWN)
    assert not ask(hosts, "192.168.1.2", "publish", "/cmd_vel").allowed
