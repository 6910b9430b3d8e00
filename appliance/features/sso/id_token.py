"""Verify an ID token (OpenID Connect Core 1.0, 3.1.3.7). No I/O; the time is a parameter.

Only a key of the provider that fits the token's algorithm in kind, curve and use verifies it. `jwk`, `jku` and `x5u`
in the token are ignored, and a symmetric key is never used. Issuer, audience, nonce, subject, expiry and time of
issue are required. The claims are parsed only after the signature is verified.
"""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from joserfc import jwt
from joserfc.errors import ClaimError, JoseError
from joserfc.jwk import ECKey, RSAKey
from joserfc.jws import JWSRegistry

from appliance.features.sso.errors import SignOnRefusedError

_LONGEST, _LONGEST_HEADER = 262_144, 32_768  # characters: a person with some thousand groups
_OLDEST_SECONDS = 600.0  # since the time of issue: the token comes from an exchange that has just happened
_LEAST_RSA_BITS = 2048
_LONGEST_SUBJECT = 255
_LATEST = 1e11  # seconds since the epoch
_CURVES = {"ES256": "P-256", "ES384": "P-384", "ES512": "P-521"}
_CLOCKS = ": compare the clocks"
_ADVICE = {
    "aud": ": compare sso.client_id with the client at the provider",
    "exp": _CLOCKS,
    "iat": _CLOCKS,
    "nbf": _CLOCKS,
}
_PUBLIC = ("kty", "crv", "n", "e", "x", "y")


@dataclass(frozen=True)
class Expected:
    """The values that an ID token must have; `skew` is in seconds."""

    issuer: str
    client_id: str
    nonce: str
    algorithms: Sequence[str]
    skew: float


def verify(token: str, keys: Sequence[dict[str, Any]], expected: Expected, now: float) -> dict[str, Any]:
    header = _header_of(token, expected.algorithms)
    key = _key_for(header, keys)
    registry = JWSRegistry(algorithms=list(expected.algorithms), strict_check_header=False)
    registry.max_header_length, registry.max_payload_length = _LONGEST_HEADER, _LONGEST
    try:
        claims = jwt.decode(token, key, algorithms=[header["alg"]], registry=registry).claims
        _require_texts(claims, "iss", "nonce", "sub")
        jwt.JWTClaimsRegistry(
            now=int(now),
            leeway=int(expected.skew),
            iss={"essential": True, "value": expected.issuer},
            aud={"essential": True, "value": expected.client_id},
            nonce={"essential": True, "value": expected.nonce},
            sub={"essential": True},
            exp={"essential": True},
            iat={"essential": True},
        ).validate(claims)
    except ClaimError as error:
        raise _refused(f"{error}{_ADVICE.get(error.claim, '')}") from None
    except (JoseError, ValueError, TypeError, RecursionError) as error:
        raise _refused(f"{error}") from None
    _check_rest(claims, expected, now)
    return claims


def _check_rest(claims: dict[str, Any], expected: Expected, now: float) -> None:
    audience = claims["aud"]
    if (isinstance(audience, list) and len(audience) > 1 and "azp" not in claims) or (
        claims.get("azp", expected.client_id) != expected.client_id
    ):
        raise _refused("it was issued to another client (azp)")
    for name in ("exp", "iat", "nbf"):
        value = claims.get(name, 0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < _LATEST:
            raise _refused(f"{name} is not a time")
    if now - claims["iat"] > _OLDEST_SECONDS + expected.skew:
        raise _refused(f"it was issued more than {_OLDEST_SECONDS:g} s ago{_CLOCKS}")
    subject = claims["sub"]
    if not 0 < len(subject) <= _LONGEST_SUBJECT:
        raise _refused("sub is not 1 to 255 characters")


def _require_texts(claims: dict[str, Any], *names: str) -> None:
    """The library takes a list that contains the expected value for the value."""
    for name in names:
        if name in claims and not isinstance(claims[name], str):
            raise _refused(f"{name} is not a string")


def _header_of(token: str, algorithms: Sequence[str]) -> dict[str, Any]:
    if len(token) > _LONGEST:
        raise _refused(f"it has more than {_LONGEST} characters: let the provider put fewer groups into it")
    if not token.isascii() or token.count(".") != 2:
        raise _refused("it is not a signed token with three parts")
    text = token.partition(".")[0]
    if len(text) > _LONGEST_HEADER:
        raise _refused(f"its header has more than {_LONGEST_HEADER} characters")
    try:
        header = json.loads(_decoded(text))
    except (ValueError, RecursionError):
        raise _refused("its header is not JSON") from None
    if not isinstance(header, dict) or not isinstance(header.get("kid", ""), str):
        raise _refused("its header is not a JSON object, or its kid is not a string")
    if header.get("alg") not in algorithms:
        raise _refused(
            f"it is signed with {str(header.get('alg'))[:20]!r}; sso.algorithms has {', '.join(algorithms)}"
        )
    if "crit" in header or "b64" in header:
        raise _refused("its header requires an extension (crit)")
    return header


def _key_for(header: dict[str, Any], keys: Sequence[dict[str, Any]]) -> RSAKey | ECKey:
    algorithm = header["alg"]
    curve = _CURVES.get(algorithm)
    fitting = [
        key
        for key in keys
        if key.get("kty") == ("EC" if curve else "RSA")
        and key.get("crv") == curve
        and key.get("use", "sig") == "sig"
        and key.get("alg", algorithm) == algorithm
        and ("kid" not in header or key.get("kid") == header["kid"])
    ]
    if len(fitting) != 1:
        named = f"key {header['kid'][:100]!r}" if "kid" in header else "no key"
        raise _refused(f"it names {named}, and the provider has {len(fitting)} keys that fit")
    public = {name: fitting[0][name] for name in _PUBLIC if name in fitting[0]}
    try:
        if not curve and 8 * len(_decoded(public["n"]).lstrip(b"\0")) < _LEAST_RSA_BITS:
            raise _refused(
                f"the provider's key has less than {_LEAST_RSA_BITS} bits: let it use a longer one"
            )
        return ECKey.import_key(public) if curve else RSAKey.import_key(public)
    except (JoseError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise _refused(f"the provider's key cannot be used: {error}") from None


def _decoded(text: str) -> bytes:
    return base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))


def _refused(reason: str) -> SignOnRefusedError:
    return SignOnRefusedError(f"the provider's ID token is not accepted: {reason}")
