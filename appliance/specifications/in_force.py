"""The specifications in force as one value, and the orders that make the next value of it. No I/O.

An order that is refused raises `SpecificationsRefusedError`, and has changed nothing.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

from appliance.channel.messages import GivenValue
from appliance.specifications.givens import DroppedValue, Given, Givens, parsed, require_topics
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    Sources,
    SpecificationsRefusedError,
)
from appliance.specifications.switches import SHADOW, Switch, Switches, require_whole

_Word = TypeVar("_Word")
_SIGNED_TOPICS = (
    "the site signs the topics of a text, so a load cannot replace them: sign a text with another topic"
)


@dataclass(frozen=True)
class InForce:
    """Specifications with everything that operators ordered about them.

    `number` is that of the revision; `acts` counts all switches and resumptions so far.
    """

    number: int = 0
    sources: Sources = field(default_factory=Sources)
    checked: CheckedSpecifications = field(default_factory=CheckedSpecifications)
    switches: Switches = field(default_factory=Switches)
    givens: Givens = field(default_factory=Givens)
    acts: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "switches", self.switches.of(self.checked))

    @property
    def tag(self) -> str:
        return f"{self.number}.{self.acts}"

    @property
    def states(self) -> Mapping[str, Switch]:
        return self.switches.states


@dataclass(frozen=True, slots=True)
class Wanted:
    """The sources of an order, and its words about their monitors.

    `shadow` and `enable` name files. `topics` and `constants` are given values. `switches` and `given` are for monitors
    that are not in force yet.
    """

    sources: Sources
    shadow: Collection[str] = ()
    enable: Collection[str] = ()
    topics: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    constants: Given = field(default_factory=dict)
    switches: Mapping[str, Switch] = field(default_factory=dict)
    given: Given = field(default_factory=dict)


class Coming(NamedTuple):
    """The next value, the monitors that the order itself switched, and the values that it gave."""

    new: InForce
    put: Mapping[str, Switch]
    given: Given


class Cleared(NamedTuple):
    """A value without words about what is not in it; `drawn_in` are in shadow mode only because of others."""

    now: InForce
    drawn_in: list[str]
    dropped: list[DroppedValue]


def loaded(now: InForce, wanted: Wanted, checked: CheckedSpecifications, *, signed: bool) -> Coming:
    """Return the next revision. With `signed`, the site signs the texts."""
    constants = constants_of(wanted, checked, signed=signed)
    present = {name: to for name, to in now.states.items() if name in checked.switches}
    said = {**_absent(now, wanted.switches), **present, **now.switches.said}
    new = InForce(
        now.number + 1,
        wanted.sources.with_topics(wanted.sources.topics, checked.givens),
        checked,
        now.switches.saying(said),
        Givens({**_absent(now, wanted.given), **now.givens.said}).giving(constants),
        now.acts,
    )
    files = checked.monitors.items()
    put: dict[str, Switch] = {name: SHADOW for name, file in files if file in wanted.shadow}
    put |= {name: True for name, file in files if file in wanted.enable and new.states[name] is False}
    new = replace(new, switches=new.switches.saying({**said, **put}))
    enabled = {name: True for name in checked.monitors if now.switches.enabled(name)}
    require_whole({**new.states, **enabled, **put}, checked)
    return Coming(new, put, constants)


def switched(now: InForce, names: Collection[str], to: Switch) -> InForce:
    others = dict.fromkeys(names, to)
    require_whole({**now.states, **others}, now.checked)
    return replace(now, switches=now.switches.saying({**now.switches.said, **others}), acts=now.acts + 1)


def given(now: InForce, name: str, values: Mapping[str, GivenValue]) -> InForce:
    return replace(now, givens=now.givens.giving({name: values}), acts=now.acts + 1)


def cleared(new: InForce) -> Cleared:
    """Forget the words about monitors and values that these specifications do not have."""
    said = {name: to for name, to in new.switches.said.items() if name in new.checked.monitors}
    drawn_in = [name for name, to in new.states.items() if to == SHADOW and new.switches.own(name) != SHADOW]
    switches = new.switches.saying({**said, **dict.fromkeys(drawn_in, SHADOW)})
    dropped, givens = new.givens.dropped(new.checked), Givens(new.givens.in_force(new.checked))
    return Cleared(replace(new, switches=switches, givens=givens), drawn_in, dropped)


def constants_of(
    wanted: Wanted, checked: CheckedSpecifications, *, signed: bool
) -> dict[str, dict[str, GivenValue]]:
    require_topics(wanted.topics, checked)
    if wanted.topics and signed:
        raise SpecificationsRefusedError([_SIGNED_TOPICS])
    unknown = [name for name in wanted.constants if name not in checked.monitors]
    if unknown:
        raise SpecificationsRefusedError([unknown_monitors(unknown, checked)])
    return {
        name: parsed(checked.givens.get(name, ()), name, values) for name, values in wanted.constants.items()
    }


def unknown_monitors(names: Collection[str], checked: CheckedSpecifications) -> str:
    known = f"there are: {', '.join(checked.monitors)}" if checked.monitors else "none is loaded"
    return f"no monitor is named {', '.join(names)}; {known}"


def _absent(now: InForce, words: Mapping[str, _Word]) -> dict[str, _Word]:
    return {name: word for name, word in words.items() if name not in now.checked.monitors}
