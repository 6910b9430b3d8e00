"""Make this whole machine, which must be a virtual machine of the tests, a host of a lab."""

import contextlib
from collections.abc import Iterator

from appliance.network import interfaces
from appliance.network.namespaces import Namespace
from examples.landshark.lab import INTERFACE, Host, Lab

_PORT = "port-root"


@contextlib.contextmanager
def root_host(lab: Lab, address: str) -> Iterator[Host]:
    own = Namespace.own()
    switch = lab.switch
    interfaces.create_veth(own, INTERFACE, switch, _PORT)
    try:
        interfaces.attach(switch, _PORT, "br0")
        interfaces.add_address(own, INTERFACE, address)
        yield Host("machine", own, _PORT, (address,))
    finally:
        interfaces.delete_link(own, INTERFACE)
