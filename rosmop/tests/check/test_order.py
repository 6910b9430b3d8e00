"""What changes what else is looked at: random statements come to what C++17 says, as g++ has it."""

from pathlib import Path
from random import Random

import pytest

from rosmop.tests.acting import act, refused_action
from rosmop.tests.check.test_against_cpp import printed
from rosmop.tests.examples import examples
from rosmop.tests.test_walks import Fed, plain

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


class Programs:
    """Random programs: of numbers and vectors, or with strings, messages and references, too."""

    def __init__(self, seed: int, *, numbers: bool, orders: bool = True) -> None:
        """`orders`: C++ says which order everything has."""
        self._random = Random(seed)  # noqa: S311  draws examples, not keys
        self._numbers = numbers
        self._orders = orders

    def declarations(self) -> str:
        """Variables, and functions that change them."""
        numbers, random = self._numbers, self._random
        changes = CHANGES if numbers else CHANGES + OF_TEXTS + OF_MESSAGES
        text = NUMBERS + VECTORS + ("" if numbers else TEXTS + MESSAGES)
        for number in range(5):
            body = " ".join(random.choice(changes) for _ in range(random.randint(1, 4)))
            text += f"int g{number}() {{ {body} return {random.choice(('i', 'j', 'v[1]', 'total'))} & 3; }}\n"
        text += "int quiet() { i = (i + 1) & 3; total += i; return j; }\n"
        text += "int h(int a, const std::vector<int>& x) { i++; total += a; return x[a & 3] + x.size(); }\n"
        if not numbers:
            text += "int k(const std::string& x, int a) { i++; return x[a & 3] + a; }\n"
            text += "void add(int& x, int a) { x += a; } void both(int& x, int& y) { int z = x; x = y + 1; y = z; }\n"
            text += (
                "double far(const geometry_msgs::Point& x, int a) { j = a & 3; return x.x + x.y + x.z; }\n"
            )
            text += (
                "std::vector<int> same(const std::vector<int>& x) { w = {i, 2}; w[0] = j; i++; return x; }\n"
            )
            text += "void move(geometry_msgs::Point& x, int a) { x.x += a; x.z = a; }\n"
        look = LOOK + ("" if numbers else LOOK_AT_TEXTS + LOOK_AT_MESSAGES)
        return f"{text}{look} return h % 1000003; }}\n"

    def statements(self, count: int) -> list[str]:
        """Statements that change what their own parts look at."""
        return [self._statement() for _ in range(count)]

    def _call(self) -> str:
        return f"g{self._random.randrange(5)}()"

    def _index(self) -> str:
        one = self._random.choice(("i", "j", "i++", "--j", "++b", self._call(), self._call(), "v[i & 3]"))
        return f"({one} & 3)"

    def _value(self) -> str:
        """One number, by what has effects in an order that C++ knows."""
        random, call = self._random, self._call
        choices = [
            call(), call(), f"{call()} + 2", "i++", "--j", "b", f"v[{self._index()}]", f"f[{self._index()}]",
            f"h({call()}, v)", f"h({call()}, w.empty() ? v : v)", f"std::max(i, {call()})", f"std::min(b, {call()})",
            f"({call()} > 1 ? {call()} : {call()})", f"({call()} > 1 && {call()} > 0)", f"({call()} == 1 || i++ > 2)",
            f"({call()}, i)", f"(i++, {call()})", f"-{call()}", f"(v[{self._index()}] = {call()})", f"(b = {call()})",
            f"(b += {call()})", f"v.at({self._index()})", "(int) v.size()", f"(f[{self._index()}] += 2)",
            f"v[v[{self._index()}] & 3]", f"(v[{self._index()}]++)", f"std::abs({call()} - 2)",
        ]  # fmt: skip
        if not self._numbers:
            choices += [f"k(s, {call()})", f"(int) far(p, {call()})", f"(int) far(ps[2], {call()})",
                        f"s[{self._index()}]",
                        f"(int) ps[{self._index()}].y", f"(int) s.find(\"e\", {call()})", f"k(ss[{self._index()}], 2)",
                        f"(int) ss[{self._index()}].size()", f"k(s.substr({self._index()}) + \"aaaa\", 1)"]  # fmt: skip
        if not self._orders:
            choices += [f"i + {call()}", f"{call()} + v[{self._index()}]", f"h(i, v) - {call()} * b",
                        "h(j++, v) + v[i & 3]",
                        f"({call()} < i)", f"(w == v) + {call()} * 2"]  # fmt: skip
            choices += (
                []
                if self._numbers
                else ["(w == same(v))", "(same(v) == w)", f"k(s + std::to_string({call()}), i)"]
            )
        return random.choice(choices)

    def _target(self) -> str:
        """What may be assigned. Of an array with an index without effects g++ 12 takes that before the right side."""
        choices = ["i", "j", "b", "total", "d", f"v[{self._index()}]", "f[2]", f"v.at({self._index()})",
                   "v.front()", "v.back()"]  # fmt: skip
        if not self._numbers:
            choices += [
                "p.x",
                "q.y",
                f"ps[{self._index()}].x",
                f"ps[{self._index()}].z",
                "ps.back().y",
                "ps[1].x",
            ]
        return self._random.choice(choices)

    def _statement(self) -> str:
        random, value, target, call = self._random, self._value, self._target, self._call
        choices = [
            *[f"{target()} = {value()};"] * 3, f"{target()} {random.choice('+-')}= {value()};", f"{target()}++;",
            f"{target()} = b = {value()};", f"total = {target()}++;", f"w.push_back({value()}); w.erase(w.begin());",
            f"if ({value()} > {random.randrange(4)}) {{ {target()} = {value()}; }} else {{ total++; }}",
            f"switch ({value()} & 3) {{ case 0: i++; case 1: j = {call()}; break; default: b = {value()}; }}",
            f"for (int n = {call()}; n < {random.randrange(4)}; n += 1 + {call()}) {{ b += n; }}",
            "for (int x : v) { total += x; total += quiet(); }",
            f"{target()} = {target()} = {value()};",
        ]  # fmt: skip
        if not self._numbers:
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
        return random.choice(choices)


def check(programs: Programs, count: int, directory: Path | None) -> Fed:
    """Fail unless the compiler, interpreter and module have the same after each of so many statements.

    Without a directory nothing is compiled.
    """
    before, statements = programs.declarations(), programs.statements(count)
    body = "\n".join(f'{one} printf("%ld\\n", look());' for one in statements)
    outcome = act(body, before=before, most=1_000_000_000)
    assert not outcome.faults
    if directory is not None:
        expected = printed(body, CPP + before, directory, "-std=c++17")
        for line, value, one in zip(outcome.log, expected, statements, strict=True):
            assert line.text == value, one
    chosen = " ".join(f"if (c == {number}) {{ {one} }}" for number, one in enumerate(statements))
    fed = Fed(f"s() {{ {before} event e(int c) /plain own/Plain '{{count:c}}' {{ {chosen} }} }}")
    for number in range(count):
        fed.check([plain(count=number)])
    return fed


# Statements with vectors, messages and most strings are for the engine: a program may have no others.
@pytest.mark.parametrize(("numbers", "taken"), [(True, 4), (False, 0)], ids=["numbers", "others"])
@pytest.mark.parametrize("seed", range(examples(12)))
def test_effects_come_in_the_order_of_the_compiler(
    seed: int, *, numbers: bool, taken: int, tmp_path: Path
) -> None:
    """By the interpreter, and by the module where it does not leave the statement to it."""
    fed = check(Programs(seed, numbers=numbers), 60, tmp_path)
    assert fed.came["together"] >= taken


@pytest.mark.parametrize("numbers", [True, False], ids=["numbers", "others"])
@pytest.mark.parametrize("seed", range(2))
def test_what_has_any_order_in_cpp_has_one_here(seed: int, *, numbers: bool) -> None:
    """Interpreter and module agree on what C++ leaves open, too."""
    check(Programs(seed, numbers=numbers, orders=False), 60, None)


BEFORE = """int n = 1; std::vector<int> v = {1, 2, 3}; std::vector<std::vector<int>> vs;
int next() { n++; v = {7, 8, 9}; return n; } int first(const std::vector<int>& x) { n++; return x[0]; }
int changing(const std::vector<int>& x) { next(); return x[0]; } int of(const int& x) { v[0]++; return x; }
void into(std::vector<int>& x, const std::vector<int>& y) { x.push_back(y[0]); }"""


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (
            "x = changing(v);",
            "`changing` gives `v` another value, which `x` would not show: leave out the `&`",
        ),
        ("x = changing(vs[0]) + of(v[1]);", "`of` gives `v` another value, which `x` would not show"),
        ("into(v, v);", "`v` is handed to two references of `into`"),
    ],
)
def test_what_a_constant_reference_would_show_is_refused(call: str, told: str) -> None:
    """It is what it was when the function was called; C++ shows what the function changes."""
    (finding,) = refused_action(call, before=BEFORE)
    assert finding.text.startswith(told)


def test_a_constant_reference_to_what_nobody_changes() -> None:
    """A function that changes something else may have one, and what is handed over beside it may change it before."""
    outcome = act(
        'std::vector<int> w = {5}; into(w, v); into(v, w); into(w, v); printf("%d %d %d", first(v), changing(w), w[1]);'
        ' x = std::max(n, next()); printf("%d %d", x, n);',
        before=BEFORE,
    )
    assert [line.text for line in outcome.log] == ["1 5 1", "4 4"]


def test_an_index_with_effects_is_evaluated_once() -> None:
    """Where C++ looks at a place and changes it, its index is looked at once, behind the right side."""
    outcome = act(
        "into(vs[next() - 2], v); for (int& y : vs[n++ - 2]) { y += n; } v[next() - 3] += next(); v[n++ - 5]++;"
        ' printf("%d %d %d %d %d", v[0], v[1], v[2], n, vs[0][0]);',
        before=BEFORE + " init() { vs.resize(3); }",
    )
    assert not outcome.faults
    assert outcome.log[0].text == "8 8 13 6 10"
