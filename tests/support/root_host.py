"""Make this whole machine a host of a lab: its own network namespace on the lab's Ethernet.

Only for a virtual machine of the tests (tests/support/machine.py): the tests change the machine's own network.
"""

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
