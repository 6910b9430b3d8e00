"""Messages that monitors make, keep and publish: the module does with them what the interpreter does."""

import struct
from random import Random

import pytest

from rosmop.fast import wasm_runner
from rosmop.fast.abi import MOST_KEPT
from rosmop.fast.layout import LINES, MOST_MADE
from rosmop.runtime.context import BUDGET, OUTPUT_COST
from rosmop.tests.random_specifications import Messages, definitions
from rosmop.tests.test_walks import STAMPED, Fed, event, plain
from rosmop.tests.test_walks_texts import stamped

VALUES = (0.0, -0.0, 2.5, 1e300, -1e-320, float("inf"), float("-inf"), float("nan"))


def of_stamped(body: str, before: str = "") -> str:
    """A specification with an event that reads a string, a time and numbers."""
    return f"""s() {{ int n = 0; {before}
        event e(std::string f, ros::Time t, double x, int c) /stamped own/Stamped '{{frame:f, when:t, x:x, count:c}}'
        {{ n++; {body} }} }}"""


PUBLISHED = {
    "numbers": "std_msgs::Float64 m; m.data = x; PUBLISH(/a, std_msgs/Float64, m); std_msgs::UInt8 u;"
    " u.data = c;"
    " PUBLISH(/b, std_msgs/UInt8, u); std_msgs::Int64 l; l.data = -c; PUBLISH(/c, std_msgs/Int64, l);"
    " std_msgs::Float32 s; s.data = x; PUBLISH(/d, std_msgs/Float32, s);",
    "zeros": "std_msgs::Header h; PUBLISH(/a, std_msgs/Header, h); geometry_msgs::Pose p;"
    " PUBLISH(/b, geometry_msgs/Pose, p);"
    " h.frame_id = f; h = std_msgs::Header(); PUBLISH(/a, std_msgs/Header, h);",
    "a truth": "std_msgs::Bool b; b.data = c; PUBLISH(/a, std_msgs/Bool, b); b.data = !b.data; n += b.data;"
    " PUBLISH(/a, std_msgs/Bool, b);",
    "times": "std_msgs::Time m; m.data = t; PUBLISH(/a, std_msgs/Time, m); m.data.sec = 4294967295u;"
    " m.data.nsec = 1000;"
    " PUBLISH(/a, std_msgs/Time, m); std_msgs::Duration d; d.data = ros::Time::now() - t;"
    " PUBLISH(/b, std_msgs/Duration, d);"
    " d.data.nsec = 999999999; PUBLISH(/b, std_msgs/Duration, d); m.data.sec = c * 100000000u;"
    " n = m.data.nsec;"
    " PUBLISH(/a, std_msgs/Time, m);",
    "strings": 'std_msgs::String m; m.data = f; PUBLISH(/a, std_msgs/String, m); m.data = "constant";'
    " PUBLISH(/a, std_msgs/String, m); if (m.data != f) { m.data = c % 2 ? f : last; n += m.data.size(); }"
    " PUBLISH(/a, std_msgs/String, m); last = m.data; m.data.clear(); PUBLISH(/a, std_msgs/String, m);",
    "kept": "told.linear.x = x; told.angular = told.linear; told.linear.y += n;"
    " PUBLISH(/a, geometry_msgs/Twist, told);"
    " PUBLISH(/b, geometry_msgs/Vector3, told.angular); if (c == 3) { geometry_msgs::Twist z; told = z;"
    " } n += told.linear.y;",
    "kept and copied": "geometry_msgs::Twist one = told; told.linear.x = n;"
    " PUBLISH(/a, geometry_msgs/Twist, one);"
    " geometry_msgs::Twist two = one; one.linear.x = 7; PUBLISH(/a, geometry_msgs/Twist, two);"
    " told = one; one.angular.x = c;"
    " PUBLISH(/a, geometry_msgs/Twist, told); two.linear = told.linear;"
    " PUBLISH(/a, geometry_msgs/Twist, two);",
    "kept with strings": "PUBLISH(/a, std_msgs/String, word); word.data = f;"
    " PUBLISH(/a, std_msgs/String, word);"
    ' if (c == 1) { word.data = "stop"; } if (c == 2) { last = word.data; } if (c == 3) { word.data = last; }'
    " if (c == 5) { head.frame_id = word.data; head.seq = n; } if (c == 36) { n += head.frame_id.size(); }"
    " std_msgs::Header h = head; h.stamp.sec = n; if (c == 0) { other = h; } if (c == 2) { head = other; }"
    " if (word.data == head.frame_id) { n += 100; } if (c == 3 && n > 70) { word.data += last; }"
    ' ROS_INFO("%s %s", h.frame_id.c_str(), word.data.c_str()); PUBLISH(/b, std_msgs/Header, other);'
    " PUBLISH(/b, std_msgs/Header, h);",
    "arrays of fixed length": "geometry_msgs::PoseWithCovariance p; p.covariance[c] = x;"
    " p.covariance[35 - c] = n;"
    " for (double one : p.covariance) { n += one > 1; } geometry_msgs::PoseWithCovariance q = p;"
    " q.covariance[0] = 4;"
    " PUBLISH(/a, geometry_msgs/PoseWithCovariance, p); PUBLISH(/a, geometry_msgs/PoseWithCovariance, q);"
    " p.covariance = q.covariance; PUBLISH(/a, geometry_msgs/PoseWithCovariance, p);",
    "by helper functions": "say(c); say(n); geometry_msgs::Vector3 v; v.x = x; n += far(v);"
    " far(told.linear); keep(v);",
    "in loops": "for (int i = 0; i < c; i++) { std_msgs::Int32 m; m.data += i;"
    " PUBLISH(/a, std_msgs/Int32, m); m.data = 9;"
    ' ROS_INFO("%d", i); }',
    "before a fault": "std_msgs::Int32 m; m.data = 10; PUBLISH(/a, std_msgs/Int32, m); told.linear.x = c;"
    " m.data = 6 / (c - 2);"
    " PUBLISH(/a, std_msgs/Int32, m);",
    "before a drop": "std_msgs::Int32 m; told.linear.x = c; m.data = c; PUBLISH(/a, std_msgs/Int32, m);"
    " if (c == 2) { return; }"
    " if (c == 1) { DROP; } PUBLISH(/a, std_msgs/Int32, m);",
    "and changed": "std_msgs::String m; m.data = f; x = n; c = c + 1; PUBLISH(/a, std_msgs/String, m);",
    "with what is beyond now and then": 'std_msgs::String m; m.data = f; if (c == 2) { m.data += "x"; }'
    " PUBLISH(/a, std_msgs/String, m); if (c == 1) { n += sin(x);"
    " } if (c == 3) { PUBLISH(/m, own/Stamped, MESSAGE); }",
}
KEPT = """std::string last; geometry_msgs::Twist told; std_msgs::String word; std_msgs::Header head;
    std_msgs::Header other;
    void say(int i) { std_msgs::Int32 m; m.data = i; PUBLISH(/said, std_msgs/Int32, m); n += m.data; }
    double far(const geometry_msgs::Vector3& v) { PUBLISH(/v, geometry_msgs/Vector3, v); return v.x * 2; }
    void keep(geometry_msgs::Vector3 v) { told.linear = v; told.linear.z = n; }"""


@pytest.mark.parametrize("name", PUBLISHED)
def test_what_is_published(name: str) -> None:
    """Bytes, order, topics and what is kept, whoever takes the message;"
    " of one that is left nothing comes twice."""
    fed, random = Fed(of_stamped(PUBLISHED[name], KEPT)), Random(4)  # noqa: S311  draws examples, not keys
    for time in range(1, 9):
        fed.publishing = time % 4 > 0
        frame = (b"", b"abc", b"a\0b", b"\xff\xfe", b"x" * MOST_KEPT, b"y" * (MOST_KEPT + 1), b"z" * 7000)[
            time % 7
        ]
        bodies = [
            stamped(frame, random.choice((0, 1, 2, 3, 5, 36))) for _ in range(random.choice((1, 6, 20)))
        ]
        at = len(frame) + 12
        bodies += [body[:at] + struct.pack("<d", VALUES[time % 8]) + body[at + 8 :] for body in bodies[:3]]
        fed.check(
            [*bodies, bodies[0][: len(frame) + 15], bodies[0]], "/stamped", 1_700_000_000_123_456_789 + time
        )
    assert fed.came["published together"] > 10


@pytest.mark.parametrize("nanoseconds", [0, 999_999_999, 1_000_000_000, 2**32 - 1])
@pytest.mark.parametrize("on", [0, 1, 2, 255])
def test_what_has_several_encodings_is_published_in_the_engines(nanoseconds: int, on: int) -> None:
    """A truth that is no bit, a time with too many nanoseconds, signalling NaNs: of the message, in another message."""
    text = """s() { event e(ros::Time t, bool on, double x, float y) /plain own/Plain
        '{when:t, on:on, x:x, y:y}' { std_msgs::Time m; m.data = t; PUBLISH(/a, std_msgs/Time, m);
        std_msgs::Bool b; b.data = on; PUBLISH(/b, std_msgs/Bool, b); std_msgs::Float64 d; d.data = x;
        PUBLISH(/c, std_msgs/Float64, d); std_msgs::Float32 f; f.data = y; PUBLISH(/d, std_msgs/Float32, f); } }"""
    fed = Fed(text)
    for x, y in ((0, 0), (0x7FF0000000000001, 0), (0, 0x7F800001), (0xFFF8000000000123, 0xFFC00123)):
        for seconds in (0, 2**32 - 1):
            body = struct.pack("<BiQIBII3qI", 1, 2, x, y, on, seconds, nanoseconds, 1, 2, 3, 0)
            fed.check([body, body])
    part = Fed("""s() { event e(geometry_msgs::Pose p, std_msgs::Header h) /s nav_msgs/Odometry
        '{pose.pose:p}' { PUBLISH(/a, geometry_msgs/Pose, p); PUBLISH(/b, geometry_msgs/Point, p.position); } }"""
               .replace(", std_msgs::Header h", ""))  # fmt: skip
    odometry = bytearray(20) + struct.pack("<7Q", 0x7FF0000000000001, *range(6)) + bytes(8 * 84)
    usual = bytearray(20) + struct.pack("<7d", *range(7)) + bytes(8 * 84)
    part.check([bytes(odometry), bytes(usual), bytes(usual)[:60], bytes(usual)], "/s")
    assert part.came["published together"] == 4


def test_more_than_there_is_room_or_budget_for() -> None:
    """Of one message and of many; what exceeds the budget is a fault after what was published before."""
    text = "for (int i = 0; i < count; i++) { n++; m.data = n; PUBLISH(/a, std_msgs/Int32, m); }"
    most, fits = BUDGET // OUTPUT_COST, LINES // 16
    for many in (fits - 4, fits - 2, fits - 1, fits, BUDGET // 200, most):
        fed = Fed(event(text, before="int n = 0; std_msgs::Int32 m;"))
        fed.check([plain(2), plain(many), plain(2)])
        assert (fed.came["fault"] > 0) == (many == most)
        assert fed.came["published together"] == (fits if many < fits - 1 else 4)


def test_long_strings_a_thousand_times() -> None:
    """A message does not publish more in the module than the engine would let it hold unmeasured."""
    fed = Fed(
        of_stamped(
            "std_msgs::String m; m.data = f; for (int i = 0; i < c; i++) { PUBLISH(/a, std_msgs/String, m); }"
        )
    )
    for many in (1, 800, 1500, 3000):
        fed.check([stamped(b"x" * MOST_KEPT, many), stamped(b"y", 2)], "/stamped")
    assert 800 < fed.came["published together"] < 1600


def test_without_fuel_the_message_at_hand_publishes_nothing_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever it ends: what is kept is as it was, and the engine publishes all of that message."""
    body = "for (int i = 0; i < 9; i++) { told.linear.x += i; say(i); } last = f; other.frame_id = word.data;"
    text = of_stamped(f"{body} word.data = f; {PUBLISHED['strings']}", KEPT)
    together = 0
    for fuel in range(900, 9000, 450):
        monkeypatch.setattr(wasm_runner, "FUEL", fuel)
        fed = Fed(text)
        fed.check([stamped(b"%d" % number, number) for number in range(12)], "/stamped")
        together += fed.came["published together"]
    assert together > 100


def test_the_first_of_a_second_is_for_the_engine() -> None:
    """Where it is to be told in full; a message that publishes nothing is not."""
    fed = Fed(event("if (count > 3) { PUBLISH(/a, std_msgs/Int32, m); } else { PUBLISH(/b, std_msgs/Int32, m); }",
                    before="int n = 0; std_msgs::Int32 m;"))  # fmt: skip
    walker = fed.walker()
    assert walker.publishes == (("s", "/a"), ("s", "/b"))
    given = b"".join(struct.pack("<I", len(plain())) + plain(count) for count in (1, 2, 5, 1))
    for published, taken in ((), 0), ((True, False), 0), ((False, True), 2), ((True, True), 4):
        view = memoryview(bytearray(given))
        prepared = walker.prepare(loud=False, told=(), published=published)
        walked = walker.walk(view, 0, 0, [], 1, prepared)
        assert walked is not None
        assert walked.position == taken * len(given) // 4
        assert len(walked.output) == taken


def test_what_is_kept_goes_on_in_a_set_that_replaces_another() -> None:
    """Messages that specifications see of each other, whichever of module and engine takes the next one."""
    first = """a() { geometry_msgs::Twist told; int n = 0; std_msgs::Time seen;
        event e(int count, ros::Time t) /plain own/Plain '{count:count, when:t}' {
            n++; told.linear.x += count; seen.data = t; }
        event other() /stamped own/Stamped '{}' { told.angular.z = sin(n); } }"""
    second = """b() { event e(double x) /plain own/Plain '{x:x}' {
        told.linear.y = told.linear.x; x = told.angular.z; PUBLISH(/a, geometry_msgs/Twist, told); } }"""
    fed = Fed(first, second)
    for number in range(4):
        fed.check([plain(number)] * 3)
        fed.check([STAMPED], "/stamped")
    before = fed.state()
    following, _ = fed.monitors.replaced({"0.rv": first, "1.rv": second}, definitions(), 5)
    names = following.interpreter.variables
    kept = [
        f"{name} {names.get(code)!r}"
        for one in following.monitors
        for name, code in one.code.variables.items()
    ]
    assert set(kept) <= set(before)
    assert fed.came["published together"] == 12


def test_on_every_kind_of_message() -> None:
    """Malformed ones, several lengths: what is published of the right ones is that of the interpreter."""
    fed = Fed(event("PUBLISH(/a, std_msgs/Int32, m); m.data += count; std_msgs::Bool b; b.data = on;"
                    " if (m.data > 9) { PUBLISH(/b, std_msgs/Bool, b); }", "int count, bool on", "count:count, on:on",
                    "std_msgs::Int32 m;"))  # fmt: skip
    for seed in range(5):
        messages = Messages(seed)
        for traffic in (messages.traffic() for _ in range(8)):
            if traffic.topic == "/plain":
                fed.check(list(traffic.bodies()))
    assert fed.came["published together"] > 50


def test_a_time_that_no_message_can_have_is_kept_by_the_engine() -> None:
    """The message has too many seconds and nanoseconds; whoever looks at what is kept of it sees the same."""
    fed = Fed("""s() { std_msgs::Time m; std_msgs::Int32 other; ros::Time last;
        event e(ros::Time t, int c) /plain own/Plain '{when:t, count:c}' { other.data = c;
        if (c == 1) { m.data = t; } if (c == 2) { last = m.data; }
        if (c == 3) { PUBLISH(/a, std_msgs/Time, m); } if (c == 4) { m = std_msgs::Time(); } } }""")
    far = plain(1)[:18] + struct.pack("<II", 2**32 - 1, 2**32 - 1) + plain(1)[26:]
    for body in (plain(1), far, plain(3), far, plain(4), far, plain(1)):
        fed.check([plain(2), body, plain(2), plain(0), plain(3)])
    assert fed.came["fault"] > 2
    assert fed.came["together"] > 4


def test_a_long_string_that_is_kept_is_not_the_modules() -> None:
    """Whoever looks at it, or copies it, is for the engine until there is another."""
    text = of_stamped(
        """if (c == 1) { word.data = f; } if (c == 2) { n += word.data.size(); }
        if (c == 3 && word.data == "abc") { n += 10; } if (c == 4) { other = word; }
        if (c == 5) { std_msgs::String m = word; n += m.data.size(); }""",
        "std_msgs::String word; std_msgs::String other;",
    )
    fed = Fed(text)
    for size in (3, MOST_KEPT, MOST_KEPT + 1, 5000, 0):
        for look in range(2, 6):
            fed.check([stamped(b"x" * size, 1)], "/stamped")
            fed.check([stamped(b"", 0), stamped(b"", look), stamped(b"", 0)], "/stamped")
    assert fed.came["together"] > 12


COPIED = {
    "kept": "last = MESSAGE; n += last.twist.linear.y; if (last.header.frame_id == f) { n++; }",
    "with what was assigned": "x = n; if (x > 3) { s = 7; } last = MESSAGE; x = last.twist.linear.x + 1;"
    " PUBLISH(/a, geometry_msgs/TwistStamped, MESSAGE);",
    "published": "PUBLISH(/a, geometry_msgs/TwistStamped, MESSAGE); if (x > 2) { x = 2; }"
    " geometry_msgs::TwistStamped m = MESSAGE; m.header.seq = n; PUBLISH(/a, geometry_msgs/TwistStamped, m);",
    "a part": "n += MESSAGE.header.seq; geometry_msgs::Twist t = MESSAGE.twist; t.linear.x = n;"
    " PUBLISH(/t, geometry_msgs/Twist, t);",
    "after another event": "PUBLISH(/a, geometry_msgs/TwistStamped, MESSAGE); } event e2(double z) /s"
    " geometry_msgs/TwistStamped '{twist.angular.z:z}' { z = z + 1;"
    " } event e3() /s geometry_msgs/TwistStamped '{}' {"
    " PUBLISH(/a, geometry_msgs/TwistStamped, MESSAGE); last = MESSAGE;",
}


@pytest.mark.parametrize("name", COPIED)
def test_the_whole_message(name: str) -> None:
    """As changed so far; cut after each byte, with bytes behind it, lengths that lie, strings of every length."""
    fed = Fed(f"""s() {{ int n = 0; geometry_msgs::TwistStamped last;
        event e(std::string f, double x, unsigned int s) /s geometry_msgs/TwistStamped
        '{{header.frame_id:f, twist.linear.x:x, header.seq:s}}' {{ n++; {COPIED[name]} }} }}""")
    for time, frame in enumerate(
        (b"", b"base", b"a\0b", b"x" * MOST_KEPT, b"y" * (MOST_KEPT + 1), b"z" * 9000)
    ):
        body = struct.pack("<IIII", 7, 2**32 - 1, 5, len(frame)) + frame + struct.pack("<6d", 4.5, *range(5))
        fed.publishing = time != 1
        lying = [body[:12] + struct.pack("<I", length) + body[16:] for length in (1, 2**31, 2**32 - 1)]
        fed.check([body, *lying, body + b"more", body, body[:-1], body], "/s", time)
        many = body[:4] + struct.pack("<II", 2**32 - 1, 2**32 - 1) + body[12:]
        fed.check([body, many, body[:-8] + struct.pack("<d", VALUES[time]), body], "/s", time)
        if len(frame) < 10:
            for end in range(len(body)):
                fed.check([body, body[:end], body], "/s", time)
    assert fed.came["together"] > 50


def test_a_long_message_costs_what_all_of_it_costs() -> None:
    """Though only its beginning is shown: an array, or all, of more than a specification may hold is a fault."""
    array = "s() { int n = 0; event e(double[] v) /stamped own/Stamped '{values:v}' { n += v.size(); } }"
    whole = "s() { std_msgs::Int32 m; event e() /i std_msgs/Int32 '{}' { m = MESSAGE; } }"
    for text, topic, body in (array, "/stamped", STAMPED), (whole, "/i", bytes(4)):
        fed = Fed(text)
        fed.check([body, body + bytes(1 << 18), body + bytes(17 << 20), body], topic)
        assert fed.came["fault"] == 1
        assert fed.came["together"] > 0


@pytest.mark.parametrize(
    "body",
    [
        "std_msgs::Int32MultiArray m; PUBLISH(/a, std_msgs/Int32MultiArray, m);",
        "PUBLISH(/a, own/Stamped, MESSAGE);",
        "std_msgs::Header h; h.stamp = t; n += MESSAGE.names.size(); PUBLISH(/a, std_msgs/Header, h);",
    ],
)
def test_what_is_beyond_is_the_engines(body: str) -> None:
    """Arrays of strings and messages, also in `MESSAGE`."""
    fed = Fed(of_stamped(body))
    fed.check([STAMPED] * 3, "/stamped")
    assert fed.monitors.walker("/stamped") is None
    assert MOST_MADE < LINES


ARRAYS = """s() { geometry_msgs::PoseWithCovariance last; double n = 0; int i = 0;
    geometry_msgs::PoseWithCovariance pose; std::vector<double> v;
    double trace(const geometry_msgs::PoseWithCovariance& p) {
        double sum = 0; for (int k = 0; k < 6; k++) { sum += p.covariance[7 * k]; } return sum; }
    event e(double x, double y) /pose geometry_msgs/PoseWithCovariance '{pose.position.x:x, pose.position.y:y}' {
        i++; last = MESSAGE; last.covariance[i % 40] = x; pose.covariance[y] += n; pose.pose.orientation.w = x;
        if (i % 5 == 4) { pose = last; pose.covariance[1] = 7; } if (i % 11 == 10) { DROP; }
        for (auto one : last.covariance) { n += one; } n += trace(pose); if (n > 1000) { n = -n / 7; }
        x = pose.covariance[35] + n; if (x > 0) { PUBLISH(/a, geometry_msgs/PoseWithCovariance, pose); } }
    event late(double z) /pose geometry_msgs/PoseWithCovariance '{pose.position.z:z}' {
        if (z == 3) { pose.covariance[2] = i / (i % 3); } if (z == 4) { v.push_back(1); pose.covariance = v; }
        if (z == 5) { pose = geometry_msgs::PoseWithCovariance(); } } }"""


def test_arrays_in_messages_that_are_kept() -> None:
    """Given, changed, looped over and published; taken back by a fault; one with too few elements is the engine's."""
    fed, random = Fed(ARRAYS), Random(2)  # noqa: S311  draws examples, not keys
    for time in range(40):
        few = random.choice(((0, 1), (0, 1, 3), (0, 3, 4)))
        numbers = [[random.uniform(-9, 9) for _ in range(43)] for _ in range(7)]
        for each in numbers:
            each[1:3] = random.choice((0, 1, 35, 36) if time % 9 == 8 else (0, 1, 35)), random.choice(few)
        numbers[0][2] = 5 * (time % 2)
        fed.check([struct.pack("<43d", *each) for each in numbers], "/pose", time)
    assert (
        min(fed.came[what] for what in ("fault", "dropped", "changed", "published together", "together")) >= 8
    )


def test_no_message_with_an_array_of_fixed_length_is_left() -> None:
    """Also one that keeps what `nav_msgs/Odometry` is."""
    fed = Fed("""s() { nav_msgs::Odometry last; double n = 0;
        event e(double x) /odom nav_msgs/Odometry '{pose.pose.position.x:x}' {
        n += last.pose.covariance[0] + last.twist.covariance[35]; last = MESSAGE; last.pose.covariance[0] = x; } }""")
    body = struct.pack("<IIII3sI4s", 1, 2, 3, 3, b"map", 4, b"base") + struct.pack("<85d", *range(85))
    for _ in range(3):
        fed.check([body] * 5, "/odom")
    assert fed.came == {"together": 3, "passed": 15}


@pytest.mark.parametrize("body", ["p.covariance[0] = renewed();", "n = p.covariance[renewed()];"])
def test_a_message_that_is_given_anew_in_the_same_statement(body: str) -> None:
    """Who looks at it, or changes it, does so when that has happened."""
    before = """geometry_msgs::PoseWithCovariance p; geometry_msgs::PoseWithCovariance q; double n = 0;
        int renewed() { p = q; return 1; }"""
    fed = Fed(event(f"p.covariance[0] = x; q.covariance[0] = x + 1; {body}", "double x", "x:x", before))
    for time in range(3):
        fed.check([plain(x=3.0), plain(x=4.0)], time=time)
