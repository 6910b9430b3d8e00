"""Fetch the provider's endpoints and keys, and bound their age.

1. A discovery document of another issuer is not used (OpenID Connect Discovery 1.0, 4.3).
2. Keys are fetched for each ID token, so an added or withdrawn key counts at once. While the provider serves no keys,
   the last ones are used for `keys_seconds`.
"""

import json
from collections.abc import Sequence
from typing import Any

import msgspec

from appliance.base import clock
from appliance.features.sso.errors import ProviderError
from appliance.features.sso.provider_connection import Exchange
from appliance.features.sso.settings import origin_of

_FRESH_SECONDS = 3600.0
_MOST_KEYS = 100
_DISCOVERY = "/.well-known/openid-configuration"
_OK = 200


class ProviderEndpoints(msgspec.Struct, frozen=True):
    """The used parts of the discovery document."""

    issuer: str
    authorization_endpoint: str
    token_endpoint: str
    jwks_uri: str
    token_endpoint_auth_methods_supported: tuple[str, ...] = ("client_secret_basic",)
    code_challenge_methods_supported: tuple[str, ...] | None = None
    authorization_response_iss_parameter_supported: bool = False


class Provider:
    """The provider with this issuer. Methods raise `ProviderError`."""

    def __init__(self, issuer: str, exchange: Exchange, keys_seconds: float) -> None:
        self.issuer = issuer
        self._exchange = exchange
        self._keys_seconds = keys_seconds
        self._endpoints: tuple[float, ProviderEndpoints] | None = None
        self._keys: tuple[float, list[dict[str, Any]]] | None = None

    async def endpoints(self) -> ProviderEndpoints:
        """Return the endpoints, at most an hour old."""
        if self._endpoints is None or clock.now() - self._endpoints[0] >= _FRESH_SECONDS:
            url = self.issuer.removesuffix("/") + _DISCOVERY
            try:
                found = msgspec.json.decode(await self._get(url), type=ProviderEndpoints)
                for place in (found.authorization_endpoint, found.token_endpoint, found.jwks_uri):
                    origin_of(place)
            except ValueError as error:
                raise ProviderError(f"{url}: not a usable discovery document: {error}") from None
            if found.issuer != self.issuer:
                raise ProviderError(
                    f"{url}: the document is of issuer {found.issuer[:200]!r}: correct sso.issuer"
                )
            methods = found.code_challenge_methods_supported
            if methods is not None and "S256" not in methods:
                raise ProviderError(f"{url}: the provider does not support PKCE with S256")
            self._endpoints = clock.now(), found
        return self._endpoints[1]

    async def keys(self) -> Sequence[dict[str, Any]]:
        now = clock.now()
        try:
            self._keys = now, await self._fetch_keys()
        except ProviderError:
            if self._keys is None or now - self._keys[0] >= self._keys_seconds:
                raise
        return self._keys[1]

    async def post(self, url: str, headers: Sequence[tuple[str, str]], body: bytes) -> tuple[int, bytes]:
        return await self._exchange("POST", url, headers, body)

    async def _fetch_keys(self) -> list[dict[str, Any]]:
        url = (await self.endpoints()).jwks_uri
        try:
            found = json.loads(await self._get(url))["keys"]
            if not isinstance(found, list) or len(found) > _MOST_KEYS:
                raise ValueError(f"`keys` is not a list of at most {_MOST_KEYS} keys")
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ProviderError(f"{url}: not a set of keys: {error}") from None
        return [key for key in found if isinstance(key, dict)]

    async def _get(self, url: str) -> bytes:
        status, body = await self._exchange("GET", url, (), b"")
        if status != _OK:
            raise ProviderError(f"{url}: the provider answers {status}")
        return body
