"""The claims that providers really send, by kind of provider: who signs in, and under which name."""

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import pytest

from appliance.base import clock
from appliance.features.sso.errors import SignOnRefusedError
from appliance.features.sso.identity import identity_of, name_of, subject_of
from appliance.features.sso.sign_on import Expected, verify
from tests.unit.features.sso.scripted_provider import CLIENT, ISSUER, claims, public, rsa, sso, token

NONCE = "n" * 43
EXPECTED = Expected(ISSUER, CLIENT, NONCE, ("RS256",), 60.0)


class Row(NamedTuple):
    """A token of a kind of provider: its name in the audit log, or a part of the refusal."""

    provider: str
    given: Mapping[str, Any]
    name: str = ""
    refusal: str = ""
    wanted: Mapping[str, Any] = {}


def by(claim: str, roles: str = "groups", crew: str = "crew", **more: Any) -> dict[str, Any]:
    return {"name_claim": claim, "roles_claim": roles, "roles": {"operator": [crew]}, **more}


def mail(address: str, verified: object = None) -> dict[str, object]:
    return {"email": address} | ({} if verified is None else {"email_verified": verified})


MAIL, USER, DOMAIN = by("email"), by("preferred_username"), by("sub", domains=["example.org"])
ENTRA_SUB = "_AAAAAAAAAAAAAAAIkzqFVrSaSaFHy782bbtaQ-x"
ADFS_SUB = "q1xKpz9oK/+wQDwbFz0sXmQ2Yk8fA4x2b4rE4n5Yd2g="
ROWS = [
    # The subject is the name by default.
    Row("Keycloak", {"sub": "f:8c2d1b1e-2a55-4b7a-9e5f-1f8b0e0a7c11:ann"},
        "f:8c2d1b1e-2a55-4b7a-9e5f-1f8b0e0a7c11:ann"),
    Row("Keycloak, UUID", {"sub": "8c2d1b1e-2a55-4b7a-9e5f-1f8b0e0a7c11"}, "8c2d1b1e-2a55-4b7a-9e5f-1f8b0e0a7c11"),
    Row("AD FS, pairwise", {"sub": ADFS_SUB}, "q1xKpz9oK%2F+wQDwbFz0sXmQ2Yk8fA4x2b4rE4n5Yd2g%3D"),
    Row("AD FS, starts with a plus", {"sub": "+x/9="}, "%2Bx%2F9%3D"),
    Row("AD FS, account", {"sub": "CORP\\ann"}, "CORP%5Cann"),
    Row("AD FS, account with an umlaut", {"sub": "CORP\\jürgen"}, "CORP%5Cj%C3%BCrgen"),
    Row("AD FS, UPN", {"sub": "ann@corp.example"}, "ann@corp.example"),
    Row("AD FS, SID", {"sub": "S-1-5-21-3623811015-1013"}, "S-1-5-21-3623811015-1013"),
    Row("Entra ID, pairwise", {"sub": ENTRA_SUB}, "%5F" + ENTRA_SUB[1:]),
    Row("Entra ID, starts with a dash", {"sub": "-AbC_9"}, "%2DAbC_9"),
    Row("Okta", {"sub": "00uid4BxXw6I6TV4m0g3"}, "00uid4BxXw6I6TV4m0g3"),
    Row("Auth0", {"sub": "auth0|5f7c8ec7c33c6c004bbafe82"}, "auth0|5f7c8ec7c33c6c004bbafe82"),
    Row("Auth0, SAML", {"sub": "samlp|corp|CN=Ann O'Neil,OU=Lab"}, "samlp|corp|CN%3DAnn%20O%27Neil%2COU%3DLab"),
    Row("Google", {"sub": "110248495921238986420"}, "110248495921238986420"),
    Row("AWS Cognito", {"sub": "us-east-1:aaaaaaaa-bbbb"}, "us-east-1:aaaaaaaa-bbbb"),
    Row("Dex", {"sub": "CiQwOGE4Njg0Yi1kYjg4EgVsb2NhbA"}, "CiQwOGE4Njg0Yi1kYjg4EgVsb2NhbA"),
    Row("LDAP bridge, DN", {"sub": "uid=ann,ou=people,dc=example,dc=org"},
        "uid%3Dann%2Cou%3Dpeople%2Cdc%3Dexample%2Cdc%3Dorg"),
    Row("WSO2, tenant", {"sub": "PRIMARY/ann@carbon.super"}, "PRIMARY%2Fann@carbon.super"),
    Row("eIDAS, pairwise URN", {"sub": "urn:uuid:f81d4fae"}, "urn:uuid:f81d4fae"),
    Row("Shibboleth, opaque", {"sub": "AAdzZWNyZXQx!idp"}, "AAdzZWNyZXQx%21idp"),
    Row("a subject with a percent sign", {"sub": "50%"}, "50%25"),
    Row("a subject with a line break", {"sub": "u\n1"}, "u%0A1"),
    Row("a subject with a zero byte", {"sub": "u\x001"}, "u%001"),
    Row("a subject that writes right to left", {"sub": "nna\u202e"}, "nna%E2%80%AE"),
    Row("a subject of 255 characters", {"sub": "s" * 255}, "s" * 95),
    Row("a subject of 256 characters", {"sub": "s" * 256}, refusal="sub"),
    Row("a subject that is a number", {"sub": 7}, refusal="sub"),
    Row("a subject that is a list", {"sub": ["u-1"]}, refusal="sub"),
    Row("an empty subject", {"sub": ""}, refusal="sub"),
    # The name is another claim.
    Row("Keycloak, user name", {"preferred_username": "ann"}, "ann", wanted=USER),
    Row("Keycloak, umlaut", {"preferred_username": "jörg"}, "j%C3%B6rg", wanted=USER),
    Row("Keycloak on a Mac, umlaut in two parts", {"preferred_username": "jo\u0308rg"}, "j%C3%B6rg", wanted=USER),
    Row("Entra ID, apostrophe", {"preferred_username": "miles.o'brien@corp.example"}, "miles.o%27brien@corp.example",
        wanted=USER),
    Row("Entra ID, guest", {"preferred_username": "ann_partner.org#EXT#@corp.example"},
        "ann_partner.org%23EXT%23@corp.example", wanted=USER),
    Row("Entra ID, object id", {"oid": "00000000-0000-0000-66f3-3332eca7ea81"},
        "00000000-0000-0000-66f3-3332eca7ea81", wanted=by("oid")),
    Row("AD FS, unique_name", {"unique_name": "CORP\\ann"}, "CORP%5Cann", wanted=by("unique_name")),
    Row("AD FS, winaccountname as a URI",
        {"http://schemas.microsoft.com/ws/2008/06/identity/claims/windowsaccountname": "ann"}, "ann",
        wanted=by("http://schemas.microsoft.com/ws/2008/06/identity/claims/windowsaccountname")),
    Row("Authentik, display name", {"name": "Ann Müller"}, "Ann%20M%C3%BCller", wanted=by("name")),
    Row("a Japanese directory", {"name": "田中"}, "%E7%94%B0%E4%B8%AD", wanted=by("name")),
    Row("a name in a nested claim", {"user": {"login": "ann"}}, "ann", wanted=by("user.login")),
    Row("a name that is missing", {}, refusal="gives no name", wanted=by("upn")),
    Row("a name that is a number", {"uid": 1001}, refusal="gives no name", wanted=by("uid")),
    Row("a name of spaces", {"name": "  "}, refusal="gives no name", wanted=by("name")),
    Row("a long name", {"name": "ü" * 100}, "%C3%BC" * 15 + "%C3", wanted=by("name")),
    # E-mail addresses.
    Row("Google, Workspace", mail("ann@example.org", True), "ann@example.org", wanted=MAIL),
    Row("AWS Cognito, verified as a string", mail("ann@example.org", "true"), "ann@example.org", wanted=MAIL),
    Row("Apple, verified as a string", mail("Ann@Example.org", "true"), "ann@example.org", wanted=MAIL),
    Row("AWS Cognito, not verified", mail("ann@example.org", "false"), refusal="gives no name", wanted=MAIL),
    Row("GitLab, not verified", mail("ann@example.org", False), refusal="gives no name", wanted=MAIL),
    Row("Entra ID, no word of verification", mail("ann@example.org"), refusal="gives no name", wanted=MAIL),
    Row("verified as 1", mail("ann@example.org", 1), refusal="gives no name", wanted=MAIL),
    Row("an address with an apostrophe", mail("o'neil@example.org", True), "o%27neil@example.org", wanted=MAIL),
    Row("an address with a tag", mail("ann+lab@example.org", True), "ann+lab@example.org", wanted=MAIL),
    Row("an internationalised address", mail("jürgen@example.org", True), "j%C3%BCrgen@example.org", wanted=MAIL),
    Row("a Kelvin sign is not a k", mail("\u212aim@example.org", True), "Kim@example.org", wanted=MAIL),
    Row("the right domain", mail("ann@example.org", "true"), "u-1", wanted=DOMAIN),
    Row("another domain", mail("ann@evil.org", True), refusal="sso.domains", wanted=DOMAIN),
    Row("a domain that is not verified", mail("ann@example.org"), refusal="sso.domains", wanted=DOMAIN),
    # Groups and roles.
    Row("AD FS, one group as a string", {"groups": "crew"}, "u-1"),
    Row("AD FS, group claim as a URI", {"http://schemas.xmlsoap.org/claims/Group": ["crew"]}, "u-1",
        wanted=by("sub", "http://schemas.xmlsoap.org/claims/Group")),
    Row("AD FS, CORP\\group", {"group": ["CORP\\Domain Users", "CORP\\crew"]}, "u-1",
        wanted=by("sub", "group", "CORP\\crew")),
    Row("AD FS, 600 groups (44 KB)",
        {"groups": [*(f"CORP\\Department {number:04d} of the site in Zürich: all employees" for number in range(600)),
                    "crew"]}, "u-1"),
    Row("Shibboleth, 5000 entitlements", {"groups": [f"urn:{number}" for number in range(4999)] + ["crew"]}, "u-1"),
    Row("5001 groups", {"groups": ["crew"] * 5001}, refusal="at most 5000"),
    Row("Entra ID, app roles", {"roles": ["crew"], "groups": None}, "u-1", wanted=by("sub", "roles")),
    Row("Entra ID, object ids", {"groups": ["62e90394-69f5-4237-9190-012177145e10"]}, "u-1",
        wanted=by("sub", crew="62e90394-69f5-4237-9190-012177145e10")),
    Row("Entra ID, more than 200 groups", {"groups": None, "_claim_names": {"groups": "src1"}},
        refusal="use app roles"),
    Row("Entra ID, implicit flow", {"groups": None, "hasgroups": "true"}, refusal="use app roles"),
    Row("Keycloak, realm roles", {"realm_access": {"roles": ["crew"]}}, "u-1",
        wanted=by("sub", "realm_access.roles")),
    Row("Keycloak, roles of a client with dots", {"resource_access": {"robot.example.org": {"roles": ["crew"]}}},
        "u-1", wanted=by("sub", "resource_access.robot.example.org.roles")),
    Row("Keycloak, roles of a client that is a part of another's name",
        {"resource_access": {"robot": {"x": 1}, "robot.lab": {"roles": ["crew"]}}}, "u-1",
        wanted=by("sub", "resource_access.robot.lab.roles")),
    Row("Keycloak, full group path", {"groups": ["/site/crew"]}, "u-1", wanted=by("sub", crew="/site/crew")),
    Row("Auth0, namespace", {"https://robot.example.org/roles": ["crew"]}, "u-1",
        wanted=by("sub", "https://robot.example.org/roles")),
    Row("Auth0, nested in a namespace", {"https://robot.example.org/": {"app": {"roles": ["crew"]}}}, "u-1",
        wanted=by("sub", "https://robot.example.org/.app.roles")),
    Row("AWS Cognito, groups", {"cognito:groups": ["crew"]}, "u-1", wanted=by("sub", "cognito:groups")),
    Row("Zitadel, roles are names of an object", {"urn:zitadel:iam:org:project:roles": {"crew": {}}},
        refusal="a string or a list", wanted=by("sub", "urn:zitadel:iam:org:project:roles")),
    Row("Google, Workspace domain", {"hd": "example.org"}, "u-1", wanted=by("sub", "hd", "example.org")),
    Row("a group with an umlaut in two parts", {"groups": ["Tu\u0308bingen"]}, "u-1",
        wanted=by("sub", crew="Tübingen")),
    Row("groups that are not strings", {"groups": [1, None, {"name": "crew"}]}, refusal="no role here"),
    Row("no group that counts", {"groups": ["staff"]}, refusal="no role here", wanted=by("sub")),
    # The answer to the request.
    Row("a list of nonces", {"nonce": [NONCE, "x"]}, refusal="nonce is not a string"),
    Row("a nonce that is a number", {"nonce": 5}, refusal="nonce is not a string"),
    Row("a list of issuers", {"iss": [ISSUER]}, refusal="iss is not a string"),
    Row("Ory Hydra, list of audiences", {"aud": [CLIENT]}, "u-1"),
    Row("Keycloak, several audiences", {"aud": [CLIENT, "account"], "azp": CLIENT}, "u-1"),
    Row("times with fractions", {"nbf": 1.5}, "u-1"),
]  # fmt: skip


def signed_in(row: Row) -> Any:
    made = token(claims(**{"nonce": NONCE, **row.given}), rsa("one"))
    now = clock.wall()
    return identity_of(verify(made, public(rsa("one")), EXPECTED, now), sso(**row.wanted), now)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.provider)
def test_a_token_signs_in_or_is_refused_in_words(row: Row) -> None:
    if row.refusal:
        with pytest.raises(SignOnRefusedError) as refused:
            signed_in(row)
        assert row.refusal in str(refused.value)
        return
    person = signed_in(row)
    assert person.name.partition("~")[0] == row.name
    assert len(person.name) <= 128
    assert person.name.isascii() and person.name.isprintable() and " " not in person.name
    assert person.subject.isascii() and person.subject.isprintable()


def test_the_table_has_no_row_twice_and_enough_of_them() -> None:
    assert len({row.provider for row in ROWS}) == len(ROWS) >= 66


TEXTS = [
    "ann", "Ann", "a%6En", "a%", "a%25", "%61nn", "jörg", "jo rg", "j%C3%B6rg", "-a", "%2Da", "a~b", "K",
    "\u202eann", "u\n", "u", "\ud83d", "\ufffd", "ü" * 100, "ü" * 101, "x" * 128, "x" * 129, "x" * 130,
    "x" * 95 + "~" + "0" * 32,
]  # fmt: skip


def test_two_names_or_subjects_are_never_one() -> None:
    for escape in (name_of, subject_of):
        for text, other in itertools.combinations(TEXTS, 2):
            assert escape(text) != escape(other), (text, other)
    assert name_of("jo\u0308rg") == name_of("j\u00f6rg"), "one spelling of a name"
    assert subject_of("jo\u0308rg") != subject_of("j\u00f6rg"), "a subject is compared byte by byte"
    assert subject_of("auth0|CORP\\ann o'neil/=") == "auth0|CORP\\ann%20o'neil/="


def test_a_name_is_kept_as_it_was() -> None:
    """Names of earlier versions have only these characters."""
    for name in ("ann", "a.b_c@d+e|f:g-h", "0" * 128):
        assert name_of(name) == name
