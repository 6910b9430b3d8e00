"""Write the state of two appliances in one line."""

from appliance.features.standby.answers import OtherAppliance, StandbyState, WitnessSeen
from appliance.features.standby.summary import is_silent, lag_of, lasting
from appliance.features.view import Pieces


def standby_line(state: StandbyState) -> tuple[str, Pieces]:
    other, witness = lag_in_words(state.other), answer_in_words(state.witness)
    line = f"{state.name} is {state.role}; {state.other.name}: {other}; witness: {witness}"
    return "standby", [(line, "yellow" if state.troubles else "")]


def lag_in_words(other: OtherAppliance) -> str:
    if other.connected:
        return "in sync" if other.in_sync else lag_of(other)
    return connection(other)


def answer_in_words(witness: WitnessSeen) -> str:
    seconds = witness.answered_seconds
    if seconds is None:
        return "has never answered"
    if is_silent(witness):
        return f"silent for {lasting(seconds)}"
    return "refuses" if witness.refusal else "answers"


def connection(other: OtherAppliance) -> str:
    if other.connected:
        return "connected"
    away = "" if other.trouble_seconds is None else f" for {lasting(other.trouble_seconds)}"
    return f"away{away}" + (f": {other.reason}" if other.reason else "")
