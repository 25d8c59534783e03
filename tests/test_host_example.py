import importlib.util
from pathlib import Path

import pytest

from zfusion.drivers.sources import open_sources
from zfusion.model.scenario import load_scenario

EXAMPLES = Path(__file__).parent.parent / "examples"

pytestmark = pytest.mark.skipif(not Path("/proc/stat").exists(), reason="the sensors of this example need Linux")


@pytest.fixture
def sensors(monkeypatch):
    """The example's module, fresh, on a clock that is a list of times."""
    spec = importlib.util.spec_from_file_location("host_sensors", EXAMPLES / "host_sensors.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "CPUS", 2)
    return module


def told(sensors, monkeypatch, function, *contents, seconds=2.0, **options) -> list:
    """What a sensor reads when its file has these contents, one after the other."""
    readings = []
    for n, content in enumerate(contents):
        monkeypatch.setattr(sensors, "lines", lambda _, content=content: [line.split() for line in content.split("\n")])
        monkeypatch.setattr(sensors.time, "monotonic", lambda n=n: 100 + seconds * n)
        readings.append(function(n + 1, 0, "x", **options))
    return readings


def test_the_scenario_has_six_sensors_that_read_this_machine():
    scenario = load_scenario(EXAMPLES / "host.toml")
    sources = open_sources(scenario, scenario.ids)
    assert len(sources) == 6
    for step in range(1, 4):
        for node, source in sources.items():
            y = source.read(step, 0)
            assert y is None or (y.shape == (1,) and 0 <= y[0] <= 1), node
    assert not any(source.counters for source in sources.values())


def test_busy_is_the_time_that_was_not_idle(sensors, monkeypatch):
    after = "cpu 30 0 10 50 5 0 5 0 99 99"
    assert told(sensors, monkeypatch, sensors.busy, "cpu 0 0 0 0 0 0 0 0 0 0", after) == [None, pytest.approx(0.45)]


def test_queue_undoes_the_smoothing_of_the_load_average(sensors, monkeypatch):
    decay = sensors.LOAD_DECAY
    load = [0.5, 0.5 * decay + 1 * (1 - decay)]
    contents = [f"{load[0]} 0 0 1/100 1", f"{load[0]} 0 0 1/100 1", f"{load[1]} 0 0 1/100 1"]
    assert told(sensors, monkeypatch, sensors.queue, *contents) == [None, None, pytest.approx(1 / 2)]


def test_pressure_is_a_share_of_time(sensors, monkeypatch):
    contents = [f"some avg10=0.00 total={us}\nfull avg10=0.00 total=7" for us in (0, 500_000)]
    assert told(sensors, monkeypatch, sensors.pressure, *contents) == [None, pytest.approx(0.25)]


def test_rates_without_a_limit_saturate(sensors, monkeypatch):
    contents = [f"ctxt {n}" for n in (0, 800)]
    assert told(sensors, monkeypatch, sensors.switches, *contents, half=200.0) == [None, pytest.approx(0.5)]
    interface = "h\nh\nlo: {0} 0 0 0 0 0 0 0 {0}\neth0: {0} 0 0 0 0 0 0 0 {0}"
    sensors.rates = sensors.Rates()
    contents = [interface.format(n) for n in (0, 300)]
    assert told(sensors, monkeypatch, sensors.network, *contents, half=100.0) == [None, pytest.approx(0.75)]


def test_the_busiest_disk_counts(sensors, monkeypatch):
    contents = [f"8 0 a 0 0 0 0 0 0 0 0 0 {a}\n8 1 b 0 0 0 0 0 0 0 0 0 {b}" for a, b in ((5, 9), (205, 1009))]
    assert told(sensors, monkeypatch, sensors.disk, *contents) == [None, pytest.approx(0.5)]


def test_what_the_machine_does_not_have_is_no_reading(sensors, monkeypatch):
    monkeypatch.setattr(sensors, "lines", lambda _: [])
    functions = [sensors.queue, sensors.pressure, sensors.network, sensors.disk, sensors.switches]
    options = [{}, {}, {"half": 1.0}, {}, {"half": 1.0}]
    for function, chosen in zip(functions, options, strict=True):
        assert [function(step, 0, "x", **chosen) for step in (1, 2)] == [None, None]
