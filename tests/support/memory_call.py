"""A call of a verb, with an appliance in memory: `verb.function(call_of(answer), …)`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from typer.core import TyperCommand

from appliance.channel.admin import AdminAnswer
from appliance.cli.connection.admin_client import AdminSocket
from appliance.cli.connection.target import Appliance, _Target


class MemorySocket(AdminSocket):
    """The client of an admin socket where `answer` returns the body of each answer, or the whole of a rejection."""

    def __init__(self, answer: Callable[[Any], Any]) -> None:
        super().__init__(Path("state"))
        self._answer = answer

    def ask(self, request: Any) -> AdminAnswer[Any]:
        body = self._answer(request)
        return body if isinstance(body, AdminAnswer) else AdminAnswer(True, body)


def call_of(
    answer: Callable[[Any], Any],
    *,
    as_json: bool = False,
    place: str | None = None,
    names: Callable[[str], str] = str,
) -> Appliance:
    """Return the call of a verb whose requests `answer` answers. `names` gives a host in words."""
    call = Appliance(TyperCommand("verb"))
    call.params = {"as_json": as_json}
    call.target = _Target(MemorySocket(answer), said=True, place=place)
    call.host_in_words = names
    return call
