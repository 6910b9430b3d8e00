"""Delete entries of the connection tracker.

Address translation applies only to the first packet of a connection. A host that keeps sending UDP (IKE, ESP in
UDP) keeps its old entry alive, so changed rules would not redirect its packets.
"""

import errno
import socket
from collections.abc import Iterable

from appliance.network import interfaces, netlink
from appliance.network.namespaces import Namespace, NetworkError

_FAMILIES = (socket.AF_INET, socket.AF_INET6)


def forget(namespace: Namespace, ports: Iterable[int]) -> int:
    """Delete the entries of the namespace's own addresses; return their number. Raises `NetworkError`."""
    pyroute2 = netlink.loaded()
    own = {address.partition("/")[0] for address in interfaces.addresses(namespace)}
    try:
        return namespace.run(
            lambda: sum(_forget(family, port, own) for family in _FAMILIES for port in ports)
        )
    except (pyroute2.NetlinkError, OSError) as error:
        raise NetworkError(f"deleting entries of the connection tracker: {error}") from error


def _forget(family: int, port: int, own: set[str]) -> int:
    pyroute2 = netlink.loaded()
    tuples = pyroute2.netlink.nfnetlink.nfctsocket.NFCTAttrTuple
    wanted = tuples(family=family, proto=socket.IPPROTO_UDP, dport=port)
    deleted = 0
    with pyroute2.NFCTSocket(nfgen_family=family) as tracker:
        for message in list(tracker.dump(tuple_orig=wanted)):
            entry = tuples.from_netlink(family, message.get_attr("CTA_TUPLE_ORIG"))
            # Kernels before 5.8 do not filter.
            if (entry.proto, entry.dport) != (wanted.proto, port) or entry.daddr not in own:
                continue
            try:
                tracker.entry("del", tuple_orig=entry)
            except pyroute2.NetlinkError as error:
                if error.code != errno.ENOENT:  # ENOENT: the entry ended before its removal
                    raise
            else:
                deleted += 1
    return deleted
