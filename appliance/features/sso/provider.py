"""Fetch the provider's endpoints and keys, and bound their age.

1. A discovery document of another issuer is not used (OpenID Connect Discovery 1.0, 4.3).
2. Keys are fetched for each ID token, so an added or withdrawn key counts at once. While the provider serves no keys,
   the last ones are used for `keys_seconds`.
3. So are the endpoints, which are fetched each hour. A browser that begins to sign on causes that, so concurrent
   calls share one fetch, and a failed one is not repeated for `_AGAIN_SECONDS`.
"""

import asyncio
import json
from collections.abc import Sequence

import msgspec

from appliance.base import clock
from appliance.features.sso.errors import ProviderError
from appliance.features.sso.provider_connection import Exchange
from appliance.features.sso.settings import origin_of

_FRESH_SECONDS = 3600.0
_AGAIN_SECONDS = 5.0
_MAX_KEYS = 100
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
        self._failure: tuple[float, str] | None = None  # of the last fetch of the endpoints
        self._one_fetch = asyncio.Lock()
        self._keys: tuple[float, list[dict[str, object]]] | None = None

    async def endpoints(self) -> ProviderEndpoints:
        """Return the endpoints: an hour old at most, or as old as keys while the provider does not serve them."""
        async with self._one_fetch:
            known = self._endpoints
            if known is not None and clock.now() - known[0] < _FRESH_SECONDS:
                return known[1]
            failure = self._failure
            if failure is None or clock.now() - failure[0] >= _AGAIN_SECONDS:
                try:
                    endpoints = await self._discover()
                except ProviderError as error:
                    failure = self._failure = clock.now(), str(error)
                else:
                    self._endpoints, self._failure = (clock.now(), endpoints), None
                    return endpoints
            if known is None or clock.now() - known[0] >= self._keys_seconds:
                raise ProviderError(failure[1])
            return known[1]

    async def _discover(self) -> ProviderEndpoints:
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
            raise ProviderError(
                f"{url}: the provider does not support PKCE with S256: enable it there for this client"
            )
        return found

    async def keys(self) -> Sequence[dict[str, object]]:
        now = clock.now()
        try:
            self._keys = now, await self._fetch_keys()
        except ProviderError:
            if self._keys is None or now - self._keys[0] >= self._keys_seconds:
                raise
        return self._keys[1]

    async def post(self, url: str, headers: Sequence[tuple[str, str]], body: bytes) -> tuple[int, bytes]:
        return await self._exchange("POST", url, headers, body)

    async def _fetch_keys(self) -> list[dict[str, object]]:
        url = (await self.endpoints()).jwks_uri
        try:
            found = json.loads(await self._get(url))["keys"]
            if not isinstance(found, list) or len(found) > _MAX_KEYS:
                raise ValueError(f"`keys` is not a list of at most {_MAX_KEYS} keys")
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ProviderError(f"{url}: not a set of keys: {error}") from None
        return [key for key in found if isinstance(key, dict)]

    async def _get(self, url: str) -> bytes:
        status, body = await self._exchange("GET", url, (), b"")
        if status != _OK:
            raise ProviderError(f"{url}: the provider answers {status}")
        return body
