"""Convert records to columns of the database and back, and hash the columns.

SQLite and JSON cannot store lone surrogates, integers beyond 64 bits, or arbitrary objects, so these are escaped,
limited, or stored as their `repr`.
"""

import hashlib
from typing import Any, NamedTuple

import msgspec

from appliance.audit.log.record import SCHEMA_VERSION, AuditRecord, RuleReference, Severity
from appliance.signing import log_proof

LARGEST_DETAIL = 65_536
LONGEST_TEXT = 4_096
_DEEPEST = 16
_MOST_ITEMS = 256
_MOST_KEYS = 128
_LARGEST_INTEGER = (1 << 63) - 1
_NONE = type(None)
_KINDS: tuple[tuple[type, ...], ...] = (
    (int,), (str,), (int,), (int,), (str,), (str,), (str, _NONE), (str, _NONE), (str, _NONE), (str, _NONE),
    (str, _NONE), (str, _NONE), (str, _NONE), (str, _NONE), (int, _NONE), (int, _NONE), (str,), (int, _NONE),
    (bytes,),
)  # fmt: skip
# The hash covers this text; an export and its verification must write it again, from dicts instead of structs.
_encoder = msgspec.json.Encoder(order="sorted")
_packer = msgspec.msgpack.Encoder()
_decode_detail = msgspec.json.Decoder(dict[str, Any]).decode


class StoredColumns(NamedTuple):
    """The columns of table `record`, in order."""

    sequence: int
    id: str
    time: int
    version: int
    event: str
    severity: str
    decision: str | None
    host: str | None
    caller_id: str | None
    category: str | None
    resource: str | None
    rule: str | None
    rule_key: str | None
    rule_file: str | None
    rule_line: int | None
    revision: int | None
    reason: str
    duration_us: int | None
    detail: bytes


def to_columns(record: AuditRecord, sequence: int) -> StoredColumns:
    """Return the columns of a record. This never fails, whatever the record contains."""
    try:
        columns = _columns(record, sequence)
        if isinstance(record.detail, dict) and len(columns.detail) <= LARGEST_DETAIL and _storable(columns):
            return columns
    except (AttributeError, TypeError, ValueError, OverflowError, RecursionError):
        pass
    return _columns(plain_record(record), sequence)


def _columns(record: AuditRecord, sequence: int) -> StoredColumns:
    rule = record.rule
    section, key, file, line = (None,) * 4 if rule is None else (rule.section, rule.key, rule.file, rule.line)
    return StoredColumns(
        sequence, record.id, record.time, SCHEMA_VERSION, record.event, record.severity.value,
        record.decision, record.host, record.caller_id, record.category, record.resource,
        section, key, file, line, record.revision, record.reason, record.duration_us,
        _encoder.encode(record.detail),
    )  # fmt: skip


def _storable(columns: StoredColumns) -> bool:
    value: Any
    for value, kinds in zip(columns, _KINDS, strict=True):
        if type(value) not in kinds:
            return False
        if isinstance(value, str):
            if len(value) > LONGEST_TEXT:
                return False
            if not value.isascii() and any("\ud800" <= c <= "\udfff" for c in value):
                return False
        elif isinstance(value, int) and not -_LARGEST_INTEGER <= value <= _LARGEST_INTEGER:
            return False
    return True


def from_columns(columns: StoredColumns) -> AuditRecord:
    rule = None
    if columns.rule is not None:
        rule = RuleReference(
            columns.rule, columns.rule_key or "", columns.rule_file or "", columns.rule_line or 0
        )
    return AuditRecord(
        id=columns.id, time=columns.time, event=columns.event, severity=Severity(columns.severity),
        decision=columns.decision, host=columns.host, caller_id=columns.caller_id, category=columns.category,
        resource=columns.resource, rule=rule, revision=columns.revision, reason=columns.reason,
        duration_us=columns.duration_us, detail=_decode_detail(columns.detail),
    )  # fmt: skip


def plain_record(record: AuditRecord) -> AuditRecord:
    rule = record.rule
    if rule is not None:
        rule = RuleReference(_text(rule.section), _text(rule.key), _text(rule.file), _integer(rule.line) or 0)
    detail = _plain(record.detail)
    if not isinstance(detail, dict):
        detail = {"value": detail}
    if len(_encoder.encode(detail)) > LARGEST_DETAIL:
        detail = _shortened(detail)
    return AuditRecord(
        id=_text(record.id), time=_integer(record.time) or 0, event=_text(record.event),
        severity=record.severity if isinstance(record.severity, Severity) else Severity.NOTICE,
        decision=_optional(record.decision), host=_optional(record.host),
        caller_id=_optional(record.caller_id), category=_optional(record.category),
        resource=_optional(record.resource), rule=rule, revision=_integer(record.revision),
        reason=_text(record.reason), duration_us=_integer(record.duration_us), detail=detail,
        unknown=record.unknown, folds=record.folds,
    )  # fmt: skip


def _shortened(detail: dict[str, Any]) -> dict[str, Any]:
    sizes = {key: len(_encoder.encode({key: value})) for key, value in detail.items()}
    kept, room = {}, LARGEST_DETAIL // 4
    for key in sorted(sizes, key=sizes.__getitem__):
        room -= sizes[key]
        if room >= 0:
            kept[key] = detail[key]
    left_out = [key[:64] for key in detail if key not in kept]
    return {**kept, "cut": "the details were too large to keep", "keys": left_out[:_MOST_KEYS]}


def _optional(value: object) -> str | None:
    return None if value is None else _text(value)


def _integer(value: object) -> int | None:
    if not isinstance(value, int):
        return None
    return max(-_LARGEST_INTEGER, min(int(value), _LARGEST_INTEGER))


def _plain(value: Any, depth: int = 0) -> Any:
    if value is None or isinstance(value, bool | float):
        plain: Any = value
    elif isinstance(value, int):
        plain = value if abs(value) <= _LARGEST_INTEGER else _text(hex(value))
    elif isinstance(value, str):
        plain = _text(value)
    elif isinstance(value, bytes | bytearray):
        plain = _text(bytes(value[:LONGEST_TEXT]).decode("ascii", "backslashreplace"))
    elif depth >= _DEEPEST:
        plain = "(nested too deeply)"
    elif isinstance(value, dict):
        plain = _plain_dict(value, depth)
    elif isinstance(value, list | tuple | set | frozenset):
        plain = [_plain(item, depth + 1) for item in list(value)[:_MOST_ITEMS]]
        if len(value) > len(plain):
            plain.append(f"... {len(value) - len(plain)} more")
    else:
        plain = _text(repr(value))
    return plain


def _plain_dict(value: dict[Any, Any], depth: int) -> dict[str, Any]:
    pairs = list(value.items())[:_MOST_ITEMS]
    plain = {_text(key): _plain(item, depth + 1) for key, item in pairs}
    if len(value) > len(pairs):
        plain["..."] = f"{len(value) - len(pairs)} more"
    return plain


def _text(value: object) -> str:
    value = value if type(value) is str else str(value)
    if len(value) > LONGEST_TEXT:
        value = f"{value[: LONGEST_TEXT - 64]}... ({len(value)} characters)"
    return value.encode("utf-8", "backslashreplace").decode()


def packed(columns: tuple[object, ...]) -> bytes:
    """Return the columns as an array, so that no two rows have the same encoding."""
    return _packer.encode(columns)


def content_hash(columns: tuple[object, ...]) -> bytes:
    return hashlib.sha256(packed(columns)).digest()


def follows(previous: bytes, columns: tuple[object, ...], digest: bytes) -> bool:
    return log_proof.follows(previous, packed(columns), digest)


def record_hash(previous: bytes, columns: tuple[object, ...]) -> bytes:
    return log_proof.link(previous, content_hash(columns))
