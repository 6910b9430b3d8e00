"""The certificates that standby makes, for `tests/unit/test_certificates.py`."""

from collections.abc import Callable, Mapping
from pathlib import Path

from appliance.features.standby.link_certificates import make_link_certificate

MADE: Mapping[str, Callable[[Path], list[bytes]]] = {
    "appliance/features/standby/link_certificates.py": lambda _folder: [
        make_link_certificate().certificate.encode()
    ]
}
