import errno
import socket
import struct

import pytest

from appliance.features.standby.witness.idle_connections import forget, forgetting, sockets_with


def test_connections_are_found_in_the_tables_of_the_kernel() -> None:
    row = "   0: {} {} {} 00000000:00000000 00:00000000 00000000 0 0 1"
    mapped = "0000000000000000FFFF0000"
    table = "\n".join(
        [
            "head",
            row.format("0100000A:D431", "0200000A:2C2F", "01"),
            row.format("0100000A:D432", "0200000A:2C2F", "0A"),
            row.format("0100000A:D433", "0300000A:2C2F", "01"),
        ]
    )
    table6 = "\n".join(
        [
            "head",
            row.format(mapped + "0100000A:D434", mapped + "0200000A:2C2F", "08"),
            row.format("0" * 32 + ":D434", "1" * 32 + ":1", "01"),
        ]
    )
    assert sockets_with({"10.0.0.2"}, [table, table6]) == [
        ("10.0.0.1", 0xD431, "10.0.0.2", 11311),
        ("10.0.0.1", 0xD434, "10.0.0.2", 11311),
    ]


def test_a_message_deletes_a_connection_from_the_tracker() -> None:
    """The attributes of nfnetlink_conntrack.h are nested, and each is padded to four bytes."""
    message = forgetting(("10.0.0.1", 0xD431, "10.0.0.2", 11311))
    assert struct.unpack("=IHHII", message[:16]) == (len(message), 0x102, 1, 0, 0)
    tuple_of = (
        "3400018014000180080001000a000001080002000a0000021c000280050001000600000006000200d431000006000300"
    )
    assert message[16:].hex() == "02000000" + tuple_of + "2c2f0000"


def test_a_kernel_without_the_trackers_interface_stops_no_witness(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_given: object) -> None:
        raise OSError(errno.EPROTONOSUPPORT, "Protocol not supported")

    monkeypatch.setattr(socket, "socket", missing)
    forget([("10.0.0.1", 0xD431, "10.0.0.2", 11311)])
