"""A record as columns of the database and back. Strangers' text is kept as it is where it can be stored.

Lone surrogates (undecodable bytes), integers beyond 64 bits and objects that are no data cannot be stored in
SQLite or JSON: they become their escaped or printed form. A record is bounded: texts past `LONGEST_TEXT`
characters are cut and say how long they were; of details past `LARGEST_DETAIL` bytes the smallest are kept, and the
names of the others.
"""

from functools import lru_cache
from typing import Any

import msgspec

from appliance.audit.chain import StoredColumns
from appliance.audit.record import SCHEMA_VERSION, Record, RuleReference, Severity

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
_encoder = msgspec.json.Encoder(order="deterministic")
_decode_detail = msgspec.json.Decoder(dict[str, Any]).decode


def to_columns(record: Record, sequence: int) -> StoredColumns:
    """The columns of a record that takes the place `sequence`. Never fails, whatever the record holds."""
    try:
        columns = _columns(record, sequence)
        if (
            isinstance(record.detail, dict)
            and len(columns.detail) <= LARGEST_DETAIL
            and _of_columns(tuple(map(type, columns)))
            and (_is_usual(columns) or all(map(_storable, columns)))
        ):
            return columns
    except (AttributeError, TypeError, ValueError, OverflowError, RecursionError):
        pass
    return _columns(plain_record(record), sequence)


def _columns(record: Record, sequence: int) -> StoredColumns:
    rule = record.rule
    section, key, file, line = (None,) * 4 if rule is None else (rule.section, rule.key, rule.file, rule.line)
    return StoredColumns(
        sequence, record.id, record.time, SCHEMA_VERSION, record.event, record.severity.value,
        record.decision, record.host, record.caller_id, record.category, record.resource,
        section, key, file, line, record.revision, record.reason, record.duration_us,
        _encoder.encode(record.detail),
    )  # fmt: skip


@lru_cache(256)
def _of_columns(kinds: tuple[type, ...]) -> bool:
    """Whether values of these types can stand in the columns."""
    return all(kind in known for kind, known in zip(kinds, _KINDS, strict=True))


def _is_usual(columns: StoredColumns) -> bool:
    """Whether a look at all columns together shows that each is storable: texts are short and ASCII."""
    texts = "".join(filter(None, (columns.id, columns.reason, *columns[4:14])))
    line, revision, took = columns.rule_line or 0, columns.revision or 0, columns.duration_us or 0
    numbers = (columns.sequence, columns.time, line, revision, took)
    return (
        len(texts) <= LONGEST_TEXT
        and texts.isascii()
        and min(numbers) >= 0
        and max(numbers) <= _LARGEST_INTEGER
    )


def _storable(value: Any) -> bool:
    kind = type(value)
    if kind is str:
        return len(value) <= LONGEST_TEXT and (
            value.isascii() or not any("\ud800" <= c <= "\udfff" for c in value)
        )
    return kind is not int or -_LARGEST_INTEGER <= value <= _LARGEST_INTEGER


def from_columns(columns: StoredColumns) -> Record:
    """The record that was stored."""
    rule = None
    if columns.rule is not None:
        rule = RuleReference(
            columns.rule, columns.rule_key or "", columns.rule_file or "", columns.rule_line or 0
        )
    return Record(
        id=columns.id, time=columns.time, event=columns.event, severity=Severity(columns.severity),
        decision=columns.decision, host=columns.host, caller_id=columns.caller_id, category=columns.category,
        resource=columns.resource, rule=rule, revision=columns.revision, reason=columns.reason,
        duration_us=columns.duration_us, detail=_decode_detail(columns.detail),
    )  # fmt: skip


def plain_record(record: Record) -> Record:
    """The same with everything in a form that can be stored, whatever it holds."""
    rule = record.rule
    if rule is not None:
        rule = RuleReference(_text(rule.section), _text(rule.key), _text(rule.file), _integer(rule.line) or 0)
    detail = _plain(record.detail)
    if not isinstance(detail, dict):
        detail = {"value": detail}
    if len(_encoder.encode(detail)) > LARGEST_DETAIL:
        detail = _shortened(detail)
    return Record(
        id=_text(record.id), time=_integer(record.time) or 0, event=_text(record.event),
        severity=record.severity if isinstance(record.severity, Severity) else Severity.NOTICE,
        decision=_optional(record.decision), host=_optional(record.host),
        caller_id=_optional(record.caller_id), category=_optional(record.category),
        resource=_optional(record.resource), rule=rule, revision=_integer(record.revision),
        reason=_text(record.reason), duration_us=_integer(record.duration_us), detail=detail,
        stranger=record.stranger, folds=record.folds,
    )  # fmt: skip


def _shortened(detail: dict[str, Any]) -> dict[str, Any]:
    """The smallest details, and the names of those that are left out."""
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
