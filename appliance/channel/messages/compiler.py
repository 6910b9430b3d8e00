"""The link control <-> compiler, which carries the texts of specifications and their contents."""

from typing import Literal

import msgspec

from appliance.channel.answers.monitor_answers import GivenState
from appliance.channel.messages.message import Message


class StateOwner(msgspec.Struct, frozen=True):
    """A monitor, identified by the digest of its state. If the state is lost, it holds the topics `held`."""

    identity: str
    held: frozenset[str]
    position: str


GivenValue = bool | int | float | str
"""The value of a given constant, or a string with the name of a given topic."""


class Contents(msgspec.Struct, frozen=True):
    """The contents of valid specifications: monitors (name to file), and what they use.

    `sharing` has the groups of monitors that share variables. `published_by` maps a file to the topics that it
    publishes, `types` a topic to its message type, and `texts` such a type to its full definition. `certificates` has
    each property of a monitor, and whether its automaton was proved equal to its formula. `places` maps a topic to
    `file:line:column`.

    `unbuilt` has the monitors of files with errors. They do nothing; the relay holds their topics, unless their code
    `begins`. `left_out` has the files whose topics are not known; nothing holds their topics. `switches` has the words
    `on`, `shadow` and `off` of monitors whose files have one. `givens` has the values in the compiled texts; that of a
    topic may differ from its default.
    """

    monitors: dict[str, str] = {}
    topics: dict[str, frozenset[str]] = {}
    services: dict[str, frozenset[str]] = {}
    publications: dict[str, str] = {}
    warnings: tuple[str, ...] = ()
    types: dict[str, str] = {}
    texts: dict[str, str] = {}
    sharing: tuple[frozenset[str], ...] = ()
    published_by: dict[str, frozenset[str]] = {}
    certificates: dict[str, list[str]] = {}
    compiled: bytes = b""
    places: dict[str, str] = {}
    unbuilt: dict[str, str] = {}
    states: dict[str, StateOwner] = {}
    left_out: dict[str, str] = {}
    givens: dict[str, tuple[GivenState, ...]] = {}
    switches: dict[str, Literal["on", "shadow", "off"]] = {}


class ContentsWanted(Message):
    """Control asks for the contents of specifications (name to text) with these message definitions.

    A `dry_run` gets less processor time than an order, and builds the module too. `at_start`: files with errors, such
    as those in `broken`, do not keep the others from being compiled; without `lints`, there are no warnings.
    """

    number: int
    files: dict[str, str]
    definitions: dict[str, str]
    dry_run: bool = False
    at_start: bool = False
    topics: dict[str, dict[str, str]] = msgspec.field(default_factory=dict)
    broken: list[str] = msgspec.field(default_factory=list)
    lints: bool = True


class ContentsFound(Message):
    """The specifications have no errors."""

    number: int
    contents: Contents


class CompilationRefused(Message):
    """All errors of the specifications (`file:line:column: error: text`), or the reason."""

    number: int
    findings: list[str]


class PartNames(msgspec.Struct, frozen=True, array_like=True):
    """The monitors of one relay in order; `shadows` are in shadow mode."""

    monitors: tuple[str, ...] = ()
    shadows: tuple[str, ...] = ()


class PartsWanted(Message):
    """Control asks for the parts of `Contents.compiled` that several relays run."""

    number: int
    compiled: bytes
    parts: list[PartNames]


class PartsMade(Message):
    """The parts (`rosmop/fast/serialization.py`), in the order of `PartsWanted`."""

    number: int
    parts: list[bytes]


CompilerLink = ContentsWanted | ContentsFound | CompilationRefused | PartsWanted | PartsMade
