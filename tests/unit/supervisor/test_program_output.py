import asyncio
import os

import pytest
from structlog.testing import capture_logs

from appliance.supervisor.process_handle import ProgramOutput

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("local_sockets")]


async def test_each_line_is_a_line_of_the_log() -> None:
    reader, writer = os.pipe()
    with capture_logs() as logged, os.fdopen(reader, "rb", buffering=0) as output:
        program = ProgramOutput("rosout", output, asyncio.get_running_loop())
        program.read()  # nothing yet
        for piece in (b"subscribed to ", b"/rosout\nbad \x1b[2J\n", b"x" * 2001 + b"\n", b"the end"):
            os.write(writer, piece)
            await asyncio.sleep(1)
        os.close(writer)
        await asyncio.sleep(1)
        assert output.closed
    assert [line["event"] for line in logged] == [
        "subscribed to /rosout", "bad ?[2J", "x" * 2000, "x", "the end",
    ]  # fmt: skip
    assert {line["process"] for line in logged} == {"rosout"}
