"""A set's module does what the interpreter does: bytes, drops, variables, states of properties; and what it leaves."""

import struct
from collections import Counter
from collections.abc import Iterable
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosmop.check.sources import compiled_from
from rosmop.fast import wasm_runner
from rosmop.fast.abi import AREA
from rosmop.fast.batch_codegen import MAX_EFFECTS
from rosmop.fast.codegen_access import MOST_TEXTS
from rosmop.fast.memory_layout import LINES
from rosmop.fast.wasm_runner import BEGINNING
from rosmop.logics.interface import ClockedRun, FiniteRun
from rosmop.run.causes import Sender
from rosmop.run.engine import MonitorSet
from rosmop.run.execution import OnFault
from rosmop.run.fast_path import FastLane
from rosmop.run.outcomes import Outcome, Verdict, named
from rosmop.runtime.action_context import LogLine, Published
from rosmop.runtime.wire import Buffer
from rosmop.tests.acting import message
from rosmop.tests.examples import examples
from rosmop.tests.interpreted import beside, check_same
from rosmop.tests.on_module import on_module
from rosmop.tests.random_specifications import Messages, Specifications, definitions
from rosmop.tests.reload import replaced
from rosmop.text.errors import SpecificationError

FEW = settings(max_examples=examples(90), suppress_health_check=list(HealthCheck))
STAMPED = struct.pack("<I3sIIdhI2dBI", 3, b"abc", 9, 8, 2.5, 1, 2, 0.5, 7.0, 1, 0)


def plain(count: int = 0, x: float = 0.0, kind: int = 0, rest: bytes = b"") -> bytes:
    """An `own/Plain`."""
    return struct.pack("<BidfBII3qI", kind, count, x, 0.0, 0, 5, 7, 1, 2, 3, len(rest)) + rest


def frames(bodies: Iterable[bytes]) -> bytes:
    """Messages as they come."""
    return b"".join(struct.pack("<I", len(body)) + body for body in bodies)


class Fed:
    """A set with its module, and the same whose functions the interpreter runs, both started."""

    def __init__(self, *texts: str, on_fault: OnFault = "drop", margins: bool = False) -> None:
        sources = {f"{place}.rv": text for place, text in enumerate(texts)}
        self.monitors = on_module(compiled_from(sources, definitions(), margins=margins), on_fault)
        self.interpreter = beside(self.monitors)
        for one in (self.monitors, self.interpreter):
            one.start(0)
            for monitor in one.monitors:
                monitor.seen = True
        self.came: Counter[str] = Counter()
        self.told: list[Verdict] = []
        """Each verdict, and why, in order."""
        self.interpreted: list[Verdict] = []
        """The same of the interpreter."""
        self.counts: Counter[str] = Counter()
        """How often there was each verdict, whoever came to it."""
        self.lines: list[LogLine] = []
        """What was put out since it was checked last."""
        self.published: list[Published] = []
        """The same of what was published."""
        self.counting = False
        """Whether verdicts are only counted."""
        self._inside = False
        """Whether messages stand in the module's memory, every other time."""

    def walker(self, topic: str = "/plain") -> FastLane:
        """The walk of a topic; there is one."""
        found = self.monitors.walker(topic)
        assert found is not None
        return found

    def check(self, bodies: list[bytes], topic: str = "/plain", time: int = 1) -> list[bytes]:
        """Fail if messages that come together make a difference; what goes on."""
        expected = []
        began, self.counts = len(self.interpreted), Counter()
        lines: list[LogLine] = []
        published: list[Published] = []
        for body in bodies:
            outcome = self.interpreter.process(topic, bytearray(body), time)
            self.interpreted += (one for each in (*outcome.before, outcome) for one in each.verdicts)
            lines += (line for each in (*outcome.before, outcome) for line in each.log)
            published += (one for each in (*outcome.before, outcome) for one in each.published)
            self.came[outcome.result if not outcome.faults else "fault"] += 1
            if outcome.result != "dropped":
                expected.append(bytes(outcome.buffer))
        self._inside = not self._inside
        told, self.lines, self.published = len(self.told), [], []
        assert self._fed(frames(bodies), topic, time) == frames(expected)
        assert self.counts + Counter(map(named, self.told[told:])) == Counter(
            map(named, self.interpreted[began:])
        )
        assert self.lines == lines
        assert self.published == published
        assert self.counting or self.told[told:] == self.interpreted[began:]
        assert self.state() == _state(self.interpreter)
        return expected

    def state(self) -> list[str]:
        """Variables, states of properties, and how close comparisons came since it was asked last."""
        return _state(self.monitors)

    def _fed(self, given: bytes, topic: str, time: int) -> bytes:
        view, area = memoryview(bytearray(given)), self.monitors.area
        if self._inside and area is not None and len(given) <= AREA:
            view = area[: len(given)]
            view[:] = given
        pieces: list[memoryview | bytes] = []
        position = run = 0
        walker = self.monitors.walker(topic)
        while position < len(view):
            if walker is not None and self.monitors.walks(walker, time):
                before = position
                counted = [self.counting] * len(walker.verdicts)
                prepared = walker.prepare(loud=False, told=(), counted=counted)
                walked = walker.walk(view, position, run, pieces, time, prepared)
                for verdict, count in zip(walker.verdicts, walked.told if walked else (), strict=False):
                    self.counts[named(verdict)] += count
                self.lines += (line for _, line in walked.output) if walked else ()
                position, run = (len(view), run) if walked is None else (walked.position, walked.run)
                self.came["together"] += position > before
                if position == len(view):
                    break
            first = position + 4
            following = first + int.from_bytes(view[position:first], "little")
            body = view[first:following]
            outcome = self.monitors.process(topic, body, time)
            self.told += (one for each in (*outcome.before, outcome) for one in each.verdicts)
            self.lines += (line for each in (*outcome.before, outcome) for line in each.log)
            self.published += (one for each in (*outcome.before, outcome) for one in each.published)
            if outcome.result == "dropped":
                pieces.append(view[run:position])
                run = following
            elif outcome.buffer is not body:
                pieces += (view[run:position], frames([bytes(outcome.buffer)]))
                run = following
            position = following
        return b"".join([*pieces, view[run:]])


def _state(monitors: MonitorSet) -> list[str]:
    state = []
    for monitor in monitors.monitors:
        names = monitors.interpreter.variables
        state += [f"{name} {names.get(code)!r}" for name, code in monitor.code.variables.items()]
        state += [str(one.run.state) for one in monitor.properties if isinstance(one.run, FiniteRun)]
        clocked = [one.run for one in monitor.properties if isinstance(one.run, ClockedRun)]
        state += [f"{run.state} since {run.since} at {run.now}" for run in clocked]
    return [*state, *map(str, monitors.take_margins())]


def event(
    body: str, parameters: str = "int count", pattern: str = "count:count", before: str = "int n = 0;"
) -> str:
    """A specification with one event on `/plain`."""
    return f"s() {{ {before} event e({parameters}) /plain own/Plain '{{{pattern}}}' {{ {body} }} }}"


# The same as the interpreter


@FEW
@given(seed=st.integers(0, 1 << 30), wild=st.lists(st.binary(max_size=80), max_size=4))
def test_random_specifications_and_messages(seed: int, wild: list[bytes]) -> None:
    """Actions, conditions, helper functions, loops, properties; messages of several topics, and bytes that are none.

    How close comparisons came is the same, too, where that is noted.
    """
    try:
        fed = Fed(*Specifications(seed).texts(), on_fault=("drop", "pass")[seed % 2], margins=seed % 4 > 1)
    except SpecificationError:
        return  # a draw that means nothing
    messages = Messages(seed)
    for number in range(4):
        traffic = messages.traffic()
        fed.counting = bool(seed + number & 2)
        fed.check([*traffic.bodies(), *wild], traffic.topic, number)


def test_most_of_that_is_taken_together_and_everything_comes_up() -> None:
    """What the comparison above compares is not nothing."""
    came: Counter[str] = Counter()
    for seed in range(24):
        try:
            fed = Fed(*Specifications(seed).texts())
        except SpecificationError:
            continue
        messages = Messages(seed)
        for traffic in (messages.traffic() for _ in range(6)):
            fed.check(list(traffic.bodies()), traffic.topic)
        came += fed.came
    found = ("fault", "dropped", "changed", "passed", "together")
    assert min(came[what] for what in found) > 3


@FEW
@given(seed=st.integers(0, 1 << 30), wild=st.lists(st.binary(max_size=80), max_size=4))
def test_one_by_one_they_are_told_as_the_interpreter_tells_them(seed: int, wild: list[bytes]) -> None:
    """What a recording's messages come to, whichever of the two takes them."""
    try:
        fed = Fed(*Specifications(seed).texts(), on_fault=("drop", "pass")[seed % 2], margins=seed % 4 > 1)
    except SpecificationError:
        return  # a draw that means nothing
    messages = Messages(seed)
    for time in range(1, 4):
        traffic = messages.traffic()
        for body in (*traffic.bodies(), *wild):
            outcome = fed.monitors.judge(traffic.topic, body, time * 900_000)
            check_same(outcome, fed.interpreter.process(traffic.topic, body, time * 900_000))
    assert fed.state() == _state(fed.interpreter)


def test_a_message_that_needs_no_record_is_not_for_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    """`judge` asks the engine for a change and a fault, and for what the module has no room for."""
    fed = Fed("""s() { int n = 0; int m = 0;
        event a(int c) /plain own/Plain '{count:c}' { n++; if (c == 3) { c = 4; } }
        event b(int kind, int x) /plain own/Plain '{kind:kind, three[0]:x}' when (kind == 1) { m = 10 / (n - 5); } }""")
    asked = []
    process = fed.monitors.process

    def counted(topic: str, buffer: Buffer, time_ns: int, sender: Sender) -> Outcome:
        asked.append(bytes(buffer))
        return process(topic, buffer, time_ns, sender)

    monkeypatch.setattr(fed.monitors, "process", counted)
    told, engine = (
        [plain(1), plain(4), plain(6, kind=1)],
        [plain(3), plain(5, kind=1), plain(rest=bytes(AREA))],
    )
    outcomes = [fed.monitors.judge("/plain", body, 7) for body in (*told, *engine)]
    assert asked == engine
    assert [outcome.events for outcome in outcomes] == [
        ("s.a",), ("s.a",), ("s.a", "s.b"), ("s.a",), ("s.a", "s.b"), ("s.a",)
    ]  # fmt: skip


EXPRESSIONS = (
    "x % 7", "-x / 3", "x << 33", "(unsigned int) x >> 1", "~x", "abs(x)", "(int8_t) x", "(uint16_t) x", "(int) y",
    "(uint8_t) y", "(unsigned long) y", "(float) x", "(long) y * x", "x ? y : 1", "x == y", "x && y", "!x || y < 0",
    "std::max(x, 7)", "std::min(y, 0.5)", "(x += 2) + x++", "(unsigned int) x < 5u", "x / (x - x)", "y / 0", "x ^ 5L",
    "1000 / (100 / (x | 1))", "std::min(x, std::max(3, std::min(x, 9)))", "sqrt(y)", "floor(y) - ceil(y)", "trunc(y)",
    "fabs(y)", "sin(y)", "isnan(y)", "std::isinf(y)", "isfinite((float) y)", "rint(y)", "nearbyint(y)", "fmin(x, y)",
    "fmax(y, x)", "copysign(x, y)", "fminf(x, y)", "sqrtf(y)", "floorf(y)", "rintf((float) y)", "isnan(0 / y)",
)  # fmt: skip


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_expressions_at_the_limits(expression: str) -> None:
    """Numbers that overflow, do not fit, or are none."""
    before = "double d = 0; long n = 0; float f = 0;"
    fed = Fed(event(f"d = {expression}; n = d; f = d; x = n;", "int x, double y", "count:x, x:y", before))
    for x in (0, 1, -1, 7, 2**31 - 1, -(2**31)):
        fed.check(
            [
                plain(x, y)
                for y in (0.0, -0.0, 0.5, -2.5, 300.0, 1e300, -1e300, float("inf"), float("nan"), 2.0**63)
            ]
        )
    assert fed.came["together"] or expression in {"sin(y)", "x / (x - x)"}


ACTIONS = {
    "parts of a time": "long n = 0; unsigned int u = 0; E(ros::Time t, int count)'{when:t, count:count}' {"
    " n = t.sec; u = t.nsec; t.sec = count; if (count > 3) { t.nsec = u + 7; } }",
    "seconds": "double d = 0; double f = 0; ros::Duration g; E(ros::Time t)'{when:t}' {"
    " g = t - ros::Time(1700000000, 123456789); d = t.toSec() + g.toSec(); f = ros::Time::now().toSec(); }",
    "times": "ros::Time last; ros::Duration gap; E(ros::Time t)'{when:t}' {"
    " gap = t - last; last = t; if (gap > ros::Duration(1,0)) { return; } t = t + gap; }",
    "loop": "int n = 0; E(int count)'{count:count}' { for (int i = 0; i < count % 50; i++) {"
    " n += i; if (n % 7 == 3) { continue; } n ^= 5; } }",
    "switch": "int n = 0; E(int count)'{count:count}' {"
    " switch (count) { case 1: n = 1; break; case 5: n += 7; default: n++; } }",
    "a helper that cannot go on": "int n = 0;"
    ' int f(int a, int b) { if (a > 3) { ROS_INFO("x"); } n += a; return b / a; }'
    " E(int count)'{count:count}' { n = f(count, 7); count = n; }",
    "an index past the end": "int n = 0; E(int r)'{rest[3]:r}' { n = r; }",
    "elements of an array": "double n = 0; E(std::vector<long> three, int count)'{three:three, count:count}' {"
    " n = three[count] + three.size() + three.back() + three.empty(); }",
    "a loop over an array": "long n = 0; E(uint8_t[] rest, int count)'{rest:rest, count:count}' {"
    " for (int one : rest) { if (one == 5) { continue; } n += one; if (n > 9) { break; } }"
    " for (int i = 0; i < rest.size(); i++) { n = n * 3 + rest[i]; } }",
    "a sum of an array": "double n = 0; E(std::vector<long> three, int count)'{three:three, count:count}' {"
    " n = std::accumulate(three.begin(), three.end(), 0.5)"
    " + std::accumulate(three.begin() + count, three.end() - 1, (uint8_t) 200); }",
    "arrays for helpers": "long n = 0; long most(const std::vector<long>& v) {"
    " long m = v[0]; for (long e : v) { m = std::max(m, e); } return m; }"
    " long other(std::vector<long> v, int at) { std::vector<long> w = v; return w.at(at) + most(v); }"
    " E(std::vector<long> three, int count)'{three:three, count:count}' { n = most(three) - other(three, count); }",
    "an array that is changed": "long n = 0; E(std::vector<long> three, int count)'{three:three, count:count}' {"
    " n = three[1]; if (count == 5) { three[2] = n; } }",
    "output that is not due": "int n = 0; E(int count)'{count:count}' {"
    ' n++; if (count) { ROS_INFO_THROTTLE(10.0, "%d", n); ROS_INFO_THROTTLE(1, "%d", count); } }',
    "a whole message now and then": "own::Plain last; int n = 0; E(int count)'{count:count}' {"
    " n++; if (count == 5) { last = MESSAGE; } count = n; }",
    "a byte that is no bool": "bool was = false; E(bool on)'{on:on}' { was = on; on = on; }",
}


@pytest.mark.parametrize("name", ACTIONS)
def test_actions_of_every_kind(name: str) -> None:
    """On messages of all kinds, many of them together."""
    fed = Fed(
        "s() { " + ACTIONS[name].replace("E(", "event e(", 1).replace(")'", ") /plain own/Plain '") + " }"
    )
    for seed in range(6):
        messages = Messages(seed)
        for traffic in (messages.traffic() for _ in range(8)):
            if traffic.topic == "/plain":
                fed.check(list(traffic.bodies()), time=1_700_000_000_123_456_789 + seed)
    assert fed.came["together"]


OUTPUT = {
    "numbers": 'ROS_INFO("%d %5u %-7x| %+.3e %g %c %08.2f %lu %hd %a %#o %%", c, c, c, x, y, c, y, l, c, x, c);',
    "strings": 'ROS_WARN("%s %5.2s %s|", f.c_str(), f.c_str(), "constant"); puts(f); ROS_ERROR("only this\\n\\n");',
    "streams": 'std::cout << "at " << t << std::fixed << std::setprecision(2) << x << y << l << std::endl;'
    " if (c > 100) { std::cerr << std::setprecision(c % 200) << x; }",
    "in helper functions": "l = said(c) + said(7);",
    "and then a fault": 'ROS_INFO("before %d", c); l = 10 / (c - 5); ROS_INFO("after %ld", l);',
    "in loops": 'for (int i = 0; i < 40; i++) { ROS_INFO("%d of %d", i, c); }',
    "more than is paid for": 'while (true) { ROS_INFO("%1000d", c); }',
    "that is kept back, or due": 'ROS_INFO_THROTTLE(2, "%d", c); ROS_WARN_COND(c > 2, "%d", c);',
}


@pytest.mark.parametrize("name", OUTPUT)
def test_lines_of_output(name: str) -> None:
    """Their text and order, whoever puts them out; of a message that is left none is put out twice."""
    fed = Fed(f"""s() {{ long l = 0; int said(int i) {{ ROS_INFO("said %d", i); return i > 4 ? 7 / (i - 5) : i; }}
        event e(int c, double x, std::string f, ros::Time t, double y) /stamped own/Stamped
        '{{frame:f, x:x, when:t, count:c, values[0]:y}}' {{ {OUTPUT[name]} }} }}""")
    values = (0.0, -0.0, 1e300, -2.5, 1e-320, float("inf"), float("nan"))
    for number, value in enumerate(values[:2] if "paid" in name else values):  # each of those takes a budget
        frame = (b"", b"abc", "\xe4\n".encode(), b"\xff%s\0", b"x" * 5000)[number % 5]
        head = struct.pack("<I", len(frame)) + frame
        rest = struct.pack("<IId", 9, 8 + number, value)
        bodies = [
            head + rest + struct.pack("<hI2d", count, 2, value, 7.0) + STAMPED[45:]
            for count in (1, -7, 5, 300)
        ]
        fed.check([*bodies, bodies[0][:20], *bodies], "/stamped", number)
    assert fed.came["together"] or "due" in name or "paid" in name


def test_more_lines_than_there_is_room_for() -> None:
    """Are put out all the same."""
    fed = Fed(event('ROS_INFO("%d %d", count, n); n++;'))
    fed.check([plain(number) for number in range(LINES // 24 + 50)])
    assert fed.came["together"] >= 2


def test_output_comes_when_it_is_due_whoever_took_the_messages_before() -> None:
    """The module knows when a line was last put out, and leaves the message at which the next one is."""
    fed = Fed(event('n++; ROS_INFO_THROTTLE(2, "%d", n);'))
    second = 1_000_000_000
    for time in (
        0,
        1,
        second,
        2 * second - 1,
        2 * second,
        3 * second,
        5 * second,
        4 * second,
        4 * second + 1,
    ):
        fed.check([plain()] * 2, time=1_700_000_000 * second + time)
    assert fed.came["together"] == 9


def test_arrays_that_lie_and_arrays_that_end_with_the_message() -> None:
    """Cut after each byte, and with lengths that are too large: as the interpreter; nobody else's bytes are read."""
    fed = Fed("""s() { double d = 0; int n = 0; event e(double[] v, std::string f) /stamped own/Stamped
        '{frame:f, values:v}' { n += v.size() + f.size();
        for (double each : v) { d += each; } for (char c : f) { n += c; } } }""")
    for end in range(len(STAMPED) + 1):
        fed.check([STAMPED, STAMPED[:end], STAMPED], "/stamped")
    for length in (1, 3, 2**29, 2**31, 2**32 - 1):
        fed.check([STAMPED[:25] + struct.pack("<I", length) + STAMPED[29:], STAMPED], "/stamped")
    assert fed.came["together"]


SHAPES = {
    "points of a polygon": "double n = 0; double far(const geometry_msgs::Point32& p) { return p.x * p.x - p.y; }"
    " event e(geometry_msgs::Point32[] points) /s geometry_msgs/PolygonStamped '{polygon.points:points}' {"
    " for (const auto& p : points) { n += far(p); } for (auto &p : points) { n += p.z; }"
    " for (geometry_msgs::Point32 p : points) { n = n / 2 + p.x; }"
    " for (int i = 0; i < points.size(); i++) { n += points[i].y; } n += points[1].x; }",
    "part of a message": "double n = 0; geometry_msgs::Point last; event e(geometry_msgs::Pose p, double s) /s"
    " nav_msgs/Odometry '{pose.pose:p, twist.twist.linear.x:s}' {"
    " const geometry_msgs::Point q = p.position; n += q.x + p.orientation.w; s = p.position.y;"
    " if (q.z > 1) { last = q; } if (q.z < -1) { p.position.x = 7; } }",
    "arrays in a message": "double n = 0; event e(geometry_msgs::PoseWithCovariance p, int k) /s nav_msgs/Odometry"
    " '{pose:p, header.seq:k}' { n += p.covariance[k]; for (double c : p.covariance) { n += c; }"
    " n += p.covariance.size() + std::accumulate(p.covariance.begin(), p.covariance.end() - k, 0.0); }",
    "a message whose size differs": "int n = 0; event e(std_msgs::Header h) /s nav_msgs/Odometry '{header:h}' {"
    " n += h.seq; }",
}


@pytest.mark.parametrize("name", SHAPES)
def test_messages_within_messages(name: str) -> None:
    """Of fixed size they are looked at where they stand: fields, elements, copies; cut after each byte."""
    fed, random = Fed(f"s() {{ {SHAPES[name]} }}"), Random(7)  # noqa: S311  draws examples, not keys
    for _ in range(12):
        points = [{axis: float(random.randint(-3, 3)) for axis in "xyz"} for _ in range(random.randint(0, 4))]
        body = message("geometry_msgs/PolygonStamped", polygon__points=points)
        if "Odometry" in SHAPES[name]:
            values = {f"pose__pose__position__{axis}": float(random.randint(-3, 3)) for axis in "xyz"}
            body = message("nav_msgs/Odometry", header__seq=random.randint(0, 40),
                           pose__covariance=[random.random() for _ in range(36)], **values)  # fmt: skip
        cuts = [body[: random.randrange(len(body))] for _ in range(3)]
        fed.check([body, body, *cuts, body], "/s")
    assert bool(fed.came["together"]) == ("differs" not in name)


def test_arrays_of_strings() -> None:
    """Compared, measured, looped over, handed on; cut after each byte, with lengths that lie; more than are noted."""
    fed = Fed("""s() { double n = 0; bool is(const std::string& s) { return s == "b"; }
        int count(const std::vector<std::string>& all) { int m = 0; for (auto s : all) { m += s.size(); } return m; }
        event e(std::vector<std::string> names, double[] at) /s sensor_msgs/JointState '{name:names, position:at}' {
            for (int i = 0; i < names.size(); i++) { if (names[i] == "arm" || is(names[i])) { n += at[i]; } }
            for (char c : names[0]) { n += c; } n = n * 2 + count(names);
            if (names.back().empty()) { at[0] = 3; } } }""")
    wrist = message("sensor_msgs/JointState", name=["arm", "wrist", "b"], position=[1.5, 2.5, -0.25])
    many = message("sensor_msgs/JointState", name=["b"] * (MOST_TEXTS + 1), position=[0.5] * (MOST_TEXTS + 1))
    fed.check([wrist, wrist, message("sensor_msgs/JointState"), many, wrist], "/s")
    assert fed.came["together"]
    fed.check([message("sensor_msgs/JointState", name=["b", ""], position=[0.0, 1.0]), wrist], "/s")
    for end in range(len(wrist) + 1):
        fed.check([wrist, wrist[:end], wrist], "/s")
    place = wrist.index(b"arm") - 4
    for length in (0, 1, 4, 200, 2**31 - 1, 2**31, 2**32 - 5, 2**32 - 1):
        for at in (place - 4, place, place + 7):
            fed.check([wrist[:at] + struct.pack("<I", length) + wrist[at + 4 :], wrist], "/s")


@pytest.mark.parametrize("text", ["", "a", "abc", "map_frame", "a name of thirty bytes exactly", "x" * 64])
def test_strings_are_compared_to_the_last_byte(text: str) -> None:
    """With constants of all lengths, in patterns and in conditions; others of the same length or nearly."""
    pattern = text.replace('"', "")
    fed = Fed(f"""s() {{ int n = 0; event a() /stamped own/Stamped '{{frame:"{pattern}"}}' {{ n++; }}
        event b(std::string f) /stamped own/Stamped '{{frame:f}}' {{ if (f != "{pattern}") {{ n += 100; }} }} }}""")
    others = {text, text + "x", text[:-1], text[:-1] + "y", "z" + text[1:], text[::-1]}
    for other in sorted(others):
        raw = other.encode()
        fed.check([struct.pack("<I", len(raw)) + raw + STAMPED[7:]] * 2, "/stamped")
    assert fed.came["together"] == len(others)


def test_seconds_of_every_size_are_rounded_once() -> None:
    """As C++ and Python do, though the module divides in two steps."""
    fed = Fed("s() { double d = 0; event e(ros::Time t) /plain own/Plain '{when:t}' { d = t.toSec(); } }")
    for seconds in (0, 1, 9_007_199, 9_007_200, 1_700_000_000, 2**32 - 1):
        for nanoseconds in (0, 1, 3, 254_740_991, 254_740_993, 499_999_999, 999_999_999):
            body = plain()
            fed.check([body[:18] + struct.pack("<II", seconds, nanoseconds) + body[26:]])
    assert fed.came["together"] == 42


# Hostile bytes, bounds


def test_a_message_that_ends_anywhere_is_nobody_elses_bytes() -> None:
    """Fields behind strings and arrays, of messages cut after each byte, with others behind them."""
    fed = Fed("""s() { int n = 0; double d = 0; event e(double v, int k, std::string f) /stamped own/Stamped
        '{frame:f, values[1]:v, kind:k}' { n += k; d = v; if (f == "abc") { k = 7; } } }""")
    for end in range(len(STAMPED) + 1):
        fed.check([STAMPED, STAMPED[:end], STAMPED], "/stamped")
    assert fed.came["together"]


@pytest.mark.parametrize("place", [0, 25, len(STAMPED) - 4])
@pytest.mark.parametrize("length", [1, 3, 200, 2**31 - 1, 2**31, 2**32 - 5, 2**32 - 1])
def test_lengths_that_lie(place: int, length: int) -> None:
    """Of a string, an array of numbers, an array of strings: nothing outside the message is read or written."""
    fed = Fed("""s() { int n = 0;
            event e(double v, int k) /stamped own/Stamped '{values[1]:v, kind:k}' { n += k; v = 3; } }
        t() { int m = 0;
            event e(std::string last) /stamped own/Stamped '{names[1]:last}' { if (last == "x") { m++; } } }""")
    bad = STAMPED[:place] + struct.pack("<I", length) + STAMPED[place + 4 :]
    fed.check([STAMPED, bad, STAMPED], "/stamped")


def test_a_fault_in_the_middle_of_a_batch_undoes_its_message_only() -> None:
    """Variables, fields and states that events before it have changed are as they were when the engine begins."""
    fed = Fed(
        """a() { int n = 0; event e(int count, double x) /plain own/Plain '{count:count, x:x}' { n += count; x = n; }
               fsm: one [ e -> two ] two [ e -> one ] @fail { } }
        b() { int m = 1; event e(int count, double x) /plain own/Plain '{count:count, x:x}' {
               m = m * 3; x = x + m; m = 100 / (count - 7); } }"""
    )
    fed.check([plain(count) for count in (1, 2, 7, 3, 7, 7, 4)])
    assert fed.came["fault"] == 3
    assert fed.came["together"] == 3


def test_without_fuel_the_message_at_hand_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever it ends: what is done is done, what is begun is taken back."""
    text = event("for (int i = 0; i < 50; i++) { n += i; } count = n;")
    for fuel in range(2000, 12000, 500):
        monkeypatch.setattr(wasm_runner, "FUEL", fuel)
        Fed(text).check([plain(number) for number in range(20)])


def test_fuel_lasts_for_many_calls_and_where_it_ends_one_message_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As if it had not been looked at; the next ones have fuel again."""
    monkeypatch.setattr(wasm_runner, "FUEL", 1000)
    fed = Fed(event("n++;"))
    walker, one = fed.walker(), frames([plain()])
    assert fed.monitors.area is not None
    view = fed.monitors.area[: len(one)]
    view[:] = one
    prepared = walker.prepare(loud=False, told=())
    left = [left for _ in range(200) if (left := walker.walk(view, 0, 0, [], 1, prepared))]
    assert 2 < len(left) < 100
    assert {walked.position for walked in left} == {0}
    assert fed.state() == [f"n {200 - len(left)}"]


def test_a_long_message_is_looked_at_where_it_begins() -> None:
    """Changed and dropped there; a field that is further behind is left, and so is the bytes' number.

    Not where all of it stands in the module's memory.
    """
    picture = bytes(range(256)) * (BEGINNING // 128)
    fed = Fed(event("if (count == 3) { return; } count = count + 1; n++;"))
    fed.check([plain(1, rest=picture), plain(2), plain(3, rest=picture), plain(4, rest=picture), plain(5)])
    assert fed.came["together"] == 1
    further = Fed(event("n += r; count = n;", "int r, int count", "rest[600]:r, count:count"))
    for together in (1, 2):
        further.check([plain(1, rest=picture[:1000]), plain(3, rest=picture[:1000])] * 2)
        assert further.came["together"] == together
    behind = Fed("s() { int n = 0; event e(int r) /plain own/Plain '{rest[9000]:r}' { n += r; } }")
    assert behind.monitors.area is not None
    for together in (1, 1, 2):
        behind.check([plain(rest=picture), plain(rest=picture)])
        assert behind.came["together"] == together
    assert behind.state() == ["n 240"]


def test_more_frames_than_fit_and_more_changes_than_are_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Go in several pieces."""
    monkeypatch.setattr("rosmop.fast.wasm_runner.FUEL", 10**9)
    fed = Fed("""one() { int n = 0; event e(int count, double x) /plain own/Plain '{count:count, x:x}' {
        n++; if (count % 2) { x = n; } } }
        two() { event e(float y) /plain own/Plain '{y:y}' when (y == 0) { y = 1; } }""")
    many = [plain(number) for number in range(MAX_EFFECTS + AREA // 20)]
    fed.check(many)
    assert fed.came["together"] == 1
    assert [*fed.walker().happened()] == [len(many)] * 2


# State


def test_variables_are_the_same_for_the_module_and_for_the_engine() -> None:
    """Of specifications that see each other's, whichever takes the next message; of a set that replaces another."""
    first = """a() { int n = 0; double d = 0; bool b = false; unsigned int u = 1; long l = -1; float f = 0; ros::Time t;
        event e(int count) /plain own/Plain '{count:count}' {
            n += count; d = n / 3.0; b = n % 2; u = u * 5; l = l * 7; f = d; t = ros::Time(1, 2); }
        event said() /stamped own/Stamped '{}' { ROS_INFO("%d", n); } }"""
    second = (
        "b() { int seen = 0; event e(double x) /plain own/Plain '{x:x}' { seen = n; x = d; l = l + seen; } }"
    )
    fed = Fed(first, second)
    for number in range(4):
        fed.check([plain(number)] * 3)
        fed.check([STAMPED], "/stamped")
    fed.check([plain(9)] * 2)
    before = fed.state()
    following, _ = replaced(fed.monitors, {"0.rv": first, "1.rv": second}, definitions(), 5)
    assert _state(following) == before


def test_what_happened_and_what_was_dropped_is_counted() -> None:
    """For each event; what happened, once."""
    fed = Fed("""s() { event a(int kind) /plain own/Plain '{kind:kind}' { }
        event b(int count) /plain own/Plain '{count:count}' when (count > 1) { if (count > 2) { return; } } }""")
    walker, view = fed.walker(), memoryview(bytearray(frames(plain(number) for number in (1, 2, 3, 3, 1, 4))))
    pieces: list[memoryview] = []
    walked = walker.walk(view, 0, 0, pieces, 1, walker.prepare(loud=False, told=()))
    size = len(plain()) + 4
    assert walked is not None
    assert (walked.position, walked.run, [*walked.dropped]) == (6 * size, 6 * size, [0, 3])
    assert [bytes(piece) for piece in pieces] == [bytes(view[: 2 * size]), bytes(view[4 * size : 5 * size])]
    assert [[*walker.happened()] for _ in range(2)] == [[6, 4], [0, 0]]


# What is left, and when


@pytest.mark.parametrize(
    ("body", "has"),
    [
        ("n = count;", True),
        ('if (count > 3) { ROS_WARN("high"); }', True),
        ("count = n; n++;", True),
        ("if (n > 2) { return; }", True),
        ("for (int i = 0; i < 3; i++) { n++; }", True),
        ('ROS_INFO("each");', True),
        ('std::string s = "x" + std::to_string(count);', False),
        ("n = down(3);", False),
        ("v.push_back(1);", False),
        ("if (count > 3) { std::reverse(v.begin(), v.end()); }", True),
        ("n = cos(count);", False),
    ],
)
def test_a_topic_of_which_every_message_would_be_left_has_no_walk(body: str, has: bool) -> None:
    """One of which some would be has."""
    before = "int n = 0; std::vector<int> v; int down(int i) { return i ? down(i - 1) : 0; }"
    fed = Fed(event(body, before=before))
    assert (fed.monitors.walker("/plain") is not None) == has


def test_walks_wait_until_a_monitor_has_begun() -> None:
    """Not before the first message, not while it is held."""
    monitors = on_module(
        compiled_from({"x.rv": "hold s() { event e() /plain own/Plain '{}' { } }"}, definitions())
    )
    monitors.start(0, restarted=True)
    walker = monitors.walker("/plain")
    assert walker is not None
    answers = [monitors.walks(walker, 1)]
    monitors.process("/plain", plain(), 1)
    answers.append(monitors.walks(walker, 1))
    monitors.resume("s")
    monitors.process("/plain", plain(), 1)
    answers.append(monitors.walks(walker, 1))
    assert answers == [False, False, True]


def test_walks_wait_while_something_is_due() -> None:
    """A tick that is due comes before the next message; it finds what walks have left."""
    fed = Fed(
        "s() { int n = 0; event e() /plain own/Plain '{}' { n++; } event t() every 1ms { n = n * 10; } }"
    )
    fed.check([plain()] * 3, time=1000)
    assert fed.monitors.walks(fed.walker(), 1000)
    assert not fed.monitors.walks(fed.walker(), 2_000_000)
    fed.check([plain()], time=1_500_000)
    assert fed.state() == ["n 31"]


CLOCKED = (
    "tfsm: a [ e -> b, o -> a ] b [ e -> a, o -> b, timeout 3ms -> c ] c [ default a, timeout 1ms -> a ]"
    " @c { n++; } @timeout { m++; }",
    "tfsm: a [ e -> b, o -> a ] b [ default a ] @timeout { n++; }",
    "pattern: globally: e causes o within 3ms @violation { n++; __RESET; }",
    "pattern: after e until o: some e within 2ms @violation { n++; __RESET; } @validation { m++; }",
    "pattern: globally: e requires o within 2ms @violation { n++; __RESET; }",
    "pattern: globally: o forbids e within 2ms @violation { n++; __RESET; }",
    "pattern: until o: no e within 2ms @violation { n++; __RESET; } @validation { m++; }",
    "mtl: e => once[0,2ms] o @violation { n++; __RESET; }",
    "mtl: e => !o since[1ms,inf] e @violation { n++; }",
    "mtl: e => previously[1ms,inf] o @violation { m++; }",
    "mtl: historically[0,3ms] (e => previously o) @violation { n++; } @validation { m++; }",
)


@pytest.mark.parametrize("text", CLOCKED)
def test_properties_with_clocks(text: str) -> None:
    """States, clocks, deadlines, handlers and explanations, as of the interpreter; far more steps than are kept.

    Where a message brings an earlier deadline, that is due before the next one.
    """
    fed = Fed(
        f"""s() {{ int n = 0; int m = 0; int k = 0;
        event e(int c) /plain own/Plain '{{count:c}}' when (c % 3 == 0) {{ if (c == 9) {{ k = 1 / (k - k); }} }}
        event o(int c) /plain own/Plain '{{count:c}}' when (c % 3 == 1) {{ k++; }} {text} }}"""
    )
    random, time = Random(3), 0  # noqa: S311  draws examples, not keys
    for number in range(150):
        time += random.choice((0, 300_000, 900_000, 2_000_000, 4_000_000, 1_100_000_000))
        quiet = number // 40 % 2
        bodies = [
            plain(random.choice((0, 1) if number % 9 else (0, 1, 2, 9)))
            for _ in range(random.choice((1, 1, 2, 40 * quiet + 1)))
        ]
        fed.check(bodies, time=time)
    assert fed.came["together"] > 10
    assert fed.told == fed.interpreted
    assert len(fed.told) > 5
    assert all(one.why for one in fed.told)


HANDLED = (
    "ere: a* (b | epsilon) @fail { n++; if (k > 40) { DROP; } __RESET; } @match { m = m * 3 + n; }",
    "ptltl: a -> (*) b @violation { m++; if (n > 9) { return; } DROP; n += 10; } @validation { n = n / 2; }",
    "fsm: one [ a -> two, b -> one ] two [ a -> one, b -> three ] three [ default one ]"
    " @two { } @three { m = 100 / (k % 7); } @one { if (m > 3) { v.push_back(1); m = 0; } }",
    "ere: (a | b)* a b @match { DROP; __RESET; } ltl: [] (a => o (a or b)) @violation { n++; __RESET; }"
    " fsm: s [ a -> t, default s ] t [ b -> s, default t ] @t { m += n; }"
    " @s { for (int i = 0; i < 3; i++) { n ^= i; } }",
)


@pytest.mark.parametrize("text", HANDLED)
def test_handlers_run_where_their_verdicts_are_only_counted(text: str) -> None:
    """Variables, drops, what begins anew; faults and what the module has not; why, when a verdict is told again."""
    fed = Fed(
        f"""s() {{ int n = 0; int m = 0; int k = 0; std::vector<int> v;
        event a(int c) /plain own/Plain '{{count:c}}' when (c % 2 == 0) {{ k++; if (c == 8) {{ k = 1 / (k - k); }} }}
        event b(int c) /plain own/Plain '{{count:c}}' when (c % 3 == 0) {{ k++; c = k; }} {text} }}
        t() {{ int seen = 0; event all(double x) /plain own/Plain '{{x:x}}' {{ seen++; x = seen; }} }}"""
    )
    random, counted = Random(5), 0  # noqa: S311  draws examples, not keys
    for time in range(1, 40):
        fed.counting = time % 3 > 0
        fed.check(
            [plain(random.choice((0, 1, 2, 3, 4, 6, 8) if time % 5 else (2, 3))) for _ in range(30)],
            time=time,
        )
        counted += fed.counts.total()
    assert counted > 100
    assert fed.came["together"] > 60
    assert fed.came["dropped"] > 5 or "DROP" not in text
    assert all(one.why for one in fed.told)


def test_a_deadline_that_comes_in_a_walk_is_known_at_once() -> None:
    """Whoever asks, when is the next due; one that is put off is due again when it was."""
    fed = Fed("""s() { event a() /plain own/Plain '{count:1}' { } event b() /plain own/Plain '{count:2}' { }
        event tick() every 1s { } pattern: globally: a causes b within 1ms @violation { } }""")
    fed.check([plain(1)], time=5_000_000)
    fed.check([plain(2)], time=5_000_500)
    fed.check([plain(3), plain(1), plain(3)], time=5_000_700)
    assert fed.came["together"] == 3
    assert fed.monitors.next_due == 6_000_001
    assert [one.timer for one in fed.monitors.advance(6_000_001)] == []
    assert fed.monitors.next_due == 6_000_701
    assert [one.timer for one in fed.monitors.advance(6_000_701)] == ["s.deadline"]


def test_a_disabled_monitor_has_no_part_in_a_walk() -> None:
    """Its topic has none; where there are others, they alone."""
    fed = Fed(event("n = count;"), event("n++;").replace("s()", "t()"))
    for one in (fed.monitors, fed.interpreter):
        one.switch({"s": False}, 5)
    fed.check([plain(7)] * 3)
    assert fed.state() == ["n 0", "n 3"]
    fed.monitors.switch({"t": False}, 5)
    assert fed.monitors.walker("/plain") is None


def test_a_walk_stops_before_what_is_to_be_told() -> None:
    """While changes are told in full nothing is changed, while drops are nothing is dropped."""
    fed = Fed(event("count = 7; if (n > 2) { return; } n++;"))
    walker, given = fed.walker(), frames([plain()] * 6)
    assert fed.monitors.area is not None
    view, size = fed.monitors.area[: len(given)], len(plain()) + 4
    view[:] = given
    walked = walker.walk(view, 0, 0, [], 5, walker.prepare(loud=True, told=[False]))
    assert walked is not None
    assert (bytes(view), walked.position) == (given, 0)
    prepared = walker.prepare(loud=False, told=[True])
    walked = walker.walk(view, 0, 0, [], 5, prepared)
    assert walked is not None
    assert bytes(view) == frames([plain(7)] * 3 + [plain()] * 3)
    assert (walked.position, prepared.changed) == (3 * size, {1: 3})
    assert fed.state() == ["n 3"]
