"""OpenTelemetry traces, if the operator wants them: a request, what it submits, each attempt and its stages.

Without ``BIRESNERF_TRACES=otlp`` nothing of OpenTelemetry is set up, and everything here does nothing. Where
the spans go is said by OpenTelemetry's own variables (``OTEL_EXPORTER_OTLP_ENDPOINT`` …).
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Awaitable, Callable, Coroutine, Iterator, Mapping
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from workers.settings.errors import SetupError
from workers.settings.settings import Settings

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.trace import Span

P = ParamSpec("P")
T = TypeVar("T")
_NAME = "biresnerf"
_FLUSH_MS = 3000
_provider: TracerProvider | None = None


def set_up_traces(process: str, settings: Settings) -> None:
    """From now on this process records spans, if the settings ask for it; raises `SetupError`."""
    global _provider
    if settings.traces == "off":
        return
    try:
        from opentelemetry import trace
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
    """Sends what is recorded, or gives up within seconds; for ends by a signal, where nothing else would."""
    if _provider is not None:
        _provider.force_flush(_FLUSH_MS)


@contextlib.contextmanager
def span(
    name: str, *, parent: str | None = None, about: Mapping[str, str | int] | None = None
) -> Iterator[None]:
    """A span around the block, below the current one, or below ``parent`` (a W3C traceparent)."""
    if _provider is None:
        yield
        return
    attributes = {f"{_NAME}.{key}": value for key, value in (about or {}).items()}
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    above = TraceContextTextMapPropagator().extract({"traceparent": parent}) if parent else None
    tracer = _provider.get_tracer(_NAME)
    with tracer.start_as_current_span(name, context=above, attributes=attributes):
        yield


def traced(name: str) -> Callable[[Callable[P, Awaitable[T]]], Callable[P, Coroutine[Any, Any, T]]]:
    """Makes each call of a coroutine function a span of its own."""

    def decorate(work: Callable[P, Awaitable[T]]) -> Callable[P, Coroutine[Any, Any, T]]:
        @functools.wraps(work)
        async def within(*given: P.args, **named: P.kwargs) -> T:
            with span(name):
                return await work(*given, **named)

        return within

    return decorate


def traceparent() -> str | None:
    """The current span as W3C has it, to go on from in another process; none without traces."""
    if _provider is None:
        return None
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    carrier: dict[str, str] = {}
    TraceContextTextMapPropagator().inject(carrier)
    return carrier.get("traceparent")


class StageSpans:
    """One span per stage of an attempt, below the span that is current when this is made."""

    def __init__(self) -> None:
        self._open: Span | None = None
        self._above = None
        if _provider is not None:
            from opentelemetry import context

            self._above = context.get_current()

    def enter(self, stage: str) -> None:
        """The stage before, if any, ends; this one begins."""
        self.end()
        if _provider is not None:
            self._open = _provider.get_tracer(_NAME).start_span(f"stage {stage}", context=self._above)

    def end(self) -> None:
        """No stage is running any more."""
        if self._open is not None:
            self._open.end()
            self._open = None
