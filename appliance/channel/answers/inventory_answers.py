"""The running program, its dependencies, and the kernel features that it uses."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import told


class Part(msgspec.Struct, frozen=True):
    """A package that the appliance depends on."""

    kind: Literal["python", "debian"]
    name: str
    version: str
    licences: Annotated[list[str], told("as its maker names them; empty: it does not say")]


class InUse(msgspec.Struct, frozen=True):
    """The kernel features that the running appliance uses."""

    firewall: Annotated[str | None, told("the back end; null: this isolation has none")]
    esp: Annotated[Literal["kernel", "user space"] | None, told("where ESP runs; null: no tunnels are open")]
    sandbox: Annotated[dict[str, str], told("by process: limits of its system calls, files and ports")]
    lacks: Annotated[list[str], told("the parts of the sandbox that this kernel lacks")]
    walls: Annotated[dict[str, str], told("the same as `sandbox`; deprecated")] = {}


class Inventory(msgspec.Struct, frozen=True):
    """Version, build, system and parts."""

    version: str
    build: Annotated[
        dict[str, str] | None,
        told("of a package or an image: kind, commit, moment; null: a checkout or a wheel, which have none"),
    ]
    python: str
    system: str
    kernel: Annotated[str, told("its release")]
    machine: str
    parts: list[Part]
    parts_list: Annotated[
        str | None,
        told("SHA-256 of the list of all parts (CycloneDX) that an image has; null: there is none"),
    ]
    in_use: Annotated[InUse | None, told("null: nothing that runs was asked")] = None
