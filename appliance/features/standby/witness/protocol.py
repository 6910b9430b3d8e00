"""The datagrams between the witness, the appliances and the followers: authenticated JSON, each in one packet."""

import functools
import hashlib
import hmac
import json
import re
from typing import Any, Callable, Dict, Optional

EXPIRY = 1.2  # seconds after a renewal until another appliance may have the lease
LONGEST = 1024  # bytes of a datagram
HIGHEST = 1 << 53  # of numbers and epochs, which JSON carries exactly
REQUEST, ANSWER = b"rosrv lease request 1\0", b"rosrv lease answer 1\0"
OPERATIONS = ("renew", "claim", "remove", "add", "release", "look")
NAME = re.compile(r"[a-z][a-z0-9-]{0,31}\Z")
LONGEST_REPORT = 160  # characters of a follower's troubles
FLAP_SECONDS = 60.0  # interruptions in this time are reported, and a report is repeated for so long
FREEBIND = 15  # a socket option that Python 3.5 does not name: the network may be down
BATCH = 64  # datagrams of unknown sources between two checks of the time, and of the sockets of known ones
_MAC = hashlib.sha256().digest_size
_TAG = 4  # bytes

Left = Callable[[], float]  # returns the seconds for which the rules that are being written are still right


@functools.lru_cache(maxsize=64)
def tag_of(key: bytes) -> bytes:
    """Return the first bytes of all datagrams with this key, so most forged datagrams cost no authentication."""
    return hmac.new(key, b"rosrv lease tag 1\0", hashlib.sha256).digest()[:_TAG]


def seal(purpose: bytes, name: str, key: bytes, body: Dict[str, Any]) -> bytes:
    """Return a datagram: tag, name, authentication code, and the body as JSON."""
    label = name.encode("ascii")
    text = json.dumps(body, sort_keys=True, separators=(",", ":")).encode("ascii")
    head = tag_of(key) + bytes([len(label)]) + label
    return head + hmac.new(key, purpose + head + text, hashlib.sha256).digest() + text


def name_in(datagram: bytes) -> str:
    """Return the name in a datagram, which is not authenticated yet, or an empty string."""
    if not _TAG + 1 + _MAC < len(datagram) <= LONGEST:
        return ""
    name = datagram[_TAG + 1 : _TAG + 1 + datagram[_TAG]].decode("ascii", "replace")
    return name if NAME.match(name) else ""


def unseal(purpose: bytes, key: bytes, datagram: bytes) -> Optional[Dict[str, Any]]:
    if datagram[:_TAG] != tag_of(key):
        return None
    end = _TAG + 1 + datagram[_TAG]
    code, text = datagram[end : end + _MAC], datagram[end + _MAC :]
    expected = hmac.new(key, purpose + datagram[:end] + text, hashlib.sha256).digest()
    if not hmac.compare_digest(code, expected):
        return None
    try:
        body = json.loads(text.decode("ascii"))
    except ValueError:
        return None
    return body if isinstance(body, dict) else None


def is_count(value: object) -> bool:
    return type(value) is int and 0 <= value <= HIGHEST
