"""The link control <-> compiler: texts of specifications, and their contents."""

import msgspec

from appliance.channel.messages.message import Message


class Contents(msgspec.Struct, frozen=True):
    """The contents of specifications without errors: monitors (name to file), topics that they subscribe to and
    publish.

    `uses` has the other monitors whose variables a monitor uses, `published_by` the topics that each file publishes.
    `types` has the message type of each topic, `texts` the full text of each such type. `certificates` has for each
    property of a monitor whether its automaton was proved equal to its formula. `places` has where each topic is first
    named (`file:line:column`). Each relay runs its part of `compiled` (`PartsWanted`).
    """

    monitors: dict[str, str] = {}
    topics: dict[str, frozenset[str]] = {}
    services: dict[str, frozenset[str]] = {}
    publications: dict[str, str] = {}
    warnings: tuple[str, ...] = ()
    types: dict[str, str] = {}
    texts: dict[str, str] = {}
    uses: dict[str, frozenset[str]] = {}
    published_by: dict[str, frozenset[str]] = {}
    certificates: dict[str, list[str]] = {}
    compiled: bytes = b""
    places: dict[str, str] = {}


class ContentsWanted(Message):
    """Control asks for the contents of these specifications (name to text), with these definitions of messages.

    A `dry_run` has a smaller budget of processor time than an order.
    """

    number: int
    files: dict[str, str]
    definitions: dict[str, str]
    dry_run: bool = False


class ContentsFound(Message):
    """The contents of specifications without errors."""

    number: int
    contents: Contents


class CompilationRefused(Message):
    """All errors of the specifications, as `file:line:column: error: text`, or why there are no parts."""

    number: int
    findings: list[str]


class PartNames(msgspec.Struct, frozen=True, array_like=True):
    """The monitors of one relay, in their order, and which of them are in shadow mode."""

    monitors: tuple[str, ...] = ()
    shadows: tuple[str, ...] = ()


class PartsWanted(Message):
    """Control asks for the parts of a compiled set (`Contents.compiled`) that several relays run."""

    number: int
    compiled: bytes
    parts: list[PartNames]


class PartsMade(Message):
    """The parts (`rosmop/fast/serialization.py`), in the order of the question."""

    number: int
    parts: list[bytes]


CompilerLink = ContentsWanted | ContentsFound | CompilationRefused | PartsWanted | PartsMade
