"""Tests of `appliance.supervisor.offline`, in a process of their own: there is no way back."""

import json
import subprocess
import sys

_PROGRAM = """
import json, os, socket
from appliance.supervisor import offline, privileges
from appliance.supervisor.users import Account
privileges.drop(Account("me", os.geteuid() or 61015, os.getegid() or 61015), parent=os.getppid())
offline.forbid_sockets()

def outcome(*arguments):
    try:
        socket.socket(*arguments).close()
    except OSError as error:
        return error.strerror
    return "made"

print(json.dumps({
    "tcp": outcome(socket.AF_INET, socket.SOCK_STREAM),
    "tcp6": outcome(socket.AF_INET6, socket.SOCK_STREAM),
    "udp": outcome(socket.AF_INET, socket.SOCK_DGRAM),
    "netlink": outcome(socket.AF_NETLINK, socket.SOCK_RAW),
    "unix": outcome(socket.AF_UNIX, socket.SOCK_STREAM),
    "child": os.system("exec " + %r),
}))
"""
_CHILD = f"{sys.executable} -c 'import socket; socket.socket()' 2>/dev/null"


def test_only_unix_sockets_can_be_made() -> None:
    """A process that forbade itself sockets gets none of any network, nor do the programs it starts."""
    program = _PROGRAM % _CHILD
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    outcome = json.loads(done.stdout)
    assert outcome.pop("unix") == "made"
    assert outcome.pop("child") != 0
    assert set(outcome.values()) == {"Permission denied"}
