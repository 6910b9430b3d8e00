import os
from collections.abc import Callable
from typing import Any

from structlog.testing import capture_logs

from appliance.supervisor.process_handle import ProgramOutput


class Loop:
    read: Callable[[], None] | None = None

    def add_reader(self, _descriptor: int, read: Callable[[], None]) -> None:
        self.read = read

    def remove_reader(self, _descriptor: int) -> None:
        self.read = None


def test_each_line_is_a_line_of_the_log() -> None:
    reader, writer = os.pipe()
    loop: Any = Loop()
    with capture_logs() as logged, os.fdopen(reader, "rb", buffering=0) as output:
        ProgramOutput("rosout", output, loop)
        loop.read()  # nothing yet
        for piece in (b"subscribed to ", b"/rosout\nbad \x1b[2J\n", b"x" * 2001 + b"\n", b"the end"):
            os.write(writer, piece)
            loop.read()
        os.close(writer)
        loop.read()
        assert output.closed
    assert loop.read is None
    assert [line["event"] for line in logged] == [
        "subscribed to /rosout", "bad ?[2J", "x" * 2000, "x", "the end",
    ]  # fmt: skip
    assert {line["process"] for line in logged} == {"rosout"}
