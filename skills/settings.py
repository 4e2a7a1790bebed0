"""The one place that reads the environment: `SKILLS_*` variables into one frozen object."""

import os
from functools import cache
from ipaddress import ip_address
from pathlib import Path
from typing import Literal

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

from skills.errors import BadSettings

MEBIBYTE = 1 << 20


def _data_folder() -> Path:
    return Path.home() / ".local" / "share" / "suture-skills"


def _cores() -> int:
    """Count the cores that this process may use; beyond four a laptop wants to choose."""
    return min(4, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


class Settings(BaseSettings):
    """How this installation runs."""

    model_config = SettingsConfigDict(env_prefix="SKILLS_", frozen=True, extra="ignore")

    database_url: str = Field(default_factory=lambda: f"sqlite:///{_data_folder() / 'skills.sqlite'}")
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535)
    root_path: str = ""
    server: str | None = None  # where the client finds the service; None: the application in this process
    sample_recordings: Path | None = None
    paper_data: Path | None = None

    max_upload_bytes: int = Field(default=256 * MEBIBYTE, gt=0)
    upload_deadline_s: float = Field(default=120.0, gt=0)
    upload_patience_s: float = Field(default=20.0, gt=0)  # then a body must have come at this rate, a modem's:
    upload_bytes_per_s: int = Field(default=16 << 10, gt=0)
    readers: int = Field(default=4, ge=1, le=24)  # uploads read at once, each in a process of its own, under these:
    reading_memory_bytes: int = Field(default=1024 * MEBIBYTE, gt=0)  # a million poses in MCAP take 320 MiB
    reading_cpu_s: int = Field(default=30, gt=0)  # they take 1 s, as a table 3
    reading_wall_s: float = Field(default=60.0, gt=0)  # others may be read beside it
    reading_file_bytes: int = Field(default=1024 * MEBIBYTE, gt=0)  # a bag unpacked from its archive
    reading_answer_bytes: int = Field(default=256 * MEBIBYTE, gt=0)  # 4 million poses
    playback_timeout_s: float = Field(default=120.0, gt=0)
    playback_memory_bytes: int = Field(default=1024 * MEBIBYTE, gt=0)
    replay_tip_error_mm: float = Field(default=0.65, ge=0)  # a calibrated dVRK's; under it every pass shall succeed
    replay_lower_bound: float = Field(default=0.95, ge=0, le=1)  # as surely: samples do at 0.99, at 3 mm at 0.28
    workers: int = Field(default_factory=_cores, ge=0, le=64)  # processes beside the service; 0: they run elsewhere
    lease_s: float = Field(default=2.0, gt=0)  # a worker silent for longer is taken for dead
    job_attempts: int = Field(default=3, ge=1)
    log_level: Literal["debug", "info", "warning", "error"] = "warning"  # "info" adds a line for each request and job
    log_format: Literal["text", "json"] = "text"

    @property
    def engine_url(self) -> str:
        """The job engine's database: beside ours on SQLite, a schema of its own on PostgreSQL."""
        if self.database_url.startswith("sqlite"):
            return self.database_url.removesuffix(".sqlite") + ".jobs.sqlite"
        return self.database_url

    def check_address(self) -> None:
        """Refuse to be reached from outside: this version has no keys.

        Raises:
            BadSettings: The address is not a loopback one.
        """
        host = "127.0.0.1" if self.host == "localhost" else self.host
        try:
            loopback = ip_address(host).is_loopback
        except ValueError:
            loopback = False
        if not loopback:
            raise BadSettings(
                f"SKILLS_HOST={self.host} would be reached from outside, and this version has no API keys yet; "
                "use 127.0.0.1, with an authenticating proxy in front where others need it."
            )


@cache
def settings() -> Settings:
    """Read the environment, once."""
    return Settings()
