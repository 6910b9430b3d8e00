"""Carry out sign-ons: OpenID Connect, authorization code with PKCE (RFC 7636, RFC 9700).

1. Each sign-on has its own random state, nonce and code verifier. A state is accepted once.
2. The keys of the browser's session are bound to the sign-on when it begins. So a stolen code, state or URL gives no
   other browser a session.
3. Beyond `_MAX` sign-ons, a new one replaces the oldest of the address that has most, so a flood from one address
   ends only its own. Before that, an address may have all: many people can have one.
"""

import base64
import hashlib
import json
import secrets
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple
from urllib.parse import quote, urlencode

from joserfc import jwt
from joserfc.errors import ClaimError, JoseError
from joserfc.jwk import ECKey, RSAKey
from joserfc.jws import JWSRegistry

from appliance.base import clock
from appliance.features.sso.errors import ProviderError, SignOnRefusedError
from appliance.features.sso.identity import identity_of
from appliance.features.sso.link import SessionKeys, SignedInPerson
from appliance.features.sso.provider import Provider, ProviderEndpoints
from appliance.features.sso.quotas import SIGN_ONS
from appliance.features.sso.settings import Sso
from appliance.quotas.peers import peer_key

# Verify an ID token (OpenID Connect Core 1.0, 3.1.3.7). No I/O; the time is a parameter.
#
# Only a key of the provider that fits the token's algorithm in kind, curve and use verifies it. `jwk`, `jku` and `x5u`
# in the token are ignored, and a symmetric key is never used. Issuer, audience, nonce, subject, expiry and time of
# issue are required. The claims are parsed only after the signature is verified.

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
        raise _refusal(f"{error}{_ADVICE.get(error.claim, '')}") from None
    except (JoseError, ValueError, TypeError, RecursionError) as error:
        raise _refusal(f"{error}") from None
    _check_rest(claims, expected, now)
    return claims


def _check_rest(claims: dict[str, Any], expected: Expected, now: float) -> None:
    audience = claims["aud"]
    if (isinstance(audience, list) and len(audience) > 1 and "azp" not in claims) or (
        claims.get("azp", expected.client_id) != expected.client_id
    ):
        raise _refusal("it was issued to another client (azp)")
    for name in ("exp", "iat", "nbf"):
        value = claims.get(name, 0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < _LATEST:
            raise _refusal(f"{name} is not a time")
    if now - claims["iat"] > _OLDEST_SECONDS + expected.skew:
        raise _refusal(f"it was issued more than {_OLDEST_SECONDS:g} s ago{_CLOCKS}")
    subject = claims["sub"]
    if not 0 < len(subject) <= _LONGEST_SUBJECT:
        raise _refusal("sub is not 1 to 255 characters")


def _require_texts(claims: dict[str, Any], *names: str) -> None:
    """The library takes a list that contains the expected value for the value."""
    for name in names:
        if name in claims and not isinstance(claims[name], str):
            raise _refusal(f"{name} is not a string")


def _header_of(token: str, algorithms: Sequence[str]) -> dict[str, Any]:
    if len(token) > _LONGEST:
        raise _refusal(f"it has more than {_LONGEST} characters: let the provider put fewer groups into it")
    if not token.isascii() or token.count(".") != 2:
        raise _refusal("it is not a signed token with three parts")
    text = token.partition(".")[0]
    if len(text) > _LONGEST_HEADER:
        raise _refusal(f"its header has more than {_LONGEST_HEADER} characters")
    try:
        header = json.loads(_decode(text))
    except (ValueError, RecursionError):
        raise _refusal("its header is not JSON") from None
    if not isinstance(header, dict) or not isinstance(header.get("kid", ""), str):
        raise _refusal("its header is not a JSON object, or its kid is not a string")
    if header.get("alg") not in algorithms:
        raise _refusal(
            f"it is signed with {str(header.get('alg'))[:20]!r}; sso.algorithms has {', '.join(algorithms)}"
        )
    if "crit" in header or "b64" in header:
        raise _refusal("its header requires an extension (crit)")
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
        raise _refusal(f"it names {named}, and the provider has {len(fitting)} keys that fit")
    public = {name: fitting[0][name] for name in _PUBLIC if name in fitting[0]}
    try:
        if not curve and 8 * len(_decode(public["n"]).lstrip(b"\0")) < _LEAST_RSA_BITS:
            raise _refusal(
                f"the provider's key has less than {_LEAST_RSA_BITS} bits: let it use a longer one"
            )
        return ECKey.import_key(public) if curve else RSAKey.import_key(public)
    except (JoseError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise _refusal(f"the provider's key cannot be used: {error}") from None


def _decode(text: str) -> bytes:
    return base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))


def _refusal(reason: str) -> SignOnRefusedError:
    return SignOnRefusedError(f"the provider's ID token is not accepted: {reason}")


PENDING_SECONDS = 600.0
_MAX = SIGN_ONS.bounds.whole
_LONGEST_CODE = 4096
_OK = 200


class _Pending(NamedTuple):
    keys: SessionKeys
    address: str
    nonce: str
    verifier: str
    until: float


class SignOns:
    """The unfinished sign-ons; `secret()` returns the client's secret, if any."""

    def __init__(self, wanted: Sso, provider: Provider, secret: Callable[[], str | None]) -> None:
        self._wanted = wanted
        self._provider = provider
        self._secret = secret
        self._pending: dict[str, _Pending] = {}  # by state, oldest first

    async def begin(self, keys: SessionKeys, address: str, *, again: bool) -> tuple[str, str]:
        endpoints = await self._provider.endpoints()
        state, nonce, verifier = (secrets.token_urlsafe(32) for _ in range(3))
        self._make_room(address)
        self._pending[state] = _Pending(keys, address, nonce, verifier, clock.now() + PENDING_SECONDS)
        asked = {
            "response_type": "code",
            "client_id": self._wanted.client_id,
            "redirect_uri": self._wanted.redirect_uri,
            "scope": " ".join(self._wanted.scopes),
            "state": state,
            "nonce": nonce,
            "code_challenge": _text(hashlib.sha256(verifier.encode()).digest()),
            "code_challenge_method": "S256",
            **({"prompt": "login"} if again else {}),
        }
        url = endpoints.authorization_endpoint
        return f"{url}{'&' if '?' in url else '?'}{urlencode(asked, quote_via=quote)}", state

    async def finish(self, state: str, code: str, issuer: str) -> tuple[SignedInPerson, SessionKeys, str]:
        """Return the person, the session's keys and the address.

        `issuer` is the parameter `iss` of the response (RFC 9207), or empty.
        """
        pending = self._pending.pop(state, None)
        if pending is None or pending.until <= clock.now():
            raise SignOnRefusedError(
                "this sign-in was not begun here, was used, or took more than"
                f" {PENDING_SECONDS / 60:g} minutes: sign in again"
            )
        endpoints = await self._provider.endpoints()
        if issuer != self._provider.issuer and (
            issuer or endpoints.authorization_response_iss_parameter_supported
        ):
            raise SignOnRefusedError("the response is of another provider (iss): sign in again")
        if not 0 < len(code) <= _LONGEST_CODE:
            raise SignOnRefusedError("the provider sent the browser back without a code: sign in again")
        token = await self._token(endpoints, code, pending.verifier)
        keys = await self._provider.keys()
        expected = Expected(
            self._provider.issuer,
            self._wanted.client_id,
            pending.nonce,
            self._wanted.algorithms,
            self._wanted.clock_skew_seconds,
        )
        now = clock.wall()
        return (
            identity_of(verify(token, keys, expected, now), self._wanted, now),
            pending.keys,
            pending.address,
        )

    async def _token(self, endpoints: ProviderEndpoints, code: str, verifier: str) -> str:
        url, client = endpoints.token_endpoint, self._wanted.client_id
        form = {
            "grant_type": "authorization_code",
            "code": code,
            "redirect_uri": self._wanted.redirect_uri,
            "code_verifier": verifier,
        }
        headers = [("Content-Type", "application/x-www-form-urlencoded")]
        try:
            secret = self._secret()
        except (OSError, ValueError) as error:
            raise ProviderError(f"sso.client_secret_file cannot be read: {error}") from None
        if secret is None:
            form["client_id"] = client
        elif "client_secret_basic" in endpoints.token_endpoint_auth_methods_supported:
            pair = f"{quote(client, safe='')}:{quote(secret, safe='')}"
            headers.append(("Authorization", f"Basic {base64.b64encode(pair.encode()).decode()}"))
        elif "client_secret_post" in endpoints.token_endpoint_auth_methods_supported:
            form |= {"client_id": client, "client_secret": secret}
        else:
            raise ProviderError(
                f"{url}: the provider accepts a client's secret neither as Basic nor in the form: allow one of them"
                " there"
            )
        status, body = await self._provider.post(url, headers, urlencode(form).encode())
        answer = _json(body)
        if status != _OK:
            reason = ascii(f"{answer.get('error', '')} {answer.get('error_description', '')}".strip()[:300])[
                1:-1
            ]
            text = f"{url}: the provider answers {status}: {reason}"
            if answer.get("error") == "invalid_grant":
                raise SignOnRefusedError(f"{text}; sign in again")
            raise ProviderError(text)
        token = answer.get("id_token")
        if not isinstance(token, str):
            raise ProviderError(
                f"{url}: the provider's answer has no ID token: make the client there one of OpenID Connect"
            )
        return token

    def _make_room(self, address: str) -> None:
        now, peer = clock.now(), peer_key(address)
        self._pending = {state: one for state, one in self._pending.items() if one.until > now}
        if len(self._pending) < _MAX:
            return
        held = Counter({peer: 1})
        held.update(peer_key(one.address) for one in self._pending.values())
        most = max(held.values())
        peer = peer if held[peer] == most > 1 else held.most_common(1)[0][0]
        del self._pending[
            next(state for state, one in self._pending.items() if peer_key(one.address) == peer)
        ]


def _json(body: bytes) -> dict[str, object]:
    try:
        found = json.loads(body)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _text(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).decode().rstrip("=")
