from pathlib import Path

import pytest

from appliance.signing.site_keys import UnsignedError, checked_key, name_of, read_signature, signer
from tests.support.site_key import LINE, NAME, OTHER_KEY, OTHER_LINE, signed

TEXT = "a policy ä\n"
# Output of `ssh-keygen -Y sign -n rosrv -f KEY` for TEXT and the key of LINE, then with `-O hashalg=sha256`, then for
# `-n file`; the last is of another kind of key.
BEGIN, END = "-----BEGIN SSH SIGNATURE-----\n", "-----END SSH SIGNATURE-----\n"
_PUBLIC = "U1NIU0lHAAAAAQAAADMAAAALc3NoLWVkMjU1MTkAAAAgA6EHv/POEL4dcN0Y50vAmWfk1j\n"
OPENSSH = f"""{BEGIN}{_PUBLIC}CbpQ1fHdyGZBJVMbgAAAAFcm9zcnYAAAAAAAAABnNoYTUxMgAAAFMAAAALc3NoLWVkMjU1
MTkAAABAcFNezwRUQsncLuErA79t3F7IQxrIrVGhTfxwzPTDovZcOBQKy8nqy317acic3u
DW0edgqmcZL0e8qUg3snBsAg==
{END}"""
OF_SHA256 = f"""{BEGIN}{_PUBLIC}CbpQ1fHdyGZBJVMbgAAAAFcm9zcnYAAAAAAAAABnNoYTI1NgAAAFMAAAALc3NoLWVkMjU1
MTkAAABAO3xInnCnfUjujbJyY8I1iAS25b6Dt94IomdnsNFzjmE49PUdU/LF2w1uTetfBj
w3mKU+qDPTRxJjUvbOLO1CCw==
{END}"""
OF_FILE = f"""{BEGIN}{_PUBLIC}CbpQ1fHdyGZBJVMbgAAAAEZmlsZQAAAAAAAAAGc2hhNTEyAAAAUwAAAAtzc2gtZWQyNTUx
OQAAAEDAaYomZVemD+D+MQGVFCc0QsjhaNFFNwfJXLt4t518N+RUGHYdrlGnhT2xLygVpj
ArHmunJyfD32CbmRpI11oD
{END}"""
OF_ECDSA = f"""{BEGIN}U1NIU0lHAAAAAQAAAGgAAAATZWNkc2Etc2hhMi1uaXN0cDI1NgAAAAhuaXN0cDI1NgAAAE
EE3EWA01nz2hoS+SAm4jss6jz8kJUKJao1/BRG2mMLr3w0np9lamvmdUeAAf5kbcvy9Sfe
PmwPcU98DtLiUo7mkQAAAAVyb3NydgAAAAAAAAAGc2hhNTEyAAAAZAAAABNlY2RzYS1zaG
EyLW5pc3RwMjU2AAAASQAAACBP2FwO5A9vd0QuC/VXZPldgqvCbW/98RYiq1TsCK3YgQAA
ACEApIhnpdGjdF9HHm+vAXk/KSt3Z7TQEDyKJzsKxJvmkYU=
{END}"""


@pytest.mark.parametrize("signature", [OPENSSH, OF_SHA256, OPENSSH.replace("\n", "\r\n"), f"\n{OPENSSH}\n"])
def test_a_signature_by_openssh_is_accepted(signature: str) -> None:
    assert signer([OTHER_LINE, LINE], TEXT, signature) == NAME == name_of(LINE)


def test_a_signature_is_openssh_s_byte_for_byte() -> None:
    assert signed(TEXT) == OPENSSH


@pytest.mark.parametrize(
    ("text", "signature", "why"),
    [
        (TEXT, "", "it has no signature of the site"),
        (TEXT + "#", OPENSSH, f"it is not the text that {NAME} signed"),
        (TEXT, signed(TEXT + "#"), f"it is not the text that {NAME} signed"),
        (TEXT, signed(TEXT, OTHER_KEY), "which is none of site_keys in appliance.yaml"),
        (TEXT, OF_FILE, "its signature is for b'file', not for rosrv"),
        (TEXT, OF_ECDSA, "its signature is not one of `rosrv sign`"),
        (TEXT, OPENSSH.replace("U1NI", "U1NJ"), "its signature is not one of `rosrv sign`"),
        (TEXT, OPENSSH.replace("AAAAAQAAADMA", "AAAAAgAAADMA"), "its signature is not one of `rosrv sign`"),
        (TEXT, OPENSSH.replace("DW0ed", "DW0eD"), f"it is not the text that {NAME} signed"),
        (TEXT, OPENSSH[:-60], "its signature is not one of `rosrv sign`"),
        (TEXT, f"{BEGIN}\n{END}", "its signature is not one of `rosrv sign`"),
        (TEXT, f"{BEGIN}=\n{END}", "its signature is not one of `rosrv sign`"),
        (TEXT, f"{BEGIN}U1NIU0lHAAAAAf////8=\n{END}", "its signature is not one of `rosrv sign`"),
    ],
)
def test_anything_else_is_refused_with_what_to_do(text: str, signature: str, why: str) -> None:
    with pytest.raises(UnsignedError) as refused:
        signer([LINE], text, signature)
    assert str(refused.value).startswith(why) or why in str(refused.value)
    assert "sign" in str(refused.value)


def test_every_bit_of_a_signature_counts() -> None:
    body = OPENSSH.removeprefix(BEGIN).removesuffix(END)
    taken = []
    for place, character in enumerate(body):
        if character in "\n=":
            continue
        changed = body[:place] + ("B" if character == "A" else "A") + body[place + 1 :]
        try:
            taken.append((place, signer([LINE], TEXT, BEGIN + changed + END)))
        except UnsignedError:
            continue
    assert taken == []


def test_without_keys_no_signature_is_needed() -> None:
    assert signer([], TEXT, "") == signer([], TEXT, "nonsense") == ""


@pytest.mark.parametrize(
    "line",
    [
        "",
        "ssh-ed25519",
        "ssh-rsa AAAA",
        "ssh-ed25519 AAAA",
        f"ssh-rsa {LINE.split()[1]}",
        LINE.replace("I", "", 1),
    ],
)
def test_an_invalid_key_is_an_error(line: str) -> None:
    with pytest.raises(ValueError, match="ssh-keygen -t ed25519"):
        checked_key(line)
    assert checked_key(LINE) == LINE


def test_a_signature_beside_a_file_is_read_up_to_a_bound(tmp_path: Path) -> None:
    file = tmp_path / "p.ini"
    assert read_signature(file) == ""
    (tmp_path / "p.ini.sig").write_text(OPENSSH)
    assert read_signature(file) == OPENSSH
    (tmp_path / "p.ini.sig").write_text(OPENSSH + " " * (1 << 20))
    assert len(read_signature(file)) == 8192
    (tmp_path / "q.ini.sig").mkdir()
    assert read_signature(tmp_path / "q.ini") == ""
