"""Read the names of hosts in /etc/hosts."""

import ipaddress
from pathlib import Path

HOSTS = Path("/etc/hosts")
_MOST = 1 << 20  # bytes of the file


def names_of_hosts(file: Path = HOSTS) -> dict[str, str]:
    """Return the first name of each address in a file like /etc/hosts; nothing if it cannot be read."""
    try:
        with file.open("rb") as lines:
            text = lines.read(_MOST).decode("ascii", "replace")
    except OSError:
        return {}
    names: dict[str, str] = {}
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        if len(words) > 1:
            try:
                names.setdefault(str(ipaddress.ip_address(words[0])), words[1])
            except ValueError:
                continue
    return names
