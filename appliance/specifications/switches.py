"""Which monitors are enabled, disabled or in shadow mode (`TRIAL`). No I/O.

A monitor that no operator has switched is as `--enable` says: `all` are enabled, or `none`, or those that are named, or
all are in shadow mode (`shadow`). A switch goes with its monitor: another one that is loaded later under the same name
starts as if it had not been switched. Monitors that share variables are in shadow mode together (apart from disabled
ones).
"""

from collections.abc import Mapping

from appliance.specifications.rollout import TRIAL, Switch
from appliance.specifications.specification_files import Checked, SpecificationsRefusedError
from rosmop.form.connected_groups import sharing


class Switches:
    """`said` are the switches that were made, `states` what all in force are; `enable` is what the start says."""

    def __init__(self, enable: str) -> None:
        self._all: Switch = TRIAL if enable == "shadow" else enable == "all"
        words = {"all", "none", "shadow"}
        self.named = set() if enable in words else {name.strip() for name in enable.split(",")}
        self.said: dict[str, Switch] = {}
        self.states: dict[str, Switch] = {}

    def enabled(self, name: str) -> bool:
        """Whether what a monitor does is done."""
        return self.states.get(name) is True

    def on_trial(self, name: str) -> bool:
        """Whether a monitor is in shadow mode: it gets copies, and what it would have done is recorded."""
        return self.states.get(name) == TRIAL

    def tried(self) -> list[str]:
        """The monitors in shadow mode."""
        return [name for name, state in self.states.items() if state == TRIAL]

    def switched_off(self) -> dict[str, Switch]:
        """The monitors that an operator disabled or put into shadow mode, by order and not by configuration."""
        return {name: to for name, to in self.said.items() if to is not True and self.states.get(name) == to}

    def states_of(self, checked: Checked) -> dict[str, Switch]:
        """What these monitors are, or would be; what shares variables with a monitor on trial is on trial, too."""
        states = {name: self._own(name) for name in checked.monitors}
        if TRIAL in states.values():
            for group in sharing(checked.uses):
                if any(states[name] == TRIAL for name in group):
                    states |= {name: TRIAL for name in group if states[name] is True}
        return states

    def _own(self, name: str) -> Switch:
        """Return how a monitor is switched, apart from those that it shares variables with."""
        return self.said.get(name, self._all or name in self.named)

    def enforce(self, checked: Checked) -> list[str]:
        """These are in force now; which of them are on trial only because of others."""
        self.said = {name: to for name, to in self.said.items() if name in checked.monitors}
        self.states = self.states_of(checked)
        drawn_in = [name for name, to in self.states.items() if to == TRIAL and self._own(name) != TRIAL]
        self.said |= dict.fromkeys(drawn_in, TRIAL)
        return drawn_in


def require_whole(states: Mapping[str, Switch], checked: Checked) -> None:
    """Raises `SpecificationsRefusedError` where monitors in force share variables with some that are on trial."""
    for group in sharing(checked.uses):
        tried = sorted(name for name in group if states[name] == TRIAL)
        others = sorted(name for name in group if states[name] is True)
        if tried and others:
            text = (
                f"{', '.join(tried)} in shadow mode and {', '.join(others)} in force do not go together,"
                " because they share variables: name them all"
            )
            raise SpecificationsRefusedError([text])
