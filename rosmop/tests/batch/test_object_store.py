import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import boto3
import pytest
from moto.server import ThreadedMotoServer

from rosmop.batch import object_store
from rosmop.recordings.recording import RecordingError
from rosmop.tests.batch.test_many_recordings import SPECIFICATION, make_bag, rosmop

pytestmark = pytest.mark.nightly


@pytest.fixture
def bucket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    for name, value in (
        ("ACCESS_KEY_ID", "key"),
        ("SECRET_ACCESS_KEY", "secret"),
        ("DEFAULT_REGION", "us-east-1"),
    ):
        monkeypatch.setenv(f"AWS_{name}", value)
    server = ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    monkeypatch.chdir(tmp_path)
    client = boto3.client("s3")
    client.create_bucket(Bucket="robots")
    yield client
    client.close()
    server.stop()


def test_objects_are_recordings(bucket: Any) -> None:
    Path("limit.rv").write_text(SPECIFICATION)
    for seed in range(3):
        bucket.upload_file(str(make_bag(Path(f"{seed}.bag"), seed)), "robots", f"lab/{seed}.bag")
    bucket.put_object(Bucket="robots", Key="lab/broken.bag", Body=b"nonsense")
    bucket.put_object(Bucket="robots", Key="lab/notes.txt", Body=b"nonsense")
    bucket.put_object(Bucket="robots", Key="other/x.bag", Body=b"nonsense")
    local = rosmop("run limit.rv --bags [012].bag --json")[1]
    for workers in (1, 2):
        status, out, _err = rosmop(f"run limit.rv --bags s3://robots/lab/ --json --workers {workers}")
        assert status == 3
        rows = [json.loads(line) for line in out.splitlines()]
        (failed,) = [row for row in rows if "error" in row]
        assert failed["bag"] == "s3://robots/lab/broken.bag"
        assert "cannot read the bag s3://robots/lab/broken.bag: File magic" in failed["error"]
        rest = [row for row in rows if row is not failed]
        assert [{**row, "bag": row["bag"].removeprefix("s3://robots/lab/")} for row in rest] == [
            json.loads(line) for line in local.splitlines()
        ]


def test_a_changed_object_is_not_read(bucket: Any) -> None:
    bucket.put_object(Bucket="robots", Key="changed/a.bag", Body=b"one")
    ((uri, _size, version),) = object_store.listed("s3://robots/changed/")
    with object_store.fetched(uri, version) as path:
        assert path.read_bytes() == b"one"
    assert not path.exists()
    bucket.put_object(Bucket="robots", Key="changed/a.bag", Body=b"two")
    with pytest.raises(RecordingError, match="PreconditionFailed"), object_store.fetched(uri, version):
        pass


def test_errors_of_the_store_are_usage_errors(bucket: Any) -> None:
    Path("limit.rv").write_text(SPECIFICATION)
    for prefix, reason in (
        ("s3://none/", "NoSuchBucket"),
        ("s3://robots/none", "there are no recordings"),
        ("s3:///x", "has no bucket"),
    ):
        status, _out, err = rosmop(f"run limit.rv --bags {prefix}")
        assert status == 2
        assert reason in err
