"""Extra connections for subscribers that their publisher must see by name: the topics of actions.

A publisher sees one connection of the relay for all subscribers. But an action client waits until the topics of its
goals and cancellations are connected to *its server*, which it knows by the `callerid` of the status messages
(actionlib, `wait_for_server`). For these topics each served subscriber (the first sixteen names of a host) gets another
connection to the publisher with the subscriber's `callerid`; its messages are discarded. It is opened after the
subscriber is served, so that the subscriber gets everything that the publisher then sends.
"""

from functools import partial

from appliance.relay.context import RelayContext
from appliance.relay.loop import LoopTimer
from appliance.relay.transport.sockets import BufferedSocket, begin_connect
from roswire.tcpros import encode_header

_GOAL = "ActionGoal"
_CANCEL = "actionlib_msgs/GoalID"
_RETRY_SECONDS = 1.0


def looks_for_names(type_name: str) -> bool:
    """Whether a publisher of this type waits for a subscriber with a certain name."""
    return type_name.endswith(_GOAL) or type_name == _CANCEL


class NamedSubscribers:
    """The extra connections to one publisher of one topic, while its main connection is open."""

    def __init__(self, context: RelayContext, topic: str, host: str) -> None:
        self._context = context
        self._topic = topic
        self._host = host
        self._wanted: frozenset[str] = frozenset()
        self._address: tuple[str, int] | None = None
        self._streams: dict[str, BufferedSocket] = {}
        self._retry: LoopTimer | None = None

    def update(self, names: frozenset[str], address: tuple[str, int]) -> None:
        """Set the subscribers that are served now, and the address of the publisher."""
        self._wanted, self._address = names, address
        for name in [stream for stream in self._streams if stream not in names]:
            self._streams.pop(name).close()
        self._open_missing()

    def close(self) -> None:
        """Close all connections with the main connection."""
        self._wanted, self._address = frozenset(), None
        for stream in self._streams.values():
            stream.close()
        self._streams.clear()
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None

    def _open_missing(self) -> None:
        self._retry = None
        if self._address is None:
            return
        for name in sorted(self._wanted - self._streams.keys()):
            try:
                sock = begin_connect(*self._address)
            except (OSError, OverflowError):
                self._try_again()
                return
            self._streams[name] = BufferedSocket(
                self._context.loop,
                sock,
                partial(self._received, name),
                partial(self._broken, name),
                payer=self._context.payer(self._host),
                opened=partial(self._connected, name),
            )

    def _connected(self, name: str) -> None:
        fields = {"callerid": name, "topic": self._topic, "type": "*", "md5sum": "*", "tcp_nodelay": "1"}
        self._streams[name].send(encode_header(fields))

    def _received(self, name: str, data: bytes) -> None:
        if not data:
            self._streams[name].close()
            self._broken(name, "")

    def _broken(self, name: str, _reason: str) -> None:
        self._streams.pop(name, None)
        self._try_again()

    def _try_again(self) -> None:
        if self._retry is None:
            self._retry = self._context.loop.after(_RETRY_SECONDS, self._open_missing)
