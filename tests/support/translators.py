"""NAT rules of other programs for their guests, exactly as these programs write them.

Each `Translator` is a network behind the machine (containers, virtual machines, clients of a hotspot).
"""

import subprocess
from dataclasses import dataclass

from appliance.network import interfaces
from appliance.network.namespaces import Namespace
from examples.landshark.lab import Host


@dataclass(frozen=True)
class Translator:
    program: str
    form: str  # nft, iptables-legacy-restore, iptables-nft-restore, ip6tables-…
    interface: str
    network: str  # "172.17.0": the machine is .1, the guest .2
    rules: str

    @property
    def chain(self) -> str:
        if self.form == "nft":
            table = self.rules.split(" {")[0].removeprefix("table ")
            chains = self.rules.split("\n    chain ")[1:]
            return f"nftables chain {table} {next(chain.split()[0] for chain in chains if 'masquerade' in chain)}"
        name = next(line.split()[1] for line in self.rules.splitlines() if "-j MASQUERADE" in line)
        return (
            f"iptables-legacy chain nat {name}" if "legacy" in self.form else f"nftables chain ip nat {name}"
        )

    @property
    def name(self) -> str:
        return f"{self.program}, {self.form.removesuffix('-restore')}"


_DOCKER = """*nat
:DOCKER - [0:0]
-A PREROUTING -m addrtype --dst-type LOCAL -j DOCKER
-A OUTPUT ! -d 127.0.0.0/8 -m addrtype --dst-type LOCAL -j DOCKER
-A POSTROUTING -s 172.17.0.0/16 ! -o docker0 -j MASQUERADE
-A DOCKER -i docker0 -j RETURN
COMMIT
*filter
:FORWARD DROP [0:0]
:DOCKER - [0:0]
:DOCKER-USER - [0:0]
-A DOCKER-USER -i veth-riso+ -j ACCEPT
-A DOCKER-USER -o veth-riso+ -j ACCEPT
-A FORWARD -j DOCKER-USER
-A FORWARD -o docker0 -m conntrack --ctstate RELATED,ESTABLISHED -j ACCEPT
-A FORWARD -o docker0 -j DOCKER
-A FORWARD -i docker0 ! -o docker0 -j ACCEPT
-A FORWARD -i docker0 -o docker0 -j ACCEPT
COMMIT
"""
_DOCKER_NFT = """table ip docker-bridges {
    chain nat-postrouting {
        type nat hook postrouting priority srcnat; policy accept;
        oifname != "docker0" ip saddr 172.17.0.0/16 counter masquerade
    }
    chain filter-FORWARD {
        type filter hook forward priority filter; policy accept;
        oifname "docker0" ct state established,related counter accept
        iifname "docker0" counter accept
    }
}
"""
_LIBVIRT = """*nat
:LIBVIRT_PRT - [0:0]
-A POSTROUTING -j LIBVIRT_PRT
-A LIBVIRT_PRT -s 192.168.122.0/24 -d 224.0.0.0/24 -j RETURN
-A LIBVIRT_PRT -s 192.168.122.0/24 -d 255.255.255.255/32 -j RETURN
-A LIBVIRT_PRT -s 192.168.122.0/24 ! -d 192.168.122.0/24 -p tcp -j MASQUERADE --to-ports 1024-65535
-A LIBVIRT_PRT -s 192.168.122.0/24 ! -d 192.168.122.0/24 -p udp -j MASQUERADE --to-ports 1024-65535
-A LIBVIRT_PRT -s 192.168.122.0/24 ! -d 192.168.122.0/24 -j MASQUERADE
COMMIT
*filter
:LIBVIRT_FWI - [0:0]
:LIBVIRT_FWO - [0:0]
-A FORWARD -j LIBVIRT_FWI
-A FORWARD -j LIBVIRT_FWO
-A LIBVIRT_FWI -d 192.168.122.0/24 -o virbr0 -m conntrack --ctstate RELATED,ESTABLISHED -j ACCEPT
-A LIBVIRT_FWI -o virbr0 -j REJECT --reject-with icmp-port-unreachable
-A LIBVIRT_FWO -s 192.168.122.0/24 -i virbr0 -j ACCEPT
-A LIBVIRT_FWO -i virbr0 -j REJECT --reject-with icmp-port-unreachable
COMMIT
"""
_LIBVIRT_NFT = """table ip libvirt_network {
    chain guest_output {
        ip saddr 192.168.122.0/24 iifname "virbr0" counter accept
        iifname "virbr0" counter reject
    }
    chain guest_input {
        oifname "virbr0" ip daddr 192.168.122.0/24 ct state related,established counter accept
        oifname "virbr0" counter reject
    }
    chain guest_nat {
        ip saddr 192.168.122.0/24 ip daddr 224.0.0.0/24 counter return
        ip saddr 192.168.122.0/24 ip daddr 255.255.255.255 counter return
        meta l4proto tcp ip saddr 192.168.122.0/24 ip daddr != 192.168.122.0/24 counter masquerade to :1024-65535
        meta l4proto udp ip saddr 192.168.122.0/24 ip daddr != 192.168.122.0/24 counter masquerade to :1024-65535
        ip saddr 192.168.122.0/24 ip daddr != 192.168.122.0/24 counter masquerade
    }
    chain forward {
        type filter hook forward priority filter; policy accept;
        counter jump guest_input
        counter jump guest_output
    }
    chain postroute_nat {
        type nat hook postrouting priority srcnat; policy accept;
        counter jump guest_nat
    }
}
"""
_NETAVARK = """*nat
:NETAVARK-1D8721804F16F - [0:0]
:NETAVARK-HOSTPORT-MASQ - [0:0]
-A POSTROUTING -j NETAVARK-HOSTPORT-MASQ
-A POSTROUTING -s 10.88.0.0/16 -j NETAVARK-1D8721804F16F
-A NETAVARK-1D8721804F16F -d 10.88.0.0/16 -j ACCEPT
-A NETAVARK-1D8721804F16F ! -d 224.0.0.0/4 -j MASQUERADE
-A NETAVARK-HOSTPORT-MASQ -m comment --comment "netavark portfw masq mark" -m mark --mark 0x2000/0x2000 -j MASQUERADE
COMMIT
*filter
:NETAVARK_FORWARD - [0:0]
-A FORWARD -m comment --comment "netavark firewall rules" -j NETAVARK_FORWARD
-A NETAVARK_FORWARD -d 10.88.0.0/16 -m conntrack --ctstate RELATED,ESTABLISHED -j ACCEPT
-A NETAVARK_FORWARD -s 10.88.0.0/16 -j ACCEPT
COMMIT
"""
_NETAVARK_NFT = """table inet netavark {
    chain nv_2f259bab_10_88_0_0_nm16 {
        ip daddr 10.88.0.0/16 accept
        ip daddr != 224.0.0.0/4 masquerade
    }
    chain POSTROUTING {
        type nat hook postrouting priority srcnat; policy accept;
        meta mark & 0x00002000 == 0x00002000 masquerade
        ip saddr 10.88.0.0/16 jump nv_2f259bab_10_88_0_0_nm16
    }
    chain FORWARD {
        type filter hook forward priority filter; policy accept;
        ct state invalid drop
        ip daddr 10.88.0.0/16 ct state related,established accept
        ip saddr 10.88.0.0/16 accept
    }
}
"""
_HOTSPOT = """*nat
-A POSTROUTING -s 10.42.0.0/24 ! -d 10.42.0.0/24 -m comment --comment nm-shared-wlan0 -j MASQUERADE
COMMIT
*filter
:nm-sh-fw-wlan0 - [0:0]
-A FORWARD -m comment --comment nm-shared-wlan0 -j nm-sh-fw-wlan0
-A nm-sh-fw-wlan0 -d 10.42.0.0/24 -o wlan0 -m state --state RELATED,ESTABLISHED -j ACCEPT
-A nm-sh-fw-wlan0 -s 10.42.0.0/24 -i wlan0 -j ACCEPT
-A nm-sh-fw-wlan0 -i wlan0 -o wlan0 -j ACCEPT
-A nm-sh-fw-wlan0 -o wlan0 -j REJECT --reject-with icmp-port-unreachable
-A nm-sh-fw-wlan0 -i wlan0 -j REJECT --reject-with icmp-port-unreachable
COMMIT
"""
_HOTSPOT_NFT = """table ip nm-shared-wlan0 {
    chain nat_postrouting {
        type nat hook postrouting priority srcnat; policy accept;
        ip saddr 10.42.0.0/24 ip daddr != 10.42.0.0/24 masquerade
    }
    chain filter_forward {
        type filter hook forward priority filter; policy accept;
        ip daddr 10.42.0.0/24 oifname "wlan0" ct state { established, related } accept
        ip saddr 10.42.0.0/24 iifname "wlan0" accept
        iifname "wlan0" oifname "wlan0" accept
        iifname "wlan0" reject
        oifname "wlan0" reject
    }
}
"""
_FIREWALLD_NFT = """table inet firewalld {
    chain nat_POST_public_allow {
        meta nfproto ipv4 oifname != "lo" masquerade
    }
    chain nat_POSTROUTING {
        type nat hook postrouting priority srcnat + 10; policy accept;
        jump nat_POST_public_allow
    }
}
"""


def _iptables(program: str, interface: str, network: str, rules: str) -> tuple[Translator, ...]:
    forms = ("iptables-legacy-restore", "iptables-nft-restore")
    return tuple(Translator(program, form, interface, network, rules) for form in forms)


TRANSLATORS = (
    *_iptables("docker", "docker0", "172.17.0", _DOCKER),
    Translator("docker", "nft", "docker0", "172.17.0", _DOCKER_NFT),
    *_iptables("libvirt", "virbr0", "192.168.122", _LIBVIRT),
    Translator("libvirt", "nft", "virbr0", "192.168.122", _LIBVIRT_NFT),
    *_iptables("netavark", "podman0", "10.88.0", _NETAVARK),
    Translator("netavark", "nft", "podman0", "10.88.0", _NETAVARK_NFT),
    *_iptables("NetworkManager", "wlan0", "10.42.0", _HOTSPOT),
    Translator("NetworkManager", "nft", "wlan0", "10.42.0", _HOTSPOT_NFT),
    Translator("firewalld", "nft", "virbr1", "192.168.99", _FIREWALLD_NFT),
)


def load(machine: Namespace, form: str, rules: str) -> None:
    command = ["nft", "-f", "-"] if form == "nft" else [form, "--noflush"]
    process = machine.popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    said, _ = process.communicate(rules, timeout=60)
    assert process.returncode == 0, said


def guest_behind(machine: Namespace, guest: Namespace, translator: Translator) -> Host:
    interfaces.create_bridge(machine, translator.interface)
    interfaces.add_address(machine, translator.interface, f"{translator.network}.1/24")
    interfaces.add_address(machine, translator.interface, "fd88::1/64")
    host = plugged(machine, guest, translator.interface, translator.network)
    interfaces.add_address(guest, "eth0", "fd88::2/64")
    interfaces.add_route(guest, "default", "fd88::1")
    for family in ("ipv4", "ipv6"):
        machine.sysctl(f"net/{family}/conf/all/forwarding", "1")
    load(machine, translator.form, translator.rules)
    return Host("guest", guest, "", (*host.interfaces, "fd88::2/64"))


def plugged(machine: Namespace, guest: Namespace, bridge: str, network: str) -> Host:
    interfaces.create_veth(guest, "eth0", machine, "vguest")
    interfaces.attach(machine, "vguest", bridge)
    interfaces.set_link(guest, "lo", up=True)
    interfaces.add_address(guest, "eth0", f"{network}.2/24")
    interfaces.add_route(guest, "default", f"{network}.1")
    return Host("guest", guest, "", (f"{network}.2/24",))
