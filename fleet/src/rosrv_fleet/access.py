"""Identify the caller of a request: a robot by its certificate, an operator by a token.

The functions are coroutines, because FastAPI would call others in a thread, which costs more than their work.
"""

from collections.abc import Awaitable, Callable

from fastapi import HTTPException, Request

from rosrv_fleet.enrolment import Robot
from rosrv_fleet.robots import Robots
from rosrv_fleet.tokens import FleetRole, OperatorToken, OperatorTokens

PEER_CERTIFICATE = "peer_certificate"
"""The key in the ASGI scope's `state` with the verified client certificate (DER)."""
COOKIE = "__Host-rosrv-fleet"
"""The console's cookie: sent only over TLS and to this host, and hidden from scripts."""


def name_of(
    identify: Callable[[Request], Awaitable[Robot | OperatorToken]],
) -> Callable[[Request], Awaitable[str]]:
    async def named(request: Request) -> str:
        return (await identify(request)).name

    return named


def certificate_of(request: Request) -> bytes | None:
    found: bytes | None = request.scope.get("state", {}).get(PEER_CERTIFICATE)
    return found


def robot_of(robots: Robots) -> Callable[[Request], Awaitable[Robot]]:
    """Return a dependency that identifies the robot, and answers 403 to any other caller."""

    async def identify(request: Request) -> Robot:
        certificate = certificate_of(request)
        robot = None if certificate is None else robots.with_certificate(certificate)
        if robot is None:
            raise HTTPException(
                403, "this certificate belongs to no enrolled robot; run 'rosrv-fleet robot list'"
            )
        return robot

    return identify


def token_of(request: Request) -> str:
    scheme, _, bearer = request.headers.get("authorization", "").partition(" ")
    text = bearer if scheme.lower() == "bearer" else request.cookies.get(COOKIE, "")
    return text.strip()


def holder_of(tokens: OperatorTokens, role: FleetRole) -> Callable[[Request], Awaitable[OperatorToken]]:
    """Return a dependency that identifies the operator: 401 without a valid token, 403 if its role is too low."""

    async def identify(request: Request) -> OperatorToken:
        text = token_of(request)
        holder = tokens.holder(text) if text else None
        if holder is None:
            raise HTTPException(
                401,
                "a token is missing or unknown; make one: rosrv-fleet token add",
                {"WWW-Authenticate": "Bearer"},
            )
        if not holder.may(role):
            raise HTTPException(403, f"the token {holder.name} has the role {holder.role}; this needs {role}")
        return holder

    return identify
