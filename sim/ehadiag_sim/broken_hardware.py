"""Named kinds of broken hardware, besides the three progressive faults.

A diagnosis must not take any of them for a healthy actuator, nor for one of the three faults.
Seeded: the same generator gives the same sizes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from ehadiag.core.actuator import Actuator
from ehadiag_sim import sensing
from ehadiag_sim.conditions import Effects, Faults, Sensors
from ehadiag_sim.plant_dynamics import DEFAULT_STEP_S
from ehadiag_sim.sensing import ChannelFault
from ehadiag_sim.simulation import simulate
from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import CHANNELS, Recording
from firmware_iface.stored_test import StoredTest


@dataclass(frozen=True, slots=True)
class Hardware:
    """One actuator with its effects and sensors, and what strikes its readings."""

    actuator: Actuator
    effects: Effects
    sensors: Sensors
    channel_faults: tuple[ChannelFault, ...] = ()


@dataclass(frozen=True, slots=True)
class HardwareFault:
    """One kind of damage."""

    what: str
    """What is broken, for people."""
    strike: Callable[[Hardware, np.random.Generator], Hardware]
    hidden: bool = False
    """The sensors need not show it: a diagnosis may say what the three faults are all the same."""


def break_hardware(kind: str, rng: np.random.Generator, whole: Hardware) -> Hardware:
    """Break hardware in one of the ways of `HARDWARE_FAULTS`; sizes are drawn from `rng`.

    An unknown kind raises ConfigurationError.
    """
    if kind not in HARDWARE_FAULTS:
        raise ConfigurationError(
            f"broken hardware {kind!r}: not one of {', '.join(HARDWARE_FAULTS)}"
        )
    return HARDWARE_FAULTS[kind].strike(whole, rng)


def simulate_broken(
    kind: str,
    rng: np.random.Generator,
    actuator: Actuator,
    test: StoredTest,
    faults: Faults | None = None,
    *,
    step: float = DEFAULT_STEP_S,
) -> Recording:
    """Record a stored test of broken hardware, without losses on the bus.

    rng: sizes of the damage and seed of the noise; step: longest integration step, s. An unknown
    kind or a value out of range raises ConfigurationError.
    """
    whole = Hardware(actuator, Effects(), Sensors())
    item = break_hardware(kind, rng, whole)
    done = simulate(
        item.actuator,
        test,
        faults,
        item.effects,
        item.sensors,
        seed=int(rng.integers(1 << 31)),
        step=step,
        channel_faults=item.channel_faults,
    )
    return done.recording(f"simulated, {kind}")


HardwareChange = Callable[[Hardware, np.random.Generator], Hardware]


def _reads(make: Callable[[np.random.Generator], ChannelFault]) -> HardwareChange:
    def strike(item: Hardware, rng: np.random.Generator) -> Hardware:
        return replace(item, channel_faults=(*item.channel_faults, make(rng)))

    return strike


def _valve(**factors: tuple[float, float]) -> HardwareChange:
    return _data("servovalve", factors)


def _jack(**factors: tuple[float, float]) -> HardwareChange:
    return _data("jack", factors)


def _data(part: str, factors: Mapping[str, tuple[float, float]]) -> HardwareChange:
    """Scale data of the actuator, each by a factor between two (evenly in the logarithm)."""

    def strike(item: Hardware, rng: np.random.Generator) -> Hardware:
        old = getattr(item.actuator, part)
        scaled = {
            name: getattr(old, name) * float(np.exp(rng.uniform(np.log(low), np.log(high))))
            for name, (low, high) in factors.items()
        }
        new = msgspec.structs.replace(old, **scaled)
        actuator = msgspec.structs.replace(item.actuator, **{part: new})
        return replace(item, actuator=actuator)

    return strike


def _foamed(item: Hardware, rng: np.random.Generator) -> Hardware:
    stage = msgspec.structs.replace(
        item.actuator.second_stage, kind="orifice", beta=float(rng.uniform(2e7, 1.5e8))
    )
    return replace(item, actuator=msgspec.structs.replace(item.actuator, second_stage=stage))


def _clogged_nozzle(item: Hardware, rng: np.random.Generator) -> Hardware:
    bias = _either(rng, 0.2, 0.45) * item.actuator.controller.IM
    return replace(item, effects=replace(item.effects, null_bias=bias))


def _worn_ball(item: Hardware, rng: np.random.Generator) -> Hardware:
    return replace(item, effects=replace(item.effects, backlash=float(rng.uniform(3e-5, 1e-4))))


def _reversed_coil(item: Hardware, _rng: np.random.Generator) -> Hardware:
    return replace(item, effects=replace(item.effects, gain_change=-2.0))


def _starved(item: Hardware, rng: np.random.Generator) -> Hardware:
    """The supply has collapsed, its probe has not noticed."""
    drop = (item.effects.supply_pressure - item.effects.return_pressure) * rng.uniform(0.5, 0.9)
    return _supply(item, -float(drop))


def _weak_supply(item: Hardware, rng: np.random.Generator) -> Hardware:
    drop = (item.effects.supply_pressure - item.effects.return_pressure) * rng.uniform(0.03, 0.1)
    return _supply(item, -float(drop))


def _supply(item: Hardware, change: float) -> Hardware:
    return replace(
        item,
        effects=replace(item.effects, supply_pressure=item.effects.supply_pressure + change),
        sensors=replace(item.sensors, supply_error=item.sensors.supply_error - change),
    )


def _blind_probe(item: Hardware, rng: np.random.Generator) -> Hardware:
    """The oil is cold, the probe says that it is not."""
    cold = float(rng.uniform(30.0, 50.0))
    return replace(
        item,
        effects=replace(item.effects, oil_temperature=item.effects.oil_temperature - cold),
        sensors=replace(item.sensors, temperature_error=item.sensors.temperature_error + cold),
    )


def _either(rng: np.random.Generator, low: float, high: float) -> float:
    """Size from `low` to `high`, of either sign."""
    return float(rng.uniform(low, high) * rng.choice((-1.0, 1.0)))


def _of_channel(index: int) -> dict[str, HardwareFault]:
    """Return what may befall one channel."""
    name = CHANNELS[index].name

    def scaled(rng: np.random.Generator) -> ChannelFault:
        low = rng.random() < 0.5
        return sensing.ScaledSensor(
            index, float(rng.uniform(0.5, 0.8) if low else rng.uniform(1.2, 1.5))
        )

    def loose(rng: np.random.Generator) -> ChannelFault:
        every = int(rng.integers(100, 400))
        return sensing.LooseContact(index, every, int(rng.integers(5, every // 2)))

    return {
        f"dead-{name}": HardwareFault(
            f"{name} reads the same all the time",
            _reads(lambda rng: sensing.DeadSensor(index, float(rng.choice((-1.0, 0.0, 1.0))))),
        ),
        f"reversed-{name}": HardwareFault(
            f"{name} reads with the wrong sign", _reads(lambda _: sensing.ScaledSensor(index, -1.0))
        ),
        f"scaled-{name}": HardwareFault(
            f"{name} reads 20 to 50 % too low or too high", _reads(scaled)
        ),
        f"drifting-{name}": HardwareFault(
            f"{name} runs away by 10 to 40 % of half range in 5 s",
            _reads(lambda rng: sensing.DriftingSensor(index, _either(rng, 0.1, 0.4) / 5000.0)),
        ),
        f"late-{name}": HardwareFault(
            f"{name} comes 5 to 50 ticks late",
            _reads(lambda rng: sensing.LateSensor(index, int(rng.integers(5, 51)))),
        ),
        f"frozen-{name}": HardwareFault(
            f"{name} stands still from 0.3 to 3 s after the start on",
            _reads(lambda rng: sensing.FrozenSensor(index, int(rng.integers(300, 3000)))),
        ),
        f"loose-{name}": HardwareFault(f"{name} drops to zero again and again", _reads(loose)),
        f"stepped-{name}": HardwareFault(
            f"{name} has steps of 64 to 256 LSB",
            _reads(lambda rng: sensing.LostLowBits(index, 1 << int(rng.integers(6, 9)))),
        ),
        f"spikes-{name}": HardwareFault(
            f"{name} has a spike every 50 to 500 ticks",
            _reads(
                lambda rng: sensing.SpikingSensor(
                    index, int(rng.integers(50, 501)), float(rng.uniform(0.05, 0.5))
                )
            ),
            hidden=True,
        ),
        f"hum-{name}": HardwareFault(
            f"{name} has a sine of 50 or 400 Hz and 2 to 20 LSB",
            _reads(
                lambda rng: sensing.MainsHum(
                    index, float(rng.choice((0.05, 0.4))), float(rng.uniform(0.001, 0.01))
                )
            ),
            hidden=True,
        ),
    }


def _swap(first: int, second: int) -> dict[str, HardwareFault]:
    one, other = CHANNELS[first].name, CHANNELS[second].name
    return {
        f"swapped-{one}-{other}": HardwareFault(
            f"wires of {one} and {other} exchanged",
            _reads(lambda _: sensing.SwappedWires(first, second)),
        )
    }


HARDWARE_FAULTS: Mapping[str, HardwareFault] = {
    "seized-spool": HardwareFault(
        "the spool does not move", _valve(FSS0=(1e3, 1e4), FSS1=(1e3, 1e4))
    ),
    "seized-jack": HardwareFault("the jack does not move", _jack(FDJ0=(1e3, 1e4), FDJ1=(1e3, 1e4))),
    "leaking-piston": HardwareFault(
        "oil passes the piston, 100 to 1000 times as much", _valve(CLK=(100, 1000))
    ),
    "foamed-oil": HardwareFault("air in the oil, bulk modulus 0.2 to 1.5·10⁸ Pa", _foamed),
    "another-valve": HardwareFault(
        "a smaller servovalve than the file says",
        _valve(GQ=(0.3, 0.5), GM=(0.5, 0.8), KSF=(1.3, 2.0), GP=(0.4, 0.7)),
    ),
    "another-jack": HardwareFault(
        "a larger jack than the file says", _jack(AJ=(1.3, 2.0), MJ=(1.5, 3.0))
    ),
    "lost-surface": HardwareFault("the surface has come off the jack", _jack(MJ=(0.02, 0.1))),
    "half-coil": HardwareFault(
        "one of two coils of the torque motor is open", _valve(GM=(0.45, 0.55))
    ),
    "dead-coil": HardwareFault("the torque motor has no current", _valve(GM=(1e-6, 1e-5))),
    "reversed-coil": HardwareFault("the torque motor is wired the wrong way round", _reversed_coil),
    "broken-wire": HardwareFault("the feedback wire is broken", _valve(KSF=(1e-4, 1e-3))),
    "worn-ball": HardwareFault("30 to 100 µm of play at the feedback ball", _worn_ball),
    "clogged-nozzle": HardwareFault(
        "one nozzle is clogged: null shifted by 20 to 45 %", _clogged_nozzle
    ),
    "starved": HardwareFault("the supply lost 50 to 90 %, its probe does not say so", _starved),
    "blind-probe": HardwareFault("oil 30 to 50 K colder than its probe says", _blind_probe),
    "weak-supply": HardwareFault(
        "the supply lost 3 to 10 %, its probe does not say so", _weak_supply, hidden=True
    ),
    **_of_channel(0),
    **_of_channel(1),
    **_of_channel(2),
    **_of_channel(3),
    **_swap(1, 2),
    **_swap(1, 3),
    **_swap(2, 3),
    **_swap(0, 1),
}
"""Kinds of broken hardware by name."""
