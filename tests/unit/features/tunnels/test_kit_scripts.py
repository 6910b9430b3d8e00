import os
import re
import subprocess
from pathlib import Path

import pytest

import appliance.features.tunnels

FOLDER = Path(appliance.features.tunnels.__file__).parent / "kit_files"
SCRIPTS = sorted(FOLDER.glob("*.sh"))


@pytest.mark.nightly
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_it_is_for_the_plainest_shell(script: Path) -> None:
    text = script.read_text()
    assert text.startswith("#!/bin/sh\n")
    done = subprocess.run(["/bin/dash", "-n", str(script)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert re.findall(r"\[\[|\bfunction\b|<\(|\blocal -|\$'", text) == []


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_it_needs_no_python(script: Path) -> None:
    assert re.findall(r"python|perl|ruby", script.read_text(), re.IGNORECASE) == []


# Options of curl 7.68 and OpenSSL 1.1.1, from Ubuntu 20.04. Check there before you add one.
_CURL = "silent show-error max-time insecure pinnedpubkey fail data-binary"
_OPENSSL = (
    "x509 pkey ecparam req crl verify dgst base64 pkeyutl"  # pkeyutl -rawin is OpenSSL 3's: for Ed25519 only
)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_it_asks_of_its_tools_what_ubuntu_20_04_has(script: Path) -> None:
    text = re.sub(r"#.*", "", script.read_text()).replace("\\\n", " ")
    calls = re.findall(r"\b(?:curl|call|ask) [^|;&]*", text)
    assert {option for call in calls for option in re.findall(r" --([a-z-]+)", call)} <= set(_CURL.split())
    assert set(re.findall(r"\bopenssl ([a-z0-9]+) -", text)) <= set(_OPENSSL.split())
    raw = [line for line in text.splitlines() if "-rawin" in line]
    assert len(raw) == (script.name == "renew.sh")


@pytest.mark.nightly
def test_a_zombie_does_not_count_as_running() -> None:
    runs = next(line for line in (FOLDER / "stop.inc").read_text().splitlines() if line.startswith("runs() "))
    with subprocess.Popen(["/bin/true"]) as ended:
        os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)
        for pid, status in ((ended.pid, 1), (os.getpid(), 0)):
            assert (
                subprocess.run(["/bin/dash", "-c", f"{runs}\nruns {pid}"], check=False).returncode == status
            )
