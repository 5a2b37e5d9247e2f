"""Optional OpenTelemetry traces: a request, the jobs that it submits, their attempts and stages.

Without ``BIRESNERF_TRACES=otlp``, OpenTelemetry's SDK is not set up and its API does nothing. OpenTelemetry's own
variables (``OTEL_EXPORTER_OTLP_ENDPOINT`` …) decide where the spans go.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from opentelemetry import context, trace
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from workers.settings.errors import SetupError
from workers.settings.settings import Settings

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

_NAME = "biresnerf"
_FLUSH_MS = 3000
TRACER = trace.get_tracer(_NAME)
_provider: TracerProvider | None = None


def set_up_traces(process: str, settings: Settings) -> None:
    """Make this process record spans, if so configured; raises `SetupError`."""
    global _provider
    if settings.traces == "off":
        return
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        raise SetupError(
            "traces_not_installed",
            f"BIRESNERF_TRACES={settings.traces} needs what is missing here ({error}): "
            "pip install 'biresnerf[service,otel]'.",
        ) from None
    _provider = TracerProvider(resource=Resource.create({"service.name": _NAME, "process.role": process}))
    _provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    trace.set_tracer_provider(_provider)


def flush_traces() -> None:
    """Sends recorded spans, or gives up within seconds; call it before a signal ends the process."""
    if _provider is not None:
        _provider.force_flush(_FLUSH_MS)


@contextlib.contextmanager
def span(name: str, *, parent: str | None, about: Mapping[str, str | int]) -> Iterator[None]:
    """A span around the block, below ``parent`` (a W3C traceparent)."""
    above = TraceContextTextMapPropagator().extract({"traceparent": parent}) if parent else None
    attributes = {f"{_NAME}.{key}": value for key, value in about.items()}
    with TRACER.start_as_current_span(name, context=above, attributes=attributes):
        yield


def traceparent() -> str | None:
    """The current span as a W3C traceparent, for another process to continue; None without traces."""
    carrier: dict[str, str] = {}
    TraceContextTextMapPropagator().inject(carrier)
    return carrier.get("traceparent")


class StageSpans:
    """One span per stage of an attempt, below the span that is current when this is made."""

    def __init__(self) -> None:
        self._open: trace.Span | None = None
        self._above = context.get_current()

    def enter(self, stage: str) -> None:
        """End the previous stage, if any, and begin this one."""
        self.end()
        self._open = TRACER.start_span(f"stage {stage}", context=self._above)

    def end(self) -> None:
        """End the current stage."""
        if self._open is not None:
            self._open.end()
            self._open = None
