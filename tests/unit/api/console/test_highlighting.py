import re
from pathlib import Path

import appliance.api
from rosmop.logics.catalogue import LOGICS

LANGUAGES = Path(appliance.api.__file__).parent / "console" / "js" / "parts" / "languages.js"


def test_every_logic_is_highlighted() -> None:
    match = re.search(r'KEYWORDS = new Set\("([^"]+)"', LANGUAGES.read_text(encoding="utf-8"))
    assert match is not None
    assert LOGICS.keys() - set(match[1].split()) == set()
