"""What specifications would mean for the topics that are published now. No I/O.

A specification that gives a topic another type than its publisher has cuts that topic: the relay cannot read the
messages, and carries none. A topic that no node publishes may be a name with a wrong letter. Both are found before the
specifications come into force, for what a change adds: what is in force already is not judged again.
"""

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

from appliance.base.validation_messages import meant
from appliance.specifications.specification_files import Checked

Published = Mapping[str, Mapping[str, str]]
"""Which nodes publish a topic, each with the type that it registered."""

_ANY = "*"


class Judged(NamedTuple):
    """`conflicts` are topics that would be cut, `warnings` the rest; both as `file:line:column: severity: text`."""

    conflicts: list[str]
    warnings: list[str]


def judge_topics(
    coming: Checked,
    present: Checked,
    published: Published,
    *,
    shadow: Collection[str],
    forced: bool,
    promoted: Collection[str] = (),
) -> Judged:
    """Compare topics that specifications add, or give another type, with what nodes publish.

    Monitors in `shadow` mode cut nothing: they are not given messages that they cannot read. `forced`: conflicts are
    warnings. Monitors that are `promoted` from shadow mode are judged again.
    """
    found = Judged([], [])
    acting = [name for name in coming.monitors if name not in shadow]
    heard, known, read = (
        _heard(coming, coming.monitors),
        _heard(present, present.monitors),
        _heard(coming, acting),
    )
    again = _heard(coming, promoted)
    sent = {topic for name in acting for topic in coming.published_by.get(coming.monitors[name], frozenset())}
    for topic in sorted(heard | coming.publications.keys()):
        place, ours = coming.places[topic], coming.types[topic]
        if present.types.get(topic) != ours or topic in again:
            consequence = _CUT if topic in read else _MIXED if topic in sent else _UNREAD
            error = consequence is not _UNREAD and not forced
            for node, theirs in published.get(topic, {}).items():
                if theirs not in (_ANY, ours):
                    text = f"{node} publishes {topic} as {theirs}, not as {ours}: {consequence}"
                    (found.conflicts if error else found.warnings).append(
                        f"{place}: {'error' if error else 'warning'}: {text}"
                    )
        if topic in heard - known and topic not in published:
            near = meant(topic, published)
            found.warnings.append(f"{place}: warning: no node publishes {topic} now{near}")
    return found


_FORCE = "give the topic the publisher's type, or say --force (REST: force=1) if the publisher is wrong"
_CUT = f"its messages would not be carried any more; {_FORCE}"
_MIXED = f"subscribers would get messages of two types; {_FORCE}"
_UNREAD = "monitors in shadow mode are not given its messages"


def _heard(checked: Checked, names: Iterable[str]) -> set[str]:
    """The topics that these monitors have events on."""
    return {topic for name in names for topic in checked.topics[name]}
