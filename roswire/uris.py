"""Node API URIs (`http://host:port/`) and service URIs (`rosrpc://host:port`), as nodes announce them.

A URI that two parsers could read differently is rejected. The host is a name or an address, the port is 1 to 65535,
and user info, query and fragment are not allowed. rospy writes an IPv6 address without brackets (`http://::1:4000/`);
then the port follows the last colon.
"""

import ipaddress
import re
from dataclasses import dataclass
from functools import lru_cache

from roswire.errors import InvalidUriError, quote

MAX_URI_LENGTH = 1024

_URI = re.compile(
    r"(?P<scheme>[A-Za-z][A-Za-z0-9+.-]*+)://"
    r"(?P<host>\[[0-9A-Fa-f:.]{2,45}\]|[0-9A-Fa-f:.]{2,45}(?=:[0-9]{1,5}(?:/|\Z))|[A-Za-z0-9_.-]{1,253})"
    r"(?P<port>:[0-9]{1,5})?"
    r"(?P<path>/[A-Za-z0-9_.~!$&'()*+,;=:@%/-]*+)?\Z"
)


@dataclass(frozen=True, slots=True)
class NodeUri:
    """A URI. `host` has no brackets; `path` starts with `/`, or is empty for a service."""

    scheme: str
    host: str
    port: int
    path: str


@lru_cache(4096)  # a node sends its own URI with every call
def parse_node_uri(text: str) -> NodeUri:
    return _parse(text, "http", "node API", "http://host:port/")


def parse_service_uri(text: str) -> NodeUri:
    """Parse the URI of a service. Raise `InvalidUriError`, including for a URI with a path."""
    uri = _parse(text, "rosrpc", "service", "rosrpc://host:port")
    if uri.path not in ("", "/"):
        raise InvalidUriError(f"service URI {quote(text)} has a path; write rosrpc://host:port")
    return NodeUri(uri.scheme, uri.host, uri.port, "")


def node_uri(host: str, port: int, path: str = "/") -> str:
    return f"http://{_bracket(host)}:{port}{path}"


def service_uri(host: str, port: int) -> str:
    return f"rosrpc://{_bracket(host)}:{port}"


def _parse(text: str, scheme: str, what: str, form: str) -> NodeUri:
    if len(text) > MAX_URI_LENGTH:
        raise InvalidUriError(f"{what} URI of {len(text)} characters; at most {MAX_URI_LENGTH} are allowed")
    match = _URI.match(text)
    if match is None:
        raise InvalidUriError(f"{what} URI {quote(text)} {_complaint(text)}; write {form}")
    if match["scheme"].lower() != scheme:
        raise InvalidUriError(
            f"{what} URI {quote(text)} has the scheme {quote(match['scheme'])}; write {form}"
        )
    if match["port"] is None:
        raise InvalidUriError(f"{what} URI {quote(text)} has no port; write {form}")
    port = int(match["port"][1:])
    if not 1 <= port <= 65535:
        raise InvalidUriError(f"{what} URI {quote(text)} has port {port}; a port is between 1 and 65535")
    return NodeUri(
        scheme, _host(match["host"], text, what), port, match["path"] or ("/" if scheme == "http" else "")
    )


def _host(host: str, text: str, what: str) -> str:
    if ":" not in host and not host.startswith("["):
        return host
    try:
        return str(ipaddress.IPv6Address(host.strip("[]")))
    except ValueError:
        raise InvalidUriError(f"{what} URI {quote(text)} has no valid IPv6 address as its host") from None


def _complaint(text: str) -> str:
    if not text:
        return "is empty"
    if not text.isascii() or not text.isprintable() or " " in text:
        return "has a space, a control character or a character outside ASCII"
    if "://" not in text:
        return "has no scheme"
    rest = text.split("://", 1)[1]
    for mark, name in (("@", "user info"), ("?", "a query"), ("#", "a fragment")):
        if mark in (rest.split("/", 1)[0] if mark == "@" else rest):
            return f"has {name}"
    return "has no valid host, port and path"


def _bracket(host: str) -> str:
    return f"[{host}]" if ":" in host else host
