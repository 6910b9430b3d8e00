"""Run `conversations/*.txt`, whose form `tests/support/features/doors/door_conversation.py` defines.

With `TRANSCRIPTS=write`, a test writes the effects to its file.
"""

from pathlib import Path

import pytest

from tests.support.conversation import compare, conversations_of, played
from tests.support.features.doors.door_conversation import DoorConversation
from tests.support.features.doors.door_world import door_world

pytestmark = pytest.mark.anyio
_FILES = sorted(Path(__file__).with_name("conversations").glob("*.txt"))
_CASES = [
    (file, *one)
    for file in _FILES
    for one in conversations_of(file.read_text(encoding="utf-8")).conversations.items()
]


@pytest.mark.parametrize(
    ("file", "title", "written"), _CASES, ids=[f"{file.stem}: {title}" for file, title, _written in _CASES]
)
async def test_conversation(file: Path, title: str, written: str) -> None:
    async with door_world() as world:
        conversation = DoorConversation(world, foxglove=file.stem == "foxglove")
        took_place = await played(written, conversation.say)
        conversation.close()
    compare(file, title, written, took_place)
