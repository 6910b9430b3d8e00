"""Make charon's configuration: its file, and the tunnels of the enrolled hosts for vici. No I/O.

1. Without a valid revocation list, no host is accepted. The name in the certificate determines the host's only
   address, and no connection matches a host that is not enrolled.
2. charon loads only the plugins listed here. None of them runs programs or requests lists from the network.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from appliance.channel.messages import APPLIANCE_NAME, Esp, TunnelHost, TunnelsStated
from appliance.quotas.table import IKE_HANDSHAKES

PROGRAM = Path("/usr/sbin/charon-systemd")
USER_SPACE_INTERFACE = "ipsec0"
IKE_PROPOSALS = ("aes256gcm16-prfsha384-x25519", "aes256gcm16-prfsha384-ecp384")
ESP_PROPOSALS = ("aes256gcm16-x25519", "aes256gcm16-ecp384")
ML_KEM = "ke1_mlkem768"  # an additional key exchange (RFC 9370), added to the first proposal of each list
_ML_KEM_ALGORITHM = "ML_KEM_768"
CHILD = "ros"
_PLUGINS = ("random", "nonce", "openssl", "pem", "x509", "revocation", "constraints", "pubkey", "kdf")
_PREFIX = "host-"


def plugins(esp: Esp) -> str:
    kernel = ("kernel-libipsec",) if esp == "user space" else ()
    return " ".join((*_PLUGINS, *kernel, "kernel-netlink", "socket-default", "vici"))


def configuration(directory: Path, esp: Esp) -> str:
    """Return charon's configuration; `directory` has the socket."""
    return f"""\
charon-systemd {{
  load = {plugins(esp)}
  retransmit_tries = 4
  retransmit_timeout = 1.0
  retransmit_base = 1.6
  half_open_timeout = 15
  cookie_threshold = 30
  block_threshold = {IKE_HANDSHAKES.bounds.host}
  init_limit_half_open = {IKE_HANDSHAKES.bounds.whole}
  plugins {{
    vici {{
      socket = unix://{directory}/vici.sock
    }}
  }}
  syslog {{
  }}
  filelog {{
    stderr {{
      default = 1
      flush_line = yes
    }}
  }}
}}
"""


@dataclass(frozen=True)
class Proposals:
    """The proposals of charon, best first."""

    ike: tuple[str, ...] = IKE_PROPOSALS
    esp: tuple[str, ...] = ESP_PROPOSALS

    @property
    def key_exchange(self) -> list[str]:
        words = [proposal.removeprefix("aes256gcm16-prfsha384-") for proposal in self.ike]
        return [word.replace("-ke1_", "+") for word in words]


def proposals_of(key_exchanges: Iterable[str]) -> Proposals:
    if _ML_KEM_ALGORITHM not in key_exchanges:
        return Proposals()
    return Proposals(
        (f"{IKE_PROPOSALS[0]}-{ML_KEM}", *IKE_PROPOSALS), (f"{ESP_PROPOSALS[0]}-{ML_KEM}", *ESP_PROPOSALS)
    )


def connection_name(host: str) -> str:
    return _PREFIX + host


def host_of(connection: str) -> str | None:
    return connection.removeprefix(_PREFIX) if connection.startswith(_PREFIX) else None


def pool(host: TunnelHost) -> dict[str, Any]:
    return {connection_name(host.name): {"addrs": f"{host.address}-{host.address}"}}


def connection(host: TunnelHost, stated: TunnelsStated, proposals: Proposals) -> Mapping[str, Any]:
    child = {
        "local_ts": [f"{stated.address}/32"],
        "remote_ts": ["dynamic"],
        "esp_proposals": list(proposals.esp),
        "dpd_action": "clear",
        "close_action": "none",
    }
    return {
        connection_name(host.name): {
            "version": "2",
            "proposals": list(proposals.ike),
            "unique": "replace",
            "encap": "yes",
            "mobike": "yes",
            "dpd_delay": "5s",
            "send_cert": "always",
            "pools": [connection_name(host.name)],
            "local": {"auth": "pubkey", "certs": [stated.certificate], "id": f"fqdn:{APPLIANCE_NAME}"},
            "remote": {
                "auth": "pubkey",
                "cacerts": [stated.authority],
                "id": f"fqdn:{host.name}",
                "revocation": "strict",
            },
            "children": {CHILD: child},
        }
    }
