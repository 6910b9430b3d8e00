"""The running program, its dependencies, and the kernel features that it uses."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import Name, doc


class Part(msgspec.Struct, frozen=True):
    """A package that the appliance depends on."""

    kind: Annotated[Literal["python", "debian"], doc("archive that the package comes from")]
    name: Name
    version: Annotated[str, doc("as its archive has it")]
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

    version: Annotated[str, doc("version of the program")]
    build: Annotated[
        dict[str, str] | None,
        doc(
            "kind, commit and time of a package's or image's build, or null for a checkout or a wheel, which have none"
        ),
    ]
    python: Annotated[str, doc("its version")]
    system: Annotated[str, doc("name and version of the operating system")]
    kernel: Annotated[str, doc("its release")]
    machine: Annotated[str, doc("its architecture")]
    parts: Annotated[list[Part], doc("packages that it depends on")]
    parts_list: Annotated[
        str | None,
        doc("SHA-256 of the list of all parts (CycloneDX) that an image has, or null if it is not an image"),
    ]
    in_use: Annotated[
        InUse | None, doc("the answer of the running appliance, or null if none was queried")
    ] = None
