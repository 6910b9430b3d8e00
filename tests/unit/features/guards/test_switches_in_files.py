"""A guard's file says whether the guard is on, so that it is in force without the state of before."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.channel import admin
from appliance.channel.answers.monitor_answers import Monitors, MonitorState
from appliance.cli.monitor_changes import write_switches
from appliance.control.operators.new_state import LACKS
from appliance.features.guards import released as released_presets
from appliance.features.guards import requests as guard_requests
from appliance.features.guards.evidence import guard_digest
from appliance.features.guards.guard_answers import GuardRow
from appliance.features.guards.guard_words import afresh_in_words
from appliance.features.guards.presets import PRESETS, Guard, text_of, with_values
from appliance.features.guards.released import origin_of
from appliance.features.guards.view import GUARDS_VIEW, GuardsState
from appliance.specifications.checking import contents
from appliance.specifications.specification_manager import SpecificationManager
from rosmop.form.switch_words import Word, file_switch, with_file_switch, without_file_switch
from tests.support.answers import example
from tests.support.memory_call import call_of
from tests.unit.features.guards.guard_desk import monitors_of
from tests.unit.features.guards.test_guard_orders import orders_of
from tests.unit.specifications.monitor_desk import WaitingManager

pytestmark = pytest.mark.anyio
WORDS: tuple[Word | None, ...] = (None, "on", "shadow", "off")
DEADMAN = Guard("deadman", PRESETS["deadman"])
PLAIN = text_of(DEADMAN)


def said(word: Word | None) -> str:
    return text_of(replace(DEADMAN, switch=word))


@pytest.mark.parametrize("word", WORDS)
def test_the_word_is_kept_and_does_not_belong_to_the_guard(word: Word | None) -> None:
    text = said(word)
    found = contents({"deadman.rv": text}, {}, lints=False)
    assert found.switches == ({"deadman": word} if word else {})
    assert (file_switch(text), without_file_switch(text)) == (word, PLAIN)
    assert found.states == contents({"deadman.rv": PLAIN}, {}, lints=False).states
    assert origin_of(text) == "current"
    assert guard_digest(DEADMAN.preset, text, {}) == guard_digest(DEADMAN.preset, PLAIN, {})
    assert file_switch(with_values(text, {"silent": "0.5"})) == word
    for other in WORDS:
        assert with_file_switch(text, other) == said(other)


@pytest.mark.parametrize("name", ["on", "off", "shadow"])
def test_a_guard_may_have_the_name_of_a_word(name: str) -> None:
    text = text_of(replace(DEADMAN, name=name, switch="on"))
    assert contents({"a.rv": text}, {}, lints=False).switches == {name: "on"}
    assert file_switch(text) == "on" and file_switch(text_of(replace(DEADMAN, name=name))) is None


STARTS = [(enable, word) for enable in ("none", "all", "shadow") for word in WORDS]


@pytest.mark.parametrize(("enable", "word"), STARTS)
async def test_a_new_state_directory_begins_as_the_file_says(
    tmp_path: Path, enable: str, word: Word | None
) -> None:
    by_setting: dict[str, Word] = {"none": "off", "all": "on", "shadow": "shadow"}
    async with monitors_of(tmp_path, {"deadman.rv": said(word)}, enable=enable) as monitors:
        assert monitors.lasting("deadman") == (word or by_setting[enable])
        assert monitors.afresh("deadman") == (word or by_setting[enable])


def disable(monitors: SpecificationManager) -> Any:
    return monitors.switch(admin.MonitorSwitch(["deadman"], False), "eve")


def load(text: str) -> Callable[[SpecificationManager], Any]:
    return lambda monitors: monitors.load(admin.MonitorLoad({"deadman.rv": text}), "eve")


async def nothing(_monitors: SpecificationManager) -> None: ...


LATER: dict[str, tuple[Callable[[SpecificationManager], Any], Word]] = {
    "nothing": (nothing, "on"),
    "a switch": (disable, "off"),
    "a file of 0.4.0": (load(PLAIN), "on"),
    "a file that says off": (load(said("off")), "on"),
}


@pytest.mark.parametrize("what", LATER)
async def test_the_stored_switch_wins_over_each_later_file(tmp_path: Path, what: str) -> None:
    order, then = LATER[what]
    async with monitors_of(tmp_path, {"deadman.rv": said("on")}, enable="none") as first:
        await order(first)
        assert first.lasting("deadman") == then
        assert isinstance(first, WaitingManager)
        for word in WORDS:
            (first.desk.folder / "deadman.rv").write_text(said(word))
            assert (await first.desk.monitors("none")).lasting("deadman") == then


async def test_a_load_that_is_taken_back_leaves_the_switch_as_it_was(tmp_path: Path) -> None:
    async with monitors_of(tmp_path, {"deadman.rv": PLAIN}, enable="all") as monitors:
        await load(said("off"))(monitors)
        await monitors.roll_back(admin.MonitorRollback(), "eve")
        assert monitors.lasting("deadman") == "on"


def alarms(state: GuardsState | None) -> dict[str, str]:
    assert state is not None
    found = {alarm.kind: alarm.text for alarm in GUARDS_VIEW.states[0].alarms(state)}
    return {kind: text for kind, text in found.items() if kind.startswith(("guard-off", "guard-older"))}


@pytest.mark.parametrize(("enable", "command"), [("none", "enable"), ("shadow", "enforce")])
async def test_a_guard_without_a_switch_is_a_warning_with_the_command(
    tmp_path: Path, enable: str, command: str
) -> None:
    async with monitors_of(tmp_path, {"deadman.rv": PLAIN}, enable=enable) as monitors:
        orders = orders_of(monitors)
        found = alarms(orders.state())
        assert [*found] == ["guard-off:deadman"]
        assert found["guard-off:deadman"].endswith(f": rosrv monitor {command} deadman")
        await disable(monitors)
        assert alarms(orders.state()) == {}  # an operator's switch is listed as switched off


@pytest.mark.parametrize("edited", [False, True])
async def test_an_older_guard_in_force_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edited: bool
) -> None:
    version = DEADMAN.preset.version
    (tmp_path / f"deadman-{version}.rv").write_text(DEADMAN.preset.text)
    newer = DEADMAN.preset.text.replace(f"preset deadman {version};", f"preset deadman {version + 1};")
    monkeypatch.setattr(released_presets, "FOLDER", tmp_path)
    text = said("on").replace("? 9 :", "? 8 :") if edited else said("on")
    async with monitors_of(tmp_path, {"deadman.rv": text}, enable="none") as monitors:
        orders = orders_of(monitors)
        assert alarms(orders.state()) == {}
        monkeypatch.setitem(PRESETS, "deadman", replace(DEADMAN.preset, source=newer))
        origin_of.cache_clear()
        [(kind, told)] = alarms(orders.state()).items()
        assert kind == "guard-older:deadman"
        assert f"has deadman {version}; the present version is {version + 1}" in told
        remedy = "rosrv guard remove deadman" if edited else "rosrv guard upgrade deadman --when-standing"
        assert told.endswith(remedy) and ("edited" in told) is edited
        await disable(monitors)
        assert alarms(orders.state()) == {}
    origin_of.cache_clear()


async def test_an_upgraded_guard_has_its_present_switch(tmp_path: Path) -> None:
    async with monitors_of(tmp_path, {"deadman.rv": PLAIN}, enable="none") as monitors:
        orders = orders_of(monitors)
        assert (await orders.guards(guard_requests.GuardsWanted())).guards[0].afresh == "off"
        await monitors.switch(admin.MonitorSwitch(["deadman"], True), "eve")
        await monitors.switch(admin.MonitorSwitch(["deadman"], False, for_seconds=600), "eve")
        assert monitors.lasting("deadman") == "on"


ROW = example(GuardRow, name="a", file="a.rv", confirm_by=None, off_until=None, origin="current")


@pytest.mark.parametrize(
    ("state", "afresh", "said"),
    [
        ("free", "on", ""),
        ("holding", "off", "would be disabled: rosrv monitor enable a,"),
        ("shadow", "absent", "the folder of specifications: rosrv monitor enable a --shadow,"),
        ("off", "on", "would be in force: rosrv monitor disable a,"),
    ],
)  # fmt: skip
def test_the_list_names_guards_that_a_new_state_directory_changes(state: str, afresh: str, said: str) -> None:
    told = afresh_in_words(msgspec.structs.replace(ROW, state=state, afresh=afresh))
    assert said in told and bool(told) == bool(said)


def written(
    folder: Path | None, text: str, *, lasting: str = "off", place: str | None = None, **loaded: Any
) -> None:
    row = example(MonitorState, name="deadman", file="deadman.rv", lasting=lasting)
    plain: dict[str, Any] = {"folder": None if folder is None else str(folder), "site_keys": []}
    answer = example(Monitors, monitors=[row], files={"deadman.rv": text}, **plain | loaded)
    write_switches(call_of(lambda _request: answer, place=place), ["deadman"])


def test_the_word_of_the_folders_own_file_is_changed(tmp_path: Path) -> None:
    file = tmp_path / "deadman.rv"
    written(tmp_path, said("on"))
    assert file.read_text() == said("off")
    file.write_text("// mine\n" + PLAIN)  # not at the beginning: it stays as it is
    written(tmp_path, PLAIN)
    assert file.read_text() == "// mine\n" + PLAIN
    file.write_text(said("on").replace("? 9 :", "? 8 :"))  # edited, and not loaded
    written(tmp_path, PLAIN, lasting="shadow")
    assert file.read_text() == said("shadow").replace("? 9 :", "? 8 :")
    written(tmp_path, "other() { }")
    assert [one.name for one in tmp_path.iterdir()] == ["deadman.rv"]


@pytest.mark.parametrize("why", ["rest", "no folder", "signed", "not writable"])
def test_a_switch_that_is_only_in_the_state_directory_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], why: str
) -> None:
    (tmp_path / "deadman.rv").write_text(said("on"))
    if why == "not writable":
        (tmp_path / "deadman.rv").unlink()
        (tmp_path / "deadman.rv").mkdir()
    written(
        None if why == "no folder" else tmp_path,
        PLAIN,
        place="https://10.0.0.2:8443" if why == "rest" else None,
        site_keys=["ours"] if why == "signed" else [],
    )
    told = " ".join(capsys.readouterr().out.split())
    assert "the switch of deadman is only in the state directory" in told
    assert "write `off` behind its name" in told
    if why != "not writable":
        assert (tmp_path / "deadman.rv").read_text() == said("on")


def test_the_page_has_a_row_for_each_part_that_a_new_state_directory_lacks() -> None:
    page = Path("docs/reference/processes.md").read_text(encoding="utf-8")
    table = page.partition("### A new state directory")[2].partition("\n## ")[0]
    rows = [line.split(" | ")[0].removeprefix("| ") for line in table.splitlines() if line.startswith("| ")]
    assert rows[1:] == [*LACKS]
