"""Deciding requests by a compiled policy."""

import ipaddress
import re

import pytest

from appliance.policy.commands import COMMANDS, DECIDED_ELSEWHERE, NAMED_ONLY
from appliance.policy.model import Address, Category, Decision, Request, told_of
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
    """A policy from text."""
    return compile_policy(text, file="p.ini", **given)  # type: ignore[arg-type]  # forwarded as given


def ask(policy: Policy, host: str, category: str, resource: str, caller_id: str = "/n") -> Decision:
    """The decision on one request."""
    return policy.decide(Request(ipaddress.ip_address(host), caller_id, Category(category), resource))


def test_figure_of_the_thesis_decides_as_the_thesis_says() -> None:
    """Only ocu may publish the trigger topic; an exact key takes the right of everybody it does not name."""
    policy = compiled(FIGURE)
    trigger = "/landshark_control/trigger"
    assert ask(policy, "10.0.0.5", "publish", trigger).allowed
    assert not ask(policy, "127.0.0.1", "publish", trigger).allowed
    assert ask(policy, "127.0.0.1", "publish", "/anything").allowed
    assert not ask(policy, "10.0.0.5", "publish", "/anything").allowed
    assert ask(policy, "10.0.0.2", "node", "/landshark_radar").allowed
    assert not ask(policy, "127.0.0.1", "node", "/landshark_radar").allowed
    assert ask(policy, "10.0.0.5", "command", "getSystemState").allowed
    assert not ask(policy, "10.0.0.5", "command", "shutdown").allowed


@pytest.mark.parametrize("host", ["10.0.0.9", "2001:db8::9", "127.0.0.1"])
def test_what_a_denied_host_is_told_names_nobody_else(host: str) -> None:
    """By default no text for a denied host has an address or a host's name but its own, whatever denies it."""
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
                told = told_of(decision, policy.tell).replace(host, "")
                assert not re.search(r"[0-9]+\.[0-9]+\.[0-9]+|2001:|few|bot|robot", told), told
                assert told_of(decision, "full") == decision.reason
                assert told_of(decision, "id") == "refused"
    assert denied > 20


def test_denial_names_who_may_and_the_rule() -> None:
    """The reason of a denial is a sentence with the host, the deed, who may instead, and file and line."""
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
    """However long names, values and file are, a reason has fewer than 300 characters and ends with the line."""
    name = "/" + "n" * 900
    text = (
        f"[Groups]\n{'g' * 500} = ::1\n[Parameters]\nwrite {name} = {'g' * 500} host:{'h' * 200} fd00::/16\n"
    )
    policy = compile_policy(text, file="d/" + "f" * 300 + ".ini")
    host = "fd01:1111:2222:3333:4444:5555:6666:7777"
    for decision in (
        ask(policy, host, "write", name),
        ask_parameter(policy, "::1", "/"),
        ask(policy, host, "write", name + "x"),
        ask(policy, host, "command", "x" * 900),
        ask(policy, host, "publish", "\x00" * 900),
        ask(policy, host, "read", name),
    ):
        assert len(decision.reason) < 300
    assert ask(policy, host, "write", name).reason.endswith(":4)")


def test_name_is_not_a_prefix() -> None:
    """A key /chatter says nothing of /chatter2 nor of /chatter/x."""
    policy = compiled("[Publishers]\n/chatter = 10.0.0.1\n")
    assert ask(policy, "10.0.0.1", "publish", "/chatter").allowed
    assert not ask(policy, "10.0.0.1", "publish", "/chatter2").allowed
    assert not ask(policy, "10.0.0.1", "publish", "/chatter/x").allowed


PATTERNS = """
[Publishers]
default = 10.0.0.1
/** = 10.0.0.2
/arm* = 10.0.0.3
/arm/** = 10.0.0.4
/arm/* = 10.0.0.5
/arm/joint = 10.0.0.6
/*/state = 10.0.0.7
/hand*/** = 10.0.0.8
/hand*/x/* = 10.0.0.9
"""


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("/leg", "/**"),
        ("/leg/x/y", "/**"),
        ("/arm2", "/arm*"),
        ("/arm", "/arm/**"),
        ("/arm/x", "/arm/*"),
        ("/arm/x/y", "/arm/**"),
        ("/arm/joint", "/arm/joint"),
        ("/leg/state", "/*/state"),
        ("/arm/state", "/arm/*"),
        ("/hand2/x/y", "/hand*/x/*"),
        ("/hand2/x", "/hand*/**"),
        ("/hand2", "/hand*/**"),
    ],
)
def test_most_specific_key_decides_alone(name: str, key: str) -> None:
    """Exact beats pattern, a longer literal beginning a shorter, `*` beats `**`; the others are mute."""
    policy = compiled(PATTERNS)
    granted = [n for n in range(1, 10) if ask(policy, f"10.0.0.{n}", "publish", name).allowed]
    decision = ask(policy, "10.9.9.9", "publish", name)
    assert decision.rule is not None
    assert decision.rule.key == key
    assert len(granted) == 1


def test_empty_value_grants_nobody() -> None:
    """A key without a value denies everybody, and says so."""
    decision = ask(compiled("[Publishers]\ndefault = *\n/cmd =\n"), "10.0.0.1", "publish", "/cmd")
    assert not decision.allowed
    assert "nobody may" in decision.reason


def test_ipv4_mapped_address_is_the_ipv4_address() -> None:
    """A host that arrives as ::ffff:10.0.0.5 has the rights of 10.0.0.5, and a rule may write it so too."""
    policy = compiled("[Publishers]\n/a = 10.0.0.5\n/b = ::ffff:10.0.0.5\n/c = ::ffff:10.0.0.0/104\n")
    assert all(ask(policy, "::ffff:10.0.0.5", "publish", name).allowed for name in ("/a", "/b", "/c"))
    assert all(ask(policy, "10.0.0.5", "publish", name).allowed for name in ("/a", "/b", "/c"))


def test_networks_ipv6_and_star() -> None:
    """Values may be CIDR networks of both families; `*` is every host."""
    policy = compiled("[Publishers]\n/v4 = 10.77.0.0/24\n/v6 = fd00:77::/64\n/all = *\n")
    assert ask(policy, "10.77.0.200", "publish", "/v4").allowed
    assert not ask(policy, "10.77.1.1", "publish", "/v4").allowed
    assert ask(policy, "fd00:77::9", "publish", "/v6").allowed
    assert not ask(policy, "fd00:78::9", "publish", "/v6").allowed
    assert not ask(policy, "fd00:77::9", "publish", "/v4").allowed
    assert ask(policy, "fd00:1::9", "publish", "/all").allowed


def test_groups_nest_and_may_be_defined_later() -> None:
    """A group may name groups that stand below it in the file."""
    policy = compiled(
        "[Groups]\nall = a b\na = 10.0.0.1\nb = 10.0.1.0/24 c\nc = 10.0.2.1\n[Nodes]\ndefault = all\n"
    )
    assert all(ask(policy, host, "node", "/n").allowed for host in ("10.0.0.1", "10.0.1.9", "10.0.2.1"))
    assert not ask(policy, "10.0.2.2", "node", "/n").allowed


def test_robot_and_enrolled_hosts_come_from_outside() -> None:
    """`robot` and host:NAME are the addresses the caller gives; a name that is not enrolled means no host."""
    text = "[Nodes]\ndefault = robot host:ocu-1 host:gone\n"
    given_hosts: dict[str, Address] = {"ocu-1": ipaddress.ip_address("10.77.0.11")}
    policy = compiled(text, hosts=given_hosts, robot=[ipaddress.ip_address("172.17.0.1")])
    assert ask(policy, "172.17.0.1", "node", "/n").allowed
    assert ask(policy, "10.77.0.11", "node", "/n").allowed
    assert not ask(policy, "10.77.0.12", "node", "/n").allowed
    assert [(w.line, w.column) for w in policy.warnings if '"gone"' in w.text] == [(2, 28)]


@pytest.mark.parametrize("category", ["node", "publish", "subscribe", "command"])
def test_missing_section_of_the_thesis_denies(category: str) -> None:
    """Without its section a category of the thesis grants nothing."""
    resource = "getPid" if category == "command" else "/x"
    decision = ask(compiled("[Groups]\n"), "127.0.0.1", category, resource)
    assert not decision.allowed
    assert "has no [" in decision.reason


@pytest.mark.parametrize("category", ["offer", "call", "read", "write"])
def test_missing_extension_leaves_the_thesis_behaviour(category: str) -> None:
    """Without [Services], [Clients], [Parameters] every host may; with an empty one nobody may."""
    section = {"offer": "Services", "call": "Clients"}.get(category, "Parameters")
    assert ask(compiled(FIGURE), "10.9.9.9", category, "/x").allowed
    assert not compiled(FIGURE).has_section(Category(category))
    assert not ask(compiled(f"{FIGURE}[{section}]\n"), "10.9.9.9", category, "/x").allowed


@pytest.mark.parametrize("command", sorted(NAMED_ONLY))
def test_default_never_grants_what_ends_or_uncovers_the_appliance(command: str) -> None:
    """shutdownMaster and getRVState need a key of their own, even in audit-only mode."""
    everything = "[Commands]\ndefault = *\n[Options]\naudit-only = all\n"
    assert not ask(compiled(everything), "127.0.0.1", "command", command).allowed
    assert not ask(
        compiled(
            f"{everything}[Commands]\n{command} = 10.0.0.1\n".replace("[Commands]\ndefault = *\n", "", 1)
        ),
        "127.0.0.1",
        "command",
        command,
    ).allowed
    assert ask(compiled(f"[Commands]\n{command} = 127.0.0.1\n"), "127.0.0.1", "command", command).allowed


def test_unknown_call_is_denied_whatever_default_says() -> None:
    """A call that is in no table is not granted by `default = *`, nor one that other sections decide."""
    policy = compiled("[Commands]\ndefault = *\n")
    assert all(ask(policy, "127.0.0.1", "command", name).allowed for name in COMMANDS - NAMED_ONLY)
    for name in ("getparam", "foo", "", "default", *DECIDED_ELSEWHERE):
        assert not ask(policy, "127.0.0.1", "command", name).allowed


def test_calls_of_the_server_have_their_wire_name_too() -> None:
    """system.listMethods and listMethods are one command, in the file and in a request."""
    for written in ("listMethods", "system.listMethods"):
        policy = compiled(f"[Commands]\n{written} = 10.0.0.1\n")
        assert ask(policy, "10.0.0.1", "command", "system.listMethods").allowed
        assert ask(policy, "10.0.0.1", "command", "listMethods").allowed


@pytest.mark.parametrize(
    "name", ["", "/", "x", "//x", "/x/", "/x\n", "/x y", "~x", "/ä", "/**", "/x/*", "/" + "a" * 2000]
)
def test_name_that_is_not_resolved_is_denied(name: str) -> None:
    """No spelling gets past the rules: what is not the one canonical name is denied even by `*`."""
    policy = compiled("[Nodes]\n/** = *\n[Publishers]\n/** = *\n[Subscribers]\ndefault = *\n")
    assert not any(
        ask(policy, "10.0.0.1", category, name).allowed for category in ("node", "publish", "subscribe")
    )


PARAMETERS = """
[Parameters]
read default = *
write default = 10.0.0.1
write /arm/** = 10.0.0.1 10.0.0.2
write /arm/limits/max = 10.0.0.1
write /leg = 10.0.0.2
write /*/secret = 10.0.0.1
"""


def ask_parameter(
    policy: Policy, host: str, key: str, *, namespace: bool = False, verb: str = "write"
) -> Decision:
    """The decision on a parameter call."""
    request = Request(ipaddress.ip_address(host), "/n", Category(verb), key)
    return policy.decide_parameter(request, namespace=namespace)


def test_call_on_a_namespace_needs_the_right_on_everything_in_it() -> None:
    """A rule below the key that denies the host denies the call, and is the rule that is named."""
    policy = compiled(PARAMETERS)
    assert ask(policy, "10.0.0.2", "write", "/arm").allowed
    denied = ask_parameter(policy, "10.0.0.2", "/arm")
    assert not denied.allowed
    assert denied.rule is not None
    assert denied.rule.key == "write /arm/limits/max"
    assert ask_parameter(policy, "10.0.0.1", "/arm").allowed
    assert ask_parameter(policy, "10.0.0.2", "/arm/speed").allowed
    assert not ask_parameter(policy, "10.0.0.2", "/arm/limits").allowed
    assert ask_parameter(policy, "10.0.0.9", "/arm", verb="read").allowed
    assert not ask_parameter(policy, "10.0.0.2", "/").allowed
    assert ask_parameter(policy, "10.0.0.1", "/").rule is not None


def test_subtree_key_counts_against_the_exact_one() -> None:
    """With `write /a` for two hosts and `write /a/**` for one, the other may not touch /a as a whole."""
    policy = compiled("[Parameters]\nwrite /a = 10.0.0.1 10.0.0.2\nwrite /a/** = 10.0.0.1\n")
    assert ask(policy, "10.0.0.2", "write", "/a").allowed
    assert not ask_parameter(policy, "10.0.0.2", "/a").allowed
    assert ask_parameter(policy, "10.0.0.1", "/a").allowed


def test_exact_key_says_nothing_of_what_is_below() -> None:
    """`write /leg` grants the parameter /leg; of a namespace /leg, the keys are decided by default."""
    policy = compiled(PARAMETERS.replace("write /*/secret = 10.0.0.1\n", ""))
    assert ask_parameter(policy, "10.0.0.2", "/leg").allowed
    assert not ask_parameter(policy, "10.0.0.2", "/leg", namespace=True).allowed


def test_star_before_the_end_reaches_below_a_key() -> None:
    """/*/secret denies a call on /leg, but not on /arm, where /arm/** is more specific."""
    policy = compiled(PARAMETERS.replace("write /arm/limits/max = 10.0.0.1\n", ""))
    assert not ask_parameter(policy, "10.0.0.2", "/leg").allowed
    assert ask_parameter(policy, "10.0.0.2", "/arm").allowed


def test_parameter_keys_have_their_own_grammar() -> None:
    """Parameter names from YAML files (dots, dashes, blanks) can be granted and are decided."""
    policy = compiled(
        "[Parameters]\nread /arm/joint-1.left/** = 10.0.0.1\nread /diag/Base Driver = 10.0.0.1\n"
    )
    assert ask(policy, "10.0.0.1", "read", "/arm/joint-1.left/gain").allowed
    assert ask(policy, "10.0.0.1", "read", "/diag/Base Driver").allowed
    assert not ask(policy, "10.0.0.1", "write", "/arm/joint-1.left/gain").allowed


def test_audit_only_lets_pass_and_says_would_deny() -> None:
    """A section in audit-only mode passes what its rules deny, marked; other sections still deny."""
    policy = compiled(f"{FIGURE}[Options]\naudit-only = publishers\n")
    decision = ask(policy, "10.9.9.9", "publish", "/landshark_control/trigger")
    assert (decision.allowed, decision.would_deny) == (True, True)
    assert decision.rule is not None
    assert not ask(policy, "10.9.9.9", "subscribe", "/landshark/gps").allowed
    assert policy.audit_only(Category.PUBLISH)
    assert not policy.audit_only(Category.SUBSCRIBE)


def test_audit_only_passes_unresolved_names_never() -> None:
    """Names outside the grammar and unknown calls stay denied in audit-only mode."""
    policy = compiled("[Options]\naudit-only = all\n")
    assert ask(policy, "10.9.9.9", "publish", "/x").allowed
    assert not any(ask(policy, "10.9.9.9", category, "//x").allowed for category in ("publish", "offer"))
    assert not ask(policy, "10.9.9.9", "command", "foo").allowed


def test_node_rule_is_asked_for_calls_that_make_a_node() -> None:
    """A decision on all rights needs both for publishing, and only its own for reading calls."""
    policy = compiled(FIGURE)

    def both(host: str, node: str, category: str, resource: str) -> Decision:
        request = Request(ipaddress.ip_address(host), node, Category(category), resource)
        return decide(policy, rights_of(request))

    trigger = "/landshark_control/trigger"
    assert both("10.0.0.5", "/ocu", "publish", trigger).allowed
    denied = both("10.0.0.5", "/landshark_radar", "publish", trigger)
    assert not denied.allowed
    assert denied.rule is not None
    assert denied.rule.section == "Nodes"
    assert not both("10.0.0.5", "", "publish", trigger).allowed
    assert both("10.0.0.5", "/any_tool", "command", "getSystemState").allowed


def test_unknown_address_is_known_as_such() -> None:
    """An address no rule names, or only an unused group, is not known; `*` names everybody."""
    policy = compiled(f"[Groups]\nunused = 10.8.8.8\n{FIGURE.replace('[Groups]', '')}")
    assert policy.knows(ipaddress.ip_address("10.0.0.5"))
    assert policy.knows(ipaddress.ip_address("::ffff:10.0.0.5"))
    assert not policy.knows(ipaddress.ip_address("10.8.8.8"))
    assert not policy.knows(ipaddress.ip_address("10.0.0.99"))
    assert compiled("[Clients]\ndefault = *\n").knows(ipaddress.ip_address("10.8.8.8"))
    assert compiled("[Options]\naudit-only = all\n").knows(ipaddress.ip_address("10.8.8.8"))


def test_memory_does_not_grow_with_requests() -> None:
    """Answers are kept for a bounded number of names, and never for long ones."""
    policy = compiled(FIGURE)
    for number in range(20_000):
        ask(policy, "10.0.0.1", "publish", f"/topic{number}")
    ask(policy, "10.0.0.1", "publish", "/" + "x" * 900)
    for number in range(5_000):
        ask(policy, f"10.1.{number >> 8}.{number & 255}", "publish", "/topic")
    assert len(policy.kept) <= 8192
    assert len(policy.hosts.kept) <= 1024
    assert max(len(key[-1]) for key in policy.kept) <= 256
