"""Message and service types by name, with their md5sums, full texts and layouts.

A type that contains itself, or nests deeper than `MAX_DEPTH`, is rejected, so that untrusted text takes
bounded work.
"""

import difflib
import hashlib
import re
from collections.abc import Collection, Mapping
from typing import Self, TypeVar

from roswire.errors import DefinitionError
from roswire.message_layout import LayoutBuilder, LayoutTooLargeError, MessageLayout
from roswire.message_text import (
    BUILTINS,
    PRIMITIVES,
    MessageDefinition,
    ServiceDefinition,
    parse_message,
    parse_service,
    split_full_text,
)

MAX_DEPTH = 64

_FILE = re.compile(r"([A-Za-z][A-Za-z0-9_]*+)/(?:(msg|srv)/)?([A-Za-z][A-Za-z0-9_]*+)\.(msg|srv)\Z")
_TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*+/[A-Za-z][A-Za-z0-9_]*+\Z")
_RULE = "=" * 80

_Answer = TypeVar("_Answer")


class Definitions:
    """An immutable set of definitions. Its methods raise `DefinitionError` for an unknown or unusable type."""

    def __init__(
        self,
        messages: Mapping[str, MessageDefinition],
        services: Mapping[str, ServiceDefinition] | None = None,
    ) -> None:
        self._services = dict(services or {})
        self._messages = dict(messages)
        for service in self._services.values():
            self._messages[service.request.name] = service.request
            self._messages[service.response.name] = service.response
        self._depths: dict[str, int] = {}
        self._md5sums: dict[str, str] = {}
        self._layouts: dict[str, MessageLayout] = {}

    @classmethod
    def from_files(cls, files: Mapping[str, str]) -> Self:
        """Parse files by name: `pkg/T.msg`, `pkg/msg/T.msg`, `pkg/T.srv` or `pkg/srv/T.srv`.

        Raise `DefinitionError` with the file and line.
        """
        messages: dict[str, MessageDefinition] = {}
        services: dict[str, ServiceDefinition] = {}
        for file, text in files.items():
            match = _FILE.match(file)
            if match is None or match[2] not in (None, match[4]):
                raise DefinitionError("write pkg/T.msg, pkg/msg/T.msg, pkg/T.srv or pkg/srv/T.srv", file)
            name = f"{match[1]}/{match[3]}"
            if name in (services if match[4] == "srv" else messages):
                raise DefinitionError(f"{name} is defined in two files", file)
            if match[4] == "srv":
                services[name] = parse_service(name, text, file)
            else:
                messages[name] = parse_message(name, text, file)
        return cls(messages, services)

    @classmethod
    def from_full_text(cls, name: str, text: str) -> Self:
        """Parse the text of a type and all nested types, as connection headers contain it."""
        messages: dict[str, MessageDefinition] = {}
        for section, body, line in split_full_text(name, text):
            if _TYPE.match(section) is None:
                raise DefinitionError(
                    f"{section[:80]!a} is not a message type; write package/Type", name, line
                )
            if section in messages:
                raise DefinitionError(f"{section} is defined twice", name, line)
            messages[section] = parse_message(section, body, name, line)
        return cls(messages)

    def merge(self, other: "Definitions") -> "Definitions":
        """Return the definitions of both. A type of `other` replaces one of the same name."""
        return Definitions(self._messages | other._messages, self._services | other._services)

    @property
    def message_names(self) -> Collection[str]:
        """The names of all messages, in no order."""
        return self._messages.keys()

    @property
    def service_names(self) -> Collection[str]:
        return self._services.keys()

    @property
    def message_types(self) -> list[str]:
        """Return the names of all messages, including the requests and responses of services."""
        return sorted(self._messages)

    @property
    def service_types(self) -> list[str]:
        return sorted(self._services)

    def message(self, name: str) -> MessageDefinition:
        return _lookup(name, self._messages, "message")

    def service(self, name: str) -> ServiceDefinition:
        return _lookup(name, self._services, "service")

    def md5sum(self, name: str) -> str:
        self._depth(name, ())
        return self._md5sum(name)

    def service_md5sum(self, name: str) -> str:
        service = self.service(name)
        parts = (service.request, service.response)
        for part in parts:
            self._depth(part.name, ())
        return _fingerprint("".join(map(self._md5_text, parts)))

    def full_text(self, name: str) -> str:
        own, *parts = self.parts(name)
        return "\n".join([own.text, *(f"{_RULE}\nMSG: {part.name}\n{part.text}" for part in parts)])

    def fingerprint(self, name: str) -> str:
        """Return a SHA-256 of all that a definition says: everything but its comments and spaces.

        The md5sum of ROS leaves out the brackets and the type names of nested messages, so types with different
        layouts can have the same.
        """
        lines = [
            line
            for part in self.parts(name)
            for line in (
                f"MSG: {part.name}",
                *(f"{constant.type} {constant.name}={constant.text}" for constant in part.constants),
                *(f"{field.notation} {field.name}" for field in part.fields),
            )
        ]
        return hashlib.sha256("\n".join(lines).encode("utf-8", "surrogateescape")).hexdigest()

    def parts(self, name: str) -> Collection[MessageDefinition]:
        """Return a type, and all types that it contains."""
        self._depth(name, ())
        order: dict[str, MessageDefinition] = {}
        waiting = [name]
        while waiting:
            current = waiting.pop()
            if current in order:
                continue
            order[current] = message = self.message(current)
            waiting += [field.type for field in reversed(message.fields) if field.type not in BUILTINS]
        return order.values()

    def layout(self, name: str) -> MessageLayout:
        self._depth(name, ())
        return self._layout(name)

    def _depth(self, name: str, outer: tuple[str, ...]) -> int:
        """Return how many levels a type has, at least 1. Raise `DefinitionError` if it cannot be used inside `outer`.

        `outer` lists the types that contain this type, outermost first. A type keeps its depth, which counts
        wherever another type contains it, so the readers of a type may follow its nested types recursively.
        """
        if name in outer:
            raise DefinitionError(" contains ".join([*outer[outer.index(name) :], name]), name)
        if len(outer) + self._depths.get(name, 1) > MAX_DEPTH:
            raise DefinitionError(f"messages nested deeper than {MAX_DEPTH}", outer[0] if outer else name)
        if name not in self._depths:
            message, inside = self.message(name), (*outer, name)
            nested = [field for field in message.fields if field.type not in BUILTINS]
            for field in nested:
                if field.type not in self._messages:
                    raise DefinitionError(
                        f"field {field.name} has the type {field.type}, which is not defined", name
                    )
            self._depths[name] = 1 + max((self._depth(field.type, inside) for field in nested), default=0)
        return self._depths[name]

    # `_depth` has checked the types below.

    def _md5sum(self, name: str) -> str:
        if name not in self._md5sums:
            self._md5sums[name] = _fingerprint(self._md5_text(self._messages[name]))
        return self._md5sums[name]

    def _md5_text(self, message: MessageDefinition) -> str:
        lines = [f"{constant.type} {constant.name}={constant.text}" for constant in message.constants]
        for field in message.fields:
            kind = field.notation if field.type in BUILTINS else self._md5sum(field.type)
            lines.append(f"{kind} {field.name}")
        return "\n".join(lines).strip()

    def _layout(self, name: str) -> MessageLayout:
        if name not in self._layouts:
            try:
                self._layouts[name] = self._build_layout(self._messages[name])
            except LayoutTooLargeError as error:
                raise DefinitionError(str(error), name) from None
        return self._layouts[name]

    def _build_layout(self, message: MessageDefinition) -> MessageLayout:
        builder = LayoutBuilder()
        for field in message.fields:
            nested = None if field.type in BUILTINS else self._layout(field.type)
            if field.type in PRIMITIVES and (field.length is not None or not field.is_array):
                builder.add_primitive(field.name, field.type, field.length)
            elif field.is_array:
                builder.add_array(field.name, field.type, field.length, nested)
            elif nested is not None:
                builder.add_message(field.name, nested)
            else:
                builder.add_string(field.name)
        return builder.finish()


def _lookup(name: str, types: Mapping[str, _Answer], what: str) -> _Answer:
    try:
        return types[name]
    except KeyError:
        similar = difflib.get_close_matches(name[:200], types, 3, 0.7)
        hint = f"; did you mean {' or '.join(similar)}?" if similar else ""
        raise DefinitionError(f"no such {what} type{hint}", name[:200]) from None


def _fingerprint(text: str) -> str:
    return hashlib.md5(text.encode("utf-8", "surrogateescape"), usedforsecurity=False).hexdigest()
