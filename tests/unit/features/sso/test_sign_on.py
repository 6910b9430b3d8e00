import asyncio
import base64
from typing import Any

import pytest

from appliance.base import clock
from appliance.features.sso.errors import ProviderError, SignOnRefusedError
from appliance.features.sso.provider_connection import ProviderAnswer
from appliance.features.sso.sign_on import PENDING_SECONDS
from tests.support.virtual_clock import let_time_pass
from tests.unit.features.sso.scripted_provider import ISSUER, KEYS, ScriptedProvider, rsa, sso

pytestmark = pytest.mark.anyio
HOUR = 3600.0


async def test_a_person_is_identified_with_role_and_groups_of_doors() -> None:
    provider = ScriptedProvider()
    state = await provider.begin(again=True)
    assert provider.asked["redirect_uri"] == "https://robot.example.org:8443/console"
    assert (provider.asked["prompt"], provider.asked["code_challenge_method"]) == ("login", "S256")
    identity, keys, address = await provider.sign_ons.finish(state, "code", "")
    found = identity.subject, identity.name, identity.role, identity.doors
    assert found == ("u-1", "u-1", "operator", ("floor",))
    assert (keys, address) == (KEYS, "10.0.0.9")
    assert identity.ends == pytest.approx(clock.wall() + HOUR, abs=1)  # of the ID token
    pair = base64.b64decode(provider.headers["Authorization"].removeprefix("Basic ")).decode()
    assert (pair, provider.form["redirect_uri"]) == ("rosrv:s3%3Acret", provider.asked["redirect_uri"])


@pytest.mark.parametrize(
    ("methods", "secret", "sent"),
    [(["client_secret_post"], "s", {"client_id", "client_secret"}), (["none"], None, {"client_id"})],
    ids=["in the form", "a public client"],
)
async def test_the_client_authenticates_as_the_provider_wants(
    methods: list[str], secret: str | None, sent: set[str]
) -> None:
    provider = ScriptedProvider(secret=secret)
    provider.metadata["token_endpoint_auth_methods_supported"] = methods
    await provider.sign_ons.finish(await provider.begin(), "code", "")
    assert sent == {name for name in provider.form if name.startswith("client")}
    assert "Authorization" not in provider.headers


async def test_a_state_is_good_once_here_and_for_ten_minutes() -> None:
    provider = ScriptedProvider()
    used = await provider.begin()
    await provider.sign_ons.finish(used, "code", "")
    for state in (used, "x" * 43):
        with pytest.raises(SignOnRefusedError, match="not begun here"):
            await provider.sign_ons.finish(state, "code", "")
    late = await provider.begin()
    let_time_pass(PENDING_SECONDS)
    with pytest.raises(SignOnRefusedError, match="not begun here, was used, or took more than 10 minutes"):
        await provider.sign_ons.finish(late, "code", "")


async def test_the_code_of_another_sign_on_gives_nothing() -> None:
    provider = ScriptedProvider()
    thief = await provider.begin("10.0.0.66")
    await provider.begin()
    provider.asked["code_challenge"] = "the challenge of the other sign-on"
    with pytest.raises(SignOnRefusedError, match="invalid_grant"):  # the provider refuses the verifier
        await provider.sign_ons.finish(thief, "stolen", "")


@pytest.mark.parametrize(
    ("change", "error", "reason"),
    [
        ({"issuer": "https://evil.example.org"}, ProviderError, "is of issuer 'https://evil.example.org'"),
        ({"token_endpoint": "http://id.example.org/token"}, ProviderError, "is not https"),
        ({"jwks_uri": "file:///etc/passwd"}, ProviderError, "is not https"),
        ({"authorization_endpoint": "javascript:alert(1)"}, ProviderError, "is not https"),
        ({"authorization_endpoint": "https://id@evil.example.org"}, ProviderError, "no user"),
        ({"authorization_endpoint": None}, ProviderError, "not a usable discovery document"),
        ({"code_challenge_methods_supported": ["plain"]}, ProviderError, "does not support PKCE"),
        ({"authorization_response_iss_parameter_supported": True}, SignOnRefusedError, "another provider"),
    ],
    ids=lambda value: str(value)[:60],
)
async def test_a_hostile_discovery_document_is_refused(
    change: dict[str, Any], error: type[Exception], reason: str
) -> None:
    provider = ScriptedProvider()
    provider.metadata |= change
    with pytest.raises(error, match=reason):
        await provider.sign_ons.finish(await provider.begin(), "code", "")


@pytest.mark.parametrize(
    ("answer", "error", "reason"),
    [
        (ProviderAnswer(400, b'{"error": "invalid_grant"}'), SignOnRefusedError, "invalid_grant; sign in again"),
        (ProviderAnswer(401, b'{"error": "invalid_client"}'), ProviderError, "answers 401: invalid_client"),
        (ProviderAnswer(302, b""), ProviderError, "answers 302"),
        (ProviderAnswer(500, b'{"error": "\x1b[2J"}'), ProviderError, "answers 500: $"),
        (ProviderAnswer(200, b"[" * 90_000), ProviderError, "has no ID token"),
        (ProviderAnswer(200, b'{"id_token": 7}'), ProviderError, "has no ID token"),
        (ProviderAnswer(200, b'{"access_token": "a"}'), ProviderError, "has no ID token"),
        (ProviderAnswer(200, b'{"id_token": "a.b.c"}'), SignOnRefusedError, "its header is not JSON"),
    ],
    ids=lambda value: str(value)[:60],
)  # fmt: skip
async def test_a_hostile_answer_for_the_code_is_refused(
    answer: ProviderAnswer, error: type[Exception], reason: str
) -> None:
    provider = ScriptedProvider()
    state = await provider.begin()
    provider.answers["token"] = answer
    with pytest.raises(error, match=reason):
        await provider.sign_ons.finish(state, "code", "")


@pytest.mark.parametrize(
    ("code", "issuer"),
    [("", ""), ("c" * 5000, ""), ("code", "https://evil.example.org")],
    ids=["none", "long", "iss"],
)
async def test_a_hostile_response_of_the_browser_is_refused(code: str, issuer: str) -> None:
    provider = ScriptedProvider()
    state = await provider.begin()
    with pytest.raises(SignOnRefusedError):
        await provider.sign_ons.finish(state, code, issuer)
    assert "token" not in provider.requests


async def _sign_on(provider: ScriptedProvider) -> None:
    await provider.sign_ons.finish(await provider.begin(), "code", ISSUER)


@pytest.mark.parametrize("name", ["two", None], ids=["with an id", "without"])
async def test_a_new_key_counts_at_once_and_a_withdrawn_one_no_longer(name: str | None) -> None:
    provider = ScriptedProvider()
    provider.header = {"kid": None} if name is None else {}
    await _sign_on(provider)
    provider.key = rsa("two")
    provider.served = [rsa("two")]
    await _sign_on(provider)
    provider.key = rsa("one")
    with pytest.raises(SignOnRefusedError, match="bad_signature" if name is None else "0 keys that fit"):
        await _sign_on(provider)


async def test_a_provider_that_does_not_answer_is_asked_seldom() -> None:
    """Unknown hosts may begin to sign on, so that must not cost a request to the provider each time."""
    provider = ScriptedProvider()
    provider.down = {"openid-configuration"}
    for asked in (1, 2):
        begun = await asyncio.gather(*(provider.begin() for _browser in range(100)), return_exceptions=True)
        assert {str(one) for one in begun} == {f"{ISSUER}/.well-known/openid-configuration: no answer"}
        assert len(provider.requests) == asked
        let_time_pass(6.0)
    provider.down = set()
    await _sign_on(provider)


@pytest.mark.parametrize("down", [{"keys"}, {"keys", "openid-configuration"}], ids=["keys", "all"])
async def test_the_last_keys_serve_while_the_provider_gives_none_but_not_for_ever(down: set[str]) -> None:
    provider = ScriptedProvider(sso(keys_hours=3.0))
    await _sign_on(provider)
    provider.down = down
    let_time_pass(2.9 * HOUR)
    await _sign_on(provider)
    let_time_pass(0.2 * HOUR)
    with pytest.raises(ProviderError, match="no answer"):
        await _sign_on(provider)
    provider.down = set()
    let_time_pass(6.0)
    await _sign_on(provider)


@pytest.mark.parametrize("body", [b"[]", b'{"keys": 1}', b'{"keys": [' + b"1," * 200 + b"1]}", b"\xff"])
async def test_a_hostile_set_of_keys_is_refused(body: bytes) -> None:
    provider = ScriptedProvider()
    provider.answers["keys"] = ProviderAnswer(200, body)
    with pytest.raises(ProviderError, match="not a set of keys"):
        await _sign_on(provider)


@pytest.mark.parametrize(
    ("given", "payload", "reason"),
    [
        ({}, {"groups": ["strangers"]}, "has no role here: the claim groups has strangers"),
        ({}, {"groups": []}, "has no role here"),
        ({}, {"groups": None}, "must be a string or a list"),
        ({}, {"groups": {"crew": True}}, "must be a string or a list"),
        ({}, {"groups": ["\x1b[2J"]}, r"\\x1b\[2J"),
        ({"name_claim": "preferred_username"}, {}, "gives no name"),
        ({"name_claim": "email"}, {"email": "a@example.org"}, "gives no name"),
        ({"domains": ["example.org"]}, {"email": "a@example.org"}, "the provider gives none"),
        ({"domains": ["example.org"]}, {"email": "a@evil.org", "email_verified": True}, "gives a@evil.org"),
        ({"domains": ["example.org"]}, {"email": "a@x.example.org", "email_verified": True}, "lets in only"),
        ({"domains": ["example.org"]}, {"email": "a@example.org", "email_verified": "yes"}, "gives none"),
    ],
    ids=str,
)
async def test_a_person_without_a_right_is_refused(
    given: dict[str, Any], payload: dict[str, Any], reason: str
) -> None:
    provider = ScriptedProvider(sso(**given))
    provider.payload = payload
    with pytest.raises(SignOnRefusedError, match=reason):
        await _sign_on(provider)


@pytest.mark.parametrize(
    ("given", "payload", "name", "role", "hours"),
    [
        ({}, {"groups": ["staff", "crew", "chiefs"]}, "u-1", "admin", 1),
        ({}, {"groups": ["staff", "audit"]}, "u-1", "investigator", 1),
        ({"roles_claim": "a.b"}, {"a": {"b": "staff"}}, "u-1", "viewer", 1),
        ({"roles_claim": "https://x/y.z"}, {"https://x/y.z": ["staff"]}, "u-1", "viewer", 1),
        ({"name_claim": "email", "domains": ["example.org"]}, {"email": "Alice@Example.org", "email_verified": True},
         "alice@example.org", "operator", 1),
        ({"session_hours": 0.5}, {}, "u-1", "operator", 0.5),
        ({"session_hours": 8, "outlives_id_token": True}, {}, "u-1", "operator", 8),
    ],
    ids=str,
)  # fmt: skip
async def test_claims_give_name_role_and_end(
    given: dict[str, Any], payload: dict[str, Any], name: str, role: str, hours: float
) -> None:
    provider = ScriptedProvider(sso(**given))
    provider.payload = payload
    identity, _keys, _address = await provider.sign_ons.finish(await provider.begin(), "code", "")
    assert (identity.name, identity.role) == (name, role)
    assert identity.ends == pytest.approx(clock.wall() + hours * HOUR, abs=1)


async def test_a_flood_of_sign_ons_ends_only_its_own() -> None:
    provider = ScriptedProvider()
    mine = await provider.begin("10.0.0.9")
    asked = provider.asked
    first = await provider.begin("2001:db8::1")
    for number in range(300):
        await provider.begin(f"2001:db8::{number:x}")  # one /64
    for number in range(400):
        await provider.begin(f"10.1.{number % 60}.7")
    provider.asked = asked
    await provider.sign_ons.finish(mine, "code", "")
    with pytest.raises(SignOnRefusedError, match="not begun here"):
        await provider.sign_ons.finish(first, "code", "")


async def test_people_behind_one_address_end_no_sign_on_of_one_another() -> None:
    provider = ScriptedProvider()
    states = []
    for _ in range(100):
        states.append((await provider.begin("10.0.0.9"), provider.asked))
    for state, asked in states:
        provider.asked = asked
        await provider.sign_ons.finish(state, "code", "")
