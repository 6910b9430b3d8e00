"""An auditor has one HTML page and no program of ours: each question is answered by it, for a history that is known."""

import ipaddress
from html.parser import HTMLParser
from typing import Any

import msgspec
import pytest

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry
from appliance.audit.proof.chain_findings import VerificationResult
from appliance.base.timestamps import parse_timestamp
from appliance.channel.answers.policy_answers import PolicyInForce
from appliance.channel.answers.token_answers import Token, Tokens
from appliance.features.logbook import report_verb
from appliance.formats.machine_report import MachineReport, Period, Reading, ReportedLog, merge, read_records
from appliance.formats.report_words import page
from appliance.policy.model import Category, Request, address_of
from appliance.policy.policy_compiler import compile_policy

POLICY = """[Groups]
joystick = 10.0.0.5
[Nodes]
default = robot joystick
[Publishers]
/cmd_vel = joystick
default = robot
[Subscribers]
default = *
[Services]
default = robot
[Clients]
/brake = joystick
[Parameters]
write default = robot
[Commands]
shutdown = robot
default = robot joystick
"""
STATUS: dict[str, Any] = {
    "processes": [{"role": "control"}, {"role": "api"}], "standby": {},
    "master": "http://10.0.0.2:11311", "policy": {"audit_only": []}, "blocks": {"hosts": 1},
    "monitors": {"enabled": 2, "loaded": 3}, "relaying": "on", "isolation": "netns",
    "doors": {"doors": [{"name": "agent"}]}, "ipsec": {"esp": "kernel", "enrolled": 2, "key_exchange": ["x25519"]},
}  # fmt: skip

FREE = {"earlier": "nobody"}
SIGN_ON = {"settings": {"sso": {"issuer": "https://id.example.org", "roles": "{'admin': ['it']}"}}}
HISTORY: tuple[tuple[str, str, str, dict[str, Any]], ...] = (
    ("2026-02-20 08:00:00", "appliance started", "", {
        "version": "0.4.0", "configuration": {"sso": "1"}, "off": {}, "settings": {},
    }),
    ("2026-02-20 08:00:05", "host enrolled", "", {"name": "tablet", "address": "10.77.0.5"}),
    ("2026-02-20 08:00:06", "door added", "agent", {"address": "10.78.0.1", "port": 9091, "source": "10.0.0.20"}),
    ("2026-03-02 09:00:00", "monitor set", "limit", {"who": "ann", "before": {"vMax": 1.5}, "values": {"vMax": 0.5}}),
    ("2026-03-04 10:00:00", "monitor disabled", "limit", {"who": "bob", "earlier": "enabled"}),
    ("2026-03-04 10:20:00", "monitor enabled", "limit", {"who": "ann", "earlier": "disabled"}),
    ("2026-03-05 11:00:00", "policy loaded", "", {
        "who": "eve", "sha256": "bb" * 32, "earlier_sha256": "aa" * 32,
        "diff": ["-/cmd_vel = robot", "+/cmd_vel = joystick"],
    }),
    ("2026-03-06 14:00:00", "authority handed over", "base", {"who": "ann", "holder": "10.77.0.5", **FREE}),
    ("2026-03-06 14:30:00", "authority handed over", "base", {"earlier": "10.77.0.5", "holder": "nobody"}),
    ("2026-03-07 15:00:00", "approval given", "/arm/move", {"who": "ann", "earlier": "waits", "now": "approved once"}),
    ("2026-03-08 16:00:00", "host blocked", "", {
        "who": "bob", "address": "10.0.0.66", "earlier": "not blocked", "until": None,
    }),
    ("2026-03-09 17:00:00", "clock set back", "", {}),
    ("2026-04-30 12:00:00", "appliance stopped", "", {}),
    ("2026-04-30 12:05:00", "appliance started", "", {
        "version": "0.5.0", "configuration": {"sso": "2"}, "off": {}, **SIGN_ON,
    }),
)  # fmt: skip


def moment(text: str) -> int:
    return parse_timestamp(f"{text.replace(' ', 'T')}Z", 0)


def entries() -> list[LogEntry]:
    return [
        LogEntry(
            number,
            AuditRecord(
                id=f"{number:020x}", time=moment(time), event=event, resource=what or None, detail=detail
            ),
        )
        for number, (time, event, what, detail) in enumerate(HISTORY, start=1)
    ]


class Page(HTMLParser):
    """The sections of a page by the words of their headings, each a list of rows; the first is that of the columns."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sections: dict[str, list[list[str]]] = {}
        self.scripts = 0
        self._heading = ""
        self._rows: list[list[str]] = []
        self._into: str | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.scripts += tag == "script"
        if tag == "h2":
            self._heading, self._rows, self._into = "", [], "heading"
        elif tag == "tr":
            self._rows.append([])
        elif tag in ("td", "th") and self._rows:
            self._rows[-1].append("")
            self._into = "cell"
        elif tag in ("p", "pre"):
            self._rows.append([""])
            self._into = "cell"

    def handle_data(self, data: str) -> None:
        if self._into == "heading":
            self._heading += data.strip()
            self.sections[self._heading.partition(". ")[2] or self._heading] = self._rows
        elif self._into == "cell" and self._rows and self._rows[-1]:
            self._rows[-1][-1] += data

    def handle_endtag(self, tag: str) -> None:
        if tag in ("h2", "p", "pre", "table"):
            self._into = None

    def rows(self, title: str) -> list[list[str]]:
        return [[cell.strip() for cell in row] for row in self.sections[title]]

    def text(self, title: str) -> str:
        return "\n".join(" | ".join(row) for row in self.rows(title))


TOKENS = Tokens([
    Token(name="ann", role="operator", id="1", created=0.0, expires=1.0, revoked=None),
    Token(name="root", role="admin", id="2", created=0.0, expires=1.0, revoked=None),
], uses_since=0.0)  # fmt: skip
IN_FORCE = PolicyInForce(
    revision=2, text=POLICY, file="robot.ini", policy_file="robot.ini", differs_from_file=False, warnings=[],
    confirm_by=None, site_keys=[], robot=["10.0.0.2/32"], hosts={"tablet": "10.77.0.5"}, loaded=0.0, who="eve",
    note="", in_force=True, signature="",
)  # fmt: skip


@pytest.fixture(scope="module")
def report() -> MachineReport:
    policy = compile_policy(POLICY, file="robot.ini", robot=[ipaddress.ip_address("10.0.0.2")])
    period = Period(moment("2026-03-01 00:00:00"), moment("2026-05-04 00:00:00"))
    read = read_records(merge({"": entries()}), period)
    result = VerificationResult(
        time_utc="2026-05-03T04:00:00.000000000Z", complete=True, verdict="The log is complete and unchanged",
        records=14, text="", log="ab", through=14,
    )  # fmt: skip
    log = ReportedLog(
        name="", id="ab", begins_utc="2026-02-20T08:00:00.000000000Z", last=14, verification=result
    )
    return MachineReport(
        robot="arm7", logs=[log], since_utc="2026-03-01T00:00:00.000000000Z",
        until_utc="2026-05-04T00:00:00.000000000Z",
        made_utc="2026-05-04T08:00:00.000000000Z", version="0.5.0", verify="rosrv audit verify",
        interventions=read.interventions, switched_off=read.switched_off, blocks=read.blocks, software=read.software,
        drivers=read.drivers, interfaces=list(report_verb.interfaces(STATUS, IN_FORCE, TOKENS, read)),
        rights=list(report_verb.rights(policy, IN_FORCE, TOKENS, read)), live_reason="", gaps=read.gaps,
    )  # fmt: skip


@pytest.fixture(scope="module")
def found(report: MachineReport) -> Page:
    return Page(page(report))


def test_the_page_runs_nothing(found: Page) -> None:
    assert not found.scripts


def test_the_page_says_who_may_stop_the_robot_remotely(found: Page) -> None:
    rows = [row for row in found.rows("Rights on the machine now") if "stop the robot remotely" in row[0]]
    assert any("ann" in who and "root" in who for _what, who, _by in rows)
    assert any("/brake" in what and "joystick" in who for what, who, _by in rows)
    assert any("end a node" in what and "robot" in who for what, who, _by in rows)
    assert "ann" in found.text("Answers")


def test_the_page_says_who_changed_the_speed_limit_in_march_from_what_to_what(found: Page) -> None:
    row = next(row for row in found.rows("Guards and monitors") if "monitor set" in row)
    assert row[:6] == ["2026-03-02 09:00:00", "monitor set", "limit", "vMax = 1.5", "vMax = 0.5", "ann"]


def test_the_page_says_was_any_guard_off_when_and_by_whose_order(found: Page) -> None:
    (row,) = found.rows("Guards and monitors that were off")[1:]
    assert row[:6] == ["limit", "disabled", "2026-03-04 10:00:00", "2026-03-04 10:20:00", "bob", "ann"]


def test_the_page_says_which_software_ran_on_3_may(found: Page) -> None:
    rows = found.rows("Software that ran")[1:]
    began = [row for row in rows if row[2] <= "2026-05-03 00:00:00"]
    assert [row[1] for row in began if row[3] == "lasts" or row[3] > "2026-05-03"] == ["0.5.0"]
    assert "appliance.yaml: sso changed" in found.text("Software")


def test_the_page_says_which_interfaces_take_commands_and_what_protects_each(found: Page) -> None:
    rows = found.rows("Interfaces now, and what protects each")[1:]
    named = {row[0] for row in rows}
    assert named >= {"ROS Master API", "topics and services (relay)", "door agent", "IPsec tunnels"}
    assert all(row[3] for row in rows)
    (door,) = (row for row in rows if row[0] == "door agent")
    assert door[1] == "address 10.78.0.1, port 9091, from 10.0.0.20"


ABSENT: dict[str, dict[str, Any]] = {
    "REST and console": {"processes": [{"role": "control"}]},
    "door agent": {"doors": None},
    "IPsec tunnels": {"ipsec": {"esp": None}},
    "the other appliance and the witness": {"standby": None},
}


@pytest.mark.parametrize("name", ABSENT)
def test_an_interface_that_is_off_is_not_named(name: str) -> None:
    named = [
        {interface.name for interface in report_verb.interfaces(status, IN_FORCE, TOKENS, Reading())}
        for status in (STATUS, STATUS | ABSENT[name])
    ]
    assert named[0] - named[1] == {name}


@pytest.mark.parametrize(("port", "free"), [(None, False), (9091, True)])
def test_a_door_is_named_with_its_port_that_needs_no_ticket(port: int | None, free: bool) -> None:
    detail = {"address": "10.78.0.1", "port": port, "source": None}
    record = AuditRecord(id="1", time=1, event="door added", resource="agent", detail=detail)
    read = read_records(merge({"": [LogEntry(1, record)]}), Period(0, 9))
    (door,) = (
        one for one in report_verb.interfaces(STATUS, IN_FORCE, TOKENS, read) if one.name == "door agent"
    )
    assert door.protection.startswith("a ticket") and ("at its own port" in door.protection) is free
    (rest,) = (one for one in report_verb.interfaces(STATUS, IN_FORCE, TOKENS, read) if "REST" in one.name)
    assert rest.protection.endswith("single sign-on: unknown: the log has no start")


@pytest.mark.parametrize("own", ["shutdown = robot\n", "shutdown = joystick\n", ""])
def test_the_right_to_end_a_node_names_the_hosts_that_the_policy_allows(own: str) -> None:
    text = POLICY.replace("shutdown = robot\n", own)
    policy = compile_policy(text, file="robot.ini", robot=[ipaddress.ip_address("10.0.0.2")])
    rows = [
        row
        for row in report_verb.rights(policy, IN_FORCE, TOKENS, Reading())
        if row.what.endswith("end a node")
    ]
    hosts = {"robot": "10.0.0.2", "joystick": "10.0.0.5"}
    assert {name for name in hosts if any(name in row.who for row in rows)} == {
        name
        for name, host in hosts.items()
        if policy.decide(Request(address_of(host), "", Category.COMMAND, "shutdown")).allowed
    }


def test_the_page_says_who_drove_at_14_03(found: Page) -> None:
    at = "2026-03-06 14:03:00"
    rows = [row for row in found.rows("Drivers")[1:] if row[2] <= at < row[3]]
    assert [row[:2] for row in rows] == [["base", "tablet (10.77.0.5)"]]


def test_a_log_without_holders_leaves_open_who_drove(report: MachineReport) -> None:
    shown = Page(page(msgspec.structs.replace(report, drivers=[])))
    (answer,) = (row[1] for row in shown.rows("Answers") if row[0].startswith("Who drove"))
    assert answer == "no record that a host held a group of [Authority] in this period"


def test_the_page_says_who_approved_the_agents_arm_motion(found: Page) -> None:
    row = next(row for row in found.rows("Approvals") if "/arm/move" in row)
    assert row[3:6] == ["waits", "approved once", "ann"]


def test_the_page_says_which_hosts_were_blocked(found: Page) -> None:
    (row,) = found.rows("Hosts that were blocked")[1:]
    assert (row[0], row[2], row[3], row[4]) == ("10.0.0.66", "2026-03-08 16:00:00", "lasts", "bob")


def test_the_page_says_are_there_gaps_and_why(found: Page) -> None:
    text = found.text("Completeness of the log")
    assert (
        "clock set back" in text and "shut down in order until 2026-04-30T12:05:00.000000000Z (300 s)" in text
    )


def test_the_page_says_who_can_change_policies(found: Page) -> None:
    (row,) = (row for row in found.rows("Rights on the machine now") if row[0].startswith("change policies"))
    assert row[1:] == ["root", "token, role admin"]
    assert any(
        "people with {'admin': ['it']}" in who for _what, who, _by in found.rows("Rights on the machine now")
    )
    assert "+sso.roles: {'admin': ['it']}" in found.text("Software")
    assert "-/cmd_vel = robot\n+/cmd_vel = joystick" in found.text("Policy")


def test_the_page_says_was_the_log_tampered_with_and_how_would_one_know(found: Page) -> None:
    text = found.text("Verification")
    assert "2026-05-03T04:00:00" in text and "complete and unchanged" in text
    assert "checkpoints that were kept on another machine" in text


def test_the_page_says_what_changed_since_the_last_report(found: Page) -> None:
    """The period of a report that follows another one begins where that ended; all of its changes are in it."""
    assert ["period (UTC)", "2026-03-01 00:00:00 to 2026-05-04 00:00:00"] in found.rows("About this report")
    titles = [title for title in found.sections if title[0].isupper()]
    listed = "\n".join(map(found.text, titles))
    assert all(time in listed for time, *_ in HISTORY if time >= "2026-03")


def test_each_question_names_the_section_that_answers_it(found: Page) -> None:
    rows = found.rows("Answers")[1:]
    assert len(rows) == 12
    numbers = {row[2] for row in rows}
    assert all(number.isdigit() for number in numbers) and all(row[1] for row in rows)
