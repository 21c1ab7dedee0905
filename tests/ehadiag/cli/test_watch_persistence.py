from ehadiag.cli.watch.persistence import INSTANT_S, NEEDED, OF, SPAN_S, Persistence


def raised(seconds: list[float]) -> list[float]:
    persistence = Persistence(1000.0)
    return [second for second in seconds if persistence.take(round(second * 1000.0))]


def test_a_burst_however_dense_is_no_change_that_lasts() -> None:
    assert raised([26.5 + 0.01 * count for count in range(340)]) == []


def test_alarms_that_come_again_and_again_are() -> None:
    twice = [start + more for start in (0.4, 7.0, 12.0, 26.0, 29.7) for more in (0.0, 0.2)]
    assert raised(twice) == [26.2, 29.7, 29.9]


def test_single_alarms_in_every_span_are_not() -> None:
    assert raised([count * SPAN_S for count in range(20)]) == []


def test_alarms_at_the_same_instant_are_one() -> None:
    """Two a span, that far apart, are two; nearer ones are not."""
    for apart, lasting in ((INSTANT_S, True), (INSTANT_S / 2.0, False)):
        times = [count * SPAN_S + more for count in range(9) for more in (0.0, apart)]
        assert bool(raised(times)) is lasting


def test_alarms_far_apart_are_not() -> None:
    apart = SPAN_S * OF / (NEEDED - 1)
    assert raised([count * apart + more for count in range(20) for more in (0.0, 1.0)]) == []
