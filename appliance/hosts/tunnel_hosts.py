"""Define the interface to the hosts in tunnels, as an appliance without tunnels implements it."""

from appliance.channel.answers.host_answers import Host
from appliance.channel.answers.status import IpsecState
from appliance.hosts.host_table import HostRefusedError


class TunnelHosts:
    _text = ""

    @property
    def bundled(self) -> str:
        return self._text

    async def take_bundle(self, text: str, who: str) -> object:
        """Take the hosts of a bundle; with an empty string, go back to `hosts.yaml`. Raises `HostRefusedError`."""
        del who
        if text.strip():
            raise HostRefusedError(
                "the bundle declares hosts, and this appliance has no tunnels: remove the hosts"
                " from the bundle"
            )
        self._text = text
        return None

    async def read_again(self, who: str) -> None:
        """Read the file again. Raises `HostRefusedError` and `StoreError`."""

    def status(self) -> IpsecState:
        return IpsecState(
            esp=None, key_exchange=[], post_quantum=None, charon=None, pool="", address="", hosts_file="",
            enrolled=0, awaited=0, up=0, troubles=[], ports={},
        )  # fmt: skip

    def rows(self) -> list[Host]:
        return []

    def served_by(self, pin: str) -> None:
        """Note the pin by which hosts recognise the api."""
