"""Run `conversations/*.txt`, whose form `tests/support/conversation.py` defines.

With `TRANSCRIPTS=write`, a test writes the effects to its file.
"""

from pathlib import Path

import pytest

from appliance.master.reconcile import liveness
from tests.support.conversation import compare, conversations_of, taken_place

pytestmark = pytest.mark.anyio
_FILES = {file.stem: file for file in sorted(Path(__file__).with_name("conversations").glob("*.txt"))}
_READ = {name: conversations_of(file.read_text(encoding="utf-8")) for name, file in _FILES.items()}
_CASES = [(name, title) for name, read in _READ.items() for title in read.conversations]


@pytest.mark.parametrize(("name", "title"), _CASES)
async def test_conversation(name: str, title: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # Checks of lost nodes would begin on their own during a later action.
    monkeypatch.setattr(liveness, "RECENTLY_LOST_SECONDS", 3600.0)
    written = _READ[name].conversations[title]
    compare(_FILES[name], title, written, await taken_place(_READ[name], title))
