"""A verb with `--watch` goes on at every rejection: a takeover, a restart or much to do ends none."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import pytest
import typer

import appliance
from appliance.channel.admin import AdminAnswer, Trouble
from appliance.cli import status_verb, status_watch
from appliance.cli.connection.target import Appliance
from appliance.features.approvals import verbs
from appliance.features.standby import live_verbs
from tests.support.memory_call import call_of

WATCHING: dict[str, Callable[[Appliance], Any]] = {
    "status": lambda call: status_verb.status.function(call, watch=True),
    "standby status": lambda call: live_verbs.status.function(call, watch=True),
    "approve": lambda call: verbs.approve.function(call, None, watch=True),
}
FINAL = {("standby status", "unknown")}  # the appliance is not of a pair
ENOUGH = 5


@pytest.mark.parametrize("trouble", get_args(Trouble))
@pytest.mark.parametrize("verb", WATCHING)
def test_a_watch_goes_on_at_each_rejection(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], verb: str, trouble: Trouble
) -> None:
    monkeypatch.setattr(status_watch, "_SECONDS", 0)
    monkeypatch.setattr(verbs, "_EVERY_SECONDS", 0)
    asked: list[object] = []

    def answer(request: object) -> AdminAnswer[object]:
        asked.append(request)
        if len(asked) == ENOUGH:
            raise KeyboardInterrupt
        return AdminAnswer(False, error="not now", trouble=trouble)

    try:
        WATCHING[verb](call_of(answer))
    except typer.Exit as ended:
        assert ended.exit_code
    assert (len(asked) < ENOUGH) == ((verb, trouble) in FINAL)
    assert "not now" in "".join(capsys.readouterr())


def test_all_watching_verbs_are_known() -> None:
    sources = [path.read_text() for path in Path(appliance.__file__).parent.rglob("*verb*.py")]
    assert sum(len(re.findall(r"^    watch: ", text, re.MULTILINE)) for text in sources) == len(WATCHING)
