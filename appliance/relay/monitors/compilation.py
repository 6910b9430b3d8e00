"""Specifications compiled to monitors: what `Compiler` does, beside the loop."""

import time
from collections.abc import Callable
from functools import cache

from appliance.channel.messages import SpecificationsStated
from appliance.relay.monitors.compiler import Result
from appliance.ros.definitions import Definitions
from appliance.ros.errors import DefinitionError
from appliance.ros.standard import standard_definitions
from appliance.rosmop.certify.properties import certificates_of
from appliance.rosmop.engine import MonitorSet
from appliance.rosmop.sent import decoded
from appliance.rosmop.syntax.errors import SpecificationError

_TICKS_SECONDS = 0.2  # of processor time that ticks and deadlines may take in one go
_TRIAL_TICKS_SECONDS = 0.02


def compiled(message: SpecificationsStated) -> Result:
    """The set that these specifications make, or what is wrong with them."""
    if message.compiled:
        monitors = MonitorSet.of(
            decoded(message.compiled).part(message.enabled),
            message.on_fault,
            _patience,
            trials=message.trials,
            trial_patience=lambda: _patience(_TRIAL_TICKS_SECONDS),
            slices=message.slices,
        )
        monitors.write_module()
        return monitors
    try:
        if not message.files:
            return MonitorSet.load({}, Definitions({}), message.on_fault, _patience)
        definitions = _standard().extended(Definitions.from_files(message.definitions))
        monitors = MonitorSet.load(
            dict(message.files),
            definitions,
            message.on_fault,
            _patience,
            trials=message.trials,
            trial_patience=lambda: _patience(_TRIAL_TICKS_SECONDS),
            margins=True,
            slices=message.slices,
        )
        for part in (monitors, *monitors.trials):
            # Control has checked its own: these are what will judge.
            _, wrong = certificates_of(part.monitors)
            if wrong:
                return [str(finding) for finding in wrong]
        monitors.write_module()
        return monitors
    except SpecificationError as error:
        return [str(finding) for finding in error.findings]
    except DefinitionError as error:
        return [str(error)]


def prepare() -> None:
    """Make what every specification needs: the parser, ROS's own definitions, the library of modules."""
    text = "prepare() { event e() /t std_msgs/Empty '{}' { } }"
    compiled(SpecificationsStated(0, [("prepare.rv", text)], {}, {}, restarted=False))


@cache
def _standard() -> Definitions:
    return standard_definitions()


def _patience(seconds: float = _TICKS_SECONDS) -> Callable[[], bool]:
    ends = time.thread_time() + seconds
    return lambda: time.thread_time() > ends
