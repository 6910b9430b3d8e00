"""Compute the publishers of a topic at a time in the past, from the records of registrations. No I/O."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

from appliance.audit.log.record_format import LogEntry, rfc3339
from appliance.audit.search.query import Filter

_NODES = ("node lost", "node returned", "replaced", "takeover")
_REGISTRATIONS = ("registered", "unregistered")
_RUNS = ("appliance started", "appliance stopped")
_COUNTED = "repetitions folded"


@dataclass(frozen=True, slots=True)
class PastPublisher:
    node: str
    host: str
    since: int | None
    """Nanoseconds since the epoch; None if the log has only the end of the registration."""
    sequence: int | None
    """The record of the registration, or of the node's return."""


@dataclass(frozen=True, slots=True)
class PastPublishers:
    """The publishers by name, with sentences on gaps of the log."""

    publishers: tuple[PastPublisher, ...]
    unknown: tuple[str, ...]


def publishers_at(
    export: Callable[[Filter], Iterable[LogEntry]], first: LogEntry | None, topic: str, at: int
) -> PastPublishers:
    """Return the publishers of a topic at a time (ns since the epoch). `first` is the first record of the log."""
    registrations = (Filter(event=event, category="publication", resource=topic) for event in _REGISTRATIONS)
    others = (Filter(event=event, until=at + 1) for event in _NODES)
    gaps = (Filter(event=event) for event in (*_RUNS, "records lost", _COUNTED))
    entries = [entry for wanted in (*registrations, *others, *gaps) for entry in export(wanted)]
    entries.sort(key=lambda entry: entry.sequence)
    past = [entry for entry in entries if entry.record.time <= at]
    known = _registered(past)
    seen = {
        (entry.record.host, entry.record.caller_id) for entry in past if entry.record.event == "registered"
    }
    reaches = first is not None and first.record.time <= at
    ended = _ended_later((entry for entry in entries if entry.record.time > at), seen) if reaches else ()
    found = sorted([*known, *ended], key=lambda one: (one.node, one.host))
    unknown = [*_unknown(past, first, at), *_runs(entries, first, at)]
    if any(_counts(entry, topic, at) for entry in entries):
        unknown.append(
            "registrations before this time were only counted: rosrv audit search --event 'repetitions folded'"
        )
    return PastPublishers(tuple(found), tuple(unknown))


def _registered(past: Iterable[LogEntry]) -> list[PastPublisher]:
    holders: dict[str, PastPublisher] = {}
    lost: dict[str, PastPublisher] = {}
    for sequence, record in past:
        name, host = record.caller_id or "", record.host or ""
        match record.event:
            case "registered":
                holders[name] = PastPublisher(name, host, record.time, sequence)
                lost.pop(name, None)
            case "unregistered":
                for nodes in (holders, lost):
                    if name in nodes and nodes[name].host == host:
                        del nodes[name]
            case "replaced" | "takeover":
                holders.pop(name, None)
                lost.pop(name, None)
            case "node lost" if name in holders and holders[name].host == host:
                lost[name] = holders.pop(name)
            case "node returned" if name in lost and lost[name].host == host:
                holders[name] = replace(lost.pop(name), since=record.time, sequence=sequence)
    return list(holders.values())


def _ended_later(
    later: Iterable[LogEntry], seen: set[tuple[str | None, str | None]]
) -> Iterator[PastPublisher]:
    for entry in later:
        if entry.record.event == "records lost":
            return
        if entry.record.event in _REGISTRATIONS:
            key = entry.record.host, entry.record.caller_id
            if key not in seen and entry.record.event == "unregistered":
                yield PastPublisher(key[1] or "", key[0] or "", None, None)
            seen.add(key)


def _counts(entry: LogEntry, topic: str, at: int) -> bool:
    detail, resource = entry.record.detail, entry.record.resource
    return (
        entry.record.event == _COUNTED
        and detail.get("of") in (*_REGISTRATIONS, *_NODES)
        and detail.get("first_time", 0) <= at
        and (resource is None or (resource == topic and entry.record.category == "publication"))
    )


def _unknown(past: list[LogEntry], first: LogEntry | None, at: int) -> Iterator[str]:
    if first is None or at < first.record.time:
        begins = "the log is empty" if first is None else f"the log begins at {rfc3339(first.record.time)}"
        yield f"{begins}: earlier registrations are missing"
    elif first.record.event != "log begun":
        yield (
            f"records before {rfc3339(first.record.time)} were removed: nodes that registered earlier, and have not"
            " unregistered since, are missing"
        )
    elif first.record.detail.get("earlier_log_missing"):
        yield f"an earlier log is missing, with the registrations before {rfc3339(first.record.time)}"
    if any(entry.record.event == "records lost" for entry in past):
        yield "records were lost before this time: rosrv audit search --event 'records lost'"


def _runs(entries: list[LogEntry], first: LogEntry | None, at: int) -> Iterator[str]:
    if first is None or at < first.record.time:
        return
    runs = [entry.record for entry in entries if entry.record.event in _RUNS]
    before = [run for run in runs if run.time <= at]
    after = [run for run in runs if run.time > at]
    if before and before[-1].event == "appliance stopped":
        yield f"the appliance was stopped at {rfc3339(before[-1].time)}: these were registered then"
    elif after and after[0].event == "appliance started" and (before or first.record.event != "log begun"):
        # Power that is cut leaves no record.
        yield (
            f"the appliance ended without a record before its start at {rfc3339(after[0].time)}: it may have been off"
            " at this time"
        )
