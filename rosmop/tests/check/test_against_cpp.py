"""Random expressions and assignments have the results of a C++ compiler for the same text.

The examples avoid undefined results of C++, except integers that wrap (a compiler option).
"""

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from rosmop.check.sources import compiled_from
from rosmop.runtime.numbers import MATH
from rosmop.tests.acting import act, definitions, message
from rosmop.tests.examples import examples
from rosmop.tests.on_module import on_module

pytestmark = pytest.mark.nightly

TYPES = (
    "int8_t", "uint8_t", "int16_t", "uint16_t", "int", "unsigned int", "long", "unsigned long", "float", "double",
    "bool", "char",
)  # fmt: skip
NAMES = tuple(f"a{index}" for index in range(len(TYPES)))
LITERALS = (
    "0", "1", "2", "7", "-1", "100", "255", "32767", "65536", "2147483647", "-2147483647", "3000000000", "1u",
    "4294967295u", "5L", "1.5", "-2.25", "0.5f", "1e3", "'a'", "true", "false",
)  # fmt: skip
FUNCTIONS = """
int ii(double d) { return d > 2e9 ? 5 : d < -2e9 ? -5 : d != d ? 0 : (int) d; }
unsigned int uu(double d) { return d > 4e9 || !(d > 0) ? 9u : (unsigned int) d; }
"""
VECTORS = """std::vector<long> v = {1, 2, 3}; std::vector<long> w; long f[4] = {5, 6}; long total = 0;
std::vector<long> turned(std::vector<long> given, long k) {
    std::reverse(given.begin(), given.end()); given.resize(k); return given; }
std::vector<long> longer(const std::vector<long>& one, const std::vector<long>& other) {
    if (one.size() < other.size()) { return other; } return one; }
long exchange(std::vector<long>& one, std::vector<long>& other, long& count) {
    std::vector<long> t = one; one = other; other = t; one.push_back(count); count += 3; return t.size(); }
"""
HEADERS = (
    "#include <algorithm>\n#include <cmath>\n#include <cstdint>\n#include <cstdio>\n#include <vector>\n"
    "using std::printf;\n"
)


def expression(random: Random, depth: int) -> str:
    if depth == 0 or random.random() < 0.15:
        return random.choice((random.choice(NAMES), random.choice(LITERALS)))
    a, b, c = (expression(random, depth - 1) for _ in range(3))
    sign = random.choice
    forms = (
        f"({a} {sign('+-*')} {b})",
        f"({a} {sign('+-*')} {b})",
        f"({a} {sign(('<', '>', '<=', '>=', '==', '!='))} {b})",
        f"({a} {sign(('&&', '||'))} {b})",
        f"({a} ? {b} : {c})",
        f"(ii({a}) {sign('&|^')} uu({b}))",
        f"(ii({a}) {sign(('<<', '>>'))} (ii({b}) & 31))",
        f"(ii({a}) {sign('/%')} (ii({b}) | 1))",
        f"({a} / (double) ((ii({b}) & 7) + 1))",
        f"{sign('-!+')}({a})",
        f"~ii({a})",
        f"std::{sign(('min', 'max'))}((double) {a}, (double) {b})",
    )
    return random.choice(forms)


def program(random: Random) -> str:
    first = ("3", "-5", "120", "0", "1", "77", "-128", "1000000")
    lines = [f"{kind} {name} = {random.choice(first)};" for kind, name in zip(TYPES, NAMES, strict=True)]
    lines += [f'printf("%.9g\\n", (double) ({expression(random, 4)}));' for _ in range(60)]
    for _ in range(40):
        name, value = random.choice(NAMES), expression(random, 2)
        exact = TYPES[NAMES.index(name)] in ("float", "double", "bool")
        operator = random.choice(("=", "+=", "-=", "*="))
        lines.append(f"{name} {operator} {value if exact else f'ii({value})'};")
        lines.append(f'printf("%.9g\\n", (double) {name});')
    return "\n".join(lines)


def vector_program(random: Random) -> str:
    lines = []
    for _ in range(80):
        a, b = random.sample(("v", "w"), 2)
        k, x = random.randrange(12), random.randrange(-99, 99)
        lines.append(
            random.choice(
                (
                    f"{a}.push_back({x});",
                    f"{a}.push_back(total);",
                    f"if (!{a}.empty()) {{ {a}.pop_back(); }}",
                    f"if (!{a}.empty()) {{ {a}[{k} % {a}.size()] = {x}; {a}.back() += {a}.front(); }}",
                    f"{a}.insert({a}.begin() + {k} % ({a}.size() + 1), {x});",
                    f"{a}.insert({a}.end(), {x});",
                    f"if (!{a}.empty()) {{ {a}.erase({a}.begin() + {k} % {a}.size()); }}",
                    f"{a}.erase({a}.begin() + {a}.size() / 2, {a}.end());",
                    f"{a}.resize({k});",
                    f"std::sort({a}.begin(), {a}.end());",
                    f"std::reverse({a}.begin(), {a}.end());",
                    f"if ({a} == {b}) {{ total += 1; }} else {{ {a} = {b}; {b}.resize({k}); }}",
                    f"{a} = turned({a}, {k});",
                    f"{{ long k = {k}; total += exchange({a}, {b}, k) + k; total += exchange({b}, {a}, k) * k; }}",
                    f"{a} = longer(turned({b}, {k}), {a});",
                    f"for (auto one : turned(longer({a}, {b}), 5)) {{ total = total * 3 + one; }}",
                    f"total += longer({a}, {b}).size() + turned({a}, 4)[3];",
                    f"{a} = {b}; if ({a} != {b}) {{ total += 7; }}",
                    f"{a}.resize(90); for (auto& one : {a}) {{ total = total * 5 + 3; one = total % 64; }}"
                    f" std::sort({a}.begin() + {k}, {a}.end());",
                    f"{a} = {b};",
                    f"{a} = {{{x}, total, {k}}};",
                    f"{a}.clear();",
                    f"f[{k % 4}] += {x} + f[{k % 3}];",
                    f"for (auto& one : {a}) {{ one += {x}; }}",
                    f"for (int i = 0; i < {a}.size(); i++) {{ {a}[i] *= i; }}",
                    f"{{ std::vector<long> t = {a}; t.push_back({x}); {a} = {b}; {b} = t; t[0] = {k}; }}",
                    f"{{ std::vector<long> t({k}); std::vector<long> u({k}, {x}); t = u; t.insert(t.begin(), 7);"
                    f" {a} = t; }}",
                    f"if ({a}.size() > 4) {{ {a}.erase({a}.begin()); }}",
                )
            )
        )
        lines.append(f"for (auto one : {a}) {{ total = total * 3 + one; }}")
        lines += [
            f'printf("%.9g\\n", (double) ({value}));'
            for value in ("total", "v.size() * 100 + w.size()", "f[0] + f[1] * 3 + f[2] * 5 + f[3] * 7")
        ]
    return "\n".join(lines)


def float_program(random: Random) -> str:
    lines = []
    for name, (count, _) in MATH.items():
        for _ in range(20):
            spread = random.choice((1.0, 3.0, 50.0, 1e6))
            given = ", ".join(f"{random.uniform(-spread, spread):.6f}f" for _ in range(count))
            lines += [
                f'printf("%.17g\\n", (double) {name}({given}));',
                f'printf("%.17g\\n", (double) {name}f({given}));',
            ]
    mixed = (
        "pow(y, 2)",
        "pow(y, y)",
        "fmin(y, 0.3)",
        "atan2(y, 1)",
        "sqrt(y) == sqrtf(y)",
        "labs(-2.5)",
        "abs(-y)",
    )
    lines += [f'printf("%.17g\\n", (double) ({one}));' for one in mixed]
    return "float y = 0.1;\n" + "\n".join(lines)


def compiler_of_cpp() -> str:
    path = shutil.which("g++")
    if path is None and os.environ.get("CI", "").lower() in ("1", "true", "yes"):
        pytest.fail("needs `g++` (Debian: sudo apt install g++), which this CI machine lacks", pytrace=False)
    return path or pytest.skip("needs `g++` (Debian: sudo apt install g++)")


def test_functions_on_floats_are_the_compilers(tmp_path: Path) -> None:
    compiler = compiler_of_cpp()
    body = float_program(Random(1))  # noqa: S311  draws examples, not keys
    source = tmp_path / "program.cpp"
    source.write_text(f"#include <math.h>\n#include <stdlib.h>\n{HEADERS}int main() {{\n{body}\n}}\n")
    program = str(tmp_path / "program")
    subprocess.run([compiler, "-w", "-O0", "-fno-builtin", "-o", program, str(source)], check=True)
    expected = subprocess.run([program], check=True, capture_output=True, text=True).stdout
    outcome = act(body)
    assert not outcome.faults
    assert [line.text.replace("-nan", "nan") for line in outcome.log] == expected.replace(
        "-nan", "nan"
    ).split()


def in_module(body: str) -> list[str]:
    begins = 'printf("%.9g\\n", '
    lines: list[str] = []
    names: list[str] = []
    for line in body.splitlines():
        if line.startswith(begins):
            names.append(f"o{len(names)}")
            lines.append(f"{names[-1]} = {line.removeprefix(begins).removesuffix(');')};")
        else:
            lines.append(line)
    variables = " ".join(f"double {name} = 0;" for name in names)
    text = "\n".join((f"s() {{ {variables} {FUNCTIONS} event e() /t std_msgs/Int32 '{{}}' {{", *lines, "} }"))
    monitors = on_module(compiled_from({"x.rv": text}, definitions()))
    monitors.start(0)
    monitors.monitor("s").seen = True
    lane = monitors.lane("/t")
    assert lane is not None
    taken = lane.process_message(message("std_msgs/Int32", data=0), 1, lane.prepare(loud=True, told=[True]))
    assert taken is not None
    assert (taken.events, [*taken.log]) == (("s.e",), [])
    return [f"{monitors.value('s', name):.9g}" for name in names]


def printed(body: str, before: str, directory: Path, *options: str) -> list[str]:
    compiler = compiler_of_cpp()
    source, program = directory / "program.cpp", str(directory / "program")
    source.write_text(f"{HEADERS}{before}int main() {{\n{body}\n}}\n")
    subprocess.run([compiler, "-w", "-fwrapv", "-O0", *options, "-o", program, str(source)], check=True)
    return subprocess.run([program], check=True, capture_output=True, text=True).stdout.split()


@pytest.mark.parametrize(
    "make", [(program, FUNCTIONS), (vector_program, VECTORS)], ids=["numbers", "vectors"]
)
@pytest.mark.parametrize("seed", range(examples(12)))
def test_the_language_agrees_with_a_compiler(
    seed: int, make: tuple[Callable[[Random], str], str], tmp_path: Path
) -> None:
    write, before = make
    body = write(Random(seed))  # noqa: S311  draws examples, not keys
    expected = [line.replace("-nan", "nan") for line in printed(body, before, tmp_path)]
    outcome = act(body, before=before)
    assert not outcome.faults
    assert [line.text for line in outcome.log] == expected
    if write is program:
        assert in_module(body) == expected
