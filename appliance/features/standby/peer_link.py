"""The datagrams between two appliances, each authenticated with a shared key.

A promise repeats the nonce and the number of its request. An active appliance uses one nonce per epoch, so a request
is new only if it has a greater epoch, or the same nonce and a greater number.
"""

import msgspec

from appliance.features.standby.lease import ClaimPromise, PeerMessage, PromiseRequest, TakeOver
from appliance.features.standby.witness.protocol import HIGHEST, name_in, seal, unseal

PURPOSES: dict[type[PeerMessage], bytes] = {
    PromiseRequest: b"rosrv promise request 1\0",
    ClaimPromise: b"rosrv promise 1\0",
    TakeOver: b"rosrv take over 1\0",
}


class PeerChannel:
    """Seals and unseals the datagrams of one end."""

    def __init__(self, name: str, other: str, key: bytes) -> None:
        self._name = name
        self._other = other
        self._key = key
        self._last: PromiseRequest | None = None

    def write(self, message: PeerMessage) -> bytes:
        return seal(PURPOSES[type(message)], self._name, self._key, msgspec.to_builtins(message))

    def read(self, datagram: bytes) -> PeerMessage | None:
        if name_in(datagram) != self._other:
            return None
        for kind, purpose in PURPOSES.items():
            body = unseal(purpose, self._key, datagram)
            if body is not None:
                try:
                    message = msgspec.convert(body, kind)
                except msgspec.ValidationError:
                    return None
                fits = 0 <= message.epoch <= HIGHEST and 0 <= message.number <= HIGHEST
                return message if fits and self._is_new(message) else None
        return None

    def _is_new(self, message: PeerMessage) -> bool:
        if not isinstance(message, PromiseRequest):
            return True  # the caller compares a promise or order with its request
        last = self._last
        new = (
            last is None
            or message.epoch > last.epoch
            or (
                (message.epoch, message.session) == (last.epoch, last.session)
                and message.number > last.number
            )
        )
        if new:
            self._last = message
        return new
