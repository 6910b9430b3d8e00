"""Conversations of nodes with RVMaster, and what follows from each line, as text; no socket is opened.

They stand in `conversations.txt`: a line at the margin is what somebody does, the lines below it are what follows
(`tests/support/conversation.py` says how to read them).
"""

from pathlib import Path

import pytest

from tests.support.control_parts import OPEN, POLICY, ControlParts
from tests.support.conversation import Conversation

pytestmark = pytest.mark.anyio
_POLICIES = {
    "open": OPEN,
    "closed": POLICY.format("/secret=\n", "/secret=\n"),
    "no_clients": f"{OPEN}[Clients]\n",
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
async def test_conversation(title: str) -> None:
    """Each line has the effects below it, all of them and in that order."""
    written = _CONVERSATIONS[title].splitlines()
    conversation = Conversation(await ControlParts.begun(), **_POLICIES)
    took_place: list[str] = []
    for line in written:
        if not line.startswith(" "):
            took_place += [line, *(f"    {effect}" for effect in await conversation.say(line))]
    assert took_place == written
