import threading

from ehadiag.live.publisher import Publisher
from ehadiag.live.snapshot import Bus, Snapshot


def look(number: int) -> Snapshot:
    return Snapshot(
        number=number,
        time="2026-03-01T12:00:00.000Z",
        command="bit",
        actuator="left",
        serial=None,
        bus=Bus(name="virtual", state="open"),
    )


def numbers(publisher: Publisher, out: list[int]) -> None:
    seen = 0
    while (snapshot := publisher.wait(seen, 10.0)) is not None:
        seen = snapshot.number
        out.append(seen)


def test_several_readers_see_ever_newer_snapshots_and_the_last_one() -> None:
    publisher = Publisher(look, period_s=0.001)
    heard: list[list[int]] = [[], [], []]
    readers = [threading.Thread(target=numbers, args=(publisher, out)) for out in heard]
    with publisher:
        for reader in readers:
            reader.start()
        publisher.wait(20, 10.0)
    for reader in readers:
        reader.join(10.0)
        assert not reader.is_alive()
    last = publisher.latest
    assert last is not None
    for out in heard:
        assert out == sorted(set(out))
        assert out[-1] == last.number


def test_nothing_comes_after_the_last() -> None:
    publisher = Publisher(look, period_s=60.0)
    assert publisher.latest is None
    with publisher:
        pass
    assert publisher.ended
    last = publisher.latest
    assert last is not None
    publisher.refresh()
    publisher.close()
    assert publisher.latest is last
    assert publisher.wait(last.number, 10.0) is None


def test_a_reader_waits_no_longer_than_it_said() -> None:
    assert Publisher(look).wait(0, 0.0) is None


def test_what_happens_can_be_shown_at_once() -> None:
    with Publisher(look, period_s=60.0) as publisher:
        publisher.refresh()
        first = publisher.latest
        assert first is not None
        assert first.number == 1
