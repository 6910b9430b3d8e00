from pathlib import Path

from appliance.network.machine_addresses import machine_addresses

TRIE = """\
Main:
  +-- 0.0.0.0/0 3 0 5
     |-- 127.0.0.1
        /32 host LOCAL
     |-- 192.168.1.0
        /24 link UNICAST
     |-- 192.168.1.2
        /32 host LOCAL
     |-- 192.168.1.255
        /32 link BROADCAST
Local:
     |-- 192.168.1.2
        /32 host LOCAL
     |-- 10.0.0.7
        /32 host LOCAL
"""
INET6 = """\
fd000000000000000000000000000002 04 40 00 82     eth0
fe8000000000000000fc00fffe000001 04 40 20 80     eth0
00000000000000000000000000000001 01 80 10 80       lo
"""


def test_addresses_without_loopback_and_link_local(tmp_path: Path) -> None:
    (tmp_path / "fib_trie").write_text(TRIE)
    (tmp_path / "if_inet6").write_text(INET6)
    assert machine_addresses(tmp_path) == ("10.0.0.7", "192.168.1.2", "fd00::2")


def test_a_kernel_without_a_family_has_no_addresses_of_it(tmp_path: Path) -> None:
    assert machine_addresses(tmp_path) == ()
    (tmp_path / "fib_trie").write_text(TRIE)
    assert machine_addresses(tmp_path) == ("10.0.0.7", "192.168.1.2")


def test_their_number_is_bounded(tmp_path: Path) -> None:
    rows = [
        f"     |-- 10.1.{number // 256}.{number % 256}\n        /32 host LOCAL\n" for number in range(1000)
    ]
    (tmp_path / "fib_trie").write_text("".join(rows))
    assert len(machine_addresses(tmp_path)) == 64
