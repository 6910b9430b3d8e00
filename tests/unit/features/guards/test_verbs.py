import errno
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
import typer

from appliance.base.option_group import GroupedCommand, GroupedVerb
from appliance.channel import admin
from appliance.channel.admin import AdminAnswer
from appliance.channel.answers.monitor_answers import (
    GivenSet,
    GivenState,
    MonitorReadout,
    Monitors,
    MonitorState,
    Replacement,
    Switched,
)
from appliance.features.guards import show_verb, suggest_verb, verbs
from appliance.features.guards.guard_answers import (
    GuardList,
    GuardPlan,
    GuardRow,
    LastStop,
    LoadedSuggestion,
    Suggestion,
    Suggestions,
)
from appliance.features.guards.presets import (
    PRESETS,
    Guard,
    GuardError,
    Parameter,
    Preset,
    loaded_values,
    text_of,
    topics_in,
    types_in,
    values_in,
)
from appliance.features.guards.requests import (
    GuardNew,
    GuardSuggestionsWanted,
    GuardsWanted,
    GuardTry,
    GuardUpgrade,
)
from appliance.features.guards.upgrades import plan, same
from rosmop.types.roles import ANY_TYPE
from tests.support.answers import example
from tests.support.memory_call import call_of
from tests.unit.features.guards.test_released import made

LOADED = [
    GuardRow(name, "fence", "", "stopping", {"command": "/cmd_vel"}, {}, [], {}, 3, version=1, origin=origin,
             below=["silent=0 is below the standard"] * (name == "old"), digest=f"digest of {name}",
             last_stop=LastStop(5, until, 2, "at the edge", "10.0.0.7", "/teleop", "18e9") if until != 0 else None)
    for name, origin, until in (("fence", "current", None), ("old", "older", 7), ("mine", "changed", 0))
]  # fmt: skip


class Robot:
    """An appliance with guards: its answers, and the orders that it got. `loaded` are the rows of its guards."""

    place: str | None = None
    off = False
    readout = MonitorReadout("fence", {}, {}, 0.0)

    def __init__(
        self, folder: Path | None, *guards: Guard, shadow: bool = False, as_json: bool = False
    ) -> None:
        self.as_json = as_json
        self.orders: list[Any] = []
        self.refused = ["it would hold /c"]
        self.files = {f"{guard.name}.rv": text_of(guard) for guard in guards}
        self.folder = None if folder is None else str(folder)
        self.loaded = LOADED
        margin = {"name": "margin", "value": 0.2, "default": 0.2, "kind": "double"}
        self.rows = [
            example(MonitorState, name=guard.name, file=f"{guard.name}.rv", shadow=shadow, enabled=not shadow,
                    topics=["/cmd_vel"], given=[margin])
            for guard in guards
        ]  # fmt: skip

    def answer(self, request: Any) -> Any:
        match request:
            case GuardSuggestionsWanted():
                return Suggestions(
                    [Suggestion("fence", "fence", "Keeps the base inside.", {"command": "/cmd_vel", "by": "/odom"},
                                {"silent": "0.2"}, {}, "rosrv guard new fence", {"by": ["/wheels"]})],
                    [LoadedSuggestion("mine", "deadman", {"command": "/cmd_vel"})],
                    ["/estop_enabled: its name does not say whether true stops"],
                    ["no button stops /cmd_vel"],
                )  # fmt: skip
            case GuardsWanted():
                return GuardList(2, "2", [], self.loaded, ["fence acts before rate"])
            case GuardTry():
                assert request.upgrade or request.values == {"margin": "0.5"}
                assert not request.enforce
                return GuardPlan(2, "2", "fence", "", "", False, False, {"margin": ["0.2", "0.5"]},
                                 {"command": "/c"}, 3, [], self.refused, self.off)  # fmt: skip
            case admin.MonitorsWanted():
                loaded = example(Monitors, files=self.files, folder=self.folder)
                return msgspec.structs.replace(loaded, monitors=self.rows)
            case admin.MonitorValuesWanted():
                return self.readout
        self.orders.append(request)
        if isinstance(request, GuardNew):
            preset = PRESETS[request.preset]
            self.files[f"{request.name}.rv"] = text_of(
                Guard(request.name, preset, request.topics, request.types, request.values)
            )
            lasting = "shadow" if request.shadow else "on"
            file = f"{request.name}.rv"
            self.rows.append(example(MonitorState, name=request.name, file=file, lasting=lasting))
        return _changed(request)


def _changed(order: Any) -> Any:
    if isinstance(order, admin.MonitorGive):
        return GivenSet(order.name, [*order.values], [], 2, "2.1")
    if isinstance(order, admin.MonitorShadow):
        return Switched(["fence"], 2, "2.1")
    shadow = [order.name] if isinstance(order, GuardNew) and order.shadow else []
    within = getattr(order, "confirm_within", None)
    return Replacement(2, "2.0", 1, [], [], [], [], [], [], [], within, shadow=shadow)


FENCE = Guard("fence", PRESETS["fence"], types={"command": "geometry_msgs/Twist", "by": "nav_msgs/Odometry"})


def run(verb: Any, robot: Robot, *arguments: Any, **options: Any) -> Any:
    call = call_of(robot.answer, as_json=robot.as_json, place=robot.place)
    verb.function(call, *arguments, **options)
    return robot.orders[0] if robot.orders else None


def test_a_new_guard_is_loaded_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    order = run(verbs.new, Robot(tmp_path), "fence", "/cmd_vel", ["margin=0.5"], by="/odom", shadow=True)
    topics = {"command": "/cmd_vel", "by": "/odom"}
    assert order == GuardNew("fence", topics, {"margin": "0.5"}, name="fence", shadow=True)
    text = (tmp_path / "fence.rv").read_text()
    assert (
        text.startswith("preset fence ") and " as fence shadow {" in text and "\n    margin = 0.5;\n" in text
    )
    assert "rosrv guard enforce fence" in capsys.readouterr().out


@pytest.mark.parametrize("new", [True, False])
def test_a_dry_run_prints_the_plan_and_changes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], new: bool
) -> None:
    robot = Robot(tmp_path, FENCE)
    with pytest.raises(typer.Exit):
        if new:
            run(verbs.new, robot, "fence", "/cmd_vel", ["margin=0.5"], dry_run=True)
        else:
            run(verbs.set_values, robot, "fence", ["margin=0.5"], dry_run=True)
    assert capsys.readouterr().out.splitlines() == [
        "would load nothing; fence would keep its state, in force", "would set margin=0.5, now 0.2",
        "topics: command=/c", "would be refused: it would hold /c",
    ]  # fmt: skip
    assert (robot.orders, [*tmp_path.iterdir()]) == ([], [])


def test_a_guard_that_may_roll_back_is_not_written(tmp_path: Path) -> None:
    """A start would load it from the folder before it is confirmed."""
    order = run(verbs.new, Robot(tmp_path), "speed", "/cmd_vel", confirm_within="5m")
    assert order.confirm_within == 300 and not [*tmp_path.iterdir()]


def test_json_changes_no_less(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = Robot(tmp_path, FENCE, as_json=True)
    run(verbs.new, robot, "speed", "/cmd_vel")
    assert (tmp_path / "speed.rv").exists()
    run(verbs.set_values, robot, "fence", ["margin=0.5", "polygon=0,0 1,0 1,1"])
    assert "\n    polygon = 0,0 1,0 1,1;\n" in (tmp_path / "fence.rv").read_text()
    run(verbs.remove, robot, "fence")
    assert not (tmp_path / "fence.rv").exists()
    shown = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [one["revision"] for one in shown] == [2] * len(robot.orders) == [2] * 3


@pytest.mark.parametrize("new", [True, False])
def test_json_refuses_no_less(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, new: bool) -> None:
    robot, replayed = Robot(tmp_path, FENCE, as_json=True), list[str]()
    monkeypatch.setattr(verbs, "_replay", lambda _robot, row, _text, _since: replayed.append(row.name))
    verb, options = (verbs.new, ("fence", "/cmd_vel")) if new else (verbs.set_values, ("fence",))
    with pytest.raises(typer.Exit) as ended:
        run(verb, robot, *options, ["margin=0.5"], dry_run=True)
    assert (ended.value.exit_code, replayed) == (1, [])
    monkeypatch.setattr(robot, "refused", [])
    run(verb, robot, *options, ["margin=0.5"], dry_run=True)
    assert replayed == ([] if new else ["fence"])


@pytest.mark.parametrize("status", [1, 2, 3])
def test_a_plan_holds_without_the_flight_recorder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    def replay(*_given: Any, **_options: Any) -> None:
        raise typer.Exit(status)

    monkeypatch.setattr(verbs, "verb_function", lambda *_verb: GroupedVerb(replay, GroupedCommand))
    robot = Robot(tmp_path, FENCE)
    robot.refused = []
    run(verbs.set_values, robot, "fence", ["margin=0.5"], dry_run=True)
    with pytest.raises(typer.Exit):
        run(verbs.set_values, robot, "fence", ["margin=0.5"], dry_run=True, since="soon")


def test_a_plan_holds_without_the_verb_for_replays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(verbs, "verb_function", lambda *_verb: None)
    robot = Robot(tmp_path, FENCE)
    robot.refused = []
    run(verbs.set_values, robot, "fence", ["margin=0.5"], dry_run=True)
    assert "this appliance cannot replay recordings" in capsys.readouterr().out


def test_a_disabled_guard_is_not_planned_in_force(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = Robot(tmp_path, FENCE)
    robot.off, robot.refused = True, []
    run(verbs.new, robot, "fence", "/cmd_vel", ["margin=0.5"], dry_run=True)
    assert "fence would keep its state, disabled" in capsys.readouterr().out


@pytest.mark.parametrize("as_json", [True, False])
def test_a_folder_that_cannot_be_changed_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], as_json: bool
) -> None:
    """In a read-only file system, as in compose.yaml, even the removal of a missing file fails."""

    def fails(_path: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "unlink", fails)
    robot = Robot(tmp_path, FENCE, as_json=as_json)
    run(verbs.remove, robot, "fence")
    shown = capsys.readouterr()
    assert "not removed" not in shown.out + shown.err
    (tmp_path / "fence.rv").write_text("x")
    run(verbs.remove, robot, "fence")
    shown = capsys.readouterr()
    assert "fence.rv is not removed: Read-only file system" in (shown.err if as_json else shown.out)


def test_over_rest_no_folder_of_this_machine_changes(tmp_path: Path) -> None:
    robot = Robot(tmp_path, FENCE)
    robot.place = "https://10.0.0.2:8443"
    (tmp_path / "fence.rv").write_text("x")
    run(verbs.new, robot, "speed", "/cmd_vel")
    run(verbs.remove, robot, "fence")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("fence.rv", "x")]


def test_a_constant_is_set_and_a_polygon_is_loaded(tmp_path: Path) -> None:
    robot = Robot(tmp_path, FENCE, shadow=True)
    run(verbs.set_values, robot, "fence", ["margin=0.5", "polygon=0,0 1,0 1,1"])
    [load] = robot.orders  # one change of both, so that none of them is in force without the other
    assert (load.name, load.shadow, load.given) == ("fence", True, {"margin": "0.5"})
    assert "\n    polygon = 0,0 1,0 1,1;\n" in load.text
    robot.orders.clear()
    for values in (["polygon=0,0 1,0 1,1", "margin=99"], ["nothing=1"], ["margin"]):
        with pytest.raises(GuardError):
            run(verbs.set_values, robot, "fence", values)
    assert not robot.orders


def test_a_guard_is_brought_into_force_and_removed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = Robot(tmp_path, FENCE)
    (tmp_path / "fence.rv").write_text("x")
    order = run(verbs.enforce, robot, "fence", confirm_within="5m")
    assert order == admin.MonitorShadow(["fence"], False, confirm_within=300)
    run(verbs.remove, robot, "fence", confirm_within="5m")
    assert (tmp_path / "fence.rv").exists()
    run(verbs.remove, robot, "fence")
    assert not (tmp_path / "fence.rv").exists()
    assert capsys.readouterr().out.count("undo: rosrv guard new fence /cmd_vel\n") == 1
    robot.files["fence.rv"] = "fence() { }"
    with pytest.raises(GuardError, match="no guard is named fence"):
        run(verbs.remove, robot, "fence")


def test_lists_and_proposals_are_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(verbs.list_guards, Robot(tmp_path, FENCE))
    shown = capsys.readouterr().out
    assert all(f"{name}: {preset.what}" in shown for name, preset in PRESETS.items())
    assert shown.startswith(
        "guard fence: fence on /cmd_vel, in force, stopping, 3 stops, since 1970-01-01 00:00Z: at the edge"
        " (/teleop on 10.0.0.7)\n"
        "guard old: fence 1, older: rosrv guard upgrade old; on /cmd_vel, in force, stopping, 3 stops,"
        " last until 1970-01-01 00:00Z: at the edge (/teleop on 10.0.0.7)\n"
        "    silent=0 is below the standard\n"
        "guard mine: fence 1, changed: not the text of the preset; on /cmd_vel, in force, stopping, 3 stops\n"
        "fence acts before rate\n"
        "the presets for further guards:\n"
    )
    run(suggest_verb.suggest, Robot(None))
    assert capsys.readouterr().out == (
        "loaded: mine (deadman on /cmd_vel)\n"
        "rosrv guard new fence\n"
        "    Keeps the base inside.\n"
        "    from the current rate: silent; check these defaults: "
        "margin=0.2, ahead=0.5, inward=0.3, worldFrame=false, wheelbase=0.25, lat0=0, lon0=0, "
        "polygon=-2,-2 2,-2 2,2 -2,2; "
        "instead of /odom: /wheels\n"
        "/estop_enabled: its name does not say whether true stops\n"
        "not protected:\n"
        "    no button stops /cmd_vel\n"
    )
    run(suggest_verb.suggest, Robot(None, as_json=True))
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == {"loaded": "mine", "preset": "deadman", "topics": {"command": "/cmd_vel"}}
    assert (lines[1]["command"], lines[1]["others"]) == ("rosrv guard new fence", {"by": ["/wheels"]})
    assert lines[2]["left_out"].startswith("/estop_enabled")
    assert lines[3:] == [{"not_protected": "no button stops /cmd_vel"}]


@pytest.mark.parametrize(("now", "shown"), [(1.7e9 + 65, ("15.00 s ago", "[65.00 s ago, in 0.50 s, 0]")),
                                            (None, ("1.7e+09", "[1.7e+09, 1.7e+09, 0]"))])  # fmt: skip
def test_a_value_that_is_a_time_has_an_age(
    now: float | None, shown: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    robot = Robot(None, FENCE)
    robot.loaded = [msgspec.structs.replace(LOADED[0], file="fence.rv")]
    values = {"until": 1.7e9 + 50, "gap": 0.25, "top": [1.7e9, 1.7e9 + 65.5, 0.0], "lastX": 1e300}
    robot.readout = MonitorReadout("fence", values, {}, 0.0, now_seconds=now)
    run(show_verb.show, robot, "fence")
    lines = [re.split(r"  +", line.strip()) for line in capsys.readouterr().out.splitlines()]
    assert lines[-4:] == [
        ["until", shown[0], "seconds: the age of the position until which it is permitted"],
        ["gap", "0.25", "seconds between two positions"],
        ["top", shown[1], "the fastest motion and turn since the position"],
        ["lastX", "1e+300", "the motion in force"],
    ]


def test_each_guard_of_the_list_has_its_digest_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    run(verbs.list_guards, Robot(None, as_json=True))
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    digests = {line["guard"]: line["digest"] for line in lines if "guard" in line}
    assert digests == {name: f"digest of {name}" for name in ("fence", "old", "mine")}


def test_all_guards_of_an_older_version_are_upgraded_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = Robot(tmp_path, Guard("old", PRESETS["fence"], types=FENCE.types))
    assert run(verbs.upgrade, robot) == GuardUpgrade("old")
    assert (tmp_path / "old.rv").read_text() == robot.files["old.rv"].replace(" as old {", " as old on {")
    robot.orders.clear()
    run(verbs.upgrade, robot, "old", confirm_within="5m")
    assert robot.orders == [GuardUpgrade("old", confirm_within=300.0)]
    capsys.readouterr()
    with pytest.raises(typer.Exit):
        run(verbs.upgrade, robot, dry_run=True)
    assert "would be refused: it would hold /c" in capsys.readouterr().out
    for options in ({"confirm_within": "5m"}, {"further": ["by=/odom"]}):
        with pytest.raises(GuardError, match="for one guard"):
            run(verbs.upgrade, robot, **options)
    robot.orders.clear()
    run(verbs.upgrade, robot, "old", further=["by=/other"])
    assert robot.orders == [GuardUpgrade("old", {"by": "/other"})]


def test_a_guard_that_cannot_be_upgraded_does_not_keep_the_others_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = Robot(tmp_path, Guard("old", PRESETS["fence"], types=FENCE.types))
    robot.loaded = [
        GuardRow(name, "fence", "", "free", {}, {}, [], {}, 0, origin="older") for name in ("bad", "old")
    ]
    answer, asked = robot.answer, list[str]()

    def without_bad(request: Any) -> Any:
        match request:
            case GuardUpgrade("bad"):
                return AdminAnswer(False, error="it is damaged", trouble="refused")
            case GuardUpgrade(name):
                asked.append(name)
        return answer(request)

    monkeypatch.setattr(robot, "answer", without_bad)
    with pytest.raises(typer.Exit):
        run(verbs.upgrade, robot)
    assert asked == ["old"]


def shown(guard: Guard) -> GuardRow:
    """Return the guard as an appliance shows it."""
    text = text_of(guard)
    constants = [_stated(one, guard.values[one.name]) for one in guard.preset.parameters if not one.loads]
    return GuardRow(
        guard.name, guard.preset.name, "", "shadow", dict(guard.topics), types_in(text), constants,
        loaded_values(text), 0, version=guard.preset.version, origin="current", below=[], digest="",
    )  # fmt: skip


def _stated(parameter: Parameter, text: str) -> GivenState:
    """Return a value that is in the text of a guard, so it is also its default."""
    number = int if parameter.kind == "int" else float
    value = text == "true" if parameter.kind == "bool" else number(text)
    return GivenState(parameter.name, parameter.kind, value, parameter.unit, default=value)


@pytest.mark.parametrize("place", [0, -1])
@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_the_undo_of_a_removal_makes_the_same_guard(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], preset: Preset, place: int
) -> None:
    kinds = tuple(types[place].replace(ANY_TYPE, "sensor_msgs/Joy") for types in preset.topics.values())
    guard = made(preset, kinds)
    if "frozen" in guard.values:  # of any other type only the silence is judged
        guard = replace(guard, values={**guard.values, "frozen": "0"})
    robot = Robot(tmp_path, guard)
    robot.loaded = [shown(guard)]
    run(verbs.remove, robot, guard.name)
    [undo] = [line for line in capsys.readouterr().out.splitlines() if line.startswith("undo: ")]
    words = iter(shlex.split(undo)[4:])
    values, options = [], []
    for word in words:
        if word.startswith("--"):
            options.append((word, "" if word == "--shadow" else next(words)))
        else:
            values.append(word)
    robot.orders.clear()
    order = run(
        verbs.new, robot, *values[:2], values[2:], shadow=("--shadow", "") in options,
        **{name: value for option, value in options if (name := option.strip("-")) in {"by", "name"}},
        further=[value for option, value in options if option == "--topic"],
        kinds=[value for option, value in options if option == "--type"],
    )  # fmt: skip
    again = text_of(plan(PRESETS[order.preset], order.name, order.topics, [], order.values, order.types))
    assert order.shadow and (topics_in(again), types_in(again)) == (guard.topics, guard.types)
    found = values_in(again)
    assert found.keys() == guard.values.keys()
    assert all(same(found[name], value) for name, value in guard.values.items())


@pytest.mark.parametrize(
    ("values", "options"),
    [
        (["vMax=1", "vMax=2"], {}),
        ([], {"further": ["by=/a", "by=/b"]}),
        ([], {"by": "/a", "further": ["by=/b"]}),
        ([], {"further": ["command=/b"]}),
        ([], {"kinds": ["command=geometry_msgs/Twist", "command=geometry_msgs/TwistStamped"]}),
    ],
)
def test_an_argument_that_is_given_twice_is_refused(tmp_path: Path, values: list[str], options: Any) -> None:
    robot = Robot(tmp_path)
    with pytest.raises(GuardError, match=r"has two values, .* and .*: give one"):
        run(verbs.new, robot, "speed", "/cmd_vel", values, **options)
    assert not robot.orders
