"""The section `approval_hook` of `appliance.yaml`."""

import re
from pathlib import Path
from typing import Annotated, ClassVar
from urllib.parse import urlsplit

from appliance.configuration.quantities import check
from appliance.configuration.sections import FeatureSection, checked_address, key, section, split_receiver

_HTTPS = 443


def _check_url(text: str) -> str:
    try:
        parts = urlsplit(text)
        parts.port  # noqa: B018  raises for an invalid one
    except ValueError:
        parts = urlsplit("")
    if parts.scheme != "https" or not parts.hostname or parts.username is not None or parts.fragment:
        raise ValueError(f"{text[:200]!r} is not https://HOST/PATH, without a user and a fragment")
    if re.search(r"[^!-~]", text):
        raise ValueError(f"{text[:200]!r} has a space, or a character that is not ASCII")
    return text


def _check_console(text: str) -> str:
    if text and (urlsplit(_check_url(text)).path or "?" in text):
        raise ValueError(f"{text!r} must be https://HOST:PORT without a path, as browsers open the console")
    return text


@section
class ApprovalHook(FeatureSection):
    """Tells a web hook of each call that waits for an approval; off unless `url` is given. It never approves."""

    place: ClassVar[str] = "approval_hook"
    url: Annotated[str, check(_check_url)] | None = key(
        default=None, description="https URL that gets a POST for each call that begins to wait"
    )
    address: Annotated[str, check(checked_address)] | None = key(
        default=None, description="ADDRESS:PORT of the URL's host; names are not looked up"
    )
    secret_file: Path | None = key(
        default=None,
        description="file whose first line signs each POST (HMAC-SHA-256), 16 characters or more",
    )
    ca: Path | None = key(
        default=None,
        description="authority of the receiver's certificate (PEM); default: those the system trusts",
    )
    console: Annotated[str, check(_check_console)] = key(
        default="",
        description="https://HOST:PORT at which browsers open the console, for the link in the POST",
    )

    def __post_init__(self) -> None:
        others = {"address": self.address, "secret_file": self.secret_file}
        missing = [name for name, value in others.items() if value is None]
        if self.url is not None and missing:
            raise ValueError(f"url needs {' and '.join(missing)}")
        given = [name for name, value in {**others, "ca": self.ca}.items() if value is not None]
        if self.url is None and given:
            raise ValueError(f"{', '.join(given)} would have no effect without url")

    @property
    def destination(self) -> tuple[str, int]:
        _protocol, address, port = split_receiver(f"tcp://{self.address}")
        return address, port

    @property
    def host(self) -> tuple[str, str]:
        """The name for which the certificate must be valid, and the value of the header `Host`."""
        parts = urlsplit(self.url or "")
        name = parts.hostname or ""
        shown = f"[{name}]" if ":" in name else name
        return name, shown if parts.port in (None, _HTTPS) else f"{shown}:{parts.port}"

    @property
    def target(self) -> str:
        parts = urlsplit(self.url or "")
        return (parts.path or "/") + (f"?{parts.query}" if parts.query else "")

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(filter(None, (self.ca, self.secret_file)))

    def receivers(self) -> dict[str, tuple[str | None, str | None]]:
        return {"address": (self.address, self.address and self.destination[0])}
