import asyncio
import hashlib
import hmac
import json
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock, Mock

import pytest
from pydantic import TypeAdapter, ValidationError

from appliance.base import clock
from appliance.channel.channel import ChannelFullError
from appliance.features.approvals.approval_table import ApprovalEntry, HeldCall
from appliance.features.approvals.control_part import UNSENT_SECONDS, WebHook
from appliance.features.approvals.hook_link import CallSent, CallWaits, HookLink
from appliance.features.approvals.hook_process import HookSender, body_of, request_of
from appliance.features.approvals.settings import ApprovalHook
from appliance.policy.model import Category, address_of
from tests.support.memory_channel import memory_link
from tests.support.virtual_clock import let_time_pass

CALL = CallWaits(7, "10.0.0.7", "/agent", "publish", "/goal", "", 120.0)
GIVEN: dict[str, Any] = {
    "url": "https://chat.example.org/hooks/1?a=b",
    "address": "10.0.0.9:8443",
    "secret_file": Path("secret"),
}


def test_the_post_is_signed_with_its_time_and_has_the_links_of_the_settings() -> None:
    body = body_of(CALL, 118.2, "lift-7", "https://lift-7:8443")
    head, _blank, sent = request_of(ApprovalHook(**GIVEN), body, b"a secret of a site", 1700).partition(
        b"\r\n\r\n"
    )
    assert sent == body
    lines = head.decode().split("\r\n")
    assert lines[:2] == ["POST /hooks/1?a=b HTTP/1.1", "Host: chat.example.org"]
    expected = hmac.new(b"a secret of a site", b"1700." + body, hashlib.sha256).hexdigest()
    assert f"ROSRV-Signature: t=1700,v1={expected}" in lines
    fields = json.loads(body)
    assert fields["console"] == "https://lift-7:8443/console/robot"
    assert fields["text"] == (
        "lift-7: 10.0.0.7 wants to publish /goal: approval 7, 118 s left. https://lift-7:8443/console/robot"
    )


def test_text_of_an_agent_is_neither_markup_nor_a_control_character() -> None:
    hostile = CallWaits(
        7, "10.0.0.7", "/<!channel>\x1b[2J\u202e", "call", "/a&b" + "x" * 5000, "<https://evil|ok>", 1.0
    )
    body = body_of(hostile, 1.0, "", "")
    assert len(body) < 2000
    assert body.isascii()
    text = "".join(str(value) for value in json.loads(body).values())
    assert not set("<>\x1b\u202e") & set(text)
    assert "evil|ok" in text, "it is shown, not hidden"


@pytest.mark.parametrize(
    ("given", "error"),
    [
        ({"url": "http://10.0.0.9/hook"}, "is not https"),
        ({"url": "https://user@10.0.0.9/hook"}, "is not https"),
        ({"url": "https://10.0.0.9/a b"}, "has a space"),
        ({"url": "https://10.0.0.9/hook", "address": None}, "url needs address"),
        ({"url": "https://10.0.0.9/hook", "secret_file": None}, "url needs secret_file"),
        ({"url": None}, "would have no effect without url"),
        ({"address": "chat.example.org:443"}, "names are not looked up"),
        ({"console": "https://lift-7:8443/console"}, "without a path"),
    ],
)
def test_a_hook_needs_https_an_address_and_a_secret(given: dict[str, Any], error: str) -> None:
    known = {"url": "https://10.0.0.9/hook", "address": "10.0.0.9:443", "secret_file": "secret"}
    fields = {name: value for name, value in (known | given).items() if value is not None}
    with pytest.raises(ValidationError, match=error):
        TypeAdapter(ApprovalHook).validate_python(fields)


def _full(*_message: object, **_when: bool) -> None:
    raise ChannelFullError


def _entry() -> ApprovalEntry:
    call = HeldCall(address_of("10.0.0.7"), Category.PUBLISH, "/goal")
    return ApprovalEntry(7, call, None, "/agent", "", b"", 0, clock.now())  # type: ignore[arg-type]  # the hook reads no rule


@pytest.mark.anyio
async def test_an_unsent_call_is_counted_until_one_is_sent_or_ten_minutes_have_passed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hook = WebHook(wanted=True)
    hook.notify(_entry(), 120.0)
    assert hook.unsent() == (1, "its process is not running")
    channel, process = memory_link(HookLink)
    hook.link.attach(channel)
    process.attach(asyncio.get_running_loop(), lambda *_message: None, lambda: None)
    hook.notify(_entry(), 120.0)
    await asyncio.sleep(0)
    assert process.messages == [CALL]
    for sent, unsent in (
        (CallSent(7, "no answer within 5 s"), (2, "no answer within 5 s")),
        (CallSent(8, ""), (0, "")),
    ):
        process.send(sent)
        await asyncio.sleep(0)
        assert hook.unsent() == unsent
    monkeypatch.setattr(channel, "send", _full)
    hook.notify(_entry(), 120.0)
    assert hook.unsent() == (1, "its process does not read")
    assert channel.closed
    let_time_pass(UNSENT_SECONDS)
    assert hook.unsent() == (0, "")


def test_without_a_hook_no_call_is_counted() -> None:
    quiet = WebHook(wanted=False)
    quiet.notify(_entry(), 120.0)
    assert quiet.unsent() == (0, "")


@pytest.mark.anyio
async def test_a_call_that_expired_in_the_queue_is_not_sent() -> None:
    sender = HookSender(ApprovalHook(**GIVEN), "lift-7")
    assert await sender.send(CALL, clock.now() - 1) == "it expired before it could be sent"


@pytest.mark.anyio
async def test_a_short_secret_is_not_used(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("short\n")
    sender = HookSender(ApprovalHook(**GIVEN | {"secret_file": tmp_path / "secret"}), "")
    assert "fewer than 16 characters" in await sender.send(CALL, clock.now() + 10)


@pytest.mark.anyio
async def test_only_an_answer_of_2xx_shows_that_a_call_was_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "secret").write_text("a secret of this site")
    sender = HookSender(ApprovalHook(**GIVEN | {"secret_file": tmp_path / "secret"}), "")

    async def trouble(answer: bytes) -> str:
        async def connect(*_place: object, **_how: object) -> tuple[asyncio.StreamReader, Any]:
            reader, writer = asyncio.StreamReader(), Mock(drain=AsyncMock())
            reader.feed_data(answer)
            reader.feed_eof()
            return reader, writer

        monkeypatch.setattr(asyncio, "open_connection", connect)
        monkeypatch.setattr(sender, "_context", lambda: None)
        return await sender.send(CALL, clock.now() + 10)

    for status in range(100, 600):
        told = await trouble(b"HTTP/1.%d %d Words\r\n\r\n" % (status % 2, status))
        assert told == ("" if 200 <= status < 300 else f"chat.example.org answered {status}")
    for answer in (b"", b"HTTP/1.1 20", b"SSH-2.0-OpenSSH_9.2", b"HTTP/2.0 200 OK\r\n"):
        assert "is not of HTTP" in await trouble(answer)
