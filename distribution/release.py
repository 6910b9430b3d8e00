"""`make release KEY=FILE`: add provenance, checksums and a signature to the files in dist/.

    provenance.json   the origin of each file (an in-toto statement, SLSA provenance 1)
    SHA256SUMS        of every file, as `sha256sum --check` reads them
    SHA256SUMS.sig    ECDSA P-256 over SHA256SUMS, as `cosign verify-blob` and `openssl dgst` check it

The person who releases keeps the key (`openssl ecparam -name prime256v1 -genkey -noout`). The target first builds
everything again, so that all signed files are of one commit.
"""

import base64
import hashlib
import json
import sys
from datetime import UTC, datetime
from pathlib import Path

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from appliance import __version__
from distribution.checkout import ROOT, BuildError, revision, time_of_commit

_OWN = ("provenance.json", "SHA256SUMS", "SHA256SUMS.sig")
_MATERIALS = (
    "requirements.lock",
    "requirements-dev.lock",
    "distribution/image-packages.lock",
    "Dockerfile",
    "fleet/requirements.lock",
    "fleet/Dockerfile",
)


def release(folder: Path, key: Path) -> None:
    """Sign the files in a folder. Raise `BuildError`, or `ValueError` for an unsuitable key or an empty folder."""
    private = _private_key(key)
    if not isinstance(private, ec.EllipticCurvePrivateKey) or private.curve.name != "secp256r1":
        raise ValueError(f"{key} is not a private key on the curve P-256")
    files = {
        path.name: _digest(path)
        for path in sorted(folder.iterdir())
        if path.is_file() and path.name not in _OWN
    }
    if not files:
        raise ValueError(f"{folder} has nothing to sign: make package, make wheel, make image")
    provenance = folder / "provenance.json"
    provenance.write_text(json.dumps(_provenance(files), indent=2) + "\n")
    sums = "".join(
        f"{digest}  {name}\n" for name, digest in (files | {provenance.name: _digest(provenance)}).items()
    )
    (folder / "SHA256SUMS").write_text(sums)
    signature = private.sign(sums.encode(), ec.ECDSA(SHA256()))
    (folder / "SHA256SUMS.sig").write_text(base64.b64encode(signature).decode() + "\n")


def _private_key(file: Path) -> PrivateKeyTypes:
    try:
        return load_pem_private_key(file.read_bytes(), password=None)
    except TypeError as error:
        raise ValueError(
            f"{file} is encrypted: give a key without a passphrase (openssl pkey -in {file} -out FILE)"
        ) from error
    except (ValueError, UnsupportedAlgorithm) as error:
        raise ValueError(
            f"{file} is not a private key (openssl ecparam -name prime256v1 -genkey -noout -out FILE makes one)"
        ) from error


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _provenance(files: dict[str, str]) -> dict[str, object]:
    moment = datetime.fromtimestamp(time_of_commit(), UTC).isoformat().replace("+00:00", "Z")
    return {
        "_type": "https://in-toto.io/Statement/v1",
        "subject": [{"name": name, "digest": {"sha256": digest}} for name, digest in files.items()],
        "predicateType": "https://slsa.dev/provenance/v1",
        "predicate": {
            "buildDefinition": {
                "buildType": "urn:rosrv:make-release:1",
                "externalParameters": {"version": __version__},
                "resolvedDependencies": [
                    {"name": "rosrv", "digest": {"gitCommit": revision()}},
                    *({"name": name, "digest": {"sha256": _digest(ROOT / name)}} for name in _MATERIALS),
                ],
            },
            "runDetails": {"builder": {"id": "distribution/release.py"}, "metadata": {"startedOn": moment}},
        },
    }


def main(arguments: list[str]) -> int:
    if len(arguments) != 1 or not arguments[0]:
        sys.stderr.write("release: give the file of the private key: make release KEY=FILE\n")
        return 2
    try:
        release(ROOT / "dist", Path(arguments[0]))
    except (BuildError, OSError, ValueError) as error:
        sys.stderr.write(f"release: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
