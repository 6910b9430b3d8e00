import asyncio
import shutil
from pathlib import Path

import pytest
from starlette.responses import StreamingResponse

from appliance.api.front.access import Bearer, TokenAuthenticator
from appliance.api.front.control import ControlLink
from appliance.api.front.history import SampleHistory
from appliance.api.front.journal import Journal
from appliance.api.front.problems import ProblemError
from appliance.api.front.services import Services
from appliance.channel.admin import AdminAnswer
from appliance.configuration.config_sources import read
from appliance.features.recorder import routes as recording_routes
from appliance.features.recorder.bag_writer import BagMessage, BagWriter
from appliance.features.recorder.mcap import as_mcap
from appliance.features.recorder.recording_answers import Recording
from tests.support.answers import example
from tests.support.idle import idle
from tests.support.inline_loop import run
from tests.unit.features.recorder.test_bag_writer import HEADER, SECOND, body

_EVE = Bearer("eve", "eve", "investigator", 1e12, "shown")


@pytest.mark.parametrize("mcap", [False, True])
def test_a_started_download_is_completed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, mcap: bool
) -> None:
    kept = tmp_path / "recordings" / ("a" * 20)
    kept.mkdir(parents=True)
    bag = BagWriter(kept / "recording.bag", {})
    bag.connect(HEADER)
    for second in range(3):
        bag.write([BagMessage(0, second * SECOND, body(b"x" * 2_000_000))])
    bag.close()
    size = (kept / "recording.bag").stat().st_size
    whole = b"".join(as_mcap(kept / "recording.bag")) if mcap else (kept / "recording.bag").read_bytes()

    async def ask(*_asked: object) -> AdminAnswer[Recording]:
        return AdminAnswer(True, example(Recording, id="a" * 20, size=size))

    control, settings = idle(ControlLink), read({"state": str(tmp_path)})
    monkeypatch.setattr(control, "ask", ask)
    keeper, journal, history = idle(TokenAuthenticator), idle(Journal), idle(SampleHistory)
    services = Services(settings, control, keeper, journal, asyncio.Event(), history)

    async def fetched() -> bytes:
        response = await _asked(services, mcap=mcap)
        assert response.headers.get("Content-Length") == (None if mcap else str(size))
        shutil.rmtree(kept)
        return b"".join([piece async for piece in response.body_iterator if isinstance(piece, bytes)])

    assert run(fetched()) == whole
    with pytest.raises(ProblemError, match="no longer exists") as gone:
        run(_asked(services, mcap=mcap))
    assert gone.value.status == 503
    kept.mkdir()
    (kept / "recording.bag").write_bytes(b"")
    if mcap:
        with pytest.raises(ProblemError, match="cannot be read"):
            run(_asked(services, mcap=mcap))


async def _asked(services: Services, *, mcap: bool) -> StreamingResponse:
    response = await recording_routes.bag_response(services, "a" * 20, _EVE, mcap=mcap)
    assert isinstance(response, StreamingResponse)
    return response
