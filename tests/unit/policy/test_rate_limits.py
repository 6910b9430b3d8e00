import ipaddress

import pytest

from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError
from appliance.policy.rate_limits import NO_LIMIT, LimitScope, Rate
from tests.unit.policy.mistakes import mistakes

HEAD = """[Groups]
guests = 10.0.0.0/24
tablet = 10.0.0.7
[Nodes]
default = *
[Publishers]
default = *
[Subscribers]
default = *
[Commands]
default = *
"""
GUEST, TABLET, ROBOT = (ipaddress.ip_address(one) for one in ("10.0.0.5", "10.0.0.7", "10.1.0.1"))


def policy(*lines: str):  # type: ignore[no-untyped-def]  # what compile_policy gives
    return compile_policy(HEAD + "[Limits]\n" + "\n".join(lines), file="p.ini")


@pytest.mark.parametrize(
    ("line", "part", "host", "rate"),
    [
        ("/camera/** = publisher 30 Hz 10 MB/s", LimitScope.PUBLISHER, GUEST, Rate(30, 10e6)),
        ("/camera/** = publisher 30Hz, 10MB/s", LimitScope.PUBLISHER, GUEST, Rate(30, 10e6)),
        ("/camera/** = publisher 1.5 hz 2 kb/s", LimitScope.PUBLISHER, GUEST, Rate(1.5, 2e3)),
        ("/camera/** = publisher 30 Hz, subscriber tablet 5 Hz", LimitScope.SUBSCRIBER, TABLET, Rate(5)),
        ("/camera/** = publisher 30 Hz, subscriber tablet 5 Hz", LimitScope.SUBSCRIBER, GUEST, NO_LIMIT),
        ("/camera/** = publisher 30 Hz, subscriber tablet 5 Hz", LimitScope.TOPIC, None, NO_LIMIT),
        (
            "/camera/** = subscriber 10 Hz, subscriber guests 1 GB/s 20 Hz",
            LimitScope.SUBSCRIBER,
            TABLET,
            Rate(10, 1e9),
        ),
        ("/camera/** = publisher guests 10.1.0.1 7 Hz", LimitScope.PUBLISHER, ROBOT, Rate(7)),
        ("/camera/** = topic 100 B/s", LimitScope.TOPIC, None, Rate(0, 100)),
        ("default = topic 3 Hz", LimitScope.TOPIC, None, Rate(3)),
        ("/other = topic 3 Hz", LimitScope.TOPIC, None, NO_LIMIT),
    ],
)
def test_a_limit_is_for_messages_or_bytes_of_hosts(
    line: str, part: LimitScope, host: ipaddress.IPv4Address, rate: Rate
) -> None:
    assert policy(line).limit(part, "/camera/front/image", host) == rate


def test_the_most_specific_key_decides_alone() -> None:
    limits = policy(
        "/** = publisher 1 Hz, topic 2 Hz", "/camera/* = publisher 30 Hz", "/camera/left = topic 9 Hz"
    )
    rates = [
        limits.limit(LimitScope.PUBLISHER, name, GUEST) for name in ("/x", "/camera/right", "/camera/left")
    ]
    assert rates == [Rate(1), Rate(30), NO_LIMIT]
    assert limits.limit(LimitScope.TOPIC, "/camera/right") == NO_LIMIT
    assert policy().limit(LimitScope.PUBLISHER, "/x", GUEST) == NO_LIMIT


@pytest.mark.parametrize(("line", "place", "text"), mistakes("limits"))
def test_a_mistake_is_reported_with_its_place(line: str, place: str, text: str) -> None:
    with pytest.raises(PolicyError) as refused:
        policy(line)
    found = [str(finding) for finding in refused.value.findings]
    assert any(
        one.startswith(f"p.ini:{place}: error: ") and text.replace("'", '"') in one for one in found
    ), found


def test_the_number_of_limits_is_bounded() -> None:
    with pytest.raises(PolicyError, match="more than 1000 limits"):
        policy(*(f"/a{number}* = topic 1 Hz" for number in range(1001)))


def test_a_default_that_never_limits_is_a_warning() -> None:
    warnings = [str(warning) for warning in policy("/** = topic 1 Hz", "default = topic 2 Hz").warnings]
    assert [warning for warning in warnings if "group" not in warning and "there is no" not in warning] == [
        "p.ini:14:1: warning: never limits: /** at line 13 matches every name before it"
    ]


def test_a_host_that_only_a_limit_names_is_unknown() -> None:
    text = "[Nodes]\n/a = 10.0.0.1\n[Limits]\n/a = publisher 10.0.0.2 1 Hz\n"
    known = compile_policy(text, file="p.ini")
    assert [known.knows(ipaddress.ip_address(f"10.0.0.{last}")) for last in (1, 2)] == [True, False]


def test_hosts_share_as_the_policy_names_them() -> None:
    known = compile_policy("[Nodes]\n/a = 10.0.0.1 10.1.0.0/16\n", file="p.ini")
    addresses = ("10.0.0.1", "10.1.0.1", "10.1.0.2", "10.9.0.1", "10.9.0.2")
    shared = [known.counted_as(ipaddress.ip_address(address)) for address in addresses]
    assert shared == ["10.0.0.1/32", "10.1.0.0/16", "10.1.0.0/16", "", ""]
