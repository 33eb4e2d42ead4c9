"""`/metrics` for Prometheus: made from rig and catalogue when asked."""

from collections.abc import Iterator

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from service.http.context import Context, Here
from service.rig import ScanKind

router = APIRouter(tags=["rig"])


class _Collector:
    def __init__(self, here: Context) -> None:
        self._here = here

    def collect(self) -> Iterator[Metric]:
        ready = GaugeMetricFamily("canopy_part_ready", "1 = can be used", labels=["part"])
        for part in self._here.rig.parts():
            ready.add_metric([part.name], float(part.ready))
        yield ready
        for name, kind in (("scans", ScanKind.SCAN), ("replays", ScanKind.REPLAY)):
            text = f"{name.capitalize()} by state"
            by_state = GaugeMetricFamily(f"canopy_{name}", text, labels=["state"])
            for state, count in self._here.scans.catalogue.count_scans(kind).items():
                by_state.add_metric([state], count)
            yield by_state
        events = CounterMetricFamily("canopy_events", "Events of scans by kind", labels=["kind"])
        for event, count in self._here.scans.catalogue.count_events().items():
            events.add_metric([event], count)
        yield events


@router.get("/metrics", response_class=Response)
def metrics(here: Here) -> Response:
    """Return what can be counted: parts that are ready, scans by state, events by kind."""
    registry = CollectorRegistry()
    registry.register(_Collector(here))
    return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)
