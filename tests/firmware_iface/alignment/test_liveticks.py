"""Live assembly of ticks: each once, in order, whatever the bus loses, repeats or swaps."""

import math
import sys
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from ehadiag import CommandMode, ConfigurationError
from firmware_iface.bus_map import default_map, load_map
from firmware_iface.codec import Encoder
from firmware_iface.live_decode import LiveTick, LiveTicks
from firmware_iface.recording import CHANNELS

MAP = default_map()
TELEMETRY = MAP.messages["ServoTelemetry"].can_id
MS = 1_000_000


@lru_cache(maxsize=1)
def encoder_for():
    return Encoder(MAP)


@lru_cache
def frames_of(ticks, mode=CommandMode.POSITION):
    """Command and telemetry of each tick; the codes and the command tell the tick."""
    encoder, out = encoder_for(), []
    for k in range(ticks):
        (command,) = encoder.command(mode, 2e-6 * k, 0, k * MS, k % 256)
        (telemetry,) = encoder.telemetry([1000 + k] * 4, k * MS, k % 256)
        out.append((command, telemetry))
    return out


@lru_cache(maxsize=1000)
def expected(k):
    seen = (float(channel.decode(np.array([1000 + k]))[0]) for channel in CHANNELS)
    return LiveTick(2e-6 * k, *seen)


def run(frames, **options):
    live = LiveTicks(MAP, **options)
    return live, [tick for frame in frames for tick in live.take(frame)]


def flat(pairs):
    return [frame for pair in pairs for frame in pair]


def test_every_tick_once_as_sent():
    live, ticks = run(flat(frames_of(600)))
    np.testing.assert_allclose(ticks, [expected(k) for k in range(600)], rtol=1e-12, atol=1e-15)
    assert (live.lost, live.breaks) == (0, 0)


def test_telemetry_may_come_before_its_command():
    _, ticks = run([frame for pair in frames_of(300) for frame in pair[::-1]])
    np.testing.assert_allclose(ticks, [expected(k) for k in range(300)], rtol=1e-12, atol=1e-15)


@settings(max_examples=30)
@given(st.sets(st.integers(1, 398)), st.sets(st.integers(1, 398)))
def test_what_is_lost_is_nan_and_nothing_else(no_command, no_telemetry):
    """Gaps up to what the counter tells: it turns after 256."""
    frames = [
        frame
        for k, pair in enumerate(frames_of(400))
        for frame, gone in zip(pair, (no_command, no_telemetry), strict=True)
        if k not in gone
    ]
    live, ticks = run(frames)
    assert live.lost == len(no_telemetry)
    assert len(ticks) == 400
    for k, tick in enumerate(ticks):
        want = expected(k)
        assert (
            math.isnan(tick.command)
            if k in no_command
            else math.isclose(tick.command, want.command)
        )
        if k in no_telemetry:
            assert all(map(math.isnan, tick[1:]))
        else:
            assert all(map(math.isclose, tick[1:], want[1:]))


def test_repeated_and_late_frames_count_once():
    pairs = frames_of(50)
    frames = flat(pairs)
    repeated = [frame for frame in frames for _ in range(2)]
    late = [*flat(pairs[:20]), *flat(pairs[21:24]), *pairs[20], *flat(pairs[24:])]
    assert run(repeated)[1] == run(frames)[1]
    live, ticks = run(late)
    assert len(ticks) == 50
    assert live.lost == 1
    assert np.isnan(ticks[20]).all()
    assert ticks[21:] == run(frames)[1][21:]


def test_damaged_frames_are_lost_ones():
    pairs = frames_of(30)
    _, bad = pairs[10]
    data = bytes([bad.data[0] ^ 1]) + bad.data[1:]
    frames = flat(pairs)
    frames[21] = replace(bad, data=data)
    live, ticks = run(frames)
    assert live.lost == 1
    assert np.isnan(ticks[10][1:]).all()
    assert ticks[11] == run(flat(pairs))[1][11]


def test_a_value_at_its_converters_end_is_nan():
    encoder = encoder_for()
    frames = [*encoder.command(CommandMode.POSITION, 0.0, 0, 0)]
    frames += encoder.telemetry([0, 4095, 2000, 1], 0)
    _, (tick,) = run(frames)
    assert [math.isnan(value) for value in tick] == [False, True, True, False, False]


def test_commands_of_the_other_mode_are_not_taken():
    _, ticks = run(flat(frames_of(10, CommandMode.CURRENT)))
    assert len(ticks) == 9  # the last one still waits for its command
    assert np.isnan([tick.command for tick in ticks]).all()
    _, ticks = run(flat(frames_of(10, CommandMode.CURRENT)), mode=CommandMode.CURRENT)
    assert [tick.command for tick in ticks] == pytest.approx([2e-6 * k for k in range(10)])


def test_after_a_long_silence_ticks_begin_anew():
    pairs = frames_of(20)
    later = [replace(frame, time_ns=frame.time_ns + 2000 * MS) for frame in flat(pairs[15:])]
    live, ticks = run([*flat(pairs[:10]), *later])
    assert (len(ticks), live.lost, live.breaks) == (15, 0, 1)


PAGED = """VERSION ""
BU_: A
BO_ 640 Servo: 8 A
 SG_ Page M : 0|4@1+ (1,0) [0|15] "" A
 SG_ Current {page}: 4|8@1+ (0.1,-12) [0|0] "mA" A
 SG_ Spool m0 : 12|8@1+ (0.004,-0.5) [0|0] "mm" A
 SG_ Pressure m0 : 20|8@1+ (0.1,-10) [0|0] "MPa" A
 SG_ Jack m0 : 28|8@1+ (0.1,-10) [0|0] "mm" A
 SG_ Oil m1 : 28|8@1+ (1,0) [0|0] "degC" A
 SG_ Count {count}: 36|{width}@1+ (1,0) [0|0] "" A
BO_ 641 Command: 8 A
 SG_ Wanted : 0|16@1- (0.001,0) [0|0] "mA" A
 SG_ Count : 32|{width}@1+ (1,0) [0|0] "" A
"""
PAGED_MAP = """schema = "ehadiag.mapping/1"
dbc = "paged.dbc"
channels.current = { message = "Servo", signal = "Current" }
channels.spool = { message = "Servo", signal = "Spool" }
channels.pressure = { message = "Servo", signal = "Pressure" }
channels.position = { message = "Servo", signal = "Jack" }
command.current = { message = "Command", signal = "Wanted" }
environment.oil_temperature = { message = "Servo", signal = "Oil" }
protection.Servo = { counter = "Count", counts = "ticks" }
protection.Command = { counter = "Count", counts = "ticks" }
"""


@pytest.fixture
def paged(tmp_path):
    """Make a bus whose telemetry is one page of two, with counters of some bits."""

    def make(width=8, page="m0", count="", tick_ms=1.0):
        text = PAGED.format(width=width, page=page, count=count)
        (tmp_path / "paged.dbc").write_text(text)
        (tmp_path / "paged.toml").write_text(PAGED_MAP.replace("\n", f"\ntick_ms = {tick_ms}\n", 1))
        return load_map(tmp_path / "paged.toml")

    return make


def paged_ticks(bus, counts, times=None):
    live = LiveTicks(bus, CommandMode.CURRENT)
    encoder, out = Encoder(bus), []
    for k, count in enumerate(counts):
        now = k * MS if times is None else times[k]
        frames = encoder.command(CommandMode.CURRENT, 1e-6 * k, 0, now, count)
        frames += encoder.environment(0.0, 0.0, 40.0, now)
        frames += encoder.telemetry([2048 + 16 * k] * 4, now, count)
        out += [tick for frame in frames for tick in live.take(frame)]
    return live, out


def test_other_pages_of_the_telemetry_are_no_telemetry(paged):
    live, ticks = paged_ticks(paged(count="m0 "), range(50))
    assert (len(ticks), live.lost) == (50, 0)
    assert [tick.command for tick in ticks] == pytest.approx([1e-6 * k for k in range(50)])
    spool = [CHANNELS[1].decode(2048 + 16 * k) for k in range(50)]
    assert [tick.spool for tick in ticks] == pytest.approx(spool, abs=2.001e-6)


def test_a_wide_counter_costs_no_memory_and_its_jump_makes_few_ticks(paged):
    live, ticks = paged_ticks(paged(width=28), [*range(5), (1 << 27) + 1000, *range(5, 10)])
    assert live.lost == len(ticks) - 11
    assert live.lost < 8192
    assert sys.getsizeof(live._commands) < 1 << 20


@pytest.mark.parametrize("tick_ms", [0.05, 0.1, 0.25, 1.0, 25.0, 250.0])
def test_a_pause_that_is_no_silence_keeps_its_ticks(paged, tick_ms):
    """The silence counts after a second: until then the counter has to tell, at any rate."""
    bus = paged(width=16, tick_ms=tick_ms)
    pause = int(990 / tick_ms)
    counts = [*range(65530, 65540), *range(65540 + pause, 65550 + pause)]
    times = [round(count * tick_ms * MS) for count in counts]
    live, ticks = paged_ticks(bus, [count % 65536 for count in counts], times)
    assert (len(ticks), live.lost, live.breaks) == (20 + pause, pause, 0)
    assert np.isnan([tick.spool for tick in ticks[10:-10]]).all()
    assert np.isfinite([tick.spool for tick in ticks[-10:]]).all()
    assert sys.getsizeof(live._commands) <= 1 << 20


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"page": "m1"}, "one frame must bring channels.current, channels.spool"),
        ({"page": ""}, "one frame must bring channels.current, channels.spool"),
        ({"count": "m1 "}, "Servo needs a counter of ticks beyond 32 in the same frame"),
        ({"width": 5}, "Servo needs a counter of ticks beyond 32"),
    ],
)
def test_ticks_that_no_single_frame_tells_are_refused(paged, change, match):
    with pytest.raises(ConfigurationError, match=match):
        LiveTicks(paged(**change), CommandMode.CURRENT)


def test_a_bus_without_counters_is_told():
    plain = {
        name: replace(item, counter=None, counts_ticks=False) for name, item in MAP.messages.items()
    }
    with pytest.raises(ConfigurationError, match="counter of ticks") as caught:
        LiveTicks(replace(MAP, messages=plain))
    assert "\n" not in str(caught.value)


def test_both_modes_are_followed_where_none_is_named():
    """Each tick with the command of the mode that the computer names; a tick whose is lost, none.

    The other mode's commands would count as lost to a reader of one mode.
    """
    encoder, live = Encoder(), LiveTicks(mode=None)
    seen = []
    for mode, command in (
        (CommandMode.POSITION, 1e-3),
        (CommandMode.CURRENT, 2e-3),
        (CommandMode.CURRENT, -2e-3),
        (CommandMode.POSITION, 4e-3),
    ):
        for frame in encoder.command(mode, command, 0, 0) + encoder.telemetry([2048] * 4, 0):
            seen += [(live.mode, tick.command) for tick in live.take(frame)]
    assert [mode for mode, _ in seen] == [
        CommandMode.POSITION,
        CommandMode.CURRENT,
        CommandMode.CURRENT,
        CommandMode.POSITION,
    ]
    assert [command for _, command in seen] == pytest.approx([1e-3, 2e-3, -2e-3, 4e-3])
