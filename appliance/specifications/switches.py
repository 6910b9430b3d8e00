"""Track which monitors are enabled, disabled or in shadow mode (`SHADOW`). No I/O.

`--enable` applies to monitors that no operator has switched. Monitors that share variables are in shadow mode
together.
"""

import json
from collections.abc import Mapping

from appliance.specifications.rollout import SHADOW, Switch
from appliance.specifications.specification_files import CheckedSpecifications, SpecificationsRefusedError

SWITCHES = "monitor switches"


class Switches:
    """The states of monitors; `said` has the switches of operators, `enable` is the start option."""

    def __init__(self, enable: str) -> None:
        self.starts_in_shadow = enable == "shadow"
        self._all: Switch = SHADOW if self.starts_in_shadow else enable == "all"
        words = {"all", "none", "shadow"}
        self.named = set() if enable in words else {name.strip() for name in enable.split(",")}
        self.said: dict[str, Switch] = {}
        self.states: dict[str, Switch] = {}

    def restore(self, text: str) -> None:
        self.said = json.loads(text)

    def enabled(self, name: str) -> bool:
        return self.states.get(name) is True

    def in_shadow(self, name: str) -> bool:
        return self.states.get(name) == SHADOW

    def shadowed(self) -> list[str]:
        return [name for name, state in self.states.items() if state == SHADOW]

    def switched_off(self) -> dict[str, Switch]:
        return {name: to for name, to in self.said.items() if to is not True and self.states.get(name) == to}

    def states_of(self, checked: CheckedSpecifications) -> dict[str, Switch]:
        states = {name: self._own(name) for name in checked.monitors}
        if SHADOW in states.values():
            for group in checked.sharing:
                if any(states[name] == SHADOW for name in group):
                    states |= {name: SHADOW for name in group if states[name] is True}
        return states

    def shadows_of(self, checked: CheckedSpecifications) -> frozenset[str]:
        return frozenset(name for name, state in self.states_of(checked).items() if state == SHADOW)

    def _own(self, name: str) -> Switch:
        return self.said.get(name, self._all or name in self.named)

    def enforce(self, checked: CheckedSpecifications) -> list[str]:
        """Return the monitors that are in shadow mode only because of others."""
        self.said = {name: to for name, to in self.said.items() if name in checked.monitors}
        self.states = self.states_of(checked)
        drawn_in = [name for name, to in self.states.items() if to == SHADOW and self._own(name) != SHADOW]
        self.said |= dict.fromkeys(drawn_in, SHADOW)
        return drawn_in


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
