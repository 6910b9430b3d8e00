"""Read recordings from S3, or from a server with its interface (`AWS_ENDPOINT_URL`), with boto3."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from rosmop.recordings.recording import RecordingError

SCHEME = "s3://"
_PIECE = 1 << 20


def listed(prefix: str) -> Iterator[tuple[str, int, str]]:
    bucket, key = _parts(prefix)
    with _errors(prefix):
        pages = _client().get_paginator("list_objects_v2").paginate(Bucket=bucket, Prefix=key)
        for page in pages:
            for row in page.get("Contents", ()):
                yield f"{SCHEME}{bucket}/{row['Key']}", row["Size"], row["ETag"]


@contextmanager
def fetched(uri: str, version: str) -> Iterator[Path]:
    """Copy an object into a temporary file for the block. Raises `RecordingError` if it changed or cannot be read.

    The file has no name, so it ends with the process, even if that is killed.
    """
    bucket, key = _parts(uri)
    with TemporaryFile(prefix="rosmop-") as file:
        with _errors(uri):
            answer = _client().get_object(Bucket=bucket, Key=key, IfMatch=version)
            with answer["Body"] as body:
                shutil.copyfileobj(body, file, _PIECE)
            file.flush()
        yield Path(f"/proc/self/fd/{file.fileno()}")


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
        hint = (
            "; put AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY into the environment"
            if "credentials" in str(error)
            else ""
        )
        raise RecordingError(f"cannot read {uri}: {error}{hint}") from error
