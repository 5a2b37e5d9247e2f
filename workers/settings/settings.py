"""The operator's settings: environment variables ``BIRESNERF_*`` (lists as JSON), or files, named by ``…_FILE``."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Literal

from pydantic import Field, SecretStr, model_validator
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict

from workers.settings.addresses import Network
from workers.settings.errors import SetupError
from workers.settings.settings_files import FileSettingsSource

MIB = 2**20
GIB = 2**30


def default_data_dir() -> Path:
    """The default data folder: a system folder for root, the XDG data folder for other users."""
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        return Path("/var/lib/biresnerf")
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local/share") / "biresnerf"


class Settings(BaseSettings):
    """Deployment settings, the same for every process of one installation."""

    model_config = SettingsConfigDict(env_prefix="BIRESNERF_", frozen=True, extra="ignore")

    database_url: str | None = Field(None, description="postgresql://…; none starts a private PostgreSQL.")
    data_dir: Path = Field(
        default_factory=default_data_dir, description="Files, scratch and private database."
    )
    pg_bin: Path | None = Field(None, description="Folder with initdb and postgres for the private database.")
    host: str = Field("127.0.0.1", description="Address that the web process listens on.")
    port: int = Field(8000, ge=0, le=65535, description="Its port; 0 takes a free one.")
    processes: int = Field(
        1, ge=1, le=16, description="Web processes that `up` and `api` start; they share the port."
    )
    auth: Literal["auto", "required", "off"] = Field(
        "auto",
        description="Who needs an API key. auto: no caller while the service listens on loopback only and no key "
        "was ever made; required: every caller; off: no caller, on any address.",
    )

    key_requests_per_s: float = Field(
        50.0, gt=0, description="Requests a second with one API key, on average, that all web processes take."
    )
    key_requests_burst: int = Field(500, ge=1, description="Requests with one API key at once.")
    key_uploads: int = Field(
        32, ge=0, description="Uploads with one API key at once that each web process takes; 0: no limit."
    )
    log_format: Literal["plain", "json"] = Field("plain", description="Lines for people, or JSON lines.")
    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR"] = Field(
        "INFO", description="Lowest level logged."
    )
    metrics_token: SecretStr | None = Field(
        None, description="Bearer token of /metrics; without one it answers on loopback only."
    )
    traces: Literal["off", "otlp"] = Field(
        "off", description="OpenTelemetry traces, sent where OTEL_EXPORTER_OTLP_ENDPOINT says (extra otel)."
    )
    storage_url: str | None = Field(
        None,
        description="s3://bucket/prefix of an S3-compatible store; none: the folder `files` in data_dir.",
    )
    storage_endpoint: str | None = Field(
        None, description="http(s)://host:port of the store; none: Amazon's own for the region."
    )
    storage_public_endpoint: str | None = Field(
        None, description="How clients reach the store, where they use another address than this service."
    )
    storage_region: str = Field("us-east-1", description="Region of the bucket.")
    storage_access_key_id: str | None = Field(None, description="None: AWS_… variables or the host's role.")
    storage_secret_access_key: str | None = Field(None, repr=False, description="The key's secret.")
    storage_presign: bool = Field(
        False,
        description="Clients get signed addresses of the bucket, to download and upload files there themselves.",
    )
    storage_presign_s: int = Field(900, ge=10, le=604_800, description="Seconds a signed address is valid.")
    share_key: str | None = Field(
        None,
        min_length=16,
        repr=False,
        description="Signs links to results; none: one that is made and kept in the database.",
    )

    slots: int = Field(1, ge=0, le=64, description="Jobs that run at the same time on this machine.")
    beat_s: float = Field(10.0, gt=0, description="Seconds between two heartbeats of a worker.")
    stall_s: float = Field(
        60.0, gt=0, description="A worker without heartbeat for so many seconds counts as dead."
    )
    answer_s: float = Field(20.0, gt=0, description="Seconds a database transaction may take.")
    poll_s: float = Field(
        2.0, gt=0, description="Seconds between two polls, in case a notification was lost."
    )
    janitor_s: float = Field(5.0, gt=0, description="Seconds between two rounds of the janitor.")
    stop_grace_s: float = Field(20.0, gt=0, description="Seconds a job has to write a checkpoint and exit.")
    cancel_grace_s: float = Field(
        6.0, gt=0, description="Seconds a cancelled job has to write a partial result."
    )
    job_timeout_s: float = Field(2 * 3600, gt=0, description="Longest run of one attempt.")
    split_above: int = Field(
        1000,
        ge=0,
        description="Photos above which a job splits itself into parts; 0: never, unless it asks to.",
    )
    part_photos: int = Field(400, ge=20, description="Photos of such a part, about.")
    check_timeout_s: float = Field(
        900, gt=0, description="Longest validation of one dataset; of small ones less."
    )
    max_attempts: int = Field(
        3,
        ge=1,
        description="Crashes after which a job fails, if it stores no checkpoint between them."
        " It may lose three times as many workers.",
    )
    job_nice: int = Field(
        10,
        ge=0,
        le=19,
        description="How far jobs give way to other processes of the machine, as a nice value.",
    )
    max_queued: int = Field(1000, ge=1, description="Jobs that may wait, of all tenants together.")
    tenant_max_running: int = Field(2, ge=0, description="Jobs of one tenant at the same time; 0: no limit.")
    tenant_max_queued: int = Field(100, ge=0, description="Jobs of one tenant that may wait; 0: no limit.")
    tenant_max_stored_bytes: int = Field(
        100 * GIB, ge=0, description="Bytes of one tenant's datasets, uploads and results; 0: no limit."
    )
    tenant_max_daily_seconds: int = Field(
        0, ge=0, description="Seconds that one tenant's jobs may run in a day (UTC), added up; 0: no limit."
    )

    max_files: int = Field(10_000, ge=1, description="Files in a dataset.")
    max_file_bytes: int = Field(2 * GIB, ge=1, description="Size of one file of a dataset.")
    max_dataset_bytes: int = Field(32 * GIB, ge=1, description="Size of all files of a dataset.")
    max_archive_bytes: int = Field(32 * GIB, ge=1, description="Size of an uploaded archive.")
    max_unpacked_bytes: int = Field(40 * GIB, ge=1, description="Size of all that comes out of an archive.")

    keep_results_days: float = Field(
        7.0, ge=0, description="Days to keep files of a finished job; 0: no limit."
    )
    keep_datasets_days: float = Field(
        7.0, ge=0, description="Days to keep a dataset after its last use; 0: no limit."
    )
    keep_records_days: float = Field(
        90.0, ge=0, description="Days to keep records of expired items and of deliveries; 0: no limit."
    )
    keep_keys_hours: float = Field(
        24.0, gt=0, description="Hours to remember an Idempotency-Key after its job has ended."
    )
    expiry_s: float = Field(30.0, gt=0, description="Seconds between two searches for expired items.")

    webhook_timeout_s: float = Field(10.0, gt=0, le=60, description="Seconds to deliver one webhook message.")
    webhook_retry_s: float = Field(
        5.0, gt=0, description="Seconds until a failed delivery is first repeated; then longer."
    )
    webhook_http: bool = Field(False, description="Accept webhook addresses with http, too.")
    webhook_ports: tuple[int, ...] = Field(
        (443,), description="Ports that webhook addresses may have; []: any port."
    )
    webhook_networks: tuple[Network, ...] = Field(
        (), description="Networks that are not public but may receive webhooks, for example 10.0.0.0/8."
    )
    webhook_give_up_days: float = Field(
        5.0, gt=0, description="Days without success until a failing webhook is disabled."
    )
    file_address_http: bool = Field(False, description="Fetch files from addresses with http, too.")
    file_address_ports: tuple[int, ...] = Field(
        (443,), description="Ports that addresses of files may have; []: any port."
    )
    file_address_networks: tuple[Network, ...] = Field(
        (), description="Networks that are not public but whose files users may have fetched and read."
    )
    max_webhooks: int = Field(20, ge=0, description="Webhooks of one tenant.")

    disk_reserve_bytes: int = Field(
        GIB,
        ge=0,
        description="Kept free on local disks: uploads are refused (507) and jobs wait before it is used.",
    )
    upload_expiry_s: float = Field(
        24 * 3600, gt=0, description="Seconds without data until an upload is abandoned."
    )

    job_command: tuple[str, ...] = Field(
        (sys.executable, "-m", "workers.run.job_process"),
        description="Program of a job; gets the job folder as its last argument.",
    )
    check_command: tuple[str, ...] = Field(
        (sys.executable, "-m", "workers.datasets.dataset_check_process"),
        description="Program that validates a dataset; gets the folder as its last argument.",
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """The sources, by priority: code, the environment, and files that the environment names."""
        return init_settings, env_settings, FileSettingsSource(settings_cls)

    @model_validator(mode="after")
    def _consistent(self) -> Settings:
        if self.stall_s < 2 * self.beat_s:
            raise ValueError(f"stall_s ({self.stall_s}) must be at least twice beat_s ({self.beat_s})")
        return self

    @property
    def scratch_dir(self) -> Path:
        """Local working copies of running jobs."""
        return self.data_dir / "scratch"

    @property
    def files_dir(self) -> Path:
        """Root of the file store if `storage_url` is None."""
        return self.data_dir / "files"

    @property
    def postgres_dir(self) -> Path:
        """Home of the private PostgreSQL."""
        return self.data_dir / "postgres"

    def require_database_url(self) -> str:
        """The database's address; raises `SetupError` if none is set."""
        if self.database_url is None:
            raise SetupError(
                "no_database",
                "BIRESNERF_DATABASE_URL is not set. Use `biresnerf up`, which starts a private PostgreSQL, "
                "or set it to postgresql://user:password@host/database.",
            )
        return self.database_url
