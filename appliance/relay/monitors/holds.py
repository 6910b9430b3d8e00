"""Let monitors hold their topics when specifications are loaded, and report those that hold to control."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from appliance.channel.messages import SpecificationsStated, SpecificationsTaken

if TYPE_CHECKING:
    from rosmop.run.engine import MonitorSet


def hold_begun(monitors: "MonitorSet", message: SpecificationsStated, switches: Mapping[str, bool]) -> None:
    """Let monitors that began in their initial state hold their topics, if they moved or cannot be built.

    A disabled monitor guarded nothing, so it does not hold its topics.
    """
    for monitor in monitors.monitors:
        if monitor.name not in monitors.began:
            continue
        if monitor.name in message.moved and not monitor.held:
            monitors.hold_lost(
                monitor, "it moved to another relay process, and its state remained in the previous one"
            )
        if monitor.name in message.unbuilt and monitor.held_channels and not monitor.code.begins:
            monitors.hold(monitor, f"its file has an error: {message.unbuilt[monitor.name]}")
        if monitor.why_held and not switches.get(monitor.name, True):
            monitors.resume(monitor.name)


def taken(
    message: SpecificationsStated, began: list[str], monitors: "MonitorSet | None"
) -> SpecificationsTaken:
    held = [] if monitors is None else [one for one in monitors.monitors if one.held]
    because = {one.name: one.why_held for one in held if one.why_held}
    return SpecificationsTaken(
        message.revision, began, [one.name for one in held], message.statement, because
    )
