import os
import signal
from pathlib import Path

from rosmop.batch.jobs import work


def double(job: bytes) -> bytes:
    return job + job


def fragile(job: bytes) -> bytes:
    """Append a line to the file that the job names, then die if the job wants it: `always`, or the first time."""
    how, _, path = job.decode().partition(" ")
    with Path(path).open("a+") as file:
        file.write(f"{os.getpid()}\n")
        file.seek(0)
        tries = len(file.readlines())
    if how == "always" or (how == "once" and tries == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    return how.encode()


def counted_work(job: bytes) -> bytes:
    with Path(os.environ["COUNTED"]).open("a") as file:
        file.write("job\n")
    return work(job)
