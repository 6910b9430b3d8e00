"""Define the policy's questions (`Request`) and answers (`Decision`)."""

import enum
import ipaddress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, NamedTuple

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


class _Stored:
    """An address whose hash, text and `is_loopback` are computed once, instead of at each use."""

    is_loopback = False

    def __init__(self, text: str) -> None:
        super().__init__(text)  # type: ignore[call-arg]  # the next base is an address
        self._hash, self._text = super().__hash__(), super().__str__()
        self.is_loopback = super().is_loopback  # type: ignore[misc]  # as above

    def __hash__(self) -> int:
        return self._hash

    def __str__(self) -> str:
        return self._text


class _IPv4(_Stored, ipaddress.IPv4Address):
    pass


class _IPv6(_Stored, ipaddress.IPv6Address):
    pass


HOST, DOOR = "host:", "door:"
"""The prefixes of hosts and doors; mappings of names have doors as `door:NAME`."""


def known_name(word: str) -> str | None:
    if word.startswith(DOOR):
        return word
    return word.removeprefix(HOST) if word.startswith(HOST) else None


def word_of(name: str) -> str:
    return name if name.startswith(DOOR) else f"{HOST}{name}"


@lru_cache(4096)
def address_of(text: str) -> Address:
    """Return the same object for the same text, to speed up the look-ups of every call.

    It equals the address that `ipaddress` makes, and has the same hash. Raises `ValueError`.
    """
    return _IPv6(text) if ":" in text else _IPv4(text)


def plain_address(text: str) -> Address:
    """Return the address without its zone, as IPv4 if it is mapped into IPv6. Raises `ValueError`."""
    address = address_of(text.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        return address_of(str(address.ipv4_mapped))
    return address


class Category(enum.StrEnum):
    """The kind of access. Each category has its own section, except READ and WRITE, which share one."""

    NODE = "node"  # use a node name                [Nodes]
    PUBLISH = "publish"  # publish a topic          [Publishers]
    SUBSCRIBE = "subscribe"  # subscribe to a topic [Subscribers]
    COMMAND = "command"  # make a call              [Commands]
    OFFER = "offer"  # offer a service              [Services]
    CALL = "call"  # call a service                 [Clients]
    READ = "read"  # read a parameter               [Parameters] read …
    WRITE = "write"  # write a parameter            [Parameters] write …


@dataclass(frozen=True, slots=True)
class Request:
    """One question to the policy: may `host` access `resource`?

    `resource` is a resolved, canonical ROS name. For `Category.COMMAND`, it is the exact name of a call. `caller_id`
    is not verified, so the policy decides by `host`.
    """

    host: Address
    caller_id: str
    category: Category
    resource: str

    def fields(self) -> dict[str, str]:
        return {
            "host": str(self.host),
            "caller_id": self.caller_id,
            "category": self.category.value,
            "resource": self.resource,
        }


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule: its section, key and position."""

    section: str  # as written in the documentation: "Publishers"
    key: str  # as written in the file: "/arm/**", "default", "read /ns/**"
    file: str
    line: int  # counted from 1

    def __str__(self) -> str:
        return f"[{self.section}] {self.key} ({self.file}:{self.line})"


@dataclass(frozen=True, slots=True)
class Decision:
    """The answer to a `Request`.

    `rule` is None if no rule matches. `told` is the reason without names and addresses of other hosts; None if
    `reason` contains none. In audit-only mode, `would_deny` is true if the rules deny the request, and `allowed` is
    true. `needs` names the additional right that decided, if any. `asks` is the request that needs an operator's
    approval, even while it has one. `held`: it waits for that approval, so it is not allowed and not denied.
    """

    allowed: bool
    rule: Rule | None
    reason: str
    would_deny: bool = False
    told: str | None = None
    needs: str = ""
    asks: Request | None = None
    held: bool = False

    @property
    def rank(self) -> int:
        """0 if nothing is granted, 1 with an approval, 2 only in audit-only mode, 3 otherwise."""
        return 2 if self.would_deny else 1 if self.asks is not None else 3 if self.allowed else 0

    @property
    def verdict(self) -> Literal["allow", "deny", "would deny", "ask"]:
        return "ask" if self.rank == 1 else self.word

    @property
    def word(self) -> Literal["allow", "deny", "would deny", "ask"]:
        return (
            "would deny" if self.would_deny else "allow" if self.allowed else "ask" if self.held else "deny"
        )


class CallHold(NamedTuple):
    """The answer to a call that needs an approval: its text, and whether it waits for an operator.

    `again` adds for the caller when it may ask again. The record leaves it out, so that repeated calls have equal ones.
    """

    text: str
    waits: bool
    again: str = ""

    def of(self, decision: Decision) -> Decision:
        """Return the decision of the held call."""
        told = f"{self.text}{self.again}: {decision.told or decision.reason}" if self.again else None
        return replace(
            decision, allowed=False, held=self.waits, reason=f"{self.text}: {decision.reason}", told=told
        )


TELLS = ("rule", "full", "id")
"""The values of `[Options] tell`, which limits the text for a denied caller; the first is the default."""


def text_for_caller(decision: Decision, tell: str) -> str:
    """Return the reason (`full`), the reason without other hosts (`rule`), or only the denial (`id`)."""
    if tell == "full":
        return decision.reason
    return "denied" if tell == "id" else decision.told or decision.reason
