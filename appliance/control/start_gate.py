"""Decide when control may serve. A single appliance serves at once; the feature with `gate.py` decides for a pair."""

import asyncio
from collections.abc import Callable, Mapping
from pathlib import Path

from appliance.channel.channel import Channel
from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.control import Control
from appliance.control.core import ControlPart
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.specifications.compiler_link import SpecificationCompiler


class StartGate:
    """Decides when control may serve."""

    links: Mapping[str, tuple[Callable[[Channel], None], object]] = {}

    async def role(
        self,
        config: Path,
        settings: Settings,
        lifeline: ControlLifeline,
        compiler: SpecificationCompiler,
        stopping: asyncio.Event,
    ) -> ActiveRole | None:
        """Wait until control may serve; return None if it is stopped first. Raises `STATE_ERRORS`."""
        del config, settings, lifeline, compiler, stopping
        return ActiveRole()

    async def begin(self, control: Control) -> ControlPart | None:
        del control
        return None
