"""Convert records to columns of the database and back, and hash the columns.

SQLite and JSON cannot store lone surrogates, integers beyond 64 bits, or arbitrary objects, so these are escaped,
limited, or stored as their `repr`.
"""

import contextlib
import hashlib
from typing import Annotated, Any, NamedTuple

import msgspec

from appliance.audit.log.record import SCHEMA_VERSION, AuditRecord, RuleReference, Severity
from appliance.signing import log_proof

LARGEST_DETAIL = 65_536
LONGEST_TEXT = 4_096
_DEEPEST = 16
_MAX_ITEMS = 256
_MAX_KEYS = 128
_LARGEST_INTEGER = (1 << 63) - 1
_Text = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]
_Integer = Annotated[int, msgspec.Meta(ge=-_LARGEST_INTEGER, le=_LARGEST_INTEGER)]
# The hash covers this text; an export and its verification must write it again, from dicts instead of structs.
_encoder = msgspec.json.Encoder(order="sorted")
_packer = msgspec.msgpack.Encoder()
_decode_detail = msgspec.json.Decoder(dict[str, Any]).decode


class StoredColumns(NamedTuple):
    """The columns of table `record`, in order."""

    sequence: _Integer
    id: _Text
    time: _Integer
    version: _Integer
    event: _Text
    severity: _Text
    decision: _Text | None
    host: _Text | None
    caller_id: _Text | None
    category: _Text | None
    resource: _Text | None
    rule: _Text | None
    rule_key: _Text | None
    rule_file: _Text | None
    rule_line: _Integer | None
    revision: _Integer | None
    reason: _Text
    duration_us: _Integer | None
    detail: bytes


def to_columns(record: AuditRecord, sequence: int) -> StoredColumns:
    """Return the columns of a record. This never fails, whatever the record contains."""
    with contextlib.suppress(AttributeError, TypeError, ValueError, OverflowError, RecursionError):
        columns = msgspec.convert(_columns(record, sequence), StoredColumns)
        pack(columns)  # raises UnicodeEncodeError, a ValueError, for a lone surrogate
        if isinstance(record.detail, dict) and len(columns.detail) <= LARGEST_DETAIL:
            return columns
    return StoredColumns(*_columns(plain_record(record), sequence))


def _columns(record: AuditRecord, sequence: int) -> tuple[Any, ...]:
    rule = record.rule
    section, key, file, line = (None,) * 4 if rule is None else (rule.section, rule.key, rule.file, rule.line)
    return (
        sequence, record.id, record.time, SCHEMA_VERSION, record.event, record.severity.value,
        record.decision, record.host, record.caller_id, record.category, record.resource,
        section, key, file, line, record.revision, record.reason, record.duration_us,
        _encoder.encode(record.detail),
    )  # fmt: skip


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
        detail = _shorten(detail)
    return AuditRecord(
        id=_text(record.id), time=_integer(record.time) or 0, event=_text(record.event),
        severity=record.severity if isinstance(record.severity, Severity) else Severity.NOTICE,
        decision=_optional(record.decision), host=_optional(record.host),
        caller_id=_optional(record.caller_id), category=_optional(record.category),
        resource=_optional(record.resource), rule=rule, revision=_integer(record.revision),
        reason=_text(record.reason), duration_us=_integer(record.duration_us), detail=detail,
        unknown=record.unknown, folds=record.folds,
    )  # fmt: skip


def _shorten(detail: dict[str, object]) -> dict[str, object]:
    sizes = {key: len(_encoder.encode({key: value})) for key, value in detail.items()}
    kept, room = {}, LARGEST_DETAIL // 4
    for key in sorted(sizes, key=sizes.__getitem__):
        room -= sizes[key]
        if room >= 0:
            kept[key] = detail[key]
    left_out = [key[:64] for key in detail if key not in kept]
    return {**kept, "cut": "the details were too large to keep", "keys": left_out[:_MAX_KEYS]}


def _optional(value: object) -> str | None:
    return None if value is None else _text(value)


def _integer(value: object) -> int | None:
    if not isinstance(value, int):
        return None
    return max(-_LARGEST_INTEGER, min(int(value), _LARGEST_INTEGER))


def _plain(value: object, depth: int = 0) -> object:
    if value is None or isinstance(value, bool | float):
        plain: object = value
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
        plain = [_plain(item, depth + 1) for item in list(value)[:_MAX_ITEMS]]
        if len(value) > len(plain):
            plain.append(f"... {len(value) - len(plain)} more")
    else:
        plain = _text(repr(value))
    return plain


def _plain_dict(value: dict[object, object], depth: int) -> dict[str, object]:
    pairs = list(value.items())[:_MAX_ITEMS]
    plain = {_text(key): _plain(item, depth + 1) for key, item in pairs}
    if len(value) > len(pairs):
        plain["..."] = f"{len(value) - len(pairs)} more"
    return plain


def _text(value: object) -> str:
    value = value if type(value) is str else str(value)
    if len(value) > LONGEST_TEXT:
        value = f"{value[: LONGEST_TEXT - 64]}... ({len(value)} characters)"
    return value.encode("utf-8", "backslashreplace").decode()


def pack(columns: tuple[object, ...]) -> bytes:
    """Return the columns as an array, so that no two rows have the same encoding."""
    return _packer.encode(columns)


def content_hash(columns: tuple[object, ...]) -> bytes:
    return hashlib.sha256(pack(columns)).digest()


def follows(previous: bytes, columns: tuple[object, ...], digest: bytes) -> bool:
    return log_proof.follows(previous, pack(columns), digest)


def record_hash(previous: bytes, columns: tuple[object, ...]) -> bytes:
    return log_proof.link(previous, content_hash(columns))
