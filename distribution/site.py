"""`make site`: build dist/rosrv-site_VERSION_ARCH.tar, which has everything that a site without a network needs.

    python -m distribution.site [OPTIONS OF docker build …]

The archive has the image with its list of parts, the files in `BESIDE`, `site.env` as `.env`, and checksums of
everything. Its use is in docs/install.md.
"""

import hashlib
import io
import sys
import tarfile
from pathlib import Path

from appliance import __version__
from distribution import image
from distribution.checkout import ROOT, time_of_commit

BESIDE = (
    "compose.yaml",
    "compose.host.yaml",
    "compose.local.yaml",
    "LICENSE",
    "docs",
    "ipsec",
    "monitors",
    "policies",
)


def pack(parts: tuple[Path, ...], *, moment: int) -> Path:
    files = {part.name: part for part in parts} | {".env": ROOT / "distribution" / "site.env"}
    for name in BESIDE:
        found = [path for path in (ROOT / name).rglob("*") if path.is_file()] or [ROOT / name]
        files |= {str(path.relative_to(ROOT)): path for path in found}
    site = parts[0].with_name(parts[0].name.replace("rosrv-image", "rosrv-site"))
    folder = f"rosrv-{__version__}"
    sums = ""
    with tarfile.open(site, "w", format=tarfile.PAX_FORMAT) as archive:
        for name, path in sorted(files.items()):
            member = tarfile.TarInfo(f"{folder}/{name}")
            member.size, member.mode, member.mtime = path.stat().st_size, 0o644, moment
            with path.open("rb") as content:
                sums += f"{hashlib.file_digest(content, 'sha256').hexdigest()}  {name}\n"
                content.seek(0)
                archive.addfile(member, content)
        member = tarfile.TarInfo(f"{folder}/SHA256SUMS")
        member.size, member.mode, member.mtime = len(sums), 0o644, moment
        archive.addfile(member, io.BytesIO(sums.encode()))
    return site


def main(arguments: list[str]) -> int:
    made = image.attempt(arguments)
    if made:
        sys.stdout.write(f"{pack(made, moment=time_of_commit()).relative_to(ROOT)}\n")
    return 0 if made else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
