"""Studies of severities: alone, by the paper's cases and in the unit cube, or beside effects.

Effects of random units are unknown, or calibrated.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.assess.verdict import objections_to_estimate
from ehadiag.calibration.calibrate_unit import calibrate
from ehadiag.core.actuator import Actuator, default_actuator, with_tolerance
from ehadiag.identify.experiment import (
    Experiment,
    build_experiment,
    lay_out_spans,
    share_offsets,
    unknowns_of,
)
from ehadiag.identify.identification_result import Identification
from ehadiag.identify.identification_session import (
    EarlierEstimate,
    IdentificationSession,
    NuisanceMode,
    identify,
)
from ehadiag.identify.linearisation import Derivatives
from ehadiag.identify.prior import basic_nuisances_of, prior_information, unit_prior
from ehadiag.model.registry import FAULT_NAMES, FAULTS, SENSOR_OFFSETS
from ehadiag.model.residual_models import SimdModel, model_response
from ehadiag_sim.conditions import Effects, Faults, Sensors
from ehadiag_sim.plant_dynamics import DEFAULT_STEP_S
from ehadiag_sim.simulation import simulate
from ehadiag_tools.accuracy.figures import NOT_TESTED, accuracy_table, cramer_rao, percent_errors
from ehadiag_tools.simulator.units import (
    COARSE_STEP,
    Unit,
    add_group,
    damaged_unit,
    read_tested,
    read_truth,
    record,
    unit_with,
)
from ehadiag_tools.study import Options, Record, Study, grouped, markdown
from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import CHANNELS, Environment, Recording, Samples
from firmware_iface.stored_test import bundled_tests, resolve_test

Severities = tuple[float, ...]
"""Kintas, FSS, FDJ, each 0 … 1."""
SURFACE_PERIOD = 4
"""Random cases for one on the surface of the cube, until each of its parts was visited."""
OIL_RANGE = (-20.0, 100.0)
"""Temperatures of the oil on a random day, degC."""
OIL_BANDS = (-20.0, 0.0, 30.0, 65.0, 100.0)
"""Limits of the bands in which coverage is counted, degC."""
PLANTS = ("detailed", "monitoring")
"""The independent simulator; the monitoring model itself."""
TESTS: Mapping[str, tuple[str, ...]] = {
    "open": ("open",),
    "closed": ("closed",),
    "joint": ("open", "closed"),
}
"""Stored tests that one identification gets."""


@dataclass(frozen=True, slots=True)
class PaperCase:
    """One case of the paper's Tables 1 and 2 (PHY-40).

    Errors are means in percent: after the first approximation, after the genetic algorithm.
    """

    test: str
    number: int
    faults: Severities
    first: float
    final: float


PAPER: tuple[PaperCase, ...] = (
    PaperCase("open", 1, (0.3, 0.3, 0.3), 0.7147, 0.1937),
    PaperCase("open", 2, (0.3, 0.6, 0.3), 7.7791, 0.4891),
    PaperCase("open", 3, (0.6, 0.6, 0.3), 9.6052, 0.2816),
    PaperCase("open", 4, (0.6, 0.6, 0.6), 9.5992, 0.2754),
    PaperCase("closed", 1, (0.3, 0.3, 0.3), 0.3005, 0.2943),
    PaperCase("closed", 2, (0.3, 0.6, 0.3), 4.5653, 0.2479),
    PaperCase("closed", 3, (0.6, 0.6, 0.3), 5.1306, 0.3380),
    PaperCase("closed", 4, (0.6, 0.6, 0.6), 2.2902, 0.2346),
)


def random_faults(count: int, seed: int) -> list[Severities]:
    """Points of the unit cube; a longer list begins with the shorter one of the same seed.

    Among them, one in four, are all corners, a point on each edge and on each face: 26 in all.
    """
    rng = np.random.default_rng(seed)
    surface: list[Severities] = []
    faces: tuple[float | None, ...] = (0.0, 1.0, None)
    for place in itertools.product(faces, repeat=3):
        if place != (None, None, None):
            free = rng.random(3).tolist()
            surface.append(tuple(r if v is None else v for v, r in zip(place, free, strict=True)))
    order = iter(rng.permutation(len(surface)))
    out: list[Severities] = []
    for index in range(count):
        inside = tuple(rng.random(3).tolist())
        special = next(order, None) if index % SURFACE_PERIOD == 0 else None
        out.append(inside if special is None else surface[special])
    return out


@dataclass(frozen=True, slots=True)
class Case:
    """Settings of one identification; what it gives depends on nothing else but the code.

    A test is one of `TESTS`, a plant of `PLANTS`; oil (degC) and supply pressure (Pa) are the
    simulator's own unless given; recordings, one log for each stored test, are identified instead
    of a simulation. Wear: largest change of a severity since a diagnosis from which a second
    identification begins.
    """

    test: str
    faults: Severities
    noise_seed: int = 0
    search_seed: int = 0
    plant: str = "detailed"
    recordings: tuple[str, ...] = ()
    conditions: tuple[float, float] | None = None
    wear: float | None = None


def perform(case: Case) -> Record:
    """Identify; plain numbers only, fractions of 1."""
    experiments = experiments_of(case)
    begin = time.thread_time()
    result = identify(experiments, seed=case.search_seed)
    spent = time.thread_time() - begin
    return {
        **({} if case.wear is None else _from_earlier(case, experiments, result, spent)),
        "faults": case.faults,
        "first": [item.first for item in result.estimates],
        "search": [item.search for item in result.estimates],
        "value": [item.value for item in result.estimates],
        "std": [item.std for item in result.estimates],
        "interval95": [list(item.interval95) for item in result.estimates],
        "outliers": result.fit.outliers,
        "anchored": result.fit.anchored,
        "evaluations": result.evaluations,
        "converged": result.converged,
        "rescued": result.rescued,
        "bound": [float(value) for value in cramer_rao(experiments, case.faults)],
    }


def _from_earlier(
    case: Case, experiments: Sequence[Experiment], found: Identification, spent: float
) -> Record:
    """Identify from an earlier diagnosis: whether it began there, how far from that of a search.

    In deviations; time as a share of that of the search.
    """
    rng = np.random.default_rng(case.noise_seed)
    change = (case.wear or 0.0) * rng.uniform(-1.0, 1.0, len(FAULT_NAMES))
    values = np.clip(np.array([item.value for item in found.estimates]) + change, 0.0, 1.0)
    earlier = EarlierEstimate(dict(zip(FAULT_NAMES, values.tolist(), strict=True)), "earlier")
    begin = time.thread_time()
    other = IdentificationSession(seed=case.search_seed, earlier=earlier).finish(experiments)
    pairs = zip(other.estimates, found.estimates, strict=True)
    return {
        "begun": bool(other.begun_from),
        "time_share": (time.thread_time() - begin) / spent,
        "apart": max(abs(new.value - old.value) / old.std for new, old in pairs),
    }


def experiments_of(case: Case) -> list[Experiment]:
    """Experiments of a case, one for each stored test."""
    out = []
    for index, name in enumerate(TESTS[case.test]):
        if case.recordings:
            samples, environment = _recorded(case.recordings[index])
        elif case.plant == "monitoring":
            samples, environment = _monitoring(name, case.faults, case.noise_seed)
        else:
            samples, environment = _detailed(name, case.faults, case.noise_seed, case.conditions)
        test = resolve_test(name)
        out.append(build_experiment(samples, environment, test, default_actuator()))
    return out


@lru_cache(maxsize=8)
def _recorded(path: str) -> tuple[Samples, Environment]:
    recording, samples = read_tested(Path(path))
    return samples, recording.environment


@lru_cache(maxsize=8)
def _detailed(
    test: str, faults: Severities, seed: int, conditions: tuple[float, float] | None = None
) -> tuple[Samples, Environment]:
    # Open and closed loop of one seed must not have the same noise: a joint estimate has both.
    key = (seed, list(TESTS).index(test))
    noise = int(np.random.SeedSequence(key).generate_state(1)[0])
    effects = None
    if conditions is not None:
        oil, supply = conditions
        effects = Effects(oil_temperature=oil, supply_pressure=supply)
    done = simulate(default_actuator(), resolve_test(test), Faults(*faults), effects, seed=noise)
    recording = done.recording("simulated")
    return done.samples, recording.environment


@lru_cache(maxsize=8)
def _monitoring(test: str, faults: Severities, seed: int) -> tuple[Samples, Environment]:
    """Spool and pressure by the monitoring model, with the converters' noise and rounding.

    The current is that of one detailed simulation, whatever the noise seed, so that the bound is
    the same for all seeds; its jack position is kept, from which the current is rebuilt exactly.
    """
    samples, environment = _detailed(test, faults, 0)
    (experiment,) = experiments_of(Case(test, faults))
    truth = model_response(
        damaged_unit(faults, environment=environment), experiment.trace.current, experiment.tick
    )
    rng = np.random.default_rng(np.random.SeedSequence((seed, 7)))
    noise = Sensors().noise_lsb
    measured = []
    for channel, clean in ((CHANNELS.spool, truth.spool), (CHANNELS.pressure, truth.pressure)):
        volts = clean + noise * channel.lsb * rng.standard_normal(len(clean))
        measured.append(channel.decode(channel.encode(volts)))
    return replace(samples, spool=measured[0], pressure=measured[1]), environment


TITLES = {"open": "Table 1, open loop", "closed": "Table 2, closed loop"}


def _paper_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--recordings", type=Path, metavar="FOLDER", help="recordings and their truth.csv instead")
    add("--plant", choices=PLANTS, default=PLANTS[0], help="what is simulated (%(default)s)")


def _paper_cases(options: Options) -> list[Case]:
    if options.recordings is None:
        seeds = range(options.seed - 1, options.seed - 1 + options.cases)
        return [
            Case(case.test, case.faults, noise_seed=seed, plant=options.plant)
            for case in PAPER
            for seed in seeds
        ]
    found = [
        Case(truth.test, truth.faults, recordings=(truth.path,))
        for truth in read_truth(options.recordings)
        if truth.test in TITLES
    ]
    if not found:
        raise ConfigurationError(f"{options.recordings}: no recording of {', '.join(TITLES)}")
    return found


def _paper_report(records: Sequence[Record], options: Options) -> Iterator[str]:
    """Mean errors of each case after two stages beside the paper's, then all errors."""
    published = {(case.test, case.faults): case for case in PAPER}
    for (test,), part in grouped(records, "test").items():
        source = options.recordings or f"plant {options.plant}"
        yield f"{TITLES[test]}: mean absolute error in percent, {source}\n"
        rows, shared = [], []
        for (faults,), runs in grouped(part, "faults").items():
            case = published.get((test, faults))
            means = [
                float(np.abs(percent_errors(runs, item)).mean()) for item in ("first", "value")
            ]
            paper = [case.first, case.final] if case else [np.nan, np.nan]
            label = ", ".join(f"{value:g}" for value in faults)
            rows.append((label, len(runs), *(f"{value:.4f}" for value in means + paper)))
            shared += [means + paper] * bool(case)
        if shared:
            cells = [f"{value:.4f}" for value in np.mean(shared, axis=0)]
            rows.append(("mean of the paper's", "", *cells))
        yield from markdown(
            ("case (Kintas, FSS, FDJ)", "runs", "first approximation", "final", "the paper's first",
             "the paper's final"),
            rows,
        )  # fmt: skip
        yield ""
    yield from accuracy_table(records, "test", "faults")
    yield ""
    yield from accuracy_table(records, "test")


def _cube_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--test", action="append", choices=list(TESTS), help="may be repeated (open and closed)")
    add_conditions(parser)
    add("--wear", action="append", type=float, metavar="K",
        help="also begin from a diagnosis with severities that differ by so much; may be repeated"
    )  # fmt: skip


def random_days(options: Options) -> list[tuple[float, float] | None]:
    """Oil, degC, and supply, Pa, for each random case; None without `--conditions`."""
    if not options.conditions:
        return [None] * options.cases
    rng, supply = np.random.default_rng([options.seed, 1]), Effects().supply_pressure
    low, high = zip(OIL_RANGE, (0.9 * supply, 1.1 * supply), strict=True)
    return [(float(a), float(b)) for a, b in rng.uniform(low, high, (options.cases, 2))]


def add_conditions(parser: argparse.ArgumentParser) -> None:
    """Add the option for days of random oil and supply, see `random_days`."""
    parser.add_argument(
        "--conditions", action="store_true", help="oil of -20 to 100 degC, supply ±10 %%"
    )


def _cube_cases(options: Options) -> list[Case]:
    days = random_days(options)
    return [
        Case(test, faults, noise_seed=index, conditions=day, wear=wear)
        for test in options.test or ("open", "closed")
        for index, (faults, day) in enumerate(
            zip(random_faults(options.cases, options.seed), days, strict=True)
        )
        for wear in options.wear or (None,)
    ]


def _cube_report(records: Sequence[Record], options: Options) -> Iterator[str]:
    yield f"Random cases, seed {options.seed}, errors in percent\n"
    yield from accuracy_table(records, "test")
    if options.conditions:
        yield "\nBy the temperature of the oil, degC:\n"
        yield from accuracy_table([{**item, "oil": _band(item)} for item in records], "test", "oil")
    if options.wear:
        yield "\nFrom an earlier diagnosis, beside a search:\n"
        yield from markdown(
            ("test", "wear", "cases", "begun there", "apart, median", "95 %", "most",
             "time, median"),
            _wear_rows(records),
        )  # fmt: skip
    for (test,), part in grouped(records, "test").items():
        first = np.abs(percent_errors(part, "first")).mean()
        outliers = max(item["outliers"] for item in part)
        yield (
            f"\n{test}: mean after the first approximation {first:.3f}, sent back to the whole cube"
            f" {sum(bool(item['rescued']) for item in part)}, not converged"
            f" {sum(not item['converged'] for item in part)}, largest share of outliers"
            f" {outliers:.2%}"
        )


def _band(record: Record) -> str:
    oil = record["conditions"][0]
    bands = itertools.pairwise(OIL_BANDS)
    return next(f"{low:g} … {high:g}" for low, high in bands if low <= oil <= high)


def _wear_rows(records: Sequence[Record]) -> Iterator[tuple[object, ...]]:
    """How far both estimates are apart, in deviations, and the time, of those that began there."""
    for (test, wear), part in grouped(records, "test", "wear").items():
        begun = [item for item in part if item["begun"]] or [
            {"apart": np.nan, "time_share": np.nan}
        ]
        apart = [item["apart"] for item in begun]
        cells = [f"{np.quantile(apart, share):.3f}" for share in (0.5, 0.95, 1.0)]
        time_share = float(np.median([item["time_share"] for item in begun]))
        share = f"{np.mean([item['begun'] for item in part]):.0%}"
        yield test, f"{wear:g}", len(part), share, *cells, f"{time_share:.2f}"


PAPER_CASES = Study(
    "paper",
    "The paper's Tables 1 and 2 beside this project's errors, and their Cramér–Rao bounds.",
    _paper_cases, perform, _paper_report, _paper_options, count=5,
    counted="noise seeds of each simulated case",
)  # fmt: skip
CUBE = Study(
    "cube",
    "Random severities of the unit cube, its corners, edges and faces among them.",
    _cube_cases, perform, _cube_report, _cube_options,
)  # fmt: skip


DATA = ("known", "tolerance", "calibrated", "textbook")
"""The unit's data are those of its file; differ by a tolerance; are learned from it as new; are
those of its file and there is no effect, so that the Cramér–Rao bound is known."""
TOLERANCE = 0.05
"""Tolerance of the data sheet, 1; that of the units' ten values."""


@dataclass(frozen=True, slots=True)
class UnitCase:
    """Settings of one identification: unit `case` of a seed; what is known of it, see `DATA`.

    Nuisances: auto, all or none; groups of effects: see `random_unit`.
    """

    test: str
    case: int
    seed: int
    nuisances: str = "auto"
    data: str = "known"
    groups: tuple[str, ...] = ()


def perform_unit(case: UnitCase) -> Record:
    """Draw a unit, record it, identify, and compare with the truth; fractions of 1."""
    unit, faults = draw_unit(case)
    actuator, reasons = knowledge(case)
    experiments = []
    for name in TESTS[case.test]:
        recording = record_worn(case, unit, name, faults)
        experiments.append(_experiment(recording, name, actuator))
    begin = time.process_time()
    result = identify(
        experiments, nuisances=NuisanceMode(case.nuisances), prior=unit_prior(actuator)
    )
    spent = time.process_time() - begin
    objections = objections_to_estimate(result, actuator.calibration)
    textbook = case.data == "textbook" and len(experiments) == 1
    return {
        "faults": faults,
        "value": [item.value for item in result.estimates],
        "interval95": [list(item.interval95) for item in result.estimates],
        "verdict": NOT_TESTED if reasons or objections else "answered",
        "refused": list(reasons),
        "attempts": result.attempts,
        "evaluations": result.evaluations,
        "processor_s": spent,
        "bound": bound_of(experiments[0], faults).tolist() if textbook else None,
    }


def _experiment(recording: Recording, name: str, actuator: Actuator) -> Experiment:
    assert recording.samples is not None
    return build_experiment(recording.samples, recording.environment, resolve_test(name), actuator)


def draw_unit(case: UnitCase) -> tuple[Unit, list[float]]:
    """Unit and severities of a case."""
    rng = np.random.default_rng([case.seed, case.case])
    unit = Unit()
    if case.data != "textbook":
        unit = unit_with(rng, case.groups, case.case, data=case.data != "known")
    return unit, rng.uniform(0.0, 1.0, 3).tolist()


def record_worn(case: UnitCase, unit: Unit, name: str, faults: Sequence[float]) -> Recording:
    """Record a stored test of a unit with severities."""
    place = ("open", "closed").index(name)
    sheet = case.data in ("tolerance", "calibrated")
    noise = _noise(case.seed, case.case, *([0] if sheet else []), place)
    step = COARSE_STEP if sheet else DEFAULT_STEP_S
    return record(unit, resolve_test(name), Faults(*faults), seed=noise, step=step)


def _noise(*key: int) -> int:
    return int(np.random.SeedSequence(key).generate_state(1)[0])


def knowledge(case: UnitCase) -> tuple[Actuator, tuple[str, ...]]:
    """What the identification is given of a unit, and why its calibration was refused."""
    if case.data in ("known", "textbook") or case.nuisances == NuisanceMode.NONE.value:
        return default_actuator(), ()
    if case.data == "tolerance":
        return with_tolerance(default_actuator(), TOLERANCE), ()
    return _calibrated(case.seed, case.case, case.groups)


@lru_cache(maxsize=64)
def _calibrated(seed: int, case: int, groups: tuple[str, ...]) -> tuple[Actuator, tuple[str, ...]]:
    """Return the unit's own data, or those of its type and why it was refused."""
    unit, _ = draw_unit(UnitCase("open", case, seed, data="calibrated", groups=groups))
    new = [
        record(unit, resolve_test(name), seed=_noise(seed, case, 1, place), step=COARSE_STEP)
        for place, name in enumerate(("open", "closed"))
    ]
    found = calibrate(new, default_actuator(), bundled_tests().values())
    return found.actuator or default_actuator(), found.reasons


def _unit_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--test", action="append", choices=list(TESTS), help="may be repeated (open and closed)")
    add("--data", action="append", choices=DATA, help="what is known; may be repeated (known)")
    kinds = [item.value for item in NuisanceMode]
    add("--nuisances", action="append", choices=kinds, help="may be repeated (auto)")
    add_group(parser)


def _unit_cases(options: Options) -> list[UnitCase]:
    groups = tuple(sorted(set(options.group)))
    return [
        UnitCase(test, case, options.seed, nuisances, data, groups)
        for data in options.data or ["known"]
        for test in options.test or ["open", "closed"]
        for nuisances in options.nuisances or ["auto"]
        for case in range(options.cases)
    ]


def _unit_report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    yield from accuracy_table(records, "test", "data", "nuisances", of_all=True)
    yield "\nModel runs and processor time of an identification, mean:\n"
    for key, part in grouped(records, "test", "data", "nuisances").items():
        runs, spent = (
            np.mean([item[name] for item in part]) for name in ("evaluations", "processor_s")
        )
        yield f"- {', '.join(key)}: {runs:.0f}, {1e3 * spent:.0f} ms"


def bound_of(experiment: Experiment, faults: Sequence[float]) -> NDArray[np.float64]:
    """Least deviation of each severity that an unbiased estimate with all unknowns can have.

    Ticks where a break-away moves within the differences have no derivative and are left out.
    """
    experiments = share_offsets([experiment])
    basic = basic_nuisances_of(experiment.constants.OIL)
    unknowns = unknowns_of(experiments, (*FAULTS, *SENSOR_OFFSETS, *basic))
    model = Derivatives(SimdModel(lay_out_spans(experiments), unknowns), experiment.noise)
    truth = dict(zip(FAULT_NAMES, faults, strict=True))
    x = np.array([truth.get(item.name, 0.0) for item in model.estimated]) / model.scale
    slope = model.trusted_slope(x)
    rows = (slope.jacobian * slope.smooth).reshape(len(x), -1)
    spread = np.linalg.inv(rows @ rows.T + prior_information(model, {}))
    return np.asarray((np.sqrt(np.diag(spread)) * model.scale)[: len(FAULTS)])


UNITS = Study(
    "units",
    "Random units: offsets, gain, null bias, hysteresis, backlash unknown; data known, with a"
    " tolerance, or calibrated.",
    _unit_cases, perform_unit, _unit_report, _unit_options, counted="units of each row",
)  # fmt: skip
