"""Derive alarms from the status: for the console, REST, `rosrv status`."""

import datetime
import shlex
from collections.abc import Iterable, Iterator
from itertools import zip_longest
from typing import Annotated, Literal

import msgspec
from msgspec import structs

from appliance.base.counted import counted
from appliance.channel.answers.field_docs import doc
from appliance.channel.answers.status import BlocksState, ProcessInfo, Status
from appliance.channel.status_summary import no_relay, probe_failed, process_names
from appliance.features.view import AlarmKind
from appliance.features.views import STATES, states_of

Severity = Literal["alarm", "warning", "notice"]
About = Literal["system", "policy", "monitors", "hosts", "audit"]
SWITCHED_OFF = "monitor-off:"
"""Begins the kinds of alarms for monitors that an order or a file disabled, or put into shadow mode."""
FAULTED = "dropped, or pass with on_fault: pass and on observed topics"
_Condition = tuple[str, About, str]
_CORE_KINDS = {
    "starting": AlarmKind("warning", "wait: RVMaster started a few seconds ago; what stays is then named"),
    "audit-failed": AlarmKind("alarm", "free or repair the disk: requests may be denied"),
    "audit-replaced": AlarmKind("alarm", "find the earlier log, or set it aside"),
    "probe": AlarmKind("alarm", "hide the ROS master: no node is served"),
    "hold-lapsed": AlarmKind("alarm", "order such a start again"),
    "rules-removed": AlarmKind("alarm", "find the program that removes rules; it ends after an hour"),
    "relay": AlarmKind("alarm", "read why it is away: its topics carry nothing"),
    "process-failing": AlarmKind("alarm", "read what it printed last"),
    "rosmaster": AlarmKind("warning", "wait: calls wait also"),
    "token-ends": AlarmKind("warning", "rotate it, or revoke it if it is not needed"),
    "audit-degraded": AlarmKind("warning", "check the disk, the load and the process signer"),
    "forgotten": AlarmKind("alarm", "enable the protection again, or remove it"),
    "monitor-off": AlarmKind("warning", "enable it again, unless it should be off"),
    "policy-unconfirmed": AlarmKind("warning", "confirm it, or let it roll back"),
    "policy-audit-only": AlarmKind("warning", "enforce the sections when they are learnt"),
    "policy-refused": AlarmKind("alarm", "correct the file: the next start may need it"),
    "policy-differs": AlarmKind("notice", "an operator changed one of them on purpose"),
    "monitor-held": AlarmKind("alarm", "resume it: its topics wait for a person"),
    "monitor-left-out": AlarmKind("alarm", "correct it and load it: nothing of it runs"),
    "monitor-failing": AlarmKind("alarm", f"correct it: messages at which it faults are {FAULTED}"),
    "monitors-refused": AlarmKind("alarm", "load others: without earlier ones, all topics are blocked"),
    "monitors-folder-refused": AlarmKind("alarm", "correct the file: the next start may need it"),
    "monitors-unconfirmed": AlarmKind("warning", "confirm them, or let them roll back"),
    "monitor-unconfirmed": AlarmKind("warning", "confirm it, or let it return to shadow mode"),
    "monitors-differ": AlarmKind("notice", "an operator changed one of them on purpose"),
    "ipsec": AlarmKind("warning", "do what the line says"),
    "hosts-blocked": AlarmKind("notice", "an operator blocked them on purpose"),
    "denials": AlarmKind("warning", "see who was denied what; it ends after a minute"),
    "drops": AlarmKind("warning", "see which messages were dropped; it ends after a minute"),
}
ALARM_KINDS = _CORE_KINDS | {name: kind for view in STATES for name, kind in view.kinds.items()}
"""Every kind of alarm: what follows a colon in `Alarm.kind` is not part of its name here."""
_ORDER = ("alarm", "warning", "notice")


class Alarm(msgspec.Struct, frozen=True, kw_only=True):
    """A condition that holds now. `kind` is a stable name; the alarm ends together with the condition."""

    kind: Annotated[str, doc("stable name of the condition")]
    severity: Annotated[Severity, doc("`notice` for a silenced alarm")]
    text: Annotated[str, doc("the problem and what to do, for a person")]
    about: Annotated[About, doc("what it belongs to")]
    handled: Annotated[str, doc("the operator who acknowledged or silenced it, if any")] = ""


class AlarmList(msgspec.Struct, frozen=True):
    """The present alarms."""

    alarms: Annotated[list[Alarm], doc("the most severe first, then denials and drops of the last minute")]
    robot: Annotated[str, doc("the `name` of the robot in `appliance.yaml`")] = ""


def open_alarms(status: Status) -> list[Alarm]:
    found = [*_system(status), *_policy(status), *_monitors(status)]
    tunnels = zip_longest(status.ipsec.trouble_names, status.ipsec.troubles, fillvalue="")
    found += [(f"ipsec:{name}".removesuffix(":"), "hosts", line) for name, line in tunnels]
    found += _blocks(status.blocks)
    for view, state in states_of(status):
        found += [(alarm.kind, alarm.about, alarm.text) for alarm in view.alarms(state)]
    alarms = (_alarm(kind, about, text) for kind, about, text in found)
    return sorted(_handle(status, alarms), key=lambda alarm: _ORDER.index(alarm.severity))


def _alarm(kind: str, about: About, text: str) -> Alarm:
    return Alarm(kind=kind, severity=ALARM_KINDS[kind.partition(":")[0]].severity, text=text, about=about)


def activity(status: Status) -> list[Alarm]:
    """Return notices of the last minute's denials and drops, which are not faults of the appliance."""
    recent = status.last_minute
    alarms = [
        _alarm(
            f"drops:{name}",
            "monitors",
            f"{name} dropped {drops} {'message' if drops == 1 else 'messages'} in the last minute;"
            " rosrv audit search --event 'message dropped' --since 1m",
        )
        for name, drops in sorted(recent.drops.items())
    ]
    if recent.denials >= recent.attention_at:
        most = f" ({recent.most_denied})" if recent.most_denied else ""
        text = f"{counted(recent.denials, 'denial')} in the last minute{most}; rosrv audit summary --since 1m"
        alarms.insert(0, _alarm("denials", "audit", text))
    return list(_handle(status, alarms))


def _handle(status: Status, alarms: Iterable[Alarm]) -> Iterator[Alarm]:
    rows = {row.kind: row for row in status.handled_alarms}
    for alarm in alarms:
        row = rows.get(alarm.kind)
        if row is None:
            yield alarm
            continue
        end = "acknowledged" if row.until is None else f"silenced until {_moment(row.until)}"
        how = f"{end} by {row.who}{f': {row.note}' if row.note else ''}"
        severity = alarm.severity if row.until is None else "notice"
        yield structs.replace(alarm, severity=severity, text=f"{alarm.text} ({how})", handled=how)


def _system(status: Status) -> Iterator[_Condition]:
    audit = status.audit
    if audit.failed is not None:
        yield "audit-failed", "audit", f"the audit log cannot be written: {audit.failed}"
    if audit.replaced is not None:
        yield "audit-replaced", "audit", audit.replaced
    if probe_failed(status):
        text = f"the ROS master is not hidden: {status.probe}; nodes are not served"
        yield "probe", "system", text
    if status.firewall.hold_lapsed:
        yield "hold-lapsed", "system", status.firewall.hold_lapsed
    if status.firewall.removed:
        yield "rules-removed", "system", status.firewall.removed
    relay, rebuilt = no_relay(status.relay), status.rosmaster != "reachable"
    if status.starting and (relay is not None or rebuilt):
        yield "starting", "system", "starting: calls and messages wait"
    elif relay is not None:
        yield "relay", "system", f"{relay}, until it is back"
    for name, process in zip(process_names(status.processes), status.processes, strict=True):
        if process.failing:
            yield f"process-failing:{name.replace(' ', '-')}", "system", _failing(process)
    if rebuilt and not status.starting:
        yield "rosmaster", "system", "the ROS master is being rebuilt: calls wait"
    if audit.degraded is not None:
        yield "audit-degraded", "audit", audit.degraded
    for token in status.tokens_ending:
        text = f"the token {token.name} ({token.role}) ends at {_moment(token.expires)}"
        yield f"token-ends:{token.name}", "system", f"{text}: rosrv token rotate {shlex.quote(token.name)}"


def _policy(status: Status) -> Iterator[_Condition]:
    policy = status.policy
    for off in status.switched_off:
        if off.forgotten:
            text = f"{off.what} since {_moment(off.since)}: {off.again}"
            yield f"forgotten:{off.name}", off.about, text
        elif off.about == "monitors":
            end = "without an end" if off.until is None else f"until {_moment(off.until)}"
            yield f"{SWITCHED_OFF}{off.name}", "monitors", f"{off.what}, {end}: {off.again}"
    if policy.confirm_by is not None:
        yield (
            "policy-unconfirmed",
            "policy",
            _rolls_back("the policy rolls", policy.confirm_by, "policy"),
        )
    if policy.audit_only:
        sections = "], [".join(policy.audit_only)
        text = f"the policy denies nothing by [{sections}]; denials are only recorded (audit-only)"
        yield "policy-audit-only", "policy", text
    if policy.file_refused:
        text = f"revision {policy.revision} stays in force, {policy.file} is rejected: {policy.file_refused}"
        yield "policy-refused", "policy", text
    elif policy.differs_from_file:
        text = (
            f"revision {policy.revision} differs from {policy.file}; to load the file: rosrv policy reload; to keep the"
            f" revision: rosrv policy show > {shlex.quote(policy.file)}"
        )
        yield "policy-differs", "policy", text


def _monitors(status: Status) -> Iterator[_Condition]:
    monitors = status.monitors
    for name in monitors.held:
        why = monitors.why_held.get(name, "a relay was restarted")
        file = monitors.unbuilt.get(name)
        fix = f"rosrv monitor resume {name}" if file is None else f"rosrv monitor load {file}"
        text = f"topics are held ({name}: {why}): {fix}"
        yield f"monitor-held:{name}", "monitors", text
    for file, error in monitors.left_out.items():
        text = f"{file} has an error, so nothing of it runs: {error}: rosrv monitor load {file}"
        yield f"monitor-left-out:{file}", "monitors", text
    for name in monitors.failing:
        text = f"monitors fail: {name}; messages at which it faults are {FAULTED}"
        yield f"monitor-failing:{name}", "monitors", text
    if monitors.refused:
        text = f"the relay rejected the specifications: {'; '.join(monitors.refused)}"
        yield "monitors-refused", "monitors", text
    if monitors.confirm_by is not None:
        text = _rolls_back("the specifications roll", monitors.confirm_by, "monitor")
        yield "monitors-unconfirmed", "monitors", text
    for name, deadline in monitors.unconfirmed.items():
        text = f"{name} returns to shadow mode at {_moment(deadline)} unless confirmed: rosrv monitor confirm"
        yield f"monitor-unconfirmed:{name}", "monitors", text
    if monitors.folder_refused:
        text = (
            f"revision {monitors.revision} of the specifications stays in force, their folder is rejected:"
            f" {monitors.folder_refused}"
        )
        yield "monitors-folder-refused", "monitors", text
    elif monitors.differs_from_folder:
        text = (
            f"revision {monitors.revision} of the specifications differs from their folder; to load the folder's:"
            " rosrv monitor reload; to remove all others as well: rosrv monitor reload --prune"
        )
        yield "monitors-differ", "monitors", text


def _blocks(blocks: BlocksState) -> Iterator[_Condition]:
    if blocks.hosts:
        count = "1 host is blocked" if blocks.hosts == 1 else f"{blocks.hosts} hosts are blocked"
        which = "the first block ends" if blocks.hosts > 1 else "the block ends"
        end = "without an end" if blocks.first_end is None else f"{which} at {_moment(blocks.first_end)}"
        yield "hosts-blocked", "hosts", f"{count}, {end}: rosrv host blocks"


def _failing(process: ProcessInfo) -> str:
    lines = "".join(f"\n    {line}" for line in process.output)
    printed = f"; it printed last:{lines}" if lines else ""
    return (
        f"{process.role} is failing, after {counted(process.restarts, 'restart')}: {process.failing}{printed}"
    )


def _rolls_back(what: str, deadline: float, noun: str) -> str:
    return f"{what} back at {_moment(deadline)} unless confirmed: rosrv {noun} confirm"


def _moment(seconds: float) -> str:
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat(timespec="seconds")
