"""The sentences of a driver check, which the console repeats, and its outcomes as exit statuses."""

CONSENT = (
    "While the base is driven slowly, its commands are withheld for up to {:g} s. A driver without a timeout drives on"
    " for that time: raise the wheels, or have free space and a hand on the emergency stop."
)
QUESTION = "May the base drive on?"
REQUEST = "drive slowly now, at most 0.3 m/s and 0.6 rad/s, until the outcome appears"
RESTARTED = "not measured: the appliance was restarted; its relays pass commands again after at most {:g} s"

_SENTENCES = {
    "stopped": "the driver stopped the base {:.2f} s after its last command",
    "moving": "the base still moved {:.2f} s after its last command, so the appliance sent a stop: if the appliance's"
    " machine dies, this base drives on",
    "idle": "not measured: no command moved the base slowly for a second, at most 0.3 m/s and 0.6 rad/s by its"
    " odometry, within {:.0f} s",
    "ended": "not measured: a stop command came {:.2f} s after the last motion; drive on during the measurement",
    "silent": "not measured: the odometry was silent, so the appliance sent a stop {:.2f} s after the last command",
}
_STATUSES = {"stopped": 0, "moving": 1}


def sentence_of(outcome: str, seconds: float | None, why: str = "") -> str:
    form = _SENTENCES.get(outcome)
    return f"not measured: {why}" if form is None or seconds is None else form.format(seconds)


def status_of(outcome: str) -> int:
    return _STATUSES.get(outcome, 2)
