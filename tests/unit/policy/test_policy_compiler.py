import ipaddress
import time

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from appliance.policy.ini_reader import MAXIMUM_CHARACTERS
from appliance.policy.model import TELLS
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import MAXIMUM_FINDINGS, FindingSeverity, PolicyError
from tests.support.examples import examples
from tests.unit.policy.mistakes import mistakes

SAMPLE_OF_ROSRV = """# machine-a: 192.168.15.69
# OCU

[groups]
localhost = 127.0.0.1\x20
certikos = 192.168.15.69 192.168.15.90\x20
ocu = 130.107.95.92 130.107.95.25

[Ports]
range = 19001-20000

[Monitor]
topic = /chatter /landshark_control/base_velocity/hmac /rosout\x20

[Nodes]
default=localhost
/roslaunch=localhost ocu
/rostopic=localhost #ocu
/landshark/gps__monitor__=localhost
/ankh/joystick_teleop=ocu
/Ocu_2D=localhost ocu

[Publishers]
default=localhost certikos
/chatter = localhost ocu
/rosout = localhost certikos ocu

[Subscribers]
default = localhost certikos\x20
#/landshark_waypoint_navigation = localhost certikos ocu
/landshark/gun_camera/compressed = localhost certikos ocu

[Commands]
default = localhost
# Commands: full access
getSystemState = localhost certikos ocu
getRVState = localhost\x20
subscribeParam = localhost certikos ocu
# Commands: local access only
shutdown = localhost
getBusInfo = localhost
"""


def errors_of(text: str) -> list[str]:
    with pytest.raises(PolicyError) as caught:
        compile_policy(text, file="p.ini")
    findings = [f for f in caught.value.findings if f.severity is FindingSeverity.ERROR]
    return [f"{f.line}:{f.column}: {f.text}" for f in findings]


def test_policy_of_the_shape_of_rosrvs_loads() -> None:
    policy = compile_policy(SAMPLE_OF_ROSRV, file="access-policy.cfg")
    assert policy.ports == range(19001, 20001)
    assert policy.monitored_topics == {"/chatter", "/landshark_control/base_velocity/hmac", "/rosout"}


def test_uses_of_a_commented_out_group_are_errors() -> None:
    errors = errors_of(SAMPLE_OF_ROSRV.replace("\nocu =", "\n#ocu ="))
    assert errors[0].startswith('17:22: no group "ocu" is defined')
    assert len(errors) == 8


@pytest.mark.parametrize(("text", "expected"), mistakes("policy"))
def test_a_mistake_is_an_error_with_its_place_and_a_hint(text: str, expected: str) -> None:
    errors = errors_of(text)
    assert len(errors) == 1
    assert errors[0].startswith(expected)


def test_all_mistakes_are_reported_at_once() -> None:
    text = "[Groups]\na = 10.0.0\n[Nodes]\nx = a\n/y = b\n[Commands]\nfoo = a\n[Options]\ntakeover = no\n"
    assert [line.split(":")[0] for line in errors_of(text)] == ["2", "4", "5", "7", "9"]


def test_misspelt_section_is_one_mistake() -> None:
    assert len(errors_of("[Group]\na = ::1\n[Nodes]\ndefault = a\n")) == 1


def test_error_says_file_line_and_column_as_compilers_do() -> None:
    with pytest.raises(PolicyError) as caught:
        compile_policy("[Nodes]\nx = *\n", file="policies/p.ini")
    assert str(caught.value).startswith("policies/p.ini:2:1: error: ")


def test_a_file_beyond_the_limit_is_refused_with_the_limit() -> None:
    errors = errors_of("#" * (MAXIMUM_CHARACTERS + 1))
    size = f"{MAXIMUM_CHARACTERS + 1} characters; the limit is {MAXIMUM_CHARACTERS}"
    assert errors == [f"1:1: the file has {size}"]


def test_errors_beyond_the_limit_are_only_counted() -> None:
    errors = errors_of("[Ports]\nrange = x\n" + "x\n" * MAXIMUM_FINDINGS)
    assert (len(errors), errors[-1][-25:]) == (MAXIMUM_FINDINGS + 1, "1 more error is not shown")


@pytest.mark.parametrize(
    "text",
    [
        "x\n" * (MAXIMUM_CHARACTERS // 2), "[Nodes]\n/a = " + "zz " * (MAXIMUM_CHARACTERS // 3 - 10), "[Groups]\n"
        + "".join(f"g{n} = g{n + 1}\n" for n in range(60_000)) + "g60000 = ::1\n[Nodes]\ndefault = g0\n",
        "[Nodes]\n" + "".join(f"/*/a{n}* = *\n" for n in range(20_000)),
        "[Nodes]\n" + "".join(f"/{'a/' * 400}b{n} = *\n" for n in range(2_000)), "[Groups]\n"
        + "".join(f"g{n} = 10.{n >> 8}.{n & 255}.1\n" for n in range(20_000)) + "[Nodes]\n/a = gg",
    ],
    ids=["garbage", "undefined", "chain", "stars", "deep", "many groups"],
)  # fmt: skip
def test_hostile_file_is_judged_in_bounded_time(text: str) -> None:
    start = time.process_time()
    try:
        compile_policy(text, file="p.ini")
    except PolicyError as error:
        assert len(error.findings) <= 2 * MAXIMUM_FINDINGS + 1
    assert time.process_time() - start < 60


WORDS = """
    [Groups] [nodes] [Publishers] [Commands] [Parameters] [Ports] [Monitor] [Options] ] [ a b robot default /a
    /a/* /*/a /** * = , # ; 10.0.0.1 10.0.0.0/8 fd00::/16 ::ffff:1.2.3.4 host:x host: ::1%x 1/2 read write
    getParam range 19001-20000 topic takeover audit-only all é
"""
PIECES = st.sampled_from([*WORDS.split(), " ", "\n", "\r", "\t", "\x00", "\ufeff", "\u2028"])
TEXTS = st.one_of(st.text(), *(st.lists(PIECES, max_size=60).map(glue.join) for glue in ("", " ")))


@settings(max_examples=examples(500))
@given(TEXTS)
@example("[Groups]\nrobot\n=")
def test_any_text_is_a_policy_or_a_policy_error(text: str) -> None:
    try:
        policy = compile_policy(text, file="p.ini", robot=[ipaddress.ip_address("172.17.0.1")])
    except PolicyError as error:
        assert error.findings
        lines = text.split("\n")
        for finding in error.findings:
            assert 1 <= finding.line <= len(lines)
            assert 1 <= finding.column <= len(lines[finding.line - 1]) + 1
            assert str(finding).isprintable()
    else:
        assert isinstance(policy, Policy)


def test_options_and_ports_have_their_documented_defaults() -> None:
    policy = compile_policy("", file="p.ini")
    assert policy.ports == range(19001, 26001)
    assert compile_policy("[Ports]\nrange = 1024-2023\n", file="p").ports == range(1024, 2024)
    assert policy.takeover == "same-host"
    assert policy.monitored_services == frozenset()
    assert compile_policy("[Options]\ntakeover = granted\n", file="p").takeover == "granted"
    assert policy.tell == "rule"
    assert {compile_policy(f"[Options]\ntell = {one}\n", file="p").tell for one in TELLS} == set(TELLS)


def test_lines_may_end_as_on_windows() -> None:
    policy = compile_policy("\ufeff[Groups]\r\na = ::1 # x\r\n[Nodes]\r\ndefault = a\r\n", file="p.ini")
    assert policy.knows(ipaddress.ip_address("::1"))
