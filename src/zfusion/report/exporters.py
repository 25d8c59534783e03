"""Metrics for those who collect them: served to Prometheus, or pushed over OTLP. Needs the extra `metrics`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from importlib import import_module
from typing import Any

from zfusion.errors import InputError
from zfusion.report.metrics import Family, Histogram

URL = re.compile(r"https?://([^\s/@]*@)?(\[[0-9A-Fa-f:.]+\]|[^\s/:?#\[\]]+)(:\d{1,5})?([/?][^\s]*)?")

LAST_PUSH_S = 2.0
"""How long the last push may take: where nobody takes it, it would be tried again for ten seconds."""

Look = Callable[[], Iterable[Family]]
"""Gives the metrics as they are now; called from other threads, never from two at once."""


def serve(look: Look, host: str, port: int) -> tuple[int, Callable[[], None]]:
    """Serve the metrics to Prometheus at ``http://host:port/metrics``; gives the port (for 0 a free one) and its end.

    InputError where the extra is not installed, or where there is no such address to listen on.
    """
    prometheus = _needs("prometheus_client", "prometheus_client")
    registry = prometheus.CollectorRegistry()
    registry.register(_Collector(look))
    try:
        server, thread = prometheus.start_http_server(port, host, registry)
    except OSError as error:
        raise InputError(f"--port: cannot listen on {host}:{port}: {error.strerror}") from None

    def end() -> None:
        server.shutdown()
        server.server_close()
        thread.join()

    return server.server_port, end


def push(families: Callable[[], Iterable[Family]], endpoint: str, interval_s: float) -> Callable[[], None]:
    """Push the metrics, but for histograms, to an OTLP collector (HTTP) every so often; gives what ends that.

    InputError where the extra is not installed, or the endpoint is no URL.
    """
    if not URL.fullmatch(endpoint):
        raise InputError(f"--otlp: expected a URL like http://collector:4318/v1/metrics (is {endpoint!r})")
    sdk = _needs("opentelemetry.sdk.metrics", "opentelemetry-sdk")
    export = _needs("opentelemetry.sdk.metrics.export", "opentelemetry-sdk")
    otlp = _needs("opentelemetry.exporter.otlp.proto.http.metric_exporter", "opentelemetry-exporter-otlp-proto-http")
    exporter = otlp.OTLPMetricExporter(endpoint=endpoint)
    reader = export.PeriodicExportingMetricReader(exporter, export_interval_millis=1000 * interval_s)
    provider = sdk.MeterProvider([reader])
    meter = provider.get_meter("zfusion")
    for family in families():
        if family.kind != "histogram":
            declare = meter.create_observable_counter if family.kind == "counter" else meter.create_observable_gauge
            name = family.name.removesuffix("_total")
            declare(name, [partial(_observe, families, family.name)], description=family.help)
    return partial(provider.shutdown, timeout_millis=1000 * LAST_PUSH_S)


def _observe(families: Callable[[], Iterable[Family]], name: str, _options: Any) -> Iterator[Any]:
    observation = _needs("opentelemetry.metrics", "opentelemetry-sdk").Observation
    for family in families():
        if family.name == name:
            for values, value in family.samples.items():
                yield observation(value, dict(zip(family.labels, values, strict=True)))


class _Collector:
    """What Prometheus' client asks at every scrape."""

    def __init__(self, look: Look) -> None:
        self._look = look

    def collect(self) -> Iterator[Any]:
        """The metrics as its own objects."""
        core = _needs("prometheus_client.core", "prometheus_client")
        kinds = {
            "counter": core.CounterMetricFamily,
            "gauge": core.GaugeMetricFamily,
            "histogram": core.HistogramMetricFamily,
        }
        for family in self._look():
            metric = kinds[family.kind](family.name.removesuffix("_total"), family.help, labels=family.labels)
            for values, value in family.samples.items():
                if isinstance(value, Histogram):
                    metric.add_metric(values, [(_bound(le), n) for le, n in value.buckets], sum_value=value.total_s)
                else:
                    metric.add_metric(values, value)
            yield metric


def _bound(seconds: float) -> str:
    return "+Inf" if math.isinf(seconds) else f"{seconds:g}"


def _needs(module: str, package: str) -> Any:
    """The module; InputError, naming the extra, where it is not installed."""

    try:
        return import_module(module)
    except ImportError:
        raise InputError(f"metrics need {package}: pip install 'zfusion[metrics]'") from None
