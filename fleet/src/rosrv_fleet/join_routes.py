"""Enrol robots that send an invitation's token, the key of their log and their certificate.

The certificate is self-signed, which proves that the sender has its private key. Every wrong token gets the same
answer, and an address (in IPv6 its /64 network) that sends many of them has to wait.
"""

from collections import deque

import msgspec
import structlog
from fastapi import APIRouter, HTTPException, Request, Response
from starlette.concurrency import run_in_threadpool

from appliance.base import clock
from appliance.formats.fleet_membership import JOIN_PATH, JoinRequest
from rosrv_fleet.collector import Collector
from rosrv_fleet.connections import owner_of
from rosrv_fleet.enrolment import EnrolmentError, Robot, require_own_signature
from rosrv_fleet.invitations import InvalidInvitationError, Invitations
from rosrv_fleet.request_body import read_body

_LONGEST = 16_384
_WRONG_PER_MINUTE = 30
_MOST_WRONG = 10_000
_log = structlog.get_logger()


def join_router(collector: Collector) -> APIRouter:
    router = APIRouter()
    invitations = Invitations(collector.config.data / "invitations")
    wrong = WrongTokens()

    @router.post(JOIN_PATH)
    async def join(request: Request) -> Response:
        """Enrol the robot that the token names. No certificate or other token is needed."""
        address = request.client.host if request.client else "127.0.0.1"
        wrong.require_patience(address)
        body = await read_body(request, _LONGEST)
        try:
            given = msgspec.json.decode(body, type=JoinRequest)
        except ValueError as error:
            raise HTTPException(422, f"not a request to join: {error}") from error
        try:
            robot = await run_in_threadpool(_enrol, collector, invitations, given)
        except InvalidInvitationError as error:
            wrong.add(address)
            _log.warning("an invitation was refused", address=address)
            raise HTTPException(403, str(error)) from error
        except EnrolmentError as error:
            raise HTTPException(409, str(error)) from error
        except OSError as error:
            _log.error("a robot was not enrolled", address=address, reason=str(error))
            raise HTTPException(503, "the collector cannot enrol robots now; see its log") from error
        _log.warning("a robot joined", robot=robot.name, address=address, certificate=robot.fingerprint)
        return Response(msgspec.json.encode({"robot": robot.name}), 201, media_type="application/json")

    return router


def _enrol(collector: Collector, invitations: Invitations, given: JoinRequest) -> Robot:
    certificate = given.certificate.encode()
    with invitations.using(given.token, msgspec.json.encode(given)) as pending:
        require_own_signature(certificate)
        return collector.robots.join(
            pending.name,
            given.key.encode(),
            certificate,
            pending.group,
            pending.appliance,
            again=bool(pending.request),
        )


class WrongTokens:
    """The wrong tokens of the last minute, by address or /64 network."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, str]] = deque(maxlen=_MOST_WRONG)

    def require_patience(self, address: str) -> None:
        """Raise `HTTPException` (429) if this address must wait."""
        while self._sent and clock.now() - self._sent[0][0] > 60.0:
            self._sent.popleft()
        owner = owner_of(address)
        if sum(sender == owner for _time, sender in self._sent) >= _WRONG_PER_MINUTE:
            raise HTTPException(429, "too many wrong invitations were sent", {"Retry-After": "60"})

    def add(self, address: str) -> None:
        self._sent.append((clock.now(), owner_of(address)))
