"""Node APIs that tests register, with a path for each node and life. The master's calls are recorded.

They answer as real nodes do, so that the appliance's liveness checks, which are not recorded, find them alive.
"""

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from socketserver import ThreadingMixIn
from typing import Any, Self
from xmlrpc.server import SimpleXMLRPCDispatcher, SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from tests.support.processes import LIMIT

_ANSWERS: dict[str, list[Any]] = {
    "getPid": [1, "", os.getpid()],
    "publisherUpdate": [1, "", 0],
    "paramUpdate": [1, "", 0],
    "shutdown": [1, "", 0],
}


@dataclass(frozen=True, slots=True)
class NodeCalled:
    node: str
    method: str
    params: tuple[Any, ...]


class _Handler(SimpleXMLRPCRequestHandler):
    rpc_paths = ()
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True


class _Server(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True
    request_queue_size = 512

    def __init__(self, called: Callable[[NodeCalled], None]) -> None:
        super().__init__(("127.0.0.1", 0), _Handler, logRequests=False, allow_none=True)
        self._called = called

    def _marshaled_dispatch(
        self,
        data: Any,
        dispatch_method: Callable[[str, tuple[Any, ...]], Any] | None = None,
        path: Any = None,
    ) -> Any:
        def answer(method: str, params: tuple[Any, ...]) -> Any:
            self._called(NodeCalled(str(path).strip("/"), method, params))
            return _ANSWERS[method]

        return SimpleXMLRPCDispatcher._marshaled_dispatch(self, data, answer, path)


class FakeNodes:
    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._calls: list[NodeCalled] = []
        self._told = 0  # all calls so far, except `getPid`
        self._server = _Server(self._keep)
        self.base = f"http://127.0.0.1:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    def uri(self, node: str) -> str:
        return self.base + node

    def calls(self, node: str, method: str) -> list[tuple[Any, ...]]:
        with self._changed:
            return [call.params[1:] for call in self._calls if (call.node, call.method) == (node, method)]

    def wait_until(self, wanted: Callable[[], bool], *, timeout: float = LIMIT) -> bool:
        with self._changed:
            while not wanted():
                before = self._told
                if not self._changed.wait_for(lambda: self._told > before, timeout):  # noqa: B023  it is called here
                    return False
            return True

    def forget(self) -> None:
        with self._changed:
            self._calls.clear()

    def _keep(self, call: NodeCalled) -> None:
        with self._changed:
            self._calls.append(call)
            self._told += call.method != "getPid"
            self._changed.notify_all()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
