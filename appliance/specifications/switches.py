"""The switches of monitors: enabled, disabled, or in shadow mode (`SHADOW`). No I/O.

A monitor that is new here begins as the word in its file says (`preset deadman 3 as deadman on {`), or else as
`--enable` says. The word is then a switch like those of operators, so a later file takes no monitor out of force.
Monitors that share variables are in shadow mode together.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from appliance.specifications.specification_files import CheckedSpecifications, SpecificationsRefusedError
from rosmop.form.switch_words import Word

SHADOW: Literal["shadow"] = "shadow"
Switch = bool | Literal["shadow"]
"""Whether a monitor's actions take effect; in shadow mode they are only reported."""

SWITCHES = "monitor switches"
_WORDS = frozenset({"all", "none", "shadow"})
_OF_FILES: Mapping[Word, Switch] = {"on": True, "shadow": SHADOW, "off": False}


@dataclass(frozen=True, slots=True)
class Switches:
    """The states of monitors in force; `said` has the switches of operators and files, `enable` is the start option."""

    enable: str = "all"
    said: Mapping[str, Switch] = field(default_factory=dict)
    states: Mapping[str, Switch] = field(default_factory=dict)
    """Follows from the other fields and the monitors."""

    @property
    def starts_in_shadow(self) -> bool:
        return self.enable == SHADOW

    @property
    def named(self) -> set[str]:
        return set() if self.enable in _WORDS else {name.strip() for name in self.enable.split(",")}

    def of(self, checked: CheckedSpecifications) -> "Switches":
        """Return the same switches for the monitors of these specifications, with the words of their files."""
        words = {name: _OF_FILES[word] for name, word in checked.switches.items()}
        known = replace(self, said={**words, **self.said})
        return replace(known, states=known.states_of(checked))

    def saying(self, said: Mapping[str, Switch]) -> "Switches":
        return replace(self, said=said)

    def is_enabled(self, name: str) -> bool:
        return self.states.get(name) is True

    def in_shadow(self, name: str) -> bool:
        return self.states.get(name) == SHADOW

    def shadowed_monitors(self) -> list[str]:
        return [name for name, state in self.states.items() if state == SHADOW]

    def switched_off(self) -> dict[str, Switch]:
        return {name: to for name, to in self.said.items() if to is not True and self.states.get(name) == to}

    def states_of(self, checked: CheckedSpecifications) -> dict[str, Switch]:
        states = {name: self.own(name) for name in checked.monitors}
        if SHADOW in states.values():
            for group in checked.sharing:
                if any(states[name] == SHADOW for name in group):
                    states |= {name: SHADOW for name in group if states[name] is True}
        return states

    def own(self, name: str) -> Switch:
        """Return the switch of a monitor, without those that share its variables."""
        return self.said.get(
            name, SHADOW if self.starts_in_shadow else self.enable == "all" or name in self.named
        )


def word_of(switch: Switch) -> Word:
    """Return the word of a file for a switch."""
    return next(word for word, to in _OF_FILES.items() if to == switch)


def require_whole(states: Mapping[str, Switch], checked: CheckedSpecifications) -> None:
    """Raise `SpecificationsRefusedError` if monitors in force share variables with monitors in shadow mode."""
    for group in checked.sharing:
        shadowed = sorted(name for name in group if states[name] == SHADOW)
        others = sorted(name for name in group if states[name] is True)
        if shadowed and others:
            text = (
                f"{', '.join(shadowed)} in shadow mode and {', '.join(others)} in force do not go together,"
                " because they share variables: name them all"
            )
            raise SpecificationsRefusedError([text])
