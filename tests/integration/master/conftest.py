from collections.abc import Iterator

import pytest

from examples.landshark.lab import Lab
from tests.support.field import Field
from tests.support.nodes import need_ros
from tests.support.requirements import need_root


@pytest.fixture(scope="module")
def battlefield(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Field]:
    need_root()
    need_ros()
    home, settings = tmp_path_factory.mktemp("field"), getattr(request.module, "CONFIGURATION", "")
    with Lab("rosrv-test") as lab, Field(lab, home, request.module.POLICY, settings) as field:
        yield field


@pytest.fixture
def field(battlefield: Field) -> Iterator[Field]:
    yield battlefield
    battlefield.unharmed()
