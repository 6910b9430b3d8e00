"""What no module does is left to the engine: vectors and messages that are made, kept or changed, what is published."""

import struct
from random import Random

import pytest

from rosmop.tests.acting import message
from rosmop.tests.test_walks import Fed

VALUES = (0.0, -0.0, 2.5, 1e300, -1e-320, float("inf"), float("-inf"), float("nan"))

KEPT = """std::string last; geometry_msgs::Twist told; std_msgs::String word; std::vector<double> v;
    void say(int i) { std_msgs::Int32 m; m.data = i; PUBLISH(/said, std_msgs/Int32, m); n += m.data; }
    double far(const geometry_msgs::Vector3& v) { PUBLISH(/v, geometry_msgs/Vector3, v); return v.x * 2; }
    void keep(geometry_msgs::Vector3 v) { told.linear = v; told.linear.z = n; }"""

LEFT = {
    "numbers that are published": "std_msgs::Float64 m; m.data = x; PUBLISH(/a, std_msgs/Float64, m);",
    "a string that is published": "std_msgs::String m; m.data = f; PUBLISH(/a, std_msgs/String, m); last = m.data;",
    "a time that is published": "std_msgs::Time m; m.data = t; PUBLISH(/a, std_msgs/Time, m);",
    "a message that is kept": "told.linear.x = x; told.angular = told.linear; PUBLISH(/a, geometry_msgs/Twist, told);",
    "a message that is copied": "geometry_msgs::Twist m = told; m.linear.x = n; told = m;",
    "a message that is read": "n += told.linear.x;",
    "a string in a message that is kept": "word.data = f; last = word.data;",
    "an array in a message": "geometry_msgs::PoseWithCovariance p; p.covariance[c] = x; n += p.covariance[0];",
    "helper functions": "say(c); geometry_msgs::Vector3 v; v.x = x; n += far(v); far(told.linear); keep(v);",
    "a loop": "for (int i = 0; i < c; i++) { say(i); }",
    "a fault": "say(10); told.linear.x = c; n = 6 / (c - c);",
    "a drop": "say(c); told.linear.x = c; DROP;",
    "a field that is written": "say(n); x = n; c = c + 1;",
    "the whole message": "PUBLISH(/m, own/Stamped, MESSAGE);",
    "a vector that grows": "v.push_back(x); n += v.size(); if (v.size() > 5) { v.erase(v.begin()); }",
    "a vector that is given": "v = values; n += v.size();",
    "a vector that is looked at": "for (double one : v) { n += one > 1; } if (v.size() > 0) { n += v[0] > x; }",
    "a vector that is made": "std::vector<double> w(c, x); w.push_back(1); std::sort(w.begin(), w.end()); n += w[0];",
    "two vectors that are compared": "if (v == values) { n++; }",
    "a copy that is changed": "std::vector<double> w = values; w.push_back(x); n += w.size() + values.size();",
    "an array of the message": "if (values.size() > 0) { values[0] = x; }",
    "an array that becomes longer": "values.push_back(x);",
}


def of_stamped(body: str) -> str:
    """A specification with an event that reads a string, a time, numbers and an array."""
    return f"""s() {{ int n = 0; {KEPT} event e(std::string f, ros::Time t, double x, int c, std::vector<double> values)
        /stamped own/Stamped '{{frame:f, when:t, x:x, count:c, values:values}}' {{ n++; {body} }} }}"""


def stamped(frame: bytes, x: float, count: int, values: tuple[float, ...] = ()) -> bytes:
    """An `own/Stamped`."""
    body = struct.pack("<I", len(frame)) + frame + struct.pack("<IIdhI", 9, 8, x, count, len(values))
    return body + struct.pack(f"<{len(values)}dBI", *values, 0, 0)


def check_everywhere(fed: Fed, counts: tuple[int, ...]) -> None:
    """Fail if the engine and the module differ: several reads, whole messages and such as end too early."""
    random = Random(4)  # noqa: S311  draws examples, not keys
    for time in range(1, 9):
        frame = (b"", b"abc", b"a\0b", b"\xff\xfe", b"x" * 3000)[time % 5]
        bodies = [
            stamped(
                frame, random.choice(VALUES), random.choice(counts), tuple(random.choices(VALUES, k=length))
            )
            for length in random.choices((0, 1, 2, 5, 7), k=random.choice((1, 6, 20)))
        ]
        cuts = [bodies[0][:end] for end in range(len(frame) + 4, len(bodies[0]), 7)]
        fed.check([*bodies, *cuts, bodies[-1]], "/stamped", 1_700_000_000_123_456_789 + time)


@pytest.mark.parametrize("name", LEFT)
def test_what_no_module_does_is_left(name: str) -> None:
    """The engine does it, whatever came before in the same read; all other messages are the module's."""
    fed = Fed(of_stamped(f"if (c > 2) {{ {LEFT[name]} }}"))
    check_everywhere(fed, (0, 1, 2, 2, 5, 7))
    fed.came.clear()
    fed.check([stamped(b"abc", 1, 1)] * 3, "/stamped")
    assert fed.came == {"together": 1, "passed": 3}


@pytest.mark.parametrize(
    "name",
    ["numbers that are published", "a message that is read", "the whole message", "a vector that is made"],
)
def test_a_topic_of_which_every_message_is_left_has_no_walk(name: str) -> None:
    """The engine alone looks at its messages."""
    assert Fed(of_stamped(LEFT[name])).monitors.walker("/stamped") is None


NAMED = {
    "a vector": "std::vector<double> w = values; n += w.size() * 2; for (double one : w) { n += one > 1; }",
    "one of two": "std::vector<double> w = values; if (c > 2) { w = values; n++; } n += w.size();",
    "what a function returns": "n += same(values).size(); for (double one : same(values)) { n += one > 1; }",
    "what a function hands back": "std::vector<double> w = values; give(w, values); n += w.size();",
    "a vector that is named again in its loop": "std::vector<double> w = values;"
    " for (double one : w) { w = values; n += one > 1; }",
    "a field beside it": "std::vector<double> w = values; x = n; c = w.size(); n += w.size();",
}


@pytest.mark.parametrize("name", NAMED)
def test_a_vector_of_the_message_with_another_name(name: str) -> None:
    """It stays where it is, and is what the interpreter copies: nothing changes it while it is looked at."""
    functions = """std::vector<double> same(const std::vector<double>& v) { n++; return v; }
        void give(std::vector<double>& to, std::vector<double> from) { n += to.size(); to = from; }"""
    text = of_stamped(NAMED[name]).replace("{ int n = 0;", f"{{ int n = 0; {functions}", 1)
    check_everywhere(Fed(text), (0, 1, 5))


POINTS = {
    "given in a loop": "geometry_msgs::Point32 q = points[0]; for (const auto& p : points) { n += q.x; q = p; }",
    "given back": "geometry_msgs::Point32 q = points[0]; give(q, points[1]); n += q.y;",
    "changed": "geometry_msgs::Point32 q = points[0]; n += q.x; if (n > 2) { q.x = 7; } n += q.x + points[0].x;",
    "kept now and then": "if (n > 3) { last = points[1]; } n += points[1].x;",
    "changed in the message": "if (n > 2) { points[0].x = n; } n += points[0].x;",
    "returned": "n += second(points).x;",
}


@pytest.mark.parametrize("name", POINTS)
def test_a_message_in_the_message_with_another_name(name: str) -> None:
    """The same of messages."""
    fed, random = (
        Fed(f"""s() {{ double n = 0; geometry_msgs::Point32 last;
        void give(geometry_msgs::Point32& to, const geometry_msgs::Point32& from) {{ to = from; }}
        geometry_msgs::Point32 second(const std::vector<geometry_msgs::Point32>& all) {{ return all[1]; }}
        event e(geometry_msgs::Point32[] points) /s geometry_msgs/PolygonStamped '{{polygon.points:points}}' {{
            {POINTS[name]} }} }}"""),
        Random(7),  # noqa: S311  draws examples, not keys
    )
    for _ in range(12):
        points = [{axis: float(random.randint(-3, 3)) for axis in "xyz"} for _ in range(random.randint(0, 4))]
        body = message("geometry_msgs/PolygonStamped", polygon__points=points)
        fed.check([body, body, body[: random.randrange(len(body))], body], "/s")
