"""Define what a feature adds to views of commands and pages, without settings: `rosrv status` must start fast."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, NamedTuple, TypeVar

from appliance.base.metric import Metric

S = TypeVar("S")

Samples = Iterable[tuple[tuple[str, ...], Any]]
"""The samples of a metric: the values of labels, and the value."""


Pieces = Sequence[tuple[str, str]]
"""The pieces of a text, each with its style on a terminal; an empty style is that of other text."""


class AlarmKind(NamedTuple):
    """Whether a kind of condition needs a person now (`alarm`), soon (`warning`) or not (`notice`), and for what."""

    severity: Literal["alarm", "warning", "notice"]
    remedy: str
    """The remedy, or why none is needed, for the reference."""


class Trouble(NamedTuple):
    """A condition that holds now; `kind` is a name of `kinds`, or one with `:` and what it is about. `text` has the
    reason and the remedy, `about` is as in `Alarm`.
    """

    kind: str
    text: str
    about: Literal["system", "monitors", "audit"] = "system"


@dataclass(frozen=True)
class StateView(Generic[S]):
    """A field of `rosrv status --json`, which is null without a state, unless `required`."""

    field: str
    kind: type[S]
    doc: str
    """The description in the schema."""
    part: Literal["status", "audit"] = "status"
    """The field belongs to the status, or to its `audit`."""
    before: str = ""
    """The name of the field that follows, or empty if the field is the last."""
    required: bool = False
    kinds: Mapping[str, AlarmKind] = dataclasses.field(default_factory=dict)
    """The kinds of `alarms`."""
    alarms: Callable[[S], Iterable[Trouble]] = lambda _state: ()
    metrics: tuple[Metric, ...] = ()
    samples: Callable[[S], Mapping[str, Samples]] = lambda _state: {}
    line: Callable[[S], tuple[str, str | Pieces]] | None = None
    """Returns what `rosrv status` prints: a name, and a text in rich's markup, or its pieces. An empty name adds the
    text to the line of the audit log.
    """


class PairView(NamedTuple):
    """The passive of two appliances. Three members are named `module:name`: a command imports only what it needs."""

    request: str
    """The request for its state."""
    samples: Callable[[Any], Mapping[str, Samples]]
    status: str
    """The function from the state to the `StatusView`."""
    verification: str
    """The function that verifies the takeovers between two logs. It returns the result, and the function that prints
    this.
    """


class FeatureView(NamedTuple):
    """The views of a feature."""

    states: tuple[StateView[Any], ...] = ()
    pair: PairView | None = None
    """In the feature that makes pairs."""
