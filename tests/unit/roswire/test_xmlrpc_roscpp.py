import datetime
import math
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from roswire.xmlrpc import MethodCall, Value, build_fault, build_response, parse_call
from tests.support.requirements import need_program

pytestmark = pytest.mark.nightly

Peer = Callable[[bytes], MethodCall]


@pytest.fixture(scope="module")
def roscpp(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Peer]:
    compiler, config = need_program("g++", "g++"), need_program("pkg-config", "pkg-config")
    program = tmp_path_factory.mktemp("xmlrpcpp") / "peer"
    flags = subprocess.run(
        [config, "--cflags", "--libs", "xmlrpcpp"], check=True, capture_output=True, text=True
    )
    source = Path(__file__).with_name("xmlrpcpp_peer.cpp")
    subprocess.run([compiler, str(source), "-o", str(program), *flags.stdout.split()], check=True)
    with subprocess.Popen([str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        to_peer, from_peer = process.stdin, process.stdout

        def exchange(answer: bytes) -> MethodCall:
            to_peer.write(b"%d\n%s" % (len(answer), answer))
            to_peer.flush()
            return parse_call(from_peer.read(int(from_peer.readline())))

        yield exchange
        to_peer.close()
    shutil.rmtree(program.parent)


VALUES: list[Value] = [
    True,
    False,
    0,
    -(2**31),
    2**31 - 1,
    1.5,
    1e-300,
    math.inf,
    -math.inf,
    "",
    " a ",
    "<>&'\" \t\n caf\u00e9 \u4e2d",
    b"",
    b"\x00\xff" * 200,
    datetime.datetime(2025, 1, 31, 23, 59, 58),  # noqa: DTZ001 - XML-RPC has no time zones
    [],
    {},
    [1, "Registered [/listener]", ["http://10.0.0.1:4567/", "http://10.0.0.2:4567/"]],
    [1, "current system state", [[["/chatter", ["/talker"]]], [], [["/talker/get_loggers", ["/talker"]]]]],
    [0, "denied <rule>", []],
    {"arm": {"gains": [1.0, 2, True], "name": "a&b"}, "": 1},
    [1, "", ["TCPROS", "10.0.0.1", 40001]],
]


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_values_survive_roscpp(roscpp: Peer, value: Value) -> None:
    call = roscpp(build_response(value))
    assert call == MethodCall("echo", (value,))
    assert [type(param) for param in call.params] == [type(value)]


def test_nan_survives_roscpp(roscpp: Peer) -> None:
    (value,) = roscpp(build_response(math.nan)).params
    assert isinstance(value, float)
    assert math.isnan(value)


def test_faults_are_faults_for_roscpp(roscpp: Peer) -> None:
    call = roscpp(build_fault(-1, "no such <method>"))
    assert call == MethodCall("fault", ({"faultCode": -1, "faultString": "no such <method>"},))


def test_a_large_answer_is_read_by_roscpp(roscpp: Peer) -> None:
    value: Value = [1, "state", [[f"/topic_{number}", [f"/node_{number}"]] for number in range(2000)]]
    assert roscpp(build_response(value)).params == (value,)
