"""Conversations of nodes with RVMaster as text, with the effects of each line; no socket is opened.

`conversations.txt` has them: a line at the margin is an action, the indented lines below it are its effects
(`tests/support/conversation.py` describes the form).
"""

from pathlib import Path

import pytest

from appliance.master.reconcile import liveness
from tests.support.control_parts import OPEN, POLICY, ControlParts
from tests.support.conversation import Conversation

pytestmark = pytest.mark.anyio
_PARAMETERS = f"{OPEN}[Parameters]\nwrite default=*\n"
_POLICIES = {
    "open": OPEN,
    "closed": POLICY.format("/secret=\n", "/secret=\n"),
    "no_clients": f"{OPEN}[Clients]\n",
    "alike": "[Groups]\nsome = 10.0.0.0/24\n" + OPEN.replace("[Nodes]\n", "[Nodes]\n/some=some\n"),
    "closed_to_publishers": POLICY.format("/secret=\n", ""),
    "exact": f"{_PARAMETERS}read /arm = 10.0.0.5\nread /arm/free = 10.0.0.5\nread default = 10.0.0.9\n",
    "whole": f"{_PARAMETERS}read /arm/** = 10.0.0.5\nread default = 10.0.0.9\n",
    "no_parameters": _PARAMETERS,
    "closed_to_subscribers": POLICY.format("", "/secret=\n"),
    "no_service": f"{OPEN}[Services]\n/secret=\ndefault=*\n",
    "no_secret_parameter": f"{_PARAMETERS}read default=*\nread /secret=\n",
    "no_server": f"{OPEN}[Services]\ndefault = 10.0.0.3\n",
    "no_setting": OPEN.replace("[Commands]\n", "[Commands]\nsetParam=10.0.0.9\n"),
    "limited": f"{OPEN}[Limits]\n/chatter = publisher 10.0.0.1 30 Hz, subscriber 5 Hz\n",
}
_TEXTS = (
    Path(__file__)
    .with_name("conversations.txt")
    .read_text(encoding="utf-8")
    .removeprefix("# ")
    .split("\n\n# ")
)
_CONVERSATIONS = dict(text.strip().split("\n", 1) for text in _TEXTS)


@pytest.mark.parametrize("title", _CONVERSATIONS)
async def test_conversation(title: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each action has exactly the effects below it, in that order."""
    # Checks of lost nodes would begin on their own during a later action.
    monkeypatch.setattr(liveness, "_RECENTLY_LOST_SECONDS", 3600.0)
    written = _CONVERSATIONS[title].splitlines()
    conversation = Conversation(await ControlParts.begun(), **_POLICIES)
    took_place: list[str] = []
    for line in written:
        if not line.startswith(" "):
            took_place += [line, *(f"    {effect}" for effect in await conversation.say(line))]
    assert took_place == written
