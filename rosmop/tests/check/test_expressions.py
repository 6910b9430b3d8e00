"""Expressions have the values that C++ gives them on a 64-bit machine."""

# ruff: noqa: E501  the rows of tables

import pytest

from rosmop.tests.acting import act, load, refused_action, shown

INTEGERS = [
    ("1 + 2", 3),
    ("7 / 2", 3),
    ("-7 / 2", -3),
    ("7 / -2", -3),
    ("-7 % 3", -1),
    ("7 % -3", 1),
    ("2147483647 + 1", -2147483648),
    ("-2147483647 - 2", 2147483647),
    ("2147483647 * 2", -2),
    ("5 & 3 | 8 ^ 1", 9),
    ("~5", -6),
    ("1 << 33", 2),
    ("1 << 31", -2147483648),
    ("1 << -1", -2147483648),
    ("-16 >> 2", -4),
    ("0x10", 16),
    ("010", 8),
    ("'a'", 97),
    ("'a' + 1", 98),
    (r"'\n'", 10),
    (r"'\x41'", 65),
    ("(int) 2.9", 2),
    ("(int) -2.9", -2),
    ("(int) 1e20", 2147483647),
    ("(int) -1e20", -2147483648),
    ("(int) (0.0 / 0.0)", 0),
    ("(char) 200", -56),
    ("(unsigned char) 300", 44),
    ("(uint8_t)300", 44),
    ("x == 0 ? 7 & 3 : 0", 3),
    ("(size_t)3 / 2", 1),
    ("(int64_t)x * 1000000", 0),
    ("(std::int8_t) 200", -56),
    ("(uint16_t)(x - 1)", 65535),
    ("-(int16_t)40000", 25536),
    ("(short) 40000", -25536),
    ("int(3.7)", 3),
    ("static_cast<int>(3.7)", 3),
    ("(bool) 7", 1),
    ("true + true", 2),
    ("!0", 1),
    ("!!7", 1),
    ("-1 < 1u", 0),
    ("-1 < 1", 1),
    ("1 == 1.0", 1),
    ("3 > 2 && 2 > 1", 1),
    ("3 < 2 || 2 < 1", 0),
    ("1 ? 2 : 3", 2),
    ("0 ? 2 : 3", 3),
    ("x++ + ++x", 2),
    ("x-- - --x", 2),
    ("x += 3", 3),
    ("(x = 5, x * 2)", 10),
    ("std::max(1, 2)", 2),
    ("std::min(3, 2)", 2),
    ("abs(-3)", 3),
    ("std::abs(-3)", 3),
    ("std::stoi(\"42\")", 42),
    ("std::stoi(\" -42abc\")", -42),
    ("std::stoi(\"ff\", 0, 16)", 255),
    ("atoi(\"17x\")", 17),
    ("atoi(\"x\")", 0),
    ("strcmp(\"a\", \"b\")", -1),
    ("INT_MAX", 2147483647),
    ("std::numeric_limits<int>::max()", 2147483647),
    ("std::numeric_limits<short>::min()", -32768),
    ("std::string(\"abc\")[1]", 98),
    ("std::string(\"abc\")[3]", 0),
    ("std::vector<int>(3, 7)[2]", 7),
    ("std::vector<int>{1, 2, 3}[1]", 2),
    ("std::vector<int>{1, 2, 3}.back()", 3),
    ("ros::Duration(1.5).sec", 1),
    ("ros::Duration(1.5).nsec", 500000000),
    ("ros::Duration(-0.5).sec", -1),
    ("ros::Time(3, 7).nsec", 7),
    ("ros::Time(1) < ros::Time(2)", 1),
    ("ros::Time::now().sec", 1),
    ("isnan(0.0 / 0.0)", 1),
    ("std::isinf(1.0 / 0)", 1),
    ("geometry_msgs::Point().x == 0", 1),
    ("landshark_msgs::PaintballTrigger::SINGLE_SHOT", 1),
]  # fmt: skip


@pytest.mark.parametrize(("expression", "value"), INTEGERS)
def test_an_integer_expression(expression: str, value: int) -> None:
    """What an integer expression is, C++ would have it be."""
    assert shown(expression, conversion="%d") == str(value)


LONG = [
    ("3000000000", "3000000000"),
    ("-2147483648 / -1", "2147483648"),
    ("9223372036854775807 + 1", "-9223372036854775808"),
    ("1L << 40", "1099511627776"),
    ("18446744073709551615u + 1", "0"),
    ("4294967295u + 1u", "0"),
    ("2147483647u + 1", "2147483648"),
    ("0u - 1", "4294967295"),
    ("std::string::npos", "18446744073709551615"),
    ("std::string(\"abc\").size()", "3"),
    ("std::string(\"abc\").size() - 4", "18446744073709551615"),
    ("std::string(\"hello\").find(\"l\")", "2"),
    ("std::string(\"hello\").find(\"l\", 3)", "3"),
    ("std::string(\"hello\").rfind(\"l\")", "3"),
    ("std::string(\"hello\").find('o')", "4"),
    ("std::stol(\"5000000000\")", "5000000000"),
    ("ros::Time(1.5).toNSec()", "1500000000"),
]  # fmt: skip


@pytest.mark.parametrize(("expression", "value"), LONG)
def test_a_long_expression(expression: str, value: str) -> None:
    """64-bit and unsigned arithmetic wraps at its own width."""
    conversion = "%ld" if value.startswith("-") else "%lu"
    assert shown(expression, conversion=conversion) == value


DOUBLES = [
    ("7 / 2.0", "3.5"),
    ("1.0 / 0.0", "inf"),
    ("-1.0 / 0", "-inf"),
    ("0.0 / 0.0", "nan"),
    ("1.0 / -0.0", "-inf"),
    ("1e308 * 10", "inf"),
    ("1.5f * 3", "4.5"),
    ("(double) 3 / 2", "1.5"),
    ("double(1) / 4", "0.25"),
    ("5 / 2 * 2.0", "4"),
    ("sqrt(2.25)", "1.5"),
    ("sqrt(-1)", "nan"),
    ("log(0)", "-inf"),
    ("log(-1)", "nan"),
    ("exp(1000)", "inf"),
    ("pow(2, 10)", "1024"),
    ("pow(0, -1)", "inf"),
    ("pow(-8, 1.0 / 3)", "nan"),
    ("fmod(5.5, 2)", "1.5"),
    ("fmod(1, 0)", "nan"),
    ("round(2.5)", "3"),
    ("round(-2.5)", "-3"),
    ("rint(2.5)", "2"),
    ("floor(-1.5)", "-2"),
    ("ceil(1.2)", "2"),
    ("trunc(-1.7)", "-1"),
    ("fabs(-3.5)", "3.5"),
    ("hypot(3, 4)", "5"),
    ("atan2(0, -1)", "3.14159"),
    ("M_PI", "3.14159"),
    ("std::min(1.5, 2.0)", "1.5"),
    ("std::max(1, 2.5)", "2.5"),
    ("-x + 0.5", "0.5"),
    ("std::stod(\"2.5e1\")", "25"),
    ("true ? 1 : 2.5", "1"),
    ("ros::Time::now().toSec()", "1.5"),
    ("(ros::Time(5.5) - ros::Time(2)).toSec()", "3.5"),
    ("(ros::Duration(2) * 0.5).toSec()", "1"),
    ("std::numeric_limits<double>::infinity()", "inf"),
    (".5 + 1.", "1.5"),
]  # fmt: skip


@pytest.mark.parametrize(("expression", "value"), DOUBLES)
def test_a_floating_expression(expression: str, value: str) -> None:
    """Floating-point arithmetic is IEEE's, division by zero and overflow included."""
    assert shown(expression, conversion="%g") == value


def test_a_decimal_that_only_unsigned_long_holds() -> None:
    """It is one, with a warning, as g++ warns; behind a minus it is the least long."""
    assert shown("18446744073709551615", conversion="%lu") == "18446744073709551615"
    assert shown("-9223372036854775808", conversion="%ld") == "-9223372036854775808"
    warnings = load("s() { event e() /t std_msgs/Int32 '{}' { auto x = 9223372036854775808; } }").warnings
    assert [one.text for one in warnings] == [
        "`9223372036854775808` is larger than `long` holds, and an `unsigned long` here; write `9223372036854775808u`"
    ]


def test_a_float_is_rounded_to_32_bits() -> None:
    """A `float` holds what 32 bits hold, also between two operations."""
    assert shown("0.1f", conversion="%.10f") == "0.1000000015"
    assert shown("16777216.0f + 1.0f", conversion="%.1f") == "16777216.0"
    assert shown("(float) 1e300", conversion="%f") == "inf"
    assert shown("f", conversion="%.10f", before="float f = 0.1;") == "0.1000000015"


STRINGS = [
    ('std::string("ab") + "cd"', "abcd"),
    ('"ab" + std::string("cd")', "abcd"),
    ("std::string(\"ab\") + 'c'", "abc"),
    ("std::to_string(5)", "5"),
    ("std::to_string(1.5)", "1.500000"),
    ("std::to_string(-1L)", "-1"),
    ('std::string("hello").substr(1, 3)', "ell"),
    ('std::string("hello").substr(2)', "llo"),
    ("std::string(3, 'z')", "zzz"),
    ('std::string("abc").c_str()', "abc"),
    ('x ? "a" : "b"', "b"),
    ('std::min(std::string("b"), std::string("a"))', "a"),
    (r'"tab\tquote\"back\\"', 'tab\tquote"back\\'),
    ('"one" "two"', "onetwo"),
    ('"\u00e4\u20ac"', "\u00e4\u20ac"),
]


@pytest.mark.parametrize(("expression", "value"), STRINGS)
def test_a_string_expression(expression: str, value: str) -> None:
    """Strings join, are cut and are made as in C++."""
    assert shown(expression) == value


def test_a_string_is_bytes() -> None:
    """The length of a string counts bytes, as in C++."""
    assert shown('std::string("\u00e4").size()', conversion="%d") == "2"
    assert shown('std::string("\u00e4")[0]', conversion="%d") == str(0xC3 - 256)


FAULTS = [
    ("10 / x", "division by zero"),
    ("10 % x", "division by zero"),
    ("std::vector<int>{1}[1]", "index 1 is past the end of a vector of 1"),
    ("std::vector<int>{1}[-1]", "index -1 is past the end of a vector of 1"),
    ("std::vector<int>{1}.at(5)", "index 5 is past the end of a vector of 1"),
    ('std::string("ab")[7]', "index 7 is past the end of a string of 2 characters"),
    ('std::string("ab").at(2)', "index 2 is past the end of a string of 2 characters"),
    ('std::stoi("x")', "the string does not begin with a number"),
    ('std::stoi("99999999999")', "the number does not fit; it must be from -2147483648 to 2147483647"),
    ('std::stod("")', "the string does not begin with a number"),
    ("ros::Time(-1.0).sec", "the time is out of range: from 0 to 2^32 seconds"),
]


@pytest.mark.parametrize(("expression", "text"), FAULTS)
def test_a_fault(expression: str, text: str) -> None:
    """What C++ leaves undefined, or throws for, is a fault that says what happened."""
    outcome = act(f'ROS_INFO("%d", {expression});')
    assert [fault.text for fault in outcome.faults] == [text]
    assert outcome.result == "dropped"
    assert outcome.log == ()


def test_a_fault_stands_where_the_expression_does() -> None:
    """A fault names file, line and column of the expression, and the values of its variables."""
    outcome = act("\n  int q = 3;\n  x = 1 + q / (x - 7);", data=7)
    [fault] = outcome.faults
    assert (fault.position.file, fault.position.line, fault.position.column) == ("x.rv", 3, 11)
    assert fault.values == {"q": 3, "x": 7}


def test_a_fault_shows_the_elements_of_an_array_of_characters() -> None:
    """Numbers, as of any other array."""
    (fault,) = act("x = 1 / (f[x] - 5);", before="char f[4] = {4, 5};", data=1).faults
    assert fault.text == "division by zero"
    assert fault.values == {"f": [4, 5, 0, 0], "x": 1}


REFUSED = [
    ('x = "a";', 3, 5, "std::string cannot become int; write `std::stod(…)` or `std::stoi(…)`"),
    ("std::string s = 5;", 3, 17, "int cannot become std::string; write `std::to_string(…)`"),
    ('std::string s = "a" + 5;', 3, 23, "int is no string; write `std::to_string(…)`"),
    ("y = 1;", 3, 1, "there is no variable `y`"),
    ("counter = 1; int count;", 3, 1, "there is no variable `counter`"),
    ("foo(1);", 3, 1, "there is no function `foo`"),
    ("sqr(1.0);", 3, 1, "there is no function `sqr`; did you mean `sqrt`?"),
    ("sqrt(1, 2);", 3, 1, "`sqrt` takes 1 argument(s), not 2"),
    ("x = 1.5 % 2;", 3, 5, "`%` has no meaning for double and int; write `fmod(…)`"),
    ("5 = x;", 3, 1, "`=` needs a variable, a field or an element"),
    ("x = ros::Time::now();", 3, 5, "ros::Time cannot become int; write `.toSec()`, `.sec` or `.nsec`"),
    ("geometry_msgs::Point p; x = p.w;", 3, 29, "geometry_msgs/Point has no field `w`; there are: x, y, z"),
    ("geometry_msgs::Pont p;", 3, 1, "there is no message type `geometry_msgs/Pont`; did you mean"),
    ("std::deque<int> m;", 3, 1, "`std::deque<int> m` is not part of the language; use a `std::vector`"),
    ("int v[3]; x = v[3];", 3, 17, "index 3 is past the end of an array of 3 elements"),
    ("if (std::string()) x = 1;", 3, 5, "std::string is no condition; write `.empty()` or compare it"),
    ('ROS_INFO("%f");', 3, 10, "`%f` has no argument; for a percent sign write `%%`"),
    ('ROS_INFO("%s", 5);', 3, 16, "`%s` needs a string; this is int"),
    ('ROS_INFO("a", 5);', 3, 15, "this argument has no conversion in the format, such as `%f` or `%s`"),
    ("std::string s; ROS_INFO(s, 5);", 3, 25, "the format must be a literal"),
    ("int i = i2;", 3, 9, "there is no variable `i2`"),
    ("int x2; int x2;", 3, 13, "`x2` is declared twice in this block"),
    ("const int c = 1; c = 2;", 3, 18, "`c` is const"),
    ("return 5;", 3, 8, "there is nobody to return a value to; write `return;` to drop the message"),
    ("break;", 3, 1, "`break` stands in a loop or a `switch`"),
    ("continue;", 3, 1, "`continue` stands in a loop"),
    ("__RESET;", 3, 1, "`__RESET;` stands in the handlers of a property"),
    ("std::vector<int> v; v.push_front(1);", 3, 21, "std::vector<int> has no function `push_front`; write `.insert(v.begin(), x)`"),
    ("std::vector<int> v; x = v;", 3, 25, "std::vector<int> cannot become int; write an index, `[0]`"),
    ("std::vector<int> v; std::vector<double> w = v;", 3, 45, "std::vector<int> cannot become std::vector<double>"),
    ("int *p;", 3, 1, "there are no pointers but `char *`; write `int`"),
    ("x = rand();", 3, 5, "there is no function `rand`; verdicts are functions of what was received"),
    ('system("rm -rf /");', 3, 1, "there is no function `system`; there are no programs to start"),
    ("x = 99999999999999999999;", 3, 5, "`99999999999999999999` is larger than any integer type holds"),
    ("x = 18446744073709551616;", 3, 5, "`18446744073709551616` is larger than any integer type holds"),
    ("x = -9223372036854775809;", 3, 5, "`-9223372036854775809` is less than any integer type holds"),
    ("char *p; p = p + 1;", 3, 14, "there is no arithmetic of pointers: write `std::string(…).substr(1)`"),
    ("char p[9]; p++;", 3, 12, "there is no arithmetic of pointers"),
    ("x = 08;", 3, 5, "`08` is no number; one that begins with 0 is octal"),
    ("switch (x) { case x: break; }", 3, 19, "a case needs a constant: a number or a character"),
    ("switch (x) { case 1: case 1: break; }", 3, 27, "case 1 occurs twice"),
    ("switch (1.5) { }", 3, 9, "`switch` needs an integer; this is double"),
    ("MESSAGE = 1;", 3, 1, "`MESSAGE` cannot be assigned; bind the fields you want to change"),
    ("PUBLISH(/a, std_msgs/Int32, x);", 3, 29, "this is int, but std_msgs::Int32 is to be published"),
    ("std_msgs::Int32 m; PUBLISH(a, std_msgs/Int32, m);", 3, 20, "`a` is no global name; write `/a`"),
    ("goto end;", 3, 1, "`goto` is not part of the language; there are no jumps"),
    ("delete x;", 3, 1, "`delete` is for `char` buffers; int needs none"),
    ("auto y;", 3, 6, "`auto` needs a value: `auto x = …;`"),
    ("static int n;", 3, 1, "there are no static variables in functions; declare it before the events"),
]  # fmt: skip


@pytest.mark.parametrize(("body", "line", "column", "text"), REFUSED)
def test_a_refusal(body: str, line: int, column: int, text: str) -> None:
    """What is outside the language is an error with its exact place, what was found, and what to write."""
    finding = refused_action(body)[0]
    assert (finding.position.line, finding.position.column) == (line, column)
    assert text in finding.text


def test_one_check_finds_all_errors_of_an_action() -> None:
    """A wrong statement does not hide the next one."""
    findings = refused_action("y = 1;\nz = 2;\nif (x) { q = 3; }\nx = 5;")
    assert [finding.position.line for finding in findings] == [3, 4, 5]


LIBRARY = [
    ("%.9g", "fabsf(-1.5)", "1.5"),
    ("%.9g", "sqrtf(2)", "1.41421354"),
    ("%.9g", "std::sqrt(2.0f)", "1.41421354"),
    ("%.9g", "powf(0.1, 2)", "0.0100000007"),
    ("%d", "fabsf(0.1) == 0.1f", "1"),
    ("%ld", "lround(2.5)", "3"),
    ("%ld", "lround(-2.5)", "-3"),
    ("%ld", "std::llround(1e300)", "9223372036854775807"),
    ("%ld", "lrint(2.5)", "2"),
    ("%.6g", "asinh(1) + acosh(2) + atanh(0.5)", "2.74764"),
    ("%.17g", "fma(0.1, 10, -1)", "5.5511151231257827e-17"),
    ("%d", "signbit(-0.0) + signbit(1.0) + std::signbit(-3)", "2"),
    ("%lu", "ULONG_MAX", "18446744073709551615"),
    ("%ld", "INT64_MAX", "9223372036854775807"),
    ("%d", "UINT8_MAX + INT8_MIN + SHRT_MAX + CHAR_MAX", "33021"),
    ("%.6g", "M_LN2 + M_LN10 + M_LOG2E + M_2_PI", "5.07505"),
    ("%g", "FLT_MIN", "1.17549e-38"),
    ("%lu", 'std::stoul("-1")', "18446744073709551615"),
    ("%lu", 'std::stoul("18446744073709551615")', "18446744073709551615"),
    ("%s", 'std::stoul("-18446744073709551616")', "fault"),
    ("%s", 'std::stoi("-2147483649")', "fault"),
    ("%f", 'std::stod("1e400")', "fault: the number does not fit"),
    ("%f", 'std::stod("-1e400")', "fault: the number does not fit"),
    ("%f", 'std::stod("1e-400")', "fault: the number does not fit"),
    ("%f", 'std::stof("1e39")', "fault: the number does not fit"),
    ("%f", 'std::stod("inf")', "inf"),
    ("%g", 'std::stof("1e38")', "1e+38"),
    ("%g", 'std::stod("0e-400")', "0"),
    ("%.9g", "(float) 9007199791611905L", "9.00720033e+15"),
    ("%.9g", "(float) (x + 9007199791611905L)", "9.00720033e+15"),
    ("%.9g", "(float) (x - 9007199791611905L)", "-9.00720033e+15"),
    ("%.9g", "(float) (x + 18446744073709551615ul)", "1.84467441e+19"),
]


@pytest.mark.parametrize(("conversion", "expression", "value"), LIBRARY)
def test_the_library(conversion: str, expression: str, value: str) -> None:
    """Functions and constants of <math.h>, <climits>, <cstdint>, <cfloat> and <string> are C++'s; what throws faults."""
    conversion = "%d" if value == "fault" else conversion
    assert shown(expression, conversion=conversion).startswith(value)
