"""Advise authors who use constructs of C++, roscpp, other MOPs or Python that the language lacks."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

_POINTERS = "there are no pointers; declare the value itself, `std_msgs::Int32 x;`, which `x = y;` copies"
_LOOKUP = (
    "use two vectors, one of the keys and one of the values, or a specification with a parameter, `name(std::string id)"
    " { … }`, which has its own variables for each value"
)
_VECTOR = "use a `std::vector`"
_NO_THREADS = "messages come one at a time; leave it out"
_NO_FILES = "there are no files; `ROS_INFO(…)` writes to the audit log"
_NO_WAITING = "an action must not wait; use an event `every …`"
_NO_NODE = "a monitor is not a node; leave it out"
_TIMER = "write `event name() every 100ms { … }`"
_ROS_INFO = "write `ROS_INFO(…)`"

_TEMPLATES = {
    "map unordered_map multimap unordered_multimap": _LOOKUP,
    "set unordered_set multiset list forward_list deque queue stack priority_queue array": _VECTOR,
    "valarray circular_buffer bitset": _VECTOR,
    "pair tuple complex": "use a variable for each member",
    "optional variant any": "use a `bool` and a variable",
    "shared_ptr weak_ptr unique_ptr scoped_ptr auto_ptr intrusive_ptr": _POINTERS,
    "function": "declare a helper function",
    "basic_string": "write `std::string`",
}  # fmt: skip
_NAMES = _TEMPLATES | {
    "make_shared make_unique malloc calloc realloc": _POINTERS,
    "free": "there are no pointers; leave it out",
    "bind mem_fn _1 _2": "declare a helper function, and call it",
    "make_pair make_tuple get tie": "use a variable for each member",
    "move forward ref cref": "values are copied; write the value itself",
    "swap": "swap with a third variable",
    "find count find_if any_of all_of none_of for_each transform": "write a loop, `for (auto x : v) { … }`",
    "memcpy memmove memset copy fill": "assign the value itself, or write a loop",
    "string_view": "write `std::string`",
    "stringstream ostringstream istringstream stringbuf ostream istream": (
        "build a `std::string` with `+` and `std::to_string(…)`, or with `snprintf`"
    ),
    "regex smatch regex_match": "use `.find(…)` and `.substr(…)`",
    "ofstream ifstream fstream fopen fclose fprintf fputs FILE open": _NO_FILES,
    "cin scanf getline getchar gets": "there is no input but messages",
    "mutex recursive_mutex lock_guard unique_lock scoped_lock atomic condition_variable thread async future"
    " pthread_t pthread_mutex_t boost::mutex::scoped_lock": _NO_THREADS,
    "system popen fork execv": "programs cannot be started",
    "exit abort quit _exit ros::shutdown": "an action cannot end the program; write `return;`",
    "assert static_assert ROS_ASSERT ROS_ASSERT_MSG ROS_BREAK": (
        "write `if (!(condition)) { ROS_ERROR(…); return; }`"
    ),
    "getenv": "there is no environment; write the value into the specification, `const double NAME = …;`",
    "rand srand random mt19937 rand_r": (
        "verdicts depend only on the received messages; they are never random"
    ),
    "time clock gettimeofday clock_gettime now WallTime SteadyTime system_clock steady_clock get_time rospy::Time": (
        "write `ros::Time::now()`"
    ),
    "WallDuration SteadyDuration seconds milliseconds microseconds nanoseconds": "write `ros::Duration(0.1)`",
    "sleep usleep nanosleep sleep_for sleep_until": _NO_WAITING,
    "Rate WallRate Timer WallTimer SteadyTimer": _TIMER,
    "Publisher": "publish with `PUBLISH(/topic, package/Type, value);`, without declaring it",
    "Subscriber": "an `event` subscribes; leave this out",
    "ServiceServer ServiceClient service::call": (
        "write `CALL(/service, package/Type, request);`; `event … service` observes the calls of other nodes"
    ),
    "NodeHandle AsyncSpinner CallbackQueue spin spinOnce ok rospy roscpp ros::init": _NO_NODE,
    "param::get param::param param::set": (
        "ROS master parameters are not available; write the value into the specification, `const double NAME = …;`"
    ),
    "__SKIP": "write `DROP;`",
    "RESET": "write `__RESET;`",
    "__MONITOR __LOC __DEFAULT_MESSAGE __ACTIVITY __STATICSIG __LINE__ __FILE__ __func__": (
        "a record already has the position and the monitor; leave it out"
    ),
    "vector": "also write the type of its elements: `std::vector<int>`",
    "emplace_back add": "write `.push_back(…)`",
    "push_front": "write `.insert(v.begin(), x)`",
    "length len": "write `.size()`",
    "contains": "write a loop; of a string: `.find(…) != std::string::npos`",
    "self this": "write the variable by its name",
    "True": "write `true`",
    "False": "write `false`",
    "None null nil": "there are no pointers; use an empty string or a `bool`",
    "let var": "write `auto`",
    "print println echo": _ROS_INFO,
    "pass then": "leave it out",
    "boolean Boolean": "write `bool`",
    "str String": "write `std::string`",
    "Time": "write `ros::Time`",
    "Duration": "write `ros::Duration`",
    "__int128": "write `long`, which has 64 bits",
}  # fmt: skip
_INSTEAD = {name: advice for names, advice in _NAMES.items() for name in names.split()}
_FAMILIES = {
    "ros": "of roscpp, only `ros::Time`, `ros::Duration` and the macros `ROS_…` are available",
    "boost": "boost is not available; the supported part of the C++ library is in docs/reference/rv-language.md",
    "Eigen": "use the message types, or a variable for each number",
    "tf": "transforms are not looked up; write an event for `/tf`, of type `tf2_msgs/TFMessage`",
    "tf2": "transforms are not looked up; write an event for `/tf`, of type `tf2_msgs/TFMessage`",
}


def instead(parts: Sequence[str]) -> str | None:
    pointer = re.fullmatch(r"(\w+::\w+?)(?:::)?(?:Const)?Ptr", "::".join(parts))
    if pointer is not None:
        return f"there are no pointers; write `{pointer[1]}`"
    if parts[-1] in ("iterator", "const_iterator", "reverse_iterator", "const_reverse_iterator"):
        return "walk through a vector with `for (auto& x : v) { … }`, or with an index"
    advice = _INSTEAD.get("::".join(parts)) or _INSTEAD.get("::".join(parts[-2:])) or _INSTEAD.get(parts[-1])
    if len(parts) == 1:
        return advice
    return (advice if parts[0] in ("std", "boost", "ros") else None) or _FAMILIES.get(parts[0])


_Advice = str | Callable[[re.Match[str]], str]


@dataclass(frozen=True)
class _Shape:
    """A construct outside the grammar, at these numbers of open braces (2 means two or more)."""

    pattern: re.Pattern[str]
    advice: _Advice
    depths: frozenset[int]


def _shape(pattern: str, advice: _Advice, *depths: int) -> _Shape:
    return _Shape(re.compile(pattern), advice, frozenset(depths or (0, 1, 2)))


def _hexadecimal(match: re.Match[str]) -> str:
    value = int(match[0].replace("'", "_"), 2)
    return f"write `{value:#x}`"


def _replace(pattern: str, by: str, template: str = "write `{}`") -> Callable[[re.Match[str]], str]:
    return lambda found: template.format(re.sub(pattern, by, found[0].strip()))


def _as_float(match: re.Match[str]) -> str:
    try:
        return f"write `{float.fromhex(match[0])!r}`"
    except OverflowError:
        return "write it in decimal"


def _of_template(match: re.Match[str]) -> str:
    return _INSTEAD[match["template"]]


_SCOPED = r"(?:\w+\s*::\s*)*\w+"
_TYPE = rf"(?:(?:unsigned|signed|long|short|const)\s+)*{_SCOPED}(?:\s*<[\w:<>\s,]*>)?"
_NOT_A_TYPE = (
    r"(?!(?:else|return|new|delete|event|throw|case|goto|if|while|for|switch|do|using|typedef|init)\b)"
)
_TEMPLATE = "|".join(name for names in _TEMPLATES for name in names.split())
_SHAPES = (
    _shape(
        r"\bnew\b(?!\s*=)\s*(?:[\w:]+(?:\s*<[^;]*>)?)?",
        "there are no pointers; declare the variable itself: it exists from the start",
    ),
    _shape(r"\b0[bB][01](?:'?[01])*", _hexadecimal),
    _shape(r"\b0[oO][0-7]+", _replace("[oO]", "")),
    _shape(r"\b0[xX][\da-fA-F]*\.?[\da-fA-F]*[pP][-+]?\d+", _as_float),
    _shape(
        r"\b\d[\da-fA-FxX]*(?:['_][\da-fA-F]+)+",
        _replace("['_]", "", "write `{}`; numbers have no separators"),
    ),
    _shape(r"\b(?:\d+\.?\d*|\.\d+)[A-Za-z_]\w*", "names begin with a letter, and numbers have no units"),
    _shape(
        r"\b(?:u8|[uUL])?R\"",
        "write it in plain quotes, with `\\\\` for a backslash and `\\n` for a new line",
    ),
    _shape(r"\b(?:u8|[uUL])(?=[\"'])", "strings are bytes; leave it out"),
    _shape(
        r"'[^'\n{][^'\n]+'",
        _replace("'", '"', "a character literal is one character; write a string in double quotes, `{}`"),
        2,
    ),
    _shape(r"\[\[[^\[\]\n]*\]\]", "there are no attributes; leave it out"),
    _shape(
        r"\[[&=\w\s,]*\]\s*(?=\([^()]*\)[^;]*\{|\{)",
        "there are no lambda functions; declare a helper function beside the events, and call it in a loop",
    ),
    _shape(r"(?<![\w\])])\s*\[[^\[\]\n;]*\]", _replace(r"^.(.*).$", r"{\1}"), 2),
    _shape(rf"\b(?:(?:std|boost)\s*::\s*)?(?P<template>{_TEMPLATE})\s*<[^;{{}}()]*", _of_template),
    _shape(
        rf"\b{_SCOPED}<[^;{{}}()]*>\s*::\s*(?:const_|reverse_|const_reverse_)?iterator\b",
        "walk through a vector with `for (auto& x : v) { … }`, or with an index",
    ),
    _shape(
        rf"\b{_SCOPED}<[^;{{}}()]*>\s*::\s*(?:size|value|difference)_type\b",
        "write `size_t`, or the type itself",
    ),
    _shape(
        rf"\b(?:std\s*::\s*)?\w+\s*<{_TYPE}>\s*(?=\()",
        "functions take no types; write `static_cast<type>(…)` for an argument that has another",
    ),
    _shape(
        r"\b(?:std|boost)\s*::\s*(?!vector\b|numeric_limits\b)\w+\s*<[^;{}()]*",
        "the only template is `std::vector<T>`",
    ),
    _shape(rf"\b{_SCOPED}::\s*\w+\s*\*+\s*\w+(?=\s*[=;,)])", _POINTERS),
    _shape(rf"\b{_SCOPED}\s*->\s*\w+", _replace(r"\s*->\s*", ".", "there are no pointers; write `{}`"), 2),
    _shape(
        r"\b(\w+)\s*::\s*(\w+?)(?:\s*::\s*)?(?:Const)?Ptr\b(?:\s*(?:const\s*)?&)?",
        lambda found: f"there are no pointers; write `{found[1]}::{found[2]}`",
    ),
    _shape(
        rf"\b{_NOT_A_TYPE}{_TYPE}\s*&&?\s*\w+\s*=",
        "there are no references except parameters of functions and `for (auto& x : v)`; without `&` it is a copy",
    ),
    _shape(
        rf"\b{_NOT_A_TYPE}{_TYPE}\s+\w+\s*\([^;{{}}]*\)\s*(?:const\s*)?(?=\{{)",
        "functions are declared beside the events, not in them",
        2,
    ),
    _shape(rf"\b{_NOT_A_TYPE}{_TYPE}\s+\w+\s*\(\s*\)(?=\s*;)", "leave the `()` out", 2),
    _shape(r"\(\s*[\w:]+\s*\)\s*(?=[\w\"])", _replace(r"^.\s*(.*?)\s*.$", r"static_cast<\1>(…)"), 2),
    _shape(
        r"\b(?:int|bool|char|long|short|float|double|unsigned)\s*\{[^{};]*\}",
        _replace(r"\s*{(.*)}", r"(\1)"),
        2,
    ),
    _shape(r"\bconst\s+\w+\s*=", "its type is missing: `const int NAME = …;`"),
    _shape(
        rf"(?<=[(,])\s*{_TYPE}\s*&?\s+\w+\s*=",
        "parameters have no default values; give the argument in each call",
        1,
    ),
    _shape(r"\.\.\.", "a function has a fixed list of parameters", 1),
    _shape(r"\bauto\s+\w+\s*\([^(){};]*\)\s*->\s*[\w:]+", "write the type first: `int f() { … }`", 1),
    _shape(r"(?<=\))\s*const\b", "functions do not belong to an object; leave `const` out", 1),
    _shape(r"\.\.\.", "write each value separately", 2),
    _shape(r"\bcase\b[^;:{}]*\.\.", "write each value separately", 2),
    _shape(r"\b(?:DROP|__RESET)\s*\(\s*\)?", _replace(r"\W.*", ";"), 2),
    _shape(r"\belif\b[^;{}]*", "write `else if (…)`", 2),
    _shape(
        r"\b(?:foreach|BOOST_FOREACH|for)\s*\(?\s*(?:[\w:]+\s+)?\w+\s*(?:,|\bin\b|\bof\b)\s*\w*\)?",
        "write `for (auto x : v) { … }`",
        2,
    ),
    _shape(r"\bunless\b[^;{}]*", "write `if (!(…))`", 2),
    _shape(
        r"\b(?:def|lambda)\b[^;{}\n]*", "declare a helper function, `double half(double x) { return x / 2; }`"
    ),
    _shape(r"[!=]==", _replace("=$", ""), 2),
    _shape(r"<=>|\?\?|\?:|\?\.|=>", "write `a ? b : c`, or `if (…) { … }`", 2),
    _shape(r":=", "write `=`", 2),
    _shape(r"\b(?:int|bool|char|long|short|float|double|unsigned|void)\s*\*\s*\*", _POINTERS),
    _shape(r"\*\*", "write `pow(x, y)`", 2),
    _shape(
        r"(?<=[;{}\n])(?<!['\u2018\u2019\u00b4`]\{)\s*\w+\s*:(?!:)",
        "there are no labels; use a loop, `break` or `continue` (or is a `}` missing before a property?)",
        2,
    ),
    _shape(
        r"\b(?:import|from(?!\s*\")|include|package)\s[^;{}()\n]*;?",
        "types and functions are known by their names; leave this line out",
        0,
        1,
    ),
    _shape(r"\busing\b[^;{}]*;?", "write the type or name itself; leave this line out"),
    _shape(
        r"\b([a-z]\w*)\.(?:msg\.)?([A-Z]\w*)\s+(?=\w)", lambda found: f"write `{found[1]}::{found[2]}`", 1, 2
    ),
    _shape(
        r"\b[A-Za-z_]\w*(?:[-.]\w+)+(?=\s*[({])|\b\w+-\w+(?=\s)",
        _replace("[-.]", "_", "a name has letters, digits and `_`; write `{}`"),
        0,
        1,
    ),
    _shape(r"\b([a-z]\w*)(?:/|::)msg(?:/|::)(\w+)", _replace("msg(/|::)", ""), 1, 2),
    _shape(
        r"\b(?!event\b)\w+\s+(\w+)\s*\([^()]*\)\s*(?=/|service\b|every\b)",
        lambda found: f"an event begins with `event`: write `event {found[1]}(…)`",
        1,
    ),
    _shape(
        r"\b\w+\s*\[[^\[\]]*\]\s*\[[^\[\]]*\]",
        "there are no arrays of arrays; use a `std::vector` of vectors",
    ),
)
_WINDOW = 200


def foreign(text: str, offset: int, depth: int) -> tuple[int, int, str] | None:
    before = text[max(0, offset - _WINDOW) : offset]
    begin = offset - len(before) + max(before.rfind(mark) for mark in ";{}\n") + 1
    end = min(len(text), offset + _WINDOW)
    for shape in _SHAPES:
        if min(depth, 2) not in shape.depths:
            continue
        for found in shape.pattern.finditer(text, begin, end):
            if found.start() <= offset <= found.end() and found[0].strip():
                advice = shape.advice if isinstance(shape.advice, str) else shape.advice(found)
                return found.end() - len(found[0].lstrip()), found.end(), advice
    return None
