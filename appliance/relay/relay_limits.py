"""The limits of the data plane. The defaults exceed the needs of a large robot (100 nodes, 1,000 topics)."""

from dataclasses import dataclass

MIB = 1 << 20


@dataclass(frozen=True)
class RelayLimits:
    """Bounds of one relay process; lengths in bytes, times in seconds."""

    connections: int = 16_384
    """The most subscribers and clients connected at once, with those that have not sent their header."""

    connections_per_host: int = 8_192
    """The most connections of one host: a robot with all nodes on one machine has one for each subscription."""

    header_bytes: int = 64 << 10
    """The longest TCPROS connection header in bytes, without its length field."""

    header_seconds: float = 10.0
    """The seconds from accepting a connection to receiving its whole header."""

    grant_seconds: float = 2.0
    """The seconds that a peer waits for a missing grant before it is refused."""

    message_bytes: int = 256 * MIB
    """The longest message, request or response in bytes; a peer that declares more is cut. At least 1 MiB."""

    queue_messages: int = 1000
    """The most messages that wait for one slow subscriber; beyond that, the oldest are dropped."""

    queue_bytes: int = 64 * MIB
    """The most bytes that wait for one slow subscriber. A partly sent message does not count: it is never dropped."""

    queue_grace: float = 0.05
    """The longest time that a publisher is not read while *every* subscriber of its topic is behind."""

    memory_bytes: int = 1024 * MIB
    """The memory of the whole process: half for unfinished messages, a quarter each for queues and latched ones."""

    header_memory_bytes: int = 64 * MIB
    """The bytes of all headers that are incomplete or wait for a grant; the first 4 KiB of each do not count."""

    budget: float = 10.0
    """Milliseconds of processor time that monitors may take for one message, request or reply."""

    late: float = 20.0
    """Milliseconds after which a tick of a monitor, or a message that it judged, counts as late."""

    heartbeat: str = ""
    """The topic of the heartbeat, or empty."""

    heartbeat_line: str = ""
    """The serial line of the heartbeat, or empty."""

    stall_seconds: float = 10.0
    """The seconds without progress after which the transfer of a large message is cut."""

    connect_seconds: float = 3.0
    """The seconds for connecting to a publisher or a service, and from there to a publisher's header."""

    service_seconds: float = 30.0
    """The seconds from connecting to a service to its header; a busy server may let clients wait, as in plain ROS."""

    answer_seconds: float = 10.0
    """The seconds to wait for control's answer to `UpstreamWanted` before asking again."""

    retry_first: float = 0.1
    """The seconds before control is asked for a lost publisher again; doubled with each failure."""

    retry_longest: float = 5.0
    """The longest wait between two tries, in seconds."""

    linger: float = 2.0
    """The seconds that a publisher's connection outlives its last subscriber, during a reload or a restart."""

    farewell: float = 2.0
    """The seconds that a refused peer has to read the reason before its connection is closed."""

    report_every: float = 1.0
    """The seconds between two `TrafficReported`, in which equal refusals are counted together."""

    refusals: int = 100
    """The number of different refusals that are reported one by one in that time; the rest are counted by host."""

    def __post_init__(self) -> None:
        if self.message_bytes < MIB:
            raise ValueError(f"message_bytes is {self.message_bytes}; it must be at least {MIB}")
