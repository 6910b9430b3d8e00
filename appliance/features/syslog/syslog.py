r"""Format records as messages of RFC 5424. No I/O.

1. A message is printable ASCII, and `"`, `\` and `]` are escaped (RFC 5424, 6.3.3). A name chosen by a host can neither
   control a receiver or a terminal, nor end its parameter, element or message.
2. A message has at most `longest` bytes. First the details are left out, then the text is cut; each leaves a mark. The
   sequence and id of the record are always included.
"""

import json
import socket
from datetime import UTC, datetime

import msgspec

from appliance.audit.log.record import Severity
from appliance.audit.log.record_format import LogEntry, fields_of, printable
from appliance.audit.proof.copies import SYSLOG_ELEMENT, SignedCheckpoint

ELEMENT = "rosrv@32473"  # 32473 is reserved for examples (RFC 5612); the project has no number
LONGEST_DATAGRAM, LONGEST_IN_STREAM = 2048, 8192  # RFC 5426, 3.2; RFC 5425, 4.3.1
_SEVERITIES = {
    Severity.DEBUG: 7,
    Severity.INFO: 6,
    Severity.NOTICE: 5,
    Severity.WARNING: 4,
    Severity.ALARM: 1,
}
_LONGEST_MESSAGE_ID = 32
_LONGEST_HOST_NAME = 255
_LONGEST_VALUE = 512
# Bytes of the header and our own parameters; number of parameters with values that callers choose.
_FIXED, _OPEN = 700, 5
_CUT = "..."


class Formatter:
    """Formats messages of at most `longest` bytes; the facility is 0 to 23."""

    def __init__(self, *, facility: int, longest: int, host_name: str | None = None) -> None:
        self._facility = facility
        self._longest = longest
        self._room = min(_LONGEST_VALUE, (longest - _FIXED) // _OPEN)
        self._host = _name(host_name or socket.gethostname(), _LONGEST_HOST_NAME)

    def record(self, entry: LogEntry) -> bytes:
        record = entry.record
        head = self._head(record.severity, record.time, record.event)
        named = {name: _value(value, self._room) for name, value in fields_of(entry).items() if value}
        text = _ascii(record.reason or record.event)
        detail = json.dumps(record.detail, separators=(",", ":")) if record.detail else ""
        if len(detail) < self._longest:
            shown = {"detail": _value(detail, 2 * len(detail))} if detail else {}
            whole = _message(head, ELEMENT, named | shown, text)
            if len(whole) <= self._longest:
                return whole
        named |= {"cut": "detail"} if detail else {}
        room = max(0, self._longest - len(_message(head, ELEMENT, named, "")) - 1)
        return _message(head, ELEMENT, named, _shorten(text, room))

    def checkpoint(self, signed: SignedCheckpoint) -> bytes:
        """Return a message that `rosrv audit verify --checkpoints` finds in the receiver's file."""
        head = self._head(Severity.NOTICE, signed.time, "checkpoint signed")
        fields = {
            name: str(value) for name, value in msgspec.structs.asdict(signed).items() if value is not None
        }
        text = f"checkpoint {signed.number} of the audit log"
        return _message(head, SYSLOG_ELEMENT, fields, text)

    def _head(self, severity: Severity, time: int, event: str) -> str:
        priority = self._facility * 8 + _SEVERITIES[severity]
        event_id = _name(event.replace(" ", "-"), _LONGEST_MESSAGE_ID)
        return f"<{priority}>1 {_time(time)} {self._host} rosrv - {event_id}"


def _message(head: str, element: str, fields: dict[str, str], text: str) -> bytes:
    shown = "".join(f' {name}="{value}"' for name, value in fields.items())
    return f"{head} [{element}{shown}]{f' {text}' if text else ''}".encode("ascii")


def _value(value: str, room: int) -> str:
    pieces = [f"\\{character}" if character in '\\"]' else character for character in _ascii(value)]
    if sum(map(len, pieces)) <= room:
        return "".join(pieces)
    left, kept = room - len(_CUT), []
    for piece in pieces:
        left -= len(piece)
        if left < 0:
            break
        kept.append(piece)
    return "".join(kept) + _CUT


def _ascii(text: str) -> str:
    return printable(text).encode("ascii", "backslashreplace").decode("ascii")


def _shorten(text: str, room: int) -> str:
    if len(text) <= room:
        return text
    return text[: room - len(_CUT)] + _CUT if room > len(_CUT) else ""


def _name(text: str, longest: int) -> str:
    return "".join(character for character in text if "!" <= character <= "~")[:longest] or "-"


def _time(time: int) -> str:
    seconds, fraction = divmod(time, 1_000_000_000)
    try:
        moment = datetime.fromtimestamp(seconds, UTC)
    except (OverflowError, ValueError, OSError):
        return "-"
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{fraction // 1000:06d}Z"
