"""Record in the audit log how operators and starts change the specifications in force."""

import datetime
from collections.abc import Mapping, Sequence

import structlog

from appliance.audit.log.record import Severity
from appliance.base.actors import DISK
from appliance.channel.answers.monitor_answers import GivenState
from appliance.channel.messages import GivenValue
from appliance.signing.fingerprints import fingerprint, fingerprint_of_all
from appliance.specifications.givens import DroppedValue, with_unit
from appliance.specifications.in_force import InForce
from appliance.specifications.specification_files import Sources
from appliance.specifications.specification_revisions import MAX_WARNINGS
from appliance.specifications.switches import SHADOW, Switch
from appliance.store.state_file import MonitorRevisionRow
from appliance.telemetry.audit_trail import AuditTrail
from appliance.telemetry.text_changes import changed_lines

_log = structlog.get_logger()
_MAX_FINDINGS = 100
_EVENTS: dict[Switch, str] = {
    True: "monitor enabled",
    False: "monitor disabled",
    SHADOW: "monitor in shadow mode",
}
WORDS: dict[Switch, str] = {True: "enabled", False: "disabled", SHADOW: "in shadow mode"}


def off_in(now: InForce) -> dict[str, str]:
    """Return the monitors that are disabled or in shadow mode, each with its state in words."""
    return {name: WORDS[to] for name, to in now.states.items() if to is not True}


class ChangeRecords:
    """The records of changes; times are seconds since the epoch."""

    def __init__(self, trail: AuditTrail) -> None:
        self._trail = trail

    def record_load(
        self,
        row: MonitorRevisionRow,
        before: Sources,
        new: InForce,
        who: str,
        *,
        began: Sequence[str],
        changed: tuple[list[str], list[str], list[str]],
        warnings: Sequence[str],
    ) -> None:
        """Record a revision. `changed` are its added, changed and removed files."""
        checked, (added, other, removed) = new.checked, changed
        self._trail.happened(
            "specifications loaded",
            f"revision {row.revision} of the specifications is in force: {row.note}",
            category="monitor",
            resource="",
            who=who,
            revision_of_specifications=row.revision,
            sha256=fingerprint_of_all(new.sources.by_name()),
            earlier_sha256=fingerprint_of_all(before.by_name()) if before.files else "",
            diff=changed_lines(before.by_name(), new.sources.by_name()),
            compiled_sha256=fingerprint(checked.compiled),
            monitors=list(checked.monitors),
            off=off_in(new),
            added=added,
            changed=other,
            removed=removed,
            began=list(began),
            signed_by=checked.signed_by,
            certificates=checked.certificates,
            warnings=[*checked.warnings, *warnings][:MAX_WARNINGS],
        )

    def record_refusal(self, revision: int, reason: str, findings: Sequence[str], who: str) -> None:
        text = f"revision {revision} stays in force: {reason}"
        self._trail.happened("specifications refused", text, findings=findings[:_MAX_FINDINGS], who=who)

    def folder_refused(self, revision: int, findings: Sequence[str]) -> None:
        text = f"revision {revision} of the specifications stays in force, because the folder has errors"
        _log.error(text, findings=findings[:_MAX_FINDINGS])
        self._trail.happened(
            "specifications refused",
            f"{text}: {findings[0]}",
            severity=Severity.ALARM,
            category="monitor",
            resource="",
            findings=findings[:_MAX_FINDINGS],
            who=DISK,
        )

    def record_confirmation(self, revision: int, promoted: Sequence[str], who: str) -> None:
        also = f": {', '.join(promoted)} in force" if promoted else ""
        self._trail.happened(
            "specifications confirmed",
            f"revision {revision} of the specifications was confirmed{also}",
            category="monitor",
            resource="",
            who=who,
        )

    def unbuilt(self, name: str, file: str, error: str) -> None:
        self._trail.happened(
            "monitor not built",
            f"{name} does nothing, because {file} has an error: {error};"
            f" load a version without the error: rosrv monitor load {file}",
            category="monitor",
            resource=name,
        )

    def left_out(self, file: str, error: str) -> None:
        text = f"{file} is left out, because it has an error: {error}; its topics are not known, so nothing holds them"
        _log.error(text)
        fix = f"load a version without the error: rosrv monitor load {file}"
        self._trail.happened("monitor not built", f"{text}; {fix}", category="monitor", resource=file)

    def record_switch(
        self, name: str, to: Switch, who: str, why: str, *, earlier: Switch | None, until: float | None
    ) -> None:
        """Record a switch; `earlier` is None for a monitor that was not loaded."""
        end = "" if until is None else f" until {_moment(until)}{' unless confirmed' if to is True else ''}"
        self._trail.happened(
            _EVENTS[to],
            f"{name} is {WORDS[to]}{end}{why}",
            severity=Severity.NOTICE,
            category="monitor",
            resource=name,
            who=who,
            earlier="not loaded" if earlier is None else WORDS[earlier],
            more=None if until is None else {"until": _moment(until)},
        )

    def record_resume(self, name: str, who: str) -> None:
        text = f"the topics of {name} are released"
        self._trail.happened("monitor resumed", text, category="monitor", resource=name, who=who)

    def record_values(
        self, name: str, states: Mapping[str, GivenState], before: Mapping[str, GivenValue], who: str
    ) -> None:
        parts = [
            f"{one} = {with_unit(states[one].value, states[one].unit)} (was {with_unit(old, states[one].unit)})"
            for one, old in before.items()
        ]
        self._trail.happened(
            "monitor set",
            f"{name}: {', '.join(parts)}",
            severity=Severity.NOTICE,
            category="monitor",
            resource=name,
            who=who,
            values={one: states[one].value for one in before},
            before=dict(before),
        )

    def record_drop(self, value: DroppedValue, who: str) -> None:
        """Record that a specification no longer takes a value that was given."""
        self._trail.happened(
            "monitor set",
            value.text,
            severity=Severity.WARNING,
            category="monitor",
            resource=value.monitor,
            who=who,
            values={value.name: value.now},
            before={value.name: value.value},
        )


def _moment(seconds: float) -> str:
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat(timespec="seconds")
