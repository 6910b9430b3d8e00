"""Read recordings from S3, or from a server with its interface (`AWS_ENDPOINT_URL`), with boto3.

Credentials, region and endpoint are those of boto3: environment, profile, or the role of the machine.
"""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rosmop.recordings.recording import RecordingError

SCHEME = "s3://"
_PIECE = 1 << 20


def listed(prefix: str) -> Iterator[tuple[str, int, str]]:
    """Yield URI, size and hash of each object with a prefix, in the order of their names. Raises `RecordingError`."""
    bucket, key = _parts(prefix)
    with _errors(prefix):
        pages = _client().get_paginator("list_objects_v2").paginate(Bucket=bucket, Prefix=key)
        for page in pages:
            for row in page.get("Contents", ()):
                yield f"{SCHEME}{bucket}/{row['Key']}", row["Size"], row["ETag"]


@contextmanager
def fetched(uri: str, version: str) -> Iterator[Path]:
    """Copy an object into a temporary file for the block. Raises `RecordingError`, also if it changed."""
    bucket, key = _parts(uri)
    with TemporaryDirectory(prefix="rosmop-") as folder:
        path = Path(folder) / "recording"
        with _errors(uri), path.open("wb") as file:
            answer = _client().get_object(Bucket=bucket, Key=key, IfMatch=version)
            with answer["Body"] as body:
                shutil.copyfileobj(body, file, _PIECE)
        yield path


def _parts(uri: str) -> tuple[str, str]:
    bucket, _, key = uri.removeprefix(SCHEME).partition("/")
    if not bucket:
        raise RecordingError(f"{uri} has no bucket: give {SCHEME}BUCKET/PREFIX")
    return bucket, key


def _client() -> Any:
    try:
        import boto3  # noqa: PLC0415  an optional extra
    except ImportError:
        raise RecordingError("boto3 is not installed: pip install 'rosmop[s3]'") from None
    return boto3.client("s3")


@contextmanager
def _errors(uri: str) -> Iterator[None]:
    try:
        yield
    except RecordingError:
        raise
    except Exception as error:
        raise RecordingError(f"cannot read {uri}: {error}") from error
