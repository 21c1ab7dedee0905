"""The head of a result: what is wrong, how bad, what to do by when. Every surface shows the same.

Terminal, report, page of `serve` and notebook show a `Head`; none of them words a verdict itself.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Sequence
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

import msgspec

from ehadiag.assess.verdict import Verdict
from ehadiag.core.conventions import display_unit
from firmware_iface.errors import EhadiagError
from firmware_iface.stored_test import bundled_tests

if TYPE_CHECKING:
    from ehadiag.assess.verdict import Levels
    from ehadiag.estimate import Severity
    from ehadiag.prognosis.units import Prognosis
    from ehadiag.result import Result

INCONCLUSIVE = "INCONCLUSIVE"
"""Word for a test that ran and was identified, but not explained; its verdict is NOT TESTED."""
LEAST_CHANCE = 0.01
"""Chance, 1, that is worth a word and a number."""


class Bar(msgspec.Struct, frozen=True):
    """One severity as it is drawn."""

    name: str
    """Plain, such as `spool friction`."""
    symbol: str
    """As in the registry of parameters."""
    value: float | None
    """Severity, 0 … 1; None: not known."""
    interval: tuple[float, float] | None
    """95 % interval; None: not known, or it does not hold."""
    state: str
    """Name of the verdict that this severity alone gives; empty: not known."""
    standing: str
    """Against the levels, in words."""


class Reason(msgspec.Struct, frozen=True):
    """Why there is no verdict."""

    cause: str
    """In plain words."""
    evidence: tuple[str, ...]
    """What was found, in the terms of the field; empty: the cause says it."""
    action: str
    """What to do; empty: nothing general can be said."""


class Head(msgspec.Struct, frozen=True):
    """Content of the head of a result."""

    word: str
    """HEALTHY, DEGRADED, FAULT, INCONCLUSIVE or NOT TESTED."""
    verdict: str
    """Name of the verdict, which gives colour and exit code."""
    sentences: tuple[str, ...]
    """What is wrong, what to do and by when, worst first; the first one stands beside the word."""
    reasons: tuple[Reason, ...]
    """Why there is no verdict, the plain cause first; none where there is one."""
    bars: tuple[Bar, ...]
    """Severities, worst first; to be drawn only beside a verdict."""
    advisory: float
    """Level from which a severity is DEGRADED, 0 … 1."""
    limit: float
    """Level from which it is FAULT."""
    facts: tuple[tuple[str, str], ...]
    """Date of the test, unit, test, type of the actuator: label, which may be empty, and text."""

    @property
    def drawn(self) -> tuple[Bar, ...]:
        """Severities that have a verdict: small bars of a test that failed would look sound."""
        return self.bars if self.verdict != Verdict.NOT_TESTED.name else ()

    @property
    def best_fit(self) -> str:
        """Severities of a test that they do not explain, as a line."""
        fits = (f"{bar.symbol} {bar.value:.2f}" for bar in self.bars if bar.value is not None)
        return f"best fit, not to be relied on: {', '.join(fits)}"

    @property
    def title(self) -> str:
        """Unit, where it is known, and word: the first line of a page."""
        serial = dict(self.facts)["unit"]
        return self.word if serial == "unknown" else f"Unit {serial}: {self.word}"

    @property
    def actions(self) -> tuple[str, ...]:
        """What to do where there is no verdict."""
        return tuple(dict.fromkeys(item.action for item in self.reasons if item.action))

    @property
    def lines(self) -> tuple[str, ...]:
        """Sentences, then what to do where there is no verdict."""
        return (*self.sentences, *self.actions)


class _Explanation(msgspec.Struct, frozen=True):
    """Plain words for the reasons that a pattern finds."""

    pattern: str
    cause: str
    action: str = ""


CONSEQUENCES = frozenset({"Samples are missing."})
"""Causes that a recording that begins late or ends early explains."""
CUT_OFF = ("The recording ends early", "The recording begins late")
LEAST_WEAR = 0.005
"""Least severity that is worth a word, 1: it is rounded to a percent."""
CUT_NOTE = re.compile(r"the (last|first) .* are missing")
NO_TIME = "By when: not known from one test; a health history tells (ehadiag history init)."
UNEXPLAINED = "does not explain the recording"
"""Words of the reason for which a culprit is looked for."""
WIDE_RANGE = 10.0
"""Ratio of the ends of an interval, 1, beyond which no time is given, only the earliest one."""


@cache
def _explanations() -> tuple[_Explanation, ...]:
    """Plain cause and action of each reason, root causes before their consequences."""
    text = resources.files("ehadiag").joinpath("data/reasons.toml").read_text(encoding="utf-8")
    return tuple(_Explanation(*row) for row in tomllib.loads(text)["explanations"])


def verdict_word(verdict: str, *, identified: bool) -> str:
    """Return the word for a verdict that people see; NOT TESTED has two.

    verdict: its name; identified: whether there are estimates. Returns INCONCLUSIVE: the test ran
    and was identified, but cannot be explained.
    """
    if verdict == Verdict.NOT_TESTED.name and identified:
        return INCONCLUSIVE
    return verdict.replace("_", " ")


def head_of(result: Result, levels: Levels, prognosis: Prognosis | None = None) -> Head:
    """Return the content of a result's head."""
    untested = result.verdict is Verdict.NOT_TESTED
    bars = sorted(
        (_bar(item, levels, untested) for item in result.as_shown.severities.values()),
        key=lambda bar: -1.0 if bar.value is None else bar.value,
        reverse=True,
    )
    reasons = _explained(result) if untested else ()
    sentences = tuple(item.cause for item in reasons) if untested else _found(result, bars, levels)
    sentences += _by_when(bars, prognosis)
    serial = "unknown" if result.serial is None else str(result.serial)
    date = "date unknown" if result.date is None else shown_date(result.date)
    dated = "recorded" if untested and not result.identified else "tested"
    facts = (
        *([] if untested and result.date is None else [(dated, date)]),
        ("unit", serial),
        ("", stored_test_name(result.test)),
        ("actuator type", result.actuator),
    )
    return Head(
        verdict_word(result.verdict.name, identified=result.identified), result.verdict.name,
        sentences, reasons, tuple(bars), levels.advisory, levels.limit, facts,
    )  # fmt: skip


def _by_when(bars: Sequence[Bar], prognosis: Prognosis | None) -> tuple[str, ...]:
    """Say by when to act on the severities between the levels, worst first."""
    worn = [bar.symbol for bar in bars if bar.state == "DEGRADED"]
    known = remaining_sentences(prognosis, worn)[:1] if prognosis else []
    if known or not worn or any(bar.state == "FAULT" for bar in bars):
        return tuple(known)
    futures = prognosis.forecasts if prognosis else ()
    why = [item.remaining[-1].why for item in futures if item.name == worn[0]]
    return (f"By when is not known yet: {why[0]}." if why else NO_TIME,)


def remaining_sentences(prognosis: Prognosis, names: Collection[str] | None = None) -> list[str]:
    """Return when severities reach the limit, the soonest first; only those with a number.

    prognosis: what the history says; names: of the severities; None: all. Returns sentences; one
    whose interval is wide says only the earliest time.
    """
    found = []
    for item in prognosis.forecasts:
        left = item.remaining[-1]
        if names is not None and item.name not in names:
            continue
        if left.median is None or left.low is None or left.high is None or left.reached:
            continue
        unit = "h" if prognosis.unit == "hours" else prognosis.unit
        low, high = two_digits(max(left.low, 0.0)), two_digits(left.high)
        when = f"reaches its limit in about {two_digits(left.median)} {unit}"
        when += f" (80 %: {low} to {high} {unit})"
        if left.low > 0.0 and left.high > WIDE_RANGE * left.low:
            when = f"reaches its limit not before about {low} {unit}"
        past = left.chance_within(0.0) or 0.0
        if left.median <= 0.0:
            when = f"may have reached its limit: {chance_text(past)}"
        elif left.low <= 0.0:
            when += f"; it may be past it: {chance_text(past)}"
        text = f"{plain_name(item.name)} {when}{_counted(prognosis)}."
        found.append((left.median, text[0].upper() + text[1:]))
    return [text for _, text in sorted(found)]


def _counted(prognosis: Prognosis) -> str:
    """Say from when on times left are counted, where that is not the day of the last test."""
    last = (prognosis.last_test or prognosis.now)[:10]
    if last == prognosis.now[:10]:
        return ""
    if prognosis.usage_now is None:
        return f", from the test of {last}"
    unit = "h" if prognosis.unit == "hours" else prognosis.unit
    return "" if unit == "days" else f", from now at about {two_digits(prognosis.usage_now)} {unit}"


@cache
def _loops() -> dict[str, str]:
    """Loop of each stored test of the package, by the test's name."""
    tests = bundled_tests().values()
    return {item.name: "closed-loop" if item.closed_loop else "open-loop" for item in tests}


def stored_test_name(name: str | None) -> str:
    """Return what people call a stored test: by its loop, one that is not of the package by name.

    name: several are joined by '+'; None: not known. Returns words such as `open-loop test`.
    """
    if name is None:
        return "test unknown"
    loops = [_loops().get(part, "") for part in name.split("+")]
    if not all(loops):
        return f'test "{name}"'
    several = [loop if loops.count(loop) == 1 else f"{loops.count(loop)} {loop}"
               for loop in dict.fromkeys(loops)]  # fmt: skip
    return f"{' and '.join(several)} test{'s' * (len(loops) > 1)}"


def two_digits(value: float) -> str:
    """Write a number with two digits that count."""
    return f"{float(f'{value:.2g}'):g}"


def percent(value: float, *others: float) -> str:
    """Write a share in percent, with as many digits as tell it from other ones."""
    for digits in range(3):
        text = f"{100.0 * value:.{digits}f}"
        if all(text != f"{100.0 * other:.{digits}f}" for other in others if other != value):
            break
    return f"{text} %"


def chance_text(chance: float) -> str:
    """Write a chance in percent; none is promised or ruled out."""
    if not LEAST_CHANCE <= chance <= 1.0 - LEAST_CHANCE:
        return "below 1 %" if chance < LEAST_CHANCE else "above 99 %"
    return f"{100.0 * chance:.0f} %"


def plain_name(name: str) -> str:
    """Return the plain name of a severity or effect; an unknown name as it is."""
    from ehadiag.model.registry import parameter  # noqa: PLC0415 - loads kernels

    try:
        return parameter(name).short
    except KeyError:
        return name


def full_name(name: str) -> str:
    """Return plain name and symbol of a severity, such as `jack friction (FDJ)`."""
    plain = plain_name(name)
    return name if plain == name else f"{plain} ({name})"


def kept_advice(line: str) -> dict[str, str]:
    """Return what to do about each severity by its name.

    line: JSON result that a history keeps; without one, as of a row that was imported, the advice
    is that of any actuator.
    """
    from ehadiag.core.actuator import Advice  # noqa: PLC0415 - not for help texts
    from ehadiag.result import Result  # noqa: PLC0415

    try:
        return {item.name: item.advice for item in Result.from_json(line).severities.values()}
    except (EhadiagError, ValueError):
        return msgspec.structs.asdict(Advice())


def advised(advice: str, *, at_once: bool) -> str:
    """Return what to do as a sentence, at once or planned; empty without an advice."""
    if not advice:
        return ""
    return f"Act now: {advice}." if at_once else f"Plan to {advice}."


def shown_date(date: str) -> str:
    """Return a date of a result, UTC and ISO 8601, as people read it."""
    return f"{date[:10]} {date[11:16]} UTC"


def _bar(item: Severity, levels: Levels, untested: bool) -> Bar:
    value, state, standing = item.estimate, "", "not known"
    if value is not None and untested:
        standing = "no verdict"
    elif value is not None:
        state, standing = "HEALTHY", "below both levels"
        if value >= levels.limit:
            state, standing = "FAULT", "at or above the limit"
        elif value >= levels.advisory:
            state, standing = "DEGRADED", "at or above the advisory level"
        elif item.interval95 is not None and item.interval95[1] >= levels.advisory:
            standing = "may be above the advisory level"
        standing += ", at its bound" * item.at_bound
    if not item.shown:
        state, standing = "", "not shown by the test"
    return Bar(
        item.meaning or plain_name(item.name), item.name, value, item.interval95, state, standing
    )


def _found(result: Result, bars: Sequence[Bar], levels: Levels) -> tuple[str, ...]:
    """Say what is worn, worst first, with what to do."""
    both = (levels.advisory, levels.limit)
    out = []
    for bar in bars:
        advice = result.severities[bar.symbol].advice
        if bar.value is None:
            continue
        size = f"{bar.name} is at {percent(bar.value, *both)}"
        if bar.state == "FAULT":
            text = f"{size}, its limit is {percent(levels.limit)}."
            text = f"{text} {advised(advice, at_once=True)}".rstrip()
        elif bar.state == "DEGRADED":
            text = f"{size}, above its advisory level of {percent(levels.advisory)}."
            text = f"{text} {advised(advice, at_once=False)}".rstrip()
        elif any(reason.startswith(f"{bar.symbol} ") for reason in result.reasons):
            text = f"{size}, and may be above its advisory level of {percent(levels.advisory)}."
        else:
            continue
        out.append(text[0].upper() + text[1:])
    for item in result.other:
        if item.beyond and item.limit is not None and item.value is not None:
            factor, unit = display_unit(item.unit, item.limit)
            text = f"{item.meaning} is {factor * item.value:.3g} {unit}"
            text += f", its limit is {factor * item.limit:.3g} {unit}."
            out.append(text[0].upper() + text[1:])
    worst = bars[0] if bars else None
    if not out and worst and worst.value is not None:
        text = "No wear was found."
        if worst.value >= LEAST_WEAR:
            text = (
                f"All wear is below its advisory level of {percent(levels.advisory)};"
                f" most worn: {worst.name}, {percent(worst.value, *both)}."
            )
        out.append("Nothing to do. " * (result.verdict is Verdict.HEALTHY) + text)
    return tuple(out)


def _explained(result: Result) -> tuple[Reason, ...]:
    """Group reasons by their plain causes, in the order of the data file."""
    texts = [*result.reasons]
    if any("missing" in text for text in texts):
        texts += [note for note in result.notes if CUT_NOTE.match(note)]
    known = _explanations()
    groups: dict[str, tuple[int, list[str], str]] = {}
    for text in texts:
        rank, cause, action = len(known), _sentence(text), ""
        for place, item in enumerate(known):
            if re.search(item.pattern, text):
                numbers = re.findall(r"\d+\.\d+", text)
                short = f"{float(numbers[0]):.1f}" if numbers else ""
                cause = item.cause.format(short, evidence=text)
                rank, action = place, item.action
                break
        found = [text]
        if UNEXPLAINED in text and (culprit := result.culprit) is not None:
            found += culprit.lines
            action = f"Check this first: {culprit.advice}." if culprit.advice else action
        groups.setdefault(cause, (rank, [], action))[1].extend(found)
    cut = [cause for cause in groups if cause.startswith(CUT_OFF)]
    if cut:  # what is missing is missing for this reason
        for cause in CONSEQUENCES & groups.keys():
            del groups[cause]
        rank = groups[cut[0]][0]
        groups[cut[0]] = (rank, [cut[0]], "Record the test to its end, then diagnose again.")
    ordered = sorted(groups.items(), key=lambda pair: pair[1][0])
    return tuple(
        Reason(cause, () if [_sentence(item) for item in evidence] == [cause] else tuple(evidence),
               action)
        for cause, (_, evidence, action) in ordered
    )  # fmt: skip


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."
