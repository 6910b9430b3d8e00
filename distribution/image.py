"""`make image`: build dist/rosrv-image_VERSION_ARCH.tar, for `docker load` and all OCI tools.

    python -m distribution.image [OPTIONS OF docker build …]
    python -m distribution.image lock BASE [OPTIONS …]     new image-packages.lock from Debian's present packages

The engine's result is rewritten so that no time in it is later than the newest commit: two builds of one commit can
be equal. An additional layer has the list of parts (`sbom`) and the origin of the build.
"""

import hashlib
import io
import json
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from appliance import __version__
from distribution.checkout import ROOT, facts, revision, time_of_commit
from distribution.programs import BuildError, run
from distribution.sbom import ImageFiles, make_sbom

NAME = f"rosrv/appliance:{__version__}"
LOCK = ROOT / "distribution/image-packages.lock"
SHARE = "opt/rosrv/share/rosrv"
_LAYER = "application/vnd.oci.image.layer.v1.tar"
_HEAD = (
    "# The Debian packages of the image beside those of its base: python -m distribution.image lock BASE\n"
)


@dataclass(frozen=True)
class Blob:
    """A part of the image in `file`, named by its digest."""

    file: Path
    digest: str
    size: int

    def described(self, media_type: str) -> dict[str, Any]:
        return {"mediaType": media_type, "digest": f"sha256:{self.digest}", "size": self.size}


def build(options: list[str], *, moment: int) -> tuple[Path, Path]:
    """Return the paths of the image and its list of parts. No time in them is later than `moment` (seconds).

    Raise `BuildError`.
    """
    # Without a cache, because older parts would keep their own times.
    pins = " ".join(line for line in LOCK.read_text().splitlines() if not line.startswith("#"))
    _docker(
        "build", "--no-cache", "--target", "appliance", "--tag", NAME, "--build-arg", f"PINS={pins}",
        "--build-arg", f"VERSION={__version__}", "--build-arg", f"REVISION={revision()}",
        *options, str(ROOT),
    )  # fmt: skip
    folder = ROOT / "build"
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="rosrv-image-", dir=folder) as work:
        saved = Path(work) / "saved.tar"
        _docker("save", "--output", str(saved), NAME)
        return _rewrite(saved, Path(work), moment)


def lock(base: str, build_options: list[str]) -> None:
    """Write the packages that the image has in addition to those of its base image to the lock file.

    Raise `BuildError`.
    """
    options = ["--quiet", "--target", "appliance", str(ROOT)]
    listed = "dpkg-query --show --showformat '${Package}=${Version}\\n'"
    before, after = (
        set(_docker("run", "--rm", "--entrypoint", "sh", image, "-c", listed).splitlines())
        for image in (base, _docker("build", *build_options, *options).strip())
    )
    LOCK.write_text(_HEAD + "\n".join(sorted(after - before)) + "\n")


def _rewrite(saved: Path, work: Path, moment: int) -> tuple[Path, Path]:
    tree = ImageFiles()
    with tarfile.open(saved) as archive:
        entry = json.loads(_opened(archive, "manifest.json").read())[0]
        config = json.loads(_opened(archive, entry["Config"]).read())
        layers = []
        for number, name in enumerate(entry["Layers"]):
            tree.begin_layer()
            with _opened(archive, name) as layer, tarfile.open(fileobj=layer) as members:
                layers.append(_layer(work / f"layer{number}", _kept(members, tree, moment)))
    architecture = config["architecture"]
    labels = config["config"]["Labels"]
    commit, base = (labels[f"org.opencontainers.image.{name}"] for name in ("revision", "base.name"))
    about = facts("image", architecture, commit, moment, base=base)
    sbom = make_sbom(tree, architecture=architecture, moment=moment)
    added = {f"{SHARE}/build.json": about, f"{SHARE}/sbom.cdx.json": sbom}
    layers.append(_layer(work / "added", _files(added, moment)))
    image = ROOT / "dist" / f"rosrv-image_{__version__}_{architecture}.tar"
    image.parent.mkdir(exist_ok=True)
    _write_oci(image, _settled(config, layers, moment), layers, moment)
    listed = image.with_suffix(".cdx.json")
    listed.write_text(sbom)
    return image, listed


def _kept(
    members: tarfile.TarFile, tree: ImageFiles, moment: int
) -> Iterator[tuple[tarfile.TarInfo, IO[bytes] | None]]:
    """Yield the entries of a layer without values that differ between builds, and add each to `tree`."""
    for member in members:
        member.mtime = min(int(member.mtime), moment)
        member.pax_headers = {
            key: value for key, value in member.pax_headers.items() if key not in ("mtime", "atime", "ctime")
        }
        content = members.extractfile(member) if member.isreg() else None
        if content is not None and tree.wants(member.name):
            data = content.read()
            tree.add(member.name, data)
            content = io.BytesIO(data)
        else:
            tree.add(member.name, b"", link=member.linkname if member.issym() else "")
        yield member, content


def _files(texts: dict[str, str], moment: int) -> Iterator[tuple[tarfile.TarInfo, IO[bytes] | None]]:
    for folder in sorted(
        {str(parent) for name in texts for parent in Path(name).parents if parent.parts[2:]}
    ):
        entry = tarfile.TarInfo(folder)
        entry.type, entry.mode, entry.mtime = tarfile.DIRTYPE, 0o755, moment
        yield entry, None
    for name, text in texts.items():
        entry = tarfile.TarInfo(name)
        entry.size, entry.mode, entry.mtime = len(text.encode()), 0o644, moment
        yield entry, io.BytesIO(text.encode())


def _layer(path: Path, entries: Iterable[tuple[tarfile.TarInfo, IO[bytes] | None]]) -> Blob:
    with tarfile.open(path, "w", format=tarfile.PAX_FORMAT) as layer:
        for entry, content in entries:
            layer.addfile(entry, content)
    return _blob(path)


def _blob(path: Path) -> Blob:
    with path.open("rb") as file:
        return Blob(path, hashlib.file_digest(file, "sha256").hexdigest(), path.stat().st_size)


def _settled(config: dict[str, Any], layers: list[Blob], moment: int) -> dict[str, Any]:
    """Return the image's configuration without the values that depend on the building engine."""
    created = datetime.fromtimestamp(moment, UTC).isoformat().replace("+00:00", "Z")
    history = [{**step, "created": created} for step in config["history"]]
    history.append(
        {"created": created, "created_by": "distribution/image.py: what is in it, what it was built from"}
    )
    kept = (
        "Env",
        "Entrypoint",
        "Cmd",
        "WorkingDir",
        "Volumes",
        "ExposedPorts",
        "StopSignal",
        "Healthcheck",
        "Labels",
    )
    return {
        "created": created,
        "architecture": config["architecture"],
        "os": config["os"],
        "config": {key: config["config"][key] for key in kept if config["config"].get(key)},
        "rootfs": {"type": "layers", "diff_ids": [f"sha256:{layer.digest}" for layer in layers]},
        "history": history,
    }


def _write_oci(image: Path, config: dict[str, Any], layers: list[Blob], moment: int) -> None:
    """Write the image as an OCI layout, with the manifest.json that `docker load` reads."""
    folder = layers[0].file.parent

    def document(name: str, content: Any) -> Blob:
        path = folder / name
        path.write_text(json.dumps(content, sort_keys=True, separators=(",", ":")))
        return _blob(path)

    configuration = document("config", config)
    annotations = config["config"]["Labels"]
    manifest = document("manifest", {
        "schemaVersion": 2,
        "mediaType": "application/vnd.oci.image.manifest.v1+json",
        "config": configuration.described("application/vnd.oci.image.config.v1+json"),
        "layers": [layer.described(_LAYER) for layer in layers],
        "annotations": annotations,
    })  # fmt: skip
    entry = manifest.described("application/vnd.oci.image.manifest.v1+json")
    entry["annotations"] = {
        "io.containerd.image.name": f"docker.io/{NAME}",
        "org.opencontainers.image.ref.name": __version__,
    }
    index = document("index", {"schemaVersion": 2, "manifests": [entry]})
    legacy = document("legacy", [{
        "Config": f"blobs/sha256/{configuration.digest}", "RepoTags": [NAME, "rosrv/appliance:latest"],
        "Layers": [f"blobs/sha256/{layer.digest}" for layer in layers],
    }])  # fmt: skip
    layout = document("layout", {"imageLayoutVersion": "1.0.0"})
    parts = {f"blobs/sha256/{blob.digest}": blob for blob in (*layers, configuration, manifest)}
    parts |= {"index.json": index, "manifest.json": legacy, "oci-layout": layout}
    with tarfile.open(image, "w", format=tarfile.PAX_FORMAT) as archive:
        for name, blob in sorted(parts.items()):
            member = tarfile.TarInfo(name)
            member.size, member.mode, member.mtime = blob.size, 0o644, moment
            with blob.file.open("rb") as content:
                archive.addfile(member, content)


def _opened(archive: tarfile.TarFile, name: str) -> IO[bytes]:
    member = archive.extractfile(name)
    assert member is not None, name  # noqa: S101  the engine wrote it
    return member


def _docker(*arguments: str) -> str:
    return run(["docker", *arguments], missing="sudo apt-get install docker.io", stdout=subprocess.PIPE)


def attempt(options: list[str]) -> tuple[Path, ...]:
    """Build the image and print its files, or print the error and return an empty tuple."""
    try:
        made = build(options, moment=time_of_commit())
    except (BuildError, OSError) as error:
        sys.stderr.write(f"image: {error}\n")
        return ()
    for path in made:
        sys.stdout.write(f"{path.relative_to(ROOT)}\n")
    return made


def main(arguments: list[str]) -> int:
    if arguments[:1] != ["lock"]:
        return 0 if attempt(arguments) else 1
    if len(arguments) < 2 or arguments[1].startswith("-"):
        sys.stderr.write("image: name the base image: python -m distribution.image lock BASE [OPTIONS …]\n")
        return 2
    try:
        lock(arguments[1], arguments[2:])
    except (BuildError, OSError) as error:
        sys.stderr.write(f"image: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
