"""Run Canaille, an independent provider of single sign-on, whose dependencies have their own lock."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from joserfc.jwk import RSAKey
from playwright.sync_api import Page

from examples.landshark.lab import Host
from tests.support.certificates import Certificates
from tests.support.processes import Process
from tests.support.waiting import eventually

LOCK = Path(__file__).parents[1] / "system" / "console" / "canaille.lock"
NAME, PORT = "logs.example", 9444  # the certificate's name; no name is looked up
ISSUER = f"https://{NAME}:{PORT}"
CLIENT, SECRET = "rosrv", "a secret of the test, with: signs/+"
_UV = Path(sys.executable).with_name("uv")


class Canaille:
    def __init__(self, host: Host, folder: Path, certificates: Certificates, redirect_uri: str) -> None:
        self._host, self._folder, self._certificates = host, folder, certificates
        self._program = folder / "environment" / "bin" / "canaille"
        environment = str(folder / "environment")
        sync = ["pip", "sync", "--require-hashes", "--python", f"{environment}/bin/python", str(LOCK)]
        for command in (["venv", environment], sync):
            subprocess.run([_UV, "--quiet", *command], check=True, timeout=240)
        self._write_settings()
        self._run("install")
        lists = {"scope": ["openid", "profile", "email", "groups"], "redirect-uris": [redirect_uri]}
        options = [f"--{name}={value}" for name, values in lists.items() for value in values]
        grant = ["--grant-types=authorization_code", "--response-types=code", "--client-name=rosrv"]
        self._run(
            "create", "client", f"--client-id={CLIENT}", f"--client-secret={SECRET}", *grant, *options,
            "--token-endpoint-auth-method=client_secret_basic",
        )  # fmt: skip
        self._run("set", "client", CLIENT, f"--audience={CLIENT}")

    def add(self, groups: Mapping[str, Sequence[str]]) -> None:
        people = {person for members in groups.values() for person in members}
        for person in sorted(people):
            names = [f"--{field}={person}" for field in ("user-name", "display-name", "family-name")]
            mail = f"--emails={person}@example.org"
            self._run(
                "create", "user", *names, f"--password={person * 2}", f"--formatted-name={person}", mail
            )
        for group, members in groups.items():
            self._run("create", "group", f"--display-name={group}", *(f"--members={one}" for one in members))

    def rename_group(self, group: str, name: str) -> None:
        self._run("set", "group", group, f"--display-name={name}")

    @contextmanager
    def running(self) -> Iterator[None]:
        self._write_settings()
        certificate = [
            "--certfile",
            str(self._certificates.certificate),
            "--keyfile",
            str(self._certificates.key),
        ]
        command = [str(self._program), "run", "--bind", f"0.0.0.0:{PORT}", *certificate]
        process = Process(self._host, command, env=self._environment(), label="canaille")
        url = f"{ISSUER}/.well-known/openid-configuration"
        ask = ["curl", "--silent", "--insecure", "--resolve", f"{NAME}:{PORT}:127.0.0.1", url]

        def serves() -> bool:
            done = self._host.popen(ask, stdout=subprocess.PIPE)
            return bool(done.communicate()[0].startswith(b"{"))

        try:
            eventually(serves, process.story, 60)
            yield
        finally:
            process.stop()

    def _write_settings(self) -> None:
        fields = RSAKey.generate_key(2048, auto_kid=True).as_dict(private=True)
        key = ", ".join(f"{name} = {json.dumps(value)}" for name, value in fields.items())
        (self._folder / "canaille.toml").write_text(f"""\
SECRET_KEY = "of the test"
SERVER_NAME = "{NAME}:{PORT}"
[CANAILLE]
JAVASCRIPT = false
[CANAILLE_SQL]
DATABASE_URI = "sqlite:///{self._folder}/canaille.db"
PASSWORD_SCHEMES = "plaintext"
[CANAILLE_OIDC]
ACTIVE_JWKS = [{{{key}}}]
""")

    def _environment(self) -> dict[str, str]:
        return {**os.environ, "CANAILLE_CONFIG": str(self._folder / "canaille.toml")}

    def _run(self, *arguments: str) -> None:
        command = [str(self._program), *arguments]
        environment = self._environment()
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, f"{arguments}\n{done.stdout}\n{done.stderr}"


def sign_in(page: Page, person: str) -> None:
    login, password = page.locator("input[name=login]"), page.locator("input[name=password]")
    login.or_(password).wait_for()
    if login.count():  # unless it knows the person, and wants a proof
        login.fill(person)
        page.keyboard.press("Enter")
    password.fill(person * 2)
    page.keyboard.press("Enter")
    accept = page.get_by_role("button", name="Accept")  # asked once
    accept.or_(page.locator(".who-name")).or_(page.get_by_text("Not signed in")).wait_for()
    if accept.count():
        accept.click()
