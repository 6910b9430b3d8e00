from rosmop.check.sources import compiled_from
from rosmop.fast.build import fast_path_of
from rosmop.run.engine import MonitorSet
from rosmop.run.readout import MAX_CHARACTERS, MAX_ELEMENTS, MAX_VALUES, Readout
from rosmop.tests.acting import definitions, message

SECOND = 10**9


def on(body: str, variables: str = "", event: str = "") -> str:
    return f"a() {{ {variables} {event} event e(int x) /t std_msgs/Int32 '{{data:x}}' {{ {body} }} }}"


def started(text: str, shadows: tuple[str, ...] = ()) -> MonitorSet:
    monitors = MonitorSet.of(compiled_from({"a.rv": text}, definitions()), shadows=shadows)
    monitors.start(0)
    return monitors


def read(text: str, *values: int, later: int = 0) -> Readout:
    """Read the variables out `later` than the last value, of which one comes a second."""
    monitors = started(text)
    for time, value in enumerate(values, 1):
        monitors.process("/t", bytearray(message("std_msgs/Int32", data=value)), time * SECOND)
    found = monitors.read_out("a", len(values) * SECOND + later)
    assert found is not None
    return found


def test_variables_are_as_the_last_message_left_them() -> None:
    variables = "int n = 0; bool on = false; double d = NAN; std::string s; ros::Duration took(0.5);"
    readout = read(on('n += x; on = true; d = x / 2.0; s = "é";', variables), 3, 4)
    assert readout == ({"n": 7, "on": True, "d": 2.0, "s": "é", "took": 0.5}, {})


def test_numbers_that_are_not_finite_are_text() -> None:
    assert read(on("", "double d = NAN, up = INFINITY;")).values == {"d": "nan", "up": "inf"}


def test_long_values_are_cut() -> None:
    grows = 'for (int i = 0; i < 300; i++) { all.push_back(i); s += "x"; }'
    values = read(on(grows, "std::vector<int> all; std::string s;"), 1).values
    assert values["all"] == [*range(MAX_ELEMENTS), f"… {300 - MAX_ELEMENTS} more"]
    assert values["s"] == "x" * MAX_CHARACTERS + f"… {300 - MAX_CHARACTERS} more"


def test_values_beyond_the_limit_are_left_out() -> None:
    values = read(on("", "".join(f"int n{number} = 0;" for number in range(MAX_VALUES + 5)))).values
    assert [*values.values()].count("…") == 5


def test_ages_of_events_grow_and_are_none_before_the_first() -> None:
    other = "event f() /u std_msgs/Empty '{}' { }"
    text = on("if (age(f) > 1 && age(e) > 1) { n = 1; }", "int n = 0;", other)
    assert read(text, 1, later=SECOND // 2).ages == {"e": 0.5, "f": None}


def test_a_monitor_in_shadow_mode_is_read_and_an_unknown_one_is_not() -> None:
    monitors = started(on("n = x;", "int n = 4;"), ("a",))
    assert monitors.read_out("a", SECOND) == ({"n": 4}, {})
    assert monitors.read_out("b", SECOND) is None


def test_reading_leaves_the_state_in_the_module() -> None:
    compiled = compiled_from({"a.rv": on("n += x;", "int n = 0;")}, definitions())
    monitors = MonitorSet.of(compiled, fast=fast_path_of(compiled))
    monitors.start(0)

    def took(number: int) -> bool:
        """Whether the module takes a message."""
        data, time = bytearray(message("std_msgs/Int32", data=2)), number * SECOND
        outcome = monitors.process_fast("/t", data, time, lambda lane: lane.prepare(
            loud=False, told=[True], counted=[], source=0
        ))  # fmt: skip
        return outcome is not None or monitors.process("/t", data, time) is None

    assert not took(1), "the first message is the engine's"
    [group] = monitors.kept_groups()
    group.base()
    assert took(2)
    before = group.cells()
    assert before
    assert monitors.read_out("a", 2 * SECOND) == ({"n": 4}, {})
    assert group.cells() == before
    assert took(3)
    assert monitors.read_out("a", 3 * SECOND) == ({"n": 6}, {})
