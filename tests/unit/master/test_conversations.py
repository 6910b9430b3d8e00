"""Run `conversations/*.txt`, whose form `tests/support/conversation.py` defines.

With `TRANSCRIPTS=write`, a test writes the effects to its file.
"""

import os
from pathlib import Path

import pytest

from appliance.master.reconcile import liveness
from tests.support.conversation import conversations_of, taken_place

pytestmark = pytest.mark.anyio
_FILES = {file.stem: file for file in sorted(Path(__file__).with_name("conversations").glob("*.txt"))}
_READ = {name: conversations_of(file.read_text(encoding="utf-8")) for name, file in _FILES.items()}
_CASES = [(name, title) for name, read in _READ.items() for title in read.conversations]


@pytest.mark.parametrize(("name", "title"), _CASES)
async def test_conversation(name: str, title: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # Checks of lost nodes would begin on their own during a later action.
    monkeypatch.setattr(liveness, "RECENTLY_LOST_SECONDS", 3600.0)
    written = _READ[name].conversations[title]
    took_place = await taken_place(_READ[name], title)
    if took_place != written and os.environ.get("TRANSCRIPTS") == "write":
        text = _FILES[name].read_text(encoding="utf-8")
        text = text.replace(f"# {title}\n{written}\n", f"# {title}\n{took_place}\n")
        _FILES[name].write_text(text, encoding="utf-8")
    assert took_place.splitlines() == written.splitlines()
