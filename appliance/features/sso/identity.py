"""Derive a person's identity and rights from verified claims. No I/O.

There is no default: without a value that gives a role, or without a name, a person does not sign in. A name or
domain from `email` needs `email_verified`, because people can claim any address at some providers.
"""

import hashlib
import re
import unicodedata
from collections.abc import Iterator, Mapping
from typing import Any

from appliance.features.sso.errors import SignOnRefusedError
from appliance.features.sso.link import SignedInPerson
from appliance.features.sso.settings import Sso

_ESCAPED = re.compile(rb"[^A-Za-z0-9._@+|:-]|^[^A-Za-z0-9]")
_LONGEST_NAME, _DIGITS = 128, 32
_UNPRINTABLE = re.compile(rb"[^!-$&-~]")
_MAX_VALUES = 5000
_UPPER = {ord(letter): ord(letter.lower()) for letter in "ABCDEFGHIJKLMNOPQRSTUVWXYZ"}


def name_of(text: str) -> str:
    """Return a name for the audit log: letters, digits and `. _ @ + | : -` stay, and all others are `%` and two
    hexadecimal digits for each byte of UTF-8.

    Two texts have one name only if Unicode's form C of both is the same. The end of a long name is its SHA-256.
    """
    data = unicodedata.normalize("NFC", text).encode("utf-8", "surrogatepass")
    name = _escape(_ESCAPED, data)
    if len(name) <= _LONGEST_NAME:
        return name
    start = name[: _LONGEST_NAME - _DIGITS - 1].rpartition("%")
    kept = start[0] if len(start[2]) < len("XX") and start[1] else "".join(start)
    return f"{kept}~{hashlib.sha256(data).hexdigest()[:_DIGITS]}"


def subject_of(text: str) -> str:
    """Return a `sub` in printable ASCII. It is the identity of a person, so no two texts have one."""
    return _escape(_UNPRINTABLE, text.encode("utf-8", "surrogatepass"))


def _escape(pattern: re.Pattern[bytes], data: bytes) -> str:
    return pattern.sub(lambda found: b"%%%02X" % found[0][0], data).decode("ascii")


def identity_of(claims: Mapping[str, Any], wanted: Sso, now: float) -> SignedInPerson:
    mail = _verified_mail(claims)
    if wanted.domains and mail.rpartition("@")[2] not in wanted.domains:
        raise SignOnRefusedError(
            f"sso.domains lets in only verified e-mail addresses of {', '.join(wanted.domains)};"
            f" the provider gives {mail or 'none'}"
        )
    given = mail if wanted.name_claim == "email" else _find(claims, wanted.name_claim)
    if not isinstance(given, str) or not given.strip():
        raise SignOnRefusedError(
            f"the claim {wanted.name_claim} (sso.name_claim) gives no name: it must be a string in the ID token;"
            " `email` must also be verified"
        )
    name = name_of(given)
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
    return SignedInPerson(subject_of(claims["sub"]), name, mail, role, wanted.door_groups_of(values), ends)


def _verified_mail(claims: Mapping[str, Any]) -> str:
    """Return the address with A to Z in lower case: other letters are not changed, or two addresses could be one."""
    mail, verified = claims.get("email"), claims.get("email_verified")
    if isinstance(mail, str) and (verified is True or verified == "true"):  # a string at some providers
        return mail.translate(_UPPER)
    return ""


def _find(claims: Mapping[str, Any], path: str) -> Any:
    return next(_at(claims, path), None)


def _at(claims: object, path: str) -> Iterator[object]:
    """Return the values at a path; a name in it may have dots, and the longest name counts first."""
    if not isinstance(claims, Mapping):
        return
    if path in claims:
        yield claims[path]
    end = path.rfind(".")
    while end > 0:
        if path[:end] in claims:
            yield from _at(claims[path[:end]], path[end + 1 :])
        end = path.rfind(".", 0, end)


def _values(claims: Mapping[str, Any], path: str) -> frozenset[str]:
    found = _find(claims, path)
    found = [found] if isinstance(found, str) else found
    if not isinstance(found, list) or len(found) > _MAX_VALUES:
        overage = "_claim_names" in claims or claims.get("hasgroups") in (True, "true")
        hint = "it leaves out the groups of a person who has many: use app roles" if overage else ""
        raise SignOnRefusedError(
            f"the claim {path} (sso.roles_claim) must be a string or a list of at most {_MAX_VALUES}: "
            + (hint or "let the provider put it into the ID token")
        )
    return frozenset(unicodedata.normalize("NFC", value) for value in found if isinstance(value, str))
