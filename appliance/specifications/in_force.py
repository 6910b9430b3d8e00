"""The specifications in force as one value, and the orders that make the next value of it. No I/O.

An order that is refused raises `SpecificationsRefusedError`, and has changed nothing.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import msgspec

from appliance.base.actors import DISK
from appliance.channel.messages import GivenValue
from appliance.specifications.givens import DroppedValue, Given, Givens, parse, require_topics
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


class Return(msgspec.Struct, frozen=True):
    """After a time, the switch `of` gives way to `back`."""

    back: Switch
    of: Switch = False


@dataclass(frozen=True)
class InForce:
    """Specifications with everything that operators ordered about them.

    `number` is that of the revision; `acts` counts all switches and resumptions so far. `returns` are of switches for a
    time. Unless it is confirmed in time, the revision gives way to the revision `back_to`, and so do all after it.
    `since` names what operators have ordered since that one was in force: `deadman` for a switch, `deadman.vMax` for a
    constant.
    `folder_refused` is why the last start rejected the folder; empty if it did not, and in the next revision.
    """

    number: int = 0
    sources: Sources = field(default_factory=Sources)
    checked: CheckedSpecifications = field(default_factory=CheckedSpecifications)
    switches: Switches = field(default_factory=Switches)
    givens: Givens = field(default_factory=Givens)
    acts: int = 0
    returns: Mapping[str, Return] = field(default_factory=dict)
    back_to: int | None = None
    since: frozenset[str] = frozenset()
    folder_refused: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "switches", self.switches.of(self.checked))

    @property
    def tag(self) -> str:
        return f"{self.number}.{self.acts}"

    @property
    def states(self) -> Mapping[str, Switch]:
        return self.switches.states

    @property
    def promoted(self) -> list[str]:
        """The monitors that return to shadow mode unless confirmed."""
        return [name for name, one in self.returns.items() if one.of is True]


class Consent(NamedTuple):
    """The operator's consent to cut topics whose publishers have another type, and to hold topics with traffic."""

    force: bool = False
    hold: bool = False


_NO_CONSENT = Consent()


@dataclass(frozen=True, slots=True)
class Order:
    """The sources that an operator wants in force, with words about their monitors.

    `within` is the time in which it must be confirmed. `author` is the author of the revision, unless it is `who`.
    `kept` are files that are not in the folder, `loaded` those that the operator named. `shadow` and `enable` name
    files. `topics` and `constants` are given values. `switches` and `given` are for monitors that are not in force yet,
    and, if the order `undoes` a change, for all others as well. After one that is `settled`, nothing waits for a
    confirmation.
    """

    sources: Sources
    who: str = DISK
    note: str = ""
    within: float | None = None
    consent: Consent = _NO_CONSENT
    author: str = ""
    kept: Collection[str] = ()
    loaded: Collection[str] = ()
    shadow: Collection[str] = ()
    enable: Collection[str] = ()
    topics: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    constants: Given = field(default_factory=dict)
    switches: Mapping[str, Switch] = field(default_factory=dict)
    given: Given = field(default_factory=dict)
    undoes: bool = False
    settled: bool = False


class Coming(NamedTuple):
    """The next value, the monitors that the order itself switched, and the values that it gave.

    Monitors that are `drawn_in` are in shadow mode only because of others.
    """

    now: InForce
    drawn_in: Collection[str]
    dropped: Collection[DroppedValue]
    put: Mapping[str, Switch]
    given: Given


def load(now: InForce, order: Order, checked: CheckedSpecifications, *, signed: bool) -> Coming:
    """Return the next revision. With `signed`, the site signs the texts."""
    constants, before = constants_of(order, checked, signed=signed), now
    waiting = now.back_to is not None and not order.settled
    if order.undoes:
        now = _undo(now, order, checked)
    present = {name: to for name, to in now.states.items() if name in checked.switches}
    said = {**_absent(now, order.switches), **present, **now.switches.said}
    new = InForce(
        now.number + 1,
        order.sources.with_topics(order.sources.topics, checked.givens),
        checked,
        now.switches.saying(said),
        Givens({**_absent(now, order.given), **now.givens.said}).giving(constants),
        now.acts,
        now.returns,
        now.back_to if waiting else None if order.within is None else now.number,
    )
    files = checked.monitors.items()
    put: dict[str, Switch] = {name: SHADOW for name, file in files if file in order.shadow}
    put |= {name: True for name, file in files if file in order.enable and new.states[name] is False}
    ordered = put.keys() | {f"{name}.{constant}" for name, given in constants.items() for constant in given}
    since = now.since - ordered if waiting else frozenset[str]()
    new = replace(new, switches=new.switches.saying({**said, **put}), since=since)
    enabled = {name: True for name in checked.monitors if now.switches.is_enabled(name)}
    if order.undoes:
        return _with_differences(clear(new), before)
    require_whole({**new.states, **enabled, **put}, checked)
    return clear(new)._replace(put=put, given=constants)


def _undo(now: InForce, order: Order, checked: CheckedSpecifications) -> InForce:
    """Return the value with the texts and words of an order, but for what ends automatically or was ordered since."""
    former = now.switches.saying(order.switches).of(checked).states
    returns = dict(now.returns)
    for name in now.returns.keys() & former.keys() - now.since:
        of = returns[name].of
        back = former[name] if of is True else former[name] or True
        returns |= {name: Return(back, of)}
    returns = {name: one for name, one in returns.items() if one.back != one.of}
    kept = now.since | now.returns.keys()
    said = {name: to for name, to in now.switches.said.items() if name in kept}
    values = {
        monitor: {name: value for name, value in given.items() if f"{monitor}.{name}" in now.since}
        for monitor, given in now.givens.said.items()
    }
    given = Givens(order.given).giving(Givens(values).in_force(checked))
    switches = now.switches.saying({**order.switches, **said})
    return replace(now, checked=checked, switches=switches, givens=given, returns=returns)


def _with_differences(coming: Coming, before: InForce) -> Coming:
    """Return it with the switches and values of `before` that it replaces."""
    new = coming.now
    put = {
        name: to
        for name, to in new.states.items()
        if before.states.get(name, to) != to and name not in coming.drawn_in
    }
    given = {
        name: {
            state.name: state.value
            for state in new.givens.states(new.checked, name)
            if state.name in old and state.value != old[state.name]
        }
        for name in new.checked.monitors
        if (old := {state.name: state.value for state in before.givens.states(before.checked, name)})
    }
    return coming._replace(put=put, given={name: values for name, values in given.items() if values})


def switch(
    now: InForce, names: Collection[str], to: Switch, *, timed: bool = False, due: bool = False
) -> InForce:
    """Return the value after a switch. A `timed` switch returns to the one before all timed ones, when it is `due`."""
    others = dict.fromkeys(names, to)
    require_whole({**now.states, **others}, now.checked)
    returns = {name: one for name, one in now.returns.items() if name not in others}
    for name in others if timed else ():
        back = now.returns[name].back if name in now.returns else now.states[name] or True
        returns[name] = Return(back, to)
    switches = now.switches.saying({**now.switches.said, **others})
    since = now.since if timed or due else now.since | others.keys()
    return replace(now, switches=switches, acts=now.acts + 1, returns=returns, since=since)


def confirm(now: InForce) -> InForce:
    returns = {name: one for name, one in now.returns.items() if one.of is not True}
    return replace(now, returns=returns, back_to=None)


def give(now: InForce, name: str, values: Mapping[str, GivenValue]) -> InForce:
    since = now.since | {f"{name}.{constant}" for constant in values}
    return replace(now, givens=now.givens.giving({name: values}), acts=now.acts + 1, since=since)


def clear(new: InForce) -> Coming:
    """Forget the words about monitors and values that these specifications do not have."""
    said = {name: to for name, to in new.switches.said.items() if name in new.checked.monitors}
    drawn_in = [name for name, to in new.states.items() if to == SHADOW and new.switches.own(name) != SHADOW]
    switches = new.switches.saying({**said, **dict.fromkeys(drawn_in, SHADOW)})
    dropped, givens = new.givens.dropped_values(new.checked), Givens(new.givens.in_force(new.checked))
    returns = {name: one for name, one in new.returns.items() if new.states.get(name) == one.of}
    now = replace(new, switches=switches, givens=givens, returns=returns)
    return Coming(now, drawn_in, dropped, {}, {})


def constants_of(
    order: Order, checked: CheckedSpecifications, *, signed: bool
) -> dict[str, dict[str, GivenValue]]:
    require_topics(order.topics, checked)
    if order.topics and signed:
        raise SpecificationsRefusedError([_SIGNED_TOPICS])
    unknown = [name for name in order.constants if name not in checked.monitors]
    if unknown:
        raise SpecificationsRefusedError([unknown_monitors(unknown, checked)])
    return {
        name: parse(checked.givens.get(name, ()), name, values) for name, values in order.constants.items()
    }


def unknown_monitors(names: Collection[str], checked: CheckedSpecifications) -> str:
    known = f"there are: {', '.join(checked.monitors)}" if checked.monitors else "none is loaded"
    return f"no monitor is named {', '.join(names)}; {known}"


def _absent(now: InForce, words: Mapping[str, _Word]) -> dict[str, _Word]:
    return {name: word for name, word in words.items() if name not in now.checked.monitors}
