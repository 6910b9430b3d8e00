import itertools
import json
from typing import Any

import pytest

from appliance.features.evidence.page import Names, Page

KINDS = [
    ("info", "deny"), ("notice", None), ("notice", "deny"), ("warning", None), ("alarm", None), ("alarm", "deny"),
]  # fmt: skip
SPAN: dict[str, Any] = {"runs": [(1, 5000)], "since": 0, "until": 9, "log": "l", "members": {}, "missing": []}


def record(sequence: int, kind: tuple[str, str | None], reason: str) -> bytes:
    row = {"sequence": sequence, "time": 1, "event": "e", "host": "10.0.0.66", "caller_id": "/x", "resource": "/y",
           "detail": "{}", "reason": reason, "severity": kind[0], "decision": kind[1]}  # fmt: skip
    return json.dumps(row).encode() + b"\n"


@pytest.mark.parametrize(("flood", "act"), [*itertools.permutations(KINDS, 2)])
def test_no_flood_of_one_kind_hides_a_record_of_another(
    flood: tuple[str, str | None], act: tuple[str, str | None]
) -> None:
    page = Page(None, Names("arm", str))
    page.add(b"".join(record(number, flood, "FLOOD") for number in range(2001)))
    page.add(record(5000, act, "THE ACT"))
    html = page.html(SPAN).decode()
    assert "THE ACT" in html and html.count("FLOOD") == 2000
    assert f"<p>1 more of the kind {' '.join(filter(None, flood))} are in records.ndjson only.</p>" in html
