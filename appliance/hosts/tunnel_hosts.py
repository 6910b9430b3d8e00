"""Define what other parts of control need of the hosts in tunnels; this class is for a product without tunnels."""

from appliance.channel.answers.host_answers import Host
from appliance.channel.answers.status import IpsecState
from appliance.hosts.host_table import HostRefusedError


class TunnelHosts:
    """The hosts in tunnels."""

    _text = ""

    @property
    def bundled(self) -> str:
        """The bundle's text that is used instead of hosts.yaml."""
        return self._text

    async def take_bundle(self, text: str, who: str) -> object:
        """An empty text stands for the file. Raises `HostRefusedError`."""
        del who
        if text.strip():
            raise HostRefusedError("the bundle declares hosts, and this appliance has no tunnels")
        self._text = text
        return None

    async def read_again(self, who: str) -> None:
        """Read hosts.yaml. Raises `HostRefusedError` and `StoreError`."""

    def status(self) -> IpsecState:
        return IpsecState(
            esp=None, key_exchange=[], post_quantum=None, charon=None, pool="", address="", hosts_file="",
            enrolled=0, awaited=0, up=0, troubles=[], ports={},
        )  # fmt: skip

    def rows(self) -> list[Host]:
        """The hosts are enrolled, awaited or declared."""
        return []

    def served_by(self, pin: str) -> None:
        """Hosts recognise the api by the pin."""
