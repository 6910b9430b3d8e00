"""Decide which monitors hold their topics after specifications were loaded, beyond those whose state was lost."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from appliance.channel.messages import SpecificationsStated

if TYPE_CHECKING:
    from rosmop.run.engine import MonitorSet


def hold_begun(monitors: "MonitorSet", message: SpecificationsStated, switches: Mapping[str, bool]) -> None:
    """Let monitors that began in their initial state hold their topics, if they moved or have no code.

    A disabled monitor guarded nothing, so it need not hold its topics.
    """
    for monitor in monitors.monitors:
        if monitor.name not in monitors.began:
            continue
        if monitor.name in message.moved and not monitor.held:
            monitors.hold_lost(
                monitor, "it moved to another relay process, and its state remained in the previous one"
            )
        if monitor.name in message.unbuilt and not monitor.code.begins:
            monitor.hold(f"its file has an error: {message.unbuilt[monitor.name]}")
        if monitor.why_held and not switches.get(monitor.name, True):
            monitor.resume()
