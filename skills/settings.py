"""The one place that reads the environment: `SKILLS_*` variables into one frozen object."""

import os
from functools import cache
from ipaddress import ip_address
from pathlib import Path
from typing import Literal

from pydantic import Field, SecretStr, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from skills.errors import BadSettings

MEBIBYTE = 1 << 20
Role = Literal["reader", "uploader", "trainer", "releaser", "admin"]
PROXY_SECRET_LENGTH = 32  # of a random one, nobody guesses that
LOOPBACK = ("localhost", "127.0.0.1", "[::1]")


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
    api_key: SecretStr | None = None  # what the client shows there
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
    learning_timeout_s: float = Field(
        default=3600.0, gt=0
    )  # of a learner beyond the table: default budgets take ten minutes
    learning_memory_bytes: int = Field(default=6144 * MEBIBYTE, gt=0)  # addresses: torch claims half, uses a tenth
    replay_tip_error_mm: float = Field(default=0.65, ge=0)  # a calibrated dVRK's; under it every pass shall succeed
    replay_lower_bound: float = Field(default=0.95, ge=0, le=1)  # as surely: samples do at 0.99, at 3 mm at 0.28
    workers: int = Field(default_factory=_cores, ge=0, le=64)  # processes beside the service; 0: they run elsewhere
    lease_s: float = Field(default=2.0, gt=0)  # a worker silent for longer is taken for dead
    job_attempts: int = Field(default=3, ge=1)
    hosts: str = ""  # further names that this service is called by, with commas between them
    tls_cert: Path | None = None
    tls_key: Path | None = None
    tls_by_proxy: bool = False  # a proxy in front speaks TLS, and nobody but it reaches the address of this service
    proxy_header: str | None = None  # the header in which an authenticating proxy names the person ...
    proxy_secret: SecretStr | None = None  # ... beside X-Skills-Proxy-Secret, by which it is known to be the proxy
    proxy_role: Role = "reader"  # of everybody whom it names
    sign_in_idle_s: float = Field(default=2 * 3600.0, gt=120)  # a page left open over a long case is still signed in
    sign_in_s: float = Field(default=12 * 3600.0, gt=120)  # a working day
    key_requests_per_s: float = Field(default=200.0, gt=0)  # of each key: a robot that asks at 100 Hz, and a page
    key_upload_bytes_per_day: int = Field(default=20480 * MEBIBYTE, gt=0)  # 80 of the largest recordings
    key_jobs: int = Field(default=100, ge=1)  # that an owner has waiting or running; a batch is one
    log_level: Literal["debug", "info", "warning", "error"] = "warning"  # "info" adds a line for each request and job
    log_format: Literal["text", "json"] = "text"

    @property
    def engine_url(self) -> str:
        """The job engine's database: beside ours on SQLite, a schema of its own on PostgreSQL."""
        if self.database_url.startswith("sqlite"):
            return self.database_url.removesuffix(".sqlite") + ".jobs.sqlite"
        return self.database_url

    @property
    def beyond_loopback(self) -> bool:
        """Whether the address is reached from other machines."""
        host = "127.0.0.1" if self.host == "localhost" else self.host
        try:
            return not ip_address(host).is_loopback
        except ValueError:
            return True

    @property
    def host_names(self) -> frozenset[str]:
        """The names that requests may call this service by, without ports."""
        names = (name.strip().lower() for name in (*LOOPBACK, self.host, *self.hosts.split(",")))
        return frozenset(f"[{name}]" if ":" in name and name[0] != "[" else name for name in names if name)

    def check_address(self) -> None:
        """Refuse to speak in the clear beyond loopback, or to trust a proxy that cannot be told from anybody else.

        Raises:
            BadSettings: The settings do not go together; the message says which.
        """
        if (self.tls_cert is None) != (self.tls_key is None):
            raise BadSettings("SKILLS_TLS_CERT and SKILLS_TLS_KEY belong together; give both.")
        secret = "" if self.proxy_secret is None else self.proxy_secret.get_secret_value()
        if self.proxy_header is not None and len(secret) < PROXY_SECRET_LENGTH:
            raise BadSettings(
                "SKILLS_PROXY_HEADER needs SKILLS_PROXY_SECRET, at least 32 random characters which the proxy sends as "
                "X-Skills-Proxy-Secret: without it anybody could send that header."
            )
        if not self.beyond_loopback:
            return
        if self.tls_cert is None and not self.tls_by_proxy:
            raise BadSettings(
                f"SKILLS_HOST={self.host} is reached from outside, where keys must not go in the clear: give "
                "SKILLS_TLS_CERT and SKILLS_TLS_KEY, or SKILLS_TLS_BY_PROXY=true where a proxy in front speaks TLS."
            )
        if self.host in ("0.0.0.0", "::") and not self.hosts:  # noqa: S104 - compared, not bound
            raise BadSettings("SKILLS_HOST is every address of this machine; name it in SKILLS_HOSTS as it is called.")


@cache
def settings() -> Settings:
    """Read the environment, once.

    Raises:
        BadSettings: A variable has a value that cannot be meant; it is named, its value is not: it may be secret.
    """
    try:
        return Settings()
    except ValidationError as error:
        said = [f"SKILLS_{'_'.join(map(str, one['loc'])).upper()}: {one['msg']}" for one in error.errors()]
        raise BadSettings(f"{'; '.join(said)}.") from None
