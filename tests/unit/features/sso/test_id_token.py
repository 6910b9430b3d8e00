import hmac
from collections.abc import Callable
from typing import Any

import pytest

from appliance.base import clock
from appliance.features.sso.errors import SignOnRefusedError
from appliance.features.sso.sign_on import Expected, verify
from tests.unit.features.sso.scripted_provider import CLIENT, ISSUER, claims, ec, part, public, rsa, token

NONCE = "n" * 43
EXPECTED = Expected(ISSUER, CLIENT, NONCE, ("RS256", "ES256"), 60.0)


def _claims(**other: Any) -> dict[str, Any]:
    return claims(**{"nonce": NONCE, **other})


def _signed(**other: Any) -> str:
    return token(_claims(**other), rsa("one"))


def _ago(seconds: float) -> int:
    return int(clock.wall() - seconds)


def _unsigned(header: dict[str, Any], signature: bytes = b"") -> str:
    return f"{part(header)}.{part(_claims())}.{part(signature)}"


def _hmac_with_public_key() -> str:
    text = f"{part({'alg': 'HS256', 'kid': 'one'})}.{part(_claims())}"
    return f"{text}.{part(hmac.digest(rsa('one').as_pem(private=False), text.encode(), 'sha256'))}"


def _changed_payload() -> str:
    header, _payload, signature = _signed().split(".")
    return f"{header}.{part(_claims(groups=['chiefs']))}.{signature}"


def _own_key(**header: Any) -> str:
    return token(_claims(), rsa("attacker"), {"kid": "one", **header})


HOSTILE: dict[str, tuple[Callable[[], str], str]] = {
    "alg none": (lambda: _unsigned({"alg": "none"}), "'none'"),
    "alg None, as some libraries accept it": (lambda: _unsigned({"alg": "nOnE"}), "'nOnE'"),
    "no alg": (lambda: _unsigned({"kid": "one"}), "'None'"),
    "alg is a list": (lambda: _unsigned({"alg": ["RS256"]}), "it is signed with"),
    "HMAC with the public key": (_hmac_with_public_key, "'HS256'"),
    "an algorithm that is not allowed": (lambda: token(_claims(), rsa("one"), {"alg": "RS512"}), "'RS512'"),
    "another key with the same id": (_own_key, "bad_signature"),
    "its own key in the header": (lambda: _own_key(jwk=public(rsa("attacker"))[0]), "bad_signature"),
    "a URL of its own keys": (lambda: _own_key(jku="https://evil.example.org/keys"), "bad_signature"),
    "an unknown key": (lambda: token(_claims(), rsa("attacker")), "0 keys that fit"),
    "no key id, and two keys": (lambda: token(_claims(), rsa("one"), {"kid": None}), "2 keys that fit"),
    "an encryption key": (lambda: token(_claims(), rsa("sealed")), "0 keys that fit"),
    "an RSA key of 1024 bits": (
        lambda: _unsigned({"alg": "RS256", "kid": "short"}, b"s" * 128),
        "less than 2048 bits",
    ),
    "a key of another curve": (lambda: _unsigned({"alg": "ES256", "kid": "p384"}, b"s" * 64), "0 keys that fit"),
    "RSA header, EC key": (lambda: _unsigned({"alg": "RS256", "kid": "ec"}, b"s" * 256), "0 keys that fit"),
    "a changed payload": (_changed_payload, "bad_signature"),
    "no signature": (lambda: _signed().rpartition(".")[0] + ".", "bad_signature"),
    "an ECDSA signature of zeros": (lambda: _unsigned({"alg": "ES256", "kid": "ec"}, b"\0" * 64), "bad_signature"),
    "an extension that must be understood": (
        lambda: _unsigned({"alg": "RS256", "kid": "one", "crit": ["x"], "x": 1}),
        "crit",
    ),
    "five parts (encrypted)": (lambda: "a.b.c.d.e", "three parts"),
    "two parts": (lambda: "a.b", "three parts"),
    "not ASCII": (lambda: "ä.b.c", "three parts"),
    "a header that is not JSON": (lambda: f"{part(b'{')}.b.c", "not JSON"),
    "a header that is a list": (lambda: f"{part([1])}.b.c", "not a JSON object"),
    "a header of deep nesting": (lambda: f"{part(b'[' * 9000)}.b.c", "not JSON"),
    "a key id that is a number": (lambda: _unsigned({"alg": "RS256", "kid": 1}), "kid is not a string"),
    "too long": (lambda: "a" * 300_000, "more than 262144"),
    "a header that is too long": (lambda: "a" * 40_000 + ".b.c", "header has more than 32768"),
    "another issuer": (lambda: _signed(iss="https://id.example.org/other"), "iss"),
    "an issuer with a slash": (lambda: _signed(iss=f"{ISSUER}/"), "iss"),
    "no issuer": (lambda: _signed(iss=None), "iss"),
    "another audience": (lambda: _signed(aud="another"), "compare sso.client_id"),
    "no audience": (lambda: _signed(aud=None), "aud"),
    "two audiences without azp": (lambda: _signed(aud=[CLIENT, "another"]), "azp"),
    "issued to another client": (lambda: _signed(azp="another"), "azp"),
    "an empty list of audiences": (lambda: _signed(aud=[]), "aud"),
    "another nonce": (lambda: _signed(nonce="m" * 43), "nonce"),
    "no nonce": (lambda: _signed(nonce=None), "nonce"),
    "expired": (lambda: _signed(exp=_ago(61)), "expired: compare the clocks"),
    "no expiry": (lambda: _signed(exp=None), "exp"),
    "an expiry that is a text": (lambda: _signed(exp="2999-01-01"), "exp"),
    "an expiry that is true": (lambda: _signed(exp=True), "exp"),
    "an endless expiry": (lambda: _signed(exp=1e300), "exp is not a time"),
    "issued in the future": (lambda: _signed(iat=_ago(-120)), "in the future: compare the clocks"),
    "issued long ago": (lambda: _signed(iat=_ago(700)), "more than 600 s ago"),
    "not valid yet": (lambda: _signed(nbf=_ago(-120)), "not yet valid"),
    "no subject": (lambda: _signed(sub=None), "sub"),
    "an empty subject": (lambda: _signed(sub=""), "sub"),
    "a subject that is a number": (lambda: _signed(sub=7), "sub"),
}  # fmt: skip


def _keys() -> list[dict[str, Any]]:
    sealed = {**public(rsa("sealed"))[0], "use": "enc"}
    symmetric = {"kty": "oct", "kid": "one", "k": part(b"k" * 32)}
    more = public(rsa("one"), rsa("two"), ec("ec"), ec("p384", "P-384"))
    short = {"kty": "RSA", "kid": "short", "n": part(b"\xff" * 128), "e": "AQAB"}
    return [*more, sealed, symmetric, short]


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_token_is_refused_with_its_reason(name: str) -> None:
    make, reason = HOSTILE[name]
    keys = [key for key in _keys() if name != "no key id, and two keys" or key["kid"] in ("one", "two")]
    with pytest.raises(SignOnRefusedError) as refused:
        verify(make(), keys, EXPECTED, clock.wall())
    assert reason in str(refused.value)


@pytest.mark.parametrize(
    "make",
    [
        _signed,
        lambda: token(_claims(), ec("ec")),
        lambda: _signed(aud=[CLIENT], azp=CLIENT),
        lambda: _signed(aud=[CLIENT, "another"], azp=CLIENT),
        lambda: _signed(iat=_ago(-59), exp=_ago(59)),
        lambda: token(_claims(), rsa("one"), {"x5t": "t" * 600}),
    ],
    ids=["RSA", "ECDSA", "a list", "two audiences", "within the skew", "a long header"],
)
def test_a_good_token_is_accepted(make: Callable[[], str]) -> None:
    assert verify(make(), _keys(), EXPECTED, clock.wall())["sub"] == "u-1"
