"""A caller may ask at its rate and in bursts, and never costs another caller anything."""

import pytest

from l3ps_api.limits import Buckets, too_many


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_a_burst_passes_and_what_comes_after_it_waits_for_the_rate(clock):
    buckets = Buckets(rate=10, burst=3, clock=clock)
    assert [buckets.take("a") for _ in range(3)] == [0, 0, 0]
    assert buckets.take("a") == pytest.approx(0.1)
    clock.now += 0.1
    assert buckets.take("a") == 0
    assert buckets.take("a") > 0


def test_a_refused_request_costs_nothing(clock):
    buckets = Buckets(rate=1, burst=1, clock=clock)
    buckets.take("a")
    waits = [buckets.take("a") for _ in range(50)]
    assert waits == [1.0] * 50


def test_two_hundred_callers_under_one_key_at_one_a_second_never_wait(clock):
    buckets = Buckets(rate=1000, burst=2000, clock=clock)
    for _ in range(60):
        assert not any(buckets.take("key") for _ in range(200))
        clock.now += 1


def test_callers_do_not_share_a_bucket_and_the_memory_of_them_is_bounded(clock):
    buckets = Buckets(rate=1, burst=1, clock=clock, size=10)
    for number in range(100):
        assert buckets.take(f"address {number}") == 0
    assert buckets.take("address 99") > 0, "the latest are remembered"
    assert buckets.take("address 0") == 0


def test_the_answer_says_when_to_come_back_in_whole_seconds():
    problem = too_many(0.01, "this key asks too often")
    assert problem.status == 429 and problem.headers == {"Retry-After": "1"}
