"""Identify the caller of a request: a robot by its certificate, an operator by a token."""

from collections.abc import Callable

from fastapi import HTTPException, Request

from rosrv_fleet.robots import Robot, Robots
from rosrv_fleet.tokens import FleetRole, OperatorToken, Tokens

PEER_CERTIFICATE = "peer_certificate"
"""The key in the ASGI scope's `state` with the verified client certificate (DER)."""
COOKIE = "__Host-rosrv-fleet"
"""The console's cookie: only over TLS, for this host, for no script."""


def name_of(identify: Callable[[Request], Robot | OperatorToken]) -> Callable[[Request], str]:
    """Return the dependency that identifies the same caller, by name."""

    def named(request: Request) -> str:
        return identify(request).name

    return named


def robot_of(robots: Robots) -> Callable[[Request], Robot]:
    """Return the dependency that identifies a robot; it answers 403 for any other caller."""

    def identify(request: Request) -> Robot:
        certificate = request.scope.get("state", {}).get(PEER_CERTIFICATE)
        robot = None if certificate is None else robots.with_certificate(certificate)
        if robot is None:
            raise HTTPException(
                403, "this certificate belongs to no enrolled robot; run 'rosrv-fleet robot list'"
            )
        return robot

    return identify


def holder_of(tokens: Tokens, role: FleetRole) -> Callable[[Request], OperatorToken]:
    """Return the dependency that requires a token with this role; it answers 401 or 403 otherwise."""

    def identify(request: Request) -> OperatorToken:
        scheme, _, bearer = request.headers.get("authorization", "").partition(" ")
        text = bearer if scheme.lower() == "bearer" else request.cookies.get(COOKIE, "")
        holder = tokens.holder(text.strip()) if text else None
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
