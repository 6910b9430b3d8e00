"""Make the kit of an enrolled host: an archive with its certificate and all files for its tunnel. No I/O.

The kit uses the host's own strongSwan with its own paths (`/etc/swanctl`), so AppArmor and other tunnels of the host
still work. The tunnel carries only traffic between the host's virtual address and the appliance's.
"""

import io
import tarfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from string import Template

from appliance.channel.answers.host_answers import KitParts
from appliance.channel.messages import APPLIANCE_NAME
from appliance.ipsec.strongswan import CHILD, ESP_PROPOSALS, IKE_PROPOSALS

CONNECTION, SECOND = "rosrv", "rosrv-2"  # the scripts find both by the beginning of these names
_SCRIPTS = {script: script for script in ("join.sh", "leave.sh", "keep.sh", "renew.sh", "README")}
_OF_TWO = {"keep.sh": "keep_either.sh"}


@dataclass(frozen=True)
class Kit:
    """The parts of a kit.

    `endpoint` is the address or name by which the host reaches the appliance; `protect` is an nftables file. `key` is
    None if the host made its own key. `host.second` is the address of the other appliance of two.
    """

    host: KitParts
    endpoint: str
    protect: str
    key: str | None

    @property
    def remotes(self) -> dict[str, str]:
        """Return the appliances' addresses by the name of their connection."""
        other = {SECOND: self.host.second} if self.host.second not in ("", self.endpoint) else {}
        return {CONNECTION: self.endpoint} | other


def members(kit: Kit) -> list[tuple[str, str, int]]:
    """Return the files of a kit: path, text, mode."""
    host = kit.host
    found = [
        ("swanctl/swanctl.conf", swanctl_conf(kit), 0o644),
        ("swanctl/x509ca/rosrv-ca.pem", host.authority, 0o644),
        ("swanctl/x509/rosrv.pem", host.certificate, 0o644),
        ("protect.nft", kit.protect, 0o644),
    ]
    if kit.key is not None:
        found.append(("swanctl/private/rosrv.key", kit.key, 0o600))
    values = {"name": host.name, "address": host.address, "appliance": host.appliance, "master": host.master}
    values |= {
        "endpoint": " or ".join(kit.remotes.values()),
        "connections": " ".join(kit.remotes),
        "child": CHILD,
    }
    values["ping"] = "iputils-ping" if len(kit.remotes) > 1 else ""
    renews = bool(host.rest_url and host.pin)
    values |= {"rest": host.rest_url if renews else "", "pin": host.pin if renews else ""}
    values |= {"ike": ", ".join(IKE_PROPOSALS), "esp": ", ".join(ESP_PROPOSALS)}
    sources = _SCRIPTS | (_OF_TWO if len(kit.remotes) > 1 else {})
    for script, source in sources.items():
        found.append((script, filled(source, values), 0o644 if script == "README" else 0o755))
    return found


def filled(script: str, values: Mapping[str, str]) -> str:
    """Return a script of `kit_files` with its values filled in."""
    text = files("appliance.ipsec").joinpath("kit_files", script).read_text(encoding="utf-8")
    return _Template(text).substitute(values)


def archive(kit: Kit) -> bytes:
    """Return the kit as `.tar.gz`: one folder, `rosrv-NAME`."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for path, content, mode in members(kit):
            data = content.encode()
            entry = tarfile.TarInfo(f"rosrv-{kit.host.name}/{path}")
            entry.size, entry.mode = len(data), mode
            tar.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()


def swanctl_conf(kit: Kit) -> str:
    """Return the host's tunnel in swanctl's format, to each of two appliances if there are two."""
    # charon opens the tunnel to a single appliance. With two, keep_either.sh opens the one that answers: if charon also
    # did, both tunnels could be open at the same time.
    alone = len(kit.remotes) == 1
    start, dpd = ("start", "restart") if alone else ("none", "clear")
    connections = "".join(_connection(kit, name, remote, start, dpd) for name, remote in kit.remotes.items())
    return f"""\
# The tunnel of {kit.host.name} to the ROSRV appliance. Made by `rosrv host add`.
connections {{
{connections}}}
"""


def _connection(kit: Kit, name: str, remote: str, start: str, dpd: str) -> str:
    return f"""\
  {name} {{
    version = 2
    remote_addrs = {remote}
    vips = 0.0.0.0
    proposals = {", ".join(IKE_PROPOSALS)}
    encap = yes
    mobike = yes
    dpd_delay = 5s
    keyingtries = 0
    send_cert = always
    local {{
      auth = pubkey
      certs = rosrv.pem
      id = fqdn:{kit.host.name}
    }}
    remote {{
      auth = pubkey
      cacerts = rosrv-ca.pem
      id = fqdn:{APPLIANCE_NAME}
    }}
    children {{
      {CHILD} {{
        local_ts = dynamic
        remote_ts = {kit.host.appliance}/32
        esp_proposals = {", ".join(ESP_PROPOSALS)}
        start_action = {start}
        close_action = {start}
        dpd_action = {dpd}
      }}
    }}
  }}
"""


class _Template(Template):
    """A template with `@name@` for values, so that the scripts keep their `$`."""

    delimiter = "@"
    pattern = r"""
    @(?:(?P<escaped>@)|(?P<named>[a-z]+)@|(?P<braced>(?!))|(?P<invalid>(?!)))
    """  # type: ignore[assignment]  # string.Template takes a text here and compiles it itself
