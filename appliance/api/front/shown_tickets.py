"""Remember the tickets of doors that peers showed. No I/O.

1. A wrong ticket counts once a minute for its peer: a page that was left open shows its ended ticket again and again,
   and must not keep the other pages of its address out. Control does not hear of the repetitions.
2. A ticket that opened its door is passed on even while its peer must wait for others of its address.
3. Tickets are remembered only as hashes under a random key of this process.
"""

import hashlib
import hmac
import secrets
from collections import OrderedDict

from appliance.api.front.access import TokenAuthenticator
from appliance.api.front.problems import ProblemError
from appliance.base import clock

_WRONG_SECONDS = 60.0
_MOST = 1024  # right ones, and as many wrong ones
_WRONG = "the ticket is wrong or over: ask the operator for a new one (rosrv door ticket NAME)"


class ShownTickets:
    """The tickets of all peers. Wrong ones count as the peer's failures at the `doorkeeper`."""

    def __init__(self, doorkeeper: TokenAuthenticator) -> None:
        self._doorkeeper = doorkeeper
        self._key = secrets.token_bytes(32)
        self._right: OrderedDict[bytes, float] = OrderedDict()
        self._wrong: OrderedDict[bytes, float] = OrderedDict()

    def require(self, peer: str, name: str, ticket: str) -> None:
        """Raise `ProblemError` (401, 429) if control need not be asked about this ticket now."""
        shown = self._digest(name, ticket)
        if clock.now() - self._wrong.get(shown, -_WRONG_SECONDS) < _WRONG_SECONDS:
            raise ProblemError(401, "not-recognised", _WRONG)
        if shown not in self._right:
            self._doorkeeper.require_patience(peer)

    def answered(self, peer: str, name: str, ticket: str, *, valid: bool) -> None:
        shown = self._digest(name, ticket)
        self._doorkeeper.noted(peer, valid=valid)
        for kept in (self._right, self._wrong):
            kept.pop(shown, None)
        kept = self._right if valid else self._wrong
        kept[shown] = clock.now()
        if len(kept) > _MOST:
            kept.popitem(last=False)

    def _digest(self, name: str, ticket: str) -> bytes:
        return hmac.digest(self._key, f"{name}\0{ticket}".encode("utf-8", "replace"), hashlib.sha256)
