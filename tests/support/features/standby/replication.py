import asyncio
import contextlib
import random
import socket
import sqlite3
import ssl
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

from appliance.features.standby.link_certificates import (
    CERTIFICATE,
    KEY,
    LinkCertificate,
    link_context,
    make_link_certificate,
)
from appliance.features.standby.replica import Replica
from appliance.features.standby.replication import ReplicationListener, follow_at
from appliance.features.standby.replication_frames import ReplicationError
from appliance.features.standby.replication_receiver import ReplicationReceiver
from appliance.features.standby.replication_sender import ReplicationSender
from appliance.store.writer_thread import Database, StoreError
from tests.support.engines import InlineDatabase

SCHEMA = """
CREATE TABLE IF NOT EXISTS thing (name TEXT PRIMARY KEY, size INTEGER NOT NULL, note TEXT) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS host (name TEXT PRIMARY KEY, address TEXT NOT NULL UNIQUE) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS tree (id INTEGER PRIMARY KEY CHECK (id = 1), data BLOB NOT NULL, weight REAL NOT NULL);
CREATE TABLE IF NOT EXISTS mark (number INTEGER PRIMARY KEY);
"""
Tables = dict[str, list[tuple[Any, ...]]]


def tables_of(path: Path) -> Tables:
    with contextlib.closing(sqlite3.connect(path)) as reader:
        return {
            table: reader.execute(f"SELECT * FROM {table} ORDER BY 1").fetchall()  # noqa: S608  names below
            for table in ("thing", "host", "tree", "mark")
        }


def change_randomly(database: Database, chosen: random.Random) -> None:
    kind = chosen.randrange(7)
    name = f"row {chosen.randrange(50)}"
    if kind < 3:
        database.put("thing", name, chosen.randrange(-5, 5), chosen.choice([None, "note", "ä" * 100]))
    elif kind == 3:
        database.delete("thing", ("name", ">", name), ("size", "<=", chosen.randrange(5)))
    elif kind == 4:
        database.put("host", name, f"10.0.0.{chosen.randrange(20)}")
    elif kind == 5:
        size = chosen.choice([10, 1000, 200_000])
        database.put("tree", 1, chosen.randbytes(size), chosen.random(), ahead=False)
    else:
        with database.together():
            for number in range(chosen.randrange(1, 100)):
                database.put("thing", f"row {number % 60}", number, None)
            database.delete("host", name=name)


def certificates(directory: Path) -> tuple[ssl.SSLContext, ssl.SSLContext]:
    homes = [directory / "certificates-active", directory / "certificates-standby"]
    active, standby = map(_kept_certificate, homes)
    return (
        link_context(active, standby.certificate, homes[0], server=True),
        link_context(standby, active.certificate, homes[1], server=False),
    )


def _kept_certificate(home: Path) -> LinkCertificate:
    home.mkdir(exist_ok=True)
    files = home / CERTIFICATE, home / KEY
    if not all(file.exists() for file in files):
        for file, text in zip(files, make_link_certificate(), strict=True):
            file.write_text(text)
    return LinkCertificate(*(file.read_text() for file in files))


def listening_socket() -> socket.socket:
    listening = socket.socket()
    listening.bind(("127.0.0.1", 0))
    listening.listen()
    return listening


class ActiveSide:
    def __init__(
        self,
        path: Path,
        context: ssl.SSLContext,
        *,
        epoch: int = 1,
        room: int = 32 << 20,
        schema: str = SCHEMA,
        listening: socket.socket | None = None,
    ) -> None:
        self.epoch = epoch
        self.database = InlineDatabase(path, schema, failed=print)
        self.sender = ReplicationSender(self.database, lambda: self.epoch, room=room)
        self._socket = listening or listening_socket()
        self.port: int = self._socket.getsockname()[1]
        self._task = asyncio.create_task(ReplicationListener(self.sender, context).run(self._socket))

    async def close(self) -> None:
        self.sender.close()
        self._task.cancel()
        await asyncio.wait([self._task])
        self._socket.close()
        await asyncio.to_thread(self.database.close)


class StandbySide:
    def __init__(
        self,
        path: Path,
        context: ssl.SSLContext,
        port: Callable[[], int],
        *,
        largest: int = 1 << 30,
        schema: str = SCHEMA,
    ) -> None:
        self.ends: list[str] = []
        self.replica = Replica(path, schema, failed=print, largest=largest)
        self.receiver = ReplicationReceiver(self.replica, lambda _epoch: True)
        self._context = context
        self._port = port
        self._task = asyncio.create_task(self._run())

    async def _run(self) -> None:
        while True:
            try:
                await follow_at("127.0.0.1", self._port(), self._context, self.receiver)
            except (ReplicationError, StoreError) as error:
                self.ends.append(str(error))
            await asyncio.sleep(0.02)

    async def close(self) -> None:
        self._task.cancel()
        await asyncio.wait([self._task])
        self.replica.close()


class CuttingProxy:
    def __init__(self, port: Callable[[], int], chosen: random.Random) -> None:
        self.cutting = True
        self.cuts = 0
        self._target = port
        self._chosen = chosen
        self._server: asyncio.Server | None = None

    async def start(self) -> int:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    async def close(self) -> None:
        assert self._server is not None
        self._server.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        left = self._chosen.choice([3000, 20_000, 300_000]) + self._chosen.randrange(3000)
        try:
            reader_there, writer_there = await asyncio.open_connection("127.0.0.1", self._target())
        except OSError:
            writer.close()
            return

        async def pass_on(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
            nonlocal left
            with contextlib.suppress(OSError):
                while data := await source.read(1500):
                    left -= len(data)
                    if self.cutting and left < 0:
                        sink.write(data[: self._chosen.randrange(len(data))])
                        self.cuts += 1
                        break
                    sink.write(data)
                    await sink.drain()
            writer.close()
            writer_there.close()

        await asyncio.gather(pass_on(reader, writer_there), pass_on(reader_there, writer))


@contextlib.asynccontextmanager
async def replicated(directory: Path, **options: Any) -> AsyncIterator[tuple[ActiveSide, StandbySide]]:
    server, client = certificates(directory)
    active = ActiveSide(directory / "active.db", server, **options)
    schema = options.get("schema", SCHEMA)
    standby = StandbySide(directory / "standby.db", client, lambda: active.port, schema=schema)
    try:
        yield active, standby
    finally:
        await standby.close()
        await active.close()
