"""Statements do what C++ statements do."""

import pytest

from rosmop.tests.acting import act, load, message, refused, refused_action


def printed(body: str, *, before: str = "", data: int = 0) -> str:
    """The lines an action prints, with spaces between them; a fault's text if there is one."""
    outcome = act(body, before=before, data=data)
    if outcome.faults:
        return f"fault: {outcome.faults[0].text}"
    return " ".join(line.text for line in outcome.log)


LOOPS = [
    ('for (int i = 0; i < 3; i++) ROS_INFO("%d", i);', "0 1 2"),
    ('for (int i = 0, j = 9; i < j; ++i, j -= 4) ROS_INFO("%d-%d", i, j);', "0-9 1-5"),
    ('for (int i = 0; ; i++) { if (i == 2) break; ROS_INFO("%d", i); }', "0 1"),
    ('for (int i = 0; i < 5; i++) { if (i % 2) continue; ROS_INFO("%d", i); }', "0 2 4"),
    ('int i = 3; while (i--) ROS_INFO("%d", i);', "2 1 0"),
    ('int i = 0; do { ROS_INFO("%d", i); } while (++i < 2);', "0 1"),
    ('int i = 0; do { i++; if (i == 2) continue; ROS_INFO("%d", i); } while (i < 3);', "1 3"),
    ('for (int i = 0; i < 3; i++) { if (i == 1) { int i = 40; continue; } ROS_INFO("%d", i); }', "0 2"),
    ('int i = 0; do { int j = i; { int i = 9; if (j == 1) continue; } ROS_INFO("%d", j); } while (++i < 3);', "0 2"),
    ('for (int i = 0; i < 3; i++) { switch (i) { case 1: { int i = 40; continue; } } ROS_INFO("%d", i); }', "0 2"),
    ('int i = 5; do ROS_INFO("%d", i); while (i < 2);', "5"),
    ('std::vector<int> v{1, 2, 3}; for (int e : v) ROS_INFO("%d", e);', "1 2 3"),
    ('std::vector<int> v{1, 2}; for (auto& e : v) e *= 10; ROS_INFO("%d %d", v[0], v[1]);', "10 20"),
    ('std::vector<int> v{1, 2}; for (auto e : v) e *= 10; ROS_INFO("%d %d", v[0], v[1]);', "1 2"),
    ('std::vector<int> v{1, 2}; for (const auto& e : v) ROS_INFO("%d", e);', "1 2"),
    ('std::vector<std::string> v{"a", "b"}; for (std::string& s : v) s += "!"; ROS_INFO("%s", v[1].c_str());', "b!"),
    ('std::string s = "ab"; for (char c : s) ROS_INFO("%c", c);', "a b"),
    ('for (int i = 0; i < 2; i++) for (int j = 0; j < 2; j++) { if (j) break; ROS_INFO("%d%d", i, j); }', "00 10"),
    ('for (int i = 0; i < 2; i++) { int n; n++; ROS_INFO("%d", n); }', "1 1"),
]  # fmt: skip


@pytest.mark.parametrize(("body", "lines"), LOOPS)
def test_a_loop(body: str, lines: str) -> None:
    """Loops run, break and continue as in C++."""
    assert printed(body) == lines


SWITCH = (
    'switch (x) { case 1: ROS_INFO("one"); case 2: ROS_INFO("two"); break; '
    'default: ROS_INFO("other"); case 5: ROS_INFO("five"); }'
)


@pytest.mark.parametrize(("data", "lines"), [(1, "one two"), (2, "two"), (5, "five"), (7, "other five")])
def test_a_switch_falls_through_until_a_break(data: int, lines: str) -> None:
    """`switch` begins at the case and goes on until `break`; `default` may stand anywhere."""
    assert printed(SWITCH, data=data) == lines


CONSTANT_CASES = [
    ("const int N = 2 * 3; switch (x) { case N + 1: %s }", 7),
    ("switch (x) { case (1 << 2): %s }", 4),
    ("switch (x) { case true ? 5 : 6: %s }", 5),
    ("switch (x) { case (char) 300: %s }", 44),
    ("switch (x) { case int(2.5) * 2 == 4: %s }", 1),
    ("switch (x) { case ~1: %s }", -2),
    ("const bool B = 3 > 2 && !false; switch (x) { case B: %s }", 1),
    ("unsigned u = 4294967295; switch (u) { case -1: %s }", 0),
    ("switch (x) { case 4294967295u: %s }", -1),
    ("switch (x) { case std_msgs::Empty_::X: %s }", None),
    ("switch (x) { case 1 / 0: %s }", None),
]


@pytest.mark.parametrize(("body", "data"), CONSTANT_CASES)
def test_a_case_is_a_constant_expression_of_the_type_of_the_switch(body: str, data: int | None) -> None:
    """What can be computed when the file is loaded is a constant, and is converted as C++ converts it."""
    if data is None:
        assert refused_action(body % ";")
    else:
        assert printed(body % 'ROS_INFO("yes"); break; default: ROS_INFO("no");', data=data) == "yes"


def test_a_case_that_its_type_cannot_hold_is_refused() -> None:
    """It would never match."""
    found = refused_action("switch (x) { case 4294967296: ; }")
    assert found[0].text == "case 4294967296 can never be: int holds -2147483648 to 2147483647"
    assert refused_action("switch (x) { case -1: ; case 4294967295u: ; }")[0].text == "case -1 occurs twice"


SIZES = [
    ("const int N = 2*3; int q[N];", 6),
    ("const int N(4); int q[N - 1];", 3),
    ("int q[(1 << 3) | 1];", 9),
    ("const double D = 2.5; int q[(int) (D * 2)];", 5),
    ("int q[10 / 3 % 2 + 1];", 2),
    ("const unsigned U = -1; int q[U == 4294967295 ? 2 : 1];", 2),
]


@pytest.mark.parametrize(("declaration", "size"), SIZES)
def test_the_size_of_an_array_is_a_constant_expression(declaration: str, size: int) -> None:
    """For local and for shared arrays."""
    assert printed(f'{declaration} ROS_INFO("%d", (int) q.size());') == str(size)
    assert printed('ROS_INFO("%d", (int) q.size());', before=declaration) == str(size)


def test_a_switch_without_a_fitting_case_does_nothing() -> None:
    """Without `default` nothing runs."""
    assert printed('switch (x) { case 1: ROS_INFO("one"); }', data=3) == ""


def test_a_drop_in_a_state_that_a_timeout_enters_has_nothing_to_drop_then() -> None:
    """With a message it drops the message; at the timeout there is none, and the handler goes on."""
    text = (
        "s() { event e() /t std_msgs/Int32 '{}' { } "
        'tfsm: s0 [ e -> s1 ] s1 [ e -> late, timeout 1s -> late ] late [ e -> s1 ] @late { DROP; ROS_INFO("late"); } }'
    )
    monitors = load(text)
    results = [monitors.process("/t", message("std_msgs/Int32"), at).result for at in (1, 2)]
    assert results == ["passed", "dropped"]
    monitors = load(text)
    monitors.process("/t", message("std_msgs/Int32"), 1)
    (outcome,) = monitors.advance(2 * 10**9)
    assert not outcome.faults, outcome.faults
    assert [line.text for line in outcome.log] == ["late"]


def test_continue_in_a_switch_is_that_of_the_loop() -> None:
    """`continue` inside a `switch` goes on with the loop around it, step included."""
    body = """for (int i = 0; i < 4; i++) {
        switch (i) { case 1: continue; case 2: break; default: ROS_INFO("d%d", i); }
        ROS_INFO("e%d", i);
    }"""
    assert printed(body) == "d0 e0 e2 d3 e3"


def test_a_character_can_be_a_case() -> None:
    """Cases may be characters, and constants of message types."""
    assert printed("switch ('b') { case 'a': ROS_INFO(\"a\"); break; case 'b': ROS_INFO(\"b\"); }") == "b"


IFS = [
    ('if (x == 0) ROS_INFO("a"); else ROS_INFO("b");', "a"),
    ('if (x) ROS_INFO("a"); else if (!x) ROS_INFO("b"); else ROS_INFO("c");', "b"),
    ('if (1) if (0) ROS_INFO("a"); else ROS_INFO("b");', "b"),
    ('if (x == 0) { int x = 5; ROS_INFO("%d", x); } ROS_INFO("%d", x);', "5 0"),
    ('{ int y = 1; { int y = 2; ROS_INFO("%d", y); } ROS_INFO("%d", y); }', "2 1"),
    ('if (double d = 0.5) ROS_INFO("a");', None),
]  # fmt: skip


@pytest.mark.parametrize(("body", "lines"), IFS)
def test_an_if(body: str, lines: str | None) -> None:
    """Branches and the scopes of blocks."""
    if lines is None:
        assert refused_action(body)
    else:
        assert printed(body) == lines


ASSIGNMENTS = [
    ("int a = 7; a += 3; a -= 1; a *= 2; a /= 4; a %= 3;", "a", "1"),
    ("int a = 6; a &= 3; a |= 8; a ^= 1; a <<= 2; a >>= 1;", "a", "22"),
    ("int a, b; a = b = 4; a += b;", "a", "8"),
    ("int a = 2.9;", "a", "2"),
    ("int a = 1; a += 1.7;", "a", "2"),
    ("int8_t a = 127; a++;", "a", "-128"),
    ("unsigned char a = 0; a--;", "a", "255"),
    ("uint16_t a = 65535; a += 2;", "a", "1"),
    ("unsigned int a = -1; a /= 2;", "a", "2147483647"),
    ("bool a = 5;", "a", "1"),
    ("int a[3] = {1, 2}; a[2] = a[1] + 5;", "a[2]", "7"),
    ("int a[] = {4, 5};", "a[1]", "5"),
    ("std::vector<std::vector<int>> a(2, std::vector<int>(2, 1)); a[0][1] = 9;", "a[0][1] + a[1][1]", "10"),
    ("std::vector<int> a; a.push_back(4); a.push_back(5); a.pop_back();", "a.size()", "1"),
    ("std::vector<int> a(3); a.resize(5); a.resize(1);", "a.size()", "1"),
    ("std::vector<int> a{1, 2}; std::vector<int> b = a; b[0] = 7;", "a[0]", "1"),
    ("std::vector<int> a{1, 2}; a = {3};", "a[0] + a.size()", "4"),
    ("auto a = 3; a += 4;", "a", "7"),
    ("int a(5);", "a", "5"),
    ("int a{6};", "a", "6"),
    ("geometry_msgs::Twist a; a.linear.x = 3; geometry_msgs::Twist b = a; b.linear.x = 4;", "(int) a.linear.x", "3"),
    ("std_msgs/Header a; a.stamp = ros::Time(5, 6); a.stamp.sec = 7;", "a.stamp.sec * 10 + a.stamp.nsec", "76"),
    ("std_msgs::Header a; a.stamp.nsec += 4; a.stamp.sec++;", "a.stamp.sec * 10 + a.stamp.nsec", "14"),
    ("ros::Duration a(2.5); a.nsec = 0;", "(int) (a.toSec() * 10)", "20"),
    ("std::vector<std::string> a(2); a[1] += \"xy\"; a[1][0] = 'z';", "a[1][0]", "122"),
    ("std::string a = \"abc\"; a[1] = 'x';", "a[1]", "120"),
    ("std::string a = \"abc\"; a[1]++;", "a[1]", "99"),
    ("long a = 1; a = a << 40; a++;", "(int) (a >> 40)", "1"),
    ("double a = 1; a++; a /= 4;", "(int) (a * 100)", "50"),
    ("float a = 0.1; a *= 3;", "(int) (a * 1000)", "300"),
    ("int a = 3; int b = a++ * 2 + --a;", "b", "9"),
]  # fmt: skip


@pytest.mark.parametrize(("body", "expression", "value"), ASSIGNMENTS)
def test_an_assignment(body: str, expression: str, value: str) -> None:
    """Variables, elements, fields and parts of times are assigned with C++'s conversions."""
    assert printed(f'{body} ROS_INFO("%d", {expression});') == value


STRINGS = [
    ('s += "d"; s.append("e"); s.push_back(\'f\');', "abcdef"),
    ("s.clear();", ""),
    ("s.erase(1, 1);", "ac"),
    ('s.insert(1, "XY");', "aXYbc"),
    ('s.replace(0, 2, "q");', "qc"),
    ("s.pop_back();", "ab"),
    ("s.resize(2);", "ab"),
    ('s = s + "-" + s;', "abc-abc"),
    ('s.assign("zz");', "zz"),
]


@pytest.mark.parametrize(("body", "value"), STRINGS)
def test_a_string_is_changed(body: str, value: str) -> None:
    """Member functions change a string in its variable."""
    assert printed(f'std::string s = "abc"; {body} ROS_INFO("%s", s.c_str());') == value


def test_character_buffers_as_in_the_samples_of_rosrv() -> None:
    """`new char[]`, `strcpy`, `%s` and `delete[]` work, and a buffer that is too small is a fault."""
    body = 'std::string m = "hello"; char * c = new char[m.length() + 1]; std::strcpy(c, m.c_str()); '
    assert printed(body + 'ROS_INFO("%s", c); delete[] c;') == "hello"
    assert printed('char c[3]; strcpy(c, "hello");') == "fault: strcpy of 6 characters into a buffer of 3"
    assert printed('char c[10]; sprintf(c, "%d-%s", 5, "x"); strcat(c, "!"); ROS_INFO("%s %d", c, (int) strlen(c));') \
        == "5-x! 4"  # fmt: skip


FUNCTIONS = [
    ("int twice(int a) { return a * 2; }", "twice(4)", "8"),
    ("int twice(int a) { return a * 2; } int four(int a) { return twice(twice(a)); }", "four(1)", "4"),
    ("double half(int a) { return a / 2.0; }", "(int) (half(3) * 10)", "15"),
    ("int later(int a) { return other(a); } int other(int a) { return a + 1; }", "later(1)", "2"),
    ("int fact(int a) { return a < 2 ? 1 : a * fact(a - 1); }", "fact(5)", "120"),
    ("bool even(int a) { if (a == 0) return true; return odd(a - 1); } "
     "bool odd(int a) { if (a == 0) return false; return even(a - 1); }", "even(10)", "1"),
    ("int first(const std::vector<int>& v) { return v[0]; }", "first(std::vector<int>{7})", "7"),
    ("int keep(int a) { a = 9; return a; }", "keep(1) + x", "9"),
]  # fmt: skip


@pytest.mark.parametrize(("before", "expression", "value"), FUNCTIONS)
def test_a_helper_function(before: str, expression: str, value: str) -> None:
    """Helper functions take values, call each other in any order, and return converted values."""
    assert printed(f'ROS_INFO("%d", {expression});', before=before) == value


def test_reference_parameters_are_handed_back() -> None:
    """A function changes what it takes by reference, and returns a value besides."""
    before = """bool split(int a, int& high, int& low, std::vector<int>& all) {
        high = a / 10; low = a % 10; all.push_back(a); return a > 0; }"""
    body = """int h, l; std::vector<int> v; bool ok = split(42, h, l, v);
        ROS_INFO("%d %d %d %d", ok, h, l, v[0]);"""
    assert printed(body, before=before) == "1 4 2 42"


SWAP = "void swap(int& a, int& b) { int c = a; a = b; b = c; } "
ALIASES = [
    (SWAP, "int a = 1; swap(a, a);", "`a` is handed to two references of `swap`"),
    (SWAP, "std::vector<int> v(2); swap(v[0], v[0]);", "`v` is handed to two references"),
    (
        "void f(std::vector<int>& v, int& a) { }",
        "std::vector<int> v(2); f(v, v[1]);",
        "`v` is handed to two references",
    ),
    ("int n; void f(int& a) { a = 1; n = 2; }", "f(n);", "`f` names `n` itself"),
    ("int n; int g() { return n; } void f(int& a) { a = g(); }", "f(n);", "`f` names `n` itself"),
    ("std::vector<int> v; void f(int& a) { v.clear(); }", "f(v[0]);", "`f` names `v` itself"),
    ('void f(char * c) { strcpy(c, "x"); }', "", "`c` is a copy"),
    ("void f(char * c) { c[0] = 'x'; }", "", "`c` is a copy"),
    ("void f(char * c) { c[0]++; }", "", "`c` is a copy"),
    ("", 'char c[5]; char * d = c; sprintf(d, "x");', "`d` is a copy"),
    ("", "char c[5]; char * d; d = c; d[1] = 'x';", "`d` is a copy"),
    ("void f(int a[]) { a[0] = 1; }", "", "`a` is a copy"),
    ("void f(int[] a) { a[0]++; }", "", "`a` is a copy"),
    ("void f(int a[]) { for (int& e : a) e = 1; }", "", "`a` is a copy"),
    ("char c[5]; char * d; init() { d = c; }", 'strcat(d, "x");', "`d` is a copy"),
]


@pytest.mark.parametrize(("before", "body", "text"), ALIASES)
def test_what_would_be_one_in_cpp_and_two_here_is_refused(before: str, body: str, text: str) -> None:
    """References are copied in and out, and buffers are values: where that shows, the file is refused."""
    assert text in refused_action(body, before=before)[0].text


NO_ALIASES = [
    (SWAP, 'std::vector<int> v{1, 2}; swap(v[0], v[1]); ROS_INFO("%d", v[0]);', "2"),
    (SWAP, 'int a = 1, b = 2; swap(a, b); ROS_INFO("%d", a);', "2"),
    ("int n; void f(int& a) { int n = 3; a = n; }", 'f(n); ROS_INFO("%d", n);', "3"),
    ("int n; void f(int& n) { n = 4; }", 'f(n); ROS_INFO("%d", n);', "4"),
    ("int n; void f(int a) { n = a + 1; }", 'f(n); ROS_INFO("%d", n);', "1"),
    ('void f(char *& c) { strcpy(c, "x"); }', 'char * c = new char[3]; f(c); ROS_INFO("%s", c);', "x"),
    ("int f(int a[]) { return a[0]; }", 'int q[2]; q[0] = 3; ROS_INFO("%d", f(q));', "3"),
    (
        "int f(std::vector<int> a) { a[0]++; return a[0]; }",
        'std::vector<int> q{3}; ROS_INFO("%d", f(q));',
        "4",
    ),
    ("int f(char * c) { c = new char[3]; return strlen(c); }", 'char c[2]; ROS_INFO("%d", f(c));', "0"),
    ("", "char c[5]; char * d = new char[5]; d[0] = 'y'; strcpy(c, d); ROS_INFO(\"%s\", c);", "y"),
]


@pytest.mark.parametrize(("before", "body", "lines"), NO_ALIASES)
def test_references_and_buffers_that_are_different_are_fine(before: str, body: str, lines: str) -> None:
    """Copies that nobody can tell from the original are none."""
    assert printed(body, before=before) == lines


def test_a_procedure_needs_no_type() -> None:
    """A function without a result type returns nothing, as in the samples of ROSRV."""
    assert printed('go(); go(); ROS_INFO("%d", n);', before="int n; go() { n++; }") == "2"


OUTPUT = [
    ('ROS_INFO("100%% of %s", "it");', "100% of it"),
    ('ROS_INFO("%5.2f|%-5d|%05d|%+d", 3.14159, 42, 42, 42);', " 3.14|42   |00042|+42"),
    ('ROS_INFO("%*d|%*d|%-*d|%0*d", 5, 42, -5, 42, 5, 42, 5, 42);', "   42|42   |42   |00042"),
    ('ROS_INFO("%.*f|%*.*f|%.*f|%*s", 2, 1.2345, 8, 3, 1.23456, -1, 1.5, 5, "ab");', "1.23|   1.235|1.500000|   ab"),
    ('ROS_INFO("%x %X %o %u", 255, 255, 8, -1);', "ff FF 10 4294967295"),
    ('ROS_INFO("%d %f", 2.9, 3);', "2 3.000000"),
    ('ROS_INFO("%ld %llu %zu %hd", 1L, 2ul, 3ul, 4);', "1 2 3 4"),
    ("ROS_INFO(\"%c%c\", 'h', 105);", "hi"),
    ('ROS_INFO("%#o|%#o|%#x|%#x|%#8o|%-8o|", 8, 0, 0, 255, 8, 8);', "010|0|0|0xff|     010|10      |"),
    ('ROS_INFO("%#.5o|%#06o|%#X|%#hhx|%#-5x|", 8, 8, 255, 511, 1);', "00010|000010|0XFF|0xff|0x1  |"),
    ('ROS_INFO("%08.3d|%.3d|%+u|%+d|% d", 7, 5, 5u, 5, 5);', "     007|005|5|+5| 5"),
    ('ROS_INFO("%hhd %hd %hhu %hho", 300, 70000, -1, -1);', "44 4464 255 377"),
    ('ROS_INFO("%a %a %A %20a|%-12a|%+a %a", 1.0, 0.1, -0.5, 3.0, 1.5, 2.0, 0.0);',
     "0x1p+0 0x1.999999999999ap-4 -0X1P-1             0x1.8p+1|0x1.8p+0    |+0x1p+1 0x0p+0"),
    ('ROS_INFO("%a %a", INFINITY, NAN);', "inf nan"),
    ('std::string s = "a"; ROS_INFO("%ld %d", s.find("q"), 4294967295u);', "-1 -1"),
    ('ROS_INFO("%ld %lu %u", 4294967295u, 4294967295u, -1);', "4294967295 4294967295 4294967295"),
    ('puts("100% %d"); std::string s = "%s"; puts(s.c_str());', "100% %d %s"),
    ('char b[20]; int n = sprintf(b, "%d", 12345); ROS_INFO("%d %s", n, b);', "5 12345"),
    ('char b[20]; ROS_INFO("%d %s", snprintf(b, 4, "%d", 12345), b); ROS_INFO("%d %s", snprintf(b, 0, "%d", 678), b);',
     "5 123 3 123"),
    ('ROS_INFO_STREAM("a" << 1 << \' \' << 2.5 << " " << true);', "a1 2.5 1"),
    ('ROS_INFO_STREAM(1 + 2);', "3"),
    ('std::cout << "x = " << 0.1 + 0.2 << std::endl;', "x = 0.3"),
    ('std::cout << std::fixed << std::setprecision(2) << 3.14159 << "\\n";', "3.14"),
    ('std::cerr << "e";', "e"),
    ('printf("%s\\n", "p");', "p"),
    ('std::string s = "%d"; ROS_INFO(s.c_str());', "%d"),
    ('std::cout << ros::Time(1, 5);', "1.000000005"),
    ('ROS_INFO_COND(x == 0, "yes"); ROS_INFO_COND(x != 0, "no");', "yes"),
    ('for (int i = 0; i < 3; i++) ROS_INFO_ONCE("once");', "once"),
    ('for (int i = 0; i < 3; i++) ROS_INFO_THROTTLE(1.0, "often");', "often"),
    ('ROS_INFO_NAMED("name", "text %d", 1);', "text 1"),
]  # fmt: skip


@pytest.mark.parametrize(("body", "text"), OUTPUT)
def test_output(body: str, text: str) -> None:
    """Formats and streams print what C++ prints."""
    assert printed(body) == text


@pytest.mark.parametrize("level", ["DEBUG", "INFO", "WARN", "ERROR", "FATAL"])
def test_the_level_of_output(level: str) -> None:
    """Every macro of rosconsole logs at its own level, under the name of the monitor."""
    [line] = act(f'ROS_{level}("text");').log
    assert (line.level, line.text, line.monitor) == (level, "text", "s")


def test_assigning_a_converted_parameter_twice_keeps_the_last() -> None:
    """What an action assigns last is what is relayed."""
    outcome = act("x = 5; x = x + 1;", data=1)
    assert outcome.result == "changed"
    assert bytes(outcome.buffer) == b"\x06\0\0\0"


CURSORS = [
    ("v.erase(v.begin());", "2 3 1"),
    ("v.erase(v.begin() + 1, v.end());", "3"),
    ("v.erase(v.end() - 1);", "3 2 3"),
    ("v.insert(v.begin() + 1, 9);", "3 9 2 3 1"),
    ("v.insert(v.end(), 9);", "3 2 3 1 9"),
    ("std::sort(v.begin(), v.end());", "1 2 3 3"),
    ("std::sort(v.begin(), v.begin() + 2);", "2 3 3 1"),
    ("std::reverse(v.begin(), v.end());", "1 3 2 3"),
    ("v.resize(v.end() - v.begin() - 2);", "3 2"),
    ("v = {(int) std::accumulate(v.begin(), v.end(), 0.5)};", "9"),
    ("v = {std::accumulate(v.begin(), v.end(), 0)};", "9"),
    ("v.erase(v.end());", "fault: from 4 to 5 is not within a vector of 4"),
    ("v.erase(v.begin() - 1);", "fault: from -1 to 0 is not within a vector of 4"),
]


@pytest.mark.parametrize(("body", "values"), CURSORS)
def test_a_place_in_a_vector(body: str, values: str) -> None:
    """`begin` and `end` say where to erase, insert, sort, reverse and add up."""
    assert printed(f'std::vector<int> v{{3, 2, 3, 1}}; {body} for (int e : v) ROS_INFO("%d", e);') == values


def test_an_iterator_is_no_value() -> None:
    """It cannot be kept, printed, or used with another vector."""
    declared = "std::vector<int> v, w; "
    assert "a variable cannot hold an iterator" in refused_action(declared + "auto i = v.begin();")[0].text
    assert "of the same vector" in refused_action(declared + "v.erase(w.begin());")[0].text
    assert "of the same vector" in refused_action(declared + "v.erase(0);")[0].text
    assert "an array of fixed length stays so long" in refused_action("int a[3]; a.erase(a.begin());")[0].text
    assert refused_action(declared + "std::cout << v.begin();")


def test_a_constant_number_may_be_a_case_or_a_size() -> None:
    """`const` numbers with a written value are known when the specification is loaded, shared ones, too."""
    before = "const int ONE = 1; const unsigned char TWO = 258; const int SIZE = 3;"
    body = """const int THREE = 3; int a[SIZE]; a[THREE - 1] = 9;
        switch (x) { case ONE: ROS_INFO("one"); break; case TWO: ROS_INFO("two"); break; case -THREE: ROS_INFO("-3"); }
        ROS_INFO("%d", (int) a[2]);"""
    assert printed(body, before=before, data=1) == "one 9"
    assert printed(body, before=before, data=2) == "two 9"
    assert printed(body, before=before, data=-3) == "-3 9"
    assert (
        "past the end of an array of 3" in refused_action("int a[SIZE]; x = a[SIZE];", before=before)[0].text
    )


def test_a_character_can_be_assigned_to_a_string() -> None:
    """As in C++: assigned, but not initialised; a number is refused."""
    assert printed('std::string s = "abc"; s = \'x\'; ROS_INFO("%s", s);') == "x"
    assert "write `std::to_string" in refused_action("std::string s; s = 65;")[0].text


ONE_MISTAKE = [
    ("foo n = 3; n++; x = n + 1; if (n) x = n;", "", "there is no type `foo`"),
    ("int n = y, m = n; m++; n++;", "", "there is no variable `y`"),
    ("foo a, b; a = b;", "", "there is no type `foo`"),
    ("for (foo i = 0; i < 3; i++) x = i;", "", "there is no type `foo`"),
    ("n++; x = n;", "foo n;", "there is no type `foo`"),
    ("x = f(1) + f(2);", "foo f(int a) { return a; }", "there is no type `foo`"),
    ("static int n = 3; n++;", "", "there are no static variables in functions"),
    ("{ foo n; } int k = 1; k++;", "", "there is no type `foo`"),
    ("int i = 0; do { int j = i; continue; } while (j < 3); x = 1;", "", "there is no variable `j`"),
    ("while (y) { } " * 20 + "while (x) { }", "", "there is no variable `y`"),
]


@pytest.mark.parametrize(("body", "before", "text"), ONE_MISTAKE)
def test_one_mistake_is_told_once(body: str, before: str, text: str) -> None:
    """What has a wrong declaration is declared: its uses are no further mistakes."""
    found = refused_action(body, before=before)
    assert len({finding.text for finding in found}) == 1
    assert text in found[0].text


def test_a_wrong_binding_is_told_once() -> None:
    """Also where the parameter is used, and in what another specification knows of a wrong variable."""
    text = "s() { event e(int x) /t std_msgs/Int32 '{dat:x}' when (x > 1) { x = 3; int y = x; } }"
    assert [finding.text[:40] for finding in refused(text)] == ["std_msgs/Int32 has no field `dat`; did y"]
    text = "a() { event e() /t std_msgs/Int32 '{}' { n++; } } b() { foo n; event e() /u std_msgs/Int32 '{}' { } }"
    assert len(refused(text)) == 1


def test_a_variable_of_a_switch_is_zero_where_its_declaration_is_jumped_over() -> None:
    """In C++ it has no value there; here it has one."""
    body = 'switch (x) { case 0: int y; y = 5; case 1: y++; ROS_INFO("%d", y); }'
    assert [printed(body, data=data) for data in (0, 1)] == ["6", "1"]


def test_a_text_that_its_array_cannot_hold_is_refused() -> None:
    """With its zero, as in C++."""
    text = "a text of 3 characters and its zero need `c[4]`"
    assert refused_action('char c[3] = "abc";')[0].text == text
    assert refused_action("", before='char c[3] = "abc";')[0].text == text
    assert printed('char c[4] = "abc"; ROS_INFO("%s", c);') == "abc"


def test_what_stands_behind_a_refused_loop_is_looked_at_as_such() -> None:
    """Two mistakes are two."""
    found = refused_action("while (y) { } break;")
    assert [finding.text for finding in found] == [
        "there is no variable `y`; there are: x", "`break` stands in a loop or a `switch`"
    ]  # fmt: skip
