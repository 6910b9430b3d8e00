"""Compare specifications with the topics that are published now. No I/O.

A monitor that begins again may hold its topics: the robot then gets no command, not even a stop, until an
operator resumes it.
"""

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

from appliance.base.validation_messages import meant
from appliance.specifications.specification_files import CheckedSpecifications


class LiveType(NamedTuple):
    """The type that a node registered, and the md5sum in its header (empty if no relay has seen it)."""

    name: str
    md5sum: str = ""
    moving: bool = True


Published = Mapping[str, Mapping[str, LiveType]]

_ANY = "*"


class TopicFindings(NamedTuple):
    """Texts of the form `file:line:column: severity: text`; `conflicts` forbid the change."""

    conflicts: list[str]
    warnings: list[str]


def judge_topics(
    coming: CheckedSpecifications,
    present: CheckedSpecifications,
    published: Published,
    *,
    shadow: Collection[str],
    forced: bool,
    promoted: Collection[str] = (),
) -> TopicFindings:
    """Compare topics that specifications add, or give another type, with those that nodes publish.

    Monitors in `shadow` mode cut nothing; those that are `promoted` from it are judged again. With `forced`,
    conflicts are warnings.
    """
    findings = TopicFindings([], [])
    acting = [name for name in coming.monitors if name not in shadow]
    heard, known, read = (
        _heard(coming, coming.monitors),
        _heard(present, present.monitors),
        _heard(coming, acting),
    )
    again = _heard(coming, promoted)
    sent = {topic for name in acting for topic in coming.published_by.get(coming.monitors[name], frozenset())}
    for topic in sorted(heard | coming.publications.keys()):
        place, ours = coming.places[topic], LiveType(coming.types[topic], coming.md5sum(topic))
        if LiveType(present.types.get(topic, ""), present.md5sum(topic)) != ours or topic in again:
            consequence = _CUT if topic in read else _MIXED if topic in sent else _UNREAD
            error = consequence is not _UNREAD and not forced
            for node, theirs in published.get(topic, {}).items():
                if difference := _difference(theirs, ours):
                    text = f"{node} publishes {topic} as {difference}: {consequence}"
                    (findings.conflicts if error else findings.warnings).append(
                        f"{place}: {'error' if error else 'warning'}: {text}"
                    )
        if topic in heard - known and topic not in published:
            near = meant(topic, published)
            findings.warnings.append(f"{place}: warning: no node publishes {topic} now{near}")
    return findings


def judge_holds(
    coming: CheckedSpecifications,
    present: CheckedSpecifications,
    published: Published,
    *,
    acting: Collection[str],
    moved: Collection[str],
    hold: bool,
) -> TopicFindings:
    """Find the monitors that will lose their state and hold topics with a publisher.

    Only monitors that are `acting` now and later hold topics. The files `moved` go to another relay.
    """
    findings = TopicFindings([], [])
    for name in (one for one in acting if one in present.states):
        owner = coming.states[name]
        changed = owner.identity != present.states[name].identity
        topics = sorted(owner.held & published.keys())
        if topics and (changed or coming.monitors[name] in moved):
            why = "its source, or a definition, changes" if changed else "it moves to another relay"
            dropped = f"drops every message of {', '.join(topics)} until it is resumed"
            text = f"{name} loses its state, because {why}, and {dropped}"
            refused = not hold and any(live.moving for topic in topics for live in published[topic].values())
            (findings.conflicts if refused else findings.warnings).append(
                f"{owner.position}: {'error' if refused else 'warning'}: {text}; {_HOLD if refused else _RESUME} {name}"
            )
    return findings


_RESUME = "when it is safe: rosrv monitor resume"
_HOLD = "stop the robot, and use --hold (REST: hold=1); then rosrv monitor resume"
_FORCE = "give the topic the publisher's type, or use --force (REST: force=1) if the publisher is wrong"
_CUT = f"its messages would no longer be relayed; {_FORCE}"
_MIXED = f"subscribers would get messages of two types; {_FORCE}"
_UNREAD = "monitors in shadow mode do not see its messages"


def _difference(theirs: LiveType, ours: LiveType) -> str:
    """Return the difference of two types, if any. As in ROS, `*` fits any type, and the md5sum decides."""
    if theirs.name not in (_ANY, ours.name):
        return f"{theirs.name}, not as {ours.name}"
    if {theirs.md5sum, ours.md5sum} & {"", _ANY} or theirs.md5sum == ours.md5sum:
        return ""
    return f"{ours.name} with md5sum {theirs.md5sum}, not {ours.md5sum} ({_DEFINITION})"


_DEFINITION = "add the robot's definition to the specifications: in msg/ beside them"


def _heard(checked: CheckedSpecifications, names: Iterable[str]) -> set[str]:
    return {topic for name in names for topic in checked.topics[name]}
