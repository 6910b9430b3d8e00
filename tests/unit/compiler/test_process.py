import asyncio
import contextlib
import os
import resource
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.compiler import process
from appliance.specifications.checking import check
from appliance.specifications.specification_files import (
    Sources,
    SpecificationsRefusedError,
    checked,
)
from rosmop.fast.serialization import decoded_part
from tests.support.waiting import eventually

GOOD = """a() {
    int shared;
    event said(string data) /chatter std_msgs/String '{data:data}' { shared = shared + 1; }
    event seen() /seen own_msgs/Seen '{}' { }
    fsm : idle [ said -> idle ]
    @idle { }
}
b() { event said() /chatter std_msgs/String '{}' { if (shared > 3) { } } }
"""
DEFINITIONS = {"own_msgs/Seen.msg": "std_msgs/Header header\ngeometry_msgs/Point[] at\n"}
HUNGRY = "s() { event e() /a std_msgs/Bool '{}' { " + "int x; x = 1 + 2 * 3; " * 2000 + " } }"

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]


async def conversation(*wanted: messages.Message) -> list[Any]:
    lifeline, its_lifeline = socket.socketpair()
    ours, theirs = socket.socketpair()
    supervisor, control = Channel(lifeline, messages.Lifeline), Channel(ours, messages.CompilerLink)
    answers: list[Any] = []
    loop = asyncio.get_running_loop()

    def answered(message: Any) -> None:
        answers.append(message)
        if len(answers) == len(wanted):
            supervisor.send(messages.Stop())

    supervisor.attach(loop, lambda _message, _descriptors: None, lambda: None)
    control.attach(loop, lambda message, _descriptors: answered(message), lambda: None)
    supervisor.send(messages.LinkOpened("control", 0), (theirs.fileno(),))
    theirs.close()
    for one in wanted:
        control.send(one)
    try:
        await process.CompilerProcess(Channel(its_lifeline, messages.Lifeline)).run()
        await asyncio.sleep(0)  # the last message is read in this turn
        return answers
    finally:
        supervisor.close()
        control.close()
        its_lifeline.close()


async def test_it_answers_each_question_and_ends_when_it_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "setrlimit", lambda *_limit: None)  # the test's own process continues
    bad = GOOD.replace("shared + 1", "shred + 1")
    found, refused = await conversation(
        messages.ContentsWanted(7, {"a.rv": GOOD}, DEFINITIONS), messages.ContentsWanted(8, {"a.rv": bad}, {})
    )
    sources = Sources({"a.rv": GOOD}, DEFINITIONS)
    assert (found.number, checked(found.contents, sources, ())) == (7, check(sources, ()))
    with pytest.raises(SpecificationsRefusedError) as error:
        check(Sources({"a.rv": bad}), ())
    assert (refused.number, refused.findings) == (8, error.value.findings)


async def test_a_defect_of_the_compiler_is_an_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "setrlimit", lambda *_limit: None)
    monkeypatch.setattr("appliance.specifications.checking._standard", lambda: 1 // 0)
    wanted = messages.ContentsWanted(1, {"a.rv": GOOD}, {})
    assert [answer.findings for answer in await conversation(wanted, wanted)] == [
        ["a defect of rosrv, please report it: ZeroDivisionError: integer division or modulo by zero"]
    ] * 2


async def test_it_builds_what_relays_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "setrlimit", lambda *_limit: None)
    text = GOOD + GOOD.replace("a()", "c()").replace("b()", "d()").replace("shared", "another")
    compiled = check(Sources({"a.rv": text}, DEFINITIONS), ()).compiled
    names = [messages.PartNames(("c", "d")), messages.PartNames(("a", "b"), ("a",))]
    (made,) = await conversation(messages.PartsWanted(3, compiled, names))
    found = [[one.name for one in decoded_part(part).compiled.specifications] for part in made.parts]
    assert (made.number, found) == (3, [["c", "d"], ["a", "b"]])


async def test_large_specifications_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit applies to the whole set and to each relay's part, so that no message exceeds a link's limit."""
    monkeypatch.setattr(resource, "setrlimit", lambda *_limit: None)
    compiled = check(Sources({"a.rv": GOOD}, DEFINITIONS), ()).compiled
    monkeypatch.setattr("appliance.specifications.checking._LONGEST", 1000)
    answers = await conversation(
        messages.ContentsWanted(1, {"a.rv": GOOD}, DEFINITIONS),
        messages.PartsWanted(2, compiled, [messages.PartNames(("a", "b"))]),
    )
    assert [answer.number for answer in answers] == [1, 2]
    for answer in answers:
        assert answer.findings == ["the compiled specifications take 0 MiB; the limit is 0 MiB: load fewer"]


def nested_repetitions(count: int) -> str:
    formula = "(a | b)* a"
    for _ in range(12):
        formula = f"({formula} (a|b))"
    events = " ".join(f"event {name}() /{name} std_msgs/Bool '{{}}' {{ }}" for name in "ab")
    return "\n".join(f"s{number}() {{ {events} ere : {formula} @match {{ }} }}" for number in range(count))


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("text", "memory", "seconds"),
    [(HUNGRY, 8 << 20, 4), (nested_repetitions(118), 1 << 30, 1)],
    ids=["memory", "time"],
)
def test_expensive_texts_stay_within_bounds(text: str, memory: int, seconds: int) -> None:
    program = f"""
import resource, sys
from pathlib import Path
from appliance.channel import messages
from appliance.compiler import process
from appliance.specifications import checking
size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (size + {memory}, size + {memory}))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
process._WORK_SECONDS, process._SPARE_SECONDS = {seconds}, 0
print(process.answer(messages.ContentsWanted(1, {{"a.rv": sys.stdin.read()}}, {{}})))
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        check=False,
        input=text,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode != 0 or "more than the 1024 MiB of memory" in done.stdout


@contextlib.contextmanager
def started(program: str) -> Iterator[tuple[subprocess.Popen[str], Channel, Channel]]:
    lifeline, its_lifeline = socket.socketpair()
    ours, theirs = socket.socketpair()
    supervisor, control = Channel(lifeline, messages.Lifeline), Channel(ours, messages.CompilerLink)
    running = subprocess.Popen(
        [sys.executable, "-c", program, str(its_lifeline.fileno())],
        pass_fds=[its_lifeline.fileno()],
        text=True,
        stderr=subprocess.PIPE,
    )
    its_lifeline.close()
    supervisor.attach(asyncio.get_running_loop(), lambda _message, _descriptors: None, lambda: None)
    supervisor.send(messages.LinkOpened("control", 0), (theirs.fileno(),))
    theirs.close()
    try:
        yield running, supervisor, control
    finally:
        supervisor.close()
        control.close()
        running.kill()
        running.communicate(timeout=60)


_COMPILER = """
import sys
from appliance.compiler import process
process._DRY_RUN_SECONDS = {}
process.main(int(sys.argv[1]))
"""


@pytest.mark.nightly
async def test_a_dry_run_ends_with_its_budget() -> None:
    with started(_COMPILER.format(1)) as (running, _supervisor, control):
        answers: asyncio.Queue[Any] = asyncio.Queue()
        control.attach(
            asyncio.get_running_loop(), lambda heard, _fds: answers.put_nowait(heard), lambda: None
        )
        text = nested_repetitions(118)
        assert 22_000 < len(text) < 25_000
        control.send(messages.ContentsWanted(4, {"a.rv": text}, {}, dry_run=True))
        async with asyncio.timeout(100):
            refused = await answers.get()
        assert (refused.number, refused.findings) == (
            4,
            ["they take more than the 1 s of processor time that a dry run has to compile them"],
        )
        assert await asyncio.to_thread(running.wait, 60) == 0


@pytest.mark.nightly
@pytest.mark.parametrize("used", [3.0, 0.0], ids=["works", "starts"])
async def test_a_compiler_without_its_link_ends(used: float) -> None:
    with started(_COMPILER.format(1000)) as (running, _supervisor, control):
        control.send(messages.ContentsWanted(4, {"a.rv": nested_repetitions(118)}, {}, dry_run=True))
        await asyncio.to_thread(_until_used, running.pid, used)
        control.close()
        assert await asyncio.to_thread(running.wait, 60) == 0


def _until_used(pid: int, seconds: float) -> None:
    def used() -> float:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    eventually(lambda: used() >= seconds, "it works")


@pytest.mark.nightly
def test_an_idle_compiler_ends_with_an_open_lifeline() -> None:
    """The supervisor kills a process that closes its lifeline and still runs, and that would count as a restart."""
    here, there = socket.socketpair()
    code = (
        "import signal, sys; from appliance.compiler import process as p; p._IDLE_SECONDS = 0.1;"
        " p.main(int(sys.argv[1])); signal.pause()"  # it would still run
    )
    with here, there:
        command = [sys.executable, "-c", code, str(there.fileno())]
        with subprocess.Popen(command, pass_fds=(there.fileno(),)) as idle:
            there.close()
            here.settimeout(60)
            try:
                while here.recv(4096):
                    pass
            finally:
                idle.kill()
    assert idle.returncode == 0
