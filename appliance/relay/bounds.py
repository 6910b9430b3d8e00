"""Every bound of the data plane, named, in one place.

The defaults are beyond a large robot (100 nodes, 1,000 topics).
"""

from dataclasses import dataclass

MIB = 1 << 20


@dataclass(frozen=True)
class Limits:
    """Bounds of one relay process; lengths in bytes, times in seconds."""

    connections: int = 16_384
    """Subscribers and clients connected at once, those that have not sent their header yet included."""

    connections_per_host: int = 8_192
    """The same, of one host: a robot whose nodes all live on one machine has one connection a subscription."""

    header_bytes: int = 64 << 10
    """A TCPROS connection header, its length field not counted."""

    header_seconds: float = 10.0
    """From accepting a connection to its whole header."""

    grant_seconds: float = 2.0
    """A peer whose grant is not there yet is kept waiting so long before it is refused."""

    message_bytes: int = 256 * MIB
    """One message, request or response; a peer that declares more is cut. At least 1 MiB."""

    queue_messages: int = 1000
    """Messages that wait for one slow subscriber; the oldest are dropped beyond."""

    queue_bytes: int = 64 * MIB
    """The same in bytes. A message in the middle of being sent does not count: it is never dropped."""

    queue_grace: float = 0.05
    """While *every* subscriber of a topic is behind, and for no longer, its publisher is not read."""

    memory_bytes: int = 1024 * MIB
    """Of the whole process: half for unfinished messages, a quarter each for queues and latched ones."""

    header_memory_bytes: int = 64 * MIB
    """Headers that are not whole, or wait for a grant, of the whole process; the first 4 KiB of each do not count."""

    budget: float = 10.0
    """Milliseconds of processor time that monitors may take for one message, request or reply."""

    stall_seconds: float = 10.0
    """A connection in the middle of a large message, of which nothing comes (or goes) for so long, is cut."""

    connect_seconds: float = 3.0
    """To connect to a publisher or a service, and from there to a publisher's header."""

    service_seconds: float = 30.0
    """From connecting to a service to its header: a server that is busy may let its clients wait, as in plain ROS."""

    answer_seconds: float = 10.0
    """For control's answer to `UpstreamWanted`; then it is asked again."""

    retry_first: float = 0.1
    """Wait before a lost publisher is asked for again; doubled with each failure."""

    retry_longest: float = 5.0
    """The longest wait between two tries."""

    linger: float = 2.0
    """A publisher's connection is kept so long after its last subscriber left."""

    farewell: float = 2.0
    """A refused peer has so long to read the reason before its connection is closed."""

    report_every: float = 1.0
    """Between two `TrafficReported`, and the time over which equal refusals are folded."""

    refusals: int = 100
    """Different refusals reported one by one in that time; the rest are counted together."""

    def __post_init__(self) -> None:
        if self.message_bytes < MIB:
            raise ValueError(f"message_bytes is {self.message_bytes}; it must be at least {MIB}")
