"""Find the message types that a specification uses. Its state survives new definitions only if they are unchanged.

The result may include an unused type, if a string equals the name of a type.
"""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from hashlib import sha256

from rosmop.text import tree
from roswire.definitions import Definitions


def reached(node: tree.Specification, definitions: Definitions) -> frozenset[str]:
    messages, services = set(definitions.message_types), set(definitions.service_types)
    waiting: list[str] = []
    for name in set(_names(node)):
        if name in messages:
            waiting.append(name)
        if name in services:
            service = definitions.service(name)
            waiting += [service.request.name, service.response.name]
    found: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in messages and name not in found:
            found.add(name)
            waiting += [field.type for field in definitions.message(name).fields]
    return frozenset(found)


def identity(node: tree.Specification) -> bytes:
    return sha256(repr(_plain(node)).encode()).digest()


def _plain(node: object) -> object:
    if isinstance(node, tuple):
        return tuple(map(_plain, node))
    if is_dataclass(node):
        named = ((field, getattr(node, field.name)) for field in fields(node) if field.compare)
        # A part that a file does not use leaves its digest as it was before the language had this part.
        parts = (_plain(value) for field, value in named if field.default != () or value != ())
        return (type(node).__name__, *parts)
    return node


def _names(root: object) -> Iterator[str]:
    waiting = [root]
    while waiting:
        node = waiting.pop()
        if isinstance(node, str):
            yield node.replace("::", "/")
        elif isinstance(node, tuple | list):
            if len(node) == 2 and all(isinstance(part, str) for part in node):
                yield "/".join(node)
            waiting += node
        elif isinstance(node, tree.SyntaxNode):
            waiting += tree.fields_of(node)
