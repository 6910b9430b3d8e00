"""Derive a person's identity and rights from verified claims. No I/O.

There is no default: without a value that gives a role, or without a name, a person does not sign in. A name or
domain from `email` needs `email_verified`, because people can claim any address at some providers.
"""

import re
from collections.abc import Mapping
from typing import Any

from appliance.features.sso.errors import SignOnRefusedError
from appliance.features.sso.link import SignedInPerson
from appliance.features.sso.settings import Sso

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@+|:-]{0,127}")
_MOST_VALUES = 1000


def identity_of(claims: Mapping[str, Any], wanted: Sso, now: float) -> SignedInPerson:
    mail = _verified_mail(claims)
    if wanted.domains and mail.rpartition("@")[2] not in wanted.domains:
        raise SignOnRefusedError(
            f"sso.domains lets in only verified e-mail addresses of {', '.join(wanted.domains)};"
            f" the provider gives {mail or 'none'}"
        )
    name = mail if wanted.name_claim == "email" else claims.get(wanted.name_claim)
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise SignOnRefusedError(
            f"the claim {wanted.name_claim} (sso.name_claim) gives no usable name: letters, digits and . _ @ + | : -,"
            " at most 128; `email` must also be verified"
        )
    values = _values(claims, wanted.roles_claim)
    role = wanted.role_of(values)
    if role is None:
        shown = ", ".join(sorted(values)[:20])[:300] or "nothing"
        raise SignOnRefusedError(
            f"{name} has no role here: the claim {wanted.roles_claim} has {ascii(shown)[1:-1]}, and sso.roles maps"
            " none of it"
        )
    ends = now + wanted.session_hours * 3600
    if not wanted.outlives_id_token:
        ends = min(ends, float(claims["exp"]))
    if ends <= now:
        raise SignOnRefusedError("the ID token has just expired: compare the clocks")
    return SignedInPerson(claims["sub"], name, mail, role, wanted.door_groups_of(values), ends)


def _verified_mail(claims: Mapping[str, Any]) -> str:
    mail = claims.get("email")
    return mail.lower() if isinstance(mail, str) and claims.get("email_verified") is True else ""


def _values(claims: Mapping[str, Any], path: str) -> frozenset[str]:
    found: Any = claims
    if path in claims:
        found = claims[path]
    else:
        for part in path.split("."):
            found = found.get(part) if isinstance(found, Mapping) else None
    found = [found] if isinstance(found, str) else found
    if not isinstance(found, list) or len(found) > _MOST_VALUES:
        raise SignOnRefusedError(
            f"the claim {path} (sso.roles_claim) must be a string or a list of at most {_MOST_VALUES}: let the provider"
            " put it into the ID token"
        )
    return frozenset(value for value in found if isinstance(value, str))
