"""List the parts of the image as CycloneDX: Debian, Python and console packages, with their licences."""

import json
import posixpath
import re
import uuid
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from email import message_from_string
from fnmatch import fnmatchcase

from cyclonedx.factory.license import LicenseFactory
from cyclonedx.model.bom import Bom, BomMetaData
from cyclonedx.model.component import Component, ComponentType
from cyclonedx.model.license import License
from cyclonedx.output.json import JsonV1Dot6
from packageurl import PackageURL

from appliance import __version__
from appliance.configuration.inventory import debian_licences, debian_packages, python_licences

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
            {(one["name"], one["version"], one["licence"]) for one in packages}
        ):
            namespace, _, last = name.rpartition("/")
            yield _part(PackageURL("npm", namespace or None, last, version), [licence])
