"""Starting the service: the application in this process, its workers in children at lower priority.

First it answers, then it gets ready for what only some requests need.
"""

import gc
import logging
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from types import FrameType

import uvicorn

from skills import logs
from skills.api.app import create_app, prepare_database
from skills.client import Client
from skills.compiled import check_wanted
from skills.db.session import Database
from skills.errors import BadSettings, SkillsError
from skills.jobs.child import start_worker_child
from skills.jobs.warm import align_once, warm_up
from skills.library.keys import refuse_without_keys
from skills.punctual import PunctualConnection
from skills.samples import load_samples
from skills.settings import Settings

GRACE_S = 12  # a worker finishes what it has begun within ten
RESTART_S = 1.0
FURTHER_S = 5.0  # from one worker to the next: several that start at once are all ready later than the first alone

log = logging.getLogger("skills.serving")


def prepare(settings: Settings) -> None:
    """Migrate the database and seed its catalogue."""
    database = Database(settings.database_url)
    prepare_database(database)
    database.close()


def refuse_keyless(settings: Settings) -> None:
    """Refuse to be reached from other machines where nobody has a key.

    Raises:
        Conflict: Neither a key that counts nor a proxy that says who asks.
    """
    if settings.beyond_loopback and settings.proxy_header is None:
        with closing(Database(settings.database_url)) as database, database.reading() as session:
            refuse_without_keys(session)


def serve(settings: Settings, *, samples: bool = False) -> None:
    """Serve until told to stop; the address must have been checked (`Settings.check_address`)."""
    if samples and (settings.beyond_loopback or settings.tls_cert is not None):
        raise BadSettings("--samples is for a look at this machine's own service; `skills seed` loads them anywhere.")
    logs.configure(settings.log_level, as_json=settings.log_format == "json")
    check_wanted()
    prepare(settings)
    refuse_keyless(settings)
    app = create_app(settings)

    def then() -> None:
        gc.freeze()  # what is there by now stays, and is not looked through again
        gc.enable()
        if samples:
            threading.Thread(target=_load, args=(settings, app.state.access.own_key), daemon=True).start()
        warm_up(align_once)

    server = Server(
        uvicorn.Config(
            app,
            host=settings.host,
            port=settings.port,
            root_path=settings.root_path,
            ssl_certfile=settings.tls_cert,
            ssl_keyfile=settings.tls_key,
            proxy_headers=False,  # who asks is not taken from what anybody may send
            http=PunctualConnection,
            log_config=None,  # what it says goes where ours goes
            log_level="warning",
            access_log=False,
            timeout_graceful_shutdown=GRACE_S,
            server_header=False,
        ),
        then,
    )
    signal.signal(signal.SIGTERM, _leave)  # the server lets a signal through again once it has shut down
    signal.signal(signal.SIGINT, _leave)
    with working(settings):
        server.run()
    if server.refused is not None:
        raise server.refused


class Server(uvicorn.Server):
    """A server that does something more once it answers, beside answering, and ends if that is refused."""

    def __init__(self, config: uvicorn.Config, then: Callable[[], None]) -> None:
        super().__init__(config)
        self.refused: SkillsError | None = None
        self._then = then

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to answer."""
        await super().startup(sockets)
        if self.started:
            threading.Thread(target=self._settle, daemon=True).start()

    def _settle(self) -> None:
        try:
            self._then()
        except SkillsError as refused:
            self.refused, self.should_exit = refused, True


@contextmanager
def working(settings: Settings) -> Iterator[None]:
    """Keep workers at work for as long as the block; the first starts at once, and one that dies is replaced."""
    over = threading.Event()

    def watch() -> None:
        crew: list[subprocess.Popen[bytes]] = []
        began_s = time.monotonic()
        while True:
            for place, worker in enumerate(crew):
                if worker.poll() is not None:
                    log.warning("A worker ended with %s; another one starts.", worker.returncode)
                    crew[place] = start_worker_child(settings)
            if len(crew) < settings.workers and time.monotonic() - began_s >= len(crew) * FURTHER_S:
                crew.append(start_worker_child(settings))
            if over.wait(RESTART_S):
                break
        _end(crew)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()


def _end(crew: list[subprocess.Popen[bytes]]) -> None:
    """Let workers finish what they have begun, for as long as that is allowed."""
    for worker in crew:
        worker.terminate()
    deadline_s = time.monotonic() + GRACE_S
    for worker in crew:
        try:
            worker.wait(max(0.0, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            worker.kill()


def _leave(_signal: int, _frame: FrameType | None) -> None:
    """End well: being told to stop is no failure."""
    sys.exit(0)


def _load(settings: Settings, key: str) -> None:
    """Load the samples and train them, over HTTP."""
    with Client(f"http://{settings.host}:{settings.port}", api_key=key) as client:
        for demo in load_samples(client):
            client.train(demo.surgeon, demo.suture, release=True)
    print(f"The samples are loaded: http://{settings.host}:{settings.port}/policies", flush=True)
