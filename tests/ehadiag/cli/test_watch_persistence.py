from ehadiag.cli.watch.persistence import NEEDED, OF, SPAN_S, Persistence


def raised(seconds: list[float]) -> list[float]:
    persistence = Persistence(1000.0)
    return [second for second in seconds if persistence.take(round(second * 1000.0))]


def test_a_burst_however_dense_is_no_change_that_lasts() -> None:
    assert raised([26.5 + 0.01 * count for count in range(340)]) == []


def test_alarms_that_come_again_and_again_are() -> None:
    assert raised([0.4, 2.0, 7.0, 12.0, 13.0]) == [12.0, 13.0]


def test_single_alarms_far_apart_are_not() -> None:
    apart = SPAN_S * OF / (NEEDED - 1)
    assert raised([count * apart for count in range(20)]) == []
