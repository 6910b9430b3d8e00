import json
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.features.fleet import verbs
from appliance.features.fleet.connection import CollectorConnection, reason_in
from appliance.formats.fleet_membership import JoinRequest

_CERTIFICATE = "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"
_INVITATION = {
    "robot": "arm7", "collector": "https://192.0.2.9:8444", "authority": "", "receipt_key": "", "expires": 1,
    "token": "rosrv-join_0123456789012345678901234567890123456789012",
}  # fmt: skip


@pytest.mark.parametrize(("pinned", "sent"), [(None, "of the signer"), ("pinned", "pinned")])
def test_a_join_needs_no_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pinned: str | None, sent: str
) -> None:
    state, posted = tmp_path / "state", list[JoinRequest]()
    for folder, text in (("signer", "of the signer"), ("control", pinned)):
        (state / folder).mkdir(parents=True)
        if text is not None:
            (state / folder / "audit.pub").write_text(text)
    invitation = tmp_path / "arm7.json"
    invitation.write_text(json.dumps(_INVITATION))

    def post(_collector: CollectorConnection, _path: str, body: bytes) -> None:
        posted.append(msgspec.json.decode(body, type=JoinRequest))

    def prepared(folder: Path, _invitation: Any) -> str:
        folder.mkdir()
        (folder / "invitation").touch()
        return _CERTIFICATE

    monkeypatch.setattr(CollectorConnection, "post", post)
    monkeypatch.setattr(verbs, "prepare_membership", prepared)
    verbs.join(invitation, state)
    assert [request.key for request in posted] == [sent]


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (b'{"detail": "arm7 is enrolled with another key: rosrv-fleet robot remove arm7"}',
         "arm7 is enrolled with another key: rosrv-fleet robot remove arm7"),
        ('{"detail": "a robot Größe is enrolled"}'.encode(), "a robot Größe is enrolled"),
        (b'{"detail": "clear\\u001b[2J"}', "clear\\x1b[2J"),
        (b"<h1>Bad Gateway</h1>", "<h1>Bad Gateway</h1>"),
        (b'{"detail": [{"loc": ["body"]}]}', '{"detail": [{"loc": ["body"]}]}'),
        (b"\xff", "\N{REPLACEMENT CHARACTER}"),
        (b"", "no reason"),
        (b'{"detail": "' + b"x" * 9000 + b'"}', "x" * 500),
    ],
    ids=["detail", "unicode", "escape", "proxy", "other json", "not text", "empty", "long"],
)  # fmt: skip
def test_a_refusal_is_shown_as_a_sentence(body: bytes, reason: str) -> None:
    assert reason_in(body) == reason
