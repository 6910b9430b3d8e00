"""Random statements with side effects have the results of g++ for C++17."""

import re
from pathlib import Path
from random import Random
from typing import Literal

import pytest

from rosmop.tests.acting import act
from rosmop.tests.both_ways import BothWays, plain
from rosmop.tests.check.test_against_cpp import printed
from rosmop.tests.examples import examples

Kind = Literal["numbers", "vectors", "others"]
CHANGES = (
    "i = (i + 1) & 3;", "j = 3 - (i & 3);", "v = {i, j, 7, 2};", "v[1] = i + 4;", "v[j & 3]++;",
    "total = total * 3 + i;",
    "d = d / 2 + i;", "w.push_back(i); if (w.size() > 6) { w.erase(w.begin()); }",
    "w.insert(w.begin(), j); w.pop_back();",
    "f[i & 3] = j;", "swapped = !swapped;",
)  # fmt: skip
OF_TEXTS = (
    's = "bcdefg";',
    "s[j & 3] = 'x';",
    't = s + "tttt";',
    "s.push_back('k'); if (s.size() > 9) { s = t; }",
)
OF_MESSAGES = (
    "p.x = i; q.y = j;", "q = p; q.z = i + 1;", "p = q;", "ps[i & 3] = q;", "ps[1].y = j; p = ps[2];",
)  # fmt: skip
NUMBERS = "int i = 1; int j = 2; int b = 5; long total = 3; double d = 0.5; bool swapped = false;\n"
VECTORS = "std::vector<int> v = {1, 2, 3, 4}; std::vector<int> w = {9, 8}; int f[4] = {4, 5};\n"
TEXTS = 'std::string s = "abcdef"; std::string t = "uvwxyz"; std::vector<std::string> ss(4, "mnopqr");\n'
MESSAGES = "geometry_msgs::Point p; geometry_msgs::Point q; std::vector<geometry_msgs::Point> ps(4);\n"
CPP = """#include <iostream>
#include <string>
namespace geometry_msgs { struct Point { double x = 0, y = 0, z = 0; }; }
"""
LOOK = """long look() {
  long h = i; h = h * 31 + j; h = h * 31 + b; h = h * 31 + total; h = h * 31 + (long) (d * 64) + swapped;
  for (int x : v) { h = h * 31 + x; } for (int x : w) { h = h * 31 + x; }
  h = h * 31 + f[0]; h = h * 31 + f[1]; h = h * 31 + f[2]; h = h * 31 + f[3];
"""
LOOK_AT_TEXTS = """for (int k = 0; k < s.size(); k++) { h = h * 31 + s[k]; }
  for (int k = 0; k < t.size(); k++) { h = h * 31 + t[k]; }
  for (int n = 0; n < 4; n++) { for (int k = 0; k < ss[n].size(); k++) { h = h * 31 + ss[n][k]; } }
"""
LOOK_AT_MESSAGES = """h = h * 31 + (long) (p.x * 3 + p.y * 5 + p.z * 7);
  h = h * 31 + (long) (q.x * 3 + q.y * 5 + q.z * 7);
  for (int k = 0; k < 4; k++) { h = h * 31 + (long) (ps[k].x * 3 + ps[k].y * 5 + ps[k].z * 7); }
"""


# The module leaves these to the engine: vectors, strings, messages, and functions with such arguments.
_NOT_PLAIN = re.compile(r"\b(v|w|f|s|t|ss|p|q|ps)\b|\b(h|k|far|add|both|move|same)\(")
_PLAIN_FUNCTIONS = 2  # of g0 to g4, in programs that also have other functions


class Programs:
    """Random programs of numbers, of numbers and vectors, or of all types. Some statements have only numbers."""

    def __init__(self, seed: int, kind: Kind, *, orders: bool = True) -> None:
        self._random = Random(seed)  # noqa: S311  draws examples, not keys
        self._kind = kind
        self._plain = False  # whether the next statement has numbers only
        self._orders = orders

    def declarations(self) -> str:
        others, random = self._kind == "others", self._random
        changes = [*CHANGES, *(OF_TEXTS + OF_MESSAGES if others else ())]
        text = NUMBERS + VECTORS + (TEXTS + MESSAGES if others else "")
        for number in range(5):
            self._plain = self._kind == "numbers" or number < _PLAIN_FUNCTIONS
            body = " ".join(self._draw(changes) for _ in range(random.randint(1, 4)))
            text += f"int g{number}() {{ {body} return {self._draw(['i', 'j', 'v[1]', 'total'])} & 3; }}\n"
        text += "int quiet() { i = (i + 1) & 3; total += i; return j; }\n"
        text += "int h(int a, const std::vector<int>& x) { i++; total += a; return x[a & 3] + x.size(); }\n"
        if others:
            text += "int k(const std::string& x, int a) { i++; return x[a & 3] + a; }\n"
            text += "void add(int& x, int a) { x += a; } void both(int& x, int& y) { int z = x; x = y + 1; y = z; }\n"
            text += (
                "double far(const geometry_msgs::Point& x, int a) { j = a & 3; return x.x + x.y + x.z; }\n"
            )
            text += (
                "std::vector<int> same(const std::vector<int>& x) { w = {i, 2}; w[0] = j; i++; return x; }\n"
            )
            text += "void move(geometry_msgs::Point& x, int a) { x.x += a; x.z = a; }\n"
        look = LOOK + (LOOK_AT_TEXTS + LOOK_AT_MESSAGES if others else "")
        return f"{text}{look} return h % 1000003; }}\n"

    def statements(self, count: int) -> list[str]:
        return [self._statement() for _ in range(count)]

    def _draw(self, choices: list[str]) -> str:
        return self._random.choice([one for one in choices if not (self._plain and _NOT_PLAIN.search(one))])

    def _call(self) -> str:
        return f"g{self._random.randrange(_PLAIN_FUNCTIONS if self._plain else 5)}()"

    def _index(self) -> str:
        one = self._draw(["i", "j", "i++", "--j", "++b", self._call(), self._call(), "v[i & 3]"])
        return f"({one} & 3)"

    def _value(self) -> str:
        call = self._call
        choices = [
            call(), call(), f"{call()} + 2", "i++", "--j", "b", f"v[{self._index()}]", f"f[{self._index()}]",
            f"h({call()}, v)", f"h({call()}, w.empty() ? v : v)", f"std::max(i, {call()})", f"std::min(b, {call()})",
            f"({call()} > 1 ? {call()} : {call()})", f"({call()} > 1 && {call()} > 0)", f"({call()} == 1 || i++ > 2)",
            f"({call()}, i)", f"(i++, {call()})", f"-{call()}", f"(v[{self._index()}] = {call()})", f"(b = {call()})",
            f"(b += {call()})", f"v.at({self._index()})", "(int) v.size()", f"(f[{self._index()}] += 2)",
            f"v[v[{self._index()}] & 3]", f"(v[{self._index()}]++)", f"std::abs({call()} - 2)",
        ]  # fmt: skip
        if self._kind == "others":
            choices += [f"k(s, {call()})", f"(int) far(p, {call()})", f"(int) far(ps[2], {call()})",
                        f"s[{self._index()}]",
                        f"(int) ps[{self._index()}].y", f"(int) s.find(\"e\", {call()})", f"k(ss[{self._index()}], 2)",
                        f"(int) ss[{self._index()}].size()", f"k(s.substr({self._index()}) + \"aaaa\", 1)"]  # fmt: skip
        if not self._orders:
            choices += [f"i + {call()}", f"{call()} + v[{self._index()}]", f"h(i, v) - {call()} * b",
                        "h(j++, v) + v[i & 3]",
                        f"({call()} < i)", f"(w == v) + {call()} * 2"]  # fmt: skip
            choices += (
                ["(w == same(v))", "(same(v) == w)", f"k(s + std::to_string({call()}), i)"]
                if self._kind == "others"
                else []
            )
        return self._draw(choices)

    def _target(self) -> str:
        """g++ 12 evaluates an array index without effects before the right side."""
        choices = ["i", "j", "b", "total", "d", f"v[{self._index()}]", "f[2]", f"v.at({self._index()})",
                   "v.front()", "v.back()"]  # fmt: skip
        if self._kind == "others":
            choices += [
                "p.x",
                "q.y",
                f"ps[{self._index()}].x",
                f"ps[{self._index()}].z",
                "ps.back().y",
                "ps[1].x",
            ]
        return self._draw(choices)

    def _statement(self) -> str:
        random, value, target, call = self._random, self._value, self._target, self._call
        self._plain = self._kind == "numbers" or random.random() < 0.25
        choices = [
            *[f"{target()} = {value()};"] * 3, f"{target()} {random.choice('+-')}= {value()};", f"{target()}++;",
            f"{target()} = b = {value()};", f"total = {target()}++;", f"w.push_back({value()}); w.erase(w.begin());",
            f"if ({value()} > {random.randrange(4)}) {{ {target()} = {value()}; }} else {{ total++; }}",
            f"switch ({value()} & 3) {{ case 0: i++; case 1: j = {call()}; break; default: b = {value()}; }}",
            f"for (int n = {call()}; n < {random.randrange(4)}; n += 1 + {call()}) {{ b += n; }}",
            "for (int x : v) { total += x; total += quiet(); }",
            f"{target()} = {target()} = {value()};",
        ]  # fmt: skip
        if self._kind == "others":
            choices += [
                f"add(i, {call()});", f"add(v[2], {call()});", f"add(v[{self._index()}], 3);", "both(i, v[i & 3]);",
                f"both(v[{self._index()}], b);", f"move(p, {value()});", f"move(ps[{self._index()}], 2);",
                f"s[{self._index()}] = 'a' + ({value()} & 7);", f"ss[{self._index()}] = s;",
                f"s += ss[{self._index()}];",
                f"ss[{self._index()}] += std::to_string({call()});", f"s.push_back('a' + {call()});",
                f"ss[{self._index()}][1] = 'a' + {call()};", f"ss[{self._index()}].append(std::to_string(b & 7));",
                f"s.append(std::to_string({call()}));", f"s.insert({self._index()}, t);",
                f"t = s.substr({call()}) + \"aaaa\";",
                f"ss[{self._index()}].push_back('q');", f"ss[{self._index()}].insert({call()}, \"z\");",
                f"ps[{self._index()}] = p;", f"ps[{self._index()}] = ps[{self._index()}];",
                f"p = q = ps[{self._index()}];",
                f"for (int& x : v) {{ x += quiet(); }} total += {value()};",
                f"ps.push_back(ps[{self._index()}]); ps.pop_back();", f"v = {{{call()}, {call()}, i, {call()}}};",
                "s = \"abcdef\"; t = \"uvwxyz\"; ss[0] = s; ss[1] = t; ss[2] = s; ss[3] = t;",
            ]  # fmt: skip
        return self._draw(choices)


def check(programs: Programs, count: int, directory: Path | None) -> BothWays:
    before, statements = programs.declarations(), programs.statements(count)
    body = "\n".join(f'{statement} printf("%ld\\n", look());' for statement in statements)
    outcome = act(body, before=before, most=1_000_000_000)
    assert not outcome.faults
    if directory is not None:
        expected = printed(body, CPP + before, directory, "-std=c++17")
        for line, value, one in zip(outcome.log, expected, statements, strict=True):
            assert line.text == value, one
    chosen = " ".join(f"if (c == {number}) {{ {statement} }}" for number, statement in enumerate(statements))
    fed = BothWays(f"s() {{ {before} event e(int c) /plain own/Plain '{{count:c}}' {{ {chosen} }} }}")
    for number in range(count):
        fed.check([plain(count=number)])
    return fed


@pytest.mark.nightly
@pytest.mark.parametrize(("kind", "taken"), [("numbers", 60), ("vectors", 10), ("others", 10)])
@pytest.mark.parametrize("seed", range(examples(12)))
def test_effects_are_in_the_order_of_the_compiler(seed: int, kind: Kind, taken: int, tmp_path: Path) -> None:
    fed = check(Programs(seed, kind), 60, tmp_path)
    assert fed.came["together"] >= taken


@pytest.mark.parametrize("kind", ["numbers", "vectors", "others"])
@pytest.mark.parametrize("seed", range(2))
def test_unspecified_orders_of_cpp_are_the_same_in_module_and_interpreter(seed: int, kind: Kind) -> None:
    check(Programs(seed, kind, orders=False), 60, None)
