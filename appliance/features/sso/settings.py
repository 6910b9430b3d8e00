"""The section `sso` of `appliance.yaml`."""

import dataclasses
import re
import unicodedata
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, ClassVar, Literal, get_args
from urllib.parse import urlsplit

from appliance.channel.answers.token_answers import TokenRole
from appliance.configuration.quantities import check, rules
from appliance.configuration.sections import (
    FeatureSection,
    checked_address,
    is_loopback,
    key,
    section,
    split_receiver,
)

Algorithm = Literal["RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512"]
"""The accepted algorithms: signatures with a public key, neither `none` nor an HMAC."""

Origin = tuple[str, str, int]
_RANKING: tuple[TokenRole, ...] = ("admin", "operator", "investigator", "viewer")
_DOMAIN_LABEL = re.compile(r"[a-z0-9-]{1,63}")
_DOOR_GROUP = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
_PORTS = {"https": 443, "http": 80}


def origin_of(url: str) -> Origin:
    """Return the origin of a URL, or raise `ValueError`: `http` is accepted only on the loopback."""
    try:
        parts = urlsplit(url)
        port = parts.port or _PORTS.get(parts.scheme, 0)
    except ValueError:
        raise ValueError(f"{url[:200]!r} is not a URL, for example https://id.example.org") from None
    host = parts.hostname or ""
    if parts.scheme != "https" and not (parts.scheme == "http" and is_loopback(host)):
        raise ValueError(f"{url[:200]!r} is not https: use https:// (http:// only for a loopback address)")
    if not host or parts.username is not None or parts.fragment or re.search(r"[^!-~]|\\", url):
        raise ValueError(
            f"{url[:200]!r} must have a host, and no user, fragment or space, for example https://id.example.org"
        )
    return parts.scheme, host, port


def _check_issuer(text: str) -> str:
    origin_of(text)
    if "?" in text:
        raise ValueError(
            f"{text!r} has a query: use the value of `issuer` in the provider's discovery document"
        )
    return text


def _check_url(text: str) -> str:
    if text:
        origin_of(text)
        if urlsplit(text).path or "?" in text:
            raise ValueError(
                f"{text!r} must be https://HOST:PORT without a path, as browsers open the console"
            )
    return text


def _check_proxy(text: str) -> str:
    protocol, _slashes, place = text.partition("://")
    if protocol != "http":
        raise ValueError(f"{text!r} is not http://ADDRESS:PORT, for example http://10.0.0.3:3128")
    checked_address(place)
    return text


def _check_domain(text: str) -> str:
    labels = text.split(".")
    if len(labels) < 2 or not all(map(_DOMAIN_LABEL.fullmatch, labels)):
        raise ValueError(f"{text!r} is not a domain in lower case, for example example.org")
    return text


def _check_door_group(text: str) -> str:
    if not _DOOR_GROUP.fullmatch(text):
        raise ValueError(f"{text!r} is not a name of a door group: use letters, digits and . _ -")
    return text


def _in_form_c(texts: Iterable[str]) -> Iterator[str]:
    return (unicodedata.normalize("NFC", text) for text in texts)


_Values = Annotated[
    list[Annotated[str, rules(min_length=1, max_length=256)]], rules(min_length=1, max_length=256)
]


@section
class Sso(FeatureSection):
    """Single sign-on by OpenID Connect for the console and REST; off unless `issuer` is given. Tokens remain valid."""

    issuer: Annotated[str, check(_check_issuer)] | None = key(
        default=None, description="the provider's issuer URL, exactly as in its discovery document"
    )
    address: Annotated[str, check(checked_address)] | None = key(
        default=None, description="ADDRESS:PORT of the provider; names are not looked up. Or give `proxy`"
    )
    proxy: Annotated[str, check(_check_proxy)] | None = key(
        default=None,
        description="http://ADDRESS:PORT of a proxy (CONNECT) that reaches a provider with many addresses",
    )
    ca: Path | None = key(
        default=None,
        description="authority of the provider's certificate (PEM); default: the system's authorities",
    )
    client_id: str = key(default="", max_length=256, description="the appliance's id at the provider")
    client_secret_file: Path | None = key(
        default=None, description="file whose first line is the client's secret; without it, a public client"
    )
    name: str = key(
        default="single sign-on",
        min_length=1,
        max_length=40,
        description="the provider's name on the console's button",
    )
    url: Annotated[str, check(_check_url)] = key(
        default="",
        description="https://HOST:PORT at which browsers open the console; the provider must permit the redirect URI"
        " `URL/console`",
    )
    scopes: list[Annotated[str, rules(pattern=r"^[!#-\[\]-~]{1,100}$")]] = key(
        default=["openid", "profile", "email"], description="scopes to request; `openid` is required"
    )
    name_claim: str = key(
        default="sub",
        min_length=1,
        max_length=256,
        description="claim with the name in the audit log, which must identify a person for ever; `email` must be"
        " verified. A nested one has dots; so may a name in it",
    )
    roles_claim: str = key(
        default="groups",
        min_length=1,
        max_length=256,
        description="claim with the values for `roles` and `doors`; a nested one has dots: realm_access.roles. A name"
        " in it may have dots too",
    )
    roles: dict[TokenRole, _Values] = key(
        default_factory=dict,
        description="values of `roles_claim` that give each role; the highest role counts, and without a role no person"
        " signs in",
    )
    doors: dict[Annotated[str, check(_check_door_group)], _Values] = key(
        default_factory=dict, description="values of `roles_claim` that give each group of doors"
    )
    domains: list[Annotated[str, check(_check_domain)]] = key(
        default=[],
        description="domains of verified e-mail addresses that may sign in; without it, any address, or none",
    )
    session_hours: Annotated[float, rules(gt=0, le=24, allow_inf_nan=False)] = key(
        default=8.0, description="longest session"
    )
    outlives_id_token: bool = key(
        default=False,
        description="on: a session may last `session_hours`, although the ID token expires before",
    )
    clock_skew_seconds: Annotated[float, rules(ge=0, le=300, allow_inf_nan=False)] = key(
        default=60.0, description="by which the clocks of the provider and of this machine may differ"
    )
    algorithms: Annotated[list[Algorithm], rules(min_length=1)] = key(
        default=[*get_args(Algorithm)], description="signatures of ID tokens that are accepted"
    )
    keys_hours: Annotated[float, rules(ge=1, le=168, allow_inf_nan=False)] = key(
        default=24.0, description="for which the provider's last keys are used while it does not serve keys"
    )

    place: ClassVar[str] = "sso"

    def __post_init__(self) -> None:
        if self.issuer is None:
            given = (self.address, self.proxy, self.ca, self.client_id, self.client_secret_file, self.url)
            if any((*given, self.roles, self.doors, self.domains)):
                raise ValueError(
                    "the section has no effect without an issuer: remove it, or name an `issuer`"
                )
            return
        needed = {"client_id": self.client_id, "url": self.url, "roles": self.roles}
        missing = [name for name, value in needed.items() if not value]
        if missing:
            raise ValueError(f"{', '.join(missing)} must be given with issuer")
        if (self.address is None) is (self.proxy is None):
            raise ValueError(
                "issuer needs either address (ADDRESS:PORT of the provider) or proxy (http://ADDRESS:PORT)"
            )
        if "openid" not in self.scopes:
            raise ValueError("scopes must contain openid: without it, the provider gives no ID token")

    def audit_values(self) -> dict[str, str]:
        """Return all values if single sign-on is on: they decide who has which role. The secret is not among them."""
        if self.issuer is None:
            return {}
        return {name: str(value) for name, value in dataclasses.asdict(self).items()}

    @property
    def destination(self) -> tuple[str, int]:
        _protocol, host, port = split_receiver(
            f"tcp://{self.address or (self.proxy or '').partition('://')[2]}"
        )
        return host, port

    @property
    def redirect_uri(self) -> str:
        return f"{self.url}/console"

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(filter(None, (self.ca, self.client_secret_file)))

    def receivers(self) -> dict[str, tuple[str | None, str | None]]:
        if self.issuer is None:
            return {}
        return {"proxy" if self.proxy else "address": (self.proxy or self.address, self.destination[0])}

    def on_page(self) -> dict[str, str]:
        return {"sign-on": self.name} if self.issuer is not None else {}

    def role_of(self, values: frozenset[str]) -> TokenRole | None:
        return next(
            (role for role in _RANKING if values.intersection(_in_form_c(self.roles.get(role, ())))), None
        )

    def door_groups_of(self, values: frozenset[str]) -> tuple[str, ...]:
        return tuple(group for group, wanted in self.doors.items() if values.intersection(_in_form_c(wanted)))
