"""The settings of an installation, from `SKILLS_*` variables; nothing else reads the environment for settings."""

import os
import re
from collections.abc import Iterable
from functools import cache
from ipaddress import ip_address
from pathlib import Path
from typing import Literal, get_args

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from skills.errors import BadSettings
from skills.remedies import did_you_mean

MEBIBYTE = 1 << 20
PREFIX = "SKILLS_"
FOR_TESTS = "SKILLS_TEST_"  # prefix of the test suite's variables, which nothing in the package reads
Role = Literal["reader", "uploader", "trainer", "releaser", "admin"]
PROXY_SECRET_LENGTH = 32  # characters; random ones of this length cannot be guessed
DATABASE = "skills.sqlite"  # the default one's file
LOOPBACK = ("localhost", "127.0.0.1", "[::1]")


def _folder(variable: str, name: str) -> Path:
    """Return our folder in that of a variable, or else in `~/.local`; XDG has relative paths ignored."""
    within = Path(os.environ.get(variable, ""))
    return (within if within.is_absolute() else Path.home() / ".local" / name) / "suture-skills"


def _cores() -> int:
    """Return the number of cores that this process may use, at most 4: on a larger machine the user should choose."""
    return min(4, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


class Settings(BaseSettings):
    """The settings of an installation."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, frozen=True, extra="ignore")

    database_url: str = Field(default_factory=lambda: f"sqlite:///{_folder('XDG_DATA_HOME', 'share') / DATABASE}")
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535)
    root_path: str = ""
    server: str | None = None  # address of the service for the client; None: the application in this process
    api_key: SecretStr | None = None  # the client's key for it
    erasures_file: Path | None = None  # list of erasures to apply after a restore; kept up to date if it is named
    # secret key that signs the history, made at the first start; kept apart from the database and its backups
    signing_key: Path = Field(default_factory=lambda: _folder("XDG_STATE_HOME", "state") / "signing.key")
    # file to which each signed head of the history is appended, and with which the database is compared; by default a
    # file beside the signing key
    checkpoints: Path | None = None
    verify_every_s: float = Field(default=3600.0, ge=1)  # between two verifications of the history by a worker
    sample_recordings: Path | None = None
    paper_data: Path | None = None

    max_upload_bytes: int = Field(default=256 * MEBIBYTE, gt=0)
    upload_deadline_s: float = Field(default=120.0, gt=0)
    # grace period of an upload; after it the body must have arrived at the following rate, a modem's
    upload_patience_s: float = Field(default=20.0, gt=0)
    upload_bytes_per_s: int = Field(default=16 << 10, gt=0)
    download_patience_s: float = Field(default=20.0, gt=0)  # grace period of a client that stops reading
    download_bytes_per_s: int = Field(default=16 << 10, gt=0)  # a client that reads slower than this falls behind
    readers: int = Field(default=4, ge=1, le=24)  # uploads read at once, each in a separate process with these limits:
    reading_memory_bytes: int = Field(default=1024 * MEBIBYTE, gt=0)  # a million poses in MCAP take 320 MiB
    reading_cpu_s: int = Field(default=30, gt=0)  # a million poses take 1 s, as a table 3 s
    reading_wall_s: float = Field(default=60.0, gt=0)  # other uploads may be read at the same time
    reading_file_bytes: int = Field(default=1024 * MEBIBYTE, gt=0)  # a bag unpacked from its archive
    reading_answer_bytes: int = Field(default=256 * MEBIBYTE, gt=0)  # 4 million poses
    # of readers, simulators and learners: run with the layers that the system offers and warn, or refuse to start
    containment: Literal["available", "required"] = "available"
    # a zip of 10,000 episodes of 10 s has half of it; storing it locks a SQLite database for some seconds
    max_dataset_bytes: int = Field(default=1024 * MEBIBYTE, gt=0)
    playback_timeout_s: float = Field(default=120.0, gt=0)
    playback_memory_bytes: int = Field(default=1024 * MEBIBYTE, gt=0)
    # of a learner that is not tabular: default budgets take ten minutes
    learning_timeout_s: float = Field(default=3600.0, gt=0)
    # of address space: torch reserves half of it and uses a tenth
    learning_memory_bytes: int = Field(default=6144 * MEBIBYTE, gt=0)
    # errors of the arms (docs/errors.md), under which every pass must succeed: uncalibrated, calibrated, or the JSON of
    # a laboratory's own, or a file with it ...
    arm_errors: str = "uncalibrated"
    # how PSM_A is driven and what errors it is allowed (docs/execution.md), as JSON or a file with it; "" for verdicts
    # that say "not executed"
    servo: str = ""
    # ... with this probability
    replay_lower_bound: float = Field(default=0.95, ge=0, le=1)
    # the release gate requires that every start so near to the demonstrated one, an uncalibrated arm's error, ...
    near_radius_mm: float = Field(default=3.0, gt=0, allow_inf_nan=False)
    # ... follows this share of the demonstration; recordings and samples: 0.91 or more, see docs/joining.md
    near_least_share: float = Field(default=0.4, ge=0, le=1)
    # ... and, in a scene, finishes with at least this probability, and touches with at most this one (docs/scenes.md)
    scene_least_finishing: float = Field(default=0.9, ge=0, le=1)
    scene_most_touching: float = Field(default=0.05, ge=0, le=1)
    # greatest turn of the surgeon's, of a plan to export or a version to release that holds the jaw; beyond it the
    # needle would stand in the jaws as no estimate of success allows for
    constant_turn_deg: float = Field(default=10.0, ge=0, le=180)
    workers: int = Field(default_factory=_cores, ge=0, le=64)  # worker processes; 0: workers run elsewhere
    lease_s: float = Field(default=2.0, gt=0)  # a worker without a heartbeat for longer is considered dead
    keep_jobs_days: float = Field(default=365.0, ge=1, le=36_500)  # jobs after their end; events stay
    keep_pictures_days: float = Field(default=365.0, ge=1, le=36_500)  # films and plots; they can be drawn again
    job_attempts: int = Field(default=3, ge=1)
    hosts: str = ""  # further host names of this service, separated by commas
    tls_cert: Path | None = None
    tls_key: Path | None = None
    # a proxy in front terminates TLS, and only the proxy can reach the address of this service
    tls_by_proxy: bool = False
    proxy_header: str | None = None  # header in which an authenticating proxy names the user ...
    proxy_secret: SecretStr | None = None  # ... and value of X-Skills-Proxy-Secret, which authenticates the proxy
    proxy_role: Role = "reader"  # role of every user whom the proxy names
    # long enough for a page that stays open during a long case
    sign_in_idle_s: float = Field(default=2 * 3600.0, gt=120)
    sign_in_s: float = Field(default=12 * 3600.0, gt=120)  # a working day
    key_requests_per_s: float = Field(default=200.0, gt=0)  # per key: a robot with requests at 100 Hz, and a web page
    key_upload_bytes_per_day: int = Field(default=20480 * MEBIBYTE, gt=0)  # 80 of the largest recordings
    key_watchers: int = Field(default=100, ge=1)  # event streams of a key at once: as many as its owner may have jobs
    key_sessions: int = Field(default=100, ge=1)  # sessions of pose styles of a key at once
    session_idle_s: float = Field(default=30.0, gt=0)  # a session without a message for longer is closed
    # of event streams and sessions: proxies close an idle one after 30 to 60 s
    heartbeat_s: float = Field(default=15.0, gt=0)
    key_jobs: int = Field(default=100, ge=1)  # unfinished jobs of an owner; a batch counts as one
    log_level: Literal["debug", "info", "warning", "error"] = "warning"  # "info" adds a line for each request and job
    log_format: Literal["text", "json"] = "text"

    @field_validator("arm_errors", "servo")
    @classmethod
    def _content_of_file(cls, stated: str) -> str:
        """Return the name or the JSON of what is stated of the arms as it is, and of a file the content."""
        file = Path(stated)
        return file.read_text() if file.suffix == ".json" else stated

    @field_validator("database_url")
    @classmethod
    def _of_postgresql(cls, url: str) -> str:
        """Accept `postgres://`, the spelling of libpq and many hosts, for `postgresql://`."""
        return url.replace("postgres://", "postgresql://", 1) if url.startswith("postgres://") else url

    @property
    def engine_url(self) -> str:
        """Return the job engine's database URL: a second SQLite file; on PostgreSQL ours, with a schema of its own."""
        if self.database_url.startswith("sqlite"):
            return self.database_url.removesuffix(".sqlite") + ".jobs.sqlite"
        return self.database_url

    @property
    def beyond_loopback(self) -> bool:
        """Return whether the address can be reached from other machines."""
        host = "127.0.0.1" if self.host == "localhost" else self.host
        try:
            return not ip_address(host).is_loopback
        except ValueError:
            return True

    @property
    def host_names(self) -> frozenset[str]:
        """Return the host names at which requests are accepted, without ports."""
        names = (name.strip().lower() for name in (*LOOPBACK, self.host, *self.hosts.split(",")))
        return frozenset(f"[{name}]" if ":" in name and name[0] != "[" else name for name in names if name)

    def check_address(self) -> None:
        """Check that traffic beyond loopback is encrypted, and that a proxy can be authenticated.

        Raises:
            BadSettings: The settings contradict each other; the message says which.
        """
        if (self.tls_cert is None) != (self.tls_key is None):
            raise BadSettings("SKILLS_TLS_CERT and SKILLS_TLS_KEY belong together; set both.")
        secret = "" if self.proxy_secret is None else self.proxy_secret.get_secret_value()
        if self.proxy_header is not None and len(secret) < PROXY_SECRET_LENGTH:
            raise BadSettings(
                "SKILLS_PROXY_HEADER needs SKILLS_PROXY_SECRET, at least 32 random characters which the proxy "
                "sends as X-Skills-Proxy-Secret: without it any client could send that header."
            )
        if not self.beyond_loopback:
            return
        if self.tls_cert is None and not self.tls_by_proxy:
            raise BadSettings(
                f"SKILLS_HOST={self.host} is reachable from other machines, and keys must not be sent unencrypted.",
                "Set SKILLS_TLS_CERT and SKILLS_TLS_KEY, or SKILLS_TLS_BY_PROXY=true if a proxy terminates TLS.",
            )
        if self.host in ("0.0.0.0", "::") and not self.hosts:  # noqa: S104 - compared, not bound
            raise BadSettings("SKILLS_HOST is every address of this machine; list its host names in SKILLS_HOSTS.")


@cache
def settings() -> Settings:
    """Read the environment, once.

    Raises:
        BadSettings: A variable is not one of the settings, or has an invalid value. The message names it without its
            value, which may be secret.
    """
    refuse_unknown(os.environ)
    try:
        return Settings()
    except ValidationError as error:
        said = [
            f"{PREFIX}{'_'.join(map(str, one['loc'])).upper()}: "
            + one["msg"].replace("Input should be", "it must be").partition(", unable")[0]
            for one in error.errors()
        ]
        choices = [one for one in error.errors() if one["type"] == "literal_error"]  # their values are no secrets
        known = [(str(one["input"]), get_args(Settings.model_fields[str(one["loc"][0])].annotation)) for one in choices]
        near = [meant for given, names in known for meant in did_you_mean(given, names)]
        raise BadSettings(f"{'; '.join(said)}.", *near, "Set it to such a value, or unset it.") from None


def refuse_unknown(environment: Iterable[str]) -> None:
    """Refuse an unknown variable with our prefix: if a misspelt one were ignored, another database could be used.

    Raises:
        BadSettings: There is one; the message names the most similar setting.
    """
    known = {f"{PREFIX}{name.upper()}" for name in Settings.model_fields}
    unknown = [
        name
        for name in sorted(environment)
        if name.upper().startswith(PREFIX) and not name.upper().startswith(FOR_TESTS) and name.upper() not in known
    ]
    if unknown:
        # without the prefix, which would make all names similar
        names = [one.removeprefix(PREFIX) for one in sorted(known)]
        said = (did_you_mean(name.upper().removeprefix(PREFIX), names) for name in unknown[:5])
        near = [re.sub("'(?=[A-Z])", f"'{PREFIX}", one) for some in said for one in some]
        words = "are not settings" if len(unknown) > 1 else "is not a setting"
        raise BadSettings(f"{', '.join(unknown[:5])} {words} of suture-skills.", *near, "Correct it or unset it.")
