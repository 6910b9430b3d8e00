"""The web hook: a real receiver with TLS, which first answers with a redirect to another one."""

import contextlib
import hashlib
import hmac
import http.server
import json
import ssl
import threading
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.support.appliance import Appliance
from tests.support.certificates import Certificates, make_certificates
from tests.support.waiting import eventually

SECRET = "a secret of this site"  # noqa: S105  of this test
POLICY = """
[Nodes]
default = *
[Publishers]
default = *
/goal = 10.9.9.9 ask 127.0.0.1
[Subscribers]
default = *
[Commands]
default = *
"""


def _answer(request: Any) -> None:
    body = request.rfile.read(int(request.headers["Content-Length"]))
    request.server.got.append((request.path, dict(request.headers), body))
    request.send_response(request.server.status)
    request.send_header("Location", "/elsewhere")
    request.end_headers()


_RECEIVER = type(
    "Receiver",
    (http.server.BaseHTTPRequestHandler,),
    {"do_POST": _answer, "log_message": lambda *_words: None},
)


@contextlib.contextmanager
def receiver(made: Certificates) -> Iterator[Any]:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(made.certificate, made.key)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), _RECEIVER) as server:
        server.got, server.status = [], 307  # type: ignore[attr-defined]  # the handler finds them here
        server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def test_a_waiting_call_is_sent_once_and_a_dead_receiver_is_a_warning(tmp_path: Path) -> None:
    made = make_certificates(tmp_path / "certificates")
    (tmp_path / "secret").write_text(f"{SECRET}\n")
    with receiver(made) as server:
        port = server.server_port
        settings = json.dumps({
            "name": "lift-7",
            "approval_hook": {
                "url": f"https://127.0.0.1:{port}/hook", "address": f"127.0.0.1:{port}", "ca": str(made.ca),
                "secret_file": str(tmp_path / "secret"), "console": "https://lift-7:8443",
            },
        })  # fmt: skip
        with Appliance(policy=POLICY, settings=settings) as appliance:

            def wants(node: str) -> str:
                with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
                    answer: Any = master.registerPublisher(
                        node, "/goal", "std_msgs/String", "http://127.0.0.1:1/"
                    )
                return str(answer[1])

            assert "held for approval" in wants("/agent")
            eventually(lambda: server.got, "the receiver gets the call")
            wants("/agent")
            [(path, headers, body)] = server.got
            assert path == "/hook", "no redirect is followed"
            time, signature = (word.partition("=")[2] for word in headers["ROSRV-Signature"].split(","))
            assert (
                signature == hmac.new(SECRET.encode(), f"{time}.".encode() + body, hashlib.sha256).hexdigest()
            )
            sent = json.loads(body)
            [row] = appliance.rest().get("/v1/approvals").json["approvals"]
            assert (sent["number"], sent["resource"], sent["robot"]) == (row["number"], "/goal", "lift-7")
            assert sent["console"] == "https://lift-7:8443/console/robot"
            eventually(lambda: appliance.status()["approvals"]["unsent"], "a redirect is no acceptance")
            assert f"127.0.0.1:{port} answered 307" in appliance.rosrv("status", check=False).stdout

            def waits_again() -> None:
                [row] = appliance.rest().get("/v1/approvals").json["approvals"]
                appliance.rosrv("approve", str(row["number"]), "--for", "1s")
                eventually(lambda: "held for approval" in wants("/agent"), "it waits again")

            server.status = 204
            waits_again()
            eventually(lambda: not appliance.status()["approvals"]["unsent"], "the receiver took it")
            server.shutdown()
            server.server_close()
            waits_again()
            eventually(lambda: appliance.status()["approvals"]["unsent"], "the failure is counted")
            assert "the web hook did not get" in appliance.rosrv("status", check=False).stdout
