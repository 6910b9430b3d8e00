import socket
import ssl
import threading
from functools import partial
from pathlib import Path

import pytest

from appliance.features.syslog.receiver import DatagramReceiver, StreamReceiver, tls_context
from tests.support.certificates import Certificates, make_certificates
from tests.support.processes import LIMIT
from tests.support.syslog import DatagramCollector, StreamCollector

HOST = "127.0.0.1"


def message(number: int) -> bytes:
    return f'<110>1 - robot rosrv - decision [rosrv@32473 sequence="{number}"]'.encode()


def server_context(certificates: Certificates, *, clients: bool = False) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificates.certificate, certificates.key)
    if clients:
        context.load_verify_locations(certificates.ca)
        context.verify_mode = ssl.CERT_REQUIRED
    return context


@pytest.mark.nightly
def test_udp_sends_datagrams() -> None:
    with DatagramCollector() as collector:
        receiver = DatagramReceiver(HOST, collector.port)
        receiver.send([message(1), message(2)])
        collector.wait_for(lambda messages: len(messages) == 2)
        assert collector.sequences() == [1, 2]
        receiver.close()


@pytest.mark.nightly
def test_tcp_counts_octets() -> None:
    with StreamCollector() as collector:
        receiver = StreamReceiver(HOST, collector.port)
        receiver.send([message(1), message(2)])
        receiver.send([message(3)])
        collector.wait_for(lambda messages: len(messages) == 3)
        assert collector.sequences() == [1, 2, 3]
        assert collector.connected == 1
        receiver.close()


@pytest.mark.nightly
def test_a_closed_connection_is_an_error() -> None:
    with StreamCollector() as collector:
        receiver = StreamReceiver(HOST, collector.port)
        receiver.send([message(1)])
        collector.wait_for(lambda messages: messages)
        collector.close()
        with pytest.raises(OSError, match=r"closed|reset|refused"):
            receiver.send([message(2)])
        receiver.close()
        with pytest.raises(ConnectionRefusedError):
            receiver.send([message(2)])
        collector.open()
        receiver.send([message(2)])
        collector.wait_for(lambda messages: len(messages) == 2)
        assert collector.sequences() == [1, 2]
        receiver.close()


@pytest.mark.nightly
def test_a_receiver_that_reads_nothing_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("appliance.features.syslog.receiver._SEND_SECONDS", 0.3)
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        listener.bind((HOST, 0))
        listener.listen(1)
        receiver = StreamReceiver(HOST, listener.getsockname()[1])
        with pytest.raises(TimeoutError):
            for _ in range(1000):
                receiver.send([b"x" * 60_000])
        receiver.close()


@pytest.mark.nightly
def test_tls_checks_the_receiver(certificates: Certificates) -> None:
    with StreamCollector(context=server_context(certificates)) as collector:
        for name in (None, "logs.example"):
            receiver = StreamReceiver(
                HOST, collector.port, lambda: tls_context(certificates.ca, None, None), name
            )
            receiver.send([message(1)])
            receiver.close()
        collector.wait_for(lambda messages: len(messages) == 2)


@pytest.mark.nightly
def test_a_wrong_certificate_gets_nothing(certificates: Certificates, tmp_path: Path) -> None:
    other = make_certificates(tmp_path / "other")
    with StreamCollector(context=server_context(certificates)) as collector:
        for ca, name in ((other.ca, None), (certificates.ca, "evil.example")):
            receiver = StreamReceiver(HOST, collector.port, partial(tls_context, ca, None, None), name)
            with pytest.raises(ssl.SSLCertVerificationError):
                receiver.send([message(1)])
            receiver.close()
        assert collector.messages == []


@pytest.mark.nightly
def test_tls_with_client_certificates(certificates: Certificates, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a certificate, the receiver's refusal is an error, although TLS 1.3 reports it late."""
    monkeypatch.setattr("appliance.features.syslog.receiver._OBJECTION_SECONDS", LIMIT)
    with StreamCollector(context=server_context(certificates, clients=True)) as collector:
        receiver = StreamReceiver(
            HOST,
            collector.port,
            lambda: tls_context(certificates.ca, certificates.certificate, certificates.key),
        )
        receiver.send([message(1)])
        collector.wait_for(lambda messages: len(messages) == 1)
        receiver.close()
        bare = StreamReceiver(HOST, collector.port, lambda: tls_context(certificates.ca, None, None))
        with pytest.raises(OSError, match=r"certificate|closed|reset"):
            bare.send([message(2)])
        bare.close()
        assert collector.sequences() == [1]


def test_unreadable_files_are_errors(tmp_path: Path, certificates: Certificates) -> None:
    with pytest.raises(OSError, match=r"nowhere\.pem.*authority"):
        tls_context(tmp_path / "nowhere.pem", None, None)
    with pytest.raises(OSError, match=r"nowhere\.key.*own certificate"):
        tls_context(certificates.ca, certificates.certificate, tmp_path / "nowhere.key")


@pytest.mark.nightly
def test_a_receiver_without_tls_gets_nothing(certificates: Certificates) -> None:
    with socket.socket() as listener:
        listener.bind((HOST, 0))
        listener.listen(1)
        seen: list[bytes] = []

        def answer() -> None:
            connection, _peer = listener.accept()
            with connection:
                seen.append(connection.recv(65_536))
                connection.sendall(b"220 hello\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        receiver = StreamReceiver(
            HOST, listener.getsockname()[1], lambda: tls_context(certificates.ca, None, None)
        )
        with pytest.raises(ssl.SSLError):
            receiver.send([message(1)])
        thread.join()
        receiver.close()
        assert b"rosrv@32473" not in b"".join(seen)
