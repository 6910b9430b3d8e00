"""The reconcile loop makes ROSMaster what the registry wants, and wants nothing that the policy took."""

import pytest

from appliance.master.registry import Kind, Registration
from tests.support.control_parts import POLICY, ControlParts

pytestmark = pytest.mark.anyio
NO_SECRET = POLICY.format("/secret=\n", "/secret=\n")


@pytest.fixture
def anyio_backend() -> str:
    """The loop that control runs on."""
    return "asyncio"


@pytest.mark.parametrize("kind", [Kind.PUBLICATION, Kind.SUBSCRIPTION])
async def test_what_the_policy_took_is_not_adopted(kind: Kind) -> None:
    """A round that comes before ROSMaster was told of the revocation takes the registration from it, not back."""
    world = ControlParts()
    await world.round()
    node = world.node("/n")
    await world.register(node, kind, "/secret")
    assert world.reload(NO_SECRET) == 1
    await world.round()
    assert (node.resources(kind), list(node.shelf)) == ([], [(kind, "/secret")])
    assert world.hidden.has(kind, "/secret") == []
    await world.settle()
    await world.round()
    assert world.hidden.has(kind, "/secret") == []


async def test_what_was_granted_and_not_written_down_is_adopted() -> None:
    """Control died between ROSMaster's answer and the registry: the node keeps its registration."""
    world = ControlParts()
    await world.round()
    node = world.node("/n")
    await world.register(node, Kind.PUBLICATION, "/first")
    await world.reconciler._register(node, Registration(Kind.PUBLICATION, "/second", "t", 0))
    await world.round()
    assert node.resources(Kind.PUBLICATION) == ["/first", "/second"]
