"""The real service for the faults: kept running as systemd's `Restart=on-failure` does, with its log in a file."""

import json
import re
import subprocess
from collections import Counter
from pathlib import Path
from threading import Event, Thread
from typing import Any

from tests.e2e.conftest import Service
from tests.faults.shim import Shim

RESTART_S = 0.5
SAID = 110  # characters of a log line that distinguish it


class Installation(Service):
    """A service whose process is started again when it ends by itself."""

    def __init__(self, folder: Path, shim: Shim | None = None, **settings: object) -> None:
        """Prepare a service.

        Args:
            folder: The folder of its database and temporary files.
            shim: Control of its disk and clock.
            settings: Further settings.
        """
        super().__init__(folder, log_format="json", **settings)
        self.log = folder.with_name(f"{folder.name}-{self.port}.log")
        self.environment["TMPDIR"] = str(folder)
        if shim is not None:
            self.environment |= shim.environment
        self.exits: list[int] = []
        self._over = Event()
        self._watch = Thread(target=self._keep)

    def launch(self) -> None:
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(self.command, env=self.environment, stderr=log)

    def start(self) -> None:
        """Start it, wait until it is ready, and keep it running from then on."""
        super().start()
        self._watch.start()

    def stop(self) -> int:
        """Stop it, and start it no more."""
        self._over.set()
        if self._watch.is_alive():
            self._watch.join()
        return super().stop()

    def _keep(self) -> None:
        while not self._over.wait(RESTART_S):
            if self.process is not None and (code := self.process.poll()) is not None:
                self.exits.append(code)
                self.launch()

    def lines(self, begin: int = 0) -> list[dict[str, Any]]:
        """Return the lines of its log from a place on."""
        with self.log.open("rb") as log:
            log.seek(begin)
            found = []
            for line in log:
                try:
                    found.append(json.loads(line))
                except ValueError:  # the interpreter's own words
                    found.append({"level": "raw", "message": line.decode(errors="replace").strip()})
            return found

    def bugs(self, begin: int = 0) -> list[str]:
        """Return the exceptions in its log that nothing expected, each once, with its places."""
        wrong = [one for one in self.lines(begin) if one["level"] == "raw" or "raised_at" in one]
        return sorted({f"{_alike(one)} {' < '.join(reversed(one.get('raised_at', [])))}" for one in wrong})

    def said(self, begin: int = 0) -> Counter[str]:
        """Count the messages in its log; those that differ in numbers and ids alone are alike."""
        return Counter(_alike(one) for one in self.lines(begin))


def _alike(line: dict[str, Any]) -> str:
    message = re.sub(r"(?<!\w)/[\w./-]+", "PATH", line["message"])
    message = re.sub(r"\b[0-9a-f-]*[0-9][0-9a-f-]*\b", "#", message)[:SAID].strip()
    return f"{line['level']}: {message}" + (f" ({line['error']})" if "error" in line else "")
