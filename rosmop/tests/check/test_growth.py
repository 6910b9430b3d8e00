import sys
from collections import Counter
from collections.abc import Callable
from types import FrameType
from typing import Any

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from roswire.standard import standard_definitions

SPECIFICATION = """m{0}(int key) {{
    int count{0} = 0;
    static int limit{0} = {0};
    int more(int x) {{ return x + limit{0}; }}
    event e(int key, int x) /t{0} std_msgs/Int32 '{{data:key, data:x}}' {{
        if (more(x) > {0}) {{ count{0} = count{0} + 1; ROS_WARN("too many"); }}
    }}
    event f() /s{0} std_msgs/Empty '{{}}' {{ }}
    ltl: [](e => o f)
    @violation {{ ROS_WARN("violated"); }}
}}
"""


def lines_run(number: int) -> Counter[str]:
    counted: Counter[str] = Counter()

    def trace(frame: FrameType, event: str, _argument: Any) -> Callable[..., Any] | None:
        if "/rosmop/" not in frame.f_code.co_filename:
            return None
        counted[frame.f_code.co_filename] += event == "line"
        return trace

    files = {f"f{each:03}.rv": SPECIFICATION.format(100 + each) for each in range(number)}
    definitions, before = standard_definitions(), sys.gettrace()
    sys.settrace(trace)
    try:
        MonitorSet.of(compiled_from(files, definitions))
    finally:
        sys.settrace(before)
    return counted


def test_twice_as_many_specifications_take_twice_as_long() -> None:
    lines_run(1)  # made once for all specifications
    few, some, many = (lines_run(number) for number in (4, 8, 16))
    for file in many:
        assert many[file] - some[file] <= 2.1 * (some[file] - few[file]) + 20, file
