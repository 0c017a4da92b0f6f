"""The stage clock: under which names launches are filed."""

import pytest

from raystream.statistics import StageClock


class Event:
    """A launch that was queued, started and ended at these nanoseconds."""

    def __init__(self, queued, start, end):
        self.profile = self
        self.queued, self.start, self.end = queued, start, end


def test_seconds_by_stage():
    clock = StageClock()
    clock.record("a", Event(0, 10, 30))
    clock.record("b", Event(1, 35, 40))
    clock.record("a", Event(2, 40, 50))
    stages = clock.take()
    assert stages["a"] == {"wall": pytest.approx(40e-9), "device": pytest.approx(30e-9)}
    assert stages["b"] == {"wall": pytest.approx(10e-9), "device": pytest.approx(5e-9)}
    assert clock.take() == {}


def recorded(clock, stage):
    """The stage under which the clock files a launch of `stage`."""
    clock.record(stage, Event(0, 1, 2))
    return list(clock.take())


def test_under_another_stage():
    clock = StageClock()
    with clock.under("user"):
        assert recorded(clock, "primitive") == ["user"]
        with clock.under("inner"):
            assert recorded(clock, "primitive") == ["inner"]
        assert recorded(clock, "primitive") == ["user"]
    assert recorded(clock, "primitive") == ["primitive"]


def test_under_ends_with_an_error():
    clock = StageClock()
    with pytest.raises(KeyError), clock.under("user"):
        raise KeyError
    assert recorded(clock, "primitive") == ["primitive"]
