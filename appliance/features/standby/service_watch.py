"""Judge whether the control of an active appliance serves the robot, by its reports.

An appliance that holds the lease without serving is worse than none, because the other one sees a healthy holder. So
the lease is given away when control reports an obstacle (a full disk), is silent, or does not get ready.

A control that died has `RESTART_SECONDS`, because topics and monitors need no control. After a lapse there are no
relays, so the other appliance takes over sooner, unless a monitor would lose its state and hold its topics.

If the lease is given away soon, all limits are doubled until this appliance serves steadily, so that two appliances
that cannot serve do not keep passing it back and forth.
"""

from appliance.features.standby.witness.protocol import EXPIRY

OBSTACLE_SECONDS = EXPIRY  # another process may lock the log for a moment
SILENT_SECONDS = 4.0  # the supervisor kills a silent control after 5 s; its next start takes seconds
START_SECONDS = 5.0
RESTART_SECONDS = 10.0
STEADY_SECONDS = 4.0
_MOST_DOUBLINGS = 5


class ServiceWatch:
    """The reports of control while this appliance is active."""

    def __init__(self) -> None:
        self._active = False
        self._cold = False
        self._keeps_state = True
        self._served = 0.0  # time of the last report without an obstacle; at first of the activation
        self._serves = False  # whether the present control has served
        self._ready: float | None = None  # time of the first report without an obstacle in this activation
        self._obstacle = ""
        self._obstacle_since = 0.0
        self._doublings = 0

    def linked(self) -> None:
        self._serves, self._obstacle = False, ""

    def reported(self, now: float, obstacle: str, *, keeps_state: bool) -> None:
        self._keeps_state = keeps_state
        if not obstacle:
            self._served, self._serves, self._cold = now, True, False
            self._ready = now if self._ready is None else self._ready
            if now - self._ready > STEADY_SECONDS:
                self._doublings = 0
        elif not self._obstacle:
            self._obstacle_since = now
        self._obstacle = obstacle

    def fault(self, now: float, *, active: bool, present: bool = True) -> str:
        """Note whether the lease is held (`active`), and whether control stands by or serves (`present`); return why
        to give the lease away, or an empty string.
        """
        if active and not self._active:
            self._served, self._cold = now, not present
            self._ready = None
            self.linked()
        self._active = active
        if not active:
            return ""
        if self._cold and not self._keeps_state:
            return "control has just started when the lease came back"
        scale = 1 << self._doublings
        if self._obstacle:
            late = now - self._obstacle_since > scale * OBSTACLE_SECONDS
            return self._obstacle if late else ""
        silent = now - self._served
        limit = START_SECONDS if self._ready is None else RESTART_SECONDS
        if silent <= scale * (SILENT_SECONDS if self._serves else limit):
            return ""
        what = "has not reported" if self._serves else "has not been ready"
        return f"control {what} for {silent:.1f} s"

    def given_away(self) -> None:
        if self._cold:
            return  # the other one stands by, and nothing was tried here
        steady = self._ready is not None and self._served - self._ready > STEADY_SECONDS
        if not steady:
            self._doublings = min(self._doublings + 1, _MOST_DOUBLINGS)
