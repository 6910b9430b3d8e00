"""What runs: the program, what it stands on, and what it uses of the kernel."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import told


class Part(msgspec.Struct, frozen=True):
    """A package that the appliance stands on."""

    kind: Literal["python", "debian"]
    name: str
    version: str
    licences: Annotated[list[str], told("as its maker names them; empty: it does not say")]


class InUse(msgspec.Struct, frozen=True):
    """What the running appliance uses of the kernel."""

    firewall: Annotated[str | None, told("the back end; null: this isolation has none")]
    esp: Annotated[Literal["kernel", "user space"] | None, told("where ESP runs; null: no tunnels are open")]
    walls: Annotated[
        dict[str, str], told("by process: what limits its calls of the kernel, its files and ports")
    ]
    lacks: Annotated[list[str], told("what this kernel lacks of them")]


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
