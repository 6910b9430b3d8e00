# ruff: noqa: E501  the rows of tables

import pytest

from rosmop.form.findings import Position, SpecificationError
from rosmop.text import tree
from rosmop.text.builder import TreeBuilder
from rosmop.text.parser import MAX_CHARACTERS, _parser, parse
from roswire.names import is_global_name


def parsed(text: str) -> tree.Specification:
    [found] = parse(text, "x.rv").specifications
    return found


def event(body: str = "", head: str = "event e() /t std_msgs/Empty '{}'") -> tree.EventDefinition:
    [found] = parsed(f"s() {{ {head} {{ {body} }} }}").events
    return found


def refusal(text: str) -> tuple[int, int, str]:
    with pytest.raises(SpecificationError) as caught:
        parse(text, "x.rv")
    finding = caught.value.findings[0]
    return finding.position.line, finding.position.column, finding.text


def test_each_rule_of_the_grammar_has_a_method() -> None:
    rules = {str(rule.alias or rule.origin.name): rule for rule in _parser().rules}
    methods = {name for name in vars(TreeBuilder) if not name.startswith("_")} - {"at", "refuse"}
    assert methods - rules.keys() == set()
    built = {name for name, rule in rules.items() if rule.alias or not rule.options.expand1}
    assert {name for name in built if not name.startswith("_")} - methods == set()


HEADS = [
    ("a() {", "a", ()),
    ("a {", "a", ()),
    ("hold a() {", "a", ("hold",)),
    ("one two a {", "a", ("one", "two")),
    ('#include <math.h>\n#include "ros/ros.h"\nusing namespace std;\n\na() {', "a", ()),
    ("#define X \\\n  1\na() {", "a", ()),
    (
        "#ifndef X\n#define X // once\n#include <x>\n#if Y(X)\n/* X */\n#endif\n#endif\n#pragma once\na() {",
        "a",
        (),
    ),
    ("// comment\n/* of * two\n lines **/ a() {", "a", ()),
    ("\ufeffa() {", "a", ()),
]


@pytest.mark.parametrize(("head", "name", "modifiers"), HEADS)
def test_the_head_of_a_specification(head: str, name: str, modifiers: tuple[str, ...]) -> None:
    specification = parsed(f"{head} event e() /t std_msgs/Empty '{{}}' {{ }} }}")
    assert specification.name == name
    assert tuple(modifier.parts[0] for modifier in specification.modifiers) == modifiers


@pytest.mark.parametrize(
    "topic", ["/1", "/1/cmd_vel", "/robots/1/cmd_vel", "/robot/_x", "/_x", "/9to5/2e3", "/a"]
)
def test_every_global_name_is_a_topic(topic: str) -> None:
    assert is_global_name(topic)
    found = parsed(
        f"""preset s 1 as s {{ given_one = {topic}; }} s() given {{ topic given_one = /b; topic other={topic}; }} {{
        std_msgs::Empty m; bool quiet; safe std_msgs/Empty {{ }} on {topic} every 1s; withhold {topic} from "10.0.0.1" while quiet;
        event e(int n) {topic} std_msgs/Int32 '{{data:n}}' {{ PUBLISH({topic}, std_msgs/Empty, m); n = n /1 + 8 /2/n; }}
        event c() service {topic} std_srvs/Empty request '{{}}' {{ CALL({topic}, std_srvs/Empty, m); }} }}"""
    )
    assert [given.topic for given in found.givens if isinstance(given, tree.TopicDeclaration)] == [
        topic,
        topic,
    ]
    triggers = [event.trigger for event in found.events]
    assert [one.topic for one in triggers if isinstance(one, tree.MessageTrigger)] == [topic, topic]
    assert [safe.topic for safe in found.safes] == [topic]
    assert [node.topic for node in tree.walk(found) if isinstance(node, tree.PublishStatement)] == [topic]
    assert [node.service for node in tree.walk(found) if isinstance(node, tree.CallStatement)] == [topic]
    assert (
        sum(isinstance(node, tree.BinaryExpression) and node.operator == "/" for node in tree.walk(found))
        == 3
    )


def test_several_specifications_in_a_file() -> None:
    text = "a() { event e() /t std_msgs/Empty '{}' { }; };\nb { event e() /t std_msgs/Empty '{}' { } }"
    assert [found.name for found in parse(text, "x.rv").specifications] == ["a", "b"]


def test_functions_and_declarations_may_stand_anywhere() -> None:
    found = parsed("""s() {
        int a = 10; double b, c = 2.5; std::string const t = "x"; char d[20]; std::vector<std::vector<double>> v;
        init() { a = 1; }
        event e() /t std_msgs/Empty '{}' { raw(); }
        raw() { a = 2; }
        double half(double x) { return x / 2; }
        event f() /t std_msgs/Empty '{}' { }
        unsigned long long z;
    }""")
    assert [declarator.name for each in found.declarations for declarator in each.declarators] == list(
        "abctdvz"
    )
    assert [function.name for function in found.functions] == ["raw", "half"]
    assert [each.name for each in found.events] == ["e", "f"]
    assert len(found.inits) == 1


TRIGGERS = [
    ("event e() /t std_msgs/Empty '{}'", ("/t", "std_msgs/Empty", None)),
    ("event e() /a/b_1 std_msgs::Empty '{}'", ("/a/b_1", "std_msgs/Empty", None)),
    ("event e() /t std_msgs/Empty'{}'", ("/t", "std_msgs/Empty", None)),
    ("event e() /t std_msgs/Empty \u2018{}\u2019", ("/t", "std_msgs/Empty", None)),
    ("creation event e() /t std_msgs/Empty '{}'", ("/t", "std_msgs/Empty", None)),
    ("static /* the only one */ event e() /t std_msgs/Empty '{}'", ("/t", "std_msgs/Empty", None)),
    ("creation // first\n unsynchronized event e() /t std_msgs/Empty '{}'", ("/t", "std_msgs/Empty", None)),
    ("event e() /t std_msgs/Empty // which\n '{}'", ("/t", "std_msgs/Empty", None)),
    ("event e() /t std_msgs/Empty/* which */'{}'", ("/t", "std_msgs/Empty", None)),
    ("event e() /t std_msgs::Empty /* one */ // two\n '{}'", ("/t", "std_msgs/Empty", None)),
    ("event e() service /s std_srvs/Empty /**/ request '{}'", ("/s", "std_srvs/Empty", "request")),
    ("event e() service /s std_srvs::Empty /* a * b */ request '{}'", ("/s", "std_srvs/Empty", "request")),
    ("event e() service /s std_srvs/Empty request '{}'", ("/s", "std_srvs/Empty", "request")),
    ("event e() service /s std_srvs::Empty response '{}'", ("/s", "std_srvs/Empty", "response")),
]


@pytest.mark.parametrize(("head", "expected"), TRIGGERS)
def test_triggers_of_events(head: str, expected: tuple[str, str, str | None]) -> None:
    trigger = event(head=head).trigger
    assert isinstance(trigger, tree.MessageTrigger)
    assert (trigger.topic, trigger.type, trigger.part) == expected


DURATIONS = [
    ("100ms", 10**8),
    ("100 ms", 10**8),
    ("0.5s", 5 * 10**8),
    ("2m", 120 * 10**9),
    ("3", 3 * 10**9),
    (".5 s", 5 * 10**8),
    ("1h", 3600 * 10**9),
    ("2000us", 2 * 10**6),
]


@pytest.mark.parametrize(("text", "nanoseconds"), DURATIONS)
def test_durations(text: str, nanoseconds: int) -> None:
    trigger = event(head=f"event e() every {text}").trigger
    assert isinstance(trigger, tree.TimerTrigger)
    assert trigger.period_ns == nanoseconds


def test_a_comma_may_end_a_pattern() -> None:
    paths = []
    for comma in (",", ""):
        pattern = f"'{{a:x, b:{{c:y{comma}}}{comma}}}'"
        trigger = event(head=f"event e(int x, int y) /t p/T {pattern}").trigger
        assert isinstance(trigger, tree.MessageTrigger)
        paths.append([[step.name for step in binding.path] for binding in trigger.pattern])
    assert paths == [[["a"], ["b", "c"]]] * 2


def test_patterns_are_paths() -> None:
    head = "event e(int a, int b) /t p/T '{x.y[2]:a, z:{w:{v:b}, c:-1.5}, s: \"on\", k: p::T::K, t: true}'"
    trigger = event(head=head).trigger
    assert isinstance(trigger, tree.MessageTrigger)
    found = [
        (".".join(step.name + (f"[{step.index}]" if step.index is not None else "") for step in binding.path),
         binding.variable, type(binding.constant).__name__)
        for binding in trigger.pattern
    ]  # fmt: skip
    assert found == [
        ("x.y[2]", "a", "NoneType"), ("z.w.v", "b", "NoneType"), ("z.c", None, "UnaryExpression"), ("s", None, "StringLiteral"),
        ("k", None, "Name"), ("t", None, "Name"),
    ]  # fmt: skip


def test_the_older_brackets_of_actions() -> None:
    found = parsed("s() { event e() /t std_msgs/Empty '{}' << int a = 1 << 2; >> }").events[0]
    assert len(found.action.statements) == 1


def test_properties() -> None:
    specification = parsed("""s() {
    event e() /t std_msgs/Empty '{}' { }
    ERE :  (e e)* // not @this
       e
    @match { __RESET; } @fail { }
    fsm: s0 [ e -> s0 ] @s0 { }
    }""")
    first, second = specification.properties
    assert (first.logic, first.formula.split(), second.formula) == (
        "ERE",
        ["(e", "e)*", "//", "not", "@this", "e"],
        "s0 [ e -> s0 ]",
    )
    assert first.formula_position == Position("x.rv", 3, 12)
    assert [handler.category for handler in first.handlers] == ["match", "fail"]


@pytest.mark.parametrize("name", ["auto", "new", "break", "try", "default", "NULL"])
def test_a_category_may_be_a_word_of_cpp(name: str) -> None:
    specification = parsed(
        f"s() {{ event e() /t std_msgs/Empty '{{}}' {{ }} fsm: {name} [ e -> {name} ] @{name} {{ }} }}"
    )
    assert [handler.category for handler in specification.properties[0].handlers] == [name]


NAMES = ["event", "init", "service", "every", "when", "request", "response", "hold"]


@pytest.mark.parametrize("name", NAMES)
def test_words_of_the_language_are_names_where_they_mean_nothing(name: str) -> None:
    assert len(event(f"int {name} = 1; {name} = {name} + 1;").action.statements) == 2


STATEMENTS = [
    "a * b;", "a & b;", "a < b;", "a / b;", "std::string s;", "geometry_msgs/Twist t;", "geometry_msgs::Twist t = MESSAGE;",
    "std::vector<geometry_msgs/Twist> v;", "std::vector<int> v(3, 0), w{1, 2};", "unsigned char c = 'x';", "x = (int) y;",
    "x = (y) + 1;", "if (a) if (b) c; else d;", "for (;;) { }", "for (a::b c : d) { }", "for (a::b & c : d) { }",
    "PUBLISH(/t, std_msgs/String /* why */, s);", "std_msgs/String /* a */ s;",
    "x = (uint8_t) y;", "x = (size_t)3;", "x = (int64_t)x * 1000000;", "x = (std::int8_t) 200;", "x = (std :: size_t)(y);",
    "std::vector<std::vector<std::string>> v;",
    "v = std::vector<std::vector<std::string>>(3);", "auto v = std::vector<std::vector<double> >{{1.0}};", "x = (int8_t) (uint16_t) -y;", "f(size_t(3));",
    "x = c ? x & mask : 0;", "x = c ? a&b:d;", "switch (x) { case a & b: y; }", "for (int i = c ? a & b : 0; i; ) { }",
    "for (const auto& a : v) { }", "for (const std::vector<int> & /* each */ a : v) x = a ? b & c : d;", "for (auto &a: v) { }",
    "PUBLISH(/t, std_msgs/String, s);", 'PUBLISH("/t", "std_msgs::String", s);', "DROP;", "return;", "delete[] p;",
    "a.b[1].c().d = e ? f : g, h;", "a = b = c;", "a <<= 1; b >>= 2;", "x = -+!~y;", "a++; ++a; a--; --a;", ";;;", "do x; while (y);",
    "switch (a) { case 1: case 2: { b; } break; default: c; }", "std::cout << a << std::endl;", "double m[2] = {1, 2};",
    "const double k(3.0);", "auto x = std::numeric_limits<double>::max();", "x = \u201ctypographic\u201d;", "long long int q;",
]  # fmt: skip


@pytest.mark.parametrize("statement", STATEMENTS)
def test_a_statement_is_read(statement: str) -> None:
    assert event(statement).action.statements


REFUSALS = [
    ("", 1, 1, "there is no specification in this file"),
    ("a() {\n int x;\n\n  \n", 2, 8, "found the end of the file, expected a declaration, an `event`"),
    ("a() { event x() /t p/T " + "/" * 5000 + "\n", 1, 20, "a message type such as"),
]


@pytest.mark.parametrize(("text", "line", "column", "reason"), REFUSALS)
def test_an_error_in_an_empty_or_long_text_has_a_position(
    text: str, line: int, column: int, reason: str
) -> None:
    found = refusal(text)
    assert found[:2] == (line, column)
    assert reason in found[2]


def test_a_file_has_a_limit() -> None:
    assert "split it into several" in refusal("a" * (MAX_CHARACTERS + 1))[2]


def test_trees_at_different_places_are_equal() -> None:
    text = "s() { int a = 1; event e(int x) /t p/T '{a.b[1]:x, c:2}' when (x) { a++; } ere: e @match { } }"
    assert parsed(text) == parsed("\n\n  " + text.replace(" when", "\n   when"))
    assert parsed(text) != parsed(text.replace("a = 1", "a = 2"))
