"""`skills serve`: the server with its time limits on connections, and its workers.

uvicorn closes only connections that are idle between two requests. Here the head of a request must arrive in time too,
and so must the rest of a body when its response is out; and a client must read a response at a minimum rate. A closed
connection still waits for its unsent bytes, so the rate is measured until the last byte is sent.

The application runs in this process; its workers are child processes at lower priority, so that Python computation
never delays a response. They are forks of this process, made after the imports and the loading of compiled loops, and
before it has a thread; so they start at once and share its memory.
"""

import asyncio
import errno
import gc
import json
import logging
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from asyncio import TimerHandle, Transport
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from email.utils import formatdate
from functools import lru_cache
from types import FrameType
from typing import Any, cast

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from skills import logs
from skills.api.app import create_app, prepare_database, prepare_to_serve
from skills.api.rate_limits import Bucket
from skills.api.sessions import FLOODED, MESSAGE_BYTES
from skills.client import Client
from skills.compiled import check_cache_setting, is_cached
from skills.db.session import Database
from skills.errors import BadSettings, SkillsError
from skills.formats.reader_process import READY, get_ready
from skills.jobs.warm_up import learn_once, warm_up
from skills.jobs.worker import run_child
from skills.library.operation.erasure_list import keep_erasures, keep_up_erasures
from skills.library.people.keys import refuse_without_keys
from skills.remedies import Action, Remedy
from skills.samples import going_on, load_samples
from skills.sandbox.forked import Fork, fork_ahead, layers_held, refuse_uncontained
from skills.settings import PREFIX, Settings

log = logging.getLogger("skills.serving")

HEAD_S = 10.0
LOOK_S = 1.0  # seconds between two checks of the unsent bytes
# in the kernel's buffer, which without a limit takes MBs at once, and then none for many seconds
UNSENT_BYTES = 128 << 10
# TLS would buffer 512 KiB and pass them on at once: half a minute's bytes at the minimum rate
BUFFERED_BYTES = 64 << 10
AT_ONCE = struct.pack("ii", 1, 0)  # SO_LINGER of 0 s: closing the socket discards unsent bytes


# Imports create no garbage, and looking for it takes a fifth of the start; `run_worker` enables the collector.
_WORKER = "import gc; gc.disable(); from skills.jobs.worker import main; main()"
GRACE_S = 12  # a worker finishes its work in progress within ten
RESTART_S = 1.0
ERASURES_EVERY_S = 1.0  # ours: an erasure may be missing in the list for this long


class Counted:
    """A proxy of a transport that counts the bytes written to it."""

    def __init__(self, transport: Transport, written: Callable[[], None]) -> None:
        self.written_bytes = 0
        self._transport, self._written = transport, written

    def write(self, data: bytes) -> None:
        """Write the data, count it, and call the callback."""
        self.written_bytes += len(data)
        self._transport.write(data)
        self._written()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)


class PunctualConnection(HttpToolsProtocol):
    """An HTTP connection that is closed when its client is too slow.

    It is closed after waiting `HEAD_S` for a head or for the rest of an answered request. It is aborted when the client
    is `patience_s` behind: the time with unsent bytes, minus the time that the bytes taken meanwhile need at
    `bytes_per_s`. Fast reading earlier earns no credit. `connections` creates the subclass with the values of the
    settings.
    """

    patience_s: float
    bytes_per_s: int
    _due: TimerHandle | None = None
    _look: TimerHandle | None = None
    _behind_s = 0.0
    _taken_bytes = 0  # at the last check
    _counted: Counted

    def connection_made(self, transport: Transport) -> None:  # type: ignore[override]
        """Start the timeout of the first request."""
        self._counted = Counted(transport, self._wrote)
        # missing on some systems, where slow readers need a larger `patience_s`
        if hasattr(socket, "TCP_NOTSENT_LOWAT"):
            option = (socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)
            transport.get_extra_info("socket").setsockopt(*option)
        transport.set_write_buffer_limits(high=BUFFERED_BYTES)
        super().connection_made(cast(Transport, self._counted))
        self._expect()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timers."""
        self._have()
        if self._look is not None:
            self._look.cancel()
        super().connection_lost(exc)

    def on_message_begin(self) -> None:
        """Start the timeout of the rest of the head, and date the response."""
        self._expect()
        self.server_state.default_headers = _dated(int(time.time()))
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """Cancel the timeout: the reader of the body has one of its own."""
        self._have()
        super().on_headers_complete()

    def on_response_complete(self) -> None:
        """Start the timeout of a body that nothing reads any more."""
        if self.cycle.more_body:
            self._expect()
        super().on_response_complete()

    def on_message_complete(self) -> None:
        """Cancel the timeout at the end of a request."""
        self._have()
        super().on_message_complete()

    def _expect(self) -> None:
        self._have()
        self._due = self.loop.call_later(HEAD_S, self._close)

    def _have(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None

    def _close(self) -> None:
        if not self.transport.is_closing():
            self.transport.close()

    def _taken(self) -> int:
        """Return the number of bytes that the system has taken for the client since the connection was made."""
        return self._counted.written_bytes - self.transport.get_write_buffer_size()

    def _wrote(self) -> None:
        """Start checking the client's rate, unless everything written was taken at once."""
        if self._look is None and self.transport.get_write_buffer_size():
            self._taken_bytes, self._behind_s = self._taken(), 0.0
            self._look = self.loop.call_later(LOOK_S, self._look_on)

    def _look_on(self) -> None:
        """Abort the connection if the client is too far behind; stop checking once it has taken everything."""
        self._look = None
        if not self.transport.get_write_buffer_size():
            return
        taken = self._taken()
        self._behind_s = max(0.0, self._behind_s + LOOK_S - (taken - self._taken_bytes) / self.bytes_per_s)
        self._taken_bytes = taken
        if self._behind_s >= self.patience_s:
            log.info("A client did not read its response; its connection was closed.")
            self.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, AT_ONCE)
            self.transport.abort()
        else:
            self._look = self.loop.call_later(LOOK_S, self._look_on)


@lru_cache(maxsize=1)
def _dated(moment_s: int) -> list[tuple[bytes, bytes]]:
    return [(b"date", formatdate(moment_s, usegmt=True).encode())]


def connections(settings: Settings) -> type[PunctualConnection]:
    """Return the connection class of a server with these settings."""

    class TimedConnection(PunctualConnection):
        patience_s, bytes_per_s = settings.download_patience_s, settings.download_bytes_per_s

    return TimedConnection


def fork_worker(settings: Settings) -> Fork:
    """Start a worker in a fork of this process, which must not have started a thread.

    It shares the memory of what this process has imported, and ends when this one does.
    """
    ours = os.getpid()
    if (pid := os.fork()) == 0:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        run_child(settings, ours)
    return Fork(pid)


def start_worker_child(settings: Settings) -> subprocess.Popen[bytes]:
    """Start a worker in a new interpreter, in the place of one that has ended; it ends when this process does."""
    return subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-c", _WORKER, str(os.getpid())],
        env=environment(settings),
        stdin=subprocess.DEVNULL,
    )


def environment(settings: Settings) -> dict[str, str]:
    """Return the environment from which exactly these settings are read."""
    others = {name: value for name, value in os.environ.items() if not name.upper().startswith(PREFIX)}
    ours = {PREFIX + name.upper(): str(value) for name, value in settings if value is not None}
    return others | ours


def prepare(settings: Settings) -> bool:
    """Migrate the database and seed its catalogue; return whether it was migrated."""
    with closing(Database.of(settings)) as database:
        return prepare_database(database, settings)


def refuse_keyless(settings: Settings) -> None:
    """Check that a service reachable from other machines has a valid key, or an authenticating proxy.

    Raises:
        Conflict: It has neither.
    """
    if settings.beyond_loopback and settings.proxy_header is None:
        with closing(Database.of(settings)) as database, database.reading() as session:
            refuse_without_keys(session)


def refuse_taken(host: str, port: int) -> None:
    """Check that this process can listen at an address, before anything else is started.

    Raises:
        BadSettings: Another process listens there, the address is not of this machine, or this user may not use the
            port.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind(address)
    except socket.gaierror as error:
        raise BadSettings(f"SKILLS_HOST={host} is not an address.", "For this machine alone use 127.0.0.1.") from error
    except OSError as error:
        other = f"Choose another port, such as {port + 1}: SKILLS_PORT={port + 1}"
        if error.errno == errno.EADDRINUSE:
            raise BadSettings(f"Port {port} of {host} is in use by another process.", other) from error
        if error.errno == errno.EACCES:
            raise BadSettings(
                f"This user may not listen at port {port}.", "Choose one above 1023: SKILLS_PORT=8000"
            ) from error
        if error.errno == errno.EADDRNOTAVAIL:
            raise BadSettings(
                f"SKILLS_HOST={host} is not an address of this machine.", "For this machine alone use 127.0.0.1."
            ) from error
        raise


def begin(given: int) -> None:
    """Begin a command in this new image of its process, which has no secret yet: none may reach the reader's process.

    Args:
        given: A file with the environment and the arguments of the command, as JSON, which is read last.
    """
    if not is_cached():
        print("The loops are compiled for this machine, once: some ten seconds.", flush=True)
    get_ready()
    warm_up(learn_once).join()
    fork_ahead(READY)
    with os.fdopen(given) as file:
        environment, sys.argv = json.load(file)
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = None  # what was imported has asked for it already, without TMPDIR
    time.tzset()


def serve(settings: Settings, *, samples: bool = False) -> None:
    """Serve until a signal ends the process; the address must have been checked (`Settings.check_address`).

    Raises:
        BadSettings: `samples` is for loopback without TLS only; the address cannot be used; or the settings require
            containment that this system does not offer.
        Conflict: See `refuse_keyless`.
    """
    if samples and (settings.beyond_loopback or settings.tls_cert is not None):
        raise BadSettings("--samples is only for a service on this machine.", Remedy(Action.LOAD_SAMPLES))
    refuse_taken(settings.host, settings.port)
    logs.configure(settings.log_level, as_json=settings.log_format == "json")
    check_cache_setting()
    if settings.containment == "required":
        refuse_uncontained()
    with closing(Database.of(settings)) as database:
        prepare_to_serve(database, settings)
    refuse_keyless(settings)
    warm_up(learn_once).join()
    with working(settings):
        _serve(settings, samples)


def _serve(settings: Settings, samples: bool) -> None:
    """Serve with workers that run already."""
    app = create_app(settings)

    def then() -> None:
        gc.freeze()  # everything imported so far stays, so later collections skip it
        gc.enable()
        if settings.port:
            scheme = "http" if settings.tls_cert is None else "https"
            print(f"The page: {scheme}://{settings.host}:{settings.port}{settings.root_path}/", flush=True)
        if samples:
            threading.Thread(target=_load, args=(settings, app.state.access.own_key), daemon=True).start()
        app.state.reader.server.wait()
        layers_held()  # logs a warning if some are missing

    server = Server(
        uvicorn.Config(
            app,
            host=settings.host,
            port=settings.port,
            root_path=settings.root_path,
            ssl_certfile=settings.tls_cert,
            ssl_keyfile=settings.tls_key,
            proxy_headers=False,  # the caller is not derived from headers that anybody can send
            http=connections(settings),
            ws=LimitedWebSocket,
            ws_max_size=MESSAGE_BYTES,
            ws_ping_interval=settings.heartbeat_s,
            ws_ping_timeout=settings.heartbeat_s,
            ws_per_message_deflate=False,  # a message has 200 bytes; compressing them would take longer than a tick
            log_config=None,  # its records go through our logging
            log_level="warning",
            access_log=False,
            timeout_graceful_shutdown=GRACE_S,
            server_header=False,
        ),
        then,
    )
    signal.signal(signal.SIGTERM, _leave)  # the server raises a signal again after its shutdown
    signal.signal(signal.SIGINT, _leave)
    with keeping_erasures(settings):
        server.run()
    if server.refused is not None:
        raise server.refused


# Ours: frames that complete no message, which a client needs every few seconds to ping. They never reach a session.
FRAMES, FRAMES_PER_S = 20, 5.0
SLICE_BYTES = 256  # parsed before the next ones: a client that sends many frames at once must not hold up the others
FLOODED_BY_FRAMES = f"At most {FRAMES_PER_S:g} frames without a message a second, and {FRAMES} at once."


class ArrivalQueue(asyncio.Queue[Any]):
    """A queue of ASGI events that notes when each of them arrived."""

    def put_nowait(self, item: Any) -> None:
        """Add an event with `arrived_s`, of the monotonic clock."""
        super().put_nowait(item | {"arrived_s": time.monotonic()})


class LimitedWebSocket(WebSocketsSansIOProtocol):
    """A WebSocket that is closed when it gets too many frames that complete no message."""

    def __init__(self, *given: Any, **how: Any) -> None:
        super().__init__(*given, **how)
        self.queue = ArrivalQueue()
        self._bucket = Bucket(FRAMES, FRAMES_PER_S)

    def data_received(self, data: bytes) -> None:
        """Parse what arrived, slice by slice, until the connection ends."""
        for at in range(0, len(data), SLICE_BYTES):
            if self.close_sent:
                return
            super().data_received(data[at : at + SLICE_BYTES])

    async def send(self, message: Any) -> None:
        """Send an event; a refusal completes the handshake, or uvicorn would log an error for each."""
        await super().send(message)
        self.handshake_complete = self.handshake_complete or self.close_sent

    def handle_ping(self) -> None:
        """Answer a ping."""
        if self._counted():
            super().handle_ping()

    def handle_pong(self, event: Any) -> None:
        """Take the answer to a ping."""
        if self._counted():
            super().handle_pong(event)

    def handle_text(self, event: Any) -> None:
        """Take a message, or its first piece."""
        if event.fin or self._counted():
            super().handle_text(event)

    def handle_cont(self, event: Any) -> None:
        """Take a further piece of a message."""
        if self._counted():
            super().handle_cont(event)

    def _counted(self) -> bool:
        """Count a frame; return whether it is taken, and close the connection if there are too many."""
        if self.close_sent:
            return False
        if self._bucket.take(1.0) == 0:
            return True
        self.conn.fail(FLOODED, FLOODED_BY_FRAMES)
        self.handle_parser_exception()  # sends the reason, ends the session and closes the connection
        return False


class Server(uvicorn.Server):
    """A server that runs a function in a thread once it answers, and stops if that function fails.

    It waits for its end, where uvicorn looks for it and dates the responses ten times a second.
    """

    def __init__(self, config: uvicorn.Config, then: Callable[[], None]) -> None:
        super().__init__(config)
        self.refused: SkillsError | None = None
        self._then = then
        self._left: Callable[[], object] = lambda: None

    async def main_loop(self) -> None:
        """Wait for the end."""
        loop, over = asyncio.get_running_loop(), asyncio.Event()
        self._left = lambda: loop.call_soon_threadsafe(over.set)
        if not self.should_exit:
            await over.wait()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """End because of a signal."""
        super().handle_exit(sig, frame)
        self._left()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to listen, then start the thread."""
        await super().startup(sockets)
        if self.started:
            threading.Thread(target=self._settle, daemon=True).start()

    def _settle(self) -> None:
        try:
            self._then()
        except SkillsError as refused:
            self.refused, self.should_exit = refused, True
            self._left()


@contextmanager
def keeping_erasures(settings: Settings) -> Iterator[None]:
    """Keep the file of erasures up to date during the block, if the settings name one.

    It is derived from the database's events, because workers and commands elsewhere erase and withdraw too.

    Raises:
        BadSettings: The file cannot be written.
    """
    file = settings.erasures_file
    if file is None:
        yield
        return
    over = threading.Event()

    def keep(known: int) -> None:
        pause_s = ERASURES_EVERY_S
        while not over.wait(pause_s):
            began_s = time.monotonic()
            try:
                known = keep_up_erasures(database, file, known)
            except (OSError, SkillsError) as error:
                log.error(
                    "The list of erasures could not be written (%s); it will be tried again.", type(error).__name__
                )
            pause_s = max(ERASURES_EVERY_S, 10 * (time.monotonic() - began_s))  # a long list costs a tenth of a core

    with closing(Database.of(settings)) as database:
        try:
            known = keep_up_erasures(database, file)
            # there are no erasures yet; write the file anyway, to find out now whether that is possible
            if not file.exists():
                keep_erasures(database, file)
        except OSError as error:
            raise BadSettings(f"SKILLS_ERASURES_FILE cannot be written: {error.strerror or error}.") from error
        keeper = threading.Thread(target=keep, args=(known,))
        keeper.start()
        try:
            yield
        finally:
            over.set()
            keeper.join()
            with suppress(OSError, SkillsError):
                keep_up_erasures(database, file)


@contextmanager
def working(settings: Settings) -> Iterator[None]:
    """Run workers during the block, and replace those that die; forks of this process if it has no other thread yet."""
    start = fork_worker if threading.active_count() == 1 else start_worker_child
    crew: list[Fork | subprocess.Popen[bytes]] = [start(settings) for _ in range(settings.workers)]
    over, changing = threading.Event(), threading.Lock()

    def keep(place: int) -> None:
        while True:
            code = crew[place].wait()
            over.wait(RESTART_S)
            with changing:
                if over.is_set():
                    return
                log.warning("A worker ended with %s; another one is started.", code)
                crew[place] = start_worker_child(settings)

    keepers = [threading.Thread(target=keep, args=(place,), daemon=True) for place in range(len(crew))]
    for keeper in keepers:
        keeper.start()
    try:
        yield
    finally:
        with changing:
            over.set()
        deadline_s = time.monotonic() + GRACE_S  # a worker finishes its work in progress before
        for signalled, until_s in ((signal.SIGTERM, deadline_s), (signal.SIGKILL, deadline_s + 1.0)):
            for worker, keeper in zip(crew, keepers, strict=True):
                if keeper.is_alive():
                    with suppress(ProcessLookupError):
                        os.kill(worker.pid, signalled)
            for keeper in keepers:
                keeper.join(max(0.0, until_s - time.monotonic()))


def _leave(_signal: int, _frame: FrameType | None) -> None:
    """Exit with 0, because a signal to stop is no failure."""
    sys.exit(0)


def _load(settings: Settings, key: str) -> None:
    """Load the samples and train them, over HTTP; print what came of it."""
    errors: list[str] = []
    with going_on(errors, "the service"), Client(f"http://{settings.host}:{settings.port}", api_key=key) as client:
        for demo in load_samples(client, errors):
            with going_on(errors, f"{demo.surgeon}, {demo.suture}"):
                client.train(demo.surgeon, demo.suture, release=True)
    few = ["Some samples are not loaded or trained:", *dict.fromkeys(errors)]
    print("\n  ".join(few) if errors else "The samples are loaded.", flush=True)
