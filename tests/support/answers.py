"""Build answers of the appliance. Fields that a test does not set are empty, zero or None."""

import types
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec

A = TypeVar("A", bound=msgspec.Struct)
_EMPTY: dict[Any, Any] = {int: 0, float: 0.0, str: "", bool: False, list: [], dict: {}}


def example(kind: type[A], **given: Any) -> A:
    return msgspec.convert(_fields(kind, given), kind)


def _fields(kind: Any, given: dict[str, Any]) -> dict[str, Any]:
    known = {field.encode_name: field for field in msgspec.structs.fields(kind)}
    assert given.keys() <= known.keys(), f"{kind.__name__} has no {given.keys() - known.keys()}"
    return {name: _value(one.type, given[name]) for name, one in known.items() if name in given} | {
        name: _empty(one.type) for name, one in known.items() if name not in given and one.required
    }


def _value(kind: Any, given: Any) -> Any:
    if get_origin(kind) is Annotated:
        return _value(get_args(kind)[0], given)
    if get_origin(kind) in (Union, types.UnionType):
        return None if given is None else _value(get_args(kind)[0], given)
    if _is_struct(kind) and isinstance(given, dict):
        return _fields(kind, given)
    if get_origin(kind) is list and isinstance(given, list):
        return [_value(get_args(kind)[0], one) for one in given]
    if get_origin(kind) is dict and isinstance(given, dict):
        return {name: _value(get_args(kind)[1], one) for name, one in given.items()}
    return given


def _empty(kind: Any) -> Any:
    origin, words = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _empty(words[0])
    if origin in (Union, types.UnionType):
        return None
    if origin is Literal:
        return words[0]
    if origin is tuple:
        return [_empty(word) for word in words]
    return _fields(kind, {}) if _is_struct(kind) else _EMPTY[origin or kind]


def _is_struct(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)
