import struct
from collections.abc import Iterator
from dataclasses import dataclass
from random import Random

from rosmop.tests import acting
from roswire.definitions import Definitions

_OF_PLAIN = (
    "uint8 kind\nint32 count\nfloat64 x\nfloat32 y\nbool on\ntime when\nint64[3] three\nuint8[] rest\n"
)
_OF_STAMPED = (
    "string frame\ntime when\nfloat64 x\nint16 count\nfloat64[] values\nuint8 kind\nstring[] names\n"
)
_OF_ROW = (
    "uint32 seq\nstring name\nfloat64[] values\nint16 count\nfloat32[] few\nuint8[] bytes\nbool[] bits\n"
    "time[] times\nduration[] gaps\nfloat64[3] three\nint64[] whole\nfloat64 x\n"
)
OWN = Definitions.from_files(
    {
        "own/Plain.msg": _OF_PLAIN,
        "own/Stamped.msg": _OF_STAMPED,
        "own/Row.msg": _OF_ROW,
        "own/Serve.srv": f"{_OF_PLAIN}---\n{_OF_STAMPED}",
    }
)
TRIGGERS = {
    "/plain": "/plain own/Plain", "/stamped": "/stamped own/Stamped",
    "/serve request": "service /serve own/Serve request", "/serve response": "service /serve own/Serve response",
}  # fmt: skip
PLAIN = ("/plain", "/serve request")


def ways(seed: int) -> tuple[str, ...]:
    served = ("/serve request", "/serve request", "/serve response", "/plain")
    return served if seed % 4 == 3 else ("/plain", "/plain", "/stamped")


_PLAIN = {"kind": "int", "count": "int", "x": "double", "y": "float", "on": "bool", "when": "ros::Time",
          "three[1]": "long", "x ": "int", "three": "std::vector<long>", "rest": "uint8_t[]"}  # fmt: skip
_STAMPED = {"frame": "std::string", "x": "double", "count": "int", "values[1]": "double", "kind": "int",
            "when.sec": "unsigned int", "values": "std::vector<double>", "names": "std::string[]"}  # fmt: skip
_NUMBERS = ("int", "long", "unsigned int", "float", "double", "bool")
_LOGICS = (
    "fsm: here [ e0 -> there, default here ] there [ e0 -> here, default there ]{here}{there}{fail}",
    "fsm: one [ e0 -> two, default one ] two [ e0 -> three ] three [ default three ]{three}{fail}",
    "ere: e0* (e1 | epsilon)\n{match}{fail}",
    "ltl: [](e0 => o (e0 or e1)){violation}{validation}",
    "ptltl: e0 -> (*) (e0 or e1){violation}{validation}",
    "cfg: S -> e0 S e1 | epsilon{match}{fail}",
    "mtl: once[0,1ms] e0{violation}",
    "tfsm: here [ e0 -> there, default here ] there [ e1 -> here, timeout 1500us -> three, default there ]"
    " three [ default here, timeout 1ms -> here ]{here}{three}",
    "tfsm: here [ default there ] there [ default here ]{there}{timeout}",
    "pattern: globally: e0 causes e1 within 2ms{violation}",
    "pattern: after e0 until e1: no e0 within 1ms{violation}",
    "pattern: globally: e1 requires e0 within 800us{violation}{validation}",
    "pattern: globally: e0 forbids e1 within 800us{violation}",
)
_HANDLERS = (*[""] * 8, "@{} {{ }}", '@{} {{ ROS_WARN("{}"); }}', "@{} {{ DROP; }}", "@{} {{ __RESET; }}",
             "@{} {{ total = total + 1; }}",
             "@{} {{ told.linear.z = total; PUBLISH(/told, geometry_msgs/Twist, told); }}")  # fmt: skip


def definitions() -> Definitions:
    return acting.definitions().merge(OWN)


@dataclass(frozen=True)
class Traffic:
    topic: str
    frames: bytes
    messages: int

    def bodies(self) -> Iterator[bytes]:
        position = 0
        while position < len(self.frames):
            first = position + 4
            position = first + int.from_bytes(self.frames[position:first], "little")
            yield self.frames[first:position]


class Specifications:
    """Random specifications. With `numbers`, they only have numbers and conditions, which a module handles."""

    def __init__(self, seed: int, *, numbers: bool = False) -> None:
        self._random = Random(seed)  # noqa: S311  draws examples, not keys
        self._numbers = numbers
        self._ways = ways(seed)

    def texts(self) -> list[str]:
        return [self._specification(number) for number in range(self._random.choice((1, 1, 1, 2, 3)))]

    def _specification(self, number: int) -> str:
        random = self._random
        events = [self._event(index) for index in range(2)]
        properties = [self._property() for _ in range(random.choice((0, 0, 0, 1, 1, 2)))]
        helper = "bool high(double v) { if (v > 3) { return true; } return total > 5; }"
        tick = random.choice(("", "", "", "event tick() every 2ms { total = 0; }"))
        return (
            f"s{number}() {{ int total = 0; double level = 1.5; bool seen = false; std::string last;\n"
            f"std::vector<int> all; std::vector<double> window; double slots[3] = {{1}};\n"
            f"geometry_msgs::Twist told; std_msgs::Bool flag; std_msgs::String word; {helper}\n"
            + "\n".join([*events, tick, *properties])
            + "\n}"
        )

    def _event(self, index: int) -> str:
        random = self._random
        topic = random.choice(self._ways)
        fields = _PLAIN if topic in PLAIN else _STAMPED
        if self._numbers:
            fields = {field: kind for field, kind in fields.items() if kind in _NUMBERS}
        chosen = random.sample(sorted(fields), random.randint(0, 3))
        arrays = {one for one in chosen if f"{one}[1]" in chosen}
        chosen = [one for one in chosen if one not in arrays]
        names = {}
        for place, field in enumerate(dict.fromkeys(one.strip() for one in chosen)):
            kind = next(fields[one] for one in chosen if one.strip() == field)
            names[f"p{place}"] = (field, kind)
        parameters = ", ".join(f"{kind} {name}" for name, (_, kind) in names.items())
        pattern = [f"{field}:{name}" for name, (field, _) in names.items()]
        if random.random() < 0.3 and not any(field == "kind" for field, _ in names.values()):
            pattern.append("kind:1")
        numbers = [
            name for name, (_, kind) in names.items() if not kind.startswith(("std::", "ros::", "uint8_t["))
        ]
        readable = [*numbers, "total", "level", "seen"]
        when = f"when ({self._condition(readable)})" if random.random() < 0.3 else ""
        body = " ".join(self._statement(names, readable, 2) for _ in range(random.randint(0, 4)))
        return (
            f"event e{index}({parameters}) {TRIGGERS[topic]} '{{{', '.join(pattern)}}}' {when} {{ {body} }}"
        )

    def _property(self) -> str:
        logic = self._random.choice(_LOGICS)
        found: dict[str, str] = {}
        for category in ("here", "there", "three", "match", "fail", "violation", "validation", "timeout"):
            handler = self._random.choice(_HANDLERS)
            found[category] = "\n" + handler.format(category, category)
        text = logic.format(**found)
        if "@" not in text:
            text = logic.format(
                **dict.fromkeys(found, "")
                | {first: f"\n@{first} {{ }}" for first in [logic[logic.rindex("{") + 1 : -1]]}
            )
        return text

    def _expression(self, names: list[str], depth: int) -> str:
        random = self._random
        if not depth or random.random() < 0.3:
            return random.choice([*names, "0", "1", "2", "-3", "0.5", "2.5", "100"])
        one, other = (self._expression(names, depth - 1) for _ in range(2))
        return random.choice(
            (
                f"({one} + {other})", f"({one} - {other})", f"({one} * {other})", f"({one} / {other})",
                f"((int) {one} % (int) {other})", f"std::max((double) {one}, (double) {other})",
                f"(high({one}) ? {one} : {other})", f"std::abs({one})", f"-({one})",
            )
        )  # fmt: skip

    def _condition(self, names: list[str]) -> str:
        random = self._random
        one, other = (self._expression(names, 1) for _ in range(2))
        sign = random.choice(("<", ">", "==", "!=", "<=", ">="))
        return random.choice(
            (f"{one} {sign} {other}", f"!({one} {sign} {other})", f"{one} > 1 && {other} < 2")
        )

    def _statement(self, names: dict[str, tuple[str, str]], readable: list[str], depth: int) -> str:
        random = self._random
        value = self._expression(readable, 2)
        assigned = [name for name in names if name in readable] * 3
        texts = [name for name, (_, kind) in names.items() if kind == "std::string"]
        of_numbers = [
            f"total = {value};", f"level = {value};", "total++;", "seen = !seen;", f"total += {value};",
            *(f"{name} = {value};" for name in assigned),
        ]  # fmt: skip
        if self._numbers:
            if depth:
                inner, other = (self._statement(names, readable, depth - 1) for _ in range(2))
                of_numbers += [f"if ({self._condition(readable)}) {{ {inner} }} else {{ {other} }}"] * 5
            return random.choice([*of_numbers, "return;", "DROP;"])
        choices = [
            *of_numbers,
            *(f'if ({name} == "abc") {{ last = {name}; }}' for name in texts),
            *(f'ROS_INFO("%s %.3f %d", {name}.c_str(), {value}, total);' for name in texts),
            f'ROS_WARN("%g and %5d", (double) {value}, total);', f"std::cout << {value} << std::endl;",
            *self._publications([*texts, "last", '"none"'], value),
        ]  # fmt: skip
        choices += [f'for (int i = 0; i < {name}.size(); i++) {{ if ({name}[i] == "nnnn") {{ total += i; }} }}'
                    for name, (_, kind) in names.items() if kind == "std::string[]"]  # fmt: skip
        choices += random.sample(
            (
                "window.push_back(level); if (window.size() > 3) { window.erase(window.begin()); }",
                "for (double each : window) { level += each; }", f"slots[total % 3] = {value};", "level = slots[1];",
                f"if (window.size() > 1) {{ window[1] += {value}; window.pop_back(); }}",
                "window.insert(window.begin(), level); all.resize(3); all.back()++;",
                "window.clear(); total += all.size();",
                "{ std::vector<double> other = window; other.push_back(level); window = other; level = other[0]; }",
                *(f"window = {name};" for name, (_, kind) in names.items() if kind == "std::vector<double>"),
            ),
            2,
        )  # fmt: skip
        for name in (name for name, (_, kind) in names.items() if kind.endswith(("g>", "e>", "t[]"))):
            choices += [f"for (double each : {name}) {{ level += each; }}", f"total += {name}.size();",
                        f"if (!{name}.empty()) {{ level = {name}[0]; }}", f"level = {name}[total];",
                        f"level = std::accumulate({name}.begin(), {name}.end(), level);",
                        f"if (seen) {{ {name}[1] = 7; }}"]  # fmt: skip
        if depth:
            inner = self._statement(names, readable, depth - 1)
            other = self._statement(names, readable, depth - 1)
            choices += [f"if ({self._condition(readable)}) {{ {inner} }} else {{ {other} }}"] * 3
            choices.append(f"if ({self._condition(readable)}) {{ {inner} }}")
        if depth < 2:
            choices += ["return;", "DROP;"] * 2
        if depth < 2 and random.random() < 0.3:
            choices += ['ROS_WARN("said %d", total);', "std::reverse(all.begin(), all.end());",
                        "for (int i = 0; i < 3; i++) { total += i; }"]  # fmt: skip
            choices += [f'{name} = "other";' for name in texts]
        return random.choice(choices)

    def _publications(self, texts: list[str], value: str) -> list[str]:
        text = self._random.choice(texts)
        return [
            f"{{ std_msgs::String m; m.data = {text}; PUBLISH(/text, std_msgs/String, m); }}",
            f"{{ std_msgs::Header m; m.seq = {value}; m.stamp = ros::Time::now(); m.frame_id = {text};"
            ' if (m.frame_id == "abc") { total++; } PUBLISH(/header, std_msgs/Header, m); }',
            f"{{ geometry_msgs::PoseWithCovariance m; m.pose.position.x = {value}; m.covariance[total] = level;"
            " level = m.covariance[3]; PUBLISH(/pose, geometry_msgs/PoseWithCovariance, m); }",
            f"told.linear.x = {value}; told.angular = told.linear; PUBLISH(/told, geometry_msgs/Twist, told);",
            "PUBLISH(/linear, geometry_msgs/Vector3, told.linear); total += told.angular.x;",
            f"{{ geometry_msgs::Twist m = told; m.linear.y = {value}; told = m; }}",
            f"word.data = {text}; PUBLISH(/text, std_msgs/String, word);",
            f"if (word.data != {text}) {{ last = word.data; }} PUBLISH(/text, std_msgs/String, word);",
            f"flag.data = {value}; PUBLISH(/text2, std_msgs/Bool, flag);",
        ]


class Messages:
    def __init__(self, seed: int) -> None:
        self._random = Random(seed)  # noqa: S311  draws examples, not keys
        self._ways = ways(seed)

    def traffic(self) -> Traffic:
        random = self._random
        topic = random.choice(self._ways)
        make = self._plain if topic in PLAIN else self._stamped
        alike = random.random() < 0.7
        count = random.choice((1, 1, 2, 5, 12, 30))
        shape = random.randrange(1 << 30)
        frames = b"".join(make(shape if alike else random.randrange(1 << 30)) for _ in range(count))
        return Traffic(topic, frames, count)

    def _number(self) -> float:
        return self._random.choice(
            (*(0.0, -0.0, 1.0, 2.5, 2.5, -3.0, 100.0) * 4, float("nan"), float("inf"), 1e-40)
        )

    def _plain(self, shape: int) -> bytes:
        random = self._random
        rest = b"\x05" * (shape % 9)
        body = struct.pack("<Bi", random.choice((0, 1, 1, 2)), random.choice((0, 1, 5, -7, 2**31 - 1)))
        body += struct.pack("<dfB", self._number(), self._number(), random.choice((0, 1, 1, 2)))
        body += struct.pack("<II3q", 5, random.choice((0, 7, 3_000_000_000)), 1, random.choice((0, 2, -1)), 3)
        body += struct.pack("<I", len(rest)) + rest
        return _frame(body[: random.choice((*[None] * 60, 3))])  # None means all bytes

    def _stamped(self, shape: int) -> bytes:
        random = self._random
        frame = (b"abc", b"abd", b"", b"longer")[shape % 4] if random.random() < 0.95 else b"xyz"
        values = [self._number() for _ in range(shape % 3)]
        names = [b"n" * (shape % 5)] * (shape % 2)
        if frame and names and random.random() < 0.1:  # as long as the others, but with other lengths inside
            frame, names = frame[:-1], [names[0] + b"n"]
        body = struct.pack("<I", len(frame)) + frame
        body += struct.pack("<IIdh", 9, 8, self._number(), random.choice((0, 1, -5)))
        body += struct.pack(f"<I{len(values)}d", len(values), *values) + struct.pack(
            "<B", random.choice((0, 1))
        )
        body += struct.pack("<I", len(names)) + b"".join(struct.pack("<I", len(one)) + one for one in names)
        return _frame(body)


def _frame(body: bytes) -> bytes:
    return struct.pack("<I", len(body)) + body
