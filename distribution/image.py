"""`make image`: build dist/rosrv-image_VERSION_ARCH.tar, for `docker load` and all OCI tools.

    python -m distribution.image [OPTIONS OF docker build …]
    python -m distribution.image lock BASE [OPTIONS …]     new image-packages.lock from Debian's present packages

The engine's result is rewritten so that no time in it is later than the newest commit: two builds of one commit can
be equal. An additional layer has the list of parts (`sbom`) and the origin of the build.
"""

import hashlib
import io
import json
import posixpath
import re
import subprocess
import sys
import tarfile
import tempfile
import uuid
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from email import message_from_string
from fnmatch import fnmatchcase
from pathlib import Path
from typing import IO, Any

from cyclonedx.factory.license import LicenseFactory
from cyclonedx.model.bom import Bom, BomMetaData
from cyclonedx.model.component import Component, ComponentType
from cyclonedx.model.license import License
from cyclonedx.output.json import JsonV1Dot6
from packageurl import PackageURL

from appliance import __version__
from appliance.configuration.inventory import debian_licences, debian_packages, python_licences
from distribution.checkout import ROOT, BuildError, facts, revision, run, time_of_commit

# List the parts of the image as CycloneDX: Debian, Python and console packages, with their licences.

SYSTEM = "debian-12"
_PYTHON = "opt/rosrv/lib/python3*/site-packages/"
_DPKG = "var/lib/dpkg/status"
_MANIFEST = f"{_PYTHON}appliance/api/console/vendor/manifest.json"
_WHITEOUT = ".wh."
_OPAQUE = f"{_WHITEOUT}{_WHITEOUT}.opq"
_READ = (_DPKG, "usr/share/doc/*/copyright", f"{_PYTHON}*.dist-info/METADATA", _MANIFEST)


class ImageFiles:
    """The files of an image that name its parts and their licences, collected layer by layer."""

    def __init__(self) -> None:
        self.texts: dict[str, str] = {}
        self._links: dict[str, str] = {}
        self._own: set[str] = set()  # the names in this layer, to which its whiteouts do not apply

    def begin_layer(self) -> None:
        self._own.clear()

    def wants(self, name: str) -> bool:
        """Return whether `add` needs the content of this file."""
        name = name.removeprefix("./")
        return any(fnmatchcase(name, pattern) for pattern in _READ)

    def add(self, name: str, data: bytes, *, link: str = "") -> None:
        """Add an entry of a layer. `link` is the target of a symbolic link."""
        name = name.removeprefix("./")
        folder, _, last = name.rpartition("/")
        self._own.add(name)
        if last == _OPAQUE:
            self._remove(folder)
        elif last.startswith(_WHITEOUT):
            self._remove(posixpath.join(folder, last.removeprefix(_WHITEOUT)))
        elif self.wants(name) and data:
            self.texts[name] = data.decode(errors="replace")
        elif link:
            self._links[name] = posixpath.normpath(posixpath.join(folder, link))

    def _remove(self, gone: str) -> None:
        """Remove a file or folder of earlier layers; "" is the root."""
        for entries in (self.texts, self._links):
            for path in [path for path in entries if f"{path}/".startswith(f"{gone}/" if gone else "")]:
                if path not in self._own:
                    del entries[path]

    def copyright(self, package: str) -> str:
        """Return the copyright file of a Debian package, or ""."""
        folder = f"usr/share/doc/{package}"
        return self.texts.get(f"{self._links.get(folder, folder)}/copyright", "")

    def matching(self, pattern: str) -> Iterator[str]:
        """Return the texts of the matching files, in the order of their names."""
        return (self.texts[name] for name in sorted(self.texts) if fnmatchcase(name, pattern))


def make_sbom(tree: ImageFiles, *, architecture: str, moment: int) -> str:
    """Return the list as JSON, which is equal for equal trees. `moment` is in seconds since the epoch."""
    itself = Component(
        name="rosrv/appliance", version=__version__, type=ComponentType.CONTAINER, bom_ref="rosrv/appliance",
        licenses=_licences(["Apache-2.0"]),
        purl=PackageURL("oci", None, "appliance", __version__, {"arch": architecture}),
    )  # fmt: skip
    parts = [*_debian(tree), *_python(tree), *_console(tree)]
    bom = Bom(
        components=parts,
        serial_number=uuid.uuid5(uuid.NAMESPACE_OID, "\n".join(sorted(str(part.purl) for part in parts))),
        metadata=BomMetaData(component=itself, timestamp=datetime.fromtimestamp(moment, UTC)),
    )
    bom.register_dependency(itself, parts)
    return JsonV1Dot6(bom).output_as_string(indent=2) + "\n"


def _part(
    purl: PackageURL, licences: Iterable[str], kind: ComponentType = ComponentType.LIBRARY
) -> Component:
    name = f"{purl.namespace}/{purl.name}" if purl.type == "npm" and purl.namespace else purl.name
    return Component(
        name=name, version=purl.version, type=kind, bom_ref=str(purl), purl=purl, licenses=_licences(licences)
    )


def _licences(names: Iterable[str]) -> list[License]:
    """Return one licence expression, or a list of single licences."""
    factory = LicenseFactory()
    made = [factory.make_from_string(name) for name in sorted(set(names))]
    return made if len(made) == 1 else [factory.make_with_name(name) for name in sorted(set(names))]


def _debian(tree: ImageFiles) -> Iterator[Component]:
    for fields in debian_packages(tree.texts[_DPKG]):
        name = fields["Package"]
        qualifiers = {"arch": fields["Architecture"], "distro": SYSTEM}
        licences = debian_licences(tree.copyright(name)) or [f"see /usr/share/doc/{name}/copyright"]
        yield _part(PackageURL("deb", "debian", name, fields["Version"], qualifiers), licences)


def _python(tree: ImageFiles) -> Iterator[Component]:
    for text in tree.matching(f"{_PYTHON}*.dist-info/METADATA"):
        fields = message_from_string(text)
        purl = PackageURL("pypi", None, re.sub(r"[-_.]+", "-", fields["Name"]).lower(), fields["Version"])
        yield _part(purl, python_licences(fields))
    yield _part(PackageURL("generic", None, "rosrv", __version__), ["Apache-2.0"], ComponentType.APPLICATION)


def _console(tree: ImageFiles) -> Iterator[Component]:
    for text in tree.matching(_MANIFEST):
        packages = [package for file in json.loads(text)["files"].values() for package in file["packages"]]
        for name, version, licence in sorted(
            {(package["name"], package["version"], package["licence"]) for package in packages}
        ):
            namespace, _, last = name.rpartition("/")
            yield _part(PackageURL("npm", namespace or None, last, version), [licence])


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

    def descriptor(self, media_type: str) -> dict[str, Any]:
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
        entry = json.loads(_open(archive, "manifest.json").read())[0]
        config = json.loads(_open(archive, entry["Config"]).read())
        layers = []
        for number, name in enumerate(entry["Layers"]):
            tree.begin_layer()
            with _open(archive, name) as layer, tarfile.open(fileobj=layer) as members:
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
    _write_oci(image, _settle(config, layers, moment), layers, moment)
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


def _settle(config: dict[str, Any], layers: list[Blob], moment: int) -> dict[str, Any]:
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
        "config": configuration.descriptor("application/vnd.oci.image.config.v1+json"),
        "layers": [layer.descriptor(_LAYER) for layer in layers],
        "annotations": annotations,
    })  # fmt: skip
    entry = manifest.descriptor("application/vnd.oci.image.manifest.v1+json")
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


def _open(archive: tarfile.TarFile, name: str) -> IO[bytes]:
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
