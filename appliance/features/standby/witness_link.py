"""The datagrams between an appliance and the witness."""

from typing import Annotated

import msgspec

from appliance.features.standby.lease import WitnessAnswer, WitnessRequest
from appliance.features.standby.witness.protocol import ANSWER, HIGHEST, REQUEST, name_in, seal, unseal

_MOST_PENDING = 32

_Count = Annotated[int, msgspec.Meta(ge=0, le=HIGHEST)]


class _AnswerBody(msgspec.Struct, frozen=True):
    boot: str
    session: str
    number: _Count
    stale: bool = False
    last: _Count = 0
    ok: bool = False
    reason: str = ""
    epoch: _Count = 0
    holder: str = ""
    in_sync: frozenset[str] = frozenset()
    expired: bool = False
    trouble: str = ""
    followers: str = ""


class WitnessChannel:
    """Writes requests and reads answers. `session` is a nonce of this process, so no earlier answer has it."""

    def __init__(self, name: str, key: bytes, session: str) -> None:
        self._name = name
        self._key = key
        self._session = session
        self._boot = ""
        self._number = 0
        self._pending: dict[int, WitnessRequest] = {}

    def write(self, request: WitnessRequest) -> bytes:
        self._number += 1
        self._pending[self._number] = request
        if len(self._pending) > _MOST_PENDING:
            del self._pending[next(iter(self._pending))]
        body = {
            "boot": self._boot,
            "session": self._session,
            "number": self._number,
            "do": request.operation,
            "epoch": request.epoch,
        }
        return seal(REQUEST, self._name, self._key, body)

    def read(self, datagram: bytes) -> tuple[WitnessRequest, WitnessAnswer] | None:
        """Return an answer with its request.

        If the nonce or number of the request was old, the answer has only the present ones, for the next request.
        """
        if name_in(datagram) != self._name:
            return None
        try:
            body = msgspec.convert(unseal(ANSWER, self._key, datagram), _AnswerBody)
        except msgspec.ValidationError:
            return None
        request = self._pending.pop(body.number, None) if body.session == self._session else None
        if request is None:
            return None
        if body.stale:
            self._boot, self._number = body.boot, max(self._number, body.last)
            return None
        answer = WitnessAnswer(
            body.ok,
            body.reason,
            body.epoch,
            body.holder,
            body.in_sync,
            body.expired,
            body.trouble,
            body.followers,
        )
        return request, answer
