"""Who writes what other languages have is told, at its place, what to write instead."""

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.text.errors import SpecificationError
from rosmop.text.parser import parse
from roswire.standard import standard_definitions

DEFINITIONS = standard_definitions()
EVENT = "event e(int n) /t std_msgs/Int32 '{data:n}' {"


def refused(text: str) -> tuple[int, str]:
    """Where the first error begins, and what it says."""
    with pytest.raises(SpecificationError) as caught:
        MonitorSet.of(compiled_from({"x.rv": text}, DEFINITIONS))
    finding = caught.value.findings[0]
    lines = text.splitlines(keepends=True)
    return sum(map(len, lines[: finding.position.line - 1])) + finding.position.column - 1, finding.text


IN_ACTIONS = [
    ("int x = ", "0b101;", "`0b101` is not part of the language; write `0x5`"),
    ("int x = ", "1'000'000;", "write `1000000`"),
    ("int x = ", "1_000;", "write `1000`"),
    ("int x = ", "0o17;", "write `017`"),
    ("double x = ", "0x1p3;", "write `8.0`"),
    ("double x = ", "5ms;", "numbers have no units"),
    ("std::string s = ", 'R"(x)";', "write it in plain quotes"),
    ("std::string s = ", "'abc';", 'write a string in double quotes, `"abc"`'),
    ("", "std::vector<int>::iterator i = v.begin();", "`for (auto& x : v) { … }`"),
    ("int x = ", "new int;", "there are no pointers; declare the variable itself"),
    ("", "p->x = 3;", "there are no pointers; write `p.x`"),
    ("n = ", "m->data;", "write `m.data`"),
    ("n = ", "*p;", "there are no pointers but `char *`; use the value itself"),
    ("", "int** x;", "there are no pointers"),
    ("int* x = ", "&n;", "there are no addresses; pass the variable itself"),
    ("", "int& r = n;", "without `&` it is a copy"),
    ("auto f = ", "[&](int a) { return a; };", "there are no lambda functions; declare a helper function"),
    ("std::vector<int> w = ", "[1, 2];", "write `{1, 2}`"),
    ("", "MESSAGE.data = 3;", "bind the fields you want to change, `'{field:x}'`, and write `x = …;`"),
    ("", "std::map<std::string, int> c;", "use two vectors, one of the keys and one of the values, or a specification"),
    ("", "std::pair<int, int> p;", "use a variable for each member"),
    ("", "boost::shared_ptr<std_msgs::Int32> p;", "there are no pointers; declare the value itself"),
    ("", "std::shared_ptr<int> p;", "there are no pointers; declare the value itself"),
    ("const ", "std_msgs::Int32::ConstPtr& p = MESSAGE;", "write `std_msgs::Int32`"),
    ("", "std_msgs::Int32ConstPtr p;", "write `std_msgs::Int32`"),
    ("", "ros::Publisher pub;", "publish with `PUBLISH(/topic, package/Type, value);`"),
    ("", "ros::NodeHandle nh;", "a monitor is no node; leave it out"),
    ("", "ros::Rate r(10);", "write `event name() every 100ms { … }`"),
    ("", "ros::spinOnce();", "a monitor is no node; leave it out"),
    ("", "ros::Duration(1).sleep();", "an action must not wait"),
    ("", "std::stringstream s;", "build a `std::string` with `+`"),
    ("", "std::mutex m;", "messages come one at a time; leave it out"),
    ("", "tf::StampedTransform t;", "transforms are not looked up"),
    ("", "boost::variant_of_mine x;", "of boost there is nothing"),
    ("", "static int k = 0;", "declare it before the events"),
    ("", "goto end;", "there are no jumps"),
    ("", "end: n = 1;", "there are no labels; use a loop, `break` or `continue`"),
    ("", "try { n = 1; } catch (...) { }", "there are no exceptions"),
    ("", "using namespace std;", "leave this line out"),
    ("", "typedef int T;", "types cannot be declared; write the type itself"),
    ("n = ", "std::max<int>(1, n);", "functions take no types"),
    ("n = ", "int{2};", "write `int(2)`"),
    ("", "int f(int x) { return x; }", "functions stand beside the events, not in them"),
    ("", "std_msgs::Int32 t();", "leave the `()` out"),
    ("", "DROP();", "write `DROP;`"),
    ("", "__SKIP;", "write `DROP;`"),
    ("", "elif (n) { }", "write `else if (…)`"),
    ("", "for x in v { }", "write `for (auto x : v) { … }`"),
    ("", "BOOST_FOREACH(int x, v) { }", "write `for (auto x : v) { … }`"),
    ("n = n ", "** 2;", "write `pow(x, y)`"),
    ("if (n ", "=== 1) { }", "write `==`"),
    ("bool b = ", "True;", "write `true`"),
    ("", "let x = 3;", "write `auto`"),
    ("", "Twist t;", "did you mean `geometry_msgs::Twist`?"),
    ("", "std_msgs.Int32 t;", "write `std_msgs::Int32`"),
    ("n = 3 ", "\u2212 1;", "this is U+2212, MINUS SIGN; write `-`"),
    ("n = 3", "\n n = 4;", "expected `;` behind this, found `n` in line 4"),
    ("n = 3", " // three\n n = 4;", "expected `;` behind this, found `n` in line 4"),
    ("if ", "n == 1 { }", "a condition stands in parentheses"),
]  # fmt: skip
IN_SPECIFICATIONS = [
    (
        "int f(",
        "int x = 3) { return x; }",
        "parameters have no default values; give the argument in each call",
    ),
    ("int f(int x, ", "int y = 3) { return x; }", "parameters have no default values"),
    ("", "template <typename T> T f(T x) { return x; }", "write a function for each type"),
    ("", "std::map<int, int> m;", "use two vectors"),
    ("", "std::shared_ptr<std_msgs::Int32> p;", "there are no pointers; declare the value itself"),
    ("", "using namespace std;", "leave this line out"),
    ("", "auto f() -> int { return 3; }", "write the type in front: `int f() { … }`"),
    ("", "public: int x;", "types cannot be declared"),
    ("", "import std_msgs.msg;", "types and functions are known by their names; leave this line out"),
    ("init ", "{ }", "write `init() { … }`"),
    ("event f() /t ", "std_msgs/msg/Int32 '{}' { }", "write `std_msgs/Int32`"),
    ("event f() /t std_msgs/Int32 ", "when (true) { }", "an event is `event name(int x) /topic package/Type"),
    ("event f ", "after(int x) : call() { }", "an event is `event name(int x) /topic package/Type"),
    ("event f(int d) /t std_msgs/Int32 '{data", ">3}' { }", "a condition stands behind it: `when (x > 3)`"),
    ("", "on f() /t std_msgs/Int32 '{}' { }", "an event begins with `event`: write `event f(…)`"),
    ("ere: e @match ", "( ) { }", "a handler is `@category { … }`"),
]
AROUND = [
    ("", "int x;\ns() {", "`int` cannot stand outside of a specification"),
    ("", "s-1() {", "write `s_1`"),
    ("", "import java.util.*;\ns() {", "leave this line out"),
]


HEAD = f"s() {{ std::vector<int> v; std_msgs::Int32 m;\n{EVENT}\n"
TEXTS = [
    *((HEAD + before, text + "\n} }", advice) for before, text, advice in IN_ACTIONS),
    *(("s() {\n" + before, text + f"\n{EVENT} }} }}", advice) for before, text, advice in IN_SPECIFICATIONS),
    *((before, text + f"\n{EVENT} }} }}", advice) for before, text, advice in AROUND),
]


@pytest.mark.parametrize(("before", "text", "advice"), TEXTS)
def test_what_to_write_instead(before: str, text: str, advice: str) -> None:
    """The place is where the foreign text begins, and what is expected has a name."""
    place, told = refused(before + text)
    assert advice in told
    assert place == len(before), told
    assert "something else" not in told


def test_an_open_brace_is_named() -> None:
    """A file that ends too early says which brace is open; those in texts and comments are none."""
    place, told = refused('s() {\nvoid f() { if (x) { "}"; // }\n')
    assert told.endswith("the `{` at 2:19 has no `}`"), (place, told)


def test_a_place_behind_very_many_comments_is_found() -> None:
    """However many lines of comments stand between what is right and what is not, and whatever quotes are in them."""
    place, told = refused("s() { int x" + " // it's\n" * 5000 + "/* ' */ }")
    assert (place, told) == (11, "expected `;` behind this, found `}` in line 5001")


@pytest.mark.parametrize(
    "behind",
    [
        "ltl: []e @violation { }",
        "LTL : []e @violation { }",
        "creation event f() every 1s { }",
        "event f() every 1s { }",
    ],
)
@pytest.mark.parametrize("between", [" ", "\n", " // what follows\n"])
def test_a_property_without_handlers_ends_where_the_next_begins(behind: str, between: str) -> None:
    """As in MOP, which reads a property's text to its handlers; here it ends at the next property or event, too."""
    [found] = parse(f"s() {{ {EVENT} }} ere: e e*{between}{behind} }}", "x.rv").specifications
    assert found.properties[0].formula.split("//")[0].strip() == "e e*"
    assert len(found.properties) + len(found.events) == 3
