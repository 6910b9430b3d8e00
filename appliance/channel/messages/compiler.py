"""The link control <-> compiler: texts of specifications, and what is in them."""

import msgspec

from appliance.channel.messages.message import Message


class Contents(msgspec.Struct, frozen=True):
    """What specifications without errors are: their monitors (name to file), what they listen to and publish.

    `uses` are the other monitors whose variables a monitor uses, `published_by` the topics each file publishes.
    `types` has the message type of each topic, `texts` the full text of each such type. `certificates` says of each
    property of a monitor whether its automaton was proved to be what is written. `places` has where each topic is
    first named (`file:line:column`). Of `compiled` each relay runs its part
    (`PartsWanted`).
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
    """Control asks what is in these files of specifications (name to text), with these definitions of messages.

    A `dry_run` has a smaller budget of processor time than an order.
    """

    number: int
    files: dict[str, str]
    definitions: dict[str, str]
    dry_run: bool = False


class ContentsFound(Message):
    """They are in order: what is in them."""

    number: int
    contents: Contents


class CompilationRefused(Message):
    """They are not, and all that is wrong with them, as `file:line:column: error: text`; or of parts why not."""

    number: int
    findings: list[str]


class PartNames(msgspec.Struct, frozen=True, array_like=True):
    """The monitors of one relay, in their order, and which of them are on trial."""

    monitors: tuple[str, ...] = ()
    trials: tuple[str, ...] = ()


class PartsWanted(Message):
    """Control asks for what each of several relays runs of a set that was compiled (`Contents.compiled`)."""

    number: int
    compiled: bytes
    parts: list[PartNames]


class PartsMade(Message):
    """They are made (`rosmop/sent.py`), in the order of the question."""

    number: int
    parts: list[bytes]


CompilerLink = ContentsWanted | ContentsFound | CompilationRefused | PartsWanted | PartsMade
