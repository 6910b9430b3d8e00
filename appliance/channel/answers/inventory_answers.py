"""The running program, its dependencies, and the kernel features that it uses."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import doc


class Part(msgspec.Struct, frozen=True):
    """A package that the appliance depends on."""

    kind: Literal["python", "debian"]
    name: str
    version: str
    licences: Annotated[list[str], doc("as the package names them, or empty if not stated")]


class InUse(msgspec.Struct, frozen=True):
    """The kernel features that the running appliance uses."""

    firewall: Annotated[str | None, doc("the back end, or null if this isolation has none")]
    esp: Annotated[
        Literal["kernel", "user space"] | None, doc("where ESP runs, or null if no tunnels are open")
    ]
    sandbox: Annotated[dict[str, str], doc("by process: limits of its system calls, files and ports")]
    lacks: Annotated[list[str], doc("parts of the sandbox that this kernel does not support")]


class Inventory(msgspec.Struct, frozen=True):
    """Version, build, system and parts."""

    version: str
    build: Annotated[
        dict[str, str] | None,
        doc(
            "kind, commit and time of a package's or image's build, or null for a checkout or a wheel, which have none"
        ),
    ]
    python: str
    system: str
    kernel: Annotated[str, doc("its release")]
    machine: str
    parts: list[Part]
    parts_list: Annotated[
        str | None,
        doc("SHA-256 of the list of all parts (CycloneDX) that an image has, or null if it is not an image"),
    ]
    in_use: Annotated[
        InUse | None, doc("the answer of the running appliance, or null if none was queried")
    ] = None
