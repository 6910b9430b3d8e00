"""Which monitors are enabled, disabled or on trial. No I/O.

A monitor that nobody has switched is enabled or not as `--enable` says. A switch goes with its monitor: another that is
loaded later under the same name is as if nobody had switched it. Monitors that share variables are on trial together
(apart from disabled ones).
"""

from collections.abc import Mapping

from appliance.rosmop.sharing import sharing
from appliance.specifications.files import Checked, SpecificationsRefusedError
from appliance.specifications.rollout import TRIAL, Switch


class Switches:
    """`said` are the switches that were made, `states` what all in force are; `enable` is what the start says."""

    def __init__(self, enable: str) -> None:
        self._all = enable == "all"
        self.named = set() if enable in {"all", "none"} else {name.strip() for name in enable.split(",")}
        self.said: dict[str, Switch] = {}
        self.states: dict[str, Switch] = {}

    def enabled(self, name: str) -> bool:
        """Whether what a monitor does is done."""
        return self.states.get(name) is True

    def on_trial(self, name: str) -> bool:
        """Whether a monitor is given copies, and what it would do is only told."""
        return self.states.get(name) == TRIAL

    def states_of(self, checked: Checked) -> dict[str, Switch]:
        """What these monitors are, or would be; what shares variables with a monitor on trial is on trial, too."""
        states: dict[str, Switch] = {
            name: self.said.get(name, self._all or name in self.named) for name in checked.monitors
        }
        if TRIAL in states.values():
            for group in sharing(checked.uses):
                if any(states[name] == TRIAL for name in group):
                    states |= {name: TRIAL for name in group if states[name] is True}
        return states

    def enforce(self, checked: Checked) -> list[str]:
        """These are in force now; which of them are on trial only because of others."""
        self.said = {name: to for name, to in self.said.items() if name in checked.monitors}
        self.states = self.states_of(checked)
        drawn_in = [name for name, to in self.states.items() if to == TRIAL and self.said.get(name) != TRIAL]
        self.said |= dict.fromkeys(drawn_in, TRIAL)
        return drawn_in


def require_whole(states: Mapping[str, Switch], checked: Checked) -> None:
    """Raises `SpecificationsRefusedError` where monitors in force share variables with some that are on trial."""
    for group in sharing(checked.uses):
        tried = sorted(name for name in group if states[name] == TRIAL)
        others = sorted(name for name in group if states[name] is True)
        if tried and others:
            text = (
                f"{', '.join(tried)} on trial and {', '.join(others)} in force do not go together,"
                " because they share variables: name them all"
            )
            raise SpecificationsRefusedError([text])
