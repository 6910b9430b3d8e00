"""The cost of reading and writing ROS's wire formats, compared with Python's own XML-RPC.

    python benchmarks/wire.py

Each line is the best of five rounds in microseconds. Every call of the Master API reads two documents and writes two.
"""

import timeit
import xmlrpc.client
from collections.abc import Callable

from roswire import names
from roswire.tcpros import HeaderParser, encode_header
from roswire.uris import parse_node_uri
from roswire.xmlrpc import Value, build_call, build_response, parse_call, parse_response

CALL = ("/talker", "/chatter", "std_msgs/String", "http://10.0.0.1:4567/")
ANSWER: Value = [1, "Registered [/talker] as publisher of [/chatter]", ["http://10.0.0.1:4567/"]]
STATE: Value = [
    1,
    "current system state",
    [[[f"/topic_{n}", [f"/node_{n % 100}"]] for n in range(1000)], [], []],
]
HEADER = {
    "callerid": "/listener",
    "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1",
    "message_definition": "string data\n",
    "tcp_nodelay": "1",
    "topic": "/chatter",
    "type": "std_msgs/String",
}


def measure(label: str, work: Callable[[], object], rounds: int = 5) -> None:
    number, _ = timeit.Timer(work).autorange()
    best = min(timeit.repeat(work, number=number, repeat=rounds)) / number
    print(f"{label:44} {best * 1e6:10.2f}")


def main() -> None:
    call, answer, state = build_call("registerPublisher", CALL), build_response(ANSWER), build_response(STATE)
    header = encode_header(HEADER)
    loads, dumps = xmlrpc.client.loads, xmlrpc.client.dumps  # noqa: TID251 - what it is measured against
    measure("read a call (registerPublisher)", lambda: parse_call(call))
    measure("  xmlrpc.client", lambda: loads(call))
    measure("write a call", lambda: build_call("registerPublisher", CALL))
    measure("  xmlrpc.client", lambda: dumps(CALL, "registerPublisher").encode())
    measure("read an answer", lambda: parse_response(answer))
    measure("write an answer", lambda: build_response(ANSWER))
    measure(f"read the state of 1,000 topics ({len(state)} bytes)", lambda: parse_response(state))
    measure("  xmlrpc.client", lambda: loads(state))
    measure("write it", lambda: build_response(STATE))
    measure("  xmlrpc.client", lambda: dumps((STATE,), methodresponse=True).encode())
    measure("resolve a global name", lambda: names.resolve("/chatter", "/talker"))
    measure("resolve a private name", lambda: names.resolve("~state", "/ns/talker"))
    measure("check a caller_id", lambda: names.canonical_caller_id("/ns/talker"))
    measure("read a node URI", lambda: parse_node_uri("http://10.0.0.1:4567/"))
    measure("read a connection header", lambda: HeaderParser().feed(header))
    measure("write a connection header", lambda: encode_header(HEADER))


if __name__ == "__main__":
    main()
