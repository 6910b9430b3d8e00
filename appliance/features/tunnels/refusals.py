"""Parse refusals in charon's log, which reports refused tunnels only there. No I/O.

One worker thread handles a packet from arrival to answer, so the lines of that thread in between belong to the
packet. If ESP runs in charon, the log also has packets that a tunnel dropped.
"""

import re
from collections import Counter
from dataclasses import dataclass, field

_LINE = re.compile(r"(\d\d)\[[A-Z]{3}\] (.*+)")
_ARRIVED = re.compile(r"received packet: from ([^\s\[]++)\[\d++\] to ")
_REFUSED = re.compile(
    r"generating (IKE_\S++) response \d++ \[ (?:.{0,2000} )?N\((AUTH_FAILED|NO_PROP|FAIL_CP_REQ|TS_UNACCEPT)\)"
)
_SENT_AGAIN = re.compile(r"  src ([^\s,]++), dst [^\s,]++, SPI [0-9a-f]{8}")
_UNDER_ANOTHERS = re.compile(
    r"discarding inbound IP packet ([0-9a-fA-F.:]++)(?:\[\d++\])? == \S++ .{0,2000}due to policy"
)
_REASONS = (
    "revoked",
    "no issuer certificate found",
    "no trusted",
    "no matching peer config",
    "no IKE config found",
    "constraint check failed",
    "validation failed",
    "subject certificate invalid",
    "signature",
    "no acceptable proposal found",
    "received proposals",
    "certificate status",
    "is not valid",
)
_WORDS = {
    "AUTH_FAILED": "authentication failed",
    "NO_PROP": "no acceptable proposal",
    "FAIL_CP_REQ": "no address for it",
    "TS_UNACCEPT": "traffic that is not allowed",
}
_LONGEST = 400


@dataclass(frozen=True)
class Refusal:
    """A refusal in charon's log. `packet`: a packet of a tunnel was dropped; otherwise a request was refused.

    `answered`: the sender has answered charon at this address, so it is not forged.
    """

    remote: str
    reason: str
    packet: bool = False
    answered: bool = False


@dataclass
class _Packet:
    remote: str
    reasons: list[str] = field(default_factory=list)


class RefusalParser:
    """Reads the log line by line."""

    def __init__(self) -> None:
        self._packets: dict[str, _Packet] = {}  # by worker thread; charon has 16 threads

    def read(self, line: str) -> Refusal | None:
        match = _LINE.match(line)
        if match is None:
            return None
        thread, text = match[1], match[2]
        if line[2:7] == "[ESP]":
            return _packet(text)
        arrived = _ARRIVED.match(text)
        if arrived is not None:
            self._packets[thread] = _Packet(arrived[1])
            return None
        packet = self._packets.get(thread)
        if packet is None:
            return None
        refused = _REFUSED.match(text)
        if refused is None:
            if any(reason in text for reason in _REASONS):
                packet.reasons.append(text.strip())
            return None
        del self._packets[thread]
        reasons = "; ".join([_WORDS[refused[2]], *packet.reasons])
        return Refusal(packet.remote, reasons[:_LONGEST], answered=refused[1] != "IKE_SA_INIT")


REFUSALS_PER_SECOND = 20
UNANSWERED_PER_SECOND = 10  # of these, from addresses that may be forged
REFUSALS_OF_A_SOURCE = 2  # per second
REFUSED_SOURCES = 20  # most sources that one report names


class RefusalShares:
    """Chooses the refused requests to pass on, so that no unknown host hides those of others; counts the rest."""

    def __init__(self) -> None:
        self._second = 0
        self._passed: Counter[str] = Counter()  # in this second, by source
        self._unanswered = 0
        self._rest: Counter[str] = Counter()

    def passes(self, refusal: Refusal, now: float) -> bool:
        if int(now) != self._second:
            self._second, self._unanswered = int(now), 0
            self._passed.clear()
        if (
            self._passed.total() < REFUSALS_PER_SECOND
            and self._passed[refusal.remote] < REFUSALS_OF_A_SOURCE
            and (refusal.answered or self._unanswered < UNANSWERED_PER_SECOND)
        ):
            self._passed[refusal.remote] += 1
            self._unanswered += not refusal.answered
            return True
        named = refusal.remote in self._rest or len(self._rest) < REFUSED_SOURCES
        self._rest[refusal.remote if named else ""] += 1
        return False

    def rest(self) -> list[Refusal]:
        """Return what did not pass since the last call, a refusal for each source; the last may have none."""
        refusals = [
            Refusal(remote, f"{count} more {'request was' if count == 1 else 'requests were'} refused")
            for remote, count in self._rest.items()
        ]
        self._rest.clear()
        return refusals


def _packet(text: str) -> Refusal | None:
    again = _SENT_AGAIN.match(text)
    if again is not None:
        return Refusal(again[1], "a packet of a tunnel was replayed", packet=True)
    anothers = _UNDER_ANOTHERS.match(text)
    if anothers is not None:
        return Refusal(
            anothers[1], "a packet from this address came through another host's tunnel", packet=True
        )
    return None
