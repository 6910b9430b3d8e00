"""The gate of the witness, which answers requests that are authentic and new. No I/O."""

import re
from typing import Any, Dict, Optional, Tuple

from appliance.features.standby.witness.lease_rules import Witness
from appliance.features.standby.witness.protocol import (
    ANSWER,
    FLAP_SECONDS,
    LONGEST_REPORT,
    OPERATIONS,
    REQUEST,
    is_count,
    name_in,
    seal,
    unseal,
)
from appliance.features.standby.witness.settings import AppliancePeer

_NOT_REPORTED = re.compile(r"[^ !#-\[\]-~]")  # an escaped character would need more bytes of a datagram


class WitnessGate:
    """Checks datagrams: each request is authenticated, and newer than all earlier ones of its appliance.

    A request has the witness's nonce of this start, which no earlier recording can have, and a rising number. An
    old nonce or number is answered with the present ones. A follower's request may have a `report` of its troubles,
    which the answers to the appliances repeat.

    """

    def __init__(
        self,
        witness: Witness,
        appliances: Dict[str, AppliancePeer],
        nonce: str,
        followers: Optional[Dict[str, AppliancePeer]] = None,
    ) -> None:
        self._witness = witness
        self._appliances = appliances
        self._peers = dict(followers or {})
        self._peers.update(appliances)
        self._nonce = nonce
        self._last = dict.fromkeys(self._peers, 0)
        self._reports = {}  # type: Dict[str, Tuple[float, str]]
        self.rejected = 0
        self.fresh = ""  # the name in the last datagram, if it was authentic and new

    def answer(self, datagram: bytes, address: str) -> Optional[bytes]:
        name, self.fresh = name_in(datagram), ""
        peer = self._peers.get(name)
        body = None
        if peer is not None and peer.address == address:
            body = unseal(REQUEST, peer.key, datagram)
        if peer is None or body is None or not (self._well_formed(body) and self._allowed(name, body)):
            self.rejected += 1
            return None
        return seal(ANSWER, name, peer.key, self._answer(name, body))

    def _allowed(self, name: str, body: Dict[str, Any]) -> bool:
        """Return whether this peer may request the operation. A follower cannot change the lease."""
        return name in self._appliances or body["do"] == "look"

    def _well_formed(self, body: Dict[str, Any]) -> bool:
        return (
            set(body) - {"report"} == {"boot", "session", "number", "do", "epoch"}
            and isinstance(body.get("report", ""), str)
            and all(isinstance(body[field], str) and len(body[field]) <= 32 for field in ("boot", "session"))
            and is_count(body["number"])
            and is_count(body["epoch"])
            and body["do"] in OPERATIONS
        )

    def _answer(self, name: str, body: Dict[str, Any]) -> Dict[str, Any]:
        answer = {"boot": self._nonce, "session": body["session"], "number": body["number"]}  # type: Dict[str, Any]
        if body["boot"] != self._nonce or body["number"] <= self._last[name]:
            answer.update(stale=True, last=self._last[name])
            return answer
        self._last[name] = body["number"]
        self.fresh = name
        other = next(iter(set(self._appliances) - {name}))  # not used for `look`, the operation of followers
        reason = self._witness.handle(name, body["do"], body["epoch"], other)
        record = self._witness.record
        answer.update(
            ok=not reason,
            reason=reason[:200].encode("ascii", "replace").decode("ascii"),
            epoch=record.epoch if record is not None else 0,
            holder=record.holder if record is not None else "",
            in_sync=[]
            if record is None
            else sorted(self._appliances if self._witness.unsettled else record.in_sync),
            expired=not self._witness.left(),
            trouble=self._witness.trouble[:200].encode("ascii", "replace").decode("ascii"),
        )
        if name in self._appliances:
            answer.update(followers=self._reported())
            return answer
        self._reports[name] = (
            self._witness.now(),
            _NOT_REPORTED.sub("?", body.get("report", ""))[:LONGEST_REPORT],
        )
        admitted = self._witness.admitted
        answer.update(
            admitted=admitted if admitted in self._appliances else "",
            left=int(self._witness.left() * 1000),
            reports=True,
        )
        return answer

    def _reported(self) -> str:
        """Return the troubles of the followers. The last one of a follower that is silent now is repeated for a
        minute.
        """
        since = self._witness.now() - FLAP_SECONDS
        found = [
            "%s: %s" % (name, text)
            for name, (at, text) in sorted(self._reports.items())
            if text and at > since
        ]
        return "; ".join(found)[:LONGEST_REPORT]
