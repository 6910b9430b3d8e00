"""Make the HTML page of a bundle. The same input gives the same page."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol

from appliance.audit.log.record_format import rfc3339
from appliance.formats.html_page import head, text

# The fields of a recording that evidence shows.
#
# Evidence imports nothing of the recorder, so an appliance without a recorder exports the log only.


class RecordedTrigger(Protocol):
    """A trigger of a recording; `time` is nanoseconds since the epoch."""

    @property
    def time(self) -> int: ...
    @property
    def what(self) -> str: ...
    @property
    def record(self) -> str: ...
    @property
    def text(self) -> str: ...


class TopicOfRecording(Protocol):
    """A topic of a recording, with the number of its messages."""

    @property
    def topic(self) -> str: ...
    @property
    def type(self) -> str: ...
    @property
    def messages(self) -> int: ...
    @property
    def missed(self) -> int: ...


class RecordingSummary(Protocol):
    """A recording; `began` and `ended` are nanoseconds since the epoch."""

    @property
    def id(self) -> str: ...
    @property
    def began(self) -> int: ...
    @property
    def ended(self) -> int: ...
    @property
    def complete(self) -> bool: ...
    @property
    def why_not(self) -> str: ...
    @property
    def triggers(self) -> Sequence[RecordedTrigger]: ...
    @property
    def topics(self) -> Sequence[TopicOfRecording]: ...


_MAX_ROWS = 2000  # of one severity and decision, so that no flood of denials hides an alarm
_SEVERE = ("notice", "warning", "alarm")
_TITLE = "Evidence of a ROSRV appliance"
_PROOF = """\
<h2>Verify it</h2>
<p>This page proves nothing. On any machine with Python 3.8 and OpenSSL 3.0, in the folder of the bundle:</p>
<p><code>python3 verify.py --key audit.pub</code></p>
<p>Use an <code>audit.pub</code> and preferably a <code>verify.py</code> from another source: an attacker who changes a
bundle can also change the copies inside it. The command lists the changed and missing parts.</p>
"""


class Names(NamedTuple):
    """The robot's name, and the function that shows a host as text for people."""

    robot: str
    host_in_words: Callable[[str], str]


class Page:
    """A page that collects its rows while the records are written."""

    def __init__(self, recording: RecordingSummary | None, names: Names) -> None:
        self._recording = recording
        self._names = names
        self._events: Counter[str] = Counter()
        self._rows: list[str] = []
        self._kinds: Counter[tuple[str, str | None]] = Counter()

    def add(self, lines: bytes) -> None:
        for line in lines.splitlines():
            self._add(json.loads(line))

    def _add(self, record: dict[str, Any]) -> None:
        self._events[record["event"]] += 1
        if record["severity"] not in _SEVERE and record["decision"] in (None, "allow"):
            return
        of_kind = record["severity"], record["decision"]
        self._kinds.update([of_kind])
        if self._kinds[of_kind] > _MAX_ROWS:
            return
        kind = record["severity"] if record["decision"] in (None, "allow") else "deny"
        host = record["host"] and self._names.host_in_words(record["host"])
        who = " ".join(filter(None, (host, record["caller_id"], _who(record["detail"]))))
        cells = [str(record["sequence"]), record["event"], record["decision"] or "", who, record["resource"] or "",
                 record["reason"]]  # fmt: skip
        shown = "".join(f"<td>{text(cell)}" for cell in cells)
        self._rows.append(f'<tr class="{kind}"><td class="time">{rfc3339(record["time"])}{shown}\n')

    def html(self, manifest: dict[str, Any]) -> bytes:
        runs = ", ".join(f"{first} to {last}" for first, last in manifest["runs"])
        facts = {
            "robot": self._names.robot,
            "span": f"{rfc3339(manifest['since'])} to {rfc3339(manifest['until'])}",
            "log": manifest["log"],
            "records": runs,
        }
        parts = [head(_TITLE), f"<h1>{_TITLE}</h1>\n<table>\n"]
        parts += [f"<tr><th>{name}<td>{text(value)}\n" for name, value in facts.items() if value]
        parts += ["</table>\n", *_recorded(self._recording), _PROOF, "<h2>Events</h2>\n<table>\n"]
        parts += [
            "<tr><th>time<th>record<th>event<th>decision<th>who<th>what<th>reason\n",
            *self._rows,
            "</table>\n",
        ]
        for (severity, decision), count in self._kinds.items():
            if count > _MAX_ROWS:
                kind = text(" ".join(filter(None, (severity, decision))))
                parts.append(
                    f"<p>{count - _MAX_ROWS} more of the kind {kind} are in records.ndjson only.</p>\n"
                )
        parts.append("<h2>All records by event</h2>\n<table>\n")
        parts += [f"<tr><td>{text(event)}<td>{count}\n" for event, count in sorted(self._events.items())]
        parts.append("</table>\n<h2>Contents of the bundle</h2>\n<table>\n")
        parts += [
            f'<tr><td><a href="{text(name).replace("%", "%25")}">{text(name)}</a><td>{about["bytes"]} bytes'
            f"<td><code>{about['sha256']}</code>\n"
            for name, about in manifest["members"].items()
            if name != "index.html"
        ]
        parts += [
            f"<tr><td>{text(place)}<td>the appliance does not have it\n" for place in manifest["missing"]
        ]
        return "".join([*parts, "</table>\n"]).encode()


def _recorded(recording: RecordingSummary | None) -> Iterator[str]:
    if recording is None:
        return
    yield f'<h2>Messages</h2>\n<p>Recording {recording.id}, <a href="recording/recording.bag">a bag</a>\n'
    yield "for rosbag, rqt_bag, Foxglove or PlotJuggler, contains the messages as sent, before monitors\n"
    yield "changed or dropped them.</p>\n"
    if not recording.complete:
        yield f'<p class="alarm">Not complete: {text(recording.why_not)}</p>\n'
    yield "<table>\n<tr><th>time<th>trigger<th>record<th>what\n"
    for trigger in recording.triggers:
        cells = (trigger.what, trigger.record, trigger.text)
        yield f'<tr><td class="time">{rfc3339(trigger.time)}{"".join(f"<td>{text(cell)}" for cell in cells)}\n'
    yield "</table>\n<table>\n<tr><th>topic<th>type<th>messages<th>missed\n"
    for topic in recording.topics:
        yield f"<tr><td>{text(topic.topic)}<td>{text(topic.type)}<td>{topic.messages}<td>{topic.missed}\n"
    yield "</table>\n"


def _who(detail: str) -> str:
    try:
        found = json.loads(detail).get("who")
    except ValueError:  # the record was damaged
        return ""
    return str(found) if found else ""
