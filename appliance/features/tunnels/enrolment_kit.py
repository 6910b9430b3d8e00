"""Make the kit of an enrolled host: an archive with its certificate and all files for its tunnel. No I/O.

The kit uses the host's own strongSwan with its own paths (`/etc/swanctl`), so AppArmor and other tunnels of the
host still work.
"""

import io
import tarfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from string import Template

from appliance.channel.messages import APPLIANCE_NAME
from appliance.features.tunnels.tunnel_answers import KitParts
from appliance.ipsec.strongswan import CHILD, ESP_PROPOSALS, IKE_PROPOSALS

CONNECTION, SECOND = "rosrv", "rosrv-2"  # the scripts find both by the beginning of these names
_SCRIPTS = ("join.sh", "leave.sh", "keep.sh", "renew.sh", "README")


@dataclass(frozen=True)
class Kit:
    host: KitParts
    endpoint: str
    """The address or name of the appliance; `host.second` is that of the other one of two."""
    protect: str
    """An nftables file."""
    key: str | None
    """None if the host made its own key."""

    @property
    def remotes(self) -> dict[str, str]:
        other = {SECOND: self.host.second} if self.host.second not in ("", self.endpoint) else {}
        return {CONNECTION: self.endpoint} | other


def members(kit: Kit) -> list[tuple[str, str, int]]:
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
    renews = bool(host.rest_url and host.pin)
    values |= {"rest": host.rest_url if renews else "", "pin": host.pin if renews else ""}
    values |= {"ike": ", ".join(IKE_PROPOSALS), "esp": ", ".join(ESP_PROPOSALS)}
    for script in _SCRIPTS:
        found.append((script, fill(script, values), 0o644 if script == "README" else 0o755))
    return found


def fill(script: str, values: Mapping[str, str]) -> str:
    """Return a script with these values. `@stop@` stands for the file `stop.inc`."""
    folder = files("appliance.features.tunnels").joinpath("kit_files")
    text, stop = (folder.joinpath(name).read_text(encoding="utf-8") for name in (script, "stop.inc"))
    return _Template(text.replace("@stop@\n", stop)).substitute(values)


def archive(kit: Kit) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for path, content, mode in members(kit):
            data = content.encode()
            entry = tarfile.TarInfo(f"rosrv-{kit.host.name}/{path}")
            entry.size, entry.mode = len(data), mode
            tar.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()


def swanctl_conf(kit: Kit) -> str:
    # charon opens no tunnel: keep.sh notices a lost one in seconds (charon with its own settings in minutes), and opens
    # only one if there are two appliances.
    connections = "".join(_connection(kit, name, remote) for name, remote in kit.remotes.items())
    return f"""\
# The tunnel of {kit.host.name} to the ROSRV appliance. Made by `rosrv host add`.
connections {{
{connections}}}
"""


def _connection(kit: Kit, name: str, remote: str) -> str:
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
        start_action = none
        close_action = none
        dpd_action = clear
      }}
    }}
  }}
"""


class _Template(Template):
    """A template with values such as `@name@`, so that the scripts keep their `$`."""

    delimiter = "@"
    pattern = r"""
    @(?:(?P<escaped>@)|(?P<named>[a-z]+)@|(?P<braced>(?!))|(?P<invalid>(?!)))
    """  # type: ignore[assignment]  # string.Template takes a text here and compiles it itself
