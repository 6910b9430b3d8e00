import functools
import hashlib
import json
from base64 import urlsafe_b64encode
from typing import Any
from urllib.parse import parse_qs, parse_qsl, urlsplit

from joserfc import jwt
from joserfc.jwk import ECKey, RSAKey

from appliance.base import clock
from appliance.features.sso.errors import ProviderError
from appliance.features.sso.link import SessionKeys
from appliance.features.sso.provider import Provider
from appliance.features.sso.provider_connection import Headers, ProviderAnswer
from appliance.features.sso.settings import Sso
from appliance.features.sso.sign_on import SignOns

ISSUER, CLIENT = "https://id.example.org/plant", "rosrv"
KEYS = SessionKeys("0123456789ab", b"r" * 32, b"v" * 32)
Key = RSAKey | ECKey


ROLES = {"viewer": ["staff"], "operator": ["crew"], "admin": ["chiefs"], "investigator": ["audit"]}
WANTED = {
    "issuer": ISSUER, "address": "10.0.0.5:443", "client_id": CLIENT, "url": "https://robot.example.org:8443",
    "roles": ROLES, "doors": {"floor": ["crew", "guests"]},
}  # fmt: skip


def sso(**given: Any) -> Sso:
    return Sso(**{**WANTED, **given})


@functools.cache
def rsa(name: str) -> RSAKey:
    return RSAKey.generate_key(2048, {"kid": name, "use": "sig"})


@functools.cache
def ec(name: str, curve: str = "P-256") -> ECKey:
    return ECKey.generate_key(curve, {"kid": name, "use": "sig"})


def public(*keys: Key) -> list[dict[str, Any]]:
    return [dict(key.as_dict(private=False)) for key in keys]


def claims(**other: Any) -> dict[str, Any]:
    now = int(clock.wall())
    given = {"iss": ISSUER, "aud": CLIENT, "sub": "u-1", "iat": now, "exp": now + 3600, "groups": ["crew"]}
    return {name: value for name, value in {**given, **other}.items() if value is not None}


def token(payload: dict[str, Any], key: Key, header: dict[str, Any] | None = None) -> str:
    chosen = {"alg": "ES256" if isinstance(key, ECKey) else "RS256", "kid": key.kid, **(header or {})}
    chosen = {name: value for name, value in chosen.items() if value is not None}
    return jwt.encode(chosen, payload, key, algorithms=[chosen["alg"]])


def part(value: Any) -> str:
    data = value if isinstance(value, bytes) else json.dumps(value).encode()
    return urlsafe_b64encode(data).decode().rstrip("=")


class ScriptedProvider:
    """A provider. `payload`, `header` and `key` make the next ID token; `down` names endpoints without an answer."""

    def __init__(self, wanted: Sso | None = None, secret: str | None = "s3:cret") -> None:  # noqa: S107  of a test
        self.wanted = wanted or sso()
        self.key: Key = rsa("one")
        self.served = [self.key]
        self.payload: dict[str, Any] = {}
        self.header: dict[str, Any] = {}
        self.metadata: dict[str, Any] = {
            "issuer": ISSUER,
            "authorization_endpoint": f"{ISSUER}/authorize",
            "token_endpoint": f"{ISSUER}/token",
            "jwks_uri": f"{ISSUER}/keys",
        }
        self.answers: dict[str, ProviderAnswer] = {}  # by endpoint: in place of the usual one
        self.down: set[str] = set()
        self.requests: list[str] = []
        self.form: dict[str, str] = {}
        self.headers: dict[str, str] = {}
        self.asked: dict[str, str] = {}  # of the last authorization request
        provider = Provider(ISSUER, self.exchange, self.wanted.keys_hours * 3600)
        self.sign_ons = SignOns(self.wanted, provider, lambda: secret)

    async def exchange(self, method: str, url: str, headers: Headers, body: bytes) -> ProviderAnswer:
        place = url.rpartition("/")[2]
        self.requests.append(place)
        if place in self.down:
            raise ProviderError(f"{url}: no answer")
        if place in self.answers:
            return self.answers[place]
        if place == "openid-configuration":
            return ProviderAnswer(200, json.dumps(self.metadata).encode())
        if place == "keys":
            return ProviderAnswer(200, json.dumps({"keys": public(*self.served)}).encode())
        assert (method, place) == ("POST", "token")
        self.form, self.headers = dict(parse_qsl(body.decode())), dict(headers)
        challenge = part(hashlib.sha256(self.form["code_verifier"].encode()).digest())
        if challenge != self.asked["code_challenge"]:
            return ProviderAnswer(400, b'{"error": "invalid_grant"}')
        signed = token(claims(nonce=self.asked["nonce"], **self.payload), self.key, self.header)
        return ProviderAnswer(200, json.dumps({"id_token": signed}).encode())

    async def begin(self, address: str = "10.0.0.9", *, again: bool = False) -> str:
        url, state = await self.sign_ons.begin(KEYS, address, again=again)
        assert url.startswith(self.metadata["authorization_endpoint"])
        self.asked = {name: values[0] for name, values in parse_qs(urlsplit(url).query).items()}
        return state
