"""The head of a result: what is wrong, how bad, what to do by when; and the text of a result.

Terminal, report, page of `serve` and notebook show a `Head`; none of them words a verdict itself.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
import tomllib
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

import msgspec
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ehadiag.assess.verdict import Levels, Verdict
from ehadiag.core.conventions import PIPE_COLUMNS, display_unit, shown_date, to_precision
from ehadiag.estimate import AT_BOUND, NOT_SHOWN
from firmware_iface.errors import printable
from firmware_iface.stored_test import bundled_tests

if TYPE_CHECKING:
    from ehadiag.estimate import Effect, Severity
    from ehadiag.prognosis.units import Prognosis
    from ehadiag.request import Request
    from ehadiag.result import Onboard, Result

INCONCLUSIVE = "INCONCLUSIVE"
"""Word for a test that ran and was identified, but not explained; its verdict is NOT TESTED."""


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


def head_of(
    result: Result, asked: Levels | None = None, prognosis: Prognosis | None = None
) -> Head:
    """Return the content of a result's head; `asked`: other levels than those of its request."""
    levels = asked or result.request
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
    known: list[str] = []
    if prognosis:
        from ehadiag.report.prognosis_tables import remaining_sentences  # noqa: PLC0415 - heavy

        known = remaining_sentences(prognosis, worn)[:1]
    if known or not worn or any(bar.state == "FAULT" for bar in bars):
        return tuple(known)
    futures = prognosis.forecasts if prognosis else ()
    why = [item.remaining[-1].why for item in futures if item.name == worn[0]]
    return (f"By when is not known yet: {why[0]}." if why else NO_TIME,)


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


def percent(value: float, *others: float) -> str:
    """Write a share in percent, with as many digits as tell it from other ones."""
    for digits in range(3):
        text = f"{100.0 * value:.{digits}f}"
        if all(text != f"{100.0 * other:.{digits}f}" for other in others if other != value):
            break
    return f"{text} %"


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


def advised(advice: str, *, at_once: bool) -> str:
    """Return what to do as a sentence, at once or planned; empty without an advice."""
    if not advice:
        return ""
    return f"Act now: {advice}." if at_once else f"Plan to {advice}."


def _bar(item: Severity, levels: Levels | Request, untested: bool) -> Bar:
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


def _found(result: Result, bars: Sequence[Bar], levels: Levels | Request) -> tuple[str, ...]:
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


STATE_STYLES = {
    "HEALTHY": "bold green",
    "DEGRADED": "bold yellow",
    "FAULT": "bold red",
    "NOT_TESTED": "bold",
}
NAMED_COLUMNS = 76
"""Columns from which on the table of the severities has their plain names too."""
FLAG_REMARKS = {AT_BOUND: "at its bound", NOT_SHOWN: "not shown by the test"}
"""What the table says of a severity's flags."""


def diagnosis_text(result: Result, *, verbose: bool = False) -> str:
    """Return a result as plain lines of text, the last one without its end."""
    console = Console(
        file=io.StringIO(), width=PIPE_COLUMNS, highlight=False, record=True, force_jupyter=False
    )
    print_result(result, console, verbose=verbose)
    return "\n".join(line.rstrip() for line in console.export_text().splitlines())


def diagnosis_html(result: Result) -> str:
    """Return a result as a piece of HTML for a notebook, its text escaped."""
    from ehadiag.report.page_parts import templates_of  # noqa: PLC0415 - bokeh is slow

    head = head_of(result)
    template = templates_of("ehadiag.report").get_template("notebook.html.j2")
    shown = result.as_shown.severities
    severities = [shown[bar.symbol] for bar in head.bars]
    return template.render(head=head, severities=severities, percent=percent)


def print_result(
    result: Result, console: Console, prognosis: Prognosis | None = None, *, verbose: bool = False
) -> None:
    """Print a result: its head, then the numbers.

    verbose: the course of the search, reasons in terms of the field, numbers beside no verdict, and
    every effect that was estimated, not only those that are not 0 beyond doubt.
    """
    head = head_of(result, prognosis=prognosis)
    _print_head(head, result, console)
    if verbose:
        for reason in result.reasons:
            print_line(console, f"- {reason}")
    relied_on = verbose or result.relied_on
    if not relied_on:
        print_line(console, head.best_fit)
    elif result.estimated:
        console.print(_severities(head, result, console), crop=False)
    if result.identified and verbose:
        for name in ("first", "search"):
            values = (f"{k} {_number(getattr(v, name), 4)}" for k, v in result.severities.items())
            print_line(console, f"after the {name}: {', '.join(values)}")
    onboard = result.origins[0].onboard if len(result.origins) == 1 else None
    if onboard is not None:
        unexplained = onboard.verdict == Verdict.NOT_TESTED.name
        print_line(console, _on_board(onboard, result, verbose or (relied_on and not unexplained)))
    if result.other and relied_on:
        console.print(_limited(result), crop=False)
    effects = [item for item in result.effects if verbose or _is_shown(item)]
    effects = [item for item in effects if item.limit is None]
    if effects and relied_on:
        print_line(console, f"also estimated: {', '.join(map(_size, effects))}")
    print_line(console, _quality_text(result))
    cut_off = any(item.cause.startswith(CUT_OFF) for item in head.reasons)
    for note in result.notes:
        if verbose or not (cut_off and CUT_NOTE.match(note)):  # the head says it
            print_line(console, f"note: {note}")
    if result.identified:
        print_line(console, _effort_text(result))


def _print_head(head: Head, result: Result, console: Console) -> None:
    indent = " " * (len(head.word) + 2)
    first, *rest = head.sentences or ("",)
    lines = _wrapped(first, console, len(indent))
    text = Text(head.word, style=STATE_STYLES[head.verdict])
    text.append(f"  {lines[0]}", style="not bold default")
    console.print(text, soft_wrap=True)
    arrow = "→" if _unicode(console) else ">"
    actions = [f"{arrow} {action}" for action in head.actions]
    for sentence in ("\n".join(lines[1:]), *rest, *actions):
        for line in _wrapped(sentence, console, len(indent)) if sentence else ():
            console.print(indent + line, soft_wrap=True)
    facts = ", ".join(f"{label} {printable(value)}".lstrip() for label, value in head.facts)
    print_line(console, facts)
    print_line(console, f"recording {printable(result.source)}")
    for item in (item for reason in head.reasons for item in reason.evidence):
        print_line(console, f"- {item}")
    if result.identified and head.drawn:
        for bar in head.drawn:
            console.print(_drawn_bar(bar, head, console), soft_wrap=True)
        advisory, limit = _marks(console)
        levels = (
            f"{advisory} advisory {percent(head.advisory)}, {limit} limit {percent(head.limit)}"
        )
        start = max(min(27, console.width - len(levels)), 0)
        console.print(" " * start + levels, soft_wrap=True)


def _drawn_bar(bar: Bar, head: Head, console: Console) -> Text:
    """Draw a severity: plain name, percent, bar with a mark at each level."""
    # At most 2 % a column.
    length = max(min(console.width - 30, 48), 8)
    full, empty = ("█", "·") if _unicode(console) else ("#", ".")
    value = bar.value or 0.0
    done = round(min(value, 1.0) * length)
    cells = [full] * done + [empty] * (length - done)
    for level, mark in zip((head.advisory, head.limit), _marks(console), strict=True):
        cells[min(round(level * length), length - 1)] = mark
    known = "unknown" if bar.value is None else percent(bar.value, head.advisory, head.limit)
    text = Text(f"  {bar.name:16}{known:>8} ")
    text.append("".join(cells), style=STATE_STYLES.get(bar.state, ""))
    return text


def _marks(console: Console) -> tuple[str, str]:
    """Marks of advisory level and limit."""
    return ("┊", "┃") if _unicode(console) else (":", "|")


def _unicode(console: Console) -> bool:
    return (console.encoding or "utf-8").lower().startswith("utf")


def _wrapped(text: str, console: Console, indent: int) -> list[str]:
    """Break a text between words, for what is left of a line."""
    width = max(console.width - indent, 20)
    plain = printable(text.replace("\n", " "))
    return textwrap.wrap(plain, width, break_long_words=False, break_on_hyphens=False) or [""]


def print_line(console: Console, text: str) -> None:
    """Print a line as it is: what others named is neither markup nor a terminal's command."""
    for number, line in enumerate(_wrapped(text, console, 4)):
        indent = "    " if number else "  "
        console.print(f"{indent}{line}", soft_wrap=True, highlight=False, markup=False, emoji=False)


def _severities(head: Head, result: Result, console: Console) -> Table:
    """Numbers of the severities, grey where there is no verdict."""
    untested = not head.drawn and result.identified
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 1), style="dim" if untested else "")
    table.add_column("severity", no_wrap=True)
    for name in ("estimate", "std", "95 % interval"):
        table.add_column(name, justify="right", no_wrap=True)
    severities = [result.severities[bar.symbol] for bar in head.bars]
    remarks = [
        ["no verdict"] if untested else [FLAG_REMARKS[flag] for flag in item.flags]
        for item in severities
    ]
    if any(remarks):
        table.add_column("", no_wrap=True)
    for bar, item, remark in zip(head.bars, severities, remarks, strict=True):
        low, high = item.interval
        table.add_row(
            f"{bar.name} ({bar.symbol})" if console.width >= NAMED_COLUMNS else bar.symbol,
            _number(item.estimate, 5),
            _number(item.std, 5),
            f"{low:.5f} … {high:.5f}",
            *([", ".join(remark)] if any(remarks) else []),
        )
    return table


def _number(value: float | None, digits: int) -> str:
    return "nan" if value is None else f"{value:.{digits}f}"


def _limited(result: Result) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    table.add_column("effect", no_wrap=True)
    for name in ("estimate", "std", "95 % interval", "limit"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for item in result.other:
        std = item.shown(_known(item.std))
        numbers = (_known(item.value), *(item.interval95 or (math.nan, math.nan)))
        value, low, high = to_precision(std, *map(item.shown, numbers))
        table.add_row(
            item.meaning,
            f"{value} {item.shown_unit}",
            *to_precision(std, std),
            f"{low} … {high}",
            f"{item.shown(_known(item.limit)):.3g} {item.shown_unit}",
            "beyond its limit" if item.beyond else "",
        )
    return table


def _known(value: float | None) -> float:
    return math.nan if value is None else value


def _is_shown(item: Effect) -> bool:
    """Whether an effect is told unasked: no offset, which the fit has, nor what was learned."""
    from ehadiag.model.registry import SENSOR_OFFSETS  # noqa: PLC0415 - loads kernels

    offsets = {offset.name for offset in SENSOR_OFFSETS}
    return item.significant and item.name not in offsets and item.source != "calibration"


def _size(item: Effect) -> str:
    value, std = item.shown(_known(item.value)), item.shown(_known(item.std))
    return f"{item.meaning} {' ± '.join(to_precision(std, value, std))} {item.shown_unit}"


def _on_board(found: Onboard, result: Result, relied_on: bool) -> str:
    """What the flight-control computer found, beside what was found here."""
    parts = [f"on board: {(found.verdict or 'no verdict').replace('_', ' ')}"]
    parts += [
        f"{name} {_known(item.estimate):.7f}" + f" ± {_known(item.std):.7f}" * relied_on
        for name, item in found.faults.items()
    ]
    if found.evaluations is not None:
        parts.append(f"{found.evaluations} model runs")
    apart = [
        abs(item.estimate - own.value) / item.std
        for name, item in found.faults.items()
        if item.estimate is not None and item.std
        if (own := result.severities.get(name)) is not None and own.estimate is not None
    ]
    if apart and relied_on:
        parts.append(f"at most {max(apart):.2f} of its deviations from what was found here")
    return ", ".join(parts)


def _quality_text(result: Result) -> str:
    item = result.quality
    if item is None:
        return "no frames"
    return (
        f"frames {item.frames}, lost {item.lost}, repeated {item.repeated}, "
        f"conflicts {item.conflicts}, CRC errors {item.crc_errors}"
    )


def _effort_text(result: Result) -> str:
    fit, timing, search = result.fit, result.timing_s, result.search
    assert fit is not None
    assert timing is not None
    took = f"{timing.total - timing.read:.2f} s"
    if timing.after_test is not None:
        took = f"{timing.after_test:.2f} s after the test"
    begun = f"; begun from {search.begun_from}" if search.begun_from else ""
    return (
        f"residual rms spool {_known(fit.spool_rms):.2f}, pressure {_known(fit.pressure_rms):.2f} "
        f"of the noise, {_known(fit.outliers):.2%} outliers; solver {search.name}, "
        f"seed {search.seed}, {search.evaluations} model runs, {took}{begun}"
    )
