"""Carry out sign-ons: OpenID Connect, authorization code with PKCE (RFC 7636, RFC 9700).

1. Each sign-on has its own random state, nonce and code verifier. A state is accepted once.
2. The keys of the browser's session are bound to the sign-on when it begins. So a stolen code, state or URL gives no
   other browser a session.
3. Beyond `_MOST` sign-ons, a new one replaces the oldest of the address that has most, so a flood from one address
   ends only its own. Before that, an address may have all: many people can have one.
"""

import base64
import hashlib
import json
import secrets
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple
from urllib.parse import quote, urlencode

from appliance.api.front.rates import peer_key
from appliance.base import clock
from appliance.features.sso.errors import ProviderError, SignOnRefusedError
from appliance.features.sso.id_token import Expected, verify
from appliance.features.sso.identity import identity_of
from appliance.features.sso.link import SessionKeys, SignedInPerson
from appliance.features.sso.provider import Provider, ProviderEndpoints
from appliance.features.sso.quotas import SIGN_ONS
from appliance.features.sso.settings import Sso

PENDING_SECONDS = 600.0
_MOST = SIGN_ONS.bounds.whole
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
        if len(self._pending) < _MOST:
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
